"""Checks of the base of free-form patches, and its normals."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..geometry.mesh_checks import check_elements, check_points, compact, has_repeated_corner, raise_for_first

__all__ = ["angle_weighted_normals", "check_surface"]

Index = NDArray[np.int64]

_ROUNDOFF = float(np.finfo(np.float64).eps)


def check_surface(vertices: Tensor, triangles: Tensor) -> Index:
    """The triangles as int64 [P, 3], after checking that the surface can carry patches."""
    name = "FreeFormPatches.triangles"
    points = check_points("FreeFormPatches.vertices", vertices)
    elements = check_elements(name, triangles, 3, len(points))
    raise_for_first(name, has_repeated_corner(elements), elements, "corners must differ", "leave them out")
    corners = points[elements]
    sides = corners[:, [1, 2, 0]] - corners
    area2 = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    # the area that rounding of the corners alone could give a degenerate triangle
    longest = np.linalg.norm(sides, axis=2).max(axis=1)
    precision = float(torch.finfo(vertices.dtype).eps)
    noise = precision * (np.abs(points).max() + 2.0 * longest) * longest
    raise_for_first(name, ~(area2 > noise), elements, "areas must not vanish", "leave them out or weld their corners")
    _check_edges(name, elements)
    compact("FreeFormPatches", elements, len(points), drop=False)
    return elements


def _check_edges(name: str, elements: Index) -> None:
    """Require each edge at most once in each direction: an oriented surface, with or without boundary."""
    directed = np.stack([elements, elements[:, [1, 2, 0]]], axis=2).reshape(-1, 2)
    count = int(elements.max()) + 1
    _, first, times = np.unique(np.sort(directed, axis=1) @ [count, 1], return_index=True, return_counts=True)
    crowded = first[times > 2]
    if len(crowded):
        raise ValueError(
            f"{name}: an edge must belong to at most two triangles, got edge {directed[crowded[0]].tolist()} with "
            f"{int(times.max())} ({len(crowded)} such edges); split the surface there"
        )
    _, first, times = np.unique(directed @ [count, 1], return_index=True, return_counts=True)
    twice = first[times > 1]
    if len(twice):
        raise ValueError(
            f"{name}: neighbours must have the same orientation, got edge {directed[twice[0]].tolist()} in the same "
            f"direction twice ({len(twice)} such edges); turn the triangles on one side (trimesh.repair.fix_winding)"
        )


def angle_weighted_normals(vertices: Tensor, elements: Index) -> Tensor:
    """Unit normals of the vertices [V, 3]: normals of the adjacent triangles, weighted by their angles.

    Thuermer and Wuethrich (1998); independent of the triangulation around a vertex. Computed in float64, then rounded
    to the precision of the vertices; no gradient.
    """
    points = vertices.detach().cpu().double().numpy()
    corners = points[elements]
    out = np.zeros_like(points)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    for k in range(3):
        a = corners[:, (k + 1) % 3] - corners[:, k]
        b = corners[:, (k + 2) % 3] - corners[:, k]
        angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))
        np.add.at(out, elements[:, k], angle[:, None] * unit)
    length = np.linalg.norm(out, axis=1)
    bad = np.flatnonzero(~(length > 1e3 * _ROUNDOFF))
    if len(bad):
        raise ValueError(
            f"FreeFormPatches.vertices: the triangles around a vertex must not cancel, got vertex {bad[0]} without a "
            f"normal ({len(bad)} in all); pass directors"
        )
    return torch.as_tensor(out / length[:, None], dtype=vertices.dtype, device=vertices.device)
