"""The oracle against closed forms, finite differences and the known numbers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from cases import (
    BEAM_STIFFNESS,
    KNOWN_CLASSIC,
    KNOWN_JACOBI,
    KNOWN_SPECTRUM,
    KNOWN_TIP,
    beam,
    beam_mesh,
    beam_tip,
    contact_block,
    hard_start,
    longest_spread,
    on_sphere,
    sliver_mesh,
    slivers,
    slope,
)
from scipy.spatial.transform import Rotation

from torchpd import TetMesh
from torchpd.baselines import BASELINES
from torchpd.reference import (
    Array,
    StepProblem,
    elastic_energy,
    elements,
    kinetic_energy,
    nearest_rotation,
    nearest_rotation_fast,
    potential_energy,
    step_problem,
)
from torchpd.reference.solvers import (
    Iterates,
    classic_chebyshev,
    classic_omegas,
    guard_tolerance,
    guarded_chebyshev,
    jacobi,
    newton,
    relative_error,
    solve_with_contact,
    spectrum,
)
from torchpd.scene import Scene
from torchpd.scene.effects import Damping, Gravity, Ground, Pin, Solid, Sphere

GRAVITY = np.array([0.0, -9.8, 0.0])


Solved = dict[float, tuple[StepProblem, Array, Array]]


@pytest.fixture(scope="module")
def solved() -> Solved:
    """Beam, first iterate and converged displacement for every stiffness."""
    found = {}
    for youngs in BEAM_STIFFNESS:
        case = beam(youngs)
        problem = case.problem()
        first = problem.first_iterate(case.start)
        found[youngs] = (problem, first, newton(problem, first))
    return found


def small_problem(seed: int = 0) -> tuple[StepProblem, Array]:
    """Slivers with hard and soft pins, forces and drag, and a disturbed iterate."""
    rng = np.random.default_rng(seed)
    mesh = sliver_mesh((3, 2, 2), seed=seed)
    body = Solid(mesh, youngs=10.0 ** rng.uniform(4.0, 6.0, len(mesh.tets)))
    scene = Scene(body, Pin(body, [0, 3]), Pin(body, [5, 9], stiffness=2e4), Gravity(GRAVITY), Damping(2.0))
    positions = mesh.vertices + 0.01 * rng.standard_normal(mesh.vertices.shape)
    velocities, forces = rng.standard_normal(positions.shape), rng.standard_normal(positions.shape)
    problem = step_problem(scene.values(), positions, velocities, 0.02, forces=forces)
    return problem, problem.first_iterate(mesh.vertices + 0.02 * rng.standard_normal(mesh.vertices.shape))


def test_rotation_of_a_rotated_stretch_is_the_rotation() -> None:
    turns = Rotation.random(200, random_state=0).as_matrix()
    axes = Rotation.random(200, random_state=1).as_matrix()
    stretches = np.random.default_rng(2).uniform(0.2, 3.0, (200, 3))
    matrices = turns @ (axes * stretches[:, None, :]) @ np.swapaxes(axes, 1, 2)
    # a gap of 0.4 between sums of singular values: rounding is amplified by 1 / 0.4 at most
    np.testing.assert_allclose(nearest_rotation(matrices), turns, atol=1e-13)
    np.testing.assert_allclose(nearest_rotation_fast(matrices), turns, atol=1e-13)


def test_rotation_of_inverted_flat_and_zero_matrices_is_the_best_rotation() -> None:
    rng = np.random.default_rng(3)
    matrices = rng.standard_normal((60, 3, 3))
    matrices[:20, :, 2] = matrices[:20, :, 1]
    matrices[20:30, :, 1:] = 0.0
    matrices[30] = 0.0
    trials = Rotation.random(4000, random_state=4).as_matrix()
    for candidates in (nearest_rotation(matrices), nearest_rotation_fast(matrices)):
        squares = candidates @ np.swapaxes(candidates, 1, 2)
        np.testing.assert_allclose(squares, np.tile(np.eye(3), (60, 1, 1)), atol=1e-13)
        np.testing.assert_allclose(np.linalg.det(candidates), 1.0, atol=1e-13)
        aligned = np.einsum("nij,nij->n", matrices, candidates)
        assert (aligned >= np.einsum("nij,tij->nt", matrices, trials).max(axis=1) - 1e-12).all()


def test_regular_tetrahedron_has_closed_form_elements() -> None:
    vertices = np.array([[1.0, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]])
    shape = elements(vertices, np.array([[0, 1, 2, 3]]))
    assert shape.volumes[0] == pytest.approx(8.0 / 3.0, rel=1e-14)
    assert shape.eigenvalue_bound[0] == pytest.approx(4.0 / 3.0, rel=1e-14)  # four unit normals at cosine -1/3
    np.testing.assert_allclose(shape.shape_gradients[0], vertices / 4.0, atol=1e-15)


def test_gradient_is_the_derivative_of_the_energy() -> None:
    problem, u = small_problem()
    direction = np.random.default_rng(1).standard_normal(u.shape) * problem.free[:, None]
    step = 1e-6
    difference = (problem.energy(u + step * direction) - problem.energy(u - step * direction)) / (2 * step)
    # rounding u E / step, against a slope of the order of E / (size of the motion, 0.02 m)
    assert difference == pytest.approx(float((problem.gradient(u) * direction).sum()), rel=1e-7)


def test_hessian_is_the_derivative_of_the_gradient() -> None:
    problem, u = small_problem()
    direction = np.random.default_rng(2).standard_normal(u.shape) * problem.free[:, None]
    step = 1e-7
    difference = (problem.gradient(u + step * direction) - problem.gradient(u - step * direction)) / (2 * step)
    product = (problem.hessian(u) @ direction.reshape(-1)).reshape(-1, 3) * problem.free[:, None]
    # truncation step^2 f''' / 6 and rounding 1e-16 / step, both near 1e-8 of |H d| on elements 1e-2 m wide
    assert np.linalg.norm(difference - product) <= 1e-6 * np.linalg.norm(product)


def test_clamped_hessian_is_positive_and_below_the_constant_matrix() -> None:
    problem, _ = small_problem()
    u = problem.first_iterate(0.2 * problem.values.rest_positions)
    exact, clamped = problem.hessian(u).toarray(), problem.hessian(u, positive=True).toarray()
    bound = np.kron(problem.matrix.toarray(), np.eye(3))
    size = np.linalg.norm(bound, 2)
    assert np.linalg.eigvalsh(exact)[0] < -1e-3 * size  # shrunk to a fifth: twists have 1 - 2 / 0.4 = -4
    assert np.linalg.eigvalsh(clamped)[0] > -1e-13 * size
    assert np.linalg.eigvalsh(bound - clamped)[0] > -1e-13 * size


def test_constant_matrix_has_the_plain_diagonal() -> None:
    problem, _ = small_problem()
    np.testing.assert_allclose(problem.matrix.diagonal(), problem.plain_diagonal, rtol=1e-12)


@pytest.mark.parametrize("youngs", BEAM_STIFFNESS)
def test_beam_tip(solved: Solved, youngs: float) -> None:
    problem, _, u = solved[youngs]
    np.testing.assert_allclose((problem.positions + u)[beam_tip()].mean(axis=0), KNOWN_TIP[youngs], atol=1e-6)
    assert np.linalg.norm(problem.gradient(u)) <= 1e-10


def test_local_global_reaches_the_newton_solution(solved: Solved) -> None:
    problem, first, u = solved[1e4]
    last = {}
    BASELINES["direct global step"].prepare(problem, first)(100, lambda k, x: last.update({0: x}))
    assert relative_error(last[0], u, first) <= 1e-10


def error_curve(
    run: Callable[..., Iterates], solved: tuple[StepProblem, Array, Array], iterations: int, **options: Any
) -> dict[int, float]:
    """|x_k - x*| / |x_0 - x*| by k."""
    problem, first, u = solved
    curve: dict[int, float] = {}
    options["observe"] = lambda k, x: curve.update({k: relative_error(x, u, first)})
    run(problem, first, iterations=iterations, **options)
    return curve


def test_jacobi_curve(solved: Solved) -> None:
    curve = error_curve(jacobi, solved[1e6], 200, weighted=False)
    assert {k: curve[k] for k in KNOWN_JACOBI} == pytest.approx(KNOWN_JACOBI, abs=1e-5)


def test_classic_curve(solved: Solved) -> None:
    curve = error_curve(classic_chebyshev, solved[1e6], 200, rho=0.995)
    assert {k: curve[k] for k in KNOWN_CLASSIC} == pytest.approx(KNOWN_CLASSIC, abs=1e-4)


def test_classic_omegas_tend_to_the_fixed_point_of_the_recurrence() -> None:
    omegas = classic_omegas(0.9, 3, 60)
    assert omegas[:4] == [1.0, 1.0, 1.0, 2.0 / (2.0 - 0.81)]
    assert omegas[-1] == pytest.approx(2.0 / (1.0 + np.sqrt(1.0 - 0.81)), rel=1e-14)


def test_guarded_curve(solved: Solved) -> None:
    curve = error_curve(guarded_chebyshev, solved[1e5], 256)
    assert min(k for k, error in curve.items() if error <= 1e-2) <= 100
    assert curve[256] <= 1e-6


def test_guarded_from_hard_starts() -> None:
    problem = hard_start("random").problem()
    u = newton(problem)
    for kind in ("random", "collapsed", "mirrored"):
        first = problem.first_iterate(hard_start(kind).start)
        assert relative_error(guarded_chebyshev(problem, first, iterations=600).displacement, u, first) <= 2e-4


def test_spectrum_of_the_beam(solved: Solved) -> None:
    problem = solved[1e6][0]
    assert spectrum(problem) == pytest.approx(KNOWN_SPECTRUM, rel=1e-2)
    assert problem.smallest_ratio <= spectrum(problem, weighted=True)[0]


@pytest.mark.parametrize("jitter", [0.0, 0.2, 0.35])
def test_weighted_diagonal_bounds_the_matrix(jitter: float) -> None:
    mesh = beam_mesh(jitter=jitter)
    body = Solid(mesh, youngs=1e6)
    values = Scene(body, Pin(body, np.arange(36))).values()
    problem = step_problem(values, mesh.vertices, 0.0 * mesh.vertices, 1.0 / 30.0)
    assert spectrum(problem, weighted=True)[1] <= 1.0 + 1e-6


def test_restart_on_slivers_never_raises_the_energy() -> None:
    """With omega = 1 the step is a scaled gradient step: E cannot rise (rounding of E apart)."""
    assert longest_spread(sliver_mesh()) > 3.99
    rises: list[float] = []
    for seed in range(3):
        problem, energies = slivers(seed=seed).problem(), []
        first = problem.first_iterate("inertial")
        watch = lambda k, x, p=problem, e=energies: e.append(p.energy(x))  # noqa: E731
        end = guarded_chebyshev(problem, first, iterations=300, observe=watch)
        # checked at u_k, acting on the step from u_{k+2} to u_{k+3}
        rises += [energies[k + 2] / energies[k + 1] - 1.0 for k in end.restarts if k < 298]
        assert max(energy for _, energy in end.energies) == end.energies[0][1]
    assert rises
    assert max(rises) <= 1e-12


def test_free_fall_is_exact_after_any_number_of_iterations() -> None:
    case = contact_block(height=5.0, velocity=(1.0, 2.0, 3.0))
    problem = case.problem()
    fall = case.time_step * (np.array([1.0, 2.0, 3.0]) + case.time_step * GRAVITY)
    for count in (0, 1, 7):
        end = guarded_chebyshev(problem, problem.first_iterate(), iterations=count)
        # 1e-16 of the 5 m coordinates, amplified by w / a, about 1e2
        np.testing.assert_allclose(end.displacement, np.tile(fall, (len(case.positions), 1)), atol=1e-12)


def test_damping_divides_free_motion() -> None:
    case = contact_block(Damping(6.0), gravity=(0.0, 0.0, 0.0), velocity=(1.0, 0.0, 0.0))
    end = newton(case.problem())
    np.testing.assert_allclose(end[:, 0] / case.time_step, 1.0 / (1.0 + 6.0 * case.time_step), rtol=1e-11)


def test_stretched_tetrahedron_pulls_back_as_its_closed_form() -> None:
    """One tet stretched by s along x: E = w V / 2 (s - 1)^2, and the force is its derivative."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    body = Solid(TetMesh(vertices, [[0, 1, 2, 3]]), youngs=1e4, density=600.0)
    values = Scene(body).values()
    stretched = vertices * [1.3, 1.0, 1.0]
    assert elastic_energy(values, stretched) == pytest.approx(1e4 / 6.0 / 2.0 * 0.09, rel=1e-13)
    problem = step_problem(values, vertices, 0.0 * vertices, 0.1)
    pull = problem.gradient(stretched - vertices) - problem.weight[:, None] * (stretched - vertices)
    np.testing.assert_allclose(pull[1], [1e4 / 6.0 * 0.3, 0.0, 0.0], atol=1e-9)
    mirrored = vertices * [-1.0, 1.0, 1.0]  # singular values 1, 1, -1: |F - R|^2 = 4
    assert elastic_energy(values, mirrored) == pytest.approx(1e4 / 6.0 / 2.0 * 4.0, rel=1e-13)


def test_soft_pin_and_weight_balance() -> None:
    """All vertices on springs k: the statics of a rigid drop by m g / k, reached with a huge time step."""
    mesh = beam_mesh()
    body = Solid(mesh, youngs=1e6)
    values = Scene(body, Pin(body, np.arange(len(mesh.vertices)), stiffness=50.0), Gravity(GRAVITY)).values()
    problem = step_problem(values, mesh.vertices, 0.0 * mesh.vertices, 1e4)
    sag = float((values.masses / 50.0).sum() * -9.8 / len(values.masses))
    assert newton(problem)[:, 1].mean() == pytest.approx(sag, rel=1e-6)  # inertia is 1e-8 of the springs


def test_state_energies_are_those_of_a_lifted_moving_body() -> None:
    values = contact_block(height=2.0).scene.values()
    mass = 1000.0 * 0.3**3
    assert potential_energy(values, values.rest_positions) == pytest.approx(mass * 9.8 * 2.15, rel=1e-12)
    assert kinetic_energy(values, np.tile([3.0, 0.0, 4.0], (64, 1))) == pytest.approx(12.5 * mass, rel=1e-12)


def test_plane_carries_what_the_block_does_not_fall() -> None:
    """Contact forces (grad E at a solution) point out of the plane, where it touches only, and balance the momentum."""
    case = contact_block(Ground(height=0.0), velocity=(0.5, -2.0, 0.0))
    problem = case.problem()
    u = solve_with_contact(problem)
    force, gaps = problem.gradient(u), problem.smallest_gap(u)
    size = np.abs(force).max()
    assert gaps.min() >= -1e-15
    assert (gaps <= 1e-12).sum() >= 16
    assert force[:, 1].min() >= -1e-9 * size
    assert np.abs(force[gaps > 1e-9]).max() <= 1e-9 * size
    assert np.abs(force[:, [0, 2]]).max() <= 1e-9 * size
    lack = (problem.weight[:, None] * (u - problem.target)).sum(axis=0)
    np.testing.assert_allclose(force.sum(axis=0), lack, atol=1e-9 * size)


@pytest.mark.parametrize(("angle", "friction"), [(0.5, 0.3), (0.8, 0.1)])
def test_block_slides_down_a_slope_with_coulomb_friction(angle: float, friction: float) -> None:
    """m a_x = m g sin - friction N and N = m (g cos + a_y), whatever the block does inside."""
    case = slope(angle, friction)
    problem = case.problem()
    u = solve_with_contact(problem)
    masses = problem.values.masses
    sideways, up, _ = masses @ u / masses.sum() / case.time_step**2
    touching = problem.smallest_gap(u) <= 1e-12
    assert (u[touching, 0] > 0.0).all()
    expected = 9.8 * np.sin(angle) - friction * (9.8 * np.cos(angle) + up)
    # each vertex slips straight downhill but for the warping of the Kuhn mesh, which is one part in 1e3 of the slip
    assert sideways == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("share", [0.8, 0.95, 1.05, 1.3])
def test_slope_at_its_critical_angle(share: float) -> None:
    """Below atan(friction) the block stays where it is; above it accelerates by g (sin - friction cos).

    Measured over 0.2 s after 0.5 s, in which the block settles into its own weight.
    """
    friction = 0.4
    angle = share * float(np.arctan(friction))
    case = slope(angle, friction)
    values, x, v = case.scene.values(), case.positions, case.velocities
    states = []
    for _ in range(42):
        problem = step_problem(values, x, v, case.time_step)
        u = guarded_chebyshev(problem, problem.first_iterate(), iterations=60).displacement
        x, v = x + u, u / case.time_step
        states.append((x, values.masses @ v / values.masses.sum()))
    (settled, slow), (end, fast) = states[29], states[41]
    closed = 9.8 * (np.sin(angle) - friction * np.cos(angle))
    if share < 1.0:
        # it still rocks on its elasticity by less than 2 % of its sag, rho g L^2 / E = 9 mm; at 1.05 it slides 33 mm
        assert np.abs(end - settled).max() <= 2e-4
        assert abs(fast[0]) <= 0.01
    else:
        assert (fast - slow)[0] / 0.2 == pytest.approx(closed, rel=0.02)


@pytest.mark.parametrize("friction", [0.0, 0.3, 1.0])
def test_sphere_obeys_coulomb(friction: float) -> None:
    case = on_sphere(friction)
    problem = case.problem()
    u = solve_with_contact(problem)
    force, gaps = problem.gradient(u), problem.smallest_gap(u)
    touching = gaps <= 1e-10
    assert touching.any()
    assert gaps.min() >= -1e-12
    arms = (problem.positions + u)[touching] - problem.sphere_centers[0]
    normals = arms / np.linalg.norm(arms, axis=1, keepdims=True)
    normal = (force[touching] * normals).sum(axis=1)
    tangential = np.linalg.norm(force[touching] - normal[:, None] * normals, axis=1)
    size = np.abs(force).max()
    assert normal.min() > 0.0
    assert (tangential <= friction * normal + 1e-8 * size).all()


def test_moving_sphere_drags_what_sticks_to_it() -> None:
    case = contact_block(Sphere((0.15, -0.2, 0.15), 0.21, 50.0), velocity=(0.0, -1.0, 0.0))
    start = case.scene.values().spheres[:, :3]
    problem = step_problem(
        case.scene.values(), case.positions, case.velocities, case.time_step,
        sphere_centers=start + [0.002, 0.0, 0.0], sphere_starts=start,
    )  # fmt: skip
    u = solve_with_contact(problem)
    touching = problem.smallest_gap(u) <= 1e-10
    arms = (problem.positions + u)[touching] - problem.sphere_centers[0]
    normals = arms / np.linalg.norm(arms, axis=1, keepdims=True)
    slip = u[touching] - problem.sphere_motions[0]
    slip = slip - (slip * normals).sum(axis=1, keepdims=True) * normals
    assert touching.any()
    assert np.abs(slip).max() <= 1e-12


def test_friction_makes_the_guard_lenient() -> None:
    assert guard_tolerance(contact_block(Ground()).problem()) == 1e-5
    assert guard_tolerance(contact_block(Ground(), Ground(friction=0.1)).problem()) == 1e-2
    assert guard_tolerance(on_sphere(0.1).problem()) == 1e-2


def test_what_cannot_be_solved_is_named() -> None:
    with pytest.raises(ValueError, match="solve_with_contact"):
        newton(contact_block(Ground()).problem())
    with pytest.raises(ValueError, match=r"start must.*rest"):
        contact_block().problem().first_iterate("rest")
