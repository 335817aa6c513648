"""Pairs of patches and quadrics that touch, and the lists that gather values and gradients in a fixed order.

A quadric touches a patch if its ellipsoid reaches a point where the patch may evaluate it. These points are the
triangle; with a curved base, or with heights measured on the surface, its neighbourhood too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

__all__ = ["TouchingPairs", "corner_lists", "find_touching_pairs", "gather_lists", "triangle_distances"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# ellipsoids are enlarged by this fraction of their radii: float32 rounding may move a sample into one that it misses
_SLACK = 1e-6


def triangle_distances(corners: Array) -> Array:
    """Distance of the origin from triangles [..., 3, 3].

    The nearest point is inside the triangle if its barycentric coordinates are positive, else on one of the edges. A
    triangle without area counts as its edges.
    """
    a, b, c = (corners[..., k, :] for k in range(3))
    best = np.full(corners.shape[:-2], np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        along = end - start
        length2 = (along**2).sum(-1)
        t = np.clip(-(start * along).sum(-1) / np.where(length2 > 0, length2, 1.0), 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(start + t[..., None] * along, axis=-1))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=-1)
    sides = np.stack([(np.cross(q - p, -p) * normal).sum(-1) for p, q in ((a, b), (b, c), (c, a))])
    inside = (sides >= 0).all(axis=0) & (area > 0)
    height = np.abs((a * normal).sum(-1)) / np.where(area > 0, area, 1.0)
    return np.where(inside, np.minimum(height, best), best)


@dataclass(frozen=True)
class TouchingPairs:
    """Pairs of patches and quadrics, ascending; and bounds of the height and steepness of each patch."""

    patch: Index  # [N]
    quadric: Index  # [N]
    reach: Array  # [P] bound of |h| for heights measured on the surface, else 0 [m]
    steepness: Array  # [P] bound of the derivative of sum_i R_i(P + h D) by h there, else 0


@dataclass(frozen=True)
class _Base:
    """The triangles, and the distance of their curved base from them."""

    corners: Array  # [P, 3, 3]
    directors: Array  # [P, 3, 3], at the corners
    bulge: Array  # [P]

    @classmethod
    def of(cls, corners: Array, directors: Array, *, curved: bool) -> _Base:
        lift = np.zeros(len(corners))
        if curved:
            # |sum_k b_k l_k N_k| <= 3/4 sum_k b_k (1 - b_k) max_jk |(V_k - V_j) . N_k|, and sum_k b_k (1 - b_k) <= 2/3
            drops = np.einsum("pkjx,pkx->pkj", corners[:, :, None] - corners[:, None], directors)
            lift = 0.5 * np.abs(drops).max(axis=(1, 2))
        return cls(corners, directors, lift)


@dataclass(frozen=True)
class _Pairs:
    """Candidate pairs, in the metric in which each ellipsoid is the unit ball."""

    patch: Index
    quadric: Index
    distance: Array  # lower bound of the distance of the base surface from the centre
    stretch: Array  # bound of |M D|
    along: Array  # [N, 2] lower and upper bound of M (P - c) . M D / |M D|


def _candidates(base: _Base, centres: Array, m: Array, slack: float) -> _Pairs:
    """Pairs whose bounding balls meet for heights up to `slack`."""
    middle = base.corners.mean(axis=1)
    radius = np.linalg.norm(base.corners - middle[:, None], axis=2).max(axis=1)
    longest = np.linalg.norm(base.directors, axis=2).max(axis=1)
    reach = 1.0 / np.linalg.svd(m, compute_uv=False)[:, -1] if len(m) else np.empty(0)
    around = float((radius + (base.bulge + slack) * longest).max())
    found = cKDTree(middle).query_ball_point(centres, (1.0 + _SLACK) * reach + around) if len(m) else []
    quadric = np.repeat(np.arange(len(m)), [len(rows) for rows in found])
    patch = np.fromiter((row for rows in found for row in rows), dtype=np.int64, count=len(quadric))
    order = np.lexsort((quadric, patch))
    patch, quadric = patch[order], quadric[order]
    corners = np.einsum("nij,nkj->nki", m[quadric], base.corners[patch] - centres[quadric][:, None])
    directors = np.einsum("nij,nkj->nki", m[quadric], base.directors[patch])
    stretch = np.linalg.norm(directors, axis=2).max(axis=1)
    lift = base.bulge[patch] * stretch
    # M (P - c) . M D lies between its values for pairs of corners; |M D| is at least its component along the mean
    products = np.einsum("nji,nki->njk", corners, directors).reshape(-1, 9)
    mean = directors.sum(axis=1, keepdims=True)
    mean = mean / np.maximum(np.linalg.norm(mean, axis=2, keepdims=True), np.finfo(np.float64).tiny)
    least = np.maximum((directors * mean).sum(axis=2).min(axis=1), 1e-9 * stretch)
    low, high = products.min(axis=1), products.max(axis=1)
    along = np.stack([low / np.where(low < 0, least, stretch) - lift, high / np.where(high > 0, least, stretch) + lift])
    return _Pairs(patch, quadric, np.maximum(triangle_distances(corners) - lift, 0.0), stretch, along.T)


def _height_bounds(pairs: _Pairs, amplitudes: Array, patches: int) -> tuple[Array, Array]:
    """Bounds [P] of h = sum_i R_i(P + h D): the smallest interval that contains its own image.

    Within |h| <= H the quadric i is at least d_i - |M_i D| H away from the centre, d_i the distance of the base.
    """
    low, high = np.zeros(patches), np.zeros(patches)
    for _ in range(1000):
        reach = np.maximum(high, -low)
        near = np.maximum(pairs.distance - pairs.stretch * reach[pairs.patch], 0.0)
        most = amplitudes[pairs.quadric] * np.maximum(1.0 - near**2, 0.0) ** 3
        higher = np.bincount(pairs.patch, np.maximum(most, 0.0), patches)
        lower = np.bincount(pairs.patch, np.minimum(most, 0.0), patches)
        if np.all(higher <= high * (1.0 + 1e-9)) and np.all(lower >= low * (1.0 + 1e-9)):
            break
        low, high = np.minimum(lower, low), np.maximum(higher, high)
    return low * (1.0 + 1e-6), high * (1.0 + 1e-6)


def _steepness(pairs: _Pairs, amplitudes: Array, low: Array, high: Array) -> Array:
    """Upper bound of dR_i(P + h D)/dh for each pair, for low <= h <= high.

    With u = M (P + h D - c) . M D / |M D| the derivative is -6 a |M D| u [1 - u^2 - ..]^2. A bump falls on its far side
    (u > 0), so that only its near side counts; for a dent it is the opposite.
    """
    a = amplitudes[pairs.quadric]
    far_below = -(pairs.along[:, 0] + pairs.stretch * low[pairs.patch])
    far_above = pairs.along[:, 1] + pairs.stretch * high[pairs.patch]
    u = np.clip(np.where(a > 0, far_below, far_above), 0.0, 1.0 / np.sqrt(5.0))
    return np.asarray(6.0 * np.abs(a) * pairs.stretch * u * (1.0 - u**2) ** 2)


def find_touching_pairs(
    vertices: Array,
    triangles: Index,
    directors: Array,
    amplitudes: Array,
    centres: Array,
    m: Array,
    *,
    curved: bool,
    on_surface: bool,
) -> TouchingPairs:
    """Every pair of a patch and a quadric that the patch may evaluate.

    With heights measured on a flat base only ellipsoids that reach the triangle count; otherwise the bounds of the
    base's curvature and of the height enlarge the range.
    """
    count = len(triangles)
    base = _Base.of(vertices[triangles], directors[triangles], curved=curved)
    pairs = _candidates(base, centres, m, 0.0)
    low = high = reach = np.zeros(count)
    slack = 0.0
    while on_surface:
        low, high = _height_bounds(pairs, amplitudes, count)
        reach = np.maximum(high, -low)
        if reach.max() <= slack:
            break
        slack = 1.5 * float(reach.max())
        pairs = _candidates(base, centres, m, slack)
    kept = pairs.distance - pairs.stretch * reach[pairs.patch] < 1.0 + _SLACK
    steepness = np.zeros(count)
    if on_surface:
        slopes = _steepness(pairs, amplitudes, low, high) * kept
        steepness += np.bincount(pairs.patch, slopes, count)
    return TouchingPairs(pairs.patch[kept], pairs.quadric[kept], reach, steepness)


def _starts(rows: Index, count: int) -> Index:
    return np.asarray(np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=count))]))


def corner_lists(elements: Index, count: int) -> tuple[Index, Index]:
    """For each of `count` vertices: the start of its list, and the corners (width * element + corner) around it."""
    flat = elements.reshape(-1)
    return _starts(flat, count), np.argsort(flat, kind="stable")


def gather_lists(triangles: Index, vertices: int, pairs: TouchingPairs, quadrics: int) -> list[Index]:
    """The first eight arrays of csrc/freeform/lists.def, in its order; the others belong to samples."""
    return [
        triangles,
        _starts(pairs.patch, len(triangles)),
        pairs.quadric,
        pairs.patch,
        _starts(pairs.quadric, quadrics),
        np.argsort(pairs.quadric, kind="stable"),
        *corner_lists(triangles, vertices),
    ]
