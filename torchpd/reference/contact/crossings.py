"""Exact signs: edges that pass through triangles; and linking numbers of closed lines.

An edge pq passes through a triangle abc if p and q lie strictly on different sides of its plane and the lines ab, bc
and ca pass pq on the same side. All are signs of 3 x 3 determinants (orient3d, Shewchuk 1997): float64 with its error
bound decides most of them, integers the others. Touching is not crossing.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .boxes import overlaps
from .surfaces import Surfaces

__all__ = ["crossings", "linking_number", "orientations"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# (7 + 56 eps) eps with eps = 2^-53: error of the determinant over that of absolute values
_BOUND = (7.0 + 56.0 * 2.0**-53) * 2.0**-53


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


def crossings(surfaces: Surfaces, positions: Tensor) -> Index:
    """Edges and triangles [n, 2] that cross at positions [N, 3], among those that may be in contact."""
    # boxes that only touch hold no crossing: its point is inside both
    x = positions.double()
    ends, faces = x[surfaces.edges], x[surfaces.triangles]
    edge, triangle = overlaps(ends.amin(1), ends.amax(1), faces.amin(1), faces.amax(1), strict=True)
    five = torch.cat([surfaces.edges[edge], surfaces.triangles[triangle]], dim=1)
    met = (five[:, :2, None] == five[:, None, 2:]).any(dim=2).any(dim=1)
    keep = (~met & surfaces.counts(five)).numpy()
    found = torch.stack([edge, triangle], dim=1).numpy()[keep]
    corners, points = five.numpy()[keep], x.numpy()
    ahead, behind = (orientations(points, corners[:, [end, 2, 3, 4]]) for end in (0, 1))
    parted = ahead * behind < 0
    found, corners = found[parted], corners[parted]
    turns = [orientations(points, corners[:, [0, 1, 2 + k, 2 + (k + 1) % 3]]) for k in range(3)]
    return np.asarray(found[(turns[0] * turns[1] > 0) & (turns[1] * turns[2] > 0)], np.int64)


def linking_number(first: Array, second: Array) -> int:
    """Linking number of two closed polylines [n, 3] and [m, 3]: Gauss's integral, exact for straight segments.

    Each pair of segments adds the solid angle of the tetrahedron of directions between them (Klenin, Langowski 2000).
    """
    a, b = first[:, None], np.roll(first, -1, axis=0)[:, None]
    c, d = second[None], np.roll(second, -1, axis=0)[None]
    ac, ad, bc, bd = c - a, d - a, c - b, d - b
    normals = [np.cross(ac, ad), np.cross(ad, bd), np.cross(bd, bc), np.cross(bc, ac)]
    units = [n / np.maximum(np.linalg.norm(n, axis=2, keepdims=True), 1e-300) for n in normals]
    angle = sum(np.arcsin(np.clip((units[k] * units[(k + 1) % 4]).sum(axis=2), -1.0, 1.0)) for k in range(4))
    side = np.sign((np.cross(d - c, b - a) * ac).sum(axis=2))
    return round(float((angle * side).sum()) / (4.0 * math.pi))
