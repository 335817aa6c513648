"""Stiff bodies that land: faces hover within micrometres of the ground, where `Multilevel` must not lose its way."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import pytest
import torch
from cases import Case
from multilevel_cases import landing
from runs import same_bits, simulator, state_of

import torchpd as pd

pytestmark = pytest.mark.usefixtures("poisoned")

STEPS = 4


@cache
def course(youngs: float, friction: float, size: float, cells: int) -> tuple[Case, list[pd.State]]:
    """A body that lands, step by step, and where each ends: by Jacobi iterations, which no contact can mislead."""
    case = landing(youngs, friction=friction, size=size, cells=cells)
    exact = simulator(case, torch.float64, solver=pd.Chebyshev(), iterations=60000, tolerance=1e-9)
    states = [state_of(case, exact)]
    for _ in range(STEPS):
        after, info = exact(states[-1], return_info=True)
        assert bool(info.converged)
        states.append(after)
    return case, states


def errors(case: Case, states: list[pd.State], iterations: int, solver: pd.Multilevel) -> list[float]:
    """|x - x*| of each step, relative to the way from where inertia alone would lead."""
    sim = simulator(case, torch.float64, solver=solver, iterations=iterations)
    found = []
    for before, solution in pairwise(states):
        course_alone = before.positions + case.time_step * before.velocities
        way = float((course_alone - solution.positions).norm())
        found.append(float((sim(before).positions - solution.positions).norm()) / way)
    return found


@pytest.mark.parametrize(
    ("youngs", "size", "cells", "iterations"),
    [(1e5, 0.02, 4, 64), (1e6, 0.02, 4, 128), (1e6, 0.02, 8, 160), (1e6, 0.1, 4, 64), (1e7, 0.1, 4, 96)],
)
def test_steps_in_which_a_stiff_body_lands_converge(youngs: float, size: float, cells: int, iterations: int) -> None:
    """Where trials that failed led to Jacobi iterations, so many left 0.2 to 1 of the second, third and fifth."""
    case, states = course(youngs, 0.0, size, cells)
    assert max(errors(case, states, iterations, pd.Multilevel())) <= 1e-3


@pytest.mark.parametrize(("youngs", "size", "iterations"), [(1e5, 0.02, 160), (1e5, 0.1, 64), (1e6, 0.1, 128)])
def test_so_they_do_with_friction(youngs: float, size: float, iterations: int) -> None:
    case, states = course(youngs, 0.5, size, 4)
    assert max(errors(case, states, iterations, pd.Multilevel())) <= 1e-3


@pytest.mark.parametrize(("youngs", "size"), [(1e5, 0.02), (1e6, 0.02), (1e6, 0.1), (1e7, 0.1)])
def test_a_tolerance_is_met_where_bodies_land(youngs: float, size: float) -> None:
    """Three times at most, in no more than 160 iterations; of |x - x*| in |x - s|, as `tolerance` is defined."""
    case, states = course(youngs, 0.0, size, 4)
    sim = simulator(case, torch.float64, solver=pd.Multilevel(), iterations=160, tolerance=1e-4)
    fall = torch.zeros(3, dtype=torch.float64)
    fall[1] = -9.81 * case.time_step**2
    for before, solution in pairwise(states):
        after, info = sim(before, return_info=True)
        assert bool(info.converged)
        scale = float((before.positions + case.time_step * before.velocities + fall - solution.positions).norm())
        assert float((after.positions - solution.positions).norm()) <= 3e-4 * scale


@pytest.mark.parametrize("tolerance", [0.0, 1e-3])
@pytest.mark.parametrize(("youngs", "friction"), [(1e6, 0.0), (1e5, 0.5)])
def test_environments_that_land_differently_do_not_know_of_each_other(
    youngs: float, friction: float, tolerance: float, dtype: torch.dtype
) -> None:
    """They share lanes, where some shorten trials or go by Jacobi iterations, some do not, and some are done."""
    case, states = course(youngs, friction, 0.02, 4)
    sim = simulator(case, dtype, solver=pd.Multilevel(), iterations=48, tolerance=tolerance)
    factors = torch.linspace(0.25, 2.0, 5).tolist()
    starts = [(s.positions.to(dtype), f * s.velocities.to(dtype)) for f in factors for s in states[:STEPS]][:17]
    positions, velocities = (torch.cat(parts) for parts in zip(*starts, strict=True))
    # from their present shape; the first iterate of a step is so near that none has trials to shorten
    together, info = sim(pd.State(positions, velocities), start=positions, return_info=True)
    assert int(info.restarts.min()) <= 2
    assert int(info.restarts.max()) >= 9
    assert (len(set(info.iterations.tolist())) > 1) == (tolerance > 0.0)
    for i, (x, v) in enumerate(starts):
        alone = sim(pd.State(x, v), start=x)
        assert same_bits(alone, pd.State(together.positions[i : i + 1], together.velocities[i : i + 1]))
