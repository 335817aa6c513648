"""All pairs whose sides may come near: boxes, then distances, in a fixed order."""

from __future__ import annotations

import torch
from torch import Tensor

from .boxes import overlaps
from .distance import closest
from .surfaces import Pairs, Surfaces, joined

__all__ = ["boxed_pairs", "near_pairs", "within"]


def boxed_pairs(surfaces: Surfaces, low: Tensor, high: Tensor, reach: Tensor) -> Pairs:
    """Pairs whose sides' boxes meet: around their vertices' boxes [N, 3] m, by the largest reach [N] m of these."""
    faces, lines, points = surfaces.triangles, surfaces.edges, surfaces.vertices[:, None]

    def boxes(sides: Tensor) -> tuple[Tensor, Tensor]:
        widest = reach[sides].amax(dim=1)[:, None]
        return low[sides].amin(dim=1) - widest, high[sides].amax(dim=1) + widest

    vertex, triangle = overlaps(*boxes(points), *boxes(faces))
    first, second = overlaps(*boxes(lines), *boxes(lines))
    once = first < second
    return joined(surfaces.point_pairs(points[vertex, 0], triangle), surfaces.edge_pairs(first[once], second[once]))


def near_pairs(surfaces: Surfaces, positions: Tensor, radii: Tensor) -> Pairs:
    """Pairs with d <= b_A + b_B + max(r, f) at positions [N, 3] m, b of a side the largest of its radii [N] m.

    No vertex leaves the ball of its radius. So the sides of every other pair stay r apart, and f.
    """
    pairs = boxed_pairs(surfaces, positions, positions, radii + 0.5 * surfaces.thickness)
    distance = closest(pairs.corners(positions), pairs.points).distance
    return pairs.chosen(within(pairs, distance, radii, surfaces.thickness))


def within(pairs: Pairs, distance: Tensor, radii: Tensor, thickness: float) -> Tensor:
    """Whether d <= b_A + b_B + r [m] at distances [m] m, b of a side the largest of its radii [N] m."""
    radius = radii[pairs.vertices]
    on_a = torch.where(pairs.on_a, radius, 0.0).amax(dim=1)
    on_b = torch.where(pairs.on_a, 0.0, radius).amax(dim=1)
    return distance <= on_a + on_b + thickness
