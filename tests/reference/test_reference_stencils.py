"""Converged steps of mixed scenes against known ones, and the derivatives of such a step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from cases import box, contact_block, rotation
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu
from stencil_scenes import (
    FIRM_CLOTH,
    LIMITED_BEAMS,
    MUSCLE_BEAMS,
    SOFT_CLOTH,
    SOLID_CASES,
    SolidCase,
    StencilScene,
    capped_box,
    chain,
    cloth,
    cloth_masses,
    group,
    hinges,
    limited_beam,
    membrane,
    muscle_beam,
    of_tets,
    pulled_spring,
    sheet,
    small_beam,
    springs,
)

import torchpd as pd
from torchpd.reference import Array, StepProblem, elastic_energy, elements, step_problem
from torchpd.reference.groups import ElementGroup
from torchpd.reference.laws import Corotated
from torchpd.reference.solvers import guarded_chebyshev, jacobi, newton, preconditioned_lbfgs, relative_error
from torchpd.scene import SceneValues

SCENES: dict[str, Callable[[], StencilScene]] = {
    "spring": pulled_spring,
    "chain": chain,
    "soft cloth": lambda: cloth(*SOFT_CLOTH),
    "firm cloth": lambda: cloth(*FIRM_CLOTH),
    "limited beam": lambda: limited_beam(*LIMITED_BEAMS[0]),
    "firmly limited beam": lambda: limited_beam(*LIMITED_BEAMS[1]),
    "muscle above": lambda: muscle_beam(upper=MUSCLE_BEAMS[0][0], tip=MUSCLE_BEAMS[0][1], energy=MUSCLE_BEAMS[0][2]),
    "muscle": lambda: muscle_beam(upper=MUSCLE_BEAMS[1][0], tip=MUSCLE_BEAMS[1][1], energy=MUSCLE_BEAMS[1][2]),
    "capped box": capped_box,
}


# iterations to errors of 1e-1, 1e-2 and 1e-3, of the prototype: 20 % apart is the same
CHEBYSHEV = {"chain": (10, 20, 26), "soft cloth": (187, 285, 470), "muscle above": (49, 103, 145)}
LBFGS = {"chain": (2, 6, 12), "limited beam": (7, 16, 23), "muscle above": (4, 7, 12)}


def check_known(scene: StencilScene) -> tuple[StepProblem, Array]:
    """Solve the step and compare with what is known of it."""
    problem = scene.problem()
    u = newton(problem, problem.first_iterate(scene.start))
    for vertices, place in scene.places:
        np.testing.assert_allclose((problem.positions + u)[vertices].mean(axis=0), place, atol=1e-6)
    assert problem.energy(u) == pytest.approx(scene.energy, rel=1e-6)
    return problem, u


def check_counts(curve: dict[int, float], expected: tuple[int, ...]) -> None:
    """Iterations to the three errors are those expected, up to 20 % and one more."""
    found = [min(k for k, error in curve.items() if error <= bound) for bound in (1e-1, 1e-2, 1e-3)]
    assert all(count <= 1.2 * known + 1.0 for count, known in zip(found, expected, strict=True)), found


@pytest.mark.parametrize("name", SCENES)
def test_converged_step(name: str) -> None:
    problem, u = check_known(SCENES[name]())
    first = problem.first_iterate(SCENES[name]().start)
    if name in CHEBYSHEV:
        curve: dict[int, float] = {}
        watch = lambda k, x: curve.update({k: relative_error(x, u, first)})  # noqa: E731
        guarded_chebyshev(problem, first, iterations=int(1.2 * CHEBYSHEV[name][2]) + 1, observe=watch)
        check_counts(curve, CHEBYSHEV[name])
    if name in LBFGS:
        curve = {}
        watch = lambda k, x: curve.update({k: relative_error(x, u, first)})  # noqa: E731
        preconditioned_lbfgs(
            problem, first, inverse(problem), iterations=int(1.2 * LBFGS[name][2]) + 1, backtrack=True, observe=watch
        )
        check_counts(curve, LBFGS[name])


def inverse(problem: StepProblem) -> Callable[[Array], Array]:
    """The exact inverse of the constant matrix, on free vertices."""
    free = np.flatnonzero(problem.free)
    factor = splu(csc_array(problem.matrix[free][:, free]))

    def apply(gradient: Array) -> Array:
        solved = np.zeros_like(gradient)
        solved[free] = factor.solve(gradient[free])
        return solved

    return apply


@pytest.mark.parametrize("case", SOLID_CASES, ids=lambda case: f"{case.youngs:g} {case.poisson} {case.cells}")
def test_converged_step_with_poisson(case: SolidCase) -> None:
    check_known(case.scene())


def test_a_tenth_of_the_drawn_box_is_capped() -> None:
    scene = capped_box()
    problem = scene.problem()
    elements = problem.groups[0]
    F = elements.deformation(newton(problem, problem.first_iterate(scene.start)))
    law = elements.law
    assert isinstance(law, Corotated)
    trace = np.linalg.svd(F)[1].sum(axis=1) - 3.0
    assert int((law.bulk * trace > law.shear).sum()) == 24


@pytest.mark.parametrize(("alternating", "sags"), [(True, (1.4127, 1.3205, 1.2757)), (False, (1.4436, 1.3287, 1.2721))])
def test_bending_strip_sags_as_known(*, alternating: bool, sags: tuple[float, ...]) -> None:
    """Strip 1 x .2 m under a load out of its plane, two rows held, sag over q L^4 / 8 kb; hinges are linear."""
    for sag, cells in zip(sags, (10, 20, 40), strict=True):
        positions, triangles = sheet((1.0 + 1.0 / cells, 0.2), (cells + 1, cells // 5), alternating=alternating)
        positions = positions - [1.0 / cells, 0.0, 0.0]
        bent = hinges(positions, triangles, 1.0)
        matrix = ElementGroup(bent, np.arange(len(bent.corners)), positions, 1.0).matrix
        free = np.flatnonzero(positions[:, 0] > 1e-9)
        load = cloth_masses(positions, triangles, 1.0)
        down = splu(csc_array(matrix[free][:, free])).solve(load[free])
        tip = positions[free, 0] > 1.0 - 1e-9
        assert 8.0 * down[tip].mean() == pytest.approx(sag, abs=2e-4)


def every_kind(seed: int = 0) -> tuple[StepProblem, Array]:
    """A box of mixed solids with every kind of element on it, in a strained state."""
    rng = np.random.default_rng(seed)
    case = contact_block(cells=2)
    values = case.scene.values()
    tets, count = values.tets, len(values.tets)
    shape, size = elements(values.rest_positions, tets), rng.uniform(0.5, 2.0, count)
    rest, faces = values.rest_positions, tets[:, 1:]
    sheets, bent = membrane(rest, faces, 1e4, 0.3), hinges(rest, np.array([[0, 1, 3], [1, 3, 4]]), 10.0)
    weights = np.array([1.0, -0.4, -0.3, -0.2, -0.1])[None, :, None]
    limits = np.array([[0.9, 1.1, 1e5]])
    along = shape.shape_gradients[:, :, :1]
    rows: dict[str, float | Array] = {"fibre_stiffness": 1e4 * size, "fibre_length": 0.8}
    groups = (
        sheets,
        replace(bent, material=bent.material | {"rest_curvature": np.full(len(bent.corners), 3.0)}),
        springs(tets[:, :2], 1e3, 0.2),
        group("tie", np.array([[0, 5, 7, 9, 20]]), weights, np.ones(1), tie_stiffness=1e3),
        group("fibre", tets, along, shape.volumes, constants=np.arange(count)[:, None] % 2.0, **rows),
        group("thread", faces, sheets.gradients[:, :, :1], sheets.measure, thread_stiffness=1e4),
        of_tets("solid_limit", values, np.arange(10), solid_limit=limits),
        group("cloth_limit", faces, sheets.gradients, sheets.measure, cloth_limit=limits),
        of_tets("volume", values, np.arange(count), volume_stiffness=1e5),
        of_tets("damper", values, np.arange(count), viscosity=1e3),
        of_tets("plastic", values, np.arange(5), plastic_youngs=1e5, plastic_poisson=0.3),
    )
    mixed = replace(
        values,
        stencils=groups,
        stiffness=1e5 * size,
        poisson=0.4 * rng.uniform(size=count),
        tet_group=np.arange(count) // 4,
    )
    moved = rest + 0.02 * rng.standard_normal(rest.shape)
    problem = step_problem(mixed, moved, np.zeros_like(rest), 0.01)
    return problem, 0.02 * rng.standard_normal(rest.shape)


def test_gradient_hessian_and_product_agree_with_every_kind() -> None:
    problem, u = every_kind()
    v = np.random.default_rng(1).standard_normal(u.shape)
    step = 1e-7
    slope = (problem.energy(u + step * v) - problem.energy(u - step * v)) / (2.0 * step)
    assert slope == pytest.approx(float((problem.gradient(u) * v).sum()), rel=1e-6)
    change = (problem.gradient(u + step * v) - problem.gradient(u - step * v)) / (2.0 * step)
    product = problem.hessian_product(u, v)
    assert np.linalg.norm(change - product) <= 1e-6 * np.linalg.norm(product)
    np.testing.assert_allclose(problem.hessian(u) @ v.reshape(-1), product.reshape(-1), rtol=1e-9, atol=1e-6)
    assert np.linalg.eigvalsh(problem.hessian(u, positive=True).toarray())[0] > 0.0
    elastic = sum(
        float(group.law.evaluate(group.deformation(u))[0].sum())
        for group in problem.groups
        if group.stencils.kind != "damper"
    )
    assert elastic_energy(problem.values, problem.positions + u) == pytest.approx(elastic, rel=1e-12)


def test_steps_of_the_diagonal_lower_the_energy_of_every_kind_together() -> None:
    problem, u = every_kind()
    energies: list[float] = []
    jacobi(problem, u, iterations=30, relaxation=1.9, observe=lambda k, x: energies.append(problem.energy(x)))
    assert (np.diff(energies) <= 1e-12 * np.abs(energies[:-1])).all()
    np.testing.assert_allclose(problem.matrix.diagonal(), problem.plain_diagonal, rtol=1e-12)
    assert (problem.plain_diagonal <= problem.weighted_diagonal).all()


def test_material_products_are_derivatives_of_the_gradient() -> None:
    """By each row of every kind together, and by Young's modulus and Poisson's ratio of single tetrahedra."""
    problem, u = every_kind()
    v = np.random.default_rng(2).standard_normal(u.shape)
    products, values = problem.material_products(u, v), problem.values

    def along(values: SceneValues) -> float:
        return float((replace(problem, values=values).gradient(u) * v).sum())

    for stencils in values.stencils:
        for name, row in stencils.material.items():
            ends = []
            for h in (1e-6, -1e-6):
                moved = replace(stencils, material=stencils.material | {name: row + h * (1.0 + np.abs(row))})
                others = tuple(moved if other is stencils else other for other in values.stencils)
                ends.append(along(replace(values, stencils=others)))
            expected = float((products[name] * (1.0 + np.abs(row))).sum())
            assert (ends[0] - ends[1]) / 2e-6 == pytest.approx(expected, rel=1e-5, abs=1e-7 * abs(ends[0]))
    poisson = values.poisson
    assert poisson is not None
    for number in (0, 5):
        one = np.eye(len(values.tets))[number]
        by_youngs = [along(replace(values, stiffness=values.stiffness + h * one)) for h in (1.0, -1.0)]
        assert (by_youngs[0] - by_youngs[1]) / 2.0 == pytest.approx(products["stiffness"][number], rel=1e-5)
        by_nu = [along(replace(values, poisson=poisson + h * one)) for h in (1e-6, -1e-6)]
        assert (by_nu[0] - by_nu[1]) / 2e-6 == pytest.approx(products["poisson"][number], rel=1e-5)


def test_a_scene_of_all_bodies_falls_as_one() -> None:
    """Elements only exchange momentum: the common centre of mass falls freely. Chebyshev finds Newton's solution."""
    vertices, tets = box((0.3, 0.3, 0.3), (2, 2, 2))
    solid = pd.Solid(pd.TetMesh(vertices, tets), youngs=1e4, poisson=0.4)
    positions, triangles = sheet((0.3, 0.3), (4, 4))
    cloth = pd.Cloth(pd.TriMesh(positions + [0.0, 0.35, 0.0], triangles), 1e5, 1e-3, 0.2)
    rod = pd.Rod([(0.05 * k, 0.5, 0.0) for k in range(7)], 1e6, 0.005)
    scene = pd.Scene(
        solid,
        cloth,
        rod,
        pd.Fibres(solid, (1.0, 0.0, 0.0), 1e4, activation=1.0),
        pd.Tie(cloth, [0, 4], solid, [(0.0, 0.3, 0.0), (0.0, 0.3, 0.3)], stiffness=1e3),
        pd.Springs(rod, [(0, 0), (6, 20)], 100.0, other=cloth),
        pd.Gravity((0.0, -9.8, 0.0)),
    )
    values = scene.values()
    start = values.rest_positions + 0.01 * np.random.default_rng(0).standard_normal(values.rest_positions.shape)
    problem = step_problem(values, start, np.zeros_like(start), 0.02)
    first = problem.first_iterate("inertial")
    u = newton(problem, first)
    np.testing.assert_allclose(values.masses @ u / values.masses.sum(), [0.0, -9.8 * 0.02**2, 0.0], atol=1e-10)
    assert not values.component.any()
    assert relative_error(guarded_chebyshev(problem, first, iterations=1000).displacement, u, first) <= 1e-3


def test_cloth_of_a_scene_has_the_energies_of_its_formulas() -> None:
    """Membrane and hinges made by `Cloth` against those made here, on a disturbed sheet."""
    rng = np.random.default_rng(0)
    positions, triangles = sheet((0.5, 0.3), (5, 3))
    positions = positions + 0.02 * rng.standard_normal(positions.shape) * [1.0, 0.0, 1.0]
    own = [membrane(positions, triangles, 2e3, 0.2), hinges(positions, triangles, 1e-3)]
    values = pd.Scene(pd.Cloth(pd.TriMesh(positions, triangles), 1e6, 2e-3, 0.2, poisson=0.2, bending=1e-3)).values()
    moved = positions + 0.05 * rng.standard_normal(positions.shape)
    expected = replace(values, stencils=tuple(own))
    problems = [step_problem(of, moved, np.zeros_like(moved), 0.01) for of in (values, expected)]
    still = np.zeros_like(moved)
    np.testing.assert_allclose(*(problem.gradient(still) for problem in problems), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(*(problem.weighted_diagonal for problem in problems), rtol=1e-12)
    np.testing.assert_allclose(values.masses, cloth_masses(positions, triangles, 0.2), rtol=1e-12)


def sensitivities(scene: StencilScene, vertices: Array, axis: int) -> tuple[float, dict[str, Array]]:
    """Mean coordinate of vertices after the converged step, and its derivatives by the rows of the material."""
    problem = scene.problem()
    u = newton(problem, problem.first_iterate(scene.start))
    rate = np.zeros_like(u)
    rate[vertices, axis] = 1.0 / len(vertices)
    rows = np.flatnonzero(np.repeat(problem.free, 3))
    adjoint = np.zeros(u.size)
    adjoint[rows] = -splu(csc_array(problem.hessian(u)[rows][:, rows])).solve(rate.reshape(-1)[rows])
    place = float((problem.positions + u)[vertices, axis].mean())
    return place, problem.material_products(u, adjoint.reshape(u.shape))


def test_derivatives_of_a_step_of_cloth() -> None:
    scene = cloth(1e3, 1e-3, 0.0, {"edge": (0.0, 0.0, 0.0)}, poisson=0.2, cells=10)
    height, rates = sensitivities(scene, scene.places[0][0], 1)
    assert height == pytest.approx(0.0496547343, abs=1e-9)
    assert rates["membrane_youngs"].sum() == pytest.approx(-6.68485e-8, rel=1e-5)  # of thickness 1 m
    assert rates["bending"].sum() == pytest.approx(-0.0211296676, rel=1e-6)
    assert rates["membrane_poisson"].sum() == pytest.approx(-8.38539e-6, rel=1e-5)


@pytest.mark.parametrize(
    ("youngs", "poisson", "height", "by_youngs", "by_poisson"),
    [
        (1e5, 0.3, -0.203292618, 8.39533660e-8, 2.51543787e-3),
        (1e6, 0.45, -0.157223687, 3.30077765e-8, 3.53152235e-1),
    ],
)
def test_derivatives_of_a_step_with_poisson(
    youngs: float, poisson: float, height: float, by_youngs: float, by_poisson: float
) -> None:
    scene = small_beam(youngs, poisson)
    found, rates = sensitivities(scene, np.flatnonzero(scene.values.rest_positions[:, 0] > 1.0 - 1e-9), 1)
    assert found == pytest.approx(height, abs=1e-9)
    assert rates["stiffness"].sum() == pytest.approx(by_youngs, rel=1e-6)
    assert rates["poisson"].sum() == pytest.approx(by_poisson, rel=1e-6)


def test_no_damping_of_a_rigid_rotation() -> None:
    """From a stretched state, the elastic gradient after a rigid rotation is the rotated one: dampers feel nothing."""
    problem, _ = every_kind()
    damper = next(group for group in problem.groups if group.stencils.kind == "damper")
    turned = problem.positions @ rotation(20.0, -50.0, 80.0).T
    stress = damper.law.evaluate(damper.deformation(turned - problem.positions))[1]
    assert np.abs(damper.nodal(stress)).max() <= 1e-12 * 1e5  # of viscosity / h


def test_negative_poisson_converges_from_hard_starts() -> None:
    """The majoriser holds for nu in (-1, 0): random and mirrored states reach the solution."""
    scene = small_beam(1e6, -0.5)
    problem = scene.problem()
    u = newton(problem, problem.first_iterate("inertial"))
    rest = problem.values.rest_positions
    for start in (np.random.default_rng(0).uniform(size=rest.shape), rest * [1.0, -1.0, 1.0]):
        first = problem.first_iterate(start)
        assert relative_error(guarded_chebyshev(problem, first, iterations=400).displacement, u, first) <= 1e-4
