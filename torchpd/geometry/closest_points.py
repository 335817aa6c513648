"""Closest points of segments, triangles and tetrahedra, as fixed combinations of their corners; distances of pairs."""

from __future__ import annotations

from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

__all__ = ["Closest", "closest_points", "segment_distances", "triangle_distances"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_EDGES = ((0, 1), (1, 2), (2, 0))
# pairs of a point and an element compared at a time, to bound memory
_CHUNK = 200_000


class Closest(NamedTuple):
    """Closest point of each query."""

    elements: Index  # [P] number of the element that holds it
    weights: Array  # [P, corners] barycentric coordinates, not negative
    distances: Array  # [P] m, 0 inside a tetrahedron


def closest_points(points: Array, vertices: Array, elements: Index) -> Closest:
    """Closest points [P] of the elements [E, 2], [E, 3] or [E, 4]; of equal ones that of the first element."""
    corners = vertices[elements]
    centres = corners.mean(axis=1)
    radii = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
    # A centre is a point of its element: the closest point is no farther away than the nearest centre.
    nearest = cKDTree(centres).query(points)[0]
    near = cKDTree(centres).query_ball_point(points, (nearest + radii.max()) * (1.0 + 1e-9))
    sizes = np.fromiter(map(len, near), dtype=np.int64, count=len(near))
    element = np.fromiter(chain.from_iterable(near), dtype=np.int64, count=int(sizes.sum()))
    point = np.repeat(np.arange(len(points)), sizes)
    reach = np.linalg.norm(points[point] - centres[element], axis=1) - radii[element]
    close = reach <= nearest[point] * (1.0 + 1e-9)
    point, element = point[close], element[close]
    weights = np.empty((len(point), elements.shape[1]))
    for start in range(0, len(point), _CHUNK):
        pairs = slice(start, start + _CHUNK)
        weights[pairs] = _weights(points[point[pairs]], corners[element[pairs]])
    offset = points[point] - np.einsum("pa,pak->pk", weights, corners[element])
    distance = np.linalg.norm(offset, axis=1)
    if elements.shape[1] == 4:
        distance[_strictly_inside(weights)] = 0.0
    order = np.lexsort((element, distance, point))
    best = order[np.unique(point[order], return_index=True)[1]]
    return Closest(element[best], weights[best], distance[best])


def triangle_distances(points: Array, corners: Array) -> Array:
    """Distances [P] m of points from one triangle each [P, 3, 3]."""
    arms = corners - points[:, None]
    return _lengths(np.einsum("pa,pak->pk", _on_triangles(points, corners), arms))


def segment_distances(first: Array, second: Array) -> Array:
    """Distances [P] m between two segments each [P, 2, 3].

    The least of the four ends from the other segment, and of the lines where their closest points lie inside.
    """
    ends = [
        _lengths(np.einsum("pa,pak->pk", _on_segments(one[:, end], other), other - one[:, end, None]))
        for one, other in ((first, second), (second, first))
        for end in (0, 1)
    ]
    u, v, w = first[:, 1] - first[:, 0], second[:, 1] - second[:, 0], first[:, 0] - second[:, 0]
    a, b, c, d, e = (np.einsum("pk,pk->p", *pair) for pair in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    determinant = a * c - b * b
    safe = np.where(determinant > 0.0, determinant, 1.0)
    s, t = (b * e - c * d) / safe, (a * e - b * d) / safe
    inside = (determinant > 0.0) & (s >= 0.0) & (s <= 1.0) & (t >= 0.0) & (t <= 1.0)
    between = _lengths(w + s[:, None] * u - t[:, None] * v)
    return np.asarray(np.minimum(np.min(ends, axis=0), np.where(inside, between, np.inf)))


def _lengths(vectors: Array) -> Array:
    return np.asarray(np.sqrt(np.einsum("pk,pk->p", vectors, vectors)))


def _weights(points: Array, corners: Array) -> Array:
    """Weights of the closest points of one element each [P, corners, 3]."""
    count = corners.shape[1]
    if count == 2:
        return _on_segments(points, corners)
    if count == 3:
        return _on_triangles(points, corners)
    return _in_tets(points, corners)


def _strictly_inside(weights: Array) -> NDArray[np.bool_]:
    return np.asarray((weights > 0.0).all(axis=1))


def _on_segments(points: Array, corners: Array) -> Array:
    edge = corners[:, 1] - corners[:, 0]
    length = np.einsum("pk,pk->p", edge, edge)
    along = np.einsum("pk,pk->p", edge, points - corners[:, 0]) / np.where(length > 0.0, length, 1.0)
    along = np.clip(along, 0.0, 1.0)
    return np.stack([1.0 - along, along], axis=1)


def _on_triangles(points: Array, corners: Array) -> Array:
    """Foot of the perpendicular if it lies inside, else the closest point of an edge."""
    first, second, away = (end - corners[:, 0] for end in (corners[:, 1], corners[:, 2], points))
    a, b, c = (np.einsum("pk,pk->p", one, other) for one, other in ((first, first), (first, second), (second, second)))
    d, e = (np.einsum("pk,pk->p", edge, away) for edge in (first, second))
    determinant = a * c - b * b
    safe = np.where(determinant > 0.0, determinant, 1.0)
    u, v = (c * d - b * e) / safe, (a * e - b * d) / safe
    weights = np.stack([1.0 - u - v, u, v], axis=1)
    outside = (weights < 0.0).any(axis=1) | ~(determinant > 0.0)
    weights[outside] = _closest_of(points[outside], corners[outside], _EDGES)
    return weights


def _in_tets(points: Array, corners: Array) -> Array:
    """The point itself if it lies inside, else the closest point of a face. Volumes are positive."""
    edges = corners[:, 1:] - corners[:, :1]
    inner = np.linalg.solve(edges.transpose(0, 2, 1), (points - corners[:, 0])[:, :, None])[:, :, 0]
    weights = np.concatenate([1.0 - inner.sum(axis=1, keepdims=True), inner], axis=1)
    outside = (weights < 0.0).any(axis=1)
    weights[outside] = _closest_of(points[outside], corners[outside], ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1)))
    return weights


def _closest_of(points: Array, corners: Array, parts: tuple[tuple[int, ...], ...]) -> Array:
    """Weights of the closest point among parts of each element, edges or faces by their corners."""
    weights = np.zeros(corners.shape[:2])
    least = np.full(len(points), np.inf)
    for part in parts:
        chosen = list(part)
        own = _weights(points, corners[:, chosen])
        distance = np.linalg.norm(points - np.einsum("pa,pak->pk", own, corners[:, chosen]), axis=1)
        nearer = np.flatnonzero(distance < least)
        least[nearer] = distance[nearer]
        weights[nearer] = 0.0
        weights[nearer[:, None], chosen] = own[nearer]
    return weights
