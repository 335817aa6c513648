"""Edges of surfaces that pass through triangles, by exact signs; and linking numbers of closed lines."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...geometry.crossings import crosses
from .boxes import overlaps
from .surfaces import Surfaces

__all__ = ["crossings", "linking_number"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def crossings(surfaces: Surfaces, positions: Tensor) -> Index:
    """Edges and triangles [n, 2] that cross at positions [N, 3], among those that may be in contact."""
    # boxes that only touch hold no crossing: its point is inside both
    x = positions.double()
    ends, faces = x[surfaces.edges], x[surfaces.triangles]
    edge, triangle = overlaps(ends.amin(1), ends.amax(1), faces.amin(1), faces.amax(1), strict=True)
    five = torch.cat([surfaces.edges[edge], surfaces.triangles[triangle]], dim=1)
    met = (five[:, :2, None] == five[:, None, 2:]).any(dim=2).any(dim=1)
    keep = (~met & surfaces.counts(five)).numpy()
    found = torch.stack([edge, triangle], dim=1).numpy()[keep]
    return np.asarray(found[crosses(x.numpy(), five.numpy()[keep])], np.int64)


def linking_number(first: Array, second: Array) -> int:
    """Linking number of two closed polylines [n, 3] and [m, 3]: Gauss's integral, exact for straight segments.

    Each pair of segments adds the solid angle of the tetrahedron of directions between them (Klenin, Langowski 2000).
    """
    a, b = first[:, None], np.roll(first, -1, axis=0)[:, None]
    c, d = second[None], np.roll(second, -1, axis=0)[None]
    ac, ad, bc, bd = c - a, d - a, c - b, d - b
    normals = [np.cross(ac, ad), np.cross(ad, bd), np.cross(bd, bc), np.cross(bc, ac)]
    units = [n / np.maximum(np.linalg.norm(n, axis=2, keepdims=True), 1e-300) for n in normals]
    angle = sum(np.arcsin(np.clip((units[k] * units[(k + 1) % 4]).sum(axis=2), -1.0, 1.0)) for k in range(4))
    side = np.sign((np.cross(d - c, b - a) * ac).sum(axis=2))
    return round(float((angle * side).sum()) / (4.0 * math.pi))
