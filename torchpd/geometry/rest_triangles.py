"""Triangles of a sheet in their rest planes, and its interior edges as hinges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Hinges", "RestTriangles", "find_hinges", "rest_triangles"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# A triangle is degenerate if twice its area is below this share of its longest edge squared.
_FLATTEST = 1e-5


@dataclass(frozen=True, eq=False)
class RestTriangles:
    """Triangles at rest, each in a plane of its own."""

    gradients: Array  # [F, 3, 2] of the linear shape functions, in the plane [1/m]
    areas: Array  # [F] m^2
    cotangents: Array  # [F, 3] of the angle at each corner
    frames: Array | None  # [F, 3, 2] orthonormal columns that span the plane in space; None for planes given by UVs


@dataclass(frozen=True, eq=False)
class Hinges:
    """Interior edges: corners x0, x1 of the edge, x2 and x3 opposite, with the two triangles.

    The curvature vector is sum c_a x_a / A (Bergou et al. 2006), with weights by the cotangents of rest angles:

        c = (c03 + c04, c01 + c02, -c01 - c03, -c02 - c04)

    c01 and c03 are those of the first triangle at x0 and x1, c02 and c04 those of the second.
    """

    corners: Index  # [H, 4]
    triangles: Index  # [H, 2]
    weights: Array  # [H, 4] c
    areas: Array  # [H] A = A0 + A1 [m^2]


def rest_triangles(name: str, corners: Array, triangles: Index) -> RestTriangles:
    """Rest shapes from the corners of each triangle, in space [F, 3, 3] or in a plane [F, 3, 2].

    `name` is the argument that errors about degenerate triangles name.
    """
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    frames = None
    if corners.shape[2] == 3:
        across = np.cross(np.cross(first, second), first)
        _refuse_degenerate(name, corners, np.linalg.norm(np.cross(first, second), axis=1), triangles)
        frames = np.stack([_unit(first), _unit(across)], axis=2)
        first, second = (np.einsum("fk,fkd->fd", edge, frames) for edge in (first, second))
    determinants = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    _refuse_degenerate(name, corners, np.abs(determinants), triangles)
    gradients = np.empty((len(triangles), 3, 2))
    gradients[:, 1] = np.stack([second[:, 1], -second[:, 0]], axis=1) / determinants[:, None]
    gradients[:, 2] = np.stack([-first[:, 1], first[:, 0]], axis=1) / determinants[:, None]
    gradients[:, 0] = -gradients[:, 1] - gradients[:, 2]
    areas = np.abs(determinants) / 2.0
    return RestTriangles(gradients, areas, _cotangents(first, second, 2.0 * areas), frames)


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1)[:, None])


def _cotangents(first: Array, second: Array, doubled: Array) -> Array:
    """Cotangents [F, 3] from two edges at corner 0: the dot product over twice the area, also for mirrored UVs."""
    third = second - first
    dots = [(first * second).sum(axis=1), -(first * third).sum(axis=1), (second * third).sum(axis=1)]
    return np.stack(dots, axis=1) / doubled[:, None]


def _refuse_degenerate(name: str, corners: Array, doubled: Array, triangles: Index) -> None:
    edges = corners[:, [1, 2, 0]] - corners
    longest = np.einsum("fak,fak->fa", edges, edges).max(axis=1)
    bad = np.flatnonzero(~(doubled > _FLATTEST * longest))
    if bad.size:
        worst = int(bad[0])
        raise ValueError(
            f"{name}: triangles must have an area above {_FLATTEST / 2.0:g} of their longest edge squared, got "
            f"{doubled[worst] / 2.0:.3g} m^2 of {triangles[worst].tolist()} at {worst} ({bad.size} in all); remesh "
            "there"
        )


def find_hinges(name: str, triangles: Index, rest: RestTriangles) -> Hinges:
    """Hinges of all interior edges; edges of more than two triangles are refused, and triangles that come twice."""
    edges = np.sort(triangles[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), axis=1)  # edge k lies opposite corner k
    order = np.lexsort((np.arange(len(edges)), edges[:, 1], edges[:, 0]))
    begins = np.append(True, (edges[order[1:]] != edges[order[:-1]]).any(axis=1))
    starts = np.flatnonzero(begins)
    uses = np.diff(np.append(starts, len(order)))
    if (uses > 2).any():
        first = starts[uses > 2][0]
        raise ValueError(
            f"{name}: an edge must belong to one or two triangles, got {int(uses[uses > 2][0])} at the edge "
            f"{edges[order[first]].tolist()} ({int((uses > 2).sum())} edges in all); cut the sheet there, and join the "
            "parts by Tie"
        )
    inner = starts[uses == 2]
    one, other = order[inner], order[inner + 1]
    corners = np.concatenate([edges[one], triangles.reshape(-1)[np.stack([one, other], axis=1)]], axis=1)
    twice = np.flatnonzero(corners[:, 2] == corners[:, 3])
    if twice.size:
        pair = (int(one[twice[0]] // 3), int(other[twice[0]] // 3))
        raise ValueError(f"{name}: triangles must differ, got the same corners at {pair[0]} and {pair[1]}")
    at_0, at_1 = ([_cotangent_at(triangles, rest, edge, corners[:, end]) for edge in (one, other)] for end in (0, 1))
    weights = np.stack([at_1[0] + at_1[1], at_0[0] + at_0[1], -at_0[0] - at_1[0], -at_0[1] - at_1[1]], axis=1)
    areas = rest.areas[one // 3] + rest.areas[other // 3]
    return Hinges(corners, np.stack([one // 3, other // 3], axis=1), weights, areas)


def _cotangent_at(triangles: Index, rest: RestTriangles, edge: Index, vertex: Index) -> Array:
    """Cotangent of the rest angle at a vertex, in the triangle of an edge (3 f + k)."""
    return np.asarray(rest.cotangents[edge // 3][triangles[edge // 3] == vertex[:, None]])
