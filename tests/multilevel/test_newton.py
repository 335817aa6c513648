"""Newton's method on a CPU: the reference's answers, stiff cloth and beams, momentum, contacts, and what it refuses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from cases import Array, Case, contact_block
from mixed_scenes import CASES
from multilevel_cases import landing, swing
from newton_cases import chain, chain_displacement, falling_cloth, free_body, strip
from runs import arguments_of, displacement, simulator, state_of
from stretch_cases import small_body

import torchpd as pd
from torchpd.reference.solvers import newton, relative_error
from torchpd.scene.solvers import check_solver

STRETCHES = ("solid_limit", "cloth_limit", "volume", "damper")


def stepped(case: Case, iterations: int, dtype: torch.dtype = torch.float64) -> Array:
    sim = simulator(case, dtype, solver=pd.Newton(), iterations=iterations)
    return displacement(sim, sim(state_of(case, sim), **arguments_of(case, sim)))


def test_a_hanging_chain_takes_its_closed_form() -> None:
    case = chain()
    expected = chain_displacement(case)
    np.testing.assert_allclose(stepped(case, 60), expected, atol=1e-11 * np.abs(expected).max())


@pytest.mark.parametrize("make", [strip, free_body, lambda: free_body(poisson=0.4)])
def test_steps_agree_with_dense_newton(make: Callable[[], Case]) -> None:
    case = make()
    problem = case.problem()
    expected = newton(problem, problem.first_iterate(), tolerance=1e-8)
    np.testing.assert_allclose(stepped(case, 150), expected, atol=1e-9 * np.abs(expected).max())


def counted(case: Case, goals: list[int]) -> list[float]:
    """Errors after so many iterations, relative to those of the first iterate."""
    problem = case.problem()
    first = problem.first_iterate(case.start)
    solution = newton(problem, first, tolerance=1e-8)
    return [relative_error(stepped(case, goal), solution, first) for goal in goals]


def test_folding_cloth_takes_few_iterations() -> None:
    assert np.all(np.array(counted(falling_cloth(), [16, 40, 65])) <= [1e-1, 1e-2, 1e-3])


def test_a_stiff_beam_takes_few_iterations() -> None:
    assert np.all(np.array(counted(swing(5, 1e8), [8, 14, 18])) <= [1e-1, 1e-2, 1e-3])


@pytest.mark.parametrize("name", [name for name in (*CASES, *STRETCHES) if name != "free sheet"])
def test_steps_of_every_kind_are_solved(name: str) -> None:
    """The forces that are left are rounding."""
    case = CASES[name]() if name in CASES else small_body(name)
    assert case.problem().relative_residual(stepped(case, 300)) <= 1e-9


@pytest.mark.parametrize("make", [lambda: contact_block(pd.Ground(0.0)), lambda: landing(1e6)])
def test_smooth_contacts_are_solved(make: Callable[[], Case]) -> None:
    case = make()
    assert case.problem().relative_residual(stepped(case, 300)) <= 1e-8


def test_a_free_body_keeps_its_momentum() -> None:
    case = free_body(poisson=0.3)
    problem, u = case.problem(), stepped(case, 100)
    force = problem.weight[:, None] * (u - problem.target)
    size = np.abs(problem.weight[:, None] * problem.target).sum()
    assert np.abs(force.sum(axis=0)).max() <= 1e-12 * size
    assert np.abs(np.cross(problem.positions + u, force).sum(axis=0)).max() <= 1e-11 * size


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_iteration_raises_the_energy(dtype: torch.dtype) -> None:
    """From collapsed, mirrored and random first iterates."""
    case, rng = free_body(poisson=0.3), np.random.default_rng(0)
    problem, x = case.problem(), case.positions
    slack = 1e-5 if dtype == torch.float32 else 1e-12
    for start in (0.0 * x, x * [1.0, -1.0, 1.0], rng.uniform(-1.0, 1.0, x.shape)):
        energies = [problem.energy(stepped(replace(case, start=start), k, dtype)) for k in (0, 1, 2, 5, 10, 20)]
        assert np.all(np.diff(energies) <= slack * np.abs(energies[:-1]))


def test_batches_have_the_bits_of_one() -> None:
    case = free_body()
    sim = simulator(case, torch.float32, solver=pd.Newton(), iterations=10)
    alone, many = (sim(state_of(case, sim, batch)).positions for batch in (1, 17))
    assert torch.equal(many, alone.expand_as(many))


def test_a_gpu_is_refused() -> None:
    with pytest.raises(RuntimeError, match=r"device must be the CPU for Newton.*Multilevel"):
        check_solver("newton", torch.device("cuda"))
