"""Four-vertex constraints of free-form patches: placement of the fourth vertex of every patch.

A constraint without neighbours resists only stretching of its patch. Bending resistance needs fourth vertices shared by
neighbours: points inside a closed body, or a second layer under a sheet.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError, cKDTree

from ..geometry.visibility import depths, is_blocked

__all__ = ["Constraints", "prisms", "skeleton"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

LEAST_VOLUME = 1e-3  # over the mean of the patches, and least height over the longest edge: stiffness grows as 1 / v
_LEAST_FILL = 1e-2  # the same for constraints between apexes, none of which is necessary
_VALENCE = 80  # most patches per apex: one row of the diagonal solve gathers them all
_SPARE = 1.25  # spare room, for patches that do not see their nearest apex


class Constraints(NamedTuple):
    """Tetrahedra between the vertices of patches and the apexes of the body."""

    points: Array  # [V + K, 3] vertices of the patches, then apexes [m]
    tets: Index  # [E, 4] of positive volume; in a skeleton, the first P are those of the patches
    patch: Index  # [E] patch of each constraint, -1 between apexes
    share: float  # sum of the volumes of the constraints / volume of the body


def volumes(points: Array, tets: Index) -> Array:
    """Signed volumes [E] in m^3."""
    corners = points[tets]
    return np.asarray(np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0)


def prisms(vertices: Array, triangles: Index, directors: Array, thickness: float) -> Constraints:
    """A second layer at distance `thickness` under the patches, with three tetrahedra per prism.

    The tetrahedra of a prism cross it in the order of vertex numbers, so that neighbours split their common
    quadrilateral along the same diagonal.
    """
    count = len(vertices)
    points = np.concatenate([vertices, vertices - thickness * directors])
    a, b, c = np.sort(triangles, axis=1).T
    walks = [(a, b, c, c + count), (a, b, b + count, c + count), (a, a + count, b + count, c + count)]
    tets = np.stack([np.stack(walk, axis=1) for walk in walks], axis=1)
    # the second layer is behind counter-clockwise triangles: the sign alternates along the path, and flips where
    # sorting has reversed the triangle
    ordered = np.stack([a, b, c], axis=1)
    forward = np.any([(np.roll(triangles, turn, axis=1) == ordered).all(axis=1) for turn in range(3)], axis=0)
    turned = forward[:, None] == np.array([True, False, True])
    tets = np.where(turned[..., None], tets[..., [1, 0, 2, 3]], tets).reshape(-1, 4)
    patch = np.repeat(np.arange(len(triangles)), 3)
    _refuse_flat(points, tets, patch, "lower thickness, or pass directors that point away from the sheet on one side")
    return Constraints(points, tets, patch, 1.0)


def skeleton(vertices: Array, triangles: Index) -> Constraints:
    """Apexes inside a closed body, one tetrahedron per patch, and tetrahedra between apexes.

    Apexes are centroids of clusters of points half way from the patches to the centroid of the body. A patch takes the
    nearest apex that it sees, or a point of its own under it. Tetrahedra fill the space along edges and around vertices
    whose patches have different apexes, and between apexes (Delaunay).
    """
    corners = vertices[triangles]
    body = float(np.linalg.det(corners).sum() / 6.0)  # volume by the divergence theorem
    _check_closed(triangles, body)
    middle = corners.mean(axis=1)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    inner = middle - 0.25 * depths(middle, -normal, corners)[:, None] * normal
    count = 1 if len(triangles) <= _VALENCE else int(np.ceil(_SPARE * len(triangles) / _VALENCE))
    while True:
        apexes = _clusters(inner, count)
        apex = _nearest_seen(corners, apexes, least=LEAST_VOLUME * body / len(triangles))
        if (apex >= 0).all() or 16 * count > len(triangles):
            break
        count *= 2
    lonely = np.flatnonzero(apex < 0)
    apex[lonely] = len(apexes) + np.arange(len(lonely))
    used, apex = np.unique(apex, return_inverse=True)
    points = np.concatenate([vertices, np.concatenate([apexes, inner[lonely]])[used]])
    own = np.column_stack([triangles[:, [0, 2, 1]], len(vertices) + apex])
    _refuse_flat(points, own, np.arange(len(own)), "merge or enlarge the triangles there, or take apex='prism'")
    fill = _fill(points, triangles, len(vertices) + apex, corners, float(volumes(points, own).mean()))
    tets = np.concatenate([own, fill])
    patch = np.concatenate([np.arange(len(own)), np.full(len(fill), -1)])
    return Constraints(points, tets, patch, float(volumes(points, tets).sum() / body))


def _check_closed(triangles: Index, body: float) -> None:
    _, times = np.unique(np.sort(_sides(triangles), axis=1), axis=0, return_counts=True)
    if (times != 2).any():
        raise ValueError(
            "PatchBody.patches: apex='skeleton' needs a closed surface, every edge in two patches, got "
            f"{int((times == 1).sum())} edges of one patch; take apex='prism'"
        )
    if not body > 0.0:
        raise ValueError(
            f"PatchBody.patches must bound a body from outside, got a volume of {body:.3g} m^3; turn the triangles "
            "round (trimesh.repair.fix_normals)"
        )


def _sides(triangles: Index) -> Index:
    """The directed edges [3 P, 2]: all first sides, then all second, then all third."""
    return np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)])


def _refuse_flat(points: Array, tets: Index, patch: Index, fix: str) -> None:
    size = volumes(points, tets)
    least = LEAST_VOLUME * float(np.abs(size).mean())
    bad = np.flatnonzero(~(size >= least) | ~(_flatness(points, tets) > LEAST_VOLUME))
    if len(bad):
        raise ValueError(
            f"PatchBody.patches: constraints must have at least {LEAST_VOLUME:g} of their mean volume "
            f"({least:.3g} m^3) and not be flat, got {size[bad[0]]:.3g} m^3 under patch {int(patch[bad[0]])} "
            f"({len(bad)} in all); {fix}"
        )


def _flatness(points: Array, tets: Index) -> Array:
    """Least height of each tetrahedron over its longest edge [E]."""
    corners = points[tets]
    faces = [corners[:, [(k + j) % 4 for j in (1, 2, 3)]] for k in range(4)]
    area = np.max([np.linalg.norm(np.cross(f[:, 1] - f[:, 0], f[:, 2] - f[:, 0]), axis=1) for f in faces], axis=0)
    edges = corners[:, [1, 2, 3, 2, 3, 3]] - corners[:, [0, 0, 0, 1, 1, 2]]
    return np.asarray(6.0 * np.abs(volumes(points, tets)) / area / np.linalg.norm(edges, axis=2).max(axis=1))


def _clusters(points: Array, count: int, *, rounds: int = 30) -> Array:
    """Centroids of k-means clusters, started from points far from one another; deterministic."""
    middle = points.mean(axis=0, keepdims=True)
    means = middle if count == 1 else points[[int(np.linalg.norm(points - middle, axis=1).argmax())]]
    for _ in range(1, count):
        away = cKDTree(means).query(points)[0]
        means = np.concatenate([means, points[[int(away.argmax())]]])
    for _ in range(rounds):
        label = cKDTree(means).query(points)[1]
        size = np.bincount(label, minlength=count)
        total = np.stack([np.bincount(label, weights=points[:, k], minlength=count) for k in range(3)], axis=1)
        moved = np.where(size[:, None] > 0, total / np.maximum(size, 1)[:, None], means)
        if np.array_equal(moved, means):
            break
        means = moved
    return means


def _nearest_seen(corners: Array, apexes: Array, *, least: float) -> Index:
    """The nearest apex [P] that each patch sees and that has room left; -1 without one.

    Works in rounds. Every patch without an apex asks for the nearest one not yet asked. Each apex accepts the nearest
    patches that see it while it has room.
    """
    middle = corners.mean(axis=1)
    reach = np.linalg.norm(middle[:, None] - apexes, axis=2)
    for number, place in enumerate(apexes):
        tets = np.concatenate([corners[:, [0, 2, 1]], np.broadcast_to(place, (len(corners), 1, 3))], axis=1)
        rows = np.arange(4 * len(tets)).reshape(-1, 4)
        flat = tets.reshape(-1, 3)
        fit = (volumes(flat, rows) >= least) & (_flatness(flat, rows) > 10.0 * LEAST_VOLUME)
        reach[~fit, number] = np.inf
    apex = np.full(len(corners), -1)
    room = np.full(len(apexes), _VALENCE)
    for _ in range(len(apexes)):
        asking = np.flatnonzero((apex < 0) & np.isfinite(reach).any(axis=1))
        if not len(asking):
            break
        wanted = reach[asking].argmin(axis=1)
        away = reach[asking, wanted]
        reach[asking, wanted] = np.inf
        seen = ~is_blocked(middle[asking], apexes[wanted], corners)
        order = np.flatnonzero(seen)[np.argsort(away[seen], kind="stable")]
        for row in order.tolist():
            if room[wanted[row]] > 0:
                room[wanted[row]] -= 1
                apex[asking[row]] = wanted[row]
    return apex


def _fill(points: Array, triangles: Index, apex: Index, corners: Array, mean: float) -> Index:
    """Tetrahedra [F, 4] between apexes: over edges, around vertices, and among apexes that see one another."""
    sides = _sides(triangles)
    order = np.lexsort((sides.max(axis=1), sides.min(axis=1)))
    left, right = order[0::2], order[1::2]  # the surface is closed: sides come in pairs
    owner = np.tile(apex, 3)
    differ = owner[left] != owner[right]
    over = np.column_stack([sides[left], owner[left], owner[right]])[differ]
    candidates = [over, _around_vertices(triangles, apex), _among_apexes(points, np.unique(apex), corners)]
    tets = np.concatenate(candidates)
    size = volumes(points, tets)
    tets = np.where((size < 0.0)[:, None], tets[:, [1, 0, 2, 3]], tets)
    sound = (np.abs(size) >= _LEAST_FILL * mean) & (_flatness(points, tets) > _LEAST_FILL)
    return tets[sound]


def _around_vertices(triangles: Index, apex: Index) -> Index:
    """Tetrahedra at vertices where three or more apexes meet: the vertex and neighbouring apexes, in their order."""
    pairs = np.unique(np.column_stack([triangles.reshape(-1), np.repeat(apex, 3)]), axis=0)
    starts = np.flatnonzero(np.diff(pairs[:, 0], prepend=-1))
    tets = [
        (int(pairs[first, 0]), int(pairs[first, 1]), int(pairs[k, 1]), int(pairs[k + 1, 1]))
        for first, last in zip(starts, np.append(starts[1:], len(pairs)), strict=True)
        for k in range(first + 1, last - 1)
    ]
    return np.array(tets, dtype=np.int64).reshape(-1, 4)


def _among_apexes(points: Array, apexes: Index, corners: Array) -> Index:
    """Delaunay tetrahedra of apexes whose six edges all stay inside the body."""
    none = np.zeros((0, 4), dtype=np.int64)
    if len(apexes) < 5:
        return apexes[None] if len(apexes) == 4 else none
    try:
        tets = apexes[Delaunay(points[apexes]).simplices.astype(np.int64)]
    except QhullError:  # all apexes in one plane
        return none
    edges = tets[:, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]].reshape(-1, 2)
    blocked = is_blocked(points[edges[:, 0]], points[edges[:, 1]], corners).reshape(-1, 6)
    return np.asarray(tets[~blocked.any(axis=1)])
