"""Pieces of bodies as a coarse space: its matrices, the iterations that it saves, contacts, and converged steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from types import ModuleType
from typing import NamedTuple

import numpy as np
import pytest
import torch
from cases import Case, box, rotation
from mixed_scenes import CASES
from multilevel_cases import Tables, slabs, swing
from numpy.typing import NDArray
from programs import ROOT
from runs import simulator
from scipy.linalg import eigh
from scipy.sparse import csr_array, kron
from stretch_cases import small_body

import torchpd as pd
from torchpd.reference import StepProblem, step_problem
from torchpd.reference.coarse_step import coarse_chebyshev
from torchpd.reference.piece_step import PieceCycle, piece_motions
from torchpd.reference.pieces import Pieces, PieceSpace, cut
from torchpd.reference.rigid import corrected
from torchpd.reference.solvers import newton, preconditioned_lbfgs, relative_error

Array = NDArray[np.float64]
H = 1.0 / 60.0


@pytest.fixture
def benchmarks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))


@pytest.fixture
def scenes(benchmarks: None) -> ModuleType:
    import coarse_scenes

    return coarse_scenes


@pytest.fixture
def pairs(benchmarks: None) -> ModuleType:
    import coarse_pairs

    return coarse_pairs


class Swing(NamedTuple):
    problem: StepProblem
    first: Array
    solution: Array
    cycle: Tables


@cache
def solved(make: Callable[[], Case]) -> Swing:
    case = make()
    problem = case.problem()
    first = problem.first_iterate(case.start)
    cycle = Tables(simulator(case, torch.float64, solver=pd.Multilevel()).plan)
    return Swing(problem, first, newton(problem, first, tolerance=1e-8), cycle)


def counts(swing: Swing, iterations: int, pieces: int | None, remakes: bool = True) -> list[int]:
    """Iterations of L-BFGS to errors of 1e-1, 1e-2 and 1e-3, one more than were done where they do not get there."""
    problem, first, solution, cycle = swing
    errors: list[float] = []
    parts = PieceCycle(problem, cycle, cut(problem, size=1, most=pieces or 1), remakes)

    def observe(k: int, u: Array) -> None:
        if pieces:
            parts.observe(k, u)
        errors.append(relative_error(u, solution, first))

    preconditioned_lbfgs(problem, first, parts, iterations=iterations, backtrack=True, observe=observe)
    assert not pieces or parts.pieces.count == pieces
    return [next((k + 1 for k, e in enumerate(errors) if e <= left), iterations + 1) for left in (1e-1, 1e-2, 1e-3)]


def test_stiff_slabs_in_a_soft_beam_take_few_iterations() -> None:
    """Contrast of 1e4; L-BFGS alone stalls, and with a space that is made once."""
    beam = solved(slabs)
    assert np.all(np.array(counts(beam, 30, 12)) <= [12, 24, 29])
    assert counts(beam, 50, 12, remakes=False)[2] == 51
    assert counts(beam, 50, None)[2] == 51


def stiff_beam() -> Case:
    return swing(5, 1e8)


def test_pieces_of_a_stiff_beam_save_half_of_the_iterations() -> None:
    beam = solved(stiff_beam)
    assert np.all(np.array(counts(beam, 20, 36)) <= [7, 10, 18])
    assert np.all(np.array(counts(beam, 40, None)) >= [14, 20, 30])


@pytest.mark.parametrize("poisson", [0.0, 0.45])
def test_the_preconditioner_is_positive(poisson: float) -> None:
    """1.8 M + Z (Hc^-1 - Ac^-1) Z^T on a beam in motion.

    H <= A (2 mu + 3 lambda) / (2 mu + lambda), so that for nu = 0 it adds to M, and takes at most 2 / 3 of Ac^-1 else.
    """
    mesh = pd.TetMesh(*box((1.0, 0.2, 0.2), (10, 2, 2)))
    body = pd.Solid(mesh, 1e6, poisson=poisson)
    scene = pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity())
    case = replace(swing(2, 1e6), scene=scene)
    problem = case.problem()
    tables = Tables(simulator(case, torch.float64, solver=pd.Multilevel()).plan)
    parts = PieceCycle(problem, tables, cut(problem, 6))
    parts.observe(2, problem.time_step * problem.velocities)
    space = PieceSpace(problem, parts.pieces, problem.time_step * problem.velocities)
    ratios = eigh(space.hessian, space.matrix, eigvals_only=True)
    assert ratios[0] < 0.05  # A is too stiff
    bulk = poisson / (1.0 - 2.0 * poisson)  # lambda / 2 mu
    assert ratios[-1] <= (1.0 + 3.0 * bulk) / (1.0 + bulk) * (1.0 + 1e-12)
    free = np.flatnonzero(np.repeat(problem.free, 3))
    rows = np.array([parts(unit.reshape(-1, 3)).ravel()[free] for unit in np.eye(problem.positions.size)[free]])
    assert np.abs(rows - rows.T).max() <= 1e-12 * np.abs(rows).max()
    assert np.linalg.eigvalsh(rows)[0] > 0.0


STRETCHES = ("solid_limit", "cloth_limit", "volume", "damper")


@pytest.mark.parametrize("name", [*CASES, *STRETCHES])
def test_matrices_of_every_kind_are_those_of_the_step(name: str) -> None:
    """Z^T H Z and Z^T A Z, from one pass over the elements."""
    case = CASES[name]() if name in CASES else small_body(name)
    problem = case.problem()
    u = problem.hold(H * problem.velocities)
    space = PieceSpace(problem, cut(problem, 3), u)
    z = space.prolongation
    assert z.shape[1] > 12
    hessian = (z.T @ problem.hessian(u, positive=True) @ z).toarray()
    np.testing.assert_allclose(space.hessian, hessian, atol=1e-12 * np.abs(hessian).max())
    matrix = (z.T @ kron(problem.matrix, np.eye(3)) @ z).toarray()
    np.testing.assert_allclose(space.matrix, matrix, atol=1e-12 * np.abs(matrix).max())
    assert np.linalg.eigvalsh(space.hessian)[0] > 0.0


@pytest.mark.parametrize(("own", "rank"), [([23], 3), ([22, 23], 5), ([11, 17, 23], 5), ([20, 21, 23], 6)])
def test_pieces_have_the_rigid_motions_that_their_vertices_show(own: list[int], rank: int) -> None:
    """A point has three, points in a line five; pinned vertices have none."""
    mesh = pd.shapes.box((0.3, 0.2, 0.1), (3, 2, 1))
    held = np.flatnonzero(mesh.vertices[:, 0] == 0.0)
    # so that rounding hides the rank
    body = pd.Solid(pd.TetMesh(mesh.vertices @ rotation(20.0, 30.0, 40.0).T, mesh.tets), 1e6)
    x = body.mesh.vertices
    problem = step_problem(pd.Scene(body, pd.Pin(body, held)).values(), x, 0.0 * x, H)
    of = np.where(problem.free, 0, -1)
    of[own] = 1
    free = np.flatnonzero(problem.free)
    shares = csr_array((np.ones(len(free)), (free, of[free])), shape=(len(x), 2))
    space = PieceSpace(problem, Pieces(of, shares), np.zeros_like(x))
    z = space.prolongation.toarray()
    assert z.shape[1] == 6 + rank
    np.testing.assert_allclose(z.T @ z, np.eye(z.shape[1]), atol=1e-14)
    turn = np.cross([1.0, 2.0, 3.0], x) + [0.1, 0.2, 0.3]
    turn[of != 1] = 0.0
    np.testing.assert_allclose(space.prolong(space.restrict(turn)), turn, atol=1e-14)
    assert np.abs(z.reshape(-1, 3, z.shape[1])[held]).max() == 0.0


def test_pieces_follow_bodies_and_stiffness() -> None:
    """No piece reaches over two bodies, and few elements of a stiff slab lie in two pieces."""
    problem = CASES["mixed"]().problem()
    pieces = cut(problem, 6)
    for piece in range(pieces.count):
        assert len(np.unique(problem.values.component[pieces.of == piece])) == 1
    assert (pieces.of[~problem.free] == -1).all()
    problem = solved(slabs).problem
    pieces = cut(problem, most=12)
    sizes = np.bincount(pieces.of[problem.free])
    assert len(sizes) == pieces.count == 12
    assert sizes.min() >= 20
    assert sizes.max() <= 150
    of = pieces.of[problem.values.tets]
    within = (of == of[:, :1]).all(axis=1)
    stiff = problem.values.stiffness == 1e8
    assert within[stiff].mean() >= 0.7
    assert within[~stiff].mean() <= 0.4


def test_a_bar_that_falls_over_its_corner_bends_right(scenes: ModuleType) -> None:
    """1e6 Pa, 32 iterations: rigid motions leave the bending of the bar, and pieces that do not blend are too stiff."""
    course = scenes.scenes(1e6)["bar falls 0.8"]
    exact = course.converged()
    problem = course.problem(0, course.positions, course.velocities)
    for blend, least, most in ((2, 0.0, 5e-4), (0, 1e-3, 5e-3)):
        pieces = cut(problem, 12, blend=blend)
        run = course.run(lambda problem, of=pieces: coarse_chebyshev(problem, iterations=32, every=4, pieces=of))
        assert least <= scenes.error(course, run, exact) <= most
    run = course.run(lambda problem: coarse_chebyshev(problem, iterations=32, every=4))
    assert scenes.error(course, run, exact) > 0.05


def test_a_bar_of_stiff_slabs_falls_over_its_corner(scenes: ModuleType) -> None:
    """1e5 and 1e8 Pa in turn, on smooth ground."""
    mesh = scenes.box((0.1, 0.5, 0.1), (2, 10, 2))
    cell = np.floor(20.0 * (0.25 + mesh.vertices[mesh.tets].mean(axis=1)[:, 1])).astype(np.int64)
    youngs = np.where(cell // 2 % 2 == 1, 1e8, 1e5)
    bar = scenes.box((0.1, 0.5, 0.1), (2, 10, 2), 15.0, 10.0)
    course = scenes.course(bar, youngs, scenes.ground(0.0), steps=4)
    exact = course.converged()
    pieces = cut(course.problem(0, course.positions, course.velocities), 12)
    run = course.run(lambda problem: coarse_chebyshev(problem, iterations=16, every=4, pieces=pieces))
    assert scenes.error(course, run, exact) <= 0.001
    run = course.run(lambda problem: coarse_chebyshev(problem, iterations=16, every=4))
    assert scenes.error(course, run, exact) > 0.03


def test_the_space_follows_slabs_that_turn() -> None:
    """Chebyshev with corrections every four iterations: 61, 65 and 81 if the space is made anew, for never."""
    problem, first, solution, _ = solved(slabs)
    for remake, most in ((4, 90), (0, 91)):
        errors: list[float] = []
        coarse_chebyshev(
            problem, first, iterations=90, every=4, pieces=cut(problem, most=12), remake=remake,
            observe=lambda k, u, kept=errors: kept.append(relative_error(u, solution, first)),
        )  # fmt: skip
        assert next((k + 1 for k, e in enumerate(errors) if e <= 1e-3), 91) <= most
    assert errors[-1] > 0.1


def test_pieces_together_move_as_one_body() -> None:
    """Weights add up to one, so that a rigid motion of the body is in the space; sweeps blend neighbours."""
    mesh = pd.shapes.box((0.4, 0.2, 0.2), (8, 4, 4))
    x = mesh.vertices
    problem = step_problem(pd.Scene(pd.Solid(mesh, 1e6)).values(), x, 0.0 * x, H)
    pieces, sharp = cut(problem, 25), cut(problem, 25, blend=0)
    assert pieces.weights.min() >= 0.0
    np.testing.assert_allclose(pieces.weights.sum(axis=1), 1.0, atol=1e-14)
    assert pieces.count == sharp.count == 9
    assert sharp.weights.nnz == len(x) < pieces.weights.nnz < 6 * len(x)
    z = PieceSpace(problem, pieces, 0.0 * x).prolongation.toarray()
    turn = (np.cross([1.0, 2.0, 3.0], x) + [0.1, 0.2, 0.3]).ravel()
    left = turn - z @ np.linalg.lstsq(z, turn)[0]
    assert np.abs(left).max() <= 1e-13


def test_a_cube_dropped_on_a_cube_deforms_right(pairs: ModuleType) -> None:
    """Rigid motions alone leave the compression of both."""
    bodies = replace(pairs.scenes(1e5, 2)["dropped on a cube"], steps=2)
    pieces = bodies.cut(6)
    exact = bodies.run(300, every=4, pieces=pieces)
    assert bodies.error(bodies.run(16, every=4, pieces=pieces), exact) <= 0.01
    assert bodies.error(bodies.run(16, every=4), exact) > 0.02


def test_a_correction_of_turning_pieces_does_not_raise_the_energy() -> None:
    """A step turns the bar by almost half a turn, where the model of the pieces is far from E."""
    mesh = pd.shapes.box((1.0, 0.1, 0.1), (20, 2, 2))
    x = mesh.vertices
    v = np.cross([0.0, 60.0, 60.0], x - x.mean(axis=0)) + np.sin(7.0 * x)
    problem = step_problem(pd.Scene(pd.Solid(mesh, 1e5)).values(), x, v, 1.0 / 30.0)
    still = np.zeros_like(x)
    motions = piece_motions(PieceSpace(problem, cut(problem, 12), still))
    assert problem.energy(corrected(problem, still, motions=motions)) < problem.energy(still)


@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_pieces_leave_solved_contacts_alone(friction: float) -> None:
    """Planes and a sphere, at a residual of rounding."""
    mesh = pd.shapes.box((0.2, 0.1, 0.1), (4, 2, 2))
    x = mesh.vertices
    parts = (
        pd.Gravity((1.0, -9.8, 0.5)),
        pd.Ground(0.0, friction=friction),
        pd.Sphere((0.25, 0.05, 0.05), 0.052, friction),
    )
    problem = step_problem(pd.Scene(pd.Solid(mesh, 1e5), *parts).values(), x, np.tile([0.5, -0.3, 0.0], (len(x), 1)), H)
    pieces = cut(problem, 8)
    u = coarse_chebyshev(problem, iterations=600, every=4, pieces=pieces)
    assert problem.relative_residual(u) <= 1e-10
    motions = piece_motions(PieceSpace(problem, pieces, u))
    assert np.abs(corrected(problem, u, motions=motions) - u).max() <= 1e-10
    assert np.abs(corrected(problem, u + 1e-4 * np.sin(99.0 * x), motions=motions) - u).max() > 1e-7


def test_bodies_alone_and_together_have_the_same_bits() -> None:
    """What touches nothing does not feel the contacts of others."""
    low, high = (pd.shapes.box((0.2, 0.1, 0.1), (4, 2, 2)) for _ in range(2))
    bodies = [pd.Solid(low, 1e6), pd.Solid(pd.TetMesh(high.vertices + np.array([0.0, 3.0, 0.0]), high.tets), 1e5)]
    rng = np.random.default_rng(3)
    velocities = [rng.standard_normal(body.mesh.vertices.shape) for body in bodies]

    def steps(*chosen: int) -> Array:
        x = np.concatenate([bodies[i].mesh.vertices for i in chosen])
        v = np.concatenate([velocities[i] for i in chosen])
        scene = pd.Scene(*(bodies[i] for i in chosen), pd.Gravity(), pd.Ground(0.0, friction=0.4))
        problem = step_problem(scene.values(), x, v, H)
        u = problem.unsolved()
        return corrected(problem, u, motions=piece_motions(PieceSpace(problem, cut(problem, 12), u)))

    np.testing.assert_array_equal(steps(0, 1), np.concatenate([steps(0), steps(1)]))
