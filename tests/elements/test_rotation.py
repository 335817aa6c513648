"""The nearest rotation of any matrix: a rotation always, and the best one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cases import Array
from matrix_classes import CLASSES
from scipy.spatial.transform import Rotation

import torchpd as pd
from torchpd.reference import nearest_rotation as reference_rotation

pytestmark = pytest.mark.usefixtures("poisoned")

ORTHOGONALITY = {torch.float32: 2e-6, torch.float64: 1e-14}


SCALES = [1.0, 1e30, 1e-30, 1e5, 1e-7]


def check_rotation(rotations: torch.Tensor, matrices: Array) -> None:
    """R^T R = I, det R = +1, and tr(R^T F) the largest possible: the signed sum of singular values."""
    r = rotations.double().cpu().numpy()
    dtype = rotations.dtype
    assert np.isfinite(r).all()
    assert np.abs(np.swapaxes(r, 1, 2) @ r - np.eye(3)).max() <= ORTHOGONALITY[dtype]
    assert np.abs(np.linalg.det(r) - 1.0).max() <= ORTHOGONALITY[dtype]
    best = np.einsum("nij,nij->n", reference_rotation(matrices), matrices)
    reached = np.einsum("nij,nij->n", r, matrices)
    size = np.linalg.norm(matrices, axis=(1, 2))
    # at the maximum the value is flat: an R wrong by e loses e^2, and one off SO(3) by e gains or loses e |F|
    assert (np.abs(best - reached) <= 2 * ORTHOGONALITY[dtype] * size).all()


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("name", CLASSES)
def test_it_is_a_rotation_and_the_best_one(name: str, scale: float, dtype: torch.dtype, device: torch.device) -> None:
    given = torch.tensor(CLASSES[name] * scale, dtype=dtype, device=device)
    check_rotation(pd.nearest_rotation(given), given.double().cpu().numpy())


def test_away_from_ambiguity_it_is_that_of_the_svd(dtype: torch.dtype, device: torch.device) -> None:
    """Sums of two singular values above 0.2: rounding of F, at most 4 ulp of |F| = 6, is amplified by 1 / 0.2."""
    given = torch.tensor(CLASSES["large strain"], dtype=dtype, device=device)
    expected = reference_rotation(given.double().cpu().numpy())
    found = pd.nearest_rotation(given).double().cpu().numpy()
    assert np.abs(found - expected).max() <= 4 * 6 / 0.2 * torch.finfo(dtype).eps


def test_rotations_are_their_own(dtype: torch.dtype, device: torch.device) -> None:
    given = torch.tensor(Rotation.random(500, random_state=3).as_matrix(), dtype=dtype, device=device)
    # entries of F round by u, those of R by a few u more
    assert float((pd.nearest_rotation(given) - given).abs().max()) <= 8 * torch.finfo(dtype).eps


def test_zero_gives_the_identity(dtype: torch.dtype, device: torch.device) -> None:
    for zero in (0.0, -0.0):
        given = torch.full((5, 3, 3), zero, dtype=dtype, device=device)
        assert torch.equal(pd.nearest_rotation(given), torch.eye(3, dtype=dtype, device=device).expand(5, 3, 3))


def test_the_smallest_and_the_largest_numbers(dtype: torch.dtype, device: torch.device) -> None:
    numbers = torch.finfo(dtype)
    turn = torch.tensor(CLASSES["large strain"][:64] / 6.0, dtype=dtype, device=device)
    for size in (numbers.max, numbers.tiny, 64 * numbers.smallest_normal * numbers.eps):
        given = turn * size
        r = pd.nearest_rotation(given).double().cpu().numpy()
        assert np.abs(np.swapaxes(r, 1, 2) @ r - np.eye(3)).max() <= ORTHOGONALITY[dtype], size


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_one_bad_matrix_spoils_itself_only(bad: float, dtype: torch.dtype, device: torch.device) -> None:
    given = torch.tensor(CLASSES["near rest"][:40], dtype=dtype, device=device)
    clean = pd.nearest_rotation(given)
    for entry in range(9):
        given[17].view(-1)[entry] = bad
        found = pd.nearest_rotation(given)
        assert bool(found[17].isnan().all())
        others = torch.arange(40, device=device) != 17
        assert torch.equal(found[others], clean[others])
        given[17] = given[16]


def test_matrices_do_not_feel_their_neighbours(dtype: torch.dtype, device: torch.device) -> None:
    """Lanes of one SIMD register hold easy and hard matrices: the bits of each are its own."""
    hard = np.concatenate([matrices[:40] for matrices in CLASSES.values()])
    order = np.random.default_rng(0).permutation(len(hard))
    given = torch.tensor(hard[order], dtype=dtype, device=device)
    together = pd.nearest_rotation(given)
    alone = torch.cat([pd.nearest_rotation(matrix[None]) for matrix in given])
    assert torch.equal(together, alone)


@pytest.mark.parametrize("shape", [(), (0,), (1,), (5, 7), (2, 0, 3), (3, 1, 2, 2)])
def test_any_leading_shape(shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> None:
    given = torch.randn(*shape, 3, 3, dtype=dtype, device=device, generator=torch.Generator(device).manual_seed(0))
    found = pd.nearest_rotation(given)
    assert found.shape == given.shape
    assert torch.equal(found.reshape(-1, 3, 3), pd.nearest_rotation(given.reshape(-1, 3, 3)))


def test_transposed_and_strided_matrices(dtype: torch.dtype, device: torch.device) -> None:
    given = torch.tensor(CLASSES["large strain"][:64], dtype=dtype, device=device)
    for view in (given.mT, given[::3], given.flip(0), given[:1].expand(4, 3, 3)):
        assert torch.equal(pd.nearest_rotation(view), pd.nearest_rotation(view.contiguous()))


def test_derivative_is_that_of_a_turning_frame(dtype: torch.dtype, device: torch.device) -> None:
    """F = Q(t) S with S symmetric: R = Q, so dR = dQ when F turns, and 0 when F stretches along its own axes."""
    stretch = np.diag([0.6, 1.0, 1.5])
    turn = Rotation.random(random_state=2).as_matrix()
    spin = np.array([[0.0, -0.3, 0.2], [0.3, 0.0, -0.5], [-0.2, 0.5, 0.0]])
    f, turning, stretching = (
        torch.tensor(m, dtype=dtype, device=device)
        for m in (turn @ stretch, turn @ spin @ stretch, turn @ stretch @ stretch)
    )
    differential = torch.ops.torchpd.rotation_differential
    limit = 30 * torch.finfo(dtype).eps  # products of a handful of matrices of size two
    np.testing.assert_allclose(differential(f, turning).cpu(), turn @ spin, atol=limit, rtol=0)
    np.testing.assert_allclose(differential(f, stretching).cpu(), np.zeros((3, 3)), atol=limit, rtol=0)
