"""However few the iterations: stiff bodies tip, fall over and roll on a plane as rigid bodies do."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from cases import Case, box, leaning, oriented, rotation
from numpy.typing import NDArray
from runs import simulator, state_of

import torchpd as pd
from torchpd.reference import step_problem

pytestmark = pytest.mark.usefixtures("poisoned")

Array = NDArray[np.float64]
ULP = {torch.float32: 2.0**-24, torch.float64: 2.0**-53}
H = 1 / 60
# What contacts push a vertex after the rigid motion, and with it their lever arms: at most this share of the size.
PUSHED = 2e-4
# Passes end with friction radii within 1e-6 of friction times l, and the motion answers those before, at twice the
# distance; of two vertices, sqrt(2) times that. Positions in float32 have no more than three digits of a push.
RUBBED = {torch.float32: 1e-3, torch.float64: 3e-6}


def after_step(case: Case, dtype: torch.dtype, device: torch.device, count: int, **options: Any) -> tuple[Array, Array]:
    sim = simulator(case, dtype, device, iterations=count, **options)
    after = sim(state_of(case, sim))
    return after.positions[0].double().cpu().numpy(), after.velocities[0].double().cpu().numpy()


def contact_force(case: Case, x: Array, v: Array, about: Array, ulp: float) -> tuple[Array, Array, float, float]:
    """Impulse of the contacts in a step, their torque about a point, and what may be left of either.

    Of the impulse that is rounding; of the torque, what pushes after the rigid motion leave, or rounding.
    """
    values = case.scene.values()
    masses = values.masses[:, None]
    push = masses * (v - case.velocities - H * values.gravity)
    rounding = 32 * ulp * float((masses * (np.abs(v) + np.abs(x) / H)).sum())
    force, torque = push.sum(axis=0), np.cross(x - about, push).sum(axis=0)
    return force, torque, rounding, max(PUSHED * float(np.linalg.norm(force) * np.ptp(x, axis=0).max()), rounding)


@pytest.mark.parametrize("count", [0, 3, 64])
def test_a_bar_falls_about_the_corner_that_it_stands_on(count: int, dtype: torch.dtype, device: torch.device) -> None:
    """Friction holds that, and has no torque about it; iterations alone let it fall with a tenth of its weight."""
    case = leaning(0.8)
    corner = int(case.positions[:, 1].argmin())
    x, v = after_step(case, dtype, device, count)
    assert np.abs(x[corner] - case.positions[corner]).max() <= 4 * ULP[dtype]
    push, torque, _, left = contact_force(case, x, v, x[corner], ULP[dtype])
    assert np.abs(torque).max() <= left
    assert push[1] > 0.0
    assert np.hypot(push[0], push[2]) <= 0.8 * push[1]
    weight = H * 9.8 * case.scene.values().masses.sum()
    assert push[1] < 0.99 * weight  # it falls
    assert np.hypot(push[0], push[2]) > 0.1 * weight


@pytest.mark.parametrize("count", [0, 3, 64])
def test_on_smooth_ground_its_middle_falls_straight(count: int, dtype: torch.dtype, device: torch.device) -> None:
    case = leaning(0.0)
    corner = int(case.positions[:, 1].argmin())
    x, v = after_step(case, dtype, device, count)
    push, torque, rounding, left = contact_force(case, x, v, x[corner], ULP[dtype])
    assert x[:, 1].min() >= -4 * ULP[dtype]
    assert x[corner, 1] <= 4 * ULP[dtype]
    assert np.abs(push[[0, 2]]).max() <= rounding
    assert np.abs(torque).max() <= left
    assert 0.0 < push[1] < 0.9 * H * 9.8 * case.scene.values().masses.sum()


def test_what_slides_and_tips_does_so_by_the_law_of_coulomb(dtype: torch.dtype, device: torch.device) -> None:
    """Its foot slips fast, so that friction acts against that, with its share of the push."""
    case = leaning(0.1, velocity=(1.0, 0.0, 0.5))
    foot = int(case.positions[:, 1].argmin())
    x, v = after_step(case, dtype, device, 3)
    push, torque, _, left = contact_force(case, x, v, x[foot], ULP[dtype])
    assert np.abs(torque).max() <= left
    slip = x[foot] - case.positions[foot]
    against = -slip[[0, 2]] / np.linalg.norm(slip[[0, 2]])
    assert push[1] > 0.0
    rub = float(np.hypot(push[0], push[2]))
    assert rub == pytest.approx(0.1 * push[1], rel=RUBBED[dtype])
    assert push[[0, 2]] @ against > 0.999 * rub


def sliding_on_an_edge() -> Case:
    return leaning(0.3, turn=(0.0, 0.0, 20.0), velocity=(1.0, 0.0, 0.15), gravity=(0.0, -9.8, 0.1))


def check_that_it_rubs_where_it_is_pushed(case: Case, x: Array, v: Array, dtype: torch.dtype) -> None:
    """Aside from the middle of its edge. All along that friction has one direction: the torque is of a force alone."""
    edge = np.flatnonzero(case.positions[:, 1] < 1e-12)
    assert len(edge) == 2
    push, torque, _, left = contact_force(case, x, v, x[edge].mean(axis=0), ULP[dtype])
    assert abs(torque[0]) > 1e-3 * push[1]  # its centre: a torque along x by how far it is aside
    assert abs(push @ torque) <= left * np.linalg.norm(push)
    assert np.hypot(push[0], push[2]) == pytest.approx(0.3 * push[1], rel=RUBBED[dtype])


def test_what_slides_on_an_edge_rubs_where_that_is_pushed(dtype: torch.dtype, device: torch.device) -> None:
    case = sliding_on_an_edge()
    x, v = after_step(case, dtype, device, 3)
    check_that_it_rubs_where_it_is_pushed(case, x, v, dtype)


def test_in_the_oracle_it_rubs_there_as_well() -> None:
    case = sliding_on_an_edge()
    problem = step_problem(case.scene.values(), case.positions, case.velocities, H)
    u = problem.align(problem.first_iterate())
    check_that_it_rubs_where_it_is_pushed(case, case.positions + u, u / H, torch.float64)


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.0, 33.0, 0.0)], ids=["along axes", "askew"])
def test_a_tall_box_tips_over_the_edge_that_it_is_pushed_over(
    turn: tuple[float, float, float], dtype: torch.dtype, device: torch.device
) -> None:
    """From its face: friction holds the far edge, whose torque along itself is none, and the near edge rises."""
    push = (6.0 * np.cos(np.radians(turn[1])), -9.8, -6.0 * np.sin(np.radians(turn[1])))
    case = leaning(1.0, turn=turn, size=(0.1, 0.4, 0.1), cells=(2, 8, 2), gravity=push)
    local = case.positions @ rotation(*turn)
    on_face = case.positions[:, 1] < 1e-12
    edge = on_face & (local[:, 0] > local[:, 0].max() - 1e-9)
    assert edge.sum() == 3
    x, v = after_step(case, dtype, device, 3)
    assert np.abs(x[edge] - case.positions[edge]).max() <= 8 * ULP[dtype]
    assert x[on_face & ~edge, 1].min() > 1e-6
    along = rotation(*turn)[:, 2]
    _, torque, _, left = contact_force(case, x, v, x[edge].mean(axis=0), ULP[dtype])
    assert abs(torque @ along) <= left


def test_what_rests_stays(dtype: torch.dtype, device: torch.device) -> None:
    """Pushed less than would tip it, the same box leans by no more than it bends."""
    case = leaning(1.0, size=(0.1, 0.4, 0.1), cells=(2, 8, 2), gravity=(2.0, -9.8, 0.0))
    x, _ = after_step(case, dtype, device, 64)
    foot = case.positions[:, 1] < 1e-12
    assert np.abs(x - case.positions)[foot].max() <= 1e-5
    assert np.abs(x - case.positions).max() <= 1e-3


@pytest.mark.parametrize(("count", "error"), [(3, 0.08), (16, 0.05), (64, 0.01)])
def test_it_falls_like_a_bar_that_is_pinned_there(
    count: int, error: float, dtype: torch.dtype, device: torch.device
) -> None:
    """A quarter of a second of a fall, against the same bar with a pin in place of friction, and 64 iterations."""
    case = leaning(1.0, turn=(0.0, 0.0, 20.0))
    corners = np.flatnonzero(case.positions[:, 1] < 1e-12)
    assert len(corners) == 2
    body = case.scene.parts[0]
    assert isinstance(body, pd.Solid)
    pinned = pd.Scene(body, pd.Gravity(), pd.Pin(body, corners))
    paths = []
    for scene, iterations in ((case.scene, count), (pinned, 64)):
        sim = simulator(Case(scene, case.positions, case.velocities, H), dtype, device, iterations=iterations)
        paths.append(sim.rollout(state_of(case, sim), 16).positions[-1, 0].double().cpu().numpy())
    fallen = np.abs(paths[1] - case.positions).max()
    assert fallen > 0.15
    assert np.abs(paths[0] - paths[1]).max() <= error * fallen


@pytest.mark.parametrize("friction", [0.0, 0.7])
def test_a_turn_ends_where_another_vertex_comes_down(friction: float, dtype: torch.dtype, device: torch.device) -> None:
    """A block that tips on to its face within the step: nothing goes under the ground."""
    case = leaning(friction, turn=(0.0, 10.0, 1.0), size=(0.2, 0.2, 0.2), cells=(2, 2, 2))
    spin = np.cross([0.0, 0.0, -2.0], case.positions - case.positions[case.positions[:, 1].argmin()])
    case = Case(case.scene, case.positions, spin, H)
    for count in (0, 3, 20):
        x, _ = after_step(case, dtype, device, count)
        assert x[:, 1].min() >= -8 * ULP[dtype]


def test_a_turn_ends_at_other_contacts(dtype: torch.dtype, device: torch.device) -> None:
    """A wall that a falling bar leans on within the step, and a ball."""
    free = leaning(0.8)
    x, _ = after_step(free, dtype, device, 3)
    top = int(x[:, 0].argmin())
    way = x[top] - free.positions[top]
    half = free.positions[top] + 0.5 * way
    wall = pd.Ground(float(half[0]), normal=(1.0, 0.0, 0.0))
    ball = pd.Sphere((float(half[0]) - 0.1, float(half[1]), float(half[2])), 0.1)
    for other in (wall, ball):
        case = leaning(0.8, other)
        x, _ = after_step(case, dtype, device, 3)
        distance = x[:, 0] - half[0] if other is wall else np.linalg.norm(x - ball.center, axis=1) - 0.1
        assert distance.min() >= -8 * ULP[dtype]
        moved = np.linalg.norm(x[top] - free.positions[top]) / np.linalg.norm(way)
        assert moved <= 0.75


def test_environments_tip_each_for_itself(dtype: torch.dtype, device: torch.device) -> None:
    """Nine bars, some of which stand, tip, slide or fly: each the same bits as alone."""
    case = leaning(0.3)
    # on a GPU a few alone would get another kernel
    options = {"kernel": "block"} if device.type == "cuda" else {}
    sim = simulator(case, dtype, device, iterations=5, **options)
    state = state_of(case, sim, 9)
    generator = torch.Generator().manual_seed(0)
    for item in range(9):
        turn = torch.as_tensor(rotation(0.0, 0.0, -20.0 + 5.0 * item), dtype=dtype).to(device)
        x = state.positions[item] @ turn.mT
        x[:, 1] -= x[:, 1].min() - (0.1 if item == 7 else 0.0)
        state.positions[item] = x
        state.velocities[item] = (item == 5) + 0.1 * torch.randn(3, generator=generator).to(x)
    together = sim(state)
    for item in range(9):
        alone = sim(pd.State(*(part[item : item + 1] for part in state)))
        assert torch.equal(alone.positions[0], together.positions[item])
        assert torch.equal(alone.velocities[0], together.velocities[item])


def prism(layers: int = 8) -> tuple[Array, Any]:
    """A column of 0.4 m with three sides, whose foot reaches 5 cm from its middle at corners and 2.5 cm at edges."""
    angles = np.radians([0.0, 120.0, 240.0])
    foot = 0.05 * np.stack([np.cos(angles), 0.0 * angles, -np.sin(angles)], axis=1)
    vertices = np.concatenate([foot + [0.0, 0.4 * k / layers, 0.0] for k in range(layers + 1)])
    split = np.array([[0, 1, 2, 3], [1, 2, 3, 4], [2, 3, 4, 5]])
    return vertices, np.concatenate([split + 3 * k for k in range(layers)])


@pytest.mark.parametrize("lean", [0.65, 0.95])
def test_a_column_of_three_sides_tips_over_an_edge(lean: float, dtype: torch.dtype, device: torch.device) -> None:
    """Pressure has its centre that share of the foot's reach at corners away, beyond the edge: at half of it."""
    vertices, tets = prism()
    push = 9.8 * 0.05 * lean / 0.2
    direction = np.array([-1.0, 0.0, 0.0])
    scene = pd.Scene(
        pd.Solid(pd.TetMesh(vertices, oriented(vertices, tets)), 1e7),
        pd.Gravity(tuple(push * direction + [0.0, -9.8, 0.0])),
        pd.Ground(0.0, friction=2.0),
    )
    case = Case(scene, vertices, 0.0 * vertices, H)
    x, v = after_step(case, dtype, device, 3)
    assert np.abs(x[[1, 2]] - vertices[[1, 2]]).max() <= 8 * ULP[dtype]
    assert x[0, 1] > 1e-5
    _, torque, _, left = contact_force(case, x, v, x[[1, 2]].mean(axis=0), ULP[dtype])
    assert abs(torque[2]) <= left


@pytest.mark.parametrize("place", [0.0, 5.0])
@pytest.mark.parametrize("time_step", [1 / 60, 1 / 240])
@pytest.mark.parametrize("friction", [0.0, 1.0])
def test_planes_may_be_tilted_and_far_away(
    friction: float, time_step: float, place: float, dtype: torch.dtype, device: torch.device
) -> None:
    """In ten directions, where positions in float32 are no nearer to a plane than they are exact."""
    generator = np.random.default_rng(1)
    for number in range(10):
        straight = leaning(friction)
        turn = rotation(*(360.0 * generator.random(3)))
        at = place * turn @ np.array([0.6, 0.0, 0.8])
        normal = turn @ [0.0, 1.0, 0.0]
        scene = pd.Scene(
            straight.scene.parts[0],
            pd.Gravity(tuple(-9.8 * normal)),
            # in any place of the list
            *(pd.Ground(-30.0, normal=tuple(side)) for side in np.eye(3)[: number % 4]),
            pd.Ground(float(at @ normal), normal=tuple(normal), friction=friction),
        )
        case = Case(scene, straight.positions @ turn.T + at, 0.0 * straight.positions, time_step)
        if dtype == torch.float32:
            case = Case(scene, case.positions.astype(np.float32).astype(np.float64), case.velocities, time_step)
        x, _ = after_step(case, dtype, device, 0)
        upright = Case(straight.scene, straight.positions, case.velocities, time_step)
        expected, _ = after_step(upright, torch.float64, torch.device("cpu"), 0)
        way = (expected - straight.positions) @ turn.T
        rounding = 8 * ULP[dtype] * (np.abs(x).max() + 0.5)
        assert np.abs((x - case.positions) - way).max() <= rounding + 1e-3 * np.abs(way).max()


def test_what_flies_over_rough_ground_is_left_alone(dtype: torch.dtype, device: torch.device) -> None:
    """However near, and however fast along it."""
    case = leaning(2.5, velocity=(-4.81, 0.55, 0.0), height=0.001)
    spin = np.cross([0.3, 2.0, -1.0], case.positions - case.positions.mean(axis=0))
    case = Case(case.scene, case.positions, case.velocities + spin, H)
    body, gravity, _ = case.scene.parts
    free = Case(pd.Scene(body, gravity), case.positions, case.velocities, H)
    over, alone = (after_step(c, dtype, device, 3)[1] for c in (case, free))
    assert np.abs(over - alone).max() <= 64 * ULP[dtype] / H


@pytest.mark.parametrize("count", [10, 16, 64])
def test_what_is_dropped_comes_to_rest(count: int, dtype: torch.dtype, device: torch.device) -> None:
    """A cube from 5 cm, on its edge first, within two seconds; iterations alone leave it leaning, or jumping."""
    case = leaning(0.8, turn=(3.0, 10.0, 2.0), size=(0.2, 0.2, 0.2), cells=(3, 3, 3), height=0.05)
    sim = simulator(case, dtype, device, iterations=count)
    track = sim.rollout(state_of(case, sim), 150)
    assert float(track.velocities[-30:].abs().max()) <= 5e-3
    foot = track.positions[-1, 0, :, 1]
    # iterations push it out by the way of gravity in a step, to the rounding of that
    assert float(foot.min()) >= -ULP[dtype] * 9.8 * H**2
    assert int((foot < 1e-5).sum()) == 16


@pytest.mark.parametrize("iterations", [0, 1])
def test_half_a_turn_to_a_contact_is_none(iterations: int, dtype: torch.dtype, device: torch.device) -> None:
    """A start that is turned by 180 degrees, and two walls on the way: a share of that turn has no axis."""
    vertices, tets = box((0.2, 0.2, 0.2), (2, 2, 2))
    vertices = vertices - 0.1
    planes = [pd.Ground(-1.0), pd.Ground(-1.0, normal=(1.0, 0.0, 0.0))]
    case = Case(
        pd.Scene(pd.Solid(pd.TetMesh(vertices, tets), 1e6), *planes),
        vertices,
        0.0 * vertices + [-100.0, -100.0, 0.0],
        H,
    )
    sim = simulator(case, dtype, device, iterations=iterations)
    state = state_of(case, sim)
    after = sim(state, start=state.positions * state.positions.new_tensor([-1.0, 1.0, -1.0]))
    assert bool(after.positions.isfinite().all())
