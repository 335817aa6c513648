"""Every iterate is the one that the reference computes, with every effect, solver and precision."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import pytest
import torch
from cases import Array, Case
from iterate_cases import CASES, RESTARTS, SOLVERS, restarting
from runs import (
    arguments_of,
    displacement,
    ended_by_rounding,
    reference_runs,
    residual_error,
    rounded_problem,
    simulator,
    state_of,
)

import torchpd as pd
from torchpd.reference import StepProblem
from torchpd.reference.solvers import Iterates

pytestmark = pytest.mark.usefixtures("poisoned")

COUNTS = (1, 2, 5, 6, 20)


# Rounding of an iterate: some fifty operations an iteration, and the extrapolation (omega < 2) lets differences grow
# like k^2 at worst: 50 * 20^2 u is 2e-12 in float64 and 1e-3 in float32. Errors of random sign stay well below that; a
# bound of 1e-3 could not see a wrong term, so a fiftieth of it is asked for.
TOLERANCE = {torch.float64: 1e-12, torch.float32: 2e-5}

# m: how a body turns that a diverging solver has torn apart is a matter of rounding
DIVERGED = 100.0


def tolerance_of(problem: StepProblem, displacement: Array, dtype: torch.dtype) -> float:
    """The bound, relative to the displacement."""
    return max(TOLERANCE[dtype], ended_by_rounding(problem, displacement))


@lru_cache(maxsize=1)
def prepared(
    case: Callable[[], Case], dtype: torch.dtype, device: torch.device
) -> tuple[Case, StepProblem, pd.Simulator]:
    """What a case is for every solver: tests of one follow each other."""
    scene = case()
    return scene, rounded_problem(scene, dtype), simulator(scene, dtype, device)


@lru_cache(maxsize=2)
def first_of_case(case: Callable[[], Case], dtype: torch.dtype, device: torch.device, *, weighted: bool) -> Array:
    """The first iterate of the reference, which of a solver depends on its diagonal alone."""
    scene, problem, _ = prepared(case, dtype, device)
    first = problem.with_diagonal(weighted=weighted).first_iterate(scene.start)
    first.setflags(write=False)
    return first


@pytest.mark.parametrize("solver", SOLVERS.values(), ids=SOLVERS)
@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_iterates_are_those_of_the_reference(
    case: Callable[[], Case], solver: pd.Jacobi | pd.Chebyshev, dtype: torch.dtype, device: torch.device
) -> None:
    scene, problem, sim = prepared(case, dtype, device)
    first = first_of_case(case, dtype, device, weighted=solver.settings()["weighted"])
    sim.solver = solver
    for expected in reference_runs(problem, first, solver, COUNTS):
        if np.abs(expected.displacement).max() > DIVERGED:
            break
        sim.iterations = expected.iterations
        for batch in (1, 9):  # lanes run over elements, and over environments
            after, info = sim(state_of(scene, sim, batch), **arguments_of(scene, sim, batch), return_info=True)
            check_iterate(problem, expected, sim, after, info, item=batch - 1)


def test_a_restart_counts_from_the_second_next_iteration(dtype: torch.dtype, device: torch.device) -> None:
    """E(u_16) has risen, so omega_18 is 1: u_19 is the first that tells."""
    scene = restarting()
    problem = rounded_problem(scene, dtype)
    first = problem.first_iterate(scene.start)
    sim = simulator(scene, dtype, device, solver=RESTARTS)
    for expected in reference_runs(problem, first, RESTARTS, (16, 17, 18, 19, 20)):
        sim.iterations = expected.iterations
        assert expected.restarts == [16] * (sim.iterations > 16)
        for batch in (1, 9):
            after, info = sim(state_of(scene, sim, batch), return_info=True)
            check_iterate(problem, expected, sim, after, info, item=batch - 1)


def check_iterate(
    problem: StepProblem, expected: Iterates, sim: pd.Simulator, after: pd.State, info: pd.Info, *, item: int
) -> None:
    tolerance = tolerance_of(problem, expected.displacement, sim.dtype)
    u = displacement(sim, after, item)
    assert np.abs(u - expected.displacement).max() <= tolerance * np.abs(expected.displacement).max(), sim.iterations
    x = after.positions[item].double().cpu().numpy()
    # one more rounding, of the sum x + u
    assert np.abs(x - problem.positions - u).max() <= 2 * torch.finfo(sim.dtype).eps * np.abs(x).max()
    assert int(info.restarts[item]) == len(expected.restarts)
    assert int(info.iterations[item]) == sim.iterations
    # E and |r|^2 are sums of squares that the iterate moves by its own relative error; |r| is 1e-3 of its start or more
    assert float(info.energy[item]) == pytest.approx(expected.energies[-1][1], rel=4 * tolerance)
    assert residual_error(problem, expected, float(info.residual[item]), sim.dtype) <= 1e3 * tolerance
