"""Samples of a fit on every patch and its edges, with the heights and normals of the target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .surface import PatchSamples, PatchSurface
from .targets import FitTarget, intersect_lines
from .tessellation import grid, tessellate

__all__ = ["FitSamples", "edge_pairs", "inner_points", "mean_edges", "sample_target"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_REACH = 1.5  # search range for the target, in mean edges of a patch
_MISSED = 0.05  # largest fraction of samples without a target


@dataclass(frozen=True)
class FitSamples:
    """Samples on the target; those on edges and vertices occur once."""

    places: PatchSamples  # [S]
    points: Array  # P on the base [S, 3] [m]
    directors: Array  # D there, not of unit length [S, 3]
    heights: Array  # h* [S] [m]
    normals: Array  # of the target there [S, 3]
    areas: Array  # of the base around each sample [S], with sum 1
    cosines: Array  # D . n* [S]: distance over difference in height
    missed: float  # fraction of samples without a target


def mean_edges(patches: PatchSurface) -> Array:
    """Mean length of the edges of each patch [P] [m]."""
    corners = patches.vertices.detach().double().numpy()[patches.triangles.numpy()]
    return np.asarray(np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2).mean(axis=1))


def sample_target(empty: PatchSurface, target: FitTarget, level: int) -> FitSamples:
    """Sample patches without quadrics with `level` segments along every edge, in float64 on the CPU.

    Raises:
        ValueError: for more than one sample in twenty the target is not along the director, or faces away.
    """
    grid_on = tessellate(empty, level)
    places = grid_on.samples
    surface = empty.surface(places)
    points = surface.points.numpy()
    corners = empty.triangles.long()[places.patch.long()]
    directors = (places.barycentrics[:, :, None] * empty.directors[corners]).sum(1).numpy()
    patch = places.patch.numpy()
    heights, normals, found = intersect_lines(target, points, directors, _REACH * mean_edges(empty)[patch])
    if np.mean(~found) > _MISSED:
        first = int(np.flatnonzero(~found)[0])
        raise ValueError(
            "FreeFormPatches.fit: target must be a height over the base, along the directors, got none or a surface "
            f"facing away at {int(np.sum(~found))} of {len(found)} samples. The first is on patch {patch[first]} near "
            f"{points[first].round(4).tolist()}: it folds there; use more patches, or pass a base that follows it"
        )
    triangles = grid_on.triangles.numpy()
    sides = points[triangles]
    area = np.linalg.norm(np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]), axis=1)
    share = np.bincount(triangles.reshape(-1), np.repeat(area, 3), len(points))
    keep = np.flatnonzero(found)
    areas = share[keep] / share[keep].sum()
    cosines = (directors[keep] * normals[keep]).sum(axis=1)
    return FitSamples(
        empty.samples(places.patch[keep], places.barycentrics[keep]),
        points[keep], directors[keep], heights[keep], normals[keep], areas, cosines, float(np.mean(~found)),
    )  # fmt: skip


def edge_pairs(triangles: Index, level: int) -> tuple[Index, Array]:
    """Points on shared edges as both neighbours see them: patches [2, S], coordinates [2, S, 3].

    Every edge shared by two patches has `level` - 1 points inside.
    """
    sides = np.stack([triangles, triangles[:, [1, 2, 0]]], axis=2).reshape(-1, 2)
    _, number, times = np.unique(
        np.sort(sides, axis=1) @ [int(triangles.max()) + 1, 1], return_inverse=True, return_counts=True
    )
    order = np.argsort(number, kind="stable")
    order = order[times[number[order]] == 2].reshape(-1, 2)
    steps = np.arange(1, level) / level
    patches, coordinates = [], []
    for column in range(2):
        patch, k = np.divmod(order[:, column], 3)
        b = np.zeros((len(order), len(steps), 3))
        # the second neighbour traverses the edge in the other direction
        share = steps if column == 0 else 1.0 - steps
        np.put_along_axis(b, np.broadcast_to(k[:, None, None], (*b.shape[:2], 1)), 1.0 - share[:, None], axis=2)
        np.put_along_axis(b, np.broadcast_to(((k + 1) % 3)[:, None, None], (*b.shape[:2], 1)), share[:, None], axis=2)
        patches.append(np.repeat(patch, len(steps)))
        coordinates.append(b.reshape(-1, 3))
    return np.stack(patches), np.stack(coordinates)


def inner_points(level: int) -> Array:
    """Coordinates [n, 3] strictly inside a patch: the centroids of the triangles in a grid of `level` segments."""
    steps, triangles = grid(level)
    return np.asarray(steps[triangles].mean(axis=1) / level)
