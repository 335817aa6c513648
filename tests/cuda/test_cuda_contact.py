"""Contact between bodies on a GPU: as on the CPU, free of crossings, the same bits in any batch."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from body_scenes import (
    THICKNESS,
    Course,
    G,
    ball_on_sheet,
    block,
    crossed,
    each,
    folded_sheet,
    gripper,
    plates,
    pressed_cubes,
    simulator,
    slope,
    two_cubes,
    two_sheets,
)
from cases import rotation
from devices import require_gpu
from on_gpu import GPU, host_waits
from rod_scenes import crossed_rods, passages, rod_on_cloth
from runs import noise
from torch import Tensor

import torchpd as pd
from torchpd.plan.contact_plan import contact_plan

require_gpu()

_COURSES: dict[str, tuple[Callable[[], Course], int]] = {
    "two cubes": (two_cubes, 12),
    "ball on a sheet": (ball_on_sheet, 8),
    "plates": (lambda: plates(-0.002)[0], 24),
    "gripper": (lambda: gripper(0.8), 24),
    "folded sheet": (lambda: folded_sheet(self_contact=True), 12),
    "rods that cross": (lambda: crossed_rods(10.0), 8),
    "rod on a sheet": (rod_on_cloth, 8),
}


def arrays(state: pd.HistoryState) -> list[Tensor]:
    return [state.positions, state.velocities, *state.history]


def same_bits(one: Sequence[Tensor], other: Sequence[Tensor]) -> bool:
    return all(torch.allclose(a, b, rtol=0.0, atol=0.0, equal_nan=True) for a, b in zip(one, other, strict=True))


def on_gpu(course: Course, iterations: int, dtype: torch.dtype = torch.float64, **options: Any) -> pd.Simulator:
    return simulator(course.scene, iterations, dtype=dtype, device=GPU, **options)


# No two distances are equal, else rounding decides between pairs. With flat faces or symmetry a change of places by
# 2e-16 changes a step on the CPU alone by 1e-6 to 1e-2 of its way.
_WITHOUT_TIES: dict[str, tuple[Callable[[], Course], tuple[int, ...]]] = {
    "pressed cubes": (pressed_cubes, (4, 16, 64)),
    "two cubes": (two_cubes, (4, 16, 64)),
    "gripper": (lambda: gripper(0.8, rotation(2.0, 9.0, 1.0)), (4, 16, 64)),
    "plates": (lambda: plates(-0.002, turn=rotation(0.5, 9.0, 0.7))[0], (4, 16, 64)),
    "ball on a sheet": (ball_on_sheet, (16,)),
    "folded sheet": (lambda: folded_sheet(self_contact=True), (16, 64)),
}


def asking(sim: pd.Simulator, state: pd.HistoryState) -> pd.HistoryState:
    """The state with a force within a body, which is dropped: the CPU takes no shorter step where boxes are apart."""
    surface = contact_plan(sim.scene.values())
    vertex, triangles = int(surface.triangles[0, 0]), surface.triangles
    own = surface.body[triangles[:, 0]] == surface.body[vertex]
    other = int(np.flatnonzero(own & (triangles != vertex).all(axis=1))[0])
    given: Any = state.clone()
    if bool((given.history.keys < 0).all()):
        given.history.keys[:, 0] = vertex * len(triangles) + other
        given.history.forces[:, 0, 0] = 1.0
    return given  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("name", "iterations"), [(name, count) for name, (_, counts) in _WITHOUT_TIES.items() for count in counts]
)
def test_a_step_equals_that_of_the_cpu(name: str, iterations: int) -> None:
    """Each step from the state of the CPU: the same pairs, places to 1e-9 of the longest way, forces to 1e-6.

    Only sums over elements, energies and bodies have another order.
    """
    course = _WITHOUT_TIES[name][0]()
    host, device = simulator(course.scene, iterations), on_gpu(course, iterations)
    before, touched = asking(host, course.start(host)), False
    for number in range(12):
        given = None if course.targets is None else course.targets(number)
        state, info = host(before, targets=given, return_info=True)
        moved = None if given is None else {part: value.to(device.rest_positions) for part, value in given.items()}
        own, report = device(before.to(GPU), targets=moved, return_info=True)
        way = max(float((state.positions - before.positions).abs().max()), 1e-6)
        assert float((own.positions.cpu() - state.positions).abs().max()) <= 1e-9 * way
        torch.testing.assert_close(own.history.poses.cpu(), state.history.poses, rtol=0.0, atol=1e-9)
        assert float(report.contact_gap) == pytest.approx(float(info.contact_gap), rel=1e-6)
        assert float(report.held_back) == pytest.approx(float(info.held_back), rel=1e-6, abs=1e-12)
        most = float(state.history.forces.abs().max())
        normal, theirs = (s.history.forces[..., 0].sum().item() for s in (own, state))
        assert normal == pytest.approx(theirs, rel=1e-6, abs=1e-6 * most)
        touched = touched or bool(state.history.forces.any())
        before = asking(host, state)
    assert touched


@pytest.mark.parametrize("iterations", [4, 16])
def test_bodies_that_meet_keep_their_momentum(iterations: int, dtype: torch.dtype) -> None:
    """The coarse correction leaves sum m v to rounding, however few the iterations."""
    bodies = [
        pd.Solid(block(0.1, 2, middle).mesh, youngs=1e5, density=1000.0) for middle in ((0.0,) * 3, (0.12, 0.02, 0.013))
    ]
    scene = pd.Scene(*bodies, pd.Contact(friction=0.5, thickness=THICKNESS))
    sim = simulator(scene, iterations, dtype=dtype, device=GPU)
    state: Any = sim.rest_state(2)
    state.velocities[:] = torch.tensor(each(scene, (1.0, 0.2, 0.0), (-1.0, 0.0, 0.0))).to(state.velocities)
    masses, first = sim.masses.double()[:, None], state.velocities.double()
    for _ in range(4):
        state = sim(state)
        change = (masses * (state.velocities.double() - first)).sum(dim=1)
        size = (masses * first.abs()).sum()
        assert float(change.abs().max() / size) <= (1e-12 if dtype == torch.float64 else 1e-5)
    assert float((state.velocities.double() - first).abs().max()) > 0.1


@pytest.mark.parametrize("batch", [1, 300])
def test_bits_without_contact(batch: int, dtype: torch.dtype) -> None:
    """Steps in which nothing meets are those of kernel `block` without Contact."""
    bodies = block(0.1, 2, (0.0, 0.0, 0.0)), block(0.1, 2, (0.3, 0.0, 0.0))
    met = simulator(pd.Scene(*bodies, pd.Gravity(), pd.Contact(thickness=THICKNESS)), 24, dtype=dtype, device=GPU)
    alone = simulator(pd.Scene(*bodies, pd.Gravity()), 24, dtype=dtype, device=GPU, kernel="block")
    state: Any = met.rest_state(batch)
    state.velocities.add_(noise(state.velocities))
    plain = pd.State(state.positions.clone(), state.velocities.clone())
    for _ in range(3):
        state, plain = met(state), alone(plain)
        assert torch.equal(state.positions, plain.positions)
        assert torch.equal(state.velocities, plain.velocities)
    assert (state.history.keys == -1).all()


@pytest.mark.parametrize("iterations", [4, 16, 64])
@pytest.mark.parametrize("name", _COURSES)
def test_surfaces_do_not_cross(name: str, iterations: int, dtype: torch.dtype) -> None:
    make, count = _COURSES[name]
    course = make()
    sim = on_gpu(course, iterations, dtype)
    least = math.inf
    for state, info in course.steps(sim, count):
        assert crossed(sim, state) == 0
        assert state.positions.isfinite().all()
        assert int(info.contact_overflow) == 0
        least = min(least, float(info.contact_gap))
    assert 0.099 <= least < 20.0


@pytest.mark.filterwarnings("ignore::torchpd.SceneWarning")
def test_a_capacity_that_grows(dtype: torch.dtype) -> None:
    """Steps are those with room for all pairs, to the bit."""
    ends: list[Any] = []
    for capacity in (5000, "grow"):
        bodies = block(0.1, 2, (0.0, 0.05, 0.0)), block(0.1, 2, (0.013, 0.17, 0.009))
        scene = pd.Scene(*bodies, pd.Contact(friction=0.3, thickness=THICKNESS, capacity=capacity))  # type: ignore[arg-type]
        sim = simulator(scene, 16, dtype=dtype, device=GPU)
        assert sim.body_contact is not None
        if capacity == "grow":
            sim.body_contact = sim.body_contact.with_capacity(4)
        state: Any = sim.rest_state(3)
        state.velocities[:, 27:, 1] = -1.0
        ends.append(sim.rollout(state, 3).state())
    width = ends[1].history.keys.shape[1]
    assert 4 < width < 5000
    assert torch.equal(ends[0].positions, ends[1].positions)
    assert torch.equal(ends[0].history.forces[:, :width], ends[1].history.forces)
    assert ends[1].history.forces.any()


@pytest.mark.parametrize("iterations", [4, 16, 64])
@pytest.mark.parametrize("speed", [1.0, 40.0])
def test_rods_do_not_pass(speed: float, iterations: int, dtype: torch.dtype) -> None:
    course = crossed_rods(speed)
    sim = on_gpu(course, iterations, dtype)
    for state, info in course.steps(sim, 12):
        assert passages(state.positions[0].double().cpu().numpy()) == 0
        assert float(info.contact_gap) >= 0.099


@pytest.mark.parametrize("name", ["two cubes", "gripper", "ball on a sheet", "rods that cross"])
@pytest.mark.parametrize("tolerance", [0.0, 1e-2])
def test_runs_and_batches_do_not_matter(name: str, tolerance: float, dtype: torch.dtype) -> None:
    """300 environments of other velocities, after steps in which most of them touch: each as alone, and every time."""
    course = _COURSES[name][0]()
    sim = on_gpu(course, 24, dtype, tolerance=tolerance)
    start: Any = sim.rest_state(300)
    if course.velocities is not None:
        start.velocities[:] = torch.tensor(course.velocities, device=GPU)
    start.velocities.add_(0.1 * noise(start.velocities))

    def run(state: Any) -> list[Tensor]:
        rows = []
        for number in range(6):
            given = None if course.targets is None else course.targets(4 * number)
            moved = None if given is None else {part: value.to(sim.rest_positions) for part, value in given.items()}
            state, info = sim(state, targets=moved, return_info=True)
            rows += [*arrays(state), *info]
        return rows

    together = run(start)
    report = pd.Info(*together[-len(pd.Info._fields) :])
    assert float(report.contact_gap.min()) < 5.0
    assert same_bits(run(start), together)
    for item in (0, 1, 131, 299):
        alone = pd.HistoryState(
            *(array[item : item + 1] for array in start[:2]),
            type(start.history)(*(array[item : item + 1] for array in start.history)),
        )
        assert same_bits(run(alone), [array[item : item + 1] for array in together])


def test_a_team_of_blocks_has_the_bits_of_one(dtype: torch.dtype) -> None:
    """Sheets of 1225 cells: alone many blocks work on them, and one each in a batch of 300."""
    course = two_sheets(35)
    sim = on_gpu(course, 64, dtype)
    start: Any = sim.rest_state(300)
    start.velocities[:] = torch.tensor(course.velocities, device=GPU)
    alone = course.start(sim)
    for _ in range(3):
        start, alone = sim(start), sim(alone)
    assert int((alone.history.keys >= 0).sum()) > 0
    for item in (0, 299):
        assert same_bits([array[item : item + 1] for array in arrays(start)], arrays(alone))


@pytest.mark.parametrize("iterations", [32, 64])
def test_a_cube_at_rest(iterations: int, dtype: torch.dtype) -> None:
    """1 kg: forces of 9.81 N to 1e-4, at the thickness to 1e-6 m; its residual counts them."""
    course = slope(0.0, 0.0)
    sim = on_gpu(course, iterations, dtype)
    state, info = course.last(sim, 40)
    assert float(state.history.forces[..., 0].sum()) == pytest.approx(G, rel=1e-4)
    assert float(state.positions[..., 1].min()) == pytest.approx(THICKNESS, abs=1e-6)
    assert float(info.contact_gap) == pytest.approx(1.0, abs=1e-3)
    assert float(info.residual) < 1e-2


def test_overflow_is_of_one_environment() -> None:
    """Only where pairs exceed the capacity the step is taken back; other environments have the bits they have alone."""
    course = two_cubes()
    scene = pd.Scene(*course.scene.parts[:-1], pd.Contact(friction=0.5, thickness=THICKNESS, capacity=40))
    sim = simulator(scene, 16, device=GPU)
    state: Any = sim.rest_state(3)
    state.velocities[1] = torch.tensor(course.velocities, device=GPU)
    for _ in range(4):
        before = state
        state, info = sim(state, return_info=True)
    over = info.contact_overflow.tolist()
    assert over[1] > 0
    assert info.contact_gap.isnan().tolist() == [False, True, False]
    assert int(info.contact_pairs[1]) == 40 + over[1]
    assert over[0] == over[2] == 0
    assert same_bits([a[1] for a in arrays(state)], [a[1] for a in arrays(before)])
    alone: Any = sim.rest_state(1)
    for _ in range(4):
        alone = sim(alone)
    for item in (0, 2):
        assert same_bits([a[item : item + 1] for a in arrays(state)], arrays(alone))


def test_the_host_does_not_wait() -> None:
    course = gripper(0.8)
    sim = on_gpu(course, 8, torch.float32)
    state = course.start(sim)
    targets = {part: value.to(sim.rest_positions) for part, value in course.targets(0).items()}  # type: ignore[misc]
    sim(state, targets=targets, return_info=True)  # the host waits for the first launch of a kernel
    assert not host_waits(lambda: sim(state, targets=targets, return_info=True))


@pytest.mark.parametrize("name", ["two cubes", "gripper", "ball on a sheet"])
def test_a_replay_is_a_step_in_place(name: str, dtype: torch.dtype) -> None:
    course = _COURSES[name][0]()
    sim = on_gpu(course, 16, dtype)
    own, eager = course.start(sim), course.start(sim)
    targets = None
    if course.targets is not None:
        targets = {part: value.to(sim.rest_positions).clone() for part, value in course.targets(0).items()}
    step = sim.capture(own, targets=targets, return_info=True)
    assert same_bits(arrays(own), arrays(eager))
    for number in range(1, 8):
        if targets is not None and course.targets is not None:
            for part, value in course.targets(4 * number).items():
                targets[part].copy_(value)
        step.replay()
        sim.step_(eager, targets=targets)
        assert same_bits(arrays(own), arrays(eager))
    assert np.isfinite(float(step.info.residual))


def test_other_kernels_are_refused() -> None:
    with pytest.raises(ValueError, match="in a scene with Contact on a GPU, got 'block'"):
        on_gpu(two_cubes(), 4, kernel="block")
