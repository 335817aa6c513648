"""Gradients through contact between bodies on a GPU: those of the CPU, the same bits in any batch, differences."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from adjoint_scenes import (
    CASES,
    CONVERGED,
    WITH_SCENE,
    Step,
    cube_on_cube,
    edge_on_edge,
    seeded,
    sliding_cube,
    sticking_cube,
    vertex_on_triangle,
)
from body_scenes import H, pressed_cubes, simulator, slope
from devices import require_gpu
from on_gpu import GPU, relative
from op_samples import OF_CONTACT, samples
from runs import plan_of, settings_of
from torch import Tensor, nn
from torch.utils._pytree import tree_map

import torchpd as pd

require_gpu()
pytestmark = pytest.mark.filterwarnings("ignore::torchpd.MeshWarning")

NAMES = ("positions", "velocities", "forces", "end", "start", "friction", "thickness", "rigid")


def pressed() -> Step:
    """Cubes that pins hold and press on each other: 18 pairs with forces, most of which stick."""
    course = pressed_cubes()
    sim = simulator(course.scene, CONVERGED)
    state: Any = course.start(sim)
    for number in range(11):
        targets = course.targets(number)  # type: ignore[misc]
        state = sim(state, targets=targets)
    (held,) = targets.values()
    sim.pin_targets[..., -len(held) :, :] = held  # for the next step, too
    return Step(sim, state)


STEPS: dict[str, Callable[[], Step]] = {**CASES, **WITH_SCENE, "pressed cubes": pressed}


@dataclass(frozen=True)
class Saved:
    """What a step on the CPU leaves for its adjoint."""

    step: Step
    positions: Tensor
    velocities: Tensor
    after: Tensor
    poses: Tensor
    history: list[Tensor]  # poses before and after the step, keys and forces
    pushes: Tensor
    taken_back: Tensor

    @classmethod
    def of(cls, step: Step) -> Saved:
        sim, state = step.sim, step.state
        assert sim.body_contact is not None
        inputs = step.inputs()
        start, keys, forces, *_ = state.history
        poses = inputs.get("end", start)
        taken = torch.ops.torchpd.contact_step(
            state[0], state[1], None, poses, [start, keys, forces], sim.material(), plan_of(sim),
            sim.body_contact.arrays, **settings_of(sim, iterations=CONVERGED),
        )  # fmt: skip
        after, numbers, actual, keys, forces, pushes = (taken[place] for place in (0, 3, 5, 6, 7, 8))
        assert bool((forces[..., 0] > 0).any())
        return cls(step, state[0], state[1], after, poses, [start, actual, keys, forces], pushes, numbers[:, 1] > 0)

    def repeated(self, shifts: Tensor) -> Saved:
        """Environments whose places after the step are moved apart by a share of the thickness each."""
        count = len(shifts)

        def each(array: Tensor) -> Tensor:
            return array.expand(count, *array.shape[1:]).contiguous()

        after = each(self.after) + shifts[:, None, None] * seeded(self.after, 7)
        history = [each(array) for array in self.history]
        return Saved(
            self.step, each(self.positions), each(self.velocities), after, each(self.poses), history,
            each(self.pushes), each(self.taken_back),
        )  # fmt: skip

    def on(self, device: torch.device) -> Saved:
        """Where the op needs no copies."""
        parts = (self.positions, self.velocities, self.after, self.poses)
        x, v, after, poses = (array.to(device) for array in parts)
        history = [array.to(device) for array in self.history]
        return Saved(self.step, x, v, after, poses, history, self.pushes.to(device), self.taken_back.to(device))

    def rows(self, chosen: list[int]) -> Saved:
        parts = (self.positions, self.velocities, self.after, self.poses)
        x, v, after, poses = (array[chosen] for array in parts)
        history = [array[chosen] for array in self.history]
        return Saved(self.step, x, v, after, poses, history, self.pushes[chosen], self.taken_back[chosen])

    def gradients(self, sim: pd.Simulator) -> dict[str, Tensor]:
        """By the op, on the device of a simulator of the same scene."""
        found = torch.ops.torchpd.contact_step_vjp(*self.arguments(sim), time_step=H)
        names = [*NAMES, *(f"material {number}" for number in range(len(found) - len(NAMES)))]
        return {name: array for name, array in zip(names, found, strict=True) if array.numel()}

    def arguments(self, sim: pd.Simulator) -> list[Any]:
        """Of the op, on that device."""
        like = sim.rest_positions
        assert sim.body_contact is not None

        def moved(array: Tensor) -> Tensor:
            return array.to(like) if array.is_floating_point() else array.to(like.device)

        count = len(self.after)
        seeds = [seeded(self.after[:1].cpu(), n).expand(count, -1, -1).contiguous() for n in range(2)]
        grads = [seeds[0], H * seeds[1], seeded(self.poses[:1].cpu(), 2).expand(count, -1, -1).contiguous()]
        state = [self.after, self.positions, self.velocities]
        return [
            *map(moved, [*grads, *state]), None, moved(self.poses), [moved(array) for array in self.history],
            moved(self.pushes), moved(self.taken_back), sim.material(), plan_of(sim), sim.body_contact.arrays,
        ]  # fmt: skip


def on_gpu(step: Step, dtype: torch.dtype = torch.float64) -> pd.Simulator:
    sim = simulator(step.sim.scene, CONVERGED, dtype=dtype, device=GPU)
    sim.pin_targets.copy_(step.sim.pin_targets)
    return sim


@pytest.mark.parametrize("name", STEPS)
def test_the_gradients_of_the_cpu(name: str) -> None:
    """The same state, pairs and forces: to 1e-9, ten times the residual at which both solves stop.

    Only sums have another order. For the pressed cubes and the cloth to 1e-8: an ulp of the places changes their
    gradients by 8e-10 and 3e-9 on the CPU. Pins whose target bodies keep them from have no gradient on either.
    """
    saved = Saved.of(STEPS[name]())
    sim = on_gpu(saved.step)
    wanted, found = saved.gradients(saved.step.sim), saved.gradients(sim)
    least = 1e-8 if name in ("pressed cubes", "cloth over a cube") else 1e-9
    most = {key: relative(found[key], wanted[key]) for key in wanted if wanted[key].any()}
    assert max(most.values()) <= least, most
    assert all(not found[key].any() for key in wanted if not wanted[key].any())
    assert not wanted["positions"].cpu().isnan().any()


@pytest.mark.parametrize("make", [sliding_cube, sticking_cube, pressed])
def test_float32(make: Callable[[], Step]) -> None:
    """As near to float64 as the CPU is, or as a residual of 1e-5 leaves it: to 1e-4."""
    saved = Saved.of(make())
    wanted = saved.gradients(saved.step.sim)
    single = simulator(saved.step.sim.scene, CONVERGED, dtype=torch.float32)
    single.pin_targets.copy_(saved.step.sim.pin_targets)
    host, found = saved.gradients(single), saved.gradients(on_gpu(saved.step, torch.float32))
    for key in ("positions", "velocities", "forces"):
        assert found[key].dtype == torch.float32
        assert relative(found[key], wanted[key]) <= max(4.0 * relative(host[key], wanted[key]), 1e-4), key


@pytest.mark.parametrize("make", [sliding_cube, sticking_cube, cube_on_cube, pressed])
def test_the_same_bits_in_a_batch(make: Callable[[], Step], dtype: torch.dtype) -> None:
    """300 environments, each as alone, and every time."""
    step = make()
    sim = on_gpu(step, dtype)
    many = Saved.of(step).repeated(torch.linspace(-1e-6, 1e-6, 300, dtype=torch.float64))
    together, again = many.gradients(sim), many.gradients(sim)
    for key, value in together.items():
        assert torch.equal(value, again[key]), key
    for number in (0, 123, 299):
        alone = many.rows([number]).gradients(sim)
        for key in ("positions", "velocities", "forces", "start", "end"):
            if key in alone:
                assert torch.equal(together[key][number], alone[key][0]), (key, number)
    assert not torch.equal(together["positions"][0], together["positions"][299])


@pytest.mark.parametrize("make", [vertex_on_triangle, edge_on_edge, sticking_cube])
def test_differences(make: Callable[[], Step]) -> None:
    """Of converged steps on the GPU itself, along a random direction: to 1e-6."""
    step = make()
    poses = None if step.poses is None else step.poses.to(GPU)
    own = Step(on_gpu(step), step.state.to(GPU), step.colliders, poses)
    inputs, found = own.inputs(), own.gradients()
    for key, size in (("positions", 1e-7), ("velocities", 1e-5), ("end", 1e-7)):
        if key not in found:
            continue
        direction = seeded(inputs[key], 11)
        along = float((found[key] * direction).sum())
        assert along == pytest.approx(own.difference(key, direction, size), rel=1e-6), key


def test_rollouts() -> None:
    """A loss of a rollout by the friction of a sliding cube, against a difference of rollouts: to 1e-3."""
    step = sliding_cube()
    sim = simulator(step.sim.scene, 256, device=GPU)
    friction = torch.tensor(0.3, dtype=torch.float64, device=GPU, requires_grad=True)
    state = step.state.to(GPU)

    def way(of: Tensor) -> Tensor:
        sim.contact_friction = of
        return sim.rollout(state, 5).state().positions[..., 0].mean()

    (found,) = torch.autograd.grad(way(friction), friction)
    with torch.no_grad():
        wanted = float(way(friction + 1e-4) - way(friction - 1e-4)) / 2e-4
    assert wanted < 0.0
    assert float(found) == pytest.approx(wanted, rel=1e-3)


def test_friction_of_each_environment() -> None:
    """The bits and the gradients of each alone; the way of the CPU."""
    step = sliding_cube()
    sim, host = simulator(step.sim.scene, 64, device=GPU), simulator(step.sim.scene, 64)
    values = torch.tensor([0.1, 0.3, 0.7], dtype=torch.float64, device=GPU)

    def way(of: pd.Simulator, friction: Tensor) -> Tensor:
        of.contact_friction = friction
        state = tree_map(lambda array: array.repeat(len(friction), *[1] * (array.dim() - 1)), step.state.to(of.device))
        return of.rollout(state, 3).state().positions[..., 0].mean(dim=1)

    friction = values[:, None, None].requires_grad_()
    together = way(sim, friction)
    (found,) = torch.autograd.grad(together.sum(), friction)
    torch.testing.assert_close(together.detach().cpu(), way(host, friction.detach().cpu()), rtol=0.0, atol=1e-10)
    for number in range(3):
        own = values[number, None, None, None].requires_grad_()
        alone = way(sim, own)
        assert torch.equal(alone[0], together[number])
        assert torch.equal(torch.autograd.grad(alone.sum(), own)[0][0], found[number])


def test_a_trained_thickness_of_a_moved_simulator() -> None:
    """It stays on the host; d (height of the top) / d thickness = 1, once a cube rests: to 1e-6 after 20 steps."""
    sim = simulator(slope(0.0, 0.0).scene, 128)
    sim.contact_thickness = nn.Parameter(torch.tensor(1.2e-3, dtype=torch.float64))
    sim = sim.to(GPU)
    state: Any = sim.rest_state()
    for _ in range(20):
        state = sim(state)
    assert isinstance(sim.contact_thickness, nn.Parameter)
    assert sim.contact_thickness.device.type == "cpu"
    (found,) = torch.autograd.grad(state.positions[0, :, 1].max(), sim.contact_thickness)
    assert float(found) == pytest.approx(1.0, abs=1e-6)


def test_a_step_that_is_taken_back() -> None:
    """An environment whose pairs exceed the capacity passes gradients on as they are; others are untouched."""
    saved = Saved.of(sliding_cube()).repeated(torch.zeros(2, dtype=torch.float64))
    saved.taken_back[1] = True
    sim = on_gpu(saved.step)
    found = saved.gradients(sim)
    alone = saved.rows([0]).gradients(sim)
    assert torch.equal(found["positions"][0], alone["positions"][0])
    assert torch.equal(found["positions"][1].cpu(), seeded(saved.after[:1], 0)[0])
    assert not found["forces"][1].any()


def test_the_host_waits_only_for_counts(capfd: pytest.CaptureFixture[str]) -> None:
    """The host reads how many pairs there are, twice, and whether solves have failed: however many iterations."""
    saved = Saved.of(sliding_cube())
    sim = on_gpu(saved.step)
    arguments = saved.arguments(sim)
    torch.ops.torchpd.contact_step_vjp(*arguments, time_step=H)
    capfd.readouterr()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            torch.ops.torchpd.contact_step_vjp(*arguments, time_step=H)
        finally:
            torch.cuda.set_sync_debug_mode("default")
    # torch warns in Python, or on stderr from C++ alone
    said = [*map(str, (each.message for each in caught)), capfd.readouterr().err]
    assert sum(text.count("called a synchronizing") for text in said) == 3


@pytest.mark.parametrize("name", OF_CONTACT)
def test_opcheck(name: str, dtype: torch.dtype) -> None:
    arguments, keywords = samples(name, dtype, GPU)
    report = torch.library.opcheck(getattr(torch.ops.torchpd, name).default, arguments, keywords)
    assert set(report.values()) == {"SUCCESS"}


def test_memory() -> None:
    """A backward pass of 64 environments takes what the text says for those in progress, and gives it back."""
    saved = Saved.of(sliding_cube()).repeated(torch.zeros(64, dtype=torch.float64)).on(GPU)
    sim = on_gpu(saved.step)
    saved.gradients(sim)
    torch.cuda.synchronize()
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    saved.gradients(sim)
    torch.cuda.synchronize()
    assert torch.cuda.memory_allocated() == before
    rows = 3 * int((saved.history[3][..., 0] > 0).sum(dim=1).max())
    assert torch.cuda.max_memory_allocated() - before <= 64 * (24 * rows**2 + 2_000 * rows + 2_000_000)


def test_too_many_pairs() -> None:
    """More rows than memory is taken for are refused by their number."""
    saved = Saved.of(sliding_cube())
    sim = on_gpu(saved.step)
    assert sim.body_contact is not None
    sizes = sim.body_contact.arrays[0].clone()
    capacity = 1_000_000
    sizes[2] = capacity
    many = torch.ones(1, capacity, 4, dtype=torch.float64)
    keys = torch.full((1, capacity), -1)
    arrays = [sizes, *sim.body_contact.arrays[1:]]
    x = saved.after.to(GPU)
    inertia = torch.ones(x.shape[1], dtype=torch.float64, device=GPU)
    pairs = [x, x, *[saved.poses.to(GPU)] * 3, keys.to(GPU), many.to(GPU), *arrays]
    with pytest.raises(NotImplementedError, match="1000000 pairs"):
        torch.ops.torchpd.contact_conjugate(
            x, x, inertia, inertia, None, sim.material(), plan_of(sim), None, None, pairs, tolerance=1e-3, time_step=H
        )
