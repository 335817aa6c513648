"""Which bodies of a scene reach into each other: points at the surface of one lie inside tetrahedra of another."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .mesh import TetMesh
from .quality import shape_gradients

__all__ = ["Overlap", "boxes_meet", "find_overlaps"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

_PULL = 1e-3  # of the way from a corner to a centroid: bodies that reach into each other by less are not seen


class Overlap(NamedTuple):
    """Two bodies that reach into each other."""

    first: int  # number of the body
    second: int
    points: int  # at the surface of either that lie inside the other


def find_overlaps(meshes: Sequence[TetMesh], places: Sequence[Array] | None = None) -> list[Overlap]:
    """Pairs of bodies, by their vertices [V, 3] m (those of the meshes), of which one has points inside the other.

    Points are the corners and the centroids of tets behind the surface: where edges alone cross something thin, between
    two such points, that is not seen. Pairs whose bounding boxes are apart cost nothing, others as much as lies
    where their boxes overlap.
    """
    places = [mesh.vertices for mesh in meshes] if places is None else places
    lows, highs = (np.stack([end(place, axis=0) for place in places]) for end in (np.min, np.max))
    found = []
    for first, second in _near(lows, highs):
        low = np.maximum(lows[first], lows[second])
        high = np.minimum(highs[first], highs[second])
        points = sum(
            _count_inside(_points(meshes[one], places[one], low, high), places[other], meshes[other].tets, low, high)
            for one, other in ((first, second), (second, first))
        )
        if points:
            found.append(Overlap(first, second, points))
    return found


def boxes_meet(lows: Array, highs: Array) -> Mask:
    """In which environments some boxes overlap [B], by their corners [B, bodies, 3]; not where these are no numbers."""
    found = np.zeros(len(lows), dtype=np.bool_)
    for first in range(lows.shape[1] - 1):
        found |= _overlap_of(first, lows, highs).any(axis=1)
    return found


def _overlap_of(first: int, lows: Array, highs: Array) -> Mask:
    """Whether the box of one body overlaps those of the later ones [B, bodies - 1 - first]."""
    later, one = slice(first + 1, None), slice(first, first + 1)
    low, high = np.maximum(lows[:, later], lows[:, one]), np.minimum(highs[:, later], highs[:, one])
    return np.asarray((low < high).all(axis=-1))


def _near(lows: Array, highs: Array) -> Iterator[tuple[int, int]]:
    """Pairs of bodies whose boxes overlap, by the corners of these [bodies, 3]."""
    for first in range(len(lows) - 1):
        for later in np.flatnonzero(_overlap_of(first, lows[None], highs[None])):
            yield first, first + 1 + int(later)


def _points(mesh: TetMesh, place: Array, low: Array, high: Array) -> Array:
    """Points behind the surface of a body, within a box: centroids of tets, and corners pulled a little towards one.

    So bodies that share a face do not overlap, and corners lie on no face of the other where both have the same grid.
    """
    outer = np.zeros(len(place), dtype=np.bool_)
    outer[mesh.boundary()] = True
    behind = mesh.tets[outer[mesh.tets].sum(axis=1) >= 3]
    centroids = place[behind].mean(axis=1)
    corners, where = np.unique(behind, return_index=True)
    pulled = (1.0 - _PULL) * place[corners] + _PULL * centroids[where // 4]
    points = np.concatenate([pulled, centroids])
    return np.asarray(points[np.all((points >= low) & (points <= high), axis=1)])


def _count_inside(points: Array, vertices: Array, tets: Index, low: Array, high: Array) -> int:
    """How many points within a box lie inside some tet."""
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
    with np.errstate(all="ignore"):  # flat tets have no inside
        gradients, _ = shape_gradients(vertices, tets)
        weights = np.einsum("pak,pk->pa", gradients[tet], points[which] - corners[tet, 0])
        weights[:, 0] = 1.0 - weights[:, 1:].sum(axis=1)
    return len(np.unique(which[weights.min(axis=1) > 0.0]))
