"""Inexact Newton in the reference: a closed form, dense Newton, stiff cloth and beams, momentum."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from cases import Case
from mixed_scenes import CASES
from multilevel_cases import Tables, slabs, swing
from newton_cases import chain, chain_displacement, falling_cloth, free_body, strip
from numpy.typing import NDArray
from runs import simulator
from scipy.linalg import eigh
from stretch_cases import small_body

import torchpd as pd
from torchpd.reference import StepProblem
from torchpd.reference.inexact_newton import NewtonModel, inexact_newton
from torchpd.reference.pieces import cut
from torchpd.reference.solvers import newton, relative_error

Array = NDArray[np.float64]


def tables(case: Case) -> Tables:
    return Tables(simulator(case, torch.float64, solver=pd.Multilevel()).plan)


def solved(case: Case, iterations: int) -> tuple[StepProblem, Array]:
    problem = case.problem()
    first = problem.first_iterate(case.start)
    return problem, inexact_newton(problem, first, tables(case), cut(problem), iterations=iterations)


def counts(case: Case, iterations: int) -> list[int]:
    """Iterations to errors of 1e-1, 1e-2 and 1e-3, one more than were done where they do not get there."""
    problem = case.problem()
    first = problem.first_iterate(case.start)
    solution, errors = newton(problem, first, tolerance=1e-8), list[float]()
    inexact_newton(
        problem, first, tables(case), cut(problem), iterations=iterations,
        observe=lambda _, u: errors.append(relative_error(u, solution, first)),
    )  # fmt: skip
    return [next((k + 1 for k, e in enumerate(errors) if e <= left), iterations + 1) for left in (1e-1, 1e-2, 1e-3)]


def test_a_hanging_chain_takes_its_closed_form() -> None:
    case = chain()
    expected = chain_displacement(case)
    _, u = solved(case, 60)
    np.testing.assert_allclose(u, expected, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("make", [strip, free_body, lambda: free_body(poisson=0.4)])
def test_steps_agree_with_dense_newton(make: Callable[[], Case]) -> None:
    problem, u = solved(make(), 150)
    expected = newton(problem, problem.first_iterate(), tolerance=1e-8)
    np.testing.assert_allclose(u, expected, atol=1e-10 * np.abs(expected).max())


def test_a_free_body_keeps_its_momentum() -> None:
    """The exact solution has no net force; the solver's must not either."""
    problem, u = solved(free_body(), 150)
    force = problem.weight[:, None] * (u - problem.target)
    size = np.abs(problem.weight[:, None] * problem.target).sum()
    assert np.abs(force.sum(axis=0)).max() <= 1e-12 * size
    assert np.abs(np.cross(problem.positions + u, force).sum(axis=0)).max() <= 1e-11 * size


def test_folding_cloth_takes_few_iterations() -> None:
    assert np.all(np.array(counts(falling_cloth(), 80)) <= [16, 40, 65])


@pytest.mark.parametrize(("make", "most"), [(lambda: swing(5, 1e8), [8, 14, 18]), (slabs, [23, 29, 31])])
def test_stiff_beams_take_few_iterations(make: Callable[[], Case], most: list[int]) -> None:
    assert np.all(np.array(counts(make(), 40)) <= most)


STRETCHES = ("solid_limit", "cloth_limit", "volume", "damper")


@pytest.mark.parametrize("name", [*CASES, *STRETCHES])
def test_blocks_bound_the_hessian_of_every_kind(name: str) -> None:
    """H <= D, so that the Chebyshev iteration cannot diverge."""
    problem = (CASES[name]() if name in CASES else small_body(name)).problem()
    model = NewtonModel(problem, problem.hold(problem.time_step * problem.velocities), lambda field: 0.0 * field)
    free = np.flatnonzero(np.repeat(problem.free, 3))
    hessian = model.hessian.toarray()[np.ix_(free, free)]
    inverse = np.zeros((problem.positions.size,) * 2)
    for i, block in enumerate(model.inverse):
        inverse[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = block
    bound = np.linalg.inv(inverse[np.ix_(free, free)])
    assert eigh(hessian, bound, eigvals_only=True)[-1] <= 1.0 + 1e-9


def test_no_step_raises_the_energy() -> None:
    """From collapsed, mirrored and random first iterates."""
    case = free_body(poisson=0.3)
    problem, rng = case.problem(), np.random.default_rng(0)
    levels, pieces = tables(case), cut(problem)
    x = problem.positions
    for start in (0.0 * x, x * [1.0, -1.0, 1.0], rng.uniform(-1.0, 1.0, x.shape)):
        u = problem.first_iterate(start)
        for _ in range(4):
            after = inexact_newton(problem, u, levels, pieces, iterations=5)
            # less than the slack of the guard is rounding
            assert problem.energy(after) <= problem.energy(u) * (1.0 + 1e-12)
            u = after
