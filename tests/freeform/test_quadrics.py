"""Quadrics: values worked by hand, the general form and back, refusals."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from patch_cases import F64, ball, lump, quadrics_on

import torchpd as pd


def test_values_of_the_kernel() -> None:
    """(1 - r^2)^3 times 0.2: 1, 27/64 and 0 at the centre, half the radius and the radius; slope -1.35 at the half."""
    x = torch.tensor([[0.25, 0.25, 0.0], [0.375, 0.25, 0.0], [0.5, 0.25, 0.0], [0.6, 0.25, 0.0]], dtype=F64)
    x.requires_grad_()
    r = lump().values(x)[:, 0]
    torch.testing.assert_close(r, torch.tensor([0.2, 0.084375, 0.0, 0.0], dtype=F64), rtol=0, atol=1e-16)
    (slope,) = torch.autograd.grad(r.sum(), x)
    torch.testing.assert_close(slope[1], torch.tensor([-1.35, 0.0, 0.0], dtype=F64), rtol=0, atol=1e-15)


def test_steepest_slope() -> None:
    """96 / (25 sqrt 5) a / rho, at 1 / sqrt 5 of the radius."""
    rho = 0.25
    x = torch.tensor([[0.25 + rho / math.sqrt(5.0), 0.25, 0.0]], dtype=F64, requires_grad=True)
    (slope,) = torch.autograd.grad(lump().values(x).sum(), x)
    assert abs(float(slope[0, 0])) == pytest.approx(1.7173002 * 0.2 / rho, rel=1e-7)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_general_form_and_back(seed: int) -> None:
    """Within rounding, magnified by the condition of A (radii 0.3 to 0.6, sheared: below 100) and by |c|^2 |A| < 50."""
    one = quadrics_on(ball(), 6, seed=seed)
    matrices, signs = one.matrices()
    assert torch.equal(matrices, matrices.mT)
    two = pd.Quadrics.from_matrices(matrices, signs)
    limit = 100 * 50 * torch.finfo(F64).eps
    for name in ("amplitudes", "centres", "factors"):
        torch.testing.assert_close(getattr(two, name), getattr(one, name), rtol=limit, atol=limit)


def test_general_form_is_the_same_function() -> None:
    one = quadrics_on(ball(), 6)
    matrices, signs = one.matrices()
    x = torch.randn(500, 4, dtype=F64, generator=torch.Generator().manual_seed(0))
    x[:, 3] = 1.0
    q = torch.einsum("ni,qij,nj->nq", x, matrices, x)
    expected = one.values(x[:, :3])
    assert int((expected != 0.0).sum()) > 50  # points inside
    torch.testing.assert_close(signs * q.clamp_min(0.0) ** 3, expected, rtol=1e-11, atol=1e-15)


def test_both_forms_have_gradients() -> None:
    one = quadrics_on(ball(), 3)
    leaves = [t.clone().requires_grad_() for t in (one.amplitudes, one.centres, one.factors)]

    def there_and_back(*tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        two = pd.Quadrics.from_matrices(*pd.Quadrics(*tensors).matrices())
        return two.amplitudes, two.centres, two.factors

    jacobian = torch.autograd.functional.jacobian(there_and_back, tuple(leaves))
    for row, parts in enumerate(jacobian):
        for column, part in enumerate(parts):
            size = leaves[row].numel()
            block = part.reshape(size, -1)
            expected = torch.eye(size, dtype=F64) if row == column else torch.zeros_like(block)
            torch.testing.assert_close(block, expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda W: W.index_put((torch.tensor(1),) * 3, torch.tensor(math.nan, dtype=F64)), "must be finite, .* at 1"),
        (lambda W: W + torch.triu(torch.ones(4, 4, dtype=F64), 1), "must be symmetric, .* at 0"),
        (lambda W: -W, "must be ellipsoids"),  # the outside of one
        (lambda W: W * torch.tensor([1.0, 1.0, 0.0, 1.0], dtype=F64)[:, None] * torch.tensor([1.0, 1.0, 0.0, 1.0]),
         "must be ellipsoids"),  # a cylinder
        (lambda W: W - 10.0 * torch.eye(4, dtype=F64), "must be ellipsoids"),  # nowhere positive
        (lambda W: 0.0 * W, "must be ellipsoids"),
    ],
)  # fmt: skip
def test_matrices_that_are_no_ellipsoids_are_refused(change: object, message: str) -> None:
    matrices, _ = quadrics_on(ball(), 3).matrices()
    with pytest.raises(ValueError, match=f"Quadrics.from_matrices: matrices {message}"):
        pd.Quadrics.from_matrices(change(matrices))  # type: ignore[operator]


def test_other_refusals() -> None:
    one = quadrics_on(ball(), 3)
    with pytest.raises(ValueError, match=r"signs must be \+1 or -1, got otherwise at 2"):
        pd.Quadrics.from_matrices(one.matrices()[0], torch.tensor([1.0, -1.0, 0.5]))
    with pytest.raises(ValueError, match=r"Quadrics.factors .*got \[3, 5\]"):
        pd.Quadrics(one.amplitudes, one.centres, one.factors[:, :5])
    with pytest.raises(TypeError, match=r"Quadrics.amplitudes .*got torch.int64"):
        pd.Quadrics(torch.ones(3, dtype=torch.int64), one.centres, one.factors)
    with pytest.raises(ValueError, match=r"Quadrics.centres .*got torch\.float32"):
        pd.Quadrics(one.amplitudes, one.centres.float(), one.factors)
    with pytest.raises(ValueError, match=r"radii .*got 0\.0"):
        pd.Quadrics.from_radii(one.amplitudes, one.centres, torch.zeros(3, dtype=F64))
    with pytest.raises(ValueError, match=r"radii .*got \[3, 2\]"):
        pd.Quadrics.from_radii(one.amplitudes, one.centres, torch.ones(3, 2, dtype=F64))


def test_printed() -> None:
    assert repr(quadrics_on(ball(), 3)) == "Quadrics(3, float64, cpu)"
    assert len(pd.Quadrics.none()) == 0


def test_matrices_of_amplitude_zero_have_a_gradient() -> None:
    """Zero, where the cube root has an infinite slope."""
    amplitudes = torch.tensor([0.0, 0.008], dtype=torch.float64, requires_grad=True)
    centres, radii = torch.zeros(2, 3, dtype=torch.float64), torch.ones(2, dtype=torch.float64)
    (slope,) = torch.autograd.grad(pd.Quadrics.from_radii(amplitudes, centres, radii).matrices()[0].sum(), amplitudes)
    # W = a^(1/3) diag(-1, -1, -1, 1), whose sum is -2 a^(1/3)
    torch.testing.assert_close(slope, torch.tensor([0.0, -2.0 / 3.0 * 0.2**-2], dtype=torch.float64))
