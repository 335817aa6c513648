"""Steps by the multilevel solver: how many iterations they take, and that their energy never rises."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import torch
from cases import Array, Case, beam, contact_block, hard_start, slivers
from multilevel_cases import converged, irregular, solved_directly, swing, twist
from runs import arguments_of, displacement, simulator, state_of

import torchpd as pd
from torchpd.reference.solvers import newton, relative_error

pytestmark = pytest.mark.usefixtures("poisoned")

OUTERS = ("lbfgs", "momentum")


def run(sim: pd.Simulator, case: Case, iterations: int) -> tuple[Array, pd.Info]:
    sim.iterations = iterations
    after, info = sim(state_of(case, sim), return_info=True, **arguments_of(case, sim))
    return displacement(sim, after), info


def errors(sim: pd.Simulator, case: Case, solution: Array, counts: list[int]) -> list[float]:
    """|x - x*| / |x_0 - x*| after some numbers of iterations, of which up to a tenth may be trials that fail."""
    first, found = case.problem().first_iterate(case.start), []
    for count in counts:
        u, info = run(sim, case, count)
        assert int(info.restarts) <= 0.1 * count
        found.append(relative_error(u, solution, first))
    return found


@cache
def solved_beam() -> Array:
    problem = beam(1e6).problem()
    return newton(problem, problem.first_iterate("inertial"))


# measured 12/17/34 and 19/35/41; a fifth more is granted
@pytest.mark.slow
@pytest.mark.parametrize(("youngs", "counts"), [(1e6, [16, 22, 42]), (1e8, [24, 42, 50])])
def test_iterations_on_the_box(youngs: float, counts: list[int], device: torch.device) -> None:
    case = swing(11, youngs)
    sim = simulator(case, torch.float64, device, solver=pd.Multilevel())
    found = errors(sim, case, converged(case), counts)
    assert [error <= goal for error, goal in zip(found, (1e-2, 1e-3, 1e-4), strict=True)] == [True] * 3, found


def test_swinging_beam(dtype: torch.dtype, device: torch.device) -> None:
    case = beam(1e6)
    sim = simulator(case, dtype, device, solver=pd.Multilevel())
    assert errors(sim, case, solved_beam(), [40])[0] <= 1e-3


def test_twisted_beam(dtype: torch.dtype, device: torch.device) -> None:
    case = twist(5, 1e6)
    sim = simulator(case, dtype, device, solver=pd.Multilevel())
    # a quarter turn in one step: trials may fail while pieces find their rotation
    u, _ = run(sim, case, 40)
    assert relative_error(u, converged(case), case.problem().first_iterate()) <= 1e-3


def test_float32_reaches_its_floor(device: torch.device) -> None:
    """|u| is rounded by 6e-8 a number and M A >= 0.6 there: 1e-5 leaves room for the 26 elements between the ends."""
    case = beam(1e6)
    sim = simulator(case, torch.float32, device, solver=pd.Multilevel())
    u, _ = run(sim, case, 120)
    assert relative_error(u, solved_beam(), case.problem().first_iterate("inertial")) <= 1e-5


def test_momentum_needs_no_pairs(device: torch.device) -> None:
    case = beam(1e6)
    sim = simulator(case, torch.float64, device, solver=pd.Multilevel("momentum"))
    first, found = case.problem().first_iterate("inertial"), []
    for count in (40, 80):
        u, info = run(sim, case, count)
        assert int(info.restarts) <= 0.1 * count
        found.append(relative_error(u, solved_beam(), first))
    assert found[0] <= 1e-3
    assert found[1] <= 1e-4


@pytest.mark.parametrize("name", ["slivers", "octopus"])
def test_irregular_meshes_with_random_stiffness(name: str, device: torch.device) -> None:
    case = slivers() if name == "slivers" else irregular()
    solution = converged(case)
    sim = simulator(case, torch.float64, device, solver=pd.Multilevel())
    assert errors(sim, case, solution, [40])[0] <= 1e-4
    sim.solver = pd.Chebyshev()
    u, _ = run(sim, case, 160)
    assert relative_error(u, solution, case.problem().first_iterate(case.start)) > 1e-3


@pytest.mark.parametrize("outer", OUTERS)
@pytest.mark.parametrize("kind", ["random", "collapsed", "mirrored"])
def test_hard_first_iterates(kind: str, outer: str, dtype: torch.dtype, device: torch.device) -> None:
    case = hard_start(kind)
    problem = case.problem()
    solution = newton(problem)
    sim = simulator(case, dtype, device, solver=pd.Multilevel(outer))  # type: ignore[arg-type]
    energies = [float(run(sim, case, count)[1].energy) for count in range(0, 60, 3)]
    noise = 1e-5 if dtype == torch.float32 else 1e-12
    assert all(after <= before * (1 + 3 * noise) for before, after in pairwise(energies))
    u, _ = run(sim, case, 150)
    assert relative_error(u, solution, problem.first_iterate(case.start)) <= 3.4e-4


@pytest.mark.parametrize("outer", OUTERS)
def test_energy_never_rises_on_slivers(outer: str, dtype: torch.dtype, device: torch.device) -> None:
    case = slivers()
    sim = simulator(case, dtype, device, solver=pd.Multilevel(outer))  # type: ignore[arg-type]
    energies = [float(run(sim, case, count)[1].energy) for count in range(40)]
    noise = 1e-5 if dtype == torch.float32 else 1e-12
    assert all(after <= before * (1 + noise) for before, after in pairwise(energies))


def test_free_body_keeps_its_momentum(dtype: torch.dtype, device: torch.device) -> None:
    """Linear momentum, at any number of iterations, as by every solver."""
    case = contact_block(height=1.0, velocity=(1.0, 0.0, 0.0), gravity=(0.0, 0.0, 0.0), youngs=1e7)
    spin = np.cross([0.0, 0.0, 5.0], case.positions - case.positions.mean(axis=0))
    case = Case(case.scene, case.positions, case.velocities + spin, case.time_step)
    for iterations in (3, 30):
        sim = simulator(case, dtype, device, solver=pd.Multilevel(), iterations=iterations)
        masses = sim.masses.detach().double().cpu()[:, None]
        track = sim.rollout(state_of(case, sim), 5)
        before = (masses * torch.tensor(case.velocities)).sum(0)
        after = (masses * track.velocities[-1, 0].double().cpu()).sum(0)
        assert float((after - before).norm()) <= 1e3 * torch.finfo(dtype).eps * float(before.norm())


@pytest.mark.parametrize("outer", OUTERS)
@pytest.mark.parametrize("batch", [1, 9])
@pytest.mark.parametrize("direct", [False, True])
def test_tolerance_stops_each_environment_by_itself(outer: str, batch: int, direct: bool, device: torch.device) -> None:
    """Where its error is of the size of the tolerance: less than ten times as large."""
    case = beam(1e5)
    solver = pd.Multilevel(outer)  # type: ignore[arg-type]
    sim = simulator(case, torch.float64, device, solver=solver, tolerance=1e-4, iterations=100)
    if direct:
        solved_directly(sim)
    state = state_of(case, sim, batch)
    state = pd.State(state.positions, state.velocities * torch.linspace(3.0, 0.0, batch, device=device)[:, None, None])
    after, info = sim(state, return_info=True)
    assert bool(info.converged.all())
    assert int(info.iterations.max()) < 60
    sim.tolerance, sim.iterations = 0.0, 300
    exact, beyond = sim(state, return_info=True)
    assert float(beyond.residual.max()) <= 1e-8
    moved = (exact.positions - state.positions).flatten(1).norm(dim=1)
    assert bool(((after.positions - exact.positions).flatten(1).norm(dim=1) <= 1e-3 * moved).all())
    if batch > 1:
        assert len(info.iterations.unique()) > 1


def test_no_iterations_leave_the_first_iterate(dtype: torch.dtype, device: torch.device) -> None:
    case = beam(1e5)
    states = []
    for solver in (pd.Chebyshev(), pd.Multilevel()):
        sim = simulator(case, dtype, device, solver=solver, iterations=0)
        states.append(sim(state_of(case, sim)))
    assert torch.equal(states[0].positions, states[1].positions)
