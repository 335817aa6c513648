"""Where the soft stop ends a step: about so much of the way from the targets is then left to go."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from cases import beam, contact_block
from runs import displacement, simulator, state_of
from test_multilevel_scenes import plate

import torchpd as pd
from torchpd.reference import StepProblem, step_problem
from torchpd.reference_solvers import classic_omegas, guarded_chebyshev, newton

pytestmark = pytest.mark.usefixtures("poisoned")


def problem_of(sim: pd.Simulator, state: pd.State, item: int = 0) -> StepProblem:
    x, v = (part[item].double().cpu().numpy() for part in state)
    return step_problem(sim.scene.values(), x, v, sim.time_step)


def left(sim: pd.Simulator, state: pd.State, after: pd.State, solution: Any = None) -> float:
    """|u - u*| / |u* - s|, the way being at least that of gravity."""
    problem = problem_of(sim, state)
    solution = newton(problem) if solution is None else solution
    fall = sim.time_step**2 * float(sim.gravity.norm()) * problem.free.sum() ** 0.5
    way = max(float(np.linalg.norm(solution - problem.target)), fall)
    return float(np.linalg.norm(displacement(sim, after) - solution)) / way


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3])
@pytest.mark.parametrize(
    ("youngs", "solver"),
    [
        (1e4, pd.Jacobi()),
        (1e4, pd.Jacobi(relaxation=1.9)),
        (1e4, pd.Chebyshev()),
        (1e6, pd.Chebyshev()),
        (1e7, pd.Chebyshev()),
        # half of the true radius' distance from one, and six times
        (1e6, pd.Chebyshev("classic", rho=0.9999, diagonal="weighted")),
        (1e6, pd.Chebyshev("classic", rho=0.995, diagonal="weighted")),
        (1e7, pd.Multilevel()),
        (1e6, pd.Multilevel("lbfgs")),
        (1e6, pd.Multilevel("momentum")),
    ],
    ids=str,
)
def test_a_stop_leaves_about_the_tolerance(
    youngs: float, solver: pd.Solver, tolerance: float, device: torch.device
) -> None:
    """Within a factor of three, of iterations whose slowest mode is known by a bound; and not a hundredth of it."""
    case = beam(youngs)
    sim = simulator(case, torch.float64, device, solver=solver, tolerance=tolerance, iterations=4000)
    state = state_of(case, sim)
    after, info = sim(state, return_info=True)
    assert bool(info.converged)
    assert 0.01 * tolerance < left(sim, state, after) < 3 * tolerance


@pytest.mark.parametrize("youngs", [3e4, 1e6])
def test_a_landing_plate_goes_on(youngs: float, device: torch.device) -> None:
    """Slivers make its first iterations change almost nothing."""
    sim, state = plate(youngs)
    sim.iterations = 6000
    solution = displacement(sim, sim(state))
    sim, state = sim.to(device), state.to(device)
    sim.tolerance, sim.iterations = 1e-2, 1000
    after, info = sim(state, return_info=True)
    assert bool(info.converged)
    assert left(sim, state, after, solution) < 1e-2


SOLVERS = [pd.Jacobi(), pd.Chebyshev(), pd.Multilevel()]


@pytest.mark.parametrize("solver", SOLVERS, ids=str)
def test_a_common_motion_changes_nothing(solver: pd.Solver, device: torch.device) -> None:
    """A spinning cube in free fall, and the same at 100 m/s."""
    case = contact_block(youngs=1e5)
    sim = simulator(case, torch.float64, device, solver=solver, tolerance=1e-3, iterations=2000)
    state = state_of(case, sim)
    spin = torch.tensor([1.0, 3.0, 5.0], dtype=torch.float64, device=device)
    turning = torch.linalg.cross(spin.expand_as(state.positions), state.positions)
    state = pd.State(state.positions, state.velocities + turning)
    course = torch.tensor([60.0, -80.0, 0.0], dtype=torch.float64, device=device)
    after, info = sim(state, return_info=True)
    fast, other = sim(pd.State(state.positions, state.velocities + course), return_info=True)
    assert bool(info.converged)
    assert 1 < int(info.iterations) == int(other.iterations)
    torch.testing.assert_close(fast.positions, after.positions + sim.time_step * course, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("solver", SOLVERS, ids=str)
def test_a_body_at_rest_stops(solver: pd.Solver, dtype: torch.dtype, device: torch.device) -> None:
    """It sags and moves by less than rounding, but gravity and elasticity are what it was."""
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (5, 2, 2))
    body = pd.Solid(mesh, 1e5)
    scene = pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity(), pd.Damping(4.0))
    slow = pd.Simulator(scene, 1 / 30, 30, pd.Multilevel(), dtype=torch.float64, progress=False)
    track = slow.rollout(slow.rest_state(), 400)
    sim = pd.Simulator(scene, 1 / 30, 100, solver, dtype=dtype, progress=False, tolerance=1e-3).to(device)
    state = pd.State(*(part[-1].to(device, dtype) for part in (track.positions, track.velocities)))
    assert float(state.velocities.norm()) < 1e-9
    _, info = sim(state, return_info=True)
    assert bool(info.converged)
    assert int(info.iterations) <= 2


@pytest.mark.parametrize("solver", SOLVERS, ids=str)
def test_free_fall_stops(solver: pd.Solver, dtype: torch.dtype, device: torch.device) -> None:
    """Nothing but gravity acts, and nothing but rounding is left to do."""
    case = contact_block(velocity=(0.0, -1.0, 0.0), youngs=1e5)
    sim = simulator(case, dtype, device, solver=solver, tolerance=1e-3, iterations=100)
    _, info = sim(state_of(case, sim), return_info=True)
    assert bool(info.converged)
    assert int(info.iterations) <= 2


def test_a_restart_is_no_stop(device: torch.device) -> None:
    """An iteration without momentum changes little: judged as one with the most of it, this one would end the step."""
    case = beam(1e7)
    sim = simulator(case, torch.float64, device, iterations=2000)
    state = state_of(case, sim)
    problem = problem_of(sim, state)
    solution, u = newton(problem), [problem.first_iterate()]
    restarts = guarded_chebyshev(problem, u[0], iterations=800, observe=lambda _, iterate: u.append(iterate)).restarts
    k = restarts[0] + 2
    limit = classic_omegas(1.0 - 1.9 * problem.smallest_ratio, 0, 5000)[-1] - 1.0
    supposed = float(np.linalg.norm(u[k + 1] - u[k])) / (1.0 - limit**0.5)
    sim.tolerance = 2.0 * supposed / float(np.linalg.norm(u[k] - problem.target))
    assert float(np.linalg.norm(u[k + 1] - solution)) > 5.0 * supposed
    after, info = sim(state, return_info=True)
    assert int(info.restarts) > 0
    assert int(info.iterations) > k + 1
    assert left(sim, state, after, solution) < 3 * sim.tolerance
