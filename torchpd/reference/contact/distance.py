"""Closest points of a vertex and a triangle (PT) and of two edges (EE).

Both are the least of several candidates. PT: the vertex against the three edges, and against the plane where its foot
lies inside. EE: the four ends against the other edge, and the inner solution where the edges are not parallel. The
inner solution alone is wrong by rounding for nearly parallel edges, and its direction then separates nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["Closest", "closest", "combined", "edge_edge", "point_triangle"]


@dataclass(frozen=True)
class Closest:
    """Closest points of m pairs. The weights of side A add up to 1, those of side B to -1."""

    weights: Tensor  # [m, 4]
    diff: Tensor  # [m, 3] from the point of B to that of A, m
    distance: Tensor  # [m] m


def closest(corners: Tensor, points: int) -> Closest:
    """Closest points of pairs [m, 4, 3] m, of which the first `points` are PT and the others EE."""
    weights = torch.cat([point_triangle(corners[:points]), edge_edge(corners[points:])])
    diff = combined(weights, corners)
    return Closest(weights, diff, diff.norm(dim=1))


def combined(weights: Tensor, corners: Tensor) -> Tensor:
    """sum_a w_a x_a [m, 3] for weights that add up to zero, by differences of places.

    The sum of products would be wrong by an ulp of the place: in float32 that turns the direction of a small distance.
    """
    return (weights[:, 1:, None] * (corners[:, 1:] - corners[:, :1])).sum(dim=1)


def point_triangle(corners: Tensor) -> Tensor:
    """Weights [m, 4] of the closest points of vertices and triangles [m, 4, 3]."""
    if not len(corners):
        return corners.new_zeros((0, 4))
    arms = corners[:, 1:] - corners[:, :1]
    candidates = []
    for i, j in ((0, 1), (1, 2), (2, 0)):
        along = corners[:, 1 + j] - corners[:, 1 + i]
        share = _share(-_dot(arms[:, i], along), _dot(along, along))
        on_edge = arms.new_zeros(arms.shape[:2])
        on_edge[:, i], on_edge[:, j] = 1.0 - share, share
        candidates.append(on_edge)
    normal = torch.linalg.cross(corners[:, 2] - corners[:, 1], corners[:, 3] - corners[:, 1])
    areas = torch.stack(
        [_dot(torch.linalg.cross(arms[:, (k + 1) % 3], arms[:, (k + 2) % 3]), normal) for k in range(3)], dim=1
    )
    inside = (areas >= 0.0).all(dim=1) & (areas.sum(dim=1) > 0.0)
    areas = torch.where(inside[:, None], areas, candidates[0])
    candidates.append(areas / areas.sum(dim=1, keepdim=True))
    among = torch.stack(candidates, dim=1)
    least = ((among[:, :, :, None] * arms[:, None]).sum(dim=2) ** 2).sum(dim=2).argmin(dim=1)
    chosen = among[torch.arange(len(among)), least]
    return torch.cat([torch.ones_like(chosen[:, :1]), -chosen], dim=1)


def edge_edge(corners: Tensor) -> Tensor:
    """Weights [m, 4] of the closest points of two edges [m, 4, 3]."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 2]
    r = corners[:, 0] - corners[:, 2]
    a, b, e = _dot(first, first), _dot(first, second), _dot(second, second)
    c, f = _dot(first, r), _dot(second, r)
    zero, one = torch.zeros_like(a), torch.ones_like(a)
    ends = [(zero, _share(f, e)), (one, _share(f + b, e)), (_share(-c, a), zero), (_share(b - c, a), one)]
    # (d1 x d2) . (d2 x r) / |d1 x d2|^2: differences of dot products would cancel for nearly parallel edges
    normal = _exact_cross(first, second)
    t = _share(b * _share(_dot(normal, _exact_cross(second, r)), _dot(normal, normal)) + f, e)
    ends.append((_share(b * t - c, a), t))
    s, t = (torch.stack(of, dim=1) for of in zip(*ends, strict=True))
    between = r[:, None] + s[:, :, None] * first[:, None] - t[:, :, None] * second[:, None]
    least = (between**2).sum(dim=2).argmin(dim=1)
    number = torch.arange(len(corners))
    s, t = s[number, least], t[number, least]
    return torch.stack([1.0 - s, s, t - 1.0, -t], dim=1)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(dim=-1)


def _exact_cross(one: Tensor, other: Tensor) -> Tensor:
    """Cross products [m, 3], every component to about one rounding."""
    (a, b, c), (x, y, z) = one.unbind(1), other.unbind(1)

    def difference(p: Tensor, q: Tensor, u: Tensor, v: Tensor) -> Tensor:
        return (p * q - u * v) + (_lost(p, q) - _lost(u, v))

    return torch.stack([difference(b, z, c, y), difference(c, x, a, z), difference(a, y, b, x)], dim=1)


def _lost(p: Tensor, q: Tensor) -> Tensor:
    """p q less its rounding to p * q, by halves of the digits (Dekker 1971)."""
    splitter = 2.0**27 + 1.0 if p.dtype == torch.float64 else 2.0**12 + 1.0
    halves = []
    for number in (p, q):
        scaled = splitter * number
        high = scaled - (scaled - number)
        halves.append((high, number - high))
    (ph, pl), (qh, ql) = halves
    return ((ph * qh - p * q) + ph * ql + pl * qh) + pl * ql


def _share(part: Tensor, whole: Tensor) -> Tensor:
    """part / whole within [0, 1]; 0 for an edge without length."""
    return torch.where(whole > 0.0, part / torch.where(whole > 0.0, whole, torch.ones_like(whole)), 0.0).clamp(0.0, 1.0)
