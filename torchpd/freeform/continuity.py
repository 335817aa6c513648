"""Continuity across the edges of free-form patches: the gap between neighbours, and the angle of their normals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from .surface import PatchPose, PatchSurface

__all__ = ["PatchContinuity", "measure_continuity"]

Index = NDArray[np.int64]

_POSITIONS = (0.25, 0.5, 0.75)  # along an edge


class PatchContinuity(NamedTuple):
    """Continuity over all edges between two patches and all environments; zeros without such an edge."""

    gap: float  # largest distance between the two surfaces [m]
    mean_angle: float  # between their normals [degrees]
    largest_angle: float  # between their normals [degrees]


def measure_continuity(patches: PatchSurface, pose: PatchPose | None = None) -> PatchContinuity:
    """Compare both patches of every edge at three points along it, at rest or in a pose."""
    triangles = patches.triangles.cpu().numpy().astype(np.int64)
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
    order = np.lexsort((ends.max(axis=1), ends.min(axis=1)))
    key = np.sort(ends, axis=1)[order]
    paired = np.flatnonzero((key[1:] == key[:-1]).all(axis=1))
    if not len(paired):
        return PatchContinuity(0.0, 0.0, 0.0)
    # the two patches traverse their edge in opposite directions
    one, other = _at(patches, order[paired], False, pose), _at(patches, order[paired + 1], True, pose)
    gap = (one[0] - other[0]).norm(dim=-1)
    sine, cosine = torch.linalg.cross(one[1], other[1]).norm(dim=-1), (one[1] * other[1]).sum(-1)
    angle = torch.rad2deg(torch.atan2(sine, cosine))
    return PatchContinuity(float(gap.max()), float(angle.mean()), float(angle.max()))


def _at(
    patches: PatchSurface, sides: Index, backwards: bool, pose: PatchPose | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Points and normals on sides 3 p + k of patches, which run from corner k to corner k + 1."""
    patch, corner = np.divmod(sides, 3)
    rows = np.arange(len(sides))
    places = np.zeros((len(_POSITIONS), len(sides), 3))
    for place, t in zip(places, _POSITIONS, strict=True):
        place[rows, (corner + 1) % 3] = 1.0 - t if backwards else t
        place[rows, corner] = t if backwards else 1.0 - t
    number = torch.as_tensor(np.tile(patch, len(_POSITIONS)), device=patches.vertices.device)
    samples = patches.samples(number, torch.as_tensor(places.reshape(-1, 3)).to(patches.vertices))
    with torch.no_grad():
        surface = patches.surface(samples, pose)
    return surface.points, surface.normals
