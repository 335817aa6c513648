"""Visibility between points inside a surface: segments and rays against all of its triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["depths", "is_blocked"]

Array = NDArray[np.float64]

_AT_ONCE = 4_000_000  # ray-triangle pairs processed at a time
_TOUCH = 1e-9  # tolerance of a barycentric coordinate: rays through an edge count


def _first_hits(origins: Array, directions: Array, corners: Array, *, least: float, most: float) -> Array:
    """Least t in (least, most) with origin + t direction on a triangle [n]; inf without a hit.

    Tests every ray against the bounding sphere of every triangle [T, 3, 3], then against the triangles of the spheres
    that it meets.
    """
    first = np.full(len(origins), np.inf)
    shift = corners.mean(axis=(0, 1))  # far from the origin, squares would lose digits
    origins, corners = origins - shift, corners - shift
    centroid = corners.mean(axis=1)
    radius = 1.001 * np.linalg.norm(corners - centroid[:, None], axis=2).max(axis=1)
    length = np.linalg.norm(directions, axis=1)
    rows = max(1, _AT_ONCE // len(corners))
    for start in range(0, len(origins), rows):
        o, d, size = origins[start : start + rows], directions[start : start + rows], length[start : start + rows]
        unit = d / size[:, None]
        along = unit @ centroid.T - (unit * o).sum(axis=1)[:, None]
        # squared distance from the ray; rounding below zero is covered by the margin of the radius
        apart = (o**2).sum(axis=1)[:, None] + (centroid**2).sum(axis=1) - 2.0 * (o @ centroid.T) - along**2
        near = (apart <= radius**2) & (along >= -radius) & (along <= most * size[:, None] + radius)
        ray, triangle = np.nonzero(near)
        hits = _hits(o[ray], d[ray], corners[triangle])
        hits[~((hits > least) & (hits < most))] = np.inf
        np.minimum.at(first, start + ray, hits)
    return first


def _hits(origins: Array, directions: Array, corners: Array) -> Array:
    """Distance along each ray [n, 3] to its triangle [n, 3, 3], from both sides; inf without a hit.

    Moeller and Trumbore (1997).
    """
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    s, p = origins - corners[:, 0], np.cross(directions, v)
    q = np.cross(s, u)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / (p * u).sum(axis=1)
        b1, b2 = inverse * (s * p).sum(axis=1), inverse * (q * directions).sum(axis=1)
        met = (b1 >= -_TOUCH) & (b2 >= -_TOUCH) & (b1 + b2 <= 1.0 + _TOUCH)
        return np.where(met, inverse * (q * v).sum(axis=1), np.inf)


def depths(points: Array, directions: Array, corners: Array) -> Array:
    """Thickness of a surface [n] in m: distance from points [n, 3] along unit directions [n, 3] to the other side.

    Zero without a hit: sides closer together than 1e-6 of the surface's size count as one.
    """
    diagonal = float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))
    first = _first_hits(points, directions, corners, least=1e-6 * diagonal, most=diagonal)
    return np.where(np.isfinite(first), first, 0.0)


def is_blocked(starts: Array, ends: Array, corners: Array) -> NDArray[np.bool_]:
    """Whether a triangle [T, 3, 3] lies strictly between two points [n, 3] and [n, 3]; starts may lie on triangles."""
    return np.asarray(_first_hits(starts, ends - starts, corners, least=1e-6, most=1.0) < 1.0)
