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
    after, last = [1, 2, 0], [2, 0, 1]
    along = corners[:, [2, 3, 1]] - corners[:, 1:]
    shares = _share(-_dot(arms, along), _dot(along, along))
    # the edge from corner k to the next one has its weights in these two columns of row k
    candidates = torch.cat([torch.diag_embed(1.0 - shares) + torch.diag_embed(shares)[:, :, last], arms[:, :1]], dim=1)
    normal = torch.linalg.cross(along[:, 0], along[:, 1])
    areas = _dot(torch.linalg.cross(arms[:, after], arms[:, last]), normal[:, None])
    inside = (areas >= 0.0).all(dim=1) & (areas.sum(dim=1) > 0.0)
    areas = torch.where(inside[:, None], areas, candidates[:, 0])
    candidates[:, 3] = areas / areas.sum(dim=1, keepdim=True)
    least = ((candidates[:, :, :, None] * arms[:, None]).sum(dim=2) ** 2).sum(dim=2).argmin(dim=1)
    chosen = candidates[torch.arange(len(arms)), least]
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
    normal, turned = _exact_cross(torch.stack([first, second]), torch.stack([second, r])).unbind(0)
    t = _share(b * _share(_dot(normal, turned), _dot(normal, normal)) + f, e)
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
    """Cross products [..., 3], every component to about one rounding."""
    after, last = [1, 2, 0], [2, 0, 1]
    halves = *_halves(one), *_halves(other)
    product, lost = _product(*(half[..., of] for half, of in zip(halves, (after, after, last, last), strict=True)))
    less, left = _product(*(half[..., of] for half, of in zip(halves, (last, last, after, after), strict=True)))
    return (product - less) + (lost - left)


def _halves(number: Tensor) -> tuple[Tensor, Tensor]:
    """The higher half of the digits, and what is left."""
    scaled = (2.0**27 + 1.0 if number.dtype == torch.float64 else 2.0**12 + 1.0) * number
    high = scaled - (scaled - number)
    return high, number - high


def _product(ph: Tensor, pl: Tensor, qh: Tensor, ql: Tensor) -> tuple[Tensor, Tensor]:
    """p q of numbers in halves, and what its rounding has lost (Dekker 1971)."""
    product = (ph + pl) * (qh + ql)
    return product, ((ph * qh - product) + ph * ql + pl * qh) + pl * ql


def _share(part: Tensor, whole: Tensor) -> Tensor:
    """part / whole within [0, 1]; 0 for an edge without length."""
    return torch.where(whole > 0.0, part / torch.where(whole > 0.0, whole, torch.ones_like(whole)), 0.0).clamp(0.0, 1.0)
