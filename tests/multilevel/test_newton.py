"""Newton's method on a CPU: the reference's answers, stiff cloth and beams, momentum, contacts, and what it refuses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from cases import Array, Case, contact_block, on_sphere
from mixed_scenes import CASES
from multilevel_cases import Tables, landing, pieces_of, slabs, swing
from newton_cases import chain, chain_displacement, falling_cloth, free_body, strip, thrown_rod
from runs import arguments_of, displacement, simulator, state_of
from stretch_cases import small_body

import torchpd as pd
from torchpd.reference.inexact_newton import inexact_newton
from torchpd.reference.solvers import newton, relative_error, solve_with_contact
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
    """Errors after so many iterations, relative to those of the first iterate. A step may have several minima."""
    first, solution = case.problem().first_iterate(case.start), stepped(case, 300)
    assert case.problem().relative_residual(solution) <= 1e-8
    return [relative_error(stepped(case, goal), solution, first) for goal in goals]


@pytest.mark.parametrize(
    ("make", "iterations"),
    [
        (slabs, [1, 2, 4, 8, 16]),
        (lambda: swing(5, 1e6, poisson=0.45), [1, 4, 8, 16]),
        (falling_cloth, [1, 4, 8, 16]),
    ],
)
def test_iterates_are_those_of_the_reference(make: Callable[[], Case], iterations: list[int]) -> None:
    """With the same pieces: steps that are halved and steps cut short, too."""
    case = make()
    problem = case.problem()
    plan = simulator(case, torch.float64, solver=pd.Newton()).plan
    first, tables, pieces = problem.first_iterate(case.start), Tables(plan), pieces_of(plan)
    for count in iterations:
        expected = problem.align(inexact_newton(problem, first, tables, pieces, iterations=count))
        found = stepped(case, count)
        # conditions of up to 1e5
        assert np.linalg.norm(found - expected) <= 1e-9 * np.linalg.norm(expected - first)


@pytest.mark.parametrize("cells", [20, 30])
def test_folding_cloth_takes_few_iterations(cells: int) -> None:
    assert np.all(np.array(counted(falling_cloth(cells), [16, 40, 65])) <= [1e-1, 1e-2, 1e-3])


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-4])
def test_a_tolerance_holds_for_folding_cloth(tolerance: float) -> None:
    case = falling_cloth(20)
    solution = stepped(case, 300)
    sim = simulator(case, torch.float64, solver=pd.Newton(), iterations=300, tolerance=tolerance)
    after, info = sim(state_of(case, sim), return_info=True, **arguments_of(case, sim))
    assert info.converged.all()
    assert np.linalg.norm(displacement(sim, after) - solution) <= tolerance * np.linalg.norm(solution)


@pytest.mark.parametrize(
    ("make", "most"), [(lambda: swing(5, 1e8), [8, 14, 18]), (slabs, [23, 29, 31]), (thrown_rod, [3, 4, 5])]
)
def test_stiff_bodies_take_few_iterations(make: Callable[[], Case], most: list[int]) -> None:
    assert np.all(np.array(counted(make(), most)) <= [1e-1, 1e-2, 1e-3])


@pytest.mark.parametrize("name", [name for name in (*CASES, *STRETCHES) if name != "free sheet"])
def test_steps_of_every_kind_are_solved(name: str) -> None:
    """The forces that are left are rounding."""
    case = CASES[name]() if name in CASES else small_body(name)
    assert case.problem().relative_residual(stepped(case, 300)) <= 1e-9


@pytest.mark.parametrize("make", [lambda: contact_block(pd.Ground(0.0)), lambda: landing(1e6)])
def test_smooth_contacts_are_solved(make: Callable[[], Case]) -> None:
    case = make()
    assert case.problem().relative_residual(stepped(case, 300)) <= 1e-8


@pytest.mark.parametrize("friction", [0.0, 0.1, 0.3, 0.5])
@pytest.mark.parametrize("on", ["ground", "sphere"])
def test_contacts_end_where_the_reference_does(on: str, friction: float) -> None:
    """Normal forces change friction: with steps at full length a cube of 1e6 Pa diverged from 0.5 on."""
    slides = {"velocity": (1.0, -1.0, 0.0), "youngs": 1e6, "cells": 4}
    case = contact_block(pd.Ground(friction=friction), **slides) if on == "ground" else on_sphere(friction)
    solution, first = solve_with_contact(case.problem()), case.problem().first_iterate(case.start)
    early, late = (relative_error(stepped(case, count), solution, first) for count in (60, 200))
    assert early <= 1e-5
    assert late <= 1e-12


@pytest.mark.parametrize("friction", [0.3, 0.5])
def test_stiff_bodies_that_slide(friction: float) -> None:
    """A cube of 1e7 Pa, of whose step 32 iterations of `Multilevel` leave 0.9 and 0.4."""
    case = contact_block(pd.Ground(friction=friction), velocity=(1.0, -1.0, 0.0), youngs=1e7, cells=4)
    solution, first = solve_with_contact(case.problem()), case.problem().first_iterate(case.start)
    assert relative_error(stepped(case, 32), solution, first) <= 1e-4


def test_gradients_are_those_of_multilevel() -> None:
    """At a solved step they depend on where it ends alone. `Multilevel` takes hundreds of iterations."""
    case, found = strip(), []
    for solver, iterations in ((pd.Newton(), 100), (pd.Multilevel(), 1000)):
        sim = simulator(case, torch.float64, solver=solver, iterations=iterations)
        state = state_of(case, sim)
        state.positions.requires_grad_()
        after, info = sim(state, return_info=True)
        assert info.residual.max() <= 1e-9
        after.positions[..., 1].sum().backward()
        assert state.positions.grad is not None
        found.append(state.positions.grad)
    torch.testing.assert_close(found[0], found[1], rtol=1e-8, atol=1e-8)


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


def test_threads_change_no_bits() -> None:
    case = swing(8, 1e6, poisson=0.3)
    sim = simulator(case, torch.float32, solver=pd.Newton(), iterations=8)
    assert sim.plan.patches == 8
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            found.append(sim(state_of(case, sim), **arguments_of(case, sim)).positions)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*found)


@pytest.mark.parametrize(("make", "name"), [(strip, "membrane_youngs"), (partial(free_body, poisson=0.3), "stiffness")])
def test_environments_have_materials_of_their_own(make: Callable[[], Case], name: str) -> None:
    """Each step is solved, with M of the stiffest, and has the bits that it has alone."""
    case = make()
    sim = simulator(case, torch.float64, solver=pd.Newton(), iterations=150)
    values = torch.tensor([[1.0], [0.2], [4.0]]) * getattr(sim, name).detach()
    sim.set_material(**{name: values})
    after, info = sim(state_of(case, sim, 3), return_info=True)
    assert info.residual.max() <= 1e-9
    for own, positions in zip(values, after.positions, strict=True):
        sim.set_material(**{name: own})
        assert torch.equal(sim(state_of(case, sim)).positions[0], positions)


def test_a_gpu_is_refused() -> None:
    with pytest.raises(RuntimeError, match=r"device must be the CPU for Newton.*Multilevel"):
        check_solver("newton", torch.device("cuda"))
