"""A surface embedded in a tetrahedral mesh: each surface vertex is a fixed combination of the corners of one tet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, combinations
from typing import Any, overload

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .closest_points import closest_points
from .mesh_checks import warn
from .mesh_faces import TET_FACES
from .mesh_quality import shape_gradients
from .tri_mesh import TriMesh

__all__ = ["Embedding", "embed_in_sheet", "embed_surface", "embed_triangles"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# number of nearest tets compared for a point outside of all
_NEAREST = 32
# edges between a surface vertex and the sheet that carries it
_OFF_SHEET = 0.1
# points processed at a time, to bound memory
_CHUNK = 100_000


@dataclass(frozen=True, eq=False, repr=False)
class Embedding:
    """Embedding of a surface: surface vertex i is sum_a weights[i, a] x[corners[i, a]].

    Weights add up to 1, so every affine motion of the mesh is reproduced exactly. The fourth one is 0 in a sheet of
    triangles.
    """

    surface: TriMesh  # surface at rest; its triangles and texture coordinates stay valid for `apply`
    tets: Index  # tet, or triangle of a sheet, of each surface vertex [n]
    weights: Array  # barycentric coordinates [n, 4], not negative inside the tet
    corners: Index  # rows `tets` of the mesh [n, 4]: the vertices of the weights
    vertex_count: int  # number of mesh vertices

    def __post_init__(self) -> None:
        count = len(self.surface.vertices)
        for name, shape in (("tets", (count,)), ("weights", (count, 4)), ("corners", (count, 4))):
            array = np.array(getattr(self, name))
            if array.shape != shape:
                raise ValueError(f"Embedding.{name} must be {list(shape)} (surface vertices), got {list(array.shape)}")
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @overload
    def apply(self, positions: NDArray[Any]) -> NDArray[Any]: ...
    @overload
    def apply(self, positions: torch.Tensor) -> torch.Tensor: ...

    def apply(self, positions: NDArray[Any] | torch.Tensor) -> NDArray[Any] | torch.Tensor:
        """Positions of the surface vertices [..., n, 3] for mesh positions [..., V, 3].

        Arrays and tensors keep their precision; tensors keep their device and are differentiable.
        """
        if not isinstance(positions, (np.ndarray, torch.Tensor)):
            raise TypeError(f"Embedding.apply: positions must be a tensor or an array, got {type(positions).__name__}")
        if tuple(positions.shape[-2:]) != (self.vertex_count, 3):
            raise ValueError(
                f"Embedding.apply: positions must be [..., {self.vertex_count}, 3] (the vertices of the mesh), "
                f"got {list(positions.shape)}; one body of a scene is positions[..., scene.vertex_range(solid), :]"
            )
        if isinstance(positions, torch.Tensor):
            return self._apply_tensor(positions)
        array = np.asarray(positions)
        weights = self.weights.astype(array.dtype if array.dtype.kind == "f" else np.float64)
        parts = (array[..., self.corners[:, a], :] * weights[:, a, None] for a in range(4))
        return np.asarray(sum(parts))

    def _apply_tensor(self, positions: torch.Tensor) -> torch.Tensor:
        if not positions.is_floating_point():
            raise TypeError(f"Embedding.apply: positions must be floating point, got {positions.dtype}")
        weights = torch.tensor(self.weights, dtype=positions.dtype, device=positions.device)
        corners = torch.tensor(self.corners, device=positions.device)
        carried = positions.index_select(-2, corners[:, 0]) * weights[:, 0, None]
        for a in range(1, 4):
            carried = carried + positions.index_select(-2, corners[:, a]) * weights[:, a, None]
        return carried

    def transformed(self, matrix: Any, corners: Sequence[int] = (0, 1, 2, 3)) -> Embedding:
        """Embedding in the transformed mesh, whose tets list their corners in another order."""
        order = list(corners)
        return Embedding(
            surface=self.surface.transformed(matrix),
            tets=self.tets,
            weights=self.weights[:, order],
            corners=self.corners[:, order],
            vertex_count=self.vertex_count,
        )

    def renumbered(self, tets: Index, vertex_count: int) -> Embedding:
        """Embedding in a mesh of the same tets [E, 4] with other vertex numbers."""
        return Embedding(self.surface, self.tets, self.weights, tets[self.tets], vertex_count)

    def __repr__(self) -> str:
        return f"Embedding({self.surface} in {self.vertex_count} mesh vertices)"


def _weights(points: Array, origins: Array, gradients: Array) -> Array:
    """Barycentric coordinates [P, 4] of points, each in its own tet: w_a = grad N_a . (p - x_0), w_0 the rest to 1."""
    weights = np.einsum("pak,pk->pa", gradients, points - origins)
    weights[:, 0] = 1.0 - weights[:, 1:].sum(axis=1)
    return np.asarray(weights)


def embed_surface(surface: TriMesh, vertices: Array, tets: Index) -> Embedding:
    """Embed a surface in a mesh of vertices [V, 3] and tets [E, 4], see `embed`."""
    points, corners = surface.vertices, vertices[tets]
    gradients, _ = shape_gradients(vertices, tets)
    centres = corners.mean(axis=1)
    radii = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
    # A tet lies in the ball around its centre through its farthest corner (widened for rounding).
    found = cKDTree(points).query_ball_point(centres, radii * (1.0 + 1e-9))
    sizes = np.fromiter(map(len, found), dtype=np.int64, count=len(found))
    which = np.fromiter(chain.from_iterable(found), dtype=np.int64, count=int(sizes.sum()))
    carriers = np.repeat(np.arange(len(centres)), sizes)
    # Points outside of all tets are compared with their nearest tets.
    near = cKDTree(centres).query(points, k=min(_NEAREST, len(centres)))[1].reshape(len(points), -1)
    which = np.concatenate([which, np.repeat(np.arange(len(points)), near.shape[1])])
    carriers = np.concatenate([carriers, near.reshape(-1)])
    # The signed distance to the plane of face a is w_a / |grad N_a|. The tet contains the point if the least over a is
    # not negative. Otherwise the tet is at least that far away.
    weights = _weights(points[which], corners[carriers, 0], gradients[carriers])
    depth = (weights / np.linalg.norm(gradients[carriers], axis=2)).min(axis=1)
    distance = _distances(points, which, corners, carriers, weights, depth)
    order = np.lexsort((carriers, -depth, distance, which))
    best = order[np.unique(which[order], return_index=True)[1]]
    chosen = carriers[best]
    _report_far(corners[chosen], distance[best])
    return Embedding(surface, chosen, weights[best], tets[chosen], len(vertices))


def _distances(points: Array, which: Index, corners: Array, tets: Index, weights: Array, depth: Array) -> Array:
    """Distance [P] of points `which` to `tets`, 0 inside; inf if another tet is certainly nearer to the point."""
    inside = np.clip(weights, 0.0, None)
    inside /= inside.sum(axis=1, keepdims=True)
    most = np.linalg.norm(points[which] - np.einsum("pa,pak->pk", inside, corners[tets]), axis=1)
    nearest = np.full(len(points), np.inf)
    np.minimum.at(nearest, which, np.where(depth >= 0.0, 0.0, most))
    distance = np.where(depth >= 0.0, 0.0, np.inf)
    open_to = np.flatnonzero((depth < 0.0) & (-depth <= nearest[which] * (1.0 + 1e-9)))
    for start in range(0, len(open_to), _CHUNK):
        pairs = open_to[start : start + _CHUNK]
        distance[pairs] = _outside(points[which[pairs]], corners[tets[pairs]])
    return distance


def _outside(points: Array, corners: Array) -> Array:
    """Distance of points [P, 3] to the surfaces of tets [P, 4, 3]: to an edge, or to a face along its normal."""
    distance = np.full(len(points), np.inf)
    for a, b in combinations(range(4), 2):
        edge, away = corners[:, b] - corners[:, a], points - corners[:, a]
        along = np.clip(_dot(edge, away) / _dot(edge, edge), 0.0, 1.0)
        np.minimum(distance, np.linalg.norm(away - along[:, None] * edge, axis=1), out=distance)
    for face in TET_FACES:
        p, q, r = (corners[:, corner] for corner in face)
        normal = np.cross(q - p, r - p)
        above = np.ones(len(points), dtype=bool)
        for start, end in ((p, q), (q, r), (r, p)):
            above &= _dot(np.cross(normal, end - start), points - start) >= 0.0
        height = np.abs(_dot(points - p, normal)) / np.linalg.norm(normal, axis=1)
        np.minimum(distance, height, out=distance, where=above)
    return distance


def _dot(one: Array, other: Array) -> Array:
    return np.asarray(np.einsum("pk,pk->p", one, other))


def _report_far(corners: Array, distance: Array) -> None:
    """Warn of surface vertices farther outside of their tets [n, 4, 3] than these are long."""
    ends = np.array(list(combinations(range(4), 2)))
    cells = distance / np.linalg.norm(corners[:, ends[:, 0]] - corners[:, ends[:, 1]], axis=2).max(axis=1)
    far = int((cells > 1.0).sum())
    if far:
        worst = int(cells.argmax())
        warn(
            f"embed: {far} of {len(cells)} surface vertices lie more than a cell outside of the mesh, up to "
            f"{cells[worst]:.3g} cells ({distance[worst]:.3g} m): their motion is extrapolated. Move or scale the "
            "surface onto the mesh, surface.transformed(matrix), or use a mesh that encloses it"
        )


def embed_in_sheet(surface: TriMesh, vertices: Array, triangles: Index) -> Embedding:
    """Embed a surface in a sheet of vertices [V, 3] and triangles [T, 3], see `embed`; the fourth weight is 0."""
    found = closest_points(surface.vertices, vertices, triangles)
    corners = triangles[found.elements]
    ends = vertices[corners]
    edges = np.linalg.norm(ends - np.roll(ends, 1, axis=1), axis=2).max(axis=1)
    far = np.flatnonzero(found.distances > _OFF_SHEET * edges)
    if far.size:
        worst = float(found.distances.max())
        warn(
            f"embed: {far.size} of {len(corners)} surface vertices lie off the sheet, up to {worst:.3g} m: they are "
            "drawn on it. Move or scale the surface onto the sheet, surface.transformed(matrix)"
        )
    weights = np.pad(found.weights, ((0, 0), (0, 1)))
    return Embedding(surface, found.elements, weights, np.pad(corners, ((0, 0), (0, 1)), mode="edge"), len(vertices))


def embed_triangles(vertices: Array, tets: Index, triangles: Index) -> Embedding:
    """Surface of mesh vertices, by their numbers [T, 3]: each has weight 1 at its vertex, in its first tet."""
    used, numbers = np.unique(triangles, return_inverse=True)
    surface = TriMesh(vertices[used], numbers.reshape(-1, 3))
    carriers, corner = np.divmod(np.unique(tets.reshape(-1), return_index=True)[1][used], 4)
    return Embedding(surface, carriers, np.eye(4)[corner], tets[carriers], len(vertices))
