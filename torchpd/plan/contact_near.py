"""Pairs of primitives of a body that rest near each other, and pairs that ties join."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.closest_points import segment_distances, triangle_distances
from .contact_tree import Boxes, ContactTree, contact_tree, meeting

__all__ = ["NearPairs", "Primitives", "least_apart", "near_pairs", "own_vertices"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Primitives:
    """Surfaces and rods of the bodies that take part, among N vertices, and trees over their primitives."""

    rest: Array  # [N, 3] m
    body: Index  # [N]
    vertices: Index  # [S] ends of the edges, increasing
    triangles: Index  # [T, 3]
    edges: Index  # [E, 2] of the triangles and rods, each once, the lower vertex first, in increasing order
    vertex_tree: ContactTree  # over the rows of `vertices`
    triangle_tree: ContactTree
    edge_tree: ContactTree

    @staticmethod
    def of(rest: Array, body: Index, triangles: Index, segments: Index) -> Primitives:
        """Vertices and edges of triangles [T, 3] and segments of rods [n, 2], with trees."""
        sides = np.sort(np.concatenate([triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), segments]), axis=1)
        edges = np.stack(np.divmod(np.unique(sides[:, 0] * len(rest) + sides[:, 1]), len(rest)), axis=1)
        vertices = np.unique(edges)
        trees = [contact_tree(rest[of].mean(axis=1), body[of[:, 0]]) for of in (vertices[:, None], triangles, edges)]
        return Primitives(rest, body, vertices, triangles, edges, *trees)

    @property
    def edge_lengths(self) -> Array:
        """[E] m."""
        return np.asarray(np.linalg.norm(self.rest[self.edges[:, 1]] - self.rest[self.edges[:, 0]], axis=1))

    def point_keys(self, vertex: Index, triangle: Index) -> Index:
        """Numbers of pairs of vertices and triangles."""
        return vertex * len(self.triangles) + triangle

    def edge_keys(self, first: Index, second: Index) -> Index:
        """Numbers of pairs of edges, above those of all vertices and triangles."""
        first, second = np.minimum(first, second), np.maximum(first, second)
        return len(self.rest) * len(self.triangles) + first * len(self.edges) + second


@dataclass(frozen=True, eq=False)
class NearPairs:
    """Pairs of a vertex and a triangle, or of two edges, with a thickness of their own.

    The key of a vertex and a triangle is `vertex * T + triangle`, that of two edges `N * T + first * E + second` with
    `first < second`.
    """

    keys: Index  # [m] increasing
    thickness: Array  # [m] m, half of the distance at rest; 0: a tie joins the sides, which are no pair


def near_pairs(surface: Primitives, touching: Mask, thickness: float, tied: Index) -> NearPairs:
    """Pairs of one body that rest nearer than twice the thickness, and those whose sides a tie joins.

    Args:
        surface: the primitives.
        touching: [bodies] whether parts of a body meet.
        thickness: r [m].
        tied: vertices [n, 2] that ties join.

    Raises:
        ValueError: sides of a pair of one body touch at rest, and no tie joins them.
    """
    joined = _tied_keys(surface, tied)
    keys, corners, distance = _near(surface, touching, np.full(len(surface.rest), thickness), joined)
    found = distance < 2.0 * thickness
    keys, corners, distance = keys[found], corners[found], distance[found]
    if not distance.all():
        where = own_vertices(surface.body, corners[int(distance.argmin())].tolist())
        raise ValueError(
            f"Contact: parts of a body must be apart at rest, got distance 0 between {where} "
            f"({np.count_nonzero(distance == 0.0)} pairs in all); merge the vertices, give the parts as bodies of "
            "their own, or leave the body out of self_contact"
        )
    keys = np.concatenate([joined, keys])
    order = np.argsort(keys)
    return NearPairs(keys[order], np.concatenate([np.zeros(len(joined)), 0.5 * distance])[order])


def least_apart(surface: Primitives, of: Mask, most: Array, tied: Index) -> Array:
    """Least distance at rest [bodies] m between parts of a body that share no vertex, 0 for bodies not asked.

    Args:
        surface: the primitives.
        of: [bodies] whether the distance of a body is wanted.
        most: [bodies] m, beyond which no distance is looked for.
        tied: vertices [n, 2] that ties join.
    """
    _, corners, distance = _near(surface, of, 0.5 * most[surface.body], _tied_keys(surface, tied))
    least = np.where(of, most, 0.0)
    np.minimum.at(least, surface.body[corners[:, 0]], distance)
    return least


def own_vertices(body: NDArray[Any], vertices: list[int]) -> str:
    """Name vertices of one body by its own numbers; `body` [N] has the body of each vertex."""
    number = int(body[vertices[0]])
    start = int(np.argmax(body == number))
    return f"vertices {[vertex - start for vertex in vertices]} of body {number}"


def _near(surface: Primitives, touching: Mask, margin: Array, joined: Index) -> tuple[Index, Index, Array]:
    """Keys, corners [n, 4] and distances [n] m of pairs of one body whose boxes meet, but for `joined` keys."""
    found = zip(_near_points(surface, touching, margin), _near_edges(surface, touching, margin), strict=True)
    keys, corners, distance = (np.concatenate(part) for part in found)
    keep = ~np.isin(keys, joined)
    return keys[keep], corners[keep], distance[keep]


def _boxes(surface: Primitives, touching: Mask, tree: ContactTree, corners: Index, margins: Array) -> Boxes:
    """Boxes of primitives, wider by margins [N] m; those of bodies that do not touch themselves meet nothing."""
    x, margin = surface.rest[corners], margins[corners[:, :1]]
    out = ~touching[surface.body[corners[:, :1]]]
    return Boxes.of(tree, np.where(out, np.inf, x.min(axis=1) - margin), np.where(out, -np.inf, x.max(axis=1) + margin))


def _apart(one: Index, other: Index) -> Mask:
    """Whether sides [n, a] and [n, b] have no common vertex [n]."""
    apart = np.ones(len(one), dtype=np.bool_)
    for corner in one.T:
        for beside in other.T:
            apart &= corner != beside
    return apart


def _near_points(surface: Primitives, touching: Mask, margin: Array) -> tuple[Index, Index, Array]:
    """Keys, corners [n, 4] and distances [n] m of vertices and triangles of one body whose boxes meet."""
    points, faces = surface.vertices[:, None], surface.triangles
    row, triangle = meeting(
        _boxes(surface, touching, surface.vertex_tree, points, margin),
        _boxes(surface, touching, surface.triangle_tree, faces, margin),
    )
    corners = np.concatenate([points[row], faces[triangle]], axis=1)
    keep = _apart(corners[:, :1], corners[:, 1:]) & (surface.body[corners[:, 0]] == surface.body[corners[:, 3]])
    corners, triangle = corners[keep], triangle[keep]
    distance = triangle_distances(surface.rest[corners[:, 0]], surface.rest[corners[:, 1:]])
    return surface.point_keys(corners[:, 0], triangle), corners, distance


def _near_edges(surface: Primitives, touching: Mask, margin: Array) -> tuple[Index, Index, Array]:
    """Keys, corners [n, 4] and distances [n] m of edges of one body whose boxes meet."""
    boxes = _boxes(surface, touching, surface.edge_tree, surface.edges, margin)
    first, second = meeting(boxes, boxes)
    corners = np.concatenate([surface.edges[first], surface.edges[second]], axis=1)
    keep = _apart(corners[:, :2], corners[:, 2:]) & (surface.body[corners[:, 0]] == surface.body[corners[:, 3]])
    corners, first, second = corners[keep], first[keep], second[keep]
    distance = segment_distances(surface.rest[corners[:, :2]], surface.rest[corners[:, 2:]])
    return surface.edge_keys(first, second), corners, distance


def _tied_keys(surface: Primitives, tied: Index) -> Index:
    """Keys of the pairs in which a side has a vertex that a tie joins to one of the other side."""
    both = np.concatenate([tied, tied[:, ::-1]])
    row, triangle = _around(surface.triangles, both[:, 1])
    points = both[row, 0]
    used = np.isin(points, surface.vertices) & _apart(points[:, None], surface.triangles[triangle])
    keys = surface.point_keys(points[used], triangle[used])
    row, first = _around(surface.edges, tied[:, 0])
    beside, second = _around(surface.edges, tied[row, 1])
    first = first[beside]
    used = _apart(surface.edges[first], surface.edges[second])
    return np.unique(np.concatenate([keys, surface.edge_keys(first[used], second[used])]))


def _around(primitives: Index, vertices: Index) -> tuple[Index, Index]:
    """Rows of `vertices` [n] and numbers of `primitives` [P, k] with that corner: all such couples."""
    order = np.argsort(primitives, axis=None, kind="stable")
    corners = primitives.reshape(-1)[order]
    begin = np.searchsorted(corners, vertices)
    count = np.searchsorted(corners, vertices, side="right") - begin
    row = np.repeat(np.arange(len(vertices)), count)
    place = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count) + begin[row]
    return row, order[place] // primitives.shape[1]
