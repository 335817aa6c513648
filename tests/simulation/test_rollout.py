"""Rollouts and steps in place are repeated steps, bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from adjoint_cases import body
from cases import contact_block
from runs import moving, same_bits, simulate, simulator, state_of, tensor_of
from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode

import torchpd as pd
from torchpd.simulation.state import Info

pytestmark = pytest.mark.usefixtures("poisoned")


def test_step_in_place_is_the_step(dtype: torch.dtype, device: torch.device) -> None:
    for batch in (1, 3, 9):
        sim = simulate(dtype, device)
        state = moving(sim, batch)
        forces = 0.1 * state.velocities
        expected, info = sim(state, forces, start="inertial", return_info=True)
        rows = torch.full((batch, 7), float("nan"), dtype=torch.float64, device=device)
        addresses = [t.data_ptr() for t in state]
        sim.step_(state, forces, start="inertial", info=rows)
        assert same_bits(state, expected)
        assert [t.data_ptr() for t in state] == addresses
        assert all(torch.equal(one, other) for one, other in zip(Info.from_rows(rows), info, strict=True))


@pytest.mark.parametrize("batch", [1, 9])
def test_rollout_is_repeated_steps(batch: int, dtype: torch.dtype, device: torch.device) -> None:
    sim = simulate(dtype, device)
    state = moving(sim, batch)
    forces = 0.1 * state.velocities.flip(0)
    track = sim.rollout(state, 7, 2, forces=forces, return_info=True)
    assert track.positions.shape == (3, batch, sim.vertices, 3)
    for step in range(6):
        state, info = sim(state, forces, return_info=True)
        if step % 2 == 1:
            assert same_bits(track.state(step // 2), state)
            columns = [column[step // 2] for column in track.info]
            assert all(torch.equal(one, other) for one, other in zip(columns, info, strict=True))


@pytest.mark.parametrize("places", [-1, 1])
def test_a_start_may_lie_where_other_environments_are_overwritten(
    places: int, dtype: torch.dtype, device: torch.device
) -> None:
    sim = simulate(dtype, device, iterations=1)
    count = 40
    memory = sim.rest_positions + 0.02 * torch.randn(
        count + 1, sim.vertices, 3, dtype=dtype, generator=torch.Generator().manual_seed(3)
    ).to(device)
    own, other = (memory[1:], memory[:-1]) if places < 0 else (memory[:-1], memory[1:])
    state = pd.State(own, torch.zeros_like(own))
    expected = sim(pd.State(own.clone(), state.velocities.clone()), start=other.clone())
    sim.step_(state, start=other)
    assert same_bits(state, expected)
    # forces among the velocities
    state, forces = pd.State(torch.zeros_like(own) + sim.rest_positions, own), other
    expected = sim(pd.State(*(t.clone() for t in state)), forces.clone())
    sim.step_(state, forces)
    assert same_bits(state, expected)


def test_progress_and_functions_change_no_bit(
    dtype: torch.dtype, device: torch.device, capsys: pytest.CaptureFixture[str]
) -> None:
    sim = simulate(dtype, device)
    state = moving(sim)
    forces = 0.1 * state.velocities
    for steps, every in ((23, 1), (230, 4), (40, 40), (50, 20), (5, 9)):
        quiet = sim.rollout(state, steps, every, forces=forces, return_info=True)
        assert capsys.readouterr().err == ""
        shown = sim.rollout(state, steps, every, forces=forces, return_info=True, progress=True)
        assert "simulating" in capsys.readouterr().err
        called = sim.rollout(state, steps, every, forces=lambda _: forces, return_info=True)
        for other in (shown, called):
            assert same_bits(other, quiet)
            assert all(torch.equal(a, b) for a, b in zip(other.info, quiet.info, strict=True))


def test_forces_and_targets_as_functions_of_the_step(dtype: torch.dtype, device: torch.device) -> None:
    sim = simulate(dtype, device)
    pin = sim.scene.pins[0]
    held = tensor_of(sim.scene.values().pin_targets[sim.scene.pin_range(pin)], sim)
    state = moving(sim)
    push = 0.1 * state.velocities

    def forces(step: int) -> torch.Tensor:
        return push * step

    def targets(step: int) -> dict[pd.Pin, torch.Tensor]:
        return {pin: held + 0.001 * (step + 1)}

    track = sim.rollout(state, 6, 3, forces=forces, targets=targets)
    for step in range(6):
        state = sim(state, forces(step), targets(step))
        if step % 3 == 2:
            assert same_bits(track.state(step // 3), state)
    # a hard pin is where it was told to be: x + (target - x), one rounding
    error = (track.positions[-1][:, pin.vertices.tolist()] - (held + 0.006)).abs().max()
    assert float(error) <= 2 * torch.finfo(dtype).eps


def test_moving_sphere_drags_in_a_rollout(dtype: torch.dtype, device: torch.device) -> None:
    """Centres given step by step carry the velocity between them; it moves what sticks, and a still centre does not."""
    ball = pd.Sphere((0.15, -1.0, 0.15), 1.0, friction=20.0)
    case = contact_block(ball, pd.Damping(5.0))
    sim = simulator(case, dtype, device, iterations=30)
    start = tensor_of(np.array([0.15, -1.0, 0.15]), sim)
    shift = tensor_of(np.array([0.002, 0.0, 0.0]), sim)
    settled = sim.rollout(state_of(case, sim), 60, 60).state()
    moved = sim.rollout(settled, 10, targets=lambda step: {ball: start + shift * (step + 1)}).state()
    still = sim.rollout(settled, 10, targets=lambda step: {ball: start}).state()
    went, stayed = ((after.positions - settled.positions)[..., 0].mean() for after in (moved, still))
    # ten steps of 2 mm on a soft block that lags behind at first
    assert 0.01 < float(went) < 0.021
    assert abs(float(stayed)) < 1e-3
    # constant targets with a velocity: the ball goes on by itself within one rollout
    target = torch.cat([start + shift, shift / sim.time_step])
    own = sim.rollout(settled, 10, targets={ball: target}).state()
    # the centres agree up to ten roundings, friction keeps the rest together
    assert float((own.positions - moved.positions).abs().max()) <= 1e4 * torch.finfo(dtype).eps


def rough_ball(dtype: torch.dtype, device: torch.device) -> tuple[pd.Simulator, pd.State, pd.Sphere]:
    """A block at rest on a ball so rough that its velocity shows."""
    ball = pd.Sphere((0.15, -1.0, 0.15), 1.0, friction=20.0)
    case = contact_block(ball, pd.Damping(5.0))
    sim = simulator(case, dtype, device, iterations=30)
    return sim, sim.rollout(state_of(case, sim), 30, 30).state(), ball


def test_velocity_of_a_sphere_is_from_the_step_before(dtype: torch.dtype, device: torch.device) -> None:
    """Where it comes with its velocity on some steps, and where it is left out, in the scene's place."""
    sim, state, ball = rough_ball(dtype, device)
    home = tensor_of(np.array([0.15, -1.0, 0.15]), sim)
    shift = tensor_of(np.array([0.002, 0.0, 0.0]), sim)
    places = [home, *(home + shift * number for number in (1, 2, 4, 0, 1, 3, 0, 5))]  # from before the first step
    omitted, told = (3, 6), (1, 5)

    def row(step: int) -> torch.Tensor:
        return torch.cat([places[step + 1], (places[step + 1] - places[step]) / sim.time_step])

    def sparse(step: int) -> dict[pd.Sphere, torch.Tensor]:
        return {} if step in omitted else {ball: row(step) if step in told else places[step + 1]}

    def full(step: int) -> dict[pd.Sphere, torch.Tensor]:
        return {} if step in omitted else {ball: row(step)}

    found, expected = (sim.rollout(state, 8, targets=targets) for targets in (sparse, full))
    assert same_bits(found, expected)
    still = sim.rollout(state, 8, targets=lambda step: {ball: torch.cat([places[step + 1], torch.zeros_like(home)])})
    assert not same_bits(still, expected)


def test_rollouts_one_after_another_are_one(dtype: torch.dtype, device: torch.device) -> None:
    """Bit for bit, where balls move: by centres alone, left out on the step between, and by a constant velocity."""
    sim, state, ball = rough_ball(dtype, device)
    home = tensor_of(np.array([0.15, -1.0, 0.15]), sim)
    shift = tensor_of(np.array([0.002, 0.0, 0.0]), sim)
    push = 0.01 * torch.ones_like(state.positions)
    asked: list[int] = []

    def centres(step: int) -> dict[pd.Sphere, torch.Tensor]:
        asked.append(step)
        return {ball: home + shift * (step + 1)}

    def sometimes(step: int) -> dict[pd.Sphere, torch.Tensor]:
        return {} if step == 3 else centres(step)

    def forces(step: int) -> torch.Tensor:
        return push * step

    constant = {ball: torch.cat([home + shift, shift / sim.time_step])}
    cases: list[dict[str, Any]] = [{"targets": targets} for targets in (centres, sometimes, constant)]
    for arguments in (*cases, {"targets": constant, "forces": forces}):
        whole = sim.rollout(state, 8, **arguments)
        asked.clear()
        begun = sim.rollout(state, 4, **arguments)
        ended = sim.rollout(begun.state(), 4, first=4, **arguments)
        both = pd.Track(
            *(torch.cat([getattr(t, name) for t in (begun, ended)]) for name in whole._fields[:2]), whole.info
        )
        assert same_bits(both, whole)
        assert min(asked, default=0) == 0
        restarted = sim.rollout(begun.state(), 4, **arguments)
        assert not same_bits(restarted, ended)


def test_moving_sphere_takes_the_present_time_step(dtype: torch.dtype, device: torch.device) -> None:
    """A simulator whose time step was replaced drags as one that was made with it."""
    ball = pd.Sphere((0.15, -1.0, 0.15), 1.0, friction=20.0)
    case = contact_block(ball)
    replaced, fresh = (pd.Simulator(case.scene, h, 30, dtype=dtype).to(device) for h in (1 / 60, 1 / 120))
    replaced.time_step = 1 / 120
    state = fresh.rollout(state_of(case, fresh), 10, 10).state()
    row = tensor_of(np.array([0.151, -1.0, 0.15, 0.12, 0.0, 0.0]), fresh)

    def centres(step: int) -> dict[pd.Sphere, torch.Tensor]:
        return {ball: row[:3] * (1 + 0.001 * step)}

    expected = fresh(state, targets={ball: row})
    assert not same_bits(expected, fresh(state, targets={ball: row[:3]}))
    assert same_bits(replaced(state, targets={ball: row}), expected)
    for targets in ({ball: row}, centres):
        assert same_bits(*(sim.rollout(state, 4, targets=targets).state() for sim in (replaced, fresh)))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e30])
@pytest.mark.parametrize("batch", [3, 9])
def test_a_broken_environment_breaks_alone(value: float, batch: int, dtype: torch.dtype, device: torch.device) -> None:
    sim = simulate(dtype, device)
    clean = moving(sim, batch)
    sick = pd.State(clean.positions.clone(), clean.velocities.clone())
    sick.positions[1, 20, 1] = value
    others = [item for item in range(batch) if item != 1]
    expected, found = (sim.rollout(state, 3, return_info=True) for state in (clean, sick))
    for one, other in zip([*found[:2], *found.info], [*expected[:2], *expected.info], strict=True):
        assert torch.equal(one[:, others], other[:, others])
    if not np.isfinite(value):
        assert not bool(found.positions[-1, 1].isfinite().all())


class Allocations(TorchDispatchMode):
    """Storages of results that have so many bytes, by their addresses."""

    def __init__(self, least: int) -> None:
        super().__init__()
        self.least, self.found = least, set[int]()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        results = func(*args, **(kwargs or {}))
        for leaf in pytree.tree_leaves(results):
            if isinstance(leaf, Tensor) and leaf.untyped_storage().nbytes() >= self.least:
                self.found.add(leaf.untyped_storage().data_ptr())
        return results


def test_every_state_is_kept_once() -> None:
    """On the way back only what a loss depends on has a gradient of all steps."""
    sim, state = body(iterations=100)
    state.velocities.requires_grad_()
    kept: dict[int, int] = {}

    def keep(saved: Tensor) -> Tensor:
        kept[saved.untyped_storage().data_ptr()] = saved.untyped_storage().nbytes()
        return saved

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda saved: saved):
        track = sim.rollout(state, 24)
    size = track.positions.numel() * track.positions.element_size()
    assert sum(size <= count for count in kept.values()) == 2
    loss = track.positions[-1].sum()
    with Allocations(size) as allocations:
        torch.autograd.grad(loss, state.velocities)
    known = {t.untyped_storage().data_ptr() for t in (track.positions, track.velocities)}
    assert len(allocations.found - known) == 1


def test_gradients_of_single_steps_are_those_of_one_call(dtype: torch.dtype, device: torch.device) -> None:
    sim = simulate(dtype, device)
    state = moving(sim)
    forces = 0.1 * state.velocities
    found = []
    for given in (forces, lambda _: forces):
        speeds = state.velocities.clone().requires_grad_()
        track = sim.rollout(pd.State(state.positions, speeds), 5, 2, forces=given)
        (track.positions[0].square().sum() + track.velocities.sum()).backward()
        found.append(speeds.grad)
    assert found[0] is not None
    assert bool((found[0] != 0.0).any())
    assert torch.equal(*found)
