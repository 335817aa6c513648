"""The least squares behind fits of patches: derivatives, radii, and both ways to solve."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchpd.freeform import least_squares as fit_problem
from torchpd.freeform.least_squares import (
    HeightProblem,
    QuadricParameters,
    levenberg_marquardt,
    ridge_amplitudes,
    within_radii,
)


def some(count: int = 5, seed: int = 0) -> QuadricParameters:
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((count, 10))
    rows[:, 0] *= 0.1
    rows[:, 1:4] *= 0.5
    rows[:, 4:7] = -np.log(rng.uniform(0.4, 0.9, (count, 3)))
    rows[:, 7:] *= 0.3
    return QuadricParameters(rows, np.full(count, 1.0))


def problem(numbers: QuadricParameters, samples: int = 400) -> HeightProblem:
    """Heights of these very quadrics, with weights at random."""
    rng = np.random.default_rng(1)
    points = rng.uniform(-1.0, 1.0, (samples, 3))
    heights = numbers.quadrics().values(torch.tensor(points)).sum(-1).numpy()
    return HeightProblem(points, heights, rng.uniform(0.5, 1.0, samples))


def test_residuals_vanish_for_the_quadrics_themselves() -> None:
    """The same sum as `Quadrics.values`, in another order: rounding only."""
    numbers = some()
    assert np.abs(problem(numbers).residuals(numbers.rows)).max() <= 1e-15


def test_derivatives_against_central_differences() -> None:
    """R has a bounded third derivative, of about 1e2 here: differences over 1e-5 are right to 1e-8."""
    numbers = some()
    case = problem(some(seed=3))
    J = case.linearised(numbers.rows)[1].toarray()
    for column in range(numbers.rows.size):
        shift = np.zeros(numbers.rows.size)
        shift[column] = 1e-5
        both = [case.residuals(numbers.rows + s * shift.reshape(-1, 10)) for s in (1.0, -1.0)]
        np.testing.assert_allclose(J[:, column], (both[0] - both[1]) / 2e-5, rtol=0, atol=1e-7)
    assert np.abs(J).max() > 0.1


def test_radii_are_held_between_bounds_and_nothing_else_changes() -> None:
    rows = some(6).rows
    rows[0, 4:7] += 8.0
    rows[1, 4:7] -= 8.0
    before = QuadricParameters(rows, np.array([1.0, 1.0, 2.0, 2.0, 2.0, 2.0]))
    after = within_radii(before, 0.2)
    s0, s1 = (np.linalg.svd(fit_problem.triangular(n.rows), compute_uv=False) for n in (before, after))
    np.testing.assert_allclose(s1, np.clip(s0, 1.0 / before.cap[:, None], 1.0 / 0.2), rtol=1e-12)
    np.testing.assert_array_equal(after.rows[:, :4], rows[:, :4])
    M = fit_problem.triangular(after.rows)
    # what was inside keeps its ellipsoid, and rounding apart its very numbers
    inside = np.isclose(s0, s1, rtol=1e-14).all(axis=1)
    assert 0 < inside.sum() < 6
    np.testing.assert_allclose(M[inside], fit_problem.triangular(rows)[inside], rtol=0, atol=1e-13)
    twice = within_radii(after, 0.2)
    np.testing.assert_allclose(twice.rows, after.rows, rtol=0, atol=1e-12)


def test_amplitudes_are_linear() -> None:
    """From 0, ridge regression finds them: exact without a ridge, held back with one."""
    truth = some()
    case = problem(truth)
    flat = truth.rows.copy()
    flat[:, 0] = 0.0
    exact = ridge_amplitudes(case, QuadricParameters(flat, truth.cap), ridge=0.0)
    np.testing.assert_allclose(exact.rows[:, 0], truth.rows[:, 0], rtol=1e-10)
    held = ridge_amplitudes(case, QuadricParameters(flat, truth.cap), ridge=1.0)
    assert np.linalg.norm(held.rows[:, 0]) < 0.8 * np.linalg.norm(truth.rows[:, 0])


@pytest.mark.parametrize("dense", [0, 3000], ids=["sparse", "dense"])
def test_it_comes_back_from_nearby(monkeypatch: pytest.MonkeyPatch, dense: int) -> None:
    """A disturbed start returns to the truth: Gauss-Newton converges quadratically where the residual is 0."""
    monkeypatch.setattr(fit_problem, "_DENSE", dense)
    truth = within_radii(some(), 0.2)
    case = problem(truth, 2000)
    near = QuadricParameters(truth.rows + 0.03 * np.random.default_rng(2).standard_normal(truth.rows.shape), truth.cap)
    counted = []
    found = levenberg_marquardt(case, near, iterations=60, least=0.1, report=lambda: counted.append(1))
    np.testing.assert_allclose(found.rows, truth.rows, rtol=0, atol=1e-8)
    assert 3 < len(counted) < 60


def test_no_radius_leaves_its_bounds() -> None:
    """Heights of a wide bump, for which a quadric must not be wider than its cap."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.0, 1.0, (500, 3))
    case = HeightProblem(points, np.ones(500), np.ones(500))
    start = QuadricParameters.spheres(np.zeros((1, 3)), np.array([0.4]), np.array([0.5]))
    found = levenberg_marquardt(case, ridge_amplitudes(case, start), iterations=30, least=0.1)
    radii = 1.0 / np.linalg.svd(fit_problem.triangular(found.rows), compute_uv=False)
    assert radii.max() == pytest.approx(0.5, rel=1e-9)
