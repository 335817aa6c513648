"""Overlap of bodies: points of one, of a solid those behind its surface, that lie inside tetrahedra of another."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .mesh_quality import shape_gradients
from .tet_mesh import TetMesh

__all__ = ["Overlap", "boxes_meet", "find_overlaps"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

_PULL = 1e-3  # share of the distance from a corner to a centroid; shallower overlaps are not found

_ROUNDING = 1e-9  # of barycentric coordinates, since vertices may lie on faces within a body


class Overlap(NamedTuple):
    """Two bodies that overlap."""

    first: int  # number of the body
    second: int
    points: int  # points of either that lie inside the other


def find_overlaps(meshes: Sequence[TetMesh | None], places: Sequence[Array]) -> list[Overlap]:
    """Pairs of bodies of which one has points inside the other.

    The points of a solid are corners and centroids of tets behind the surface, those of surfaces and rods are their
    vertices. An overlap between two such points, where edges cross a thin part, is not found. Pairs whose bounding
    boxes are apart cost nothing.

    Args:
        meshes: of the bodies; None for surfaces and rods, which have no inside.
        places: their vertices [V, 3] m.
    """
    lows, highs = (np.stack([end(place, axis=0) for place in places]) for end in (np.min, np.max))
    found = []
    for first, second in _near(lows, highs):
        low = np.maximum(lows[first], lows[second])
        high = np.minimum(highs[first], highs[second])
        points = sum(
            _count_inside(_points(meshes[one], places[one], low, high), places[other], solid.tets, low, high)
            for one, other in ((first, second), (second, first))
            if (solid := meshes[other]) is not None
        )
        if points:
            found.append(Overlap(first, second, points))
    return found


def boxes_meet(lows: Array, highs: Array) -> Mask:
    """Whether some boxes meet in each environment [B], by their corners [B, bodies, 3]; False for NaN."""
    found = np.zeros(len(lows), dtype=np.bool_)
    for first in range(lows.shape[1] - 1):
        found |= _overlap_of(first, lows, highs).any(axis=1)
    return found


def _overlap_of(first: int, lows: Array, highs: Array) -> Mask:
    """Whether the box of one body meets those of later bodies [B, bodies - 1 - first]."""
    later, one = slice(first + 1, None), slice(first, first + 1)
    low, high = np.maximum(lows[:, later], lows[:, one]), np.minimum(highs[:, later], highs[:, one])
    return np.asarray((low <= high).all(axis=-1))


def _near(lows: Array, highs: Array) -> Iterator[tuple[int, int]]:
    """Pairs of bodies whose boxes meet, by the corners of the boxes [bodies, 3]."""
    for first in range(len(lows) - 1):
        for later in np.flatnonzero(_overlap_of(first, lows[None], highs[None])):
            yield first, first + 1 + int(later)


def _points(mesh: TetMesh | None, place: Array, low: Array, high: Array) -> Array:
    """Points of a body in a box.

    Of a solid those behind its surface: centroids of tets, and corners pulled slightly towards a centroid. So solids
    that share a face do not overlap. If both have the same grid, no corner lies on a face of the other.
    """
    if mesh is None:
        return np.asarray(place[np.all((place >= low) & (place <= high), axis=1)])
    outer = np.zeros(len(place), dtype=np.bool_)
    outer[mesh.boundary()] = True
    behind = mesh.tets[outer[mesh.tets].sum(axis=1) >= 3]
    centroids = place[behind].mean(axis=1)
    corners, where = np.unique(behind, return_index=True)
    pulled = (1.0 - _PULL) * place[corners] + _PULL * centroids[where // 4]
    points = np.concatenate([pulled, centroids])
    return np.asarray(points[np.all((points >= low) & (points <= high), axis=1)])


def _count_inside(points: Array, vertices: Array, tets: Index, low: Array, high: Array) -> int:
    """Number of points in a box that lie inside some tet."""
    corners = vertices[tets]
    meets = np.all((corners.min(axis=1) <= high) & (corners.max(axis=1) >= low), axis=1)
    tets, corners = tets[meets], corners[meets]
    if not (len(points) and len(tets)):
        return 0
    centres = corners.mean(axis=1)
    radii = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
    near = cKDTree(points).query_ball_point(centres, radii)
    sizes = np.fromiter(map(len, near), dtype=np.int64, count=len(near))
    which = np.fromiter(chain.from_iterable(near), dtype=np.int64, count=int(sizes.sum()))
    tet = np.repeat(np.arange(len(tets)), sizes)
    with np.errstate(all="ignore"):  # flat tets divide by zero and contain nothing
        gradients, _ = shape_gradients(vertices, tets)
        weights = np.einsum("pak,pk->pa", gradients[tet], points[which] - corners[tet, 0])
        weights[:, 0] = 1.0 - weights[:, 1:].sum(axis=1)
    return len(np.unique(which[weights.min(axis=1) > -_ROUNDING]))
