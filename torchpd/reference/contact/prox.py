"""Contact as one more proximal step of an iteration: multipliers in the metric of D.

An iteration takes z = x' - c g / D with c = theta omega. Its contacts choose forces lambda n + lambda_t on side A, the
opposite on side B, that shift each vertex by c / D_i sum w_i (lambda n + lambda_t). lambda >= 0 and n . sum w z >= r
are complementary; lambda_t lies in the disc of radius friction lambda and opposes the slip since the step's start. The
fixed point is that of the forces alone: it depends neither on theta and omega, nor on D.

Each of a few sweeps moves all multipliers at once, by the inverse of a majoriser of c C D^-1 C^T:

    beta = 1 / (c sum_i |w_i| S_i / D_i)        S_i = sum over active pairs |w_i|
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from .distance import Closest, combined
from .surfaces import Pairs

__all__ = ["Multipliers", "augmented_lagrangian", "directions", "forces", "prox", "slips"]


@dataclass(frozen=True)
class Multipliers:
    """Forces [N] of m pairs on their side A."""

    normal: Tensor  # [m] lambda
    tangential: Tensor  # [m, 3] lambda_t

    @staticmethod
    def none(count: int, dtype: torch.dtype) -> Multipliers:
        return Multipliers(torch.zeros(count, dtype=dtype), torch.zeros((count, 3), dtype=dtype))


def _tangential(vectors: Tensor, normals: Tensor) -> Tensor:
    return vectors - (vectors * normals).sum(dim=1, keepdim=True) * normals


def _onto_disc(vectors: Tensor, radius: Tensor) -> Tensor:
    length = vectors.norm(dim=1)
    share = torch.where(length > radius, radius / torch.where(length > radius, length, torch.ones_like(length)), 1.0)
    return share[:, None] * vectors


def slips(pairs: Pairs, weights: Tensor, normals: Tensor, moves: Tensor) -> Tensor:
    """Slip [m, 3] m of pairs whose vertices have moved by `moves` [N, 3] m since the step's start."""
    return _tangential(combined(weights, moves[pairs.vertices]), normals)


def forces(pairs: Pairs, weights: Tensor, normals: Tensor, held: Multipliers, count: int) -> Tensor:
    """Forces [count, 3] N on the vertices: sum w (lambda n + lambda_t)."""
    each = held.normal[:, None] * normals + held.tangential
    sums = torch.zeros((count, 3), dtype=each.dtype)
    spread = (weights[:, :, None] * each[:, None]).reshape(-1, 3)
    return sums.index_add_(0, pairs.vertices.reshape(-1), spread)


def prox(
    pairs: Pairs,
    weights: Tensor,
    normals: Tensor,
    held: Multipliers,
    target: Tensor,
    start: Tensor,
    inverse: Tensor,
    scale: float,
    sweeps: int,
) -> tuple[Tensor, Multipliers]:
    """The iterate `target` [N, 3] m after contact, and the new multipliers.

    Args:
        pairs: the list.
        weights, normals: [m, 4], [m, 3] of the closest points at the present iterate.
        held: multipliers to begin with.
        target: z.
        start: [N, 3] m, positions at the step's start.
        inverse: [N] 1 / D in m/N, 0 for kinematic vertices.
        scale: c = theta omega.
        sweeps: number of sweeps.
    """
    mobile = (weights.abs() * (inverse[pairs.vertices] > 0.0)).sum(dim=1) > 1e-6
    gap = (normals * combined(weights, pairs.corners(target))).sum(dim=1)
    active = mobile & ((held.normal > 0.0) | (gap < pairs.thickness))
    # where all weight lies on kinematic vertices nothing can yield: beta would be 1 / 0
    held = Multipliers(held.normal * mobile, held.tangential * mobile[:, None])
    if not active.any():
        return target, held
    some, w, n = pairs.chosen(active), weights[active], normals[active]
    lambda_n, lambda_t = held.normal[active], held.tangential[active]
    index = some.vertices.reshape(-1)
    sums = torch.zeros_like(inverse).index_add_(0, index, w.abs().reshape(-1))
    beta = 1.0 / (scale * (w.abs() * sums[some.vertices] * inverse[some.vertices]).sum(dim=1))
    moves = scale * w * inverse[some.vertices]
    before = combined(w, some.corners(start))

    def shifted() -> Tensor:
        each = lambda_n[:, None] * n + lambda_t
        return target.index_add(0, index, (moves[:, :, None] * each[:, None]).reshape(-1, 3))

    for _ in range(sweeps):
        between = combined(w, some.corners(shifted()))
        lambda_n = (lambda_n + beta * (some.thickness - (n * between).sum(dim=1))).clamp(min=0.0)
        pull = lambda_t - beta[:, None] * _tangential(between - before, n)
        lambda_t = _onto_disc(_tangential(pull, n), some.friction * lambda_n)
    normal, tangential = held.normal.clone(), held.tangential.clone()
    normal[active], tangential[active] = lambda_n, lambda_t
    return shifted(), replace(held, normal=normal, tangential=tangential)


def augmented_lagrangian(
    pairs: Pairs, weights: Tensor, inverse: Tensor, held: Multipliers, distance: Tensor, slip: Tensor
) -> float:
    """psi [J] of all pairs at gaps `distance` [m] and slips [m, 3], by multipliers and friction bounds as they are.

    psi        = (max(0, q)^2 - lambda^2) / 2k + (huber(|lambda_t - k t|) - |lambda_t|^2 / 2) / k
    q          = lambda + k (r - d)        1 / k = sum w^2 / D
    huber(y)   = y^2 / 2 up to the bound b = friction lambda, beyond it b y - b^2 / 2
    """
    yielding = (weights**2 * inverse[pairs.vertices]).sum(dim=1)
    own = yielding > 0.0
    k = 1.0 / torch.where(own, yielding, torch.ones_like(yielding))
    pushed = (held.normal + k * (pairs.thickness - distance)).clamp(min=0.0)
    normal = 0.5 * (pushed**2 - held.normal**2) / k
    size = (held.tangential - k[:, None] * slip).norm(dim=1)
    bound = pairs.friction * held.normal
    huber = torch.where(size > bound, bound * size - 0.5 * bound**2, 0.5 * size**2)
    tangential = torch.where(bound > 0.0, (huber - 0.5 * (held.tangential**2).sum(dim=1)) / k, 0.0)
    return float(torch.where(own, normal + tangential, 0.0).double().sum())


def directions(near: Closest, fallback: Tensor) -> Tensor:
    """Directions [m, 3] toward side A: diff / d, or `fallback` where sides all but touch."""
    distance = near.distance[:, None]
    return torch.where(distance > 1e-9, near.diff / torch.where(distance > 1e-9, distance, 1.0), fallback)
