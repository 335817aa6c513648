"""Triangulation of polygons."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .content import Array, Index

__all__ = ["FaultyPolygons", "triangulate"]


class FaultyPolygons(NamedTuple):
    """Number of polygons with fewer than three corners, and of self-intersecting polygons."""

    small: int
    crossed: int


def triangulate(points: Array, corners: Index, sizes: Index) -> tuple[Index, Index, FaultyPolygons]:
    """Cut polygons into triangles without new vertices.

    A polygon is a fan from its vertex of the lowest number, so that neighbours are cut alike. Where the fan of a
    concave polygon would fold, ears are cut off one after another.

    Args:
        points: [N, 3].
        corners: vertex numbers of all polygons, one after another.
        sizes: corners of each polygon [n].

    Returns:
        Triangles [T, 3] in the order of the polygons, the polygon of each [T], and the counts of faulty polygons.
    """
    starts = np.cumsum(sizes) - sizes
    triangles, owners, crossed = [], [], 0
    for size in np.unique(sizes[sizes >= 3]):
        which = np.flatnonzero(sizes == size)
        rings = corners[starts[which][:, None] + np.arange(size)]
        turn = (rings.argmin(axis=1)[:, None] + np.arange(size)) % size
        rings = np.take_along_axis(rings, turn, axis=1)
        fans = np.stack([np.broadcast_to(rings[:, :1], rings[:, 1:-1].shape), rings[:, 1:-1], rings[:, 2:]], axis=2)
        for row in np.flatnonzero(_is_folded(points, rings, fans)):
            ears = _cut_ears(points, rings[row])
            if ears is None:
                crossed += 1
            else:
                fans[row] = ears
        triangles.append(fans.reshape(-1, 3))
        owners.append(np.repeat(which, size - 2))
    wrong = FaultyPolygons(int((sizes < 3).sum()), crossed)
    if not triangles:
        return np.empty((0, 3), dtype=np.int64), np.empty(0, dtype=np.int64), wrong
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(triangles)[order], owner[order], wrong


def _normals(points: Array, triangles: Index) -> Array:
    a, b, c = (points[triangles[..., k]] for k in range(3))
    return np.asarray(np.cross(b - a, c - a))


def _is_folded(points: Array, rings: Index, fans: Index) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Whether a triangle of a fan opposes the area vector of its polygon, beyond rounding."""
    normals = _normals(points, fans)
    total = normals.sum(axis=1, keepdims=True)
    along = np.einsum("ntk,ntk->nt", normals, np.broadcast_to(total, normals.shape))
    return np.asarray((along < -1e-9 * np.einsum("ntk,ntk->nt", total, total)).any(axis=1))


def _cut_ears(points: Array, ring: Index) -> Index | None:
    """Triangles [size - 2, 3] of a simple polygon, projected along its area vector; None if it intersects itself."""
    places = points[ring] - points[ring].mean(axis=0)
    area = np.cross(places, np.roll(places, -1, axis=0)).sum(axis=0)
    if not np.linalg.norm(area) > 0:
        return None
    normal = area / np.linalg.norm(area)
    across = np.eye(3)[np.abs(normal).argmin()]
    x = np.cross(across, normal) / np.linalg.norm(np.cross(across, normal))
    flat = places @ np.column_stack([x, np.cross(normal, x)])
    left, triangles, ear = list(range(len(ring))), [], 0
    while len(left) > 3:
        # continue next to the last ear
        turns = ((ear + k - 1) % len(left) for k in range(len(left)))
        ear = next((k for k in turns if _is_ear(flat, left, k)), -1)
        if ear < 0:
            return None
        triangles.append([left[ear - 1], left[ear], left[(ear + 1) % len(left)]])
        del left[ear]
    if _turn(*flat[left]) < 0:
        return None
    triangles.append(left)
    return np.asarray(ring[np.array(triangles)])


def _turn(a: Array, b: Array, c: Array) -> Array:
    """Twice the area of plane triangles, positive if counter-clockwise."""
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    return np.asarray(ux * vy - uy * vx)


def _is_ear(flat: Array, left: list[int], k: int) -> bool:
    """Whether corner k is convex and no other corner lies in the triangle with its neighbours."""
    a, b, c = flat[left[k - 1]], flat[left[k]], flat[left[(k + 1) % len(left)]]
    if not _turn(a, b, c) > 0:
        return False
    others = flat[[i for i in left if i not in (left[k - 1], left[k], left[(k + 1) % len(left)])]]
    inside = (_turn(a, b, others) >= 0) & (_turn(b, c, others) >= 0) & (_turn(c, a, others) >= 0)
    # corners at the position of a or c are seams to a hole
    seams = (others == a).all(axis=1) | (others == c).all(axis=1)
    return not bool((inside & ~seams).any())
