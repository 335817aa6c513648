"""Which points inside a surface see each other: segments and rays against all of its triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["depths", "is_blocked"]

Array = NDArray[np.float64]

_AT_ONCE = 4_000_000  # pairs of a ray and a triangle
_TOUCH = 1e-9  # of a barycentric coordinate: rays through an edge count


def _first_hits(origins: Array, directions: Array, corners: Array, *, least: float, most: float) -> Array:
    """The least t in (least, most) with origin + t direction on a triangle [n], inf where there is none.

    Every ray against the ball around every triangle [T, 3, 3], and against those triangles whose ball it meets.
    """
    first = np.full(len(origins), np.inf)
    shift = corners.mean(axis=(0, 1))  # far from the origin, squares would lose digits
    origins, corners = origins - shift, corners - shift
    middle = corners.mean(axis=1)
    radius = 1.001 * np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
    length = np.linalg.norm(directions, axis=1)
    rows = max(1, _AT_ONCE // len(corners))
    for start in range(0, len(origins), rows):
        o, d, size = origins[start : start + rows], directions[start : start + rows], length[start : start + rows]
        unit = d / size[:, None]
        along = unit @ middle.T - (unit * o).sum(axis=1)[:, None]
        # the square of the distance from the ray, at least zero but for rounding that the margin of the radius covers
        apart = (o**2).sum(axis=1)[:, None] + (middle**2).sum(axis=1) - 2.0 * (o @ middle.T) - along**2
        near = (apart <= radius**2) & (along >= -radius) & (along <= most * size[:, None] + radius)
        ray, triangle = np.nonzero(near)
        hits = _hits(o[ray], d[ray], corners[triangle])
        hits[~((hits > least) & (hits < most))] = np.inf
        np.minimum.at(first, start + ray, hits)
    return first


def _hits(origins: Array, directions: Array, corners: Array) -> Array:
    """Where each ray [n, 3] meets its triangle [n, 3, 3], from both sides; inf where it does not.

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
    """How far it is from points [n, 3] on a surface along unit directions [n, 3] to its other side [n] in m.

    Zero where nothing is hit: sides closer together than 1e-6 of the surface's size count as one.
    """
    diagonal = float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))
    first = _first_hits(points, directions, corners, least=1e-6 * diagonal, most=diagonal)
    return np.where(np.isfinite(first), first, 0.0)


def is_blocked(starts: Array, ends: Array, corners: Array) -> NDArray[np.bool_]:
    """Whether a triangle [T, 3, 3] lies strictly between two points [n, 3] and [n, 3]; starts may lie on triangles."""
    return np.asarray(_first_hits(starts, ends - starts, corners, least=1e-6, most=1.0) < 1.0)
