"""Free-form patches as triangles: a barycentric grid on every patch, welded where patches meet.

Grid points are numbered by their vertex, by their edge and position along it, or by their patch and position inside it.
Patches share the points of their common edge. So the mesh has the Euler number of the base at every level, and no gaps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..common.reprs import by_fields
from ..geometry.tri_mesh import TriMesh
from .surface import PatchPose, PatchSamples, PatchSurface

__all__ = ["Tessellation", "tessellate"]

Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Tessellation:
    """A triangle mesh over patches; `patches.surface(samples, pose).points` are its vertices in a pose."""

    patches: PatchSurface
    samples: PatchSamples  # one for each vertex
    triangles: Tensor  # int64 [T, 3]

    def mesh(self, pose: PatchPose | None = None) -> TriMesh:
        """The mesh at rest, or in a pose of one environment."""
        if pose is not None and len(pose.positions) != 1:
            raise ValueError(
                f"Tessellation.mesh: pose must be of one environment, got {len(pose.positions)}; "
                "take `surface` of the samples for many"
            )
        with torch.no_grad():
            points = self.patches.surface(self.samples, pose).points
        return TriMesh(points.reshape(-1, 3).cpu().numpy(), self.triangles.cpu().numpy())

    def __repr__(self) -> str:
        return by_fields(self)


def grid(level: int) -> tuple[Index, Index]:
    """Barycentric grid of a patch: steps [(m + 1)(m + 2)/2, 3] that sum to m, and triangles [m^2, 3]."""
    steps = np.array([(level - r, r - c, c) for r in range(level + 1) for c in range(r + 1)])
    row = [r * (r + 1) // 2 for r in range(level + 2)]
    up = [(row[r] + c, row[r + 1] + c, row[r + 1] + c + 1) for r in range(level) for c in range(r + 1)]
    down = [(row[r] + c, row[r + 1] + c + 1, row[r] + c + 1) for r in range(level) for c in range(r)]
    return steps, np.array(up + down)


def weld(elements: Index, vertices: int, steps: Index, level: int) -> Index:
    """The number of every grid point [P, points]: vertices first, then points on edges, then points inside."""
    sides = np.stack([elements, elements[:, [1, 2, 0]]], axis=2)  # side k runs from corner k to corner k + 1
    low, high = sides.min(axis=2), sides.max(axis=2)
    edges, edge = np.unique(low * vertices + high, return_inverse=True)
    edge = edge.reshape(-1, 3)
    number = np.empty((len(elements), len(steps)), dtype=np.int64)
    inside = (steps > 0).all(axis=1)
    first = vertices + len(edges) * (level - 1)
    number[:, inside] = first + np.arange(len(elements) * inside.sum()).reshape(len(elements), -1)
    for k in range(3):
        number[:, steps[:, k] == level] = elements[:, [k]]
        on_side = (steps[:, (k + 2) % 3] == 0) & (steps[:, k] > 0) & (steps[:, (k + 1) % 3] > 0)
        # counted from the end with the lower vertex number, which is the same for both sides of the edge
        forward = elements[:, [k]] == low[:, [k]]
        step = np.where(forward, steps[on_side, (k + 1) % 3], steps[on_side, k])
        number[:, on_side] = vertices + edge[:, [k]] * (level - 1) + step - 1
    return number


def tessellate(patches: PatchSurface, level: Any) -> Tessellation:
    """The grid of `level` segments along every edge, over all patches, welded."""
    if isinstance(level, bool) or not isinstance(level, int) or level < 1:
        raise ValueError(f"tessellate: level must be a whole number of segments >= 1, got {level!r}")
    elements = patches.triangles.cpu().numpy().astype(np.int64)
    steps, triangles = grid(level)
    number = weld(elements, len(patches.vertices), steps, level)
    _, chosen = np.unique(number, return_index=True)
    patch, place = np.divmod(chosen, len(steps))
    device, dtype = patches.vertices.device, patches.vertices.dtype
    barycentrics = torch.as_tensor(steps[place], dtype=dtype, device=device) / level
    samples = patches.samples(torch.as_tensor(patch, device=device), barycentrics)
    return Tessellation(patches, samples, torch.as_tensor(number[:, triangles].reshape(-1, 3), device=device))
