"""Surface simplification, down to the base mesh of freeform patches.

Edges are contracted in the order of their quadric error (Garland and Heckbert, 1997), while the topology stays and no
triangle flips. So the result can carry patches whenever the original could. fast-simplification is a hundred times
faster, but of the octopus at 80 triangles it leaves a non-manifold edge.
"""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

from ..common.checks import check_scalar
from .tri_mesh import TriMesh

__all__ = ["simplify"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Weights of the squared distances from boundary planes and from the vertices, relative to triangle planes. The latter
# keeps triangles even on flat surfaces.
_BOUNDARY, _PLACE = 10.0, 3e-3
_LEAST_TURN = 0.2  # cosine between the old and the new normal of a triangle
_NEXT, _LAST = [1, 2, 0], [2, 0, 1]
_LEAST_SHAPE = 0.05  # twice the area over the longest edge squared: 0.87 for an equilateral triangle


def _plane_quadrics(normals: Array, points: Array, weights: Array) -> Array:
    """Squared distances from planes as quadratic forms [N, 4, 4] of (x, 1)."""
    plane = np.concatenate([normals, -(normals * points).sum(axis=1, keepdims=True)], axis=1)
    return np.asarray(weights[:, None, None] * plane[:, :, None] * plane[:, None, :])


def _vertex_quadrics(vertices: Array, triangles: Index) -> Array:
    corners = vertices[triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(cross, axis=1)
    normal = cross / np.maximum(2.0 * area, np.finfo(np.float64).tiny)[:, None]
    total = np.zeros((len(vertices), 4, 4))
    faces = _plane_quadrics(normal, corners[:, 0], area / 3.0)
    near = np.broadcast_to(np.eye(4), (len(vertices), 4, 4)).copy()
    near[:, :3, 3] = near[:, 3, :3] = -vertices
    near[:, 3, 3] = (vertices**2).sum(axis=1)
    for k in range(3):
        np.add.at(total, triangles[:, k], faces)
        np.add.at(total, triangles[:, k], _PLACE * area[:, None, None] / 3.0 * near[triangles[:, k]])
    directed = np.stack([triangles, triangles[:, [1, 2, 0]]], axis=2).reshape(-1, 2)
    _, first, times = np.unique(np.sort(directed, axis=1) @ [len(vertices), 1], return_index=True, return_counts=True)
    lone = first[times == 1]
    start, end = directed[lone].T
    along = vertices[end] - vertices[start]
    across = np.cross(along, normal[lone // 3])
    length = np.maximum(np.linalg.norm(across, axis=1), np.finfo(np.float64).tiny)
    walls = _plane_quadrics(across / length[:, None], vertices[start], _BOUNDARY * length**2 / 2.0)
    np.add.at(total, start, walls)
    np.add.at(total, end, walls)
    return total


def _cross(a: Array, b: Array) -> Array:
    """`np.cross` of [N, 3], many times faster for small N."""
    return np.asarray(a[:, _NEXT] * b[:, _LAST] - a[:, _LAST] * b[:, _NEXT])


class _Surface:
    """Triangles around each vertex, and a heap of candidate edges."""

    def __init__(self, mesh: TriMesh) -> None:
        self.vertices = mesh.vertices.copy()
        self.triangles = mesh.triangles.copy()
        self.alive = np.ones(len(self.triangles), dtype=bool)
        self.quadrics = _vertex_quadrics(self.vertices, self.triangles)
        self.version = [0] * len(self.vertices)
        self.around: list[set[int]] = [set() for _ in self.vertices]
        for number, corners in enumerate(self.triangles.tolist()):
            for corner in corners:
                self.around[corner].add(number)
        # no two entries have the same vertices and versions: positions are never compared
        self.heap: list[tuple[float, int, int, int, int, Array]] = []
        self.push(np.unique(np.sort(self.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0))

    def push(self, pairs: Index) -> None:
        """Push edges [N, 2] with the minimum of the summed quadrics, and its position."""
        forms = self.quadrics[pairs[:, 0]] + self.quadrics[pairs[:, 1]]
        places = np.linalg.solve(forms[:, :3, :3], -forms[:, :3, 3:])[..., 0]
        for (u, v), form, x in zip(pairs.tolist(), forms, places, strict=True):
            least = float(form[:3, 3] @ x + form[3, 3])
            heapq.heappush(self.heap, (least, u, v, self.version[u], self.version[v], x))

    def neighbours(self, u: int) -> set[int]:
        return {corner for face in self.around[u] for corner in self.triangles[face].tolist()} - {u}

    def keeps_topology(self, u: int, v: int) -> bool:
        """Link condition of Dey et al. (1999), for surfaces with and without a boundary."""
        wings = self.around[u] & self.around[v]
        common = self.neighbours(u) & self.neighbours(v)
        if len(common) != len(wings):
            return False
        open_u, open_v = (len(self.neighbours(w)) != len(self.around[w]) for w in (u, v))
        if open_u and open_v and len(wings) == 2:
            return False
        return all(len(self.around[w]) > (3 if len(wings) == 2 else 1) for w in common)

    def keeps_shape(self, u: int, v: int, x: Array) -> bool:
        """Whether no remaining triangle flips or becomes a sliver."""
        staying = np.array(sorted(self.around[u] ^ self.around[v]), dtype=np.int64)
        if not len(staying):
            return False
        elements = self.triangles[staying]
        old = self.vertices[elements]
        new = np.where(((elements == u) | (elements == v))[..., None], x, old)
        sides = new[:, [1, 2, 0]] - new
        before = _cross(old[:, 1] - old[:, 0], old[:, 2] - old[:, 0])
        after = _cross(sides[:, 0], sides[:, 1])
        longest2 = (sides**2).sum(axis=2).max(axis=1)
        size = np.linalg.norm(after, axis=1)
        turned = (before * after).sum(axis=1) > _LEAST_TURN * np.linalg.norm(before, axis=1) * size
        return bool(np.all(turned & (size > _LEAST_SHAPE * longest2)))

    def contract(self, u: int, v: int, x: Array) -> int:
        """Move u to x and merge v into u; returns the number of triangles removed."""
        wings = self.around[u] & self.around[v]
        for face in wings:
            self.alive[face] = False
            for corner in self.triangles[face].tolist():
                self.around[corner].discard(face)
        for face in self.around[v]:
            self.triangles[face][self.triangles[face] == v] = u
        self.around[u] |= self.around[v]
        self.around[v] = set()
        self.vertices[u] = x
        self.quadrics[u] += self.quadrics[v]
        self.version[u] += 1
        self.version[v] += 1
        self.push(np.array([(min(u, w), max(u, w)) for w in sorted(self.neighbours(u))]).reshape(-1, 2))
        return len(wings)


def simplify(mesh: TriMesh, triangles: int) -> TriMesh:
    """Simplify a surface to at most the given number of triangles, and about as many.

    Args:
        mesh: oriented, each edge in at most two triangles.
        triangles: upper bound, at least 4.

    Raises:
        ValueError: topology or shape of the surface does not allow so few.
    """
    most = int(check_scalar("simplify: triangles", triangles, minimum=4))
    surface = _Surface(mesh)
    left = len(mesh.triangles)
    while left > most and surface.heap:
        _, u, v, at_u, at_v, x = heapq.heappop(surface.heap)
        if (surface.version[u], surface.version[v]) != (at_u, at_v):
            continue
        if surface.keeps_topology(u, v) and surface.keeps_shape(u, v, x):
            left -= surface.contract(u, v, x)
    if left > most:
        raise ValueError(
            f"simplify: {most} triangles must be enough for the topology and shape of the surface, reached {left} "
            f"of {len(mesh.triangles)}; ask for more, or supply a coarse mesh"
        )
    used, numbers = np.unique(surface.triangles[surface.alive], return_inverse=True)
    return TriMesh(surface.vertices[used], numbers.reshape(-1, 3))
