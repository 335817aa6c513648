"""Pins that are let go let go, in some environments or all, and hold again when they are told to."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from held_bar import BAR, LEFT, RIGHT, H, fallen, way
from multilevel_cases import solved_directly
from torch import Tensor
from torch.func import functional_call

import torchpd as pd
from torchpd.common.gpu import Properties
from torchpd.plan import Plan
from torchpd.plan.kernel_choice import choose_plan
from torchpd.scene.solvers import Solver


def simulator(
    *parts: Any,
    youngs: float = 1e6,
    held: Any = LEFT,
    iterations: int = 64,
    solver: Solver | None = None,
    dtype: torch.dtype = torch.float64,
) -> pd.Simulator:
    bar = pd.Solid(BAR, youngs=youngs)
    scene = pd.Scene(bar, pd.Pin(bar, held), pd.Gravity(), *parts)
    return pd.Simulator(scene, H, iterations, solver, dtype, progress=False)


def by_tiny_springs(sim: pd.Simulator) -> Any:
    sim.set_material(pin_stiffness=1e-9)
    return sim


def by_the_mask(sim: pd.Simulator) -> Any:
    sim.set_material(pin_hard=False)
    return sim


def in_place(sim: pd.Simulator) -> Any:
    sim.pin_hard[:] = False
    return sim


def by_another_buffer(sim: pd.Simulator) -> Any:
    sim.pin_hard = torch.zeros_like(sim.pin_hard)
    return sim


def by_a_state_dict(sim: pd.Simulator) -> Any:
    sim.load_state_dict(by_the_mask(copy.deepcopy(sim)).state_dict())
    return sim


def by_a_state_dict_of_before_the_mask(sim: pd.Simulator) -> Any:
    numbers = {name: array for name, array in sim.state_dict().items() if name != "pin_hard"}
    sim.load_state_dict(numbers | {"pin_stiffness": torch.full_like(sim.pin_stiffness, 1e-9)})
    return sim


def by_a_call(sim: pd.Simulator) -> Any:
    free = torch.zeros_like(sim.pin_hard)
    return lambda *args: functional_call(sim, {"pin_hard": free}, args)


def in_a_copy(sim: pd.Simulator) -> Any:
    return copy.deepcopy(by_the_mask(sim)).float()


@pytest.mark.parametrize(
    "let_go",
    [
        by_tiny_springs,
        by_the_mask,
        in_place,
        by_another_buffer,
        by_a_state_dict,
        by_a_state_dict_of_before_the_mask,
        by_a_call,
        in_a_copy,
    ],
)
@pytest.mark.parametrize("solver", [None, pd.Multilevel()], ids=["plain", "levels"])
def test_a_body_that_is_let_go_falls(let_go: Callable[[pd.Simulator], Any], solver: Solver | None) -> None:
    """Of 10 MPa, which 64 iterations alone do not shift: without rigid motions it falls by 4 % of this."""
    sim = simulator(youngs=1e7, solver=solver)
    sim(sim.rest_state())
    step = let_go(sim)
    dtype = step.dtype if isinstance(step, pd.Simulator) else sim.dtype
    state = sim.rest_state().to(dtype)
    for _ in range(6):
        state = step(state)
    assert float(way(sim, state.positions)) == pytest.approx(fallen(6), rel=1e-5)


@pytest.mark.parametrize("solver", [None, pd.Multilevel()], ids=["plain", "levels"])
def test_one_environment_is_let_go_and_grasped_again(solver: Solver | None) -> None:
    sim = simulator(youngs=1e7, solver=solver)
    held = sim(sim.rest_state(), return_info=True)
    sim.set_material(pin_hard=torch.tensor([[True], [False]]))
    track = sim.rollout(sim.rest_state(), 6)
    assert float(way(sim, track.positions[-1])[1]) == pytest.approx(fallen(6), rel=1e-6)
    hung = track.positions[0, 0]
    assert torch.equal(hung[LEFT], sim.rest_positions[LEFT])
    if solver is None:
        assert torch.equal(hung, held[0].positions[0])
    else:
        # by another preconditioner
        torch.testing.assert_close(hung, held[0].positions[0], rtol=0.0, atol=1e-9)
    state, plan = track.state(), sim.plan
    sim.set_material(pin_hard=True, pin_targets=state.positions[:, LEFT])
    for _ in range(3):
        state = sim(state)
    assert torch.equal(state.positions[:, LEFT], sim.pin_targets)
    # what is captured for a plan goes on, of which a preconditioner that holds them again is another part
    assert (sim.plan is plan) == (solver is None)


@pytest.mark.parametrize("direct", [False, True])
def test_pins_that_a_preconditioner_does_not_know_cost_no_iterations(direct: bool) -> None:
    """16 to a body of 10 MPa that sags by 0.6 mm, as with the preconditioner that knows them."""
    sim = simulator(youngs=1e7, iterations=16, solver=pd.Multilevel())
    held = sim(sim.rest_state())
    sim.set_material(pin_hard=torch.tensor([[True], [False]]))
    if direct:
        solved_directly(sim)
    torch.testing.assert_close(sim(sim.rest_state()).positions[0], held.positions[0], rtol=0.0, atol=1e-9)


def test_what_is_held_in_some_environments_has_the_bits_that_it_has_alone() -> None:
    """With contacts, friction, and pins that leave everything, a turn about a line or a point, or nothing."""
    line = np.isin(LEFT, np.flatnonzero(BAR.vertices[:, 1] == BAR.vertices[:, 1].min()))
    masks = torch.tensor(
        np.stack([line | True, line & False, line, np.arange(len(LEFT)) == 0, ~line])[np.arange(9) % 5]
    )
    assert masks.sum(1).tolist() == [9, 0, 3, 1, 6, 9, 0, 3, 1]
    contacts = pd.Ground(-0.001, friction=0.4), pd.Sphere((0.15, -0.05, 0.05), 0.06, friction=0.2)
    sim, alone = (simulator(*contacts, iterations=12, dtype=torch.float32) for _ in range(2))
    sim.set_material(pin_hard=masks)
    state = sim.rest_state()
    state.velocities.copy_(torch.randn(state.positions.shape, generator=torch.Generator().manual_seed(0)))
    track = sim.rollout(state, 4)
    assert float(track.positions[..., 1].min()) == pytest.approx(-0.001, abs=1e-7)
    clamped = alone.plan
    for item, mask in enumerate(masks):
        alone.set_material(pin_hard=mask)
        assert item != 0 or alone.plan is clamped
        single = alone.rollout(pd.State(state[0][item : item + 1], state[1][item : item + 1]), 4)
        assert torch.equal(single.positions[:, 0], track.positions[:, item]), item
        assert torch.equal(single.velocities[:, 0], track.velocities[:, item]), item


@pytest.mark.parametrize("let_go", ["set_material", "in place"])
def test_a_preconditioner_lets_go_too(let_go: str) -> None:
    """Of one end of two: a preconditioner that still held it would leave 0.7 of this."""
    both, left = np.concatenate([LEFT, RIGHT]), torch.arange(18) < 9
    exact = simulator(youngs=1e5, held=both, iterations=3000)
    exact.set_material(pin_hard=left)
    sim = simulator(youngs=1e5, held=both, iterations=16, solver=pd.Multilevel())
    if let_go == "in place":
        sim.pin_hard.copy_(left)
    else:
        # the other environment holds on: the step is right there too, with a preconditioner that holds nothing there
        sim.set_material(pin_hard=torch.stack([left, left | True]))
    found, expected = (s.rollout(s.rest_state(), 5).positions[-1] - s.rest_positions for s in (sim, exact))
    assert float((found[0] - expected[0]).norm() / expected[0].norm()) <= 1e-6
    if let_go != "in place":
        holding = simulator(youngs=1e5, held=both, iterations=200, solver=pd.Multilevel())
        hung = holding.rollout(holding.rest_state(), 5).positions[-1] - holding.rest_positions
        assert float((found[1] - hung[0]).norm() / hung.norm()) <= 1e-2
        sim.iterations = 100
        found = sim.rollout(sim.rest_state(), 5).positions[-1] - sim.rest_positions
        assert float((found[1] - hung[0]).norm() / hung.norm()) <= 1e-6


def test_springs_of_another_batch_bring_their_masks() -> None:
    sim = simulator(pd.Ground(-1.0))
    for batch in (2, 5):
        springs = torch.full((batch, len(LEFT)), torch.inf)
        springs[1:] = 1e3
        sim.set_material(pin_stiffness=springs, masses=sim.rest_positions.new_ones(batch, sim.vertices))
        assert sim.pin_hard.tolist() == springs.isinf().tolist()


def test_springs_that_are_written_to_count_in_the_next_step() -> None:
    """Beside pins that are hard, for which springs as the ops take them are kept from step to step."""
    sim, other = (simulator() for _ in range(2))
    mask = torch.arange(len(LEFT)) == 0
    for each in (sim, other):
        each.set_material(pin_stiffness=torch.full((len(LEFT),), 1e3).masked_fill(mask, torch.inf))
    state = sim(sim.rest_state())
    with torch.no_grad():
        sim.pin_stiffness.mul_(100.0)
    other.set_material(pin_stiffness=torch.full((len(LEFT),), 1e5).masked_fill(mask, torch.inf))
    assert torch.equal(sim(state).positions, other(state).positions)


def test_gradients_of_springs_and_targets_where_masks_differ() -> None:
    """By central differences; a hard pin's spring has no gradient, its target the one of what it holds."""
    sim = simulator(youngs=2e4, iterations=400)
    mask = torch.rand(3, len(LEFT), generator=torch.Generator().manual_seed(1)) < 0.5
    sim.set_material(pin_stiffness=torch.linspace(50.0, 200.0, 9, dtype=sim.dtype), pin_hard=mask)
    state = sim.rest_state()
    weights = torch.randn(state.positions.shape, dtype=sim.dtype, generator=torch.Generator().manual_seed(2))

    def loss(springs: Tensor, targets: Tensor) -> Tensor:
        after = functional_call(sim, {"pin_stiffness": springs, "pin_targets": targets}, (state,))
        return (weights * after.positions).sum()

    own = [array.detach().clone().requires_grad_() for array in (sim.pin_stiffness, sim.pin_targets)]
    found = torch.autograd.grad(loss(*own), own)
    sim.pin_stiffness.requires_grad_()
    (kept,) = torch.autograd.grad((weights * sim(state).positions).sum(), sim.pin_stiffness)
    assert torch.equal(kept, found[0])
    assert bool((found[0][mask.all(0)] == 0.0).all())
    sim.set_material(pin_hard=True)
    (none,) = torch.autograd.grad((weights * sim(state).positions).sum(), sim.pin_stiffness)
    assert not none.any()
    sim.set_material(pin_hard=mask)
    for number, size in ((0, 1e-2), (1, 1e-5)):
        direction = torch.randn(own[number].shape, dtype=sim.dtype, generator=torch.Generator().manual_seed(3))
        ends = []
        for change in (size * direction, -size * direction):
            given = [array.detach() for array in own]
            given[number] = given[number] + change
            ends.append(float(loss(*given)))
        expected = (ends[0] - ends[1]) / (2.0 * size)
        assert float((found[number] * direction).sum()) == pytest.approx(expected, rel=1e-6)


def test_only_what_pins_clamp_everywhere_is_left_out() -> None:
    """Pieces that a step moves rigidly: of two bodies those that some environment leaves a motion."""
    bars = [pd.Solid(BAR, youngs=1e6) for _ in range(2)]
    scene = pd.Scene(*bars, *(pd.Pin(bar, LEFT) for bar in bars))
    pinned = scene.values().pinned
    line, triangle = np.isin(np.arange(9), [0, 1, 2]), np.isin(np.arange(9), [0, 1, 3])
    point, none, all_of_them = np.arange(9) == 4, np.zeros(9, dtype=bool), np.ones(9, dtype=bool)
    for first, second, expected in (
        (all_of_them, all_of_them, [False, False]),
        (none, triangle, [True, False]),
        (line, point, [True, True]),
        ([all_of_them, triangle], [triangle, line], [False, True]),
        # no pin holds in both, but each holds by its own
        ([triangle, ~triangle], [triangle, none], [False, True]),
    ):
        hard = np.concatenate([np.atleast_2d(first), np.atleast_2d(second)], axis=1)
        assert pinned.loose(hard).tolist() == expected, (first, second)
        assert pinned.loose(hard.squeeze()).tolist() == expected
    sim = pd.Simulator(scene, H, progress=False)
    clamped = sim.plan

    def groups(plan: Plan) -> list[int]:
        return plan.vertex_component[torch.argsort(plan.vertex_order)].reshape(2, -1).unique(dim=1).flatten().tolist()

    assert groups(clamped) == [-1, -1]
    sim.set_material(pin_hard=torch.cat([torch.ones(9) > 0, torch.zeros(9) > 0]))
    assert groups(sim.plan) == [-1, 0]
    assert sim.plan.sizes[3] == 1 == sim.plan.sizes[-1]
    one = sim.plan
    sim.set_material(pin_hard=True)
    sim.set_material(pin_hard=torch.cat([torch.ones(9) > 0, torch.zeros(9) > 0]))
    sim.set_material(stiffness=5e5)
    assert sim.plan is one
    sim.set_material(pin_hard=False)
    assert groups(sim.plan) == [0, 1]
    # in another precision it is compiled for what is let go then
    sim.set_material(pin_hard=True)
    assert groups(sim.double().plan) == [-1, -1]


def test_a_plan_of_a_gpu_has_the_pieces_that_are_let_go() -> None:
    values, gpu = simulator().scene.values(), Properties(132, 232_448, 16)
    for kernel in ("block", "cluster", "grid", "stream"):
        for loose in (False, True):
            plan = choose_plan(replace(values, loose=np.array([loose])), torch.float32, gpu, kernel)
            assert plan.loose is not None
            assert plan.size("pieces") == int(loose) == int(plan.loose.sum())


def test_masks_are_mapped_and_compiled() -> None:
    sim, state = simulator(youngs=1e7), simulator().rest_state()
    masks = torch.stack([sim.pin_hard, ~sim.pin_hard])
    ends = torch.vmap(lambda mask: functional_call(sim, {"pin_hard": mask}, (state,)).positions)(masks)
    assert float(way(sim, ends[1])[0]) == pytest.approx(fallen(1), rel=1e-6)
    assert torch.equal(ends[0], functional_call(simulator(youngs=1e7), {}, (state,)).positions)
    step = torch.compile(sim, backend="eager", fullgraph=True)
    step(state)
    sim.set_material(pin_hard=False)
    assert torch.equal(step(state).positions, ends[1])


def test_a_pin_that_holds_nothing_costs_nothing_of_the_motion(dtype: torch.dtype) -> None:
    """A spring of 0 N/m is none: the same bits as a scene without pins."""
    bar = pd.Solid(BAR, youngs=1e5)
    free = pd.Simulator(pd.Scene(bar, pd.Gravity(), pd.Ground(-0.01)), H, 12, dtype=dtype, progress=False)
    sim = simulator(pd.Ground(-0.01), youngs=1e5, iterations=12, dtype=dtype)
    sim.set_material(pin_hard=False)
    assert bool((sim.pin_stiffness == 0.0).all())
    tracks = [one.rollout(one.rest_state(), 12) for one in (sim, free)]
    assert torch.equal(tracks[0].positions, tracks[1].positions)


def test_a_file_keeps_masks_and_springs(tmp_path: Any) -> None:
    sim = simulator(youngs=1e7)
    masks = torch.tensor([[True] * 9, [False] * 9])
    sim.set_material(pin_stiffness=torch.arange(9.0), pin_hard=masks)
    sim.save(tmp_path / "simulation")
    loaded = pd.Simulator.load(tmp_path / "simulation")
    assert torch.equal(loaded.pin_hard, masks)
    assert torch.equal(loaded.pin_stiffness, sim.pin_stiffness)
    assert torch.equal(loaded(loaded.rest_state()).positions, sim(sim.rest_state()).positions)
