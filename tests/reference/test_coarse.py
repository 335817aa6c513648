"""Coarse correction: rigid motions and contacts are right after few iterations, and converged steps stay."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from cases import leaning
from numpy.typing import NDArray
from programs import ROOT

import torchpd as pd
from torchpd.reference import StepProblem, nearest_rotation, step_problem
from torchpd.reference.coarse import RigidMotions, correct
from torchpd.reference.coarse_step import coarse_chebyshev
from torchpd.reference.envelopes import contacts_at, pushes_of
from torchpd.reference.piece_step import piece_motions
from torchpd.reference.pieces import PieceSpace, cut
from torchpd.reference.rigid import corrected

Array = NDArray[np.float64]
H = 1.0 / 60.0


@pytest.fixture
def scenes(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import coarse_scenes

    return coarse_scenes


@pytest.mark.parametrize("youngs", [1e5, 1e6, 1e7])
def test_a_spinning_cube_flies_as_the_converged_one(scenes: ModuleType, youngs: float) -> None:
    """9.8 rad/s: the momentum is exact, the spin lacks what centrifugal stretch changes of the inertia."""
    course = scenes.scenes(youngs, 2)["flies"]
    masses = course.scene.values().masses
    run = course.run(lambda problem: coarse_chebyshev(problem, iterations=8))
    for (x, v), (x0, v0) in zip(run, course.converged(), strict=True):
        (middle, spin), (middle0, spin0) = (scenes.middle_and_spin(masses, *state) for state in ((x, v), (x0, v0)))
        assert np.abs(middle - middle0).max() <= 1e-7
        assert np.linalg.norm(spin - spin0) <= 1e-4 * np.linalg.norm(spin0)


def solved_tumbles(count: int) -> list[tuple[StepProblem, Array]]:
    """Steps of random tumbles that the iterations have solved to 1e-8, with their solutions."""
    from tumbles import random_tumble

    found = []
    for number in range(count):
        _, sim, state = random_tumble(np.random.default_rng([11, number]))
        for _ in range(8):
            problem = step_problem(
                sim.scene.values(), state.positions[0].numpy(), state.velocities[0].numpy(), sim.time_step
            )
            with torch.no_grad():
                state = sim(state)
            u = sim.time_step * state.velocities[0].numpy()
            if problem.relative_residual(u) <= 1e-8:
                found.append((problem, u))
    return found


@pytest.mark.usefixtures("scenes")
def test_converged_steps_stay() -> None:
    solved = solved_tumbles(20)
    assert len(solved) >= 120
    assert sum(bool(problem.values.planes[0, -1] > 0.0) for problem, _ in solved) >= 60
    for problem, u in solved:
        assert np.abs(corrected(problem, u) - u).max() <= 1e-8
        alone = coarse_chebyshev(problem, corrected(problem, u), iterations=9, every=4)
        assert np.abs(alone - u).max() <= 1e-8
    for problem, u in solved[::3]:
        pieces = coarse_chebyshev(problem, u, iterations=9, every=4, pieces=cut(problem, 12))
        assert np.abs(pieces - u).max() <= 1e-8


@pytest.mark.usefixtures("scenes")
def test_smooth_contacts_never_raise_the_energy() -> None:
    from tumbles import random_tumble

    corrections = 0
    for number in range(30):
        facts, sim, state = random_tumble(np.random.default_rng([11, number]))
        if facts["friction"] > 0.0:
            continue
        for _ in range(4):
            before = state.positions[0].numpy(), state.velocities[0].numpy()
            problem, iterates = step_problem(sim.scene.values(), *before, sim.time_step), []
            coarse_chebyshev(problem, iterations=32, every=4, observe=lambda k, u, kept=iterates: kept.append((k, u)))
            pieces = piece_motions(PieceSpace(problem, cut(problem, 12), iterates[0][1]))
            for u in (u for k, u in iterates if k % 4 == 0):
                for motions in (RigidMotions, pieces):
                    energy = problem.energy(corrected(problem, u, motions=motions))
                    assert energy <= problem.energy(u) * (1.0 + 1e-12)
                corrections += 1
            with torch.no_grad():
                state = sim(state)
    assert corrections >= 100


@pytest.mark.usefixtures("scenes")
@pytest.mark.parametrize("number", [14, 41, 58, 91])
def test_stiff_landings_on_rough_ground_settle(number: int) -> None:
    """Friction radii that follow the normal forces at once leave 0.3 to 0.97 of the speed as error here."""
    import coarse

    assert max(row["error"] for row in coarse.run_scene(number)["solved"]) <= 0.05


def simulate(course: Any, steps: int, iterations: int) -> list[tuple[Array, Array]]:
    """Positions and velocities after every step."""
    x, v, out = course.positions, course.velocities, []
    for step in range(steps):
        u = coarse_chebyshev(course.problem(step, x, v), iterations=iterations)
        x, v = x + u, u / H
        out.append((x, v))
    return out


@pytest.mark.parametrize("youngs", [1e5, 1e7])
def test_sliding_loses_speed_by_coulomb(scenes: ModuleType, youngs: float) -> None:
    """2 m/s less 0.1 g in a second."""
    course = scenes.course(scenes.box((0.1,) * 3, (2,) * 3), youngs, scenes.ground(0.1), velocity=(2.0, 0.0, 0.0))
    masses = course.scene.values().masses
    speed = masses @ simulate(course, 60, 8)[-1][1][:, 0] / masses.sum()
    assert speed == pytest.approx(2.0 - 0.1 * 9.8, abs=1e-4)


@pytest.mark.parametrize("youngs", [1e5, 1e6, 1e7])
def test_rest_on_an_incline_does_not_creep(scenes: ModuleType, youngs: float) -> None:
    slope = np.radians(20.0)
    gravity = pd.Gravity((9.8 * float(np.sin(slope)), -9.8 * float(np.cos(slope)), 0.0))
    course = scenes.course(scenes.box((0.1,) * 3, (2,) * 3), youngs, scenes.ground(0.5), gravity)
    run = simulate(course, 150, 3)
    assert np.abs(run[-1][0] - run[-61][0]).max() < 1e-9
    assert np.abs(run[-1][0] - course.positions).max() < 1e-3  # it settles


@pytest.mark.parametrize("youngs", [1e5, 1e7])
def test_what_is_dropped_askew_comes_to_rest_on_a_face(scenes: ModuleType, youngs: float) -> None:
    mesh = scenes.box((0.2,) * 3, (2,) * 3, 20.0, 15.0)
    course = scenes.course(mesh, youngs, scenes.ground(0.5), height=0.1)
    x, v = simulate(course, 120, 3)[-1]
    assert np.abs(v).max() < 1e-4
    # the vertices of a face; a soft cube sags by rho g L^2 / E = 4 mm
    assert (x[:, 1] < 1e-6).sum() == 9


@pytest.mark.parametrize("count", [0, 3, 64])
@pytest.mark.parametrize("youngs", [1e5, 1e7])
@pytest.mark.parametrize("friction", [0.0, 0.8])
def test_a_bar_falls_about_its_corner(friction: float, youngs: float, count: int) -> None:
    """Contacts have no torque about the corner; friction holds it, or nothing pushes sideways."""
    case = leaning(friction, youngs=youngs)
    problem, corner = case.problem(), int(case.positions[:, 1].argmin())
    u = coarse_chebyshev(problem, iterations=count)
    masses, x = problem.values.masses[:, None], case.positions + u
    push = masses * (u / H - case.velocities - H * problem.values.gravity)
    force, torque = push.sum(axis=0), np.cross(x - x[corner], push).sum(axis=0)
    momentum, size = float(np.linalg.norm(masses * u / H, axis=1).sum()), 0.5
    # not zero: the pushes of the touching vertices come after the rigid motion, and change the lever arms
    assert np.linalg.norm(torque) <= 2e-4 * momentum * size
    sideways = float(np.hypot(force[0], force[2]))
    if friction > 0.0:
        assert np.abs(u[corner]).max() <= 1e-12
        assert sideways <= friction * force[1]
    else:
        assert sideways <= 1e-12 * force[1]
        assert abs(x[corner, 1]) <= 1e-12
    assert 0.05 <= force[1] / (9.8 * H * masses.sum()) <= 0.96


def test_a_pushed_column_turns_over_its_edge(scenes: ModuleType) -> None:
    mesh, gravity = scenes.box((0.1, 0.4, 0.1), (1, 4, 1)), pd.Gravity((6.0, -9.8, 0.0))
    course = scenes.course(mesh, 1e7, scenes.ground(1.0), gravity)
    x = course.positions
    edge = (x[:, 1] < 1e-9) & (x[:, 0] > 0.05 - 1e-9)
    far = (x[:, 1] < 1e-9) & (x[:, 0] < -0.05 + 1e-9)
    u = coarse_chebyshev(course.problem(0, x, course.velocities), iterations=3)
    assert np.abs(u[edge]).max() <= 1e-6
    assert u[far, 1].min() >= 2e-4


@pytest.mark.parametrize(("youngs", "share"), [(1e5, 0.08), (1e6, 0.05), (1e7, 0.02)])
def test_a_ball_carries_a_cube(scenes: ModuleType, youngs: float, share: float) -> None:
    """The ball of 10 m starts at 0.1 m/s; the cube sticks to it."""
    course = scenes.scenes(youngs, 2)["cube on a starting ball"]
    run = course.run(lambda problem: coarse_chebyshev(problem, iterations=16))
    assert scenes.error(course, run, course.converged()) <= share


@pytest.mark.parametrize("angle", [2e-4, 0.025])
def test_two_planes_that_are_nearly_one_rub_as_one(angle: float) -> None:
    """Each bears half of a block of 100 MPa that cannot lie in both, so contacts open and close among the passes."""
    mesh = pd.shapes.box((0.1,) * 3, (3,) * 3)
    x = mesh.vertices - [0.05, 0.0, 0.05]
    planes = [
        pd.Ground(0.0, normal=(side * np.sin(angle / 2), np.cos(angle / 2), 0.0), friction=0.3) for side in (-1.0, 1.0)
    ]
    scene = pd.Scene(pd.Solid(pd.TetMesh(x, mesh.tets), 1e8), pd.Gravity(), *planes)
    problem = step_problem(scene.values(), x, np.tile([0.0, 0.0, 1.0], (len(x), 1)), H)
    along = float(coarse_chebyshev(problem, iterations=3)[:, 2].mean()) / H
    assert along == pytest.approx(1.0 - 0.3 * 9.81 * H / np.cos(angle / 2), abs=0.01)


@pytest.mark.parametrize("youngs", [1e5, 1e6, 1e7])
def test_a_rough_corner_stops_a_cube(scenes: ModuleType, youngs: float) -> None:
    course = scenes.scenes(youngs, 2)["corner of planes"]
    run = course.run(lambda problem: coarse_chebyshev(problem, iterations=16))
    assert scenes.error(course, run, course.converged()) <= 1e-2


@pytest.mark.parametrize("youngs", [1e5, 1e7])
def test_a_squeezed_cube_is_lifted(scenes: ModuleType, youngs: float) -> None:
    course = scenes.gripper(youngs, 2)
    run = course.run(lambda problem: coarse_chebyshev(problem, iterations=16))
    assert scenes.error(course, run, course.converged()) <= 0.05


@pytest.mark.parametrize("spin", [5.0, 60.0])
def test_a_body_that_touches_nothing_turns_by_the_nearest_rotation(spin: float) -> None:
    """At 60 rad/s a step turns by 45 degrees; the sum of a (z - mean) (y - mean)^T has the closed form."""
    mesh = pd.shapes.box((0.2, 0.1, 0.1), (2, 1, 1))
    x = mesh.vertices
    v = np.array([1.0, 0.0, 2.0]) + np.cross(spin * np.array([0.6, 0.0, 0.8]), x - x.mean(axis=0))
    problem = step_problem(pd.Scene(pd.Solid(mesh, 1e6)).values(), x, v, H)
    share = problem.weight[:, None] / problem.weight.sum()
    arms, goal = x - (share * x).sum(axis=0), x + problem.target
    mean = (share * goal).sum(axis=0)
    closed = arms @ nearest_rotation((share * (goal - mean)).T @ arms).T + mean - x
    still = np.zeros_like(x)
    # the last step is at most 1e-6 of the size, and its error of second order
    np.testing.assert_allclose(correct(problem, still, np.zeros((0, *x.shape))).displacement, closed, atol=1e-12)


@pytest.mark.parametrize(("held", "free"), [([], 6), ([0], 3), ([0, 1], 1), ([0, 1, 2], 1), ([0, 1, 4], 0)])
def test_pins_leave_turns(held: list[int], free: int) -> None:
    """A point leaves three turns, points in a line one; pinned vertices stay under the finite motion."""
    mesh = pd.shapes.box((0.4, 0.1, 0.1), (4, 1, 2))
    body = pd.Solid(mesh, 1e6)
    scene = pd.Scene(body, pd.Gravity(), *([pd.Pin(body, held)] if held else []))
    x = mesh.vertices
    problem = step_problem(scene.values(), x, 0.0 * x, H)
    rigid = RigidMotions(problem, np.zeros_like(x), (np.arange(len(x)),))
    assert rigid.modes.shape[2] == free
    moved = rigid.after(0.3 * np.ones(free)).displacement
    lengths = [np.linalg.norm(y[:, None] - y[None], axis=2) for y in (x, x + moved)]
    np.testing.assert_allclose(*lengths, atol=1e-14)
    assert np.abs(moved[held]).max(initial=0.0) == 0.0
    # however far other vertices have gone
    far = np.random.default_rng(0).standard_normal(x.shape) * np.where(problem.free, 1e9, 0.0)[:, None]
    assert RigidMotions(problem, far, (np.arange(len(x)),)).modes.shape[2] == free


def test_a_released_pin_is_free_and_a_grasped_vertex_is_held() -> None:
    mesh = pd.shapes.box((0.4, 0.1, 0.1), (4, 1, 1))
    body = pd.Solid(mesh, 1e6)
    x = mesh.vertices
    v = np.cross([0.0, 0.0, 2.0], x - x[0])
    pinned, alone = pd.Scene(body, pd.Gravity(), pd.Pin(body, [0, 1])), pd.Scene(body, pd.Gravity())
    u = coarse_chebyshev(step_problem(pinned.values(), x, v, H), iterations=3)
    assert np.abs(u[:2]).max() == 0.0
    problem = step_problem(alone.values(), x, v, H)
    after = coarse_chebyshev(problem, iterations=3)
    masses = problem.values.masses[:, None]
    fall = (masses * (v + H * problem.values.gravity)).sum(axis=0)
    np.testing.assert_allclose((masses * after / H).sum(axis=0), fall, atol=1e-12 * masses.sum())


def test_envelopes_have_their_forces_as_derivatives() -> None:
    """Planes and a sphere, in contact and out of it, sticking and slipping."""
    rng = np.random.default_rng(5)
    mesh = pd.shapes.box((0.2,) * 3, (2,) * 3)
    scene = pd.Scene(pd.Solid(mesh, 1e5), pd.Ground(0.05, friction=0.5), pd.Sphere((0.1, 0.1, 0.1), 0.12, 0.3))
    x = mesh.vertices
    problem = step_problem(scene.values(), x, 0.0 * x, H)
    u = 0.02 * rng.standard_normal(x.shape)
    forces = pushes_of(problem, u, problem.gradient(u))
    contacts = contacts_at(problem, u, forces, np.arange(len(x)))
    radius = contacts.friction * contacts.normal_anchors
    way = 0.01 * rng.standard_normal(contacts.gaps.shape + (3,))
    step, at = 1e-6, contacts.shifted(way)
    on, cut = at.normal_forces() > 0.0, at.tangent_forces(radius)[1]
    assert 5 < on.sum() < len(on) - 5
    assert ((cut > 0.0) & (cut < 1.0)).sum() > 5
    # truncation step^2 / 6 and rounding 1e-16 / step, relative to lengths of 1e-2 m
    direction = rng.standard_normal(way.shape)
    ahead, behind = (contacts.shifted(way + sign * step * direction) for sign in (1.0, -1.0))
    slope = (ahead.energy(radius) - behind.energy(radius)) / (2.0 * step)
    assert slope == pytest.approx(-float((at.forces(radius) * direction).sum()), rel=1e-7)
    # the majoriser is the second derivative but where friction is cut, and there along the normal
    along_normal = contacts.normals * direction.sum(axis=1, keepdims=True)
    for step_along, rows in ((direction, (cut == 0.0) | (cut == 1.0)), (along_normal, cut >= 0.0)):
        ahead, behind = (contacts.shifted(way + sign * step * step_along) for sign in (1.0, -1.0))
        change = (ahead.forces(radius) - behind.forces(radius)) / (2.0 * step)
        expected = -np.einsum("mij,mj->mi", at.majoriser(radius), step_along)
        np.testing.assert_allclose(change[rows], expected[rows], atol=1e-6 * np.abs(expected).max())
    assert np.linalg.eigvalsh(at.majoriser(radius)).min() >= -1e-9 * contacts.stiffness.max()


def test_quadratics_lie_above_envelopes_along_surfaces() -> None:
    """Those of the majoriser touch e; the second derivative would not stay above it where friction is cut."""
    rng = np.random.default_rng(6)
    mesh = pd.shapes.box((0.2,) * 3, (2,) * 3)
    scene = pd.Scene(pd.Solid(mesh, 1e5), pd.Ground(0.05, friction=0.5), pd.Sphere((0.1, 0.1, 0.1), 0.12, 0.3))
    x = mesh.vertices
    problem = step_problem(scene.values(), x, 0.0 * x, H)
    u = 0.02 * rng.standard_normal(x.shape)
    contacts = contacts_at(problem, u, pushes_of(problem, u, problem.gradient(u)), np.arange(len(x)))
    radius = contacts.friction * contacts.normal_anchors
    cut = contacts.tangent_forces(radius)[1]
    assert ((cut > 0.0) & (cut < 1.0)).sum() > 5
    along = contacts.tangential(rng.standard_normal((len(cut), 3)))
    for size in (1e-4, 1e-2, 1.0):
        model = 0.5 * size**2 * np.einsum("mi,mij,mj", along, contacts.majoriser(radius), along)
        model -= size * float((contacts.forces(radius) * along).sum())
        assert contacts.shifted(size * along).energy(radius) - contacts.energy(radius) <= model


def test_bodies_alone_and_together_have_the_same_bits() -> None:
    """What touches nothing does not feel the contacts of others, and what touches not the others."""
    low, high = (pd.shapes.box((0.1,) * 3, (2,) * 3) for _ in range(2))
    high = pd.TetMesh(high.vertices + np.array([0.0, 3.0, 0.0]), high.tets)
    bodies = [pd.Solid(mesh, 1e6) for mesh in (low, high)]
    parts = pd.Gravity(), pd.Ground(0.0, friction=0.4)
    rng = np.random.default_rng(3)
    velocities = [rng.standard_normal(mesh.vertices.shape) for mesh in (low, high)]

    def steps(chosen: list[int]) -> Array:
        x = np.concatenate([bodies[i].mesh.vertices for i in chosen])
        v = np.concatenate([velocities[i] for i in chosen])
        problem = step_problem(pd.Scene(*(bodies[i] for i in chosen), *parts).values(), x, v, H)
        first = problem.first_iterate()
        return corrected(problem, first)

    together = steps([0, 1])
    np.testing.assert_array_equal(together, np.concatenate([steps([0]), steps([1])]))
