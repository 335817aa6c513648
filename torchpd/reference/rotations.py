"""Nearest rotations and orthonormal frames of deformation gradients, and their derivatives."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "LEAST",
    "nearest_frame",
    "nearest_orthonormal",
    "nearest_rotation",
    "nearest_rotation_fast",
    "orthonormal_linearised",
    "singular_frames",
]

Array = NDArray[np.float64]

LEAST = 1e-12  # least sum of two stretches that a derivative divides by: at zero the nearest point is not unique


def singular_frames(matrices: Array) -> tuple[Array, Array, Array]:
    """F = U diag(s) V^T with U and V rotations: s_1 >= s_2 >= |s_3|, and s_3 takes the sign of det F."""
    left, values, right = np.linalg.svd(matrices)
    # flip the last singular direction of a frame that reflects, and s_3 with it
    left_sign, right_sign = np.sign(np.linalg.det(left)), np.sign(np.linalg.det(right))
    left[..., :, 2] *= left_sign[..., None]
    right[..., 2, :] *= right_sign[..., None]
    values[..., 2] *= left_sign * right_sign
    return left, values, right


def nearest_rotation(matrices: Array) -> Array:
    """The nearest rotation of every F [..., 3, 3]: R with det R = +1 minimises |F - R|; U V^T of the signed SVD."""
    left, _, right = singular_frames(matrices)
    return left @ right


# indices into a row-major 3x3 matrix: the products of these entries are its cofactors
_NEXT, _LAST = (1, 2, 0), (2, 0, 1)
_ENTRIES = [[3 * i + j for i in rows for j in columns] for rows, columns in
            ((_NEXT, _NEXT), (_LAST, _LAST), (_NEXT, _LAST), (_LAST, _NEXT))]  # fmt: skip


def _cofactors(m: Array) -> Array:
    """Cofactor matrices of m [3, 3, n]: row i is the cross product of the other two rows."""
    a, b, c, d = (m.reshape(9, -1).take(entries, axis=0) for entries in _ENTRIES)
    return np.asarray((a * b - c * d).reshape(m.shape))


def nearest_rotation_fast(matrices: Array, *, sweeps: int = 9) -> Array:
    """`nearest_rotation` of F [n, 3, 3], about ten times faster where F is far from singular and not inverted.

    Higham's Newton iteration X <- (X + X^-T) / 2 converges quadratically to the rotation of the polar decomposition
    when det F > 0 (Higham 1986). The SVD handles matrices for which it has not converged to rounding.
    """
    x = np.array(np.moveaxis(matrices, 0, 2), order="C")  # a copy, also for n = 1
    scale = np.abs(x).max(axis=(0, 1)) ** 3
    sound = (x[0] * _cofactors(x)[0]).sum(axis=0) > 1e-3 * scale
    x[:, :, ~sound] = np.eye(3)[:, :, None]
    change = np.zeros(len(matrices))
    for _ in range(sweeps):
        cofactors = _cofactors(x)
        determinants = (x[0] * cofactors[0]).sum(axis=0)
        following = 0.5 * (x + cofactors / determinants)
        change, x = np.abs(following - x).max(axis=(0, 1)), following
        if change.max(initial=0.0) < 1e-9:  # quadratic convergence: the error is now of the order of 1e-18
            break
    rotations = np.ascontiguousarray(np.moveaxis(x, 2, 0))
    rest = ~sound | (change >= 1e-9)
    if rest.any():
        rotations[rest] = nearest_rotation(matrices[rest])
    return rotations


def nearest_frame(matrices: Array) -> tuple[Array, Array, Array]:
    """The nearest orthonormal frame R [n, 3, 2] of F [n, 3, 2], its unit normal [n, 3] and h = tr(R^T F) [n].

    With columns a, b and normal n = a x b / |a x b|: R = [a + b x n, b + n x a] / h and h = s_1 + s_2. Where F has rank
    one, n is any unit normal of the longer column; F = 0 takes the first two axes.
    """
    a, b = matrices[..., 0], matrices[..., 1]
    cross = np.cross(a, b)
    area, squares = np.linalg.norm(cross, axis=1), (matrices**2).sum(axis=(1, 2))
    sound = area > 1e-14 * squares
    longer = np.where(((b**2).sum(axis=1) > (a**2).sum(axis=1))[:, None], b, a)
    across = np.cross(longer, np.eye(3)[np.abs(longer).argmin(axis=1)])
    across = np.where(squares[:, None] > 0.0, across, [0.0, 0.0, 1.0])
    normal = np.where(sound[:, None], cross, across)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    h = np.sqrt(squares + 2.0 * np.where(sound, area, 0.0))
    frame = np.stack([a + np.cross(b, normal), b + np.cross(normal, a)], axis=2)
    frame = frame / np.where(h > 0.0, h, 1.0)[:, None, None]
    frame = np.where(h[:, None, None] > 0.0, frame, np.eye(3)[:, :2])
    return frame, normal, h


def nearest_orthonormal(matrices: Array) -> Array:
    """R that minimises |F - R|: a rotation for F [n, 3, 3], an orthonormal frame for F [n, 3, 2]."""
    return nearest_rotation_fast(matrices) if matrices.shape[2] == 3 else nearest_frame(matrices)[0]


def orthonormal_linearised(matrices: Array) -> Callable[[Array], Array]:
    """The derivative of `nearest_orthonormal`: a map of dF.

    d = 3: U W V^T with W_ij = (M_ij - M_ji) / (s_i + s_j) and M = U^T dF V (Papadopoulo and Lourakis 2000). d = 2: the
    turn about the normal, and the tilt n (n^T dF) S^-1 with S = R^T F.
    """
    return _rotation_linearised(matrices) if matrices.shape[2] == 3 else _frame_linearised(matrices)


def _rotation_linearised(matrices: Array) -> Callable[[Array], Array]:
    left, values, right = singular_frames(matrices)
    sums = np.maximum(values[:, :, None] + values[:, None, :], LEAST)

    def along(change: Array) -> Array:
        inner = np.swapaxes(left, 1, 2) @ change @ np.swapaxes(right, 1, 2)
        return np.asarray(left @ ((inner - np.swapaxes(inner, 1, 2)) / sums) @ right)

    return along


def _frame_linearised(matrices: Array) -> Callable[[Array], Array]:
    frame, normal, h = nearest_frame(matrices)
    squares = np.swapaxes(matrices, 1, 2) @ matrices
    trace = np.trace(squares, axis1=1, axis2=2)
    area = np.maximum(0.5 * (h**2 - trace), LEAST * np.maximum(trace, LEAST))
    h = np.maximum(h, LEAST)
    inverse = ((trace + area)[:, None, None] * np.eye(2) - squares) / (area * h)[:, None, None]
    turned = np.stack([frame[..., 1], -frame[..., 0]], axis=2)

    def along(change: Array) -> Array:
        turn = ((frame[..., 1] * change[..., 0]).sum(axis=1) - (frame[..., 0] * change[..., 1]).sum(axis=1)) / h
        tilt = np.einsum("nk,nki,nji->nj", normal, change, inverse)
        return np.asarray(turned * turn[:, None, None] + normal[:, :, None] * tilt[:, None, :])

    return along
