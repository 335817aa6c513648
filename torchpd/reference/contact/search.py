"""All pairs whose sides may come near: boxes, then distances, in a fixed order."""

from __future__ import annotations

import torch
from torch import Tensor

from .boxes import overlaps
from .distance import closest
from .surfaces import Pairs, Surfaces, joined

__all__ = ["boxed_pairs", "near_pairs"]


def boxed_pairs(surfaces: Surfaces, low: Tensor, high: Tensor) -> Pairs:
    """Pairs whose sides' boxes meet; each vertex has a box [N, 3] m, each triangle and edge that of its vertices."""
    faces, lines = surfaces.triangles, surfaces.edges
    points = surfaces.vertices
    vertex, triangle = overlaps(low[points], high[points], low[faces].amin(1), high[faces].amax(1))
    edge_low, edge_high = low[lines].amin(1), high[lines].amax(1)
    first, second = overlaps(edge_low, edge_high, edge_low, edge_high)
    once = first < second
    return joined(surfaces.point_pairs(points[vertex], triangle), surfaces.edge_pairs(first[once], second[once]))


def near_pairs(surfaces: Surfaces, positions: Tensor, radii: Tensor) -> Pairs:
    """Pairs with d <= b_A + b_B + max(r, f) at positions [N, 3] m, b of a side the largest of its radii [N] m.

    No vertex leaves the ball of its radius. So the sides of every other pair stay r apart, and f.
    """
    reach = (radii + 0.5 * surfaces.thickness)[:, None]
    pairs = boxed_pairs(surfaces, positions - reach, positions + reach)
    radius = radii[pairs.vertices]
    on_a = torch.where(pairs.on_a, radius, 0.0).amax(dim=1)
    on_b = torch.where(pairs.on_a, 0.0, radius).amax(dim=1)
    distance = closest(pairs.corners(positions), pairs.points).distance
    return pairs.chosen(distance <= on_a + on_b + surfaces.thickness)
