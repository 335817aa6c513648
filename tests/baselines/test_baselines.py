"""Methods of the literature end at the same minimum, and do what their textbooks say on a linear problem."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from cases import Case, box, contact_block, sliver_mesh
from runs import simulator
from threadpoolctl import threadpool_info, threadpool_limits

import torchpd as pd
from torchpd.baselines import (
    BASELINES,
    Baseline,
    GaussSeidel,
    colour_vertices,
    dense_direct,
    factorised,
    run_baseline,
    two_stage_rho,
)
from torchpd.baselines.compiled_step import CompiledStep, CountedStep
from torchpd.baselines.dense_direct import DENSE, DenseDirect
from torchpd.baselines.newton_krylov import NewtonKrylov
from torchpd.reference import StepProblem, step_problem
from torchpd.reference.solvers import newton, preconditioned_lbfgs, relative_error, solve_with_contact


def swinging() -> Case:
    """A short beam: spectral radius of Jacobi about 0.98."""
    mesh = pd.TetMesh(*box((0.6, 0.2, 0.2), (6, 2, 2)))
    body = pd.Solid(mesh, youngs=3e4)
    velocities = np.zeros_like(mesh.vertices)
    velocities[:, 1] = -5.0 * mesh.vertices[:, 0] ** 2
    scene = pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity())
    return Case(scene, np.array(mesh.vertices), velocities, 1 / 30)


@pytest.fixture(scope="module")
def problem() -> StepProblem:
    return swinging().problem()


@pytest.fixture(scope="module")
def solution(problem: StepProblem) -> np.ndarray:
    return newton(problem)


# Iterations to a relative error of 1e-6, rounded up generously; a method that stalls needs many times more.
ENOUGH = {
    "Jacobi, NumPy": 1500,
    "classic Chebyshev, NumPy": 300,
    "guarded Chebyshev, NumPy": 300,
    "Gauss-Seidel": 800,
    "Gauss-Seidel + Chebyshev": 200,
    "PCG global step": 60,
    "direct global step": 60,
    "direct global step + Chebyshev": 30,
    "Newton": 12,
    "Newton-PCG with M": 12,
    "L-BFGS": 120,
    "L-BFGS with A^-1": 25,
}


def compiled(problem: StepProblem) -> CompiledStep:
    return CompiledStep(**{field.name: getattr(problem, field.name) for field in dataclasses.fields(StepProblem)})


def everything(seed: int = 0) -> StepProblem:
    """Slivers, each of its own stiffness, with hard and soft pins, gravity, drag and forces, out of shape."""
    rng = np.random.default_rng(seed)
    mesh = sliver_mesh((3, 2, 2), seed=seed)
    body = pd.Solid(mesh, youngs=10.0 ** rng.uniform(4.0, 6.0, len(mesh.tets)))
    pins = [pd.Pin(body, [0, 3]), pd.Pin(body, [5, 9], stiffness=2e4)]
    values = pd.Scene(body, *pins, pd.Gravity(), pd.Damping(2.0)).values()
    positions = mesh.vertices + 0.01 * rng.standard_normal(mesh.vertices.shape)
    velocities, forces = rng.standard_normal((2, *positions.shape))
    targets = values.pin_targets + 0.01 * rng.standard_normal(values.pin_targets.shape)
    return step_problem(values, positions, velocities, 0.02, forces=forces, pin_targets=targets)


def test_the_compiled_step_pulls_a_stretched_tetrahedron_back() -> None:
    """Stretched by s along x: E = w V / 2 (s - 1)^2, and the force is its derivative; inertia by its formula."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    values = pd.Scene(pd.Solid(pd.TetMesh(vertices, [[0, 1, 2, 3]]), youngs=1e4, density=600.0)).values()
    step = compiled(step_problem(values, vertices, 0.0 * vertices, 0.1))
    u = vertices * [0.3, 0.0, 0.0]
    # 25 kg at each vertex, m / h^2 = 2500 N/m, and one of them has moved by 0.3 m
    assert step.energy(u) == pytest.approx(1e4 / 6.0 / 2.0 * 0.09 + 2500.0 / 2.0 * 0.09, rel=1e-13)
    pull = 1e4 / 6.0 * 0.3
    expected = [[-pull, 0.0, 0.0], [pull + 2500.0 * 0.3, 0.0, 0.0], [0.0] * 3, [0.0] * 3]
    assert np.allclose(step.gradient(u), expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("size", [0.0, 0.01, 1.0], ids=["still", "near", "crumpled"])
def test_the_compiled_step_is_that_of_the_reference(size: float) -> None:
    """E, grad E and both, to rounding, and each of them counts as one local step."""
    problem = everything()
    step = compiled(problem)
    u = size * np.random.default_rng(1).standard_normal(problem.positions.shape)
    energy, gradient = problem.evaluate(u)
    found = [step.evaluate(u), (step.energy(u), step.gradient(u))]
    assert step.calls == [3]
    for own, slopes in found:
        assert own == pytest.approx(energy, rel=1e-12)
        assert np.allclose(slopes, gradient, rtol=0, atol=1e-11 * np.abs(gradient).max())
        assert not slopes[~problem.free].any()


def test_local_steps_are_compiled_but_for_those_of_the_twins(problem: StepProblem) -> None:
    for method in BASELINES.values():
        seen: list[type] = []
        asked = Baseline(lambda step, _, seen=seen: seen.append(type(step)) or (lambda *_: None),
                         compiled_twin=method.compiled_twin)  # fmt: skip
        run_baseline(asked, problem, problem.first_iterate(), 1)
        assert seen == [CountedStep if method.compiled_twin else CompiledStep]
        assert ("C++" in method.parts) == (method.compiled_twin is None)


def test_blas_has_the_threads_of_torch_while_a_method_runs(problem: StepProblem) -> None:
    seen: list[set[int]] = []

    def threads() -> set[int]:
        return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

    method = Baseline(lambda *_: lambda *_: seen.append(threads()))
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        with threadpool_limits(2, user_api="blas"):
            run_baseline(method, problem, problem.first_iterate(), 1)
            assert threads() == {2}
    finally:
        torch.set_num_threads(before)
    assert seen == [{1}]


@pytest.mark.parametrize("name", ["direct global step", "direct global step + Chebyshev", "L-BFGS with A^-1"])
def test_one_global_step_solves_a_free_fall(name: str) -> None:
    """Along translations E is the quadratic of A: u_1 = u_0 - A^-1 grad E(u_0) falls as Newton's apple, and stays."""
    case = contact_block(height=5.0, velocity=(1.0, 2.0, 3.0))
    problem = case.problem()
    fall = np.tile(case.time_step * (np.array([1.0, 2.0, 3.0]) + case.time_step * np.array([0.0, -9.8, 0.0])), (64, 1))
    trace = run_baseline(BASELINES[name], problem, np.zeros_like(fall), 30)
    for displacement in (trace.displacements[1], trace.displacements[trace.last]):
        assert np.allclose(displacement, fall, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["direct global step + Chebyshev", "L-BFGS with A^-1"])
def test_the_first_step_is_that_of_the_factorised_matrix(name: str, problem: StepProblem) -> None:
    """A bounds the Hessian, so that it is no shorter than that."""
    first, free = problem.first_iterate(), problem.free
    expected = first.copy()
    expected[free] -= np.linalg.solve(problem.matrix[free][:, free].toarray(), problem.gradient(first)[free])
    found = run_baseline(BASELINES[name], problem, first, 1).displacements[1]
    assert np.allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_a_step_that_is_too_long_is_halved() -> None:
    """Ten times too long on a quadratic: 10, 5 and 2.5 rise, 1.25 of the way falls by enough."""
    problem = contact_block(velocity=(1.0, 0.0, 0.0), gravity=(0.0, 0.0, 0.0)).problem()
    zero = np.zeros_like(problem.positions)
    with pytest.raises(RuntimeError, match=r"iteration 0.*backtrack=True"):
        preconditioned_lbfgs(problem, zero, factorised(problem), iterations=1, relaxation=10.0)
    found = preconditioned_lbfgs(problem, zero, factorised(problem), iterations=1, relaxation=10.0, backtrack=True)
    assert np.allclose(found, 1.25 * problem.target, rtol=0, atol=1e-12)


def test_chebyshev_on_the_direct_step_has_the_iterates_of_the_dense_inverse(problem: StepProblem) -> None:
    name = "direct global step + Chebyshev"
    first = problem.first_iterate()
    found = run_baseline(BASELINES[name], problem, first, 25).displacements
    method = DenseDirect(simulator(swinging(), torch.float64), problem)
    omegas = DENSE[f"{name}, dense"](problem, first, 25)
    assert max(omegas) > 1.0
    for count in (1, 11, 25):
        expected = method.iterate(torch.from_numpy(first), omegas[:count]).numpy()
        assert relative_error(found[count], expected, first) < 1e-9


@pytest.mark.parametrize("name", BASELINES)
def test_every_method_finds_the_minimum(name: str, problem: StepProblem, solution: np.ndarray) -> None:
    first = problem.first_iterate()
    trace = run_baseline(BASELINES[name], problem, first, ENOUGH[name])
    assert relative_error(trace.displacements[trace.last], solution, first) < 1e-6
    assert trace.local_steps[trace.last] >= trace.last > 1
    seconds = [trace.seconds[k] for k in sorted(trace.seconds)]
    assert seconds == sorted(seconds)
    assert seconds[0] == 0.0
    # pins stay where they are
    assert not trace.displacements[trace.last][~problem.free].any()


@pytest.mark.parametrize("name", DENSE)
def test_dense_inverses_have_the_iterates_of_the_factorisation(
    name: str, dtype: torch.dtype, device: torch.device
) -> None:
    """On the device, recorded or not; and with Chebyshev they are at 1e-4 after twenty, without it not."""
    case = swinging()
    problem = case.problem()
    sim = simulator(case, dtype, device)
    first = problem.first_iterate()
    omegas = DENSE[name](problem, first, 60)
    method = DenseDirect(sim, problem)
    play = method.recorded(torch.as_tensor(first, dtype=dtype, device=device), omegas)
    rounding = {torch.float32: 1e-4, torch.float64: 1e-11}[dtype]
    for _ in range(2):
        found = play().double().cpu().numpy()
        assert not found[~problem.free].any()
        expected = first
        before, solve = first, factorised(problem)
        for omega in omegas:
            stepped = expected - solve(problem.gradient(expected))
            expected, before = before + omega * (stepped - before), expected
        assert relative_error(found, expected, first) < rounding
    solution = newton(problem)
    twenty = method.iterate(torch.as_tensor(first, dtype=dtype, device=device), omegas[:20]).double().cpu().numpy()
    reached = relative_error(twenty, solution, first)
    assert (reached < 1e-4) == ("Chebyshev" in name)
    assert method.bytes == len(problem.free) ** 2 * torch.finfo(dtype).bits // 8


def test_dense_inverses_refuse_contacts_and_large_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    resting = contact_block(pd.Ground(0.0))
    with pytest.raises(ValueError, match=r"no contacts.*1 planes"):
        DenseDirect(simulator(resting, torch.float64), resting.problem())
    monkeypatch.setattr(dense_direct, "MOST_VERTICES", 40)
    case = swinging()
    with pytest.raises(ValueError, match=r"vertices.* 40 .*63"):
        DenseDirect(simulator(case, torch.float64), case.problem())


def test_colours_separate_neighbours(problem: StepProblem) -> None:
    colours = colour_vertices(problem.matrix)
    entries = problem.matrix.tocoo()
    apart = entries.row != entries.col
    assert (colours[entries.row[apart]] != colours[entries.col[apart]]).all()
    # greedy colouring needs no more than the largest degree + 1; Kuhn's grid has 14 neighbours
    assert colours.max() + 1 <= 15


def test_a_sweep_is_the_triangle_of_the_coloured_matrix(problem: StepProblem) -> None:
    """One sweep from zero solves (L + D) d = r in the order of the colours; there and back is the symmetric form."""
    sweep, both = GaussSeidel(problem), GaussSeidel(problem, symmetric=True)
    order = np.concatenate(sweep.groups)
    matrix = problem.matrix[sweep.free][:, sweep.free].toarray()[np.ix_(order, order)]
    residual = np.where(problem.free[:, None], np.random.default_rng(0).standard_normal((len(problem.free), 3)), 0.0)
    lower, diagonal = np.tril(matrix), np.diag(np.diag(matrix))
    right = residual[sweep.free][order]
    expected = np.linalg.solve(lower, right)
    assert np.allclose(sweep(residual)[sweep.free][order], expected, rtol=1e-12)
    # (U + D)^-1 D (L + D)^-1
    assert np.allclose(both(residual)[both.free][order], np.linalg.solve(lower.T, diagonal @ expected), rtol=1e-12)


def test_two_stage_rho_lies_below_the_spectral_radius(problem: StepProblem) -> None:
    """And near it, for Jacobi with the plain diagonal near the solution, where the iteration is linear."""
    free, diagonal = problem.free, problem.plain_diagonal
    half = 1.0 / np.sqrt(diagonal[free])
    scaled = half[:, None] * problem.matrix[free][:, free].toarray() * half
    largest = 1.0 - np.linalg.eigvalsh(scaled)[0]
    rho = two_stage_rho(problem, problem.first_iterate(), lambda g: g / diagonal[:, None], iterations=64)
    assert 2.0 * largest - 1.0 < rho < 0.5 * (1.0 + largest)


def test_newton_krylov_has_the_energy_of_the_reference_and_its_derivatives(problem: StepProblem) -> None:
    """E and grad E of the compiled elements against NumPy's, H p against central differences of grad E."""
    passes = [0]
    method = NewtonKrylov(problem, passes)
    rng = np.random.default_rng(0)
    u, p = (np.where(problem.free[:, None], rng.normal(size=problem.positions.shape), 0.0) for _ in range(2))
    u *= 0.01
    energy, gradient = method.evaluate(torch.from_numpy(u))
    expected, slopes = problem.evaluate(u)
    assert energy == pytest.approx(expected, rel=1e-10)
    assert np.allclose(gradient, slopes, rtol=0, atol=1e-10 * np.abs(slopes).max())
    product = method.product(torch.from_numpy(u), torch.from_numpy(p)).numpy()
    step = 1e-6
    differences = (problem.gradient(u + step * p) - problem.gradient(u - step * p)) / (2.0 * step)
    assert np.allclose(product, differences, rtol=0, atol=1e-6 * np.abs(product).max())
    assert passes == [2]


def test_newton_krylov_holds_and_frees_what_the_step_does(problem: StepProblem) -> None:
    """M is zero at the held vertices and nowhere else."""
    method = NewtonKrylov(problem, [0])
    field = torch.from_numpy(np.random.default_rng(0).normal(size=problem.positions.shape))
    image = torch.ops.torchpd.precondition(field[None], method.levels)[0].numpy()
    assert np.array_equal(np.any(image != 0.0, axis=1), problem.free)


def test_memory_is_watched_and_contacts_are_refused(problem: StepProblem) -> None:
    trace = run_baseline(BASELINES["direct global step"], problem, problem.first_iterate(), 2, memory=True)
    # at least the iterates that are kept, and the sparse operator
    assert trace.peak_bytes > problem.groups[0].operator.data.nbytes
    resting = contact_block(pd.Ground(0.0)).problem()
    with pytest.raises(ValueError, match=r"no contacts.*1 planes"):
        run_baseline(BASELINES["Newton"], resting, resting.first_iterate(), 1)
    assert run_baseline(BASELINES["guarded Chebyshev, NumPy"], resting, resting.first_iterate(), 2).last == 2


@pytest.mark.parametrize("ground", [pd.Ground(0.0), pd.Ground(-0.001)], ids=["resting", "landing"])
def test_newton_krylov_finds_contacts(ground: pd.Ground) -> None:
    case = contact_block(ground, velocity=(0.0, -1.0, 0.0), youngs=1e5)
    problem = case.problem()
    first, solution = problem.first_iterate(), solve_with_contact(problem)
    trace = run_baseline(BASELINES["Newton-PCG with M"], problem, first, 20)
    assert relative_error(trace.displacements[trace.last], solution, first) < 1e-6
    assert sorted(trace.displacements) == list(range(trace.last + 1))
    assert trace.local_steps[trace.last] > trace.last > 1
    rough = contact_block(pd.Ground(0.0, friction=0.5)).problem()
    with pytest.raises(ValueError, match="friction"):
        run_baseline(BASELINES["Newton-PCG with M"], rough, rough.first_iterate(), 1)
