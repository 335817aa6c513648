"""Smooth normals of a moving surface: shared on gentle bends, split at edges."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ..common.checks import as_array, check_finite, check_shape

__all__ = ["SmoothSurface"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_GRAZING = 0.03  # least cosine between a normal and the direction to the eye


class SmoothSurface:
    """Triangles whose vertices are split at creases, so that one normal per vertex shades them well.

    Two triangles share the normals along an edge if they meet at less than `crease` in the shape given here. The split
    stays while the surface moves, so that a fold that opens or closes does not flicker. Vertices at equal positions
    count as one, at any place in the list: files duplicate them at texture seams.

    Attributes:
        source: [S] the given vertex that each split vertex follows.
        triangles: [T, 3] into the split vertices.
    """

    def __init__(self, vertices: Any, triangles: Any, *, crease: float = 60.0) -> None:
        positions = as_array("vertices", vertices, np.float64, for_picture=True)
        check_shape("vertices", positions, (None, 3), "positions [m]")
        check_finite("vertices", positions)
        faces = as_array("triangles", triangles)
        check_shape("triangles", faces, (None, 3), "vertex numbers")
        if faces.size == 0 or not np.issubdtype(faces.dtype, np.integer):
            raise ValueError(f"triangles must be integers, at least one row, got {faces.dtype} {list(faces.shape)}")
        if faces.min() < 0 or faces.max() >= len(positions):
            raise IndexError(f"triangles must lie in 0..{len(positions) - 1}, got {faces.min()}..{faces.max()}")
        faces = faces.astype(np.int64)
        corner_group = _smoothing_groups(positions, faces, crease)
        self.triangles: Index = corner_group.reshape(-1, 3)
        self.source: Index = np.empty(int(corner_group.max()) + 1, dtype=np.int64)
        self.source[corner_group] = faces.reshape(-1)

    def split(self, vertices: Array) -> Array:
        """Positions [..., S, 3] of the split vertices, from positions [..., n, 3] of the given ones."""
        return vertices[..., self.source, :]

    def normals(self, split_vertices: Array) -> Array:
        """Unit normals [S, 3], weighted by area; +y where the triangles around a vertex cancel."""
        import trimesh

        face_normals = trimesh.triangles.cross(split_vertices[self.triangles])
        normals = trimesh.geometry.mean_vertex_normals(len(split_vertices), self.triangles, face_normals)
        return np.where(normals.any(axis=1, keepdims=True), normals, [0.0, 1.0, 0.0])

    def normals_seen_from(self, eye: Array, split_vertices: Array) -> Array:
        """The normals [S, 3], bent towards the eye where a visible triangle needs it.

        Along the silhouette of a coarse surface an averaged normal may point away although its triangle is visible. A
        path tracer would render it black.
        """
        import trimesh

        normals = self.normals(split_vertices)
        towards = eye - split_vertices
        towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
        face_normals = trimesh.triangles.cross(split_vertices[self.triangles])
        seen_faces = np.einsum("ij,ij->i", face_normals, eye - split_vertices[self.triangles[:, 0]]) > 0.0
        seen = np.zeros(len(normals), dtype=bool)
        seen[self.triangles[seen_faces]] = True
        side = np.where(seen, 1.0, -1.0)  # a vertex of hidden triangles only is visible from behind, if at all
        lacking = np.maximum(0.0, _GRAZING - side * np.einsum("ij,ij->i", normals, towards))
        bent = normals + (side * lacking)[:, None] * towards
        return np.asarray(bent / np.linalg.norm(bent, axis=1, keepdims=True))


def _smoothing_groups(vertices: Array, triangles: Index, crease: float) -> Index:
    """The split vertex [3T] of each corner of a triangle."""
    import trimesh

    place = np.unique(vertices, axis=0, return_inverse=True)[1].reshape(-1)[triangles]
    normals = trimesh.triangles.cross(vertices[triangles])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.where(length > 0.0, length, 1.0)

    pairs, edges = trimesh.graph.face_adjacency(place, return_edges=True)
    gentle = np.einsum("ij,ij->i", *normals[pairs.T]) > np.cos(np.radians(crease))
    pairs, edges = pairs[gentle], edges[gentle]
    # both corners at each end of an edge shared by two triangles
    corner = (place[pairs][:, :, None] == edges[:, None, :, None]).argmax(axis=3) + 3 * pairs[:, :, None]
    rows, columns = corner[:, 0].reshape(-1), corner[:, 1].reshape(-1)
    graph = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(triangles.size, triangles.size))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)
