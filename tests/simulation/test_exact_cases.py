"""The solver against numbers that are known from elsewhere; |x - x*| against the Newton solution of the reference."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from cases import (
    BEAM_STIFFNESS,
    KNOWN_CLASSIC,
    KNOWN_JACOBI,
    KNOWN_SPECTRUM,
    KNOWN_TIP,
    Array,
    Case,
    beam,
    beam_mesh,
    beam_tip,
    hard_start,
    longest_spread,
    sliver_mesh,
    slivers,
)
from runs import arguments_of, displacement, simulator, state_of
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import eigsh

import torchpd as pd
from torchpd.ops.diagonal import step_diagonal
from torchpd.reference import StepProblem
from torchpd.reference.solvers import newton, relative_error

pytestmark = pytest.mark.usefixtures("poisoned")

TIP_TOLERANCE = {torch.float64: 1e-6, torch.float32: 2e-5}


@cache
def solved(youngs: float) -> tuple[StepProblem, Array, Array]:
    """Beam, first iterate and converged displacement."""
    case = beam(youngs)
    problem = case.problem()
    first = problem.first_iterate(case.start)
    return problem, first, newton(problem, first)


@cache
def settled() -> tuple[StepProblem, Array]:
    """The converged step of the beam at rest under gravity."""
    problem = hard_start("random").problem()
    return problem, newton(problem)


def unlike(state: pd.State, item: int, batch: int) -> pd.State:
    """A batch of different environments with `state` as the given item."""
    scale = torch.linspace(0.5, 1.5, batch, dtype=state.positions.dtype, device=state.positions.device)
    scale[item] = 1.0
    return pd.State(state.positions.repeat(batch, 1, 1), state.velocities * scale[:, None, None])


def errors(
    case: Case, solver: pd.Jacobi | pd.Chebyshev, counts: list[int], dtype: torch.dtype, device: torch.device
) -> list[float]:
    """|x - x*| / |x_0 - x*| of the beam at E = 1e6 or 1e5 after some numbers of iterations."""
    _, first, u = solved(float(case.scene.solids[0].youngs[0]))
    found = []
    sim = simulator(case, dtype, device, solver=solver)
    for sim.iterations in counts:
        after = sim(state_of(case, sim), **arguments_of(case, sim))
        found.append(relative_error(displacement(sim, after), u, first))
    return found


@pytest.mark.parametrize("youngs", BEAM_STIFFNESS)
def test_converged_tip_alone_and_in_a_batch(youngs: float, dtype: torch.dtype, device: torch.device) -> None:
    case = beam(youngs)
    # relative error 1e-6 takes 75, 227 and 781 iterations
    sim = simulator(case, dtype, device, iterations={1e4: 150, 1e5: 450, 1e6: 1600}[youngs])
    state = state_of(case, sim)
    alone = sim(state, start="inertial")
    tip = alone.positions[0, beam_tip()].double().mean(dim=0).cpu()
    np.testing.assert_allclose(tip, KNOWN_TIP[youngs], atol=TIP_TOLERANCE[dtype], rtol=0)
    together = sim(unlike(state, 3, 7), start="inertial")
    assert torch.equal(together.positions[3], alone.positions[0])
    assert torch.equal(together.velocities[3], alone.velocities[0])


def test_plain_jacobi_curve(dtype: torch.dtype, device: torch.device) -> None:
    found = errors(beam(1e6), pd.Jacobi(relaxation=1.0, diagonal="plain"), list(KNOWN_JACOBI), dtype, device)
    np.testing.assert_allclose(found, list(KNOWN_JACOBI.values()), atol=1e-5, rtol=0)


def test_classic_chebyshev_curve(dtype: torch.dtype, device: torch.device) -> None:
    solver = pd.Chebyshev("classic", rho=0.995, delay=10, relaxation=1.0)
    found = errors(beam(1e6), solver, list(KNOWN_CLASSIC), dtype, device)
    np.testing.assert_allclose(found, list(KNOWN_CLASSIC.values()), atol=1e-4, rtol=0)


def test_guarded_default_is_ten_times_ahead_of_jacobi(dtype: torch.dtype, device: torch.device) -> None:
    case = beam(1e5)
    early, late = errors(case, pd.Chebyshev(), [100, 256], dtype, device)
    assert early <= 1e-2
    # float32: an iterate is rounded by 6e-8 of |u|, and |u| is at most |x_0 - x*|; an iteration leaves of this what the
    # accelerated rate sqrt(mu) = 1 / 23 does not remove, and each of its four operations rounds
    assert late <= (1e-6 if dtype == torch.float64 else 1e-6 + 4 * 23 * 2.0**-24)
    before, there = errors(case, pd.Jacobi(diagonal="plain"), [995, 996], dtype, device)
    assert before > 1e-2 >= there


def test_extreme_eigenvalues_with_the_diagonal_of_the_plan() -> None:
    """D^-1 A with A from the reference and D from the compiled plan."""
    problem, _, _ = solved(1e6)
    sim = simulator(beam(1e6), torch.float64, solver=pd.Jacobi(diagonal="plain"))
    assert extreme_eigenvalues(problem, sim, weighted=False) == pytest.approx(KNOWN_SPECTRUM, rel=1e-2)


@pytest.mark.filterwarnings("ignore:TetMesh")
@pytest.mark.parametrize("jitter", [0.0, 0.2, 0.35])
def test_weighted_diagonal_of_the_plan_bounds_the_matrix(jitter: float) -> None:
    mesh = beam_mesh(jitter=jitter)
    body = pd.Solid(mesh, youngs=1e6)
    case = Case(pd.Scene(body, pd.Pin(body, np.arange(36))), mesh.vertices, 0.0 * mesh.vertices, 1.0 / 30.0)
    sim = simulator(case, torch.float64)
    assert extreme_eigenvalues(case.problem(), sim, weighted=True)[1] <= 1.0 + 1e-6


def extreme_eigenvalues(problem: StepProblem, sim: pd.Simulator, *, weighted: bool) -> tuple[float, float]:
    _, diagonal = step_diagonal(sim.plan.arrays, sim.material(), sim.time_step, weighted=weighted)
    free = np.flatnonzero(problem.free)
    assert bool(diagonal[~torch.from_numpy(problem.free)].isinf().all())
    half = diags_array(1.0 / np.sqrt(diagonal.numpy()[free]))
    scaled = csc_array(half @ problem.matrix[free][:, free] @ half)
    smallest = eigsh(scaled, k=1, sigma=0.0, which="LM", return_eigenvectors=False)
    largest = eigsh(scaled, k=1, which="LA", return_eigenvectors=False)
    return float(smallest[0]), float(largest[0])


@pytest.mark.parametrize("kind", ["random", "collapsed", "mirrored"])
@pytest.mark.parametrize("batch", [1, 7])
def test_hard_first_iterates(kind: str, batch: int, dtype: torch.dtype, device: torch.device) -> None:
    problem, u = settled()
    case = hard_start(kind)
    sim = simulator(case, dtype, device, iterations=600)
    after = sim(state_of(case, sim, batch), **arguments_of(case, sim, batch))
    assert bool(after.positions.isfinite().all())
    first = problem.first_iterate(case.start)
    assert relative_error(displacement(sim, after, batch - 1), u, first) <= 2e-4


@pytest.mark.parametrize("seed", [0, 1])
def test_energy_never_rises_at_a_restart_on_slivers(seed: int, dtype: torch.dtype, device: torch.device) -> None:
    """The check at u_k acts on the step from u_{k+2} to u_{k+3}, which is then plain descent; rounding of E apart."""
    assert longest_spread(sliver_mesh(seed=seed)) > 3.95
    case = slivers(seed=seed)
    sim = simulator(case, dtype, device)
    state = state_of(case, sim)

    def look(iterations: int) -> tuple[float, int]:
        sim.iterations = iterations
        _, info = sim(state, start="inertial", return_info=True)
        return float(info.energy), int(info.restarts)

    checks = list(range(0, 300, 4))
    energies = [look(k)[0] for k in checks]
    assert np.isfinite(energies).all()
    assert max(energies) == energies[0]
    # k + 1 iterations include the check at u_k
    restarts = [0, *(look(k + 1)[1] for k in checks)]
    restarted = [k for k, before, after in zip(checks, restarts, restarts[1:], strict=False) if after > before]
    assert restarted
    # E is a sum of squares, so its relative rounding is that of a square and of a sum, here of some 200 terms a lane
    slack = 1.0 + 200 * torch.finfo(dtype).eps
    for k in restarted:
        assert look(k + 3)[0] <= look(k + 2)[0] * slack
