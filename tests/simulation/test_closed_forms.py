"""Motions and energies that can be written down: no reference, no other program."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from cases import Array, Case, box, contact_block, slope
from runs import ULP, arguments_of, displacement, simulator, state_of, tensor_of
from scipy.spatial.transform import Rotation

import torchpd as pd

pytestmark = pytest.mark.usefixtures("poisoned")

TET = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
ITERATIONS = (0, 1, 2, 7, 64)


def one_tet(*parts: Any, youngs: float = 1e4, density: float = 600.0) -> Case:
    """The corner tetrahedron: V = 1/6 m^3, 25 kg a vertex."""
    body = pd.Solid(pd.TetMesh(TET, [[0, 1, 2, 3]]), youngs=youngs, density=density)
    return Case(pd.Scene(body, *parts), TET, 0.0 * TET, 0.1)


def free_case(*parts: Any, velocity: tuple[float, float, float] = (1.0, 2.0, 3.0)) -> Case:
    return contact_block(*parts, height=5.0, velocity=velocity)


@pytest.mark.parametrize("batch", [1, 9])
@pytest.mark.parametrize("start", ["velocity", "inertial"])
def test_free_fall_is_exact_after_any_number_of_iterations(
    batch: int, start: str, dtype: torch.dtype, device: torch.device
) -> None:
    case = free_case()
    sim = simulator(case, dtype, device)
    v = np.array([1.0, 2.0, 3.0]) + case.time_step * np.array([0.0, -9.8, 0.0])
    for sim.iterations in ITERATIONS:
        after = sim(state_of(case, sim, batch), start=start)
        # edges are a few ulp of 5 m wrong, which elasticity answers by moves of that size: in v they are divided by h
        limit = 16 * ULP[dtype] * 5.0 / case.time_step
        np.testing.assert_allclose(after.velocities[-1].double().cpu(), np.tile(v, (64, 1)), atol=limit, rtol=0)
        np.testing.assert_allclose(
            after.positions[-1].double().cpu(), case.positions + case.time_step * v, atol=16 * ULP[dtype] * 5.0, rtol=0
        )


def test_free_flight_over_many_steps(dtype: torch.dtype, device: torch.device) -> None:
    """v_n = v_0 + n h g and x_n = x_0 + n h v_0 + n (n + 1) / 2 h^2 g: implicit Euler's own parabola."""
    case = free_case()
    sim = simulator(case, dtype, device, iterations=3)
    track = sim.rollout(state_of(case, sim), 30)
    h, g, n = case.time_step, np.array([0.0, -9.8, 0.0]), np.arange(1, 31)[:, None, None]
    x = case.positions + n * h * np.array([1.0, 2.0, 3.0]) + n * (n + 1) / 2 * h**2 * g
    # thirty steps, each with the few ulp of 5 m of the test above
    np.testing.assert_allclose(track.positions[:, 0].double().cpu(), x, atol=30 * 16 * ULP[dtype] * 5.0, rtol=0)


@pytest.mark.parametrize("shift", [0.0, 100.0])
def test_translated_body_feels_nothing(shift: float, dtype: torch.dtype, device: torch.device) -> None:
    case = one_tet()
    sim = simulator(case, dtype, device, iterations=5)
    after = sim(pd.State(tensor_of(TET + shift, sim, 1), tensor_of(0.0 * TET, sim, 1)))
    # edges of a tetrahedron at 100 m are rounded by an ulp of 100 m
    np.testing.assert_allclose(after.positions[0].double().cpu(), TET + shift, atol=8 * ULP[dtype] * (1.0 + shift))


def test_rotated_body_feels_nothing(dtype: torch.dtype, device: torch.device) -> None:
    case = contact_block(gravity=(0.0, 0.0, 0.0))
    sim = simulator(case, dtype, device, iterations=20)
    for seed in range(4):
        turned = case.positions @ Rotation.random(random_state=seed).as_matrix()
        after = sim(pd.State(tensor_of(turned, sim, 1), tensor_of(0.0 * turned, sim, 1)))
        # edges of 0.1 m between coordinates of 0.5 m: a strain of 10 ulp, some 20 times that over the four cells
        np.testing.assert_allclose(after.positions[0].double().cpu(), turned, atol=20 * 10 * ULP[dtype] * 0.5, rtol=0)
        # half w V |strain|^2 with V = 0.027 m^3
        assert 0.0 <= float(sim.energy(after.positions)) <= 0.5 * 1e5 * 0.027 * (20 * 10 * ULP[dtype]) ** 2


STRETCHES = {  # F, |F - R|^2
    "stretched": (np.diag([1.3, 1.0, 1.0]), 0.09),
    "squeezed": (np.diag([1.0, 0.6, 0.7]), 0.16 + 0.09),
    "flat": (np.diag([1.0, 1.0, 0.0]), 1.0),
    "collapsed": (np.zeros((3, 3)), 3.0),
    "mirrored": (np.diag([-1.0, 1.0, 1.0]), 4.0),  # singular values 1, 1, -1: (1 - -1)^2
    "mirrored and short": (np.diag([1.0, 1.0, -0.2]), 1.44),
    # |F|^2 + 3 - 2 tr S, where the stretch S of a shear by s has the trace 1 + 2 sqrt(1 + s^2 / 4)
    "sheared": (np.array([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]), 3.25 + 3.0 - 2.0 * (1.0 + 2.0 * math.sqrt(1.0625))),
}


@pytest.mark.parametrize("name", STRETCHES)
def test_energy_of_one_tetrahedron(name: str, dtype: torch.dtype, device: torch.device) -> None:
    """w V / 2 |F - R|^2, whatever rigid motion is added."""
    deformation, strain = STRETCHES[name]
    case = one_tet()
    sim = simulator(case, dtype, device)
    turn = Rotation.random(random_state=1).as_matrix()
    placed = torch.stack([tensor_of(TET @ (q @ deformation).T + t, sim) for q, t in ((np.eye(3), 0.0), (turn, 1.0))])
    expected = 1e4 / 6.0 / 2.0 * strain
    # E = w V / 2 |D|^2 with D wrong by a few ulp of |F| = 2
    limit = 1e4 / 6.0 * (math.sqrt(strain) + 1e-3) * 30 * ULP[dtype]
    np.testing.assert_allclose(sim.energy(placed).double().cpu(), [expected, expected], atol=limit, rtol=0)


def test_force_of_one_stretched_tetrahedron(dtype: torch.dtype, device: torch.device) -> None:
    """Stretched by 1.3 along x: vertex 1 pulls with w V 0.3 dN/dx = 1e4 / 6 * 0.3, vertex 0 against it."""
    sim = simulator(one_tet(), dtype, device)
    gradient = sim.gradient(tensor_of(TET * [1.3, 1.0, 1.0], sim, 1))[0].double().cpu()
    pull = 1e4 / 6.0 * 0.3
    expected = np.array([[-pull, 0, 0], [pull, 0, 0], [0, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(gradient, expected, atol=1e4 / 6.0 * 10 * ULP[dtype], rtol=0)


def test_one_breathing_tetrahedron(dtype: torch.dtype, device: torch.device) -> None:
    """A uniform scaling s of the regular tetrahedron stays one: m r^2 (s' - s0 - h s0') / h^2 + w V 3 (s' - 1) = 0.

    With vertices at distance r, sum m r^2 = 4 m r^2 is the inertia of s, and |F - R|^2 = 3 (s - 1)^2.
    """
    vertices = np.array([[1.0, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]])
    body = pd.Solid(pd.TetMesh(vertices, [[0, 1, 2, 3]]), youngs=1e4, density=600.0)
    scale, rate, h = 0.8, -2.0, 0.05
    case = Case(pd.Scene(body), scale * vertices, rate * vertices, h)
    sim = simulator(case, dtype, device, iterations=400)
    after = sim(state_of(case, sim))
    volume = 8.0 / 3.0
    inertia, spring = 600.0 * volume * 3.0 / h**2, 3.0 * 1e4 * volume
    expected = (inertia * (scale + h * rate) + spring) / (inertia + spring)
    np.testing.assert_allclose(after.positions[0].double().cpu(), expected * vertices, atol=50 * ULP[dtype], rtol=0)


@pytest.mark.parametrize("rate", [0.5, 6.0, 600.0])
def test_damping_divides_a_free_motion(rate: float, dtype: torch.dtype, device: torch.device) -> None:
    """v_n = v_0 / (1 + rate h)^n, rigid, at any number of iterations."""
    case = contact_block(pd.Damping(rate), gravity=(0.0, 0.0, 0.0), velocity=(1.0, -2.0, 0.5))
    sim = simulator(case, dtype, device, iterations=2)
    track = sim.rollout(state_of(case, sim), 10)
    n = np.arange(1, 11)[:, None, None]
    expected = np.array([1.0, -2.0, 0.5]) / (1.0 + rate * case.time_step) ** n
    # as in free fall, coordinates of half a metre
    limit = 10 * 16 * ULP[dtype] * 0.5 / case.time_step
    np.testing.assert_allclose(track.velocities[:, 0].double().cpu(), np.tile(expected, (1, 64, 1)), atol=limit, rtol=0)


def test_terminal_velocity(dtype: torch.dtype, device: torch.device) -> None:
    """Under gravity and drag v tends to g / rate."""
    case = contact_block(pd.Damping(50.0))
    sim = simulator(case, dtype, device, iterations=2)
    track = sim.rollout(state_of(case, sim), 80, every=80)
    # (1 + 50 / 60)^-80 is 1e-21; the body is then 0.3 m deep, positions round by an ulp of that
    limit = 16 * ULP[dtype] * 0.5 / case.time_step
    np.testing.assert_allclose(track.velocities[0, 0, :, 1].double().cpu(), -9.8 / 50.0, atol=limit, rtol=0)


@pytest.mark.parametrize("iterations", [1, 3, 10])
def test_momentum_of_free_bodies(iterations: int, dtype: torch.dtype, device: torch.device) -> None:
    """Two deformed bodies, forces on them: P' = P + h (M g + F) each, however few the iterations."""
    vertices, tets = box((0.3, 0.3, 0.3), (3, 3, 3))
    soft, hard = (pd.Solid(pd.TetMesh(vertices + [x, 0.0, 0.0], tets), e) for x, e in ((0.0, 1e3), (1.0, 1e6)))
    scene = pd.Scene(soft, hard, pd.Gravity((0.0, -9.8, 0.0)))
    values, rng = scene.values(), np.random.default_rng(0)
    x = values.rest_positions + 0.02 * rng.standard_normal((128, 3))
    v, forces = rng.standard_normal((2, 128, 3))
    case = Case(scene, x, v, 1 / 60, extras={"forces": forces})
    sim = simulator(case, dtype, device, iterations=iterations)
    after = sim(state_of(case, sim), **arguments_of(case, sim)).velocities[0].double().cpu().numpy()
    for body in (slice(0, 64), slice(64, 128)):
        masses = values.masses[body, None]
        expected = (masses * v[body]).sum(0) + (masses.sum() * np.array([0.0, -9.8, 0.0]) + forces[body].sum(0)) / 60
        # each vertex contributes m v, rounded twice; v is up to 10 m/s after a stretch of the hard body
        limit = 4 * ULP[dtype] * float((masses * np.abs(after[body])).sum()) + 4 * ULP[dtype] * np.abs(expected).max()
        np.testing.assert_allclose((masses * after[body]).sum(0), expected, atol=limit, rtol=0)


def test_pins_hold_and_move_as_told(dtype: torch.dtype, device: torch.device) -> None:
    vertices, tets = box((0.3, 0.3, 0.3), (3, 3, 3))
    body = pd.Solid(pd.TetMesh(vertices, tets), 1e5)
    pin = pd.Pin(body, vertices[:, 0] == 0.0)
    case = Case(pd.Scene(body, pin, pd.Gravity()), vertices, 0.0 * vertices, 1 / 60)
    sim = simulator(case, dtype, device, iterations=4)
    who = pin.vertices.tolist()
    held = vertices[who]
    after = sim(state_of(case, sim))
    assert torch.equal(after.positions[0, who], tensor_of(held, sim))
    assert not after.velocities[0, who].any()
    moved = tensor_of(held + [0.01, 0.0, 0.02], sim, 1)
    after = sim(after, targets={pin: moved})
    # x + (target - x): one ulp
    np.testing.assert_allclose(after.positions[:, who].cpu(), moved.cpu(), atol=2 * ULP[dtype], rtol=0)
    velocity = after.velocities[0, who].double().cpu()
    np.testing.assert_allclose(velocity, np.tile([0.6, 0.0, 1.2], (16, 1)), atol=60 * 2 * ULP[dtype], rtol=1e-6)


def test_soft_pins_sag_by_weight_over_stiffness(dtype: torch.dtype, device: torch.device) -> None:
    """A stiff body on springs, h so large that inertia is nothing: each of the four vertices sags by m g / k."""
    stiffness = 1e3
    case = one_tet(pd.Gravity((0.0, -9.8, 0.0)), youngs=1.0)
    case = Case(pd.Scene(*case.scene.parts, pd.Pin(case.scene.solids[0], [0, 1, 2, 3], stiffness)), TET, 0 * TET, 1e3)
    sim = simulator(case, dtype, device, iterations=300)
    u = displacement(sim, sim(state_of(case, sim), start="inertial"))
    # all vertices weigh the same, so it moves as a whole; inertia m / h^2 is 2.5e-8 of k
    np.testing.assert_allclose(u, np.tile([0.0, -25.0 * 9.8 / stiffness, 0.0], (4, 1)), atol=1e-7 + 8 * ULP[dtype])


def test_block_on_the_ground_stays(dtype: torch.dtype, device: torch.device) -> None:
    """Pressed by its weight, a column of height L and modulus E at Poisson ratio 0 shortens by rho g L^2 / (2 E)."""
    case = contact_block(pd.Ground(0.0, friction=1.0), pd.Damping(20.0))
    sim = simulator(case, dtype, device, iterations=40)
    end = sim.rollout(state_of(case, sim), 120, every=120).state()
    heights = end.positions[0, :, 1].double().cpu().numpy()
    bottom, top = case.positions[:, 1] == 0.0, np.isclose(case.positions[:, 1], 0.3)
    assert heights.min() >= -ULP[dtype]
    assert heights[bottom].max() <= 2 * ULP[dtype]
    # with lumped masses the discrete column shortens by just as much; Kuhn cells are not symmetric, which costs 2 %,
    # and the strain of 3 % at the foot enters in second order
    shorter = 0.3 - heights[top].mean()
    assert shorter == pytest.approx(1000.0 * 9.8 * 0.3**2 / (2 * 1e5), rel=0.03)
    assert float(end.velocities.abs().max()) <= 1e-3


@pytest.mark.parametrize("share", [0.8, 0.95, 1.05, 1.3])
def test_slope_at_its_critical_angle(share: float, dtype: torch.dtype, device: torch.device) -> None:
    """Below atan(friction) it stays where it is; above, it accelerates by g (sin - friction cos). 0.5 s to settle."""
    friction = 0.4
    angle = share * math.atan(friction)
    case = slope(angle, friction)
    sim = simulator(case, dtype, device, iterations=60)
    track = sim.rollout(state_of(case, sim), 42)
    masses = case.scene.values().masses
    velocity = np.einsum("v,tv->t", masses, track.velocities[:, 0, :, 0].double().cpu().numpy()) / masses.sum()
    if share < 1.0:
        # it still rocks on its elasticity by 2 % of its sag, rho g L^2 / E = 9 mm; at 1.05 it slides 33 mm
        assert float((track.positions[41] - track.positions[29]).abs().max()) <= 2e-4
        assert abs(velocity[41]) <= 0.01
    else:
        closed = 9.8 * (math.sin(angle) - friction * math.cos(angle))
        assert (velocity[41] - velocity[29]) / (12 * case.time_step) == pytest.approx(closed, rel=0.02)


def cloud(*parts: Any) -> Case:
    """Four vertices so softly tied that each moves as a point."""
    return Case(one_tet(*parts, youngs=1e-9).scene, TET, 0.0 * TET, 0.1)


def points_after(case: Case, positions: Array, velocities: Array, dtype: torch.dtype, device: torch.device) -> Array:
    sim = simulator(case, dtype, device, iterations=50)
    after = sim(pd.State(tensor_of(positions, sim, 1), tensor_of(velocities, sim, 1)))
    x: Array = after.positions[0].double().cpu().numpy()
    return x


def test_points_meet_a_tilted_plane(dtype: torch.dtype, device: torch.device) -> None:
    """A point that would end d inside is put back along the normal, and Coulomb takes friction d of its slip."""
    normal = np.array([0.6, 0.8, 0.0])
    along = np.array([0.8, -0.6, 0.0])
    case = cloud(pd.Ground(0.0, normal=(3.0, 4.0, 0.0), friction=0.5))
    start = TET @ np.stack([along, [0, 0, 1], normal]) + 0.05 * normal  # heights 0.05, 0.05, 0.05, 1.05
    speed = np.array([[-1.0, 2.0], [-1.0, 0.1], [-0.4, 1.0], [-1.0, 1.0]])  # along the normal, along the slope
    velocity = speed[:, :1] * normal + speed[:, 1:] * along
    x = points_after(case, start, velocity, dtype, device)
    depth = np.maximum(-(start @ normal + 0.1 * speed[:, 0]), 0.0)
    assert depth == pytest.approx([0.05, 0.05, 0.0, 0.0], abs=1e-12)
    slip = 0.1 * speed[:, 1]
    slip = np.maximum(slip - 0.5 * depth, 0.0)  # the second point sticks: 0.01 < 0.025
    expected = start + (0.1 * speed[:, :1] + depth[:, None]) * normal + slip[:, None] * along
    # elasticity of 1e-9 Pa against 2.5e3 N/m of inertia: 1e-12
    np.testing.assert_allclose(x, expected, atol=1e-9 + 20 * ULP[dtype], rtol=0)


def test_points_meet_a_ball(dtype: torch.dtype, device: torch.device) -> None:
    """A point falling straight at the centre stops on the surface; one at the centre leaves upwards; others fly on."""
    ball = pd.Sphere((0.0, 0.0, 0.0), 0.5)
    start = np.array([[0.0, 0.6, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.7], [2.0, 2.0, 2.0]])
    velocity = np.array([[0.0, -5.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -5.0], [1.0, 0.0, 0.0]])
    x = points_after(cloud(ball), start, velocity, dtype, device)
    expected = np.array([[0.0, 0.5, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.5], [2.1, 2.0, 2.0]])
    np.testing.assert_allclose(x, expected, atol=1e-9 + 20 * ULP[dtype], rtol=0)


def test_sticking_point_follows_a_moving_ball(dtype: torch.dtype, device: torch.device) -> None:
    """High friction, pressed by gravity: the point moves sideways with the ball."""
    ball = pd.Sphere((0.0, -1.0, 0.0), 1.0, friction=50.0)
    case = cloud(ball, pd.Gravity((0.0, -9.8, 0.0)))
    sim = simulator(case, dtype, device, iterations=50)
    start = np.array([[0.0, 0.0, 0.0], [5.0, 9, 0], [0, 9, 5], [5, 9, 5]])
    target = tensor_of(np.array([0.01, -1.0, 0.0, 0.1, 0.0, 0.0]), sim, 1)  # centre, and its velocity
    after = sim(pd.State(tensor_of(start, sim, 1), tensor_of(0 * start, sim, 1)), targets={ball: target})
    # the tangent plane is that at x = 0 seen from the new centre: a slope of 0.01, along which it keeps its place
    x = after.positions[0, 0].double().cpu().numpy()
    assert np.linalg.norm(x - [0.01, -1.0, 0.0]) == pytest.approx(1.0, abs=2e-4)
    assert x[0] == pytest.approx(0.01, abs=3e-4)


@pytest.mark.parametrize("iterations", [3, 64])
@pytest.mark.parametrize("solver", [pd.Chebyshev(), pd.Multilevel()], ids=["Chebyshev", "Multilevel"])
@pytest.mark.parametrize("wall", [0.0, 0.4])
@pytest.mark.parametrize("lean", [0.0, 0.5])
def test_along_a_wall_it_is_coulombs_law_whatever_the_iterations(
    lean: float, wall: float, solver: pd.Solver, iterations: int, dtype: torch.dtype, device: torch.device
) -> None:
    """A stiff cube between a rough floor and a wall that leans: each stops it by friction times how much it bears."""
    vertices, tets = box((0.1, 0.1, 0.1), (3, 3, 3))
    floor, side = pd.Ground(0.0, friction=0.3), np.array([0.0, lean, 1.0]) / np.hypot(lean, 1.0)
    shear = vertices.copy()
    shear[:, 2] -= lean * shear[:, 1]  # its side lies on the wall
    scene = pd.Scene(
        pd.Solid(pd.TetMesh(shear, tets), 1e7),
        pd.Gravity((0.0, -9.8, -4.0)),
        floor,
        pd.Ground(0.0, normal=tuple(side), friction=wall),
    )
    sim = pd.Simulator(scene, 1 / 60, iterations, solver=solver, dtype=dtype, progress=False).to(device)
    state = sim.rest_state()
    state.velocities[..., 0] = 2.0
    bears = np.linalg.solve(np.stack([[0.0, 1.0, 0.0], side]).T[1:], [9.8, 4.0])
    slows = float(bears @ [0.3, wall])
    track = sim.rollout(state, 10)
    expected = 2.0 - slows / 60 * torch.arange(1, 11)
    assert float((track.velocities[:, 0, :, 0].mean(dim=1).double().cpu() - expected).abs().max()) <= 2e-2


@pytest.mark.parametrize("length", [1.0, 1.00009, 0.99991])
@pytest.mark.parametrize("angle", [2e-4, 3e-4, 0.015, 0.0192, 0.025])
def test_in_a_flat_groove_it_is_coulombs_law(
    angle: float, length: float, dtype: torch.dtype, device: torch.device
) -> None:
    """Between two planes that are nearly one, whose normals are 1 to rounding and no more: each bears half."""
    vertices, tets = box((0.1, 0.1, 0.1), (3, 3, 3))
    vertices = vertices - [0.05, 0.0, 0.05]
    planes = [
        pd.Ground(0.0, normal=(side * np.sin(angle / 2), np.cos(angle / 2), 0.0), friction=0.3) for side in (-1.0, 1.0)
    ]
    sim = pd.Simulator(pd.Scene(pd.Solid(pd.TetMesh(vertices, tets), 1e8), pd.Gravity(), *planes), 1 / 60, 3,
                       dtype=dtype, progress=False).to(device)  # fmt: skip
    scaled = sim.planes.detach().clone()
    scaled[:, :3] *= length
    sim.set_material(planes=scaled)
    state = sim.rest_state()
    state.velocities[..., 2] = 1.0
    found = sim.rollout(state, 4).velocities[:, 0, :, 2].mean(dim=1).double().cpu()
    expected = 1.0 - 0.3 * 9.81 / 60 / np.cos(angle / 2) * torch.arange(1, 5)
    # a body that cannot lie in both at once jolts where it starts
    assert float((found - expected).abs().max()) <= 0.02
