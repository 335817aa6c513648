"""Exact signs: edges that pass through triangles.

An edge pq passes through a triangle abc if p and q lie strictly on different sides of its plane and the lines ab, bc
and ca pass pq on the same side. All are signs of 3 x 3 determinants (orient3d, Shewchuk 1997): float64 with its error
bound decides most of them, integers the others. Touching is not crossing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["crosses", "orientations"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# (7 + 56 eps) eps with eps = 2^-53: error of the determinant over that of absolute values
_BOUND = (7.0 + 56.0 * 2.0**-53) * 2.0**-53


def crosses(points: Array, corners: Index) -> NDArray[np.bool_]:
    """Whether an edge passes through a triangle [m]: points [n, 3] numbered p, q, a, b, c [m, 5]."""
    ahead, behind = (orientations(points, corners[:, [end, 2, 3, 4]]) for end in (0, 1))
    found = ahead * behind < 0
    corners = corners[found]
    turns = [orientations(points, corners[:, [0, 1, 2 + k, 2 + (k + 1) % 3]]) for k in range(3)]
    found[found] = (turns[0] * turns[1] > 0) & (turns[1] * turns[2] > 0)
    return np.asarray(found)


def orientations(points: Array, corners: Index) -> Index:
    """Sign [m] of det (a - d, b - d, c - d) of points [n, 3] numbered a, b, c, d [m, 4], exact."""
    a, b, c = (points[corners[:, k]] - points[corners[:, 3]] for k in range(3))
    determinant = np.zeros(len(corners))
    permanent = np.zeros(len(corners))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        first, second = b[:, j] * c[:, k], b[:, k] * c[:, j]
        determinant += a[:, i] * (first - second)
        permanent += np.abs(a[:, i]) * (np.abs(first) + np.abs(second))
    signs = np.sign(determinant).astype(np.int64)
    unsure = np.flatnonzero(np.abs(determinant) <= _BOUND * permanent)
    if unsure.size:
        signs[unsure] = _exact(points, corners[unsure])
    return signs


def _exact(points: Array, corners: Index) -> Index:
    """Signs [m] by integers: every place times the same power of two."""
    used, number = np.unique(corners, return_inverse=True)
    ratios = [[value.as_integer_ratio() for value in point] for point in points[used].tolist()]
    scale = max(below for point in ratios for _, below in point)
    whole = np.array([[above * (scale // below) for above, below in point] for point in ratios], dtype=object)
    places = whole[number.reshape(corners.shape)]
    a, b, c = (places[:, k] - places[:, 3] for k in range(3))
    determinant = sum(
        a[:, i] * (b[:, (i + 1) % 3] * c[:, (i + 2) % 3] - b[:, (i + 2) % 3] * c[:, (i + 1) % 3]) for i in range(3)
    )
    return np.array([(value > 0) - (value < 0) for value in determinant], dtype=np.int64)
