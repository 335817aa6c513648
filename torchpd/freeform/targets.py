"""Targets of a patch fit: a mesh, a cloud of points, or a function that vanishes on a surface.

Each gives the signed distance of points (negative inside), its direction, and the normal of the surface nearby.
Newton's method does the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree

from ..common.checks import as_array, check_finite, check_shape
from ..geometry.decimate import simplify
from ..geometry.isosurface import contour
from ..geometry.mesh_checks import compact
from ..geometry.tri_mesh import TriMesh
from .checks import angle_weighted_normals, check_surface

__all__ = [
    "CloudTarget",
    "FieldTarget",
    "FitTarget",
    "MeshTarget",
    "base_triangles",
    "intersect_lines",
    "project",
    "target_of",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Answer: TypeAlias = tuple[Array, Array, Array]

_NAME = "FreeFormPatches.fit: target"
_NEIGHBOURS = 16  # points of a cloud that define the surface at a point
_CELLS = 24  # cells of the lattice that finds the surface of a function or a cloud
_FACING = 0.1  # least cosine between a director and the normal where it meets the surface


class FitTarget(Protocol):
    """A target surface, as the fit sees it."""

    size: float  # longest side of the bounding box [m]

    def near(self, points: Array) -> Answer:
        """Signed distances [N] [m], their unit gradients [N, 3], and unit normals [N, 3] of the surface nearby."""
        ...

    def mesh(self) -> TriMesh:
        """The surface as triangles, as fine as known or as a base may need."""
        ...


class MeshTarget:
    """A triangle mesh; vertices at equal positions count as one. Its normals interpolate those of the vertices."""

    def __init__(self, surface: TriMesh) -> None:
        import trimesh

        points, numbers = np.unique(surface.vertices, axis=0, return_inverse=True)
        elements = numbers.reshape(-1)[surface.triangles]
        corners = points[elements]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        longest2 = ((corners - corners[:, [1, 2, 0]]) ** 2).sum(axis=2).max(axis=1)
        elements = elements[np.linalg.norm(cross, axis=1) > 1e-10 * longest2]
        if not len(elements):
            raise ValueError(f"{_NAME} must have triangles with an area, got {surface}")
        kept, elements = compact(_NAME, elements, len(points), drop=len(elements) < len(surface.triangles))
        self.surface = TriMesh(points[kept], elements)
        try:
            vertices = torch.tensor(self.surface.vertices)
            self.vertex_normals = angle_weighted_normals(vertices, check_surface(vertices, torch.tensor(elements)))
        except ValueError as error:
            raise ValueError(f"{_NAME} must be an oriented surface: {error}") from None
        self.shape = self.surface.to_trimesh()
        if self.shape.is_watertight and self.surface.volume() < 0:
            raise ValueError(
                f"{_NAME} must have its triangles counter-clockwise seen from outside, got a closed surface of volume "
                f"{self.surface.volume():.3g} m^3; reverse them (mesh.triangles[:, ::-1])"
            )
        self.size = float(np.ptp(self.surface.bounds, axis=0).max())
        proximity: Any = trimesh.proximity
        self._closest = proximity.closest_point
        try:
            self._closest(self.shape, self.surface.vertices[:1])
        except ImportError as error:
            raise ImportError(f"{_NAME}: distances from a mesh need the package rtree: pip install rtree") from error

    def near(self, points: Array) -> Answer:
        if not len(points):
            return np.empty(0), np.empty((0, 3)), np.empty((0, 3))
        nearest, distance, face = self._closest(self.shape, points)
        corners = self.surface.triangles[face]
        from trimesh.triangles import points_to_barycentric

        triangles = self.surface.vertices[corners]
        share = np.clip(points_to_barycentric(triangles, nearest, method="cramer"), 0.0, 1.0)
        normals = _unit(np.einsum("nk,nkx->nx", share, self.vertex_normals.numpy()[corners]))
        apart = points - nearest
        flat = self.shape.face_normals[face]
        # on the surface the offset has no direction; beside an edge two faces are equally near
        side = np.where((apart * normals).sum(axis=1) < 0, -1.0, 1.0)
        on = distance <= 1e-9 * self.size
        gradient = np.where(on[:, None], flat, side[:, None] * apart / np.where(on, 1.0, distance)[:, None])
        return np.where(on, (apart * flat).sum(axis=1), side * distance), gradient, normals

    def mesh(self) -> TriMesh:
        return self.surface


class FieldTarget:
    """The zero surface of a smooth function, negative inside. Value over gradient length estimates the distance: to
    first order for any function, exact for a signed distance."""

    def __init__(self, function: Callable[[torch.Tensor], Any], bounds: Any) -> None:
        self.function = function
        self.bounds = as_array("FreeFormPatches.fit: bounds", bounds, np.float64)
        check_shape("FreeFormPatches.fit: bounds", self.bounds, (2, 3), "lower and upper corner [m]")
        check_finite("FreeFormPatches.fit: bounds", self.bounds)
        if not np.all(self.bounds[1] > self.bounds[0]):
            raise ValueError(
                f"FreeFormPatches.fit: bounds must be a lower and an upper corner, got {self.bounds.tolist()}"
            )
        self.size = float(np.ptp(self.bounds, axis=0).max())
        self.near(self.bounds)

    def near(self, points: Array) -> Answer:
        x = torch.tensor(points, requires_grad=True)
        with torch.enable_grad():
            values = self.function(x)
        if not torch.is_tensor(values) or values.shape != x.shape[:1]:
            came = list(values.shape) if torch.is_tensor(values) else type(values).__name__
            raise ValueError(
                f"{_NAME}: a function must turn points [N, 3] into a tensor [N], got {came} for N={len(x)}"
            )
        if not values.requires_grad:
            raise ValueError(f"{_NAME}: a function must be differentiable by torch, got values without a gradient")
        (slope,) = torch.autograd.grad(values.sum(), x)
        value, gradient = values.detach().double().numpy(), slope.double().numpy()
        _refuse_nonsense(points, np.column_stack([value, gradient]))
        length = np.maximum(np.linalg.norm(gradient, axis=1), 1e-12)
        normal = gradient / length[:, None]
        return value / length, normal, normal

    def _values(self, points: Array) -> Array:
        with torch.no_grad():
            values = np.asarray(self.function(torch.tensor(points)).double().numpy())
        _refuse_nonsense(points, values[:, None])
        return values

    def mesh(self) -> TriMesh:
        return _contour(self._values, *self.bounds)


def _refuse_nonsense(points: Array, numbers: Array) -> None:
    bad = np.flatnonzero(~np.isfinite(numbers).all(axis=1))
    if len(bad):
        raise ValueError(
            f"{_NAME}: a function must have finite values and gradients, got {numbers[bad[0]].tolist()} at "
            f"{points[bad[0]].tolist()} ({len(bad)} in all)"
        )


class CloudTarget:
    """Points with normals, as an implicit moving least-squares surface (Kolluri 2008; exact on spheres). It is the zero
    set of the mean distance from planes through the points nearby, weighted by [1 - |x - p|^2 / r^2]^3."""

    def __init__(self, points: Any, normals: Any = None) -> None:
        self.points = as_array(_NAME, points, np.float64)
        check_shape(_NAME, self.points, (None, 3), "a cloud of points [m]")
        check_finite(_NAME, self.points)
        if len(np.unique(self.points, axis=0)) < 4 * _NEIGHBOURS:
            raise ValueError(f"{_NAME}: a cloud must have at least {4 * _NEIGHBOURS} points, got {len(self.points)}")
        self.bounds = np.array([self.points.min(axis=0), self.points.max(axis=0)])
        self.size = float(np.ptp(self.bounds, axis=0).max())
        self.tree = cKDTree(self.points)
        if normals is None:
            self.normals = _estimated_normals(self.points, self.tree)
            return
        self.normals = as_array("FreeFormPatches.fit: normals", normals, np.float64)
        check_shape("FreeFormPatches.fit: normals", self.normals, self.points.shape, "one for each point")
        check_finite("FreeFormPatches.fit: normals", self.normals)
        length = np.linalg.norm(self.normals, axis=1)
        if not length.min() > 0:
            raise ValueError(f"FreeFormPatches.fit: normals must have a length, got 0 at {int(length.argmin())}")
        self.normals = self.normals / length[:, None]

    def near(self, points: Array) -> Answer:
        reach, chosen = self.tree.query(points, k=_NEIGHBOURS + 1)
        radius = np.maximum(reach[:, -1:], np.finfo(np.float64).tiny)
        weight = (1.0 - (reach[:, :-1] / radius) ** 2) ** 3
        weight = np.where(weight.sum(axis=1, keepdims=True) > 0, weight, 1.0)
        weight /= weight.sum(axis=1, keepdims=True)
        normal = self.normals[chosen[:, :-1]]
        mean = _unit(np.einsum("nk,nkx->nx", weight, normal))
        # the plane through p half way between both normals meets a sphere again: no bias on curved surfaces
        planes = ((points[:, None] - self.points[chosen[:, :-1]]) * 0.5 * (normal + mean[:, None])).sum(axis=2)
        return (weight * planes).sum(axis=1), mean, mean

    def mesh(self) -> TriMesh:
        return _contour(lambda x: self.near(x)[0], *self.bounds)


def _estimated_normals(points: Array, tree: cKDTree) -> Array:
    """Normals of planes through neighbours, oriented along a spanning tree of least turns (Hoppe et al. 1992).

    The highest point of each connected component faces upwards.
    """
    chosen = tree.query(points, k=_NEIGHBOURS)[1]
    local = points[chosen] - points[chosen].mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nkx,nky->nxy", local, local))[1][:, :, 0]
    start = np.repeat(np.arange(len(points)), _NEIGHBOURS - 1)
    end = chosen[:, 1:].reshape(-1)
    # a weight of 0 would be no edge
    cost = 1.0 - np.abs((normals[start] * normals[end]).sum(axis=1)) + 1e-6
    graph = coo_array((cost, (start, end)), shape=(len(points),) * 2).tocsr()
    graph = graph.maximum(graph.T)
    forest = minimum_spanning_tree(graph)
    pieces, piece = connected_components(graph, directed=False)
    for number in range(pieces):
        members = np.flatnonzero(piece == number)
        top = int(members[points[members, 2].argmax()])
        if normals[top, 2] < 0:
            normals[top] = -normals[top]
        order, before = breadth_first_order(forest, top, directed=False)
        for place in order[1:].tolist():
            if normals[place] @ normals[before[place]] < 0:
                normals[place] = -normals[place]
    return np.asarray(normals)


def _contour(values: Callable[[Array], Array], low: Array, high: Array) -> TriMesh:
    margin = 2.0 * float((high - low).max()) / _CELLS
    try:
        mesh = contour(values, low - margin, high + margin, _CELLS, rounds=2)
        check_surface(torch.tensor(mesh.vertices), torch.tensor(mesh.triangles))
    except ValueError as error:
        raise ValueError(
            f"{_NAME} must enclose a body within its bounds, negative inside and positive outside, got no closed "
            f"surface there ({error}); correct its sign or bounds, or pass the base as a TriMesh"
        ) from None
    return mesh


def target_of(target: Any, normals: Any = None, bounds: Any = None, base: TriMesh | None = None) -> FitTarget:
    """Convert any supported target of a fit to a `FitTarget`."""
    import trimesh

    if isinstance(target, (trimesh.Trimesh, trimesh.Scene)):
        target = TriMesh.from_trimesh(target)
    is_mesh = isinstance(target, TriMesh)
    is_function = callable(target) and not isinstance(target, (torch.Tensor, TriMesh))
    if normals is not None and (is_mesh or is_function):
        raise ValueError("FreeFormPatches.fit: normals belong to a cloud of points, not to a mesh or a function")
    if bounds is not None and not is_function:
        raise ValueError("FreeFormPatches.fit: bounds belong to a function, not to a mesh or a cloud of points")
    if is_mesh:
        return MeshTarget(target)
    if is_function:
        if bounds is None and base is None:
            raise ValueError(
                "FreeFormPatches.fit: bounds must say where the surface of a function lies (lower and upper corner [m])"
                ", unless the base is passed as a TriMesh"
            )
        return FieldTarget(target, base.bounds + _room(base) if bounds is None and base is not None else bounds)
    if isinstance(target, (np.ndarray, torch.Tensor, list, tuple)):
        return CloudTarget(target, normals)
    raise TypeError(
        f"{_NAME} must be a TriMesh, a trimesh.Trimesh, points [N, 3] or a function of points, "
        f"got {type(target).__name__}"
    )


def _room(base: TriMesh) -> Array:
    return 0.1 * float(np.ptp(base.bounds, axis=0).max()) * np.array([[-1.0], [1.0]])


def project(target: FitTarget, points: Array, steps: int = 8) -> Array:
    """Move the points onto the surface, along the gradient of the distance."""
    for _ in range(steps):
        distance, gradient, _ = target.near(points)
        points = points - distance[:, None] * gradient
    return points


def intersect_lines(
    target: FitTarget, points: Array, directions: Array, reach: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Intersect lines from points along directions [N, 3] with the surface, from the inside to the outside.

    Newton's method for the distance along the line; exact on a plane.

    Returns:
        Signed parameters t [N] in units of the direction, normals there [N, 3], and whether there is an intersection
        with |t| <= `reach`.
    """
    t = np.zeros(len(points))
    normals = np.zeros_like(points)
    found = np.zeros(len(points), dtype=bool)
    active = np.arange(len(points))
    length = np.linalg.norm(directions, axis=1)
    for step in range(30):
        distance, gradient, normal = target.near(points[active] + t[active, None] * directions[active])
        normals[active] = normal
        done = np.abs(distance) <= 1e-12 * target.size
        found[active[done]] = True
        active, distance, gradient = active[~done], distance[~done], gradient[~done]
        if not len(active):
            break
        slope = (gradient * directions[active]).sum(axis=1)
        slope = np.copysign(np.maximum(np.abs(slope), 0.2 * length[active]), slope)
        shift = distance / slope * (1.0 if step < 15 else 0.7)  # damped: it may oscillate between two faces
        t[active] = np.clip(t[active] - shift, -1.5 * reach[active], 1.5 * reach[active])
    distance = target.near(points[active] + t[active, None] * directions[active])[0]
    found[active[np.abs(distance) <= 1e-7 * target.size]] = True
    found &= np.abs(t) <= reach
    found &= (normals * directions).sum(axis=1) > _FACING * length
    return t, normals, found


def base_triangles(target: FitTarget, patches: int | TriMesh) -> tuple[TriMesh, Array]:
    """The base of patches with its vertices on the target, and the target's normals there [V, 3]."""
    if isinstance(patches, TriMesh):
        coarse = patches
    else:
        fine = target.mesh()
        coarse = simplify(fine, patches) if len(fine.triangles) > patches else fine
    vertices = project(target, coarse.vertices)
    off, _, normals = target.near(vertices)
    bad = np.flatnonzero(~(np.abs(off) <= 1e-6 * target.size))
    if len(bad):
        raise ValueError(
            f"FreeFormPatches.fit: vertices of the base must come to lie on the target, got {abs(off[bad[0]]):.3g} m "
            f"off at vertex {bad[0]} ({len(bad)} in all); pass a base that lies closer"
        )
    return TriMesh(vertices, coarse.triangles), normals


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, np.finfo(np.float64).tiny))
