"""Where the soft stop ends a step: about so much of the way from the targets is then left to go."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from cases import Array, beam, contact_block
from multilevel_cases import plate
from runs import displacement, simulator, state_of

import torchpd as pd
from torchpd.reference import StepProblem, step_problem
from torchpd.reference.solvers import classic_omegas, guarded_chebyshev, newton

pytestmark = pytest.mark.usefixtures("poisoned")


def problem_of(sim: pd.Simulator, state: pd.State, item: int = 0) -> StepProblem:
    x, v = (part[item].double().cpu().numpy() for part in state)
    return step_problem(sim.scene.values(), x, v, sim.time_step)


def left(sim: pd.Simulator, state: pd.State, after: pd.State, solution: Any = None) -> float:
    """|u - u*| / |u* - s|, the way being at least that of gravity."""
    problem = problem_of(sim, state)
    solution = newton(problem) if solution is None else solution
    fall = sim.time_step**2 * float(sim.gravity.norm()) * len(problem.free) ** 0.5
    way = max(float(np.linalg.norm(solution - problem.target)), fall)
    return float(np.linalg.norm(displacement(sim, after) - solution)) / way


@cache
def swung(youngs: float) -> Array:
    """u* [V, 3] of the beam."""
    return newton(beam(youngs).problem())


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
        (1e6, pd.Multilevel()),
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
    assert 0.01 * tolerance < left(sim, state, after, swung(youngs)) < 3 * tolerance


@pytest.mark.parametrize("youngs", [3e4, 1e6])
def test_a_landing_plate_goes_on(youngs: float, device: torch.device) -> None:
    """Slivers make its first iterations change almost nothing."""
    sim, state = plate(youngs)
    sim.iterations = 6000
    solution = displacement(sim, sim(state))
    sim, state = sim.to(device), state.to(device)
    sim.tolerance, sim.iterations = 1e-2, 4000
    after, info = sim(state, return_info=True)
    assert bool(info.converged)
    assert left(sim, state, after, solution) < 1e-2


def hung(kind: str, youngs: float) -> tuple[pd.Simulator, pd.State, Any]:
    """A bar at rest that begins to swing about an edge or a corner, the state, and the solution of its step."""
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (10, 2, 2))
    body, end = pd.Solid(mesh, youngs), mesh.vertices[:, 0] == 0.0
    edge = end & (mesh.vertices[:, 1] == 0.0)
    pin = {
        "hinge": pd.Pin(body, edge),
        "soft hinge": pd.Pin(body, edge, stiffness=1e5),
        "corner": pd.Pin(body, edge & (mesh.vertices[:, 2] == 0.0)),
    }[kind]
    sim = pd.Simulator(pd.Scene(body, pin, pd.Gravity()), 1 / 30, 2000, dtype=torch.float64, progress=False)
    state = sim.rest_state()
    return sim, state, newton(problem_of(sim, state), tolerance=1e-8)


@pytest.mark.parametrize(("kind", "stiffest"), [("hinge", 1e9), ("soft hinge", 1e9), ("corner", 1e8)])
def test_parts_that_turn_are_not_taken_for_still(kind: str, stiffest: float, device: torch.device) -> None:
    """The matrix of projective dynamics resists their turning, and first iterates hardly move: 0.8 were left.

    From a corner, at 1e9 Pa, iterations stall on their way, with 28 times the tolerance left: see docs/limits.md.
    """
    for youngs in (1e7, stiffest):
        sim, state, solution = hung(kind, youngs)
        sim, state = sim.to(device), state.to(device)
        sim.solver = pd.Multilevel()
        for sim.tolerance in (1e-1, 1e-2, 1e-3):
            after, info = sim(state, return_info=True)
            assert bool(info.converged)
            assert left(sim, state, after, solution) < 3 * sim.tolerance, youngs


def test_stops_at_no_turning_point(device: torch.device) -> None:
    """Modes swing under Chebyshev, and some iterations change little of a large error: up to 31 times the tolerance."""
    case = beam(1e6)
    sim = simulator(case, torch.float64, device, iterations=2000)
    state = state_of(case, sim)
    for _ in range(3):
        solution = newton(problem_of(sim, state))
        for sim.tolerance in np.geomspace(0.1, 1e-4, 25):
            after, info = sim(state, return_info=True)
            assert bool(info.converged)
            assert left(sim, state, after, solution) < 1.2 * sim.tolerance
        state = after


def test_very_slow_modes_are_known_to_be(device: torch.device) -> None:
    """Slower than the most momentum is for: the first iteration was a stop, with three times the tolerance left."""
    sim, state, solution = hung("hinge", 1e9)
    sim, state = sim.to(device), state.to(device)
    sim.iterations = 20_000
    for sim.tolerance in (0.3, 0.1):
        after, info = sim(state, return_info=True)
        assert bool(info.converged)
        assert left(sim, state, after, solution) < sim.tolerance


@pytest.mark.parametrize("outer", ["lbfgs", "momentum"])
def test_material_that_changes_is_judged_as_such(outer: Any, device: torch.device) -> None:
    """One tetrahedron a thousand times as stiff: up to seventy times the tolerance were left."""
    case = beam(1e5)
    sim = simulator(case, torch.float64, device, solver=pd.Multilevel(outer), iterations=2000)
    state = state_of(case, sim)
    stiffness = sim.stiffness.clone()
    stiffness[..., stiffness.shape[-1] // 2] *= 1000.0
    sim.set_material(stiffness=stiffness)
    exact = simulator(case, torch.float64, solver=pd.Chebyshev(), iterations=20_000)
    exact.set_material(stiffness=stiffness.cpu())
    solution = displacement(exact, exact(state.to("cpu")))
    for sim.tolerance in (1e-2, 1e-3):
        after, info = sim(state, return_info=True)
        assert bool(info.converged)
        assert left(sim, state, after, solution) < 3 * sim.tolerance


SOLVERS = [pd.Jacobi(), pd.Chebyshev(), pd.Multilevel()]


def at_once(solver: pd.Solver) -> int:
    """Iterations of a step that is solved when it begins: until the small problem is there nobody knows."""
    return 4 if isinstance(solver, pd.Multilevel) else 2


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
    assert int(info.iterations) <= at_once(solver)


@pytest.mark.parametrize("solver", SOLVERS, ids=str)
def test_free_fall_stops(solver: pd.Solver, dtype: torch.dtype, device: torch.device) -> None:
    """Nothing but gravity acts, and nothing but rounding is left to do."""
    case = contact_block(velocity=(0.0, -1.0, 0.0), youngs=1e5)
    sim = simulator(case, dtype, device, solver=solver, tolerance=1e-3, iterations=100)
    _, info = sim(state_of(case, sim), return_info=True)
    assert bool(info.converged)
    assert int(info.iterations) <= at_once(solver)


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
