"""However few the iterations: momentum, linear and angular, of what no pin holds, and Coulomb's law of what slides."""

from __future__ import annotations

import itertools
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
import torch
from cases import Case, Still, box, contact_block, slope
from numpy.typing import NDArray
from runs import arguments_of, simulator, state_of

import torchpd as pd
from torchpd.reference import step_problem
from torchpd.reference.solvers import guarded_chebyshev

pytestmark = pytest.mark.usefixtures("poisoned")

Array = NDArray[np.float64]
ULP = {torch.float32: 2.0**-24, torch.float64: 2.0**-53}
H = 1 / 60
SOLVERS = [pd.Jacobi(), pd.Chebyshev(), pd.Multilevel()]
COUNTS = [1, 3, 10]


def stepped(case: Case, dtype: torch.dtype, device: torch.device, solver: object, count: int) -> tuple[Array, Array]:
    """Positions and velocities after a step."""
    sim = simulator(case, dtype, device, iterations=count, solver=solver)
    after = sim(state_of(case, sim), **arguments_of(case, sim))
    return after.positions[0].double().cpu().numpy(), after.velocities[0].double().cpu().numpy()


def rod(youngs: float, *parts: pd.scene.Part, forces: Array | None = None, spin: float = 0.0) -> Case:
    """A bar of 0.6 m in the air, or on y = 0, that turns about an axis askew."""
    vertices, tets = box((0.6, 0.1, 0.1), (6, 1, 1))
    scene = pd.Scene(pd.Solid(pd.TetMesh(vertices, tets), youngs), *parts)
    turning = np.cross(spin * np.array([0.1, 1.0, 0.2]), vertices - vertices.mean(axis=0))
    return Case(scene, vertices, turning, H, extras={} if forces is None else {"forces": forces})


def gains(case: Case, x: Array, v: Array) -> tuple[Array, Array, float]:
    """Gains of momentum, and of that about the centre, beyond forces and gravity, and the size of their terms."""
    values = case.scene.values()
    masses = values.masses[:, None]
    outer = case.extras.get("forces", np.zeros_like(v)) + masses * values.gravity
    left = masses * (v - case.velocities) - H * outer
    arms = x - (masses * x).sum(axis=0) / masses.sum()
    # a velocity is the difference of two positions over h
    size = float((masses * (np.abs(v) + np.abs(case.velocities) + np.abs(x) / H)).sum() + H * np.abs(outer).sum())
    return left.sum(axis=0), np.cross(arms, left).sum(axis=0), size


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("solver", SOLVERS, ids=repr)
def test_few_iterations_turn_a_stiff_body(solver: object, count: int, dtype: torch.dtype, device: torch.device) -> None:
    """By the torque of a couple, of a bar that spins at 10 / s besides: iterations alone pass on a tenth of it."""
    forces = np.zeros((28, 3))
    forces[0, 2], forces[-1, 1] = 30.0, -20.0
    case = rod(1e7, pd.Gravity(), forces=forces, spin=10.0)
    linear, angular, size = gains(case, *stepped(case, dtype, device, solver, count))
    assert np.abs(linear).max() <= 8 * ULP[dtype] * size
    assert np.abs(angular).max() <= 8 * ULP[dtype] * size
    torque = np.cross(case.positions - case.positions.mean(axis=0), forces).sum(axis=0)
    assert H * np.abs(torque).max() > 1e4 * ULP[dtype] * size  # else nothing is shown


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("solver", SOLVERS, ids=repr)
def test_smooth_ground_takes_nothing_along_itself(
    solver: object, count: int, dtype: torch.dtype, device: torch.device
) -> None:
    """Forces along tilted ground, and their torque about its normal."""
    forces = np.zeros((28, 3))
    forces[0, 2], forces[-1, 0] = 30.0, -20.0
    ground = pd.Ground(0.0, normal=(0.2, 1.0, 0.0))
    case = rod(1e7, pd.Gravity((1.96, -9.8, 0.0)), ground, forces=forces)
    lift = np.array([[1.0, -0.2, 0.0], [0.2, 1.0, 0.0], [0.0, 0.0, np.sqrt(1.04)]]).T / np.sqrt(1.04)
    values = case.scene.values()
    # the bar lies on the ground
    case = Case(case.scene, values.rest_positions @ lift, case.velocities, H, extras=case.extras)
    x, v = stepped(case, dtype, device, solver, count)
    normal = np.array([0.2, 1.0, 0.0]) / np.sqrt(1.04)
    assert (x @ normal).min() >= -8 * ULP[dtype]
    linear, angular, size = gains(case, x, v)
    assert np.abs(linear - normal * (linear @ normal)).max() <= 16 * ULP[dtype] * size
    # passes end with one of at most 1e-6 of the size; it leaves what Newton's matrix lacks, by |u| / size: how contacts
    # follow finite turns
    momentum = float((values.masses[:, None] * np.abs(v)).sum())
    assert abs(angular @ normal) <= max(1e-6 * momentum * 0.6, 16 * ULP[dtype] * size)
    assert linear @ normal > 0.1 * H * 9.8 * values.masses.sum()


@pytest.mark.parametrize(
    ("solver", "count"),
    # friction may lead Multilevel astray
    [*itertools.product([pd.Jacobi(), pd.Chebyshev()], [3, 10, 64])],
    ids=str,
)
@pytest.mark.parametrize("youngs", [1e5, 1e7])
def test_a_plate_slides_as_coulomb_says(
    youngs: float, solver: object, count: int, dtype: torch.dtype, device: torch.device
) -> None:
    """Pushed, and when the push ends, until friction stops it: iterations alone leave a tenth of the acceleration."""
    mesh = pd.shapes.box((0.4, 0.05, 0.4), (8, 1, 8))
    scene = pd.Scene(pd.Solid(mesh, youngs, 1000.0), pd.Gravity(), pd.Ground(0.0, friction=0.3))
    sim = pd.Simulator(scene, H, count, solver, dtype=dtype).to(device)  # type: ignore[arg-type]
    state, push = sim.rest_state(), torch.zeros_like(sim.rest_state().positions)
    push[..., 0] = 6.0 * sim.masses.detach()
    speed = 0.0
    for step in range(40):
        state = sim(state, push if step < 10 else None)
        speed = max(speed + H * ((6.0 if step < 10 else 0.0) - 0.3 * 9.81), 0.0)
        mean = float((sim.masses * state.velocities[0, :, 0]).sum() / sim.masses.sum())
        # of a soft plate vertices set down, and stop, one after another
        assert abs(mean - speed) <= 0.05 * (speed + 0.1), step
    assert speed == 0.0


@pytest.mark.parametrize("count", [3, 64])
def test_friction_holds_what_it_can_hold(count: int, dtype: torch.dtype, device: torch.device) -> None:
    mesh = pd.shapes.box((0.4, 0.05, 0.4), (8, 1, 8))
    scene = pd.Scene(pd.Solid(mesh, 1e6, 1000.0), pd.Gravity((2.5, -9.8, 0.0)), pd.Ground(0.0, friction=0.3))
    sim = pd.Simulator(scene, H, count, dtype=dtype).to(device)
    track = sim.rollout(sim.rest_state(), 60)
    assert float((track.positions[-1] - sim.rest_positions).abs().max()) <= 2e-4


def test_the_way_along_an_edge_is_exact(dtype: torch.dtype, device: torch.device) -> None:
    """Between ground and a wall askew, pushed into both and along their edge, x = y = 0."""
    wall = pd.Ground(0.0, normal=(1.0, 0.3, 0.0))
    case = contact_block(pd.Ground(0.0), wall, gravity=(-5.0, -9.8, 2.0), youngs=1e7)
    after, v = stepped(case, dtype, device, pd.Chebyshev(), 3)
    linear, _, size = gains(case, after, v)
    assert abs(linear[2]) <= 8 * ULP[dtype] * size


def test_what_a_motion_would_lead_into_stops_it(device: torch.device) -> None:
    """A block that slides into a wall within the step is left to the iterations, and stays on this side."""
    case = contact_block(
        pd.Ground(0.0), pd.Ground(-0.301, normal=(-1.0, 0.0, 0.0)), velocity=(2.0, 0.0, 0.0), youngs=1e6
    )
    x, v = stepped(case, torch.float64, device, pd.Chebyshev(), 20)
    assert x[:, 0].max() <= 0.301 + 1e-12
    assert v[:, 0].mean() < 1.5


@pytest.mark.parametrize("held", [[0], [0, 1], [0, 1, 2, 3]], ids=["point", "edge", "springs"])
@pytest.mark.parametrize("solver", SOLVERS, ids=repr)
def test_few_iterations_swing_a_stiff_bar(
    held: list[int], solver: object, dtype: torch.dtype, device: torch.device
) -> None:
    """Angular momentum about what holds it gains gravity's torque: iterations alone pass on a fiftieth of it."""
    vertices, tets = box((0.6, 0.1, 0.1), (6, 1, 1))
    body = pd.Solid(pd.TetMesh(vertices, tets), 1e7)
    pin = pd.Pin(body, held) if len(held) < 3 else pd.Pin(body, held, stiffness=50.0)
    scene = pd.Scene(body, pin, pd.Gravity())
    case = Case(scene, vertices, 0.0 * vertices, H)
    x, v = stepped(case, dtype, device, solver, 3)
    masses = scene.values().masses[:, None]
    left = masses * (v - H * scene.values().gravity)
    if len(held) == 4:  # springs act at the end of the step
        left[held] += H * 50.0 * (x - vertices)[held]
        size = np.abs(masses * v).sum() + np.abs(masses * x).sum() / H
        assert np.abs(left.sum(axis=0)).max() <= 16 * ULP[dtype] * size
        arms = x
    else:
        arms = x - vertices[held].mean(axis=0)
        size = np.abs(masses * v).sum() + np.abs(masses * x).sum() / H
    torque = np.cross(arms, left)[[i for i in range(28) if i not in held or len(held) == 4]].sum(axis=0)
    along = np.array([0.0, 0.0, 1.0]) if len(held) == 2 else np.ones(3)
    assert np.abs(torque * along).max() <= 16 * ULP[dtype] * size
    assert abs(v[-1, 1]) > 0.1  # the free end falls


def test_energy_falls_along_rigid_motions() -> None:
    """Of a body that starts askew of its targets, in the reference: by what no translation alone can take."""
    case = rod(1e6, pd.Gravity(), spin=30.0)
    rng = np.random.default_rng(0)
    problem = case.problem()
    u = problem.target + 0.05 * rng.standard_normal(problem.target.shape) + 0.1 * case.positions[:, [1, 2, 0]]
    aligned = problem.align(u)
    assert problem.energy(aligned) < problem.energy(u)
    # a minimum: neither a shift nor a turn lowers it further
    gradient = problem.gradient(aligned)
    arms = case.positions + aligned
    scale = np.abs(gradient).sum()
    assert np.abs(gradient.sum(axis=0)).max() <= 1e-12 * scale
    assert np.abs(np.cross(arms, gradient).sum(axis=0)).max() <= 1e-12 * scale


def pressed_corner() -> Case:
    """A plate that yaws about the corner where it is pressed down: its friction acts there, and its slips differ."""
    vertices, tets = box((0.4, 0.05, 0.4), (4, 1, 4))
    scene = pd.Scene(pd.Solid(pd.TetMesh(vertices, tets), 1e5), pd.Gravity(), pd.Ground(0.0, friction=0.5))
    forces = np.zeros_like(vertices)
    forces[np.abs(vertices - [0.0, 0.05, 0.0]).sum(axis=1).argmin(), 1] = -20.0
    return Case(scene, vertices, np.cross([0.0, 1.0, 0.0], vertices), H, extras={"forces": forces})


def spinning_plate(spin: float, speed: float) -> Case:
    vertices, tets = box((0.4, 0.05, 0.4), (4, 1, 4))
    scene = pd.Scene(pd.Solid(pd.TetMesh(vertices, tets), 1e5), pd.Gravity(), pd.Ground(0.0, friction=0.3))
    turning = np.cross([0.0, spin, 0.0], vertices - vertices.mean(axis=0))
    return Case(scene, vertices, turning + [speed, 0.0, 0.0], H)


def gripped(gravity: float = 0.0) -> Case:
    """A cube between two rough balls that squeeze it, and lift it in this step."""
    vertices, tets = box((0.1, 0.1, 0.1), (2, 2, 2))
    vertices = vertices - 0.05
    balls = [pd.Sphere((side * 0.149, 0.0, 0.0), 0.1, friction=1.0) for side in (-1.0, 1.0)]
    scene = pd.Scene(pd.Solid(pd.TetMesh(vertices, tets), 1e5), pd.Gravity((0.0, gravity, 0.0)), *balls)
    starts = np.array([ball.center for ball in balls])
    lifted = {"sphere_centers": starts + [0.0, 0.002, 0.0], "sphere_starts": starts}
    return Case(scene, vertices, 0.0 * vertices, H, extras=lifted)


@pytest.mark.parametrize(
    "case",
    [
        spinning_plate(0.0, 0.5), spinning_plate(5.0, 0.04), spinning_plate(1.0, 0.04), spinning_plate(5.0, 0.5),
        spinning_plate(0.0, 0.01), pressed_corner(), slope(0.3, 0.6), slope(0.5, 0.3), slope(0.5, 0.0),
        contact_block(pd.Ground(0.0, friction=0.4), velocity=(1.0, -1.0, 0.0)),
        contact_block(pd.Ground(0.0), pd.Ground(0.0, normal=(1.0, 0.0, 0.0)), velocity=(-1.0, -1.0, 0.5)),
        rod(1e5, pd.Gravity(), spin=20.0), gripped(), gripped(-9.8),
    ],
    ids=[
        "slides", "spins and stops", "spins slowly", "spins and slides", "sticks", "pressed at a corner", "holds",
        "slides down", "smooth", "lands", "edge", "flies", "gripped", "gripped, heavy",
    ],
)  # fmt: skip
def test_nothing_moves_once_iterations_have_converged(case: Case) -> None:
    """Solved without rigid motions a step is where rigid motions leave it; then errors of a sum show."""
    problem, x, v = case.problem(), case.positions, case.velocities
    for _ in range(3):
        problem = step_problem(case.scene.values(), x, v, H, **case.extras)
        still = Still(**{name.name: getattr(problem, name.name) for name in fields(problem)})
        solved = guarded_chebyshev(still, still.unsolved(), iterations=300).displacement
        assert np.linalg.norm(problem.residual(solved)) <= 1e-9 * np.linalg.norm(problem.residual(problem.unsolved()))
        assert np.abs(problem.align(solved) - solved).max() <= 1e-10
        x, v = x + solved, solved / H


def after_steps(case: Case, offset: float, steps: int, **options: Any) -> Array:
    """Velocities."""
    vertices, tets = case.positions + offset, case.scene.values().tets
    body = pd.Solid(pd.TetMesh(vertices, tets), 1e6)
    pin = [pd.Pin(body, [0], stiffness=options["spring"])] if options else []
    sim = pd.Simulator(pd.Scene(body, pd.Gravity(), *pin), H, 32, dtype=torch.float64, progress=False)
    track = sim.rollout(pd.State(torch.tensor(vertices)[None], torch.tensor(case.velocities)[None]), steps)
    return np.asarray(track.velocities[-1, 0])


@pytest.mark.parametrize("offset", [1e2, 1e4, 1e6])
def test_far_from_the_origin_it_is_the_same(offset: float) -> None:
    """To the rounding of positions there: sums about the origin lose all digits of a body of 10 cm at 1e6 m."""
    case = rod(1e6, spin=5.0)
    near, far = after_steps(case, 0.0, 5), after_steps(case, offset, 5)
    assert np.abs(far - near).max() <= 2e3 * ULP[torch.float64] * offset / H


@pytest.mark.parametrize("spring", [1e6, 1e9, 1e12])
def test_a_spring_that_outweighs_all_is_a_pivot(spring: float) -> None:
    """Its share of sums about the origin would drown those of the body."""
    case = rod(1e6)
    near, far = after_steps(case, 0.0, 5, spring=spring), after_steps(case, 10.0, 5, spring=spring)
    assert np.abs(far - near).max() <= 1e-4 * np.abs(near).max()


@pytest.mark.parametrize(
    "beside", [(), (pd.Ground(-10.0, normal=(1.0, 0.0, 0.0)),), (pd.Sphere((0.0, -20.0, 0.0), 0.5),)]
)
def test_what_lifts_off_rough_ground_does_not_know_of_contacts_far_away(
    beside: tuple[pd.Part, ...], dtype: torch.dtype, device: torch.device
) -> None:
    """From where it is, with so few iterations that rigid motions do all."""
    case = contact_block(pd.Ground(0.0, friction=0.5), *beside, velocity=(3.0, 1.3, 0.0), youngs=1e7)
    sim = simulator(case, dtype, device, iterations=3)
    state = state_of(case, sim)
    after = sim(state, start=state.positions)
    mean = after.velocities[0].double().mean(dim=0).cpu()
    assert float((mean - torch.tensor([3.0, 1.3 - 9.8 * H, 0.0])).abs().max()) <= 1e-3
