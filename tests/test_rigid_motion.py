"""However few the iterations: momentum, linear and angular, of what no pin holds, and Coulomb's law of what slides."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from cases import Case, box, contact_block
from numpy.typing import NDArray
from runs import arguments_of, simulator, state_of

import torchpd as pd

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
    assert abs(angular @ normal) <= 16 * ULP[dtype] * size
    assert linear @ normal > 0.1 * H * 9.8 * values.masses.sum()


@pytest.mark.parametrize(
    ("solver", "count"),
    [*itertools.product([pd.Jacobi(), pd.Chebyshev()], [3, 10, 64]), (pd.Multilevel(), 64)],
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
        # bending sets some vertices down before others, at first
        assert abs(mean - speed) <= 0.05 * (speed + 0.05), step
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
