"""A plane between the two sides of every pair, certified by the vertices themselves.

For a unit direction n let a = min over side A of n . x, b = max over side B, and gap = a - b. A positive gap separates
the convex hulls of both sides. Two numbers c_A - c_B >= f then bound all later places: n . x >= c_A on side A and
n . x <= c_B on side B keep the hulls f apart, and so do straight ways between two such states: the set is convex.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .distance import Closest
from .surfaces import Pairs

__all__ = [
    "Planes",
    "best_of",
    "candidates",
    "divide",
    "gap_along",
    "gap_bounds",
    "make_planes",
    "margins",
    "separate",
]


@dataclass(frozen=True)
class Planes:
    """Half-spaces of m pairs: n . x >= above on side A, n . x <= below on side B."""

    normals: Tensor  # [m, 3] toward side A
    above: Tensor  # [m] c_A, m
    below: Tensor  # [m] c_B, m
    margin: Tensor  # [m] rounding of a place, m
    frozen: Tensor  # [m] no direction separates the sides beyond rounding: their vertices must not move

    def replaced(self, of: Tensor, by: Planes) -> Planes:
        """The planes with those of some pairs [n] made anew."""
        return Planes(
            *(old.index_put((of,), new) for old, new in zip(vars(self).values(), vars(by).values(), strict=True))
        )


def margins(corners: Tensor) -> Tensor:
    """Rounding [m] m of n . x at places [m, 4, 3]: 2 eps of the largest |x|_1."""
    return 2.0 * torch.finfo(corners.dtype).eps * corners.abs().sum(dim=2).amax(dim=1)


def gap_along(normals: Tensor, corners: Tensor, points: int) -> Tensor:
    """a - b [m, ...] m along directions [m, ..., 3], from differences of places."""
    arms = corners[:, 1:] - corners[:, :1]
    heights = torch.einsum("m...d,mkd->mk...", normals, arms)
    on_b = heights.amax(dim=1)
    on_b[points:] = heights[points:, 1:].amax(dim=1)
    on_a = torch.zeros_like(on_b)
    on_a[points:] = heights[points:, 0].clamp(max=0.0)
    return on_a - on_b


def candidates(corners: Tensor, points: int, near: Closest, *others: Tensor) -> Tensor:
    """Unit directions [m, k, 3] that may separate the sides; zero where one has no length.

    The first is that between the closest points. The second is the same made orthogonal to the edges that carry them:
    rounding turns it by ulp / d, over an edge's length more than the gap. Then the normal of the face, or the common
    normal of the edges, and `others` [m, 3].
    """
    own = [near.diff, _squared(corners, points, near), _normals(corners, points, near.diff)]
    among = torch.stack([*own, *others], dim=1)
    length = among.norm(dim=2, keepdim=True)
    return torch.where(length > 0.0, among / torch.where(length > 0.0, length, torch.ones_like(length)), 0.0)


def best_of(among: Tensor, gaps: Tensor) -> tuple[Tensor, Tensor]:
    """The direction [m, 3] of the largest of the gaps [m, k] m, and that gap; the first of equals."""
    gaps = torch.where((among != 0.0).any(dim=2), gaps, -torch.inf)
    best, number = gaps.argmax(dim=1), torch.arange(len(gaps))
    return among[number, best], gaps[number, best]


def gap_bounds(corners: Tensor) -> Tensor:
    """Rounding [m] m of `gap_along`: 4 eps of the largest |x_a - x_0|_1."""
    reach = (corners[:, 1:] - corners[:, :1]).abs().sum(dim=2).amax(dim=1)
    return 4.0 * torch.finfo(corners.dtype).eps * reach


def separate(corners: Tensor, points: int, near: Closest, *others: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Direction of the largest gap among `candidates` [m, 3], that gap [m] m, and the bound [m] m of its rounding."""
    among = candidates(corners, points, near, *others)
    normals, gap = best_of(among, gap_along(among, corners, points))
    return normals, gap, gap_bounds(corners)


def _normals(corners: Tensor, points: int, diff: Tensor) -> Tensor:
    """Normals of triangles and common normals of edges [m, 3], toward side A."""
    first = corners[:, 1] - corners[:, 0]
    first[:points] = corners[:points, 2] - corners[:points, 1]
    second = corners[:, 3] - corners[:, 2]
    normal = torch.linalg.cross(first, second)
    return torch.where((normal * diff).sum(dim=1, keepdim=True) < 0.0, -normal, normal)


def _squared(corners: Tensor, points: int, near: Closest) -> Tensor:
    """`diff` [m, 3] made orthogonal to the edges in whose inside the closest points lie; twice, for two edges."""
    inside = near.weights != 0.0
    sides = []
    # PT: the edge of the two corners that carry the foot, if a third does not
    for i, j, k in ((1, 2, 3), (2, 3, 1), (3, 1, 2)):
        sides.append((corners[:, j] - corners[:, i], inside[:, i] & inside[:, j] & ~inside[:, k], slice(0, points)))
    for i, j in ((0, 1), (2, 3)):
        sides.append((corners[:, j] - corners[:, i], inside[:, i] & inside[:, j], slice(points, None)))
    diff = near.diff.clone()
    for along, carries, of in (*sides, *sides[3:]):
        along, own = along[of], diff[of]
        square = (along * along).sum(dim=1, keepdim=True)
        share = (own * along).sum(dim=1, keepdim=True) / torch.where(square > 0.0, square, torch.ones_like(square))
        diff[of] = torch.where(carries[of, None], own - share * along, own)
    return diff


def divide(
    corners: Tensor, want: Tensor, on_a: Tensor, floor: Tensor, normals: Tensor, gap: Tensor, bound: Tensor
) -> Planes:
    """Planes at places [m, 4, 3] whose vertices want to go to `want` [m, 4, 3].

    What is left of the gap is shared by how far each side wants to come, each side at least a twentieth. Below the
    floor the sides may part or slide, but not come nearer.
    """
    heights = (normals[:, None] * corners).sum(dim=2)
    least = torch.where(on_a, heights, torch.inf).amin(dim=1)
    most = torch.where(on_a, -torch.inf, heights).amax(dim=1)
    moves = (normals[:, None] * (want - corners)).sum(dim=2)
    by_a = torch.where(on_a, -moves, 0.0).amax(dim=1).clamp(min=0.0)
    by_b = torch.where(on_a, 0.0, moves).amax(dim=1).clamp(min=0.0)
    both = by_a + by_b
    share = torch.where(both > 0.0, by_b / torch.where(both > 0.0, both, torch.ones_like(both)), 0.5).clamp(0.05, 0.95)
    margin = margins(corners)
    apart = floor + 2.0 * margin
    roomy = gap >= apart
    below = torch.where(roomy, most + share * (gap - apart), most - margin)
    above = torch.where(roomy, below + apart, least + margin)
    return Planes(normals, above, below, margin, gap <= bound)


def make_planes(pairs: Pairs, positions: Tensor, want: Tensor, near: Closest, *hand: Tensor) -> Planes:
    """Planes of pairs at positions [N, 3] m that want to go to `want` [N, 3] m; `hand` has the directions at hand."""
    corners = pairs.corners(positions)
    normals, gap, bound = separate(corners, pairs.points, near, *hand)
    return divide(corners, pairs.corners(want), pairs.on_a, pairs.floor, normals, gap, bound)
