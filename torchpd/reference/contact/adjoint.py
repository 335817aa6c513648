"""Gradients of a converged step with contact between bodies: dense, in float64, by automatic differentiation.

At a fixed point the pairs with a force hold their gaps, and those that stick hold their two slips too:

    F(x') = g(x') - sum_p w_p (x) f_p = 0,    c(x') = 0
    smooth    f = lambda n                    c = d - r
    slides    f = lambda (n - mu s / |s|)     c = d - r               s = (1 - n n^T) sum w (x' - x)
    sticks    f = lambda n + lambda_t         c = d - r and s = 0

Let K = dF / dx', C = dc / dx', and B the directions of the forces by their multipliers. Where pairs say the same twice,
the multipliers are not unique. The sweeps of a step move them by W C q from those that it began with. Here W are the
steps of the sweeps, and q is any field on the vertices. So for a loss L

    K^T l + C^T nu = dL/dx',    (B W C)^T l = 0,    dL/dp = -l . dF/dp - nu . dc/dp.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..problem import StepProblem
from .screws import placed
from .surfaces import Pairs

__all__ = ["ContactGradients", "SolvedContact", "contact_adjoint", "pair_frames"]

Array = NDArray[np.float64]

# Shares of the friction bound: of the force below which a pair sticks, and of what its slip pulls. One whose slip pulls
# more than the bound slides.
STICKING = 1e-3
TIE = 1e-9  # relative: of equally close features the larger one counts
PARALLEL = 0.05  # sine of the angle of two edges below which their closest points are frozen

# w = base + sum_j share_j move_j: first the features with two shares, then with one, then with none
_CORNERS = np.eye(4)
_FACE = (_CORNERS[0] - _CORNERS[1], [_CORNERS[1] - _CORNERS[2], _CORNERS[1] - _CORNERS[3]])
_INNER = (_CORNERS[0] - _CORNERS[2], [_CORNERS[1] - _CORNERS[0], _CORNERS[2] - _CORNERS[3]])
_SIDES = [(_CORNERS[0] - _CORNERS[a], [_CORNERS[a] - _CORNERS[b]]) for a, b in ((1, 2), (2, 3), (3, 1))]
_ENDS = [(_CORNERS[a] - _CORNERS[2], [_CORNERS[2] - _CORNERS[3]]) for a in (0, 1)] + [
    (_CORNERS[0] - _CORNERS[b], [_CORNERS[1] - _CORNERS[0]]) for b in (2, 3)
]
_POINTS: list[tuple[Array, list[Array]]] = [(_CORNERS[0] - _CORNERS[a], []) for a in (1, 2, 3)]
_TIPS: list[tuple[Array, list[Array]]] = [(_CORNERS[a] - _CORNERS[b], []) for a in (0, 1) for b in (2, 3)]
_OF_POINTS, _OF_EDGES = [_FACE, *_SIDES, *_POINTS], [_INNER, *_ENDS, *_TIPS]


@dataclass(frozen=True)
class SolvedContact:
    """A converged step and the pairs that carry forces at its end."""

    problem: StepProblem
    after: Tensor  # [V, 3] m of the bodies
    collider: Tensor  # [N] collider of each vertex, -1 for those of bodies, which come first
    points: Tensor  # [N - V, 3] m of the colliders about their origins
    poses: Tensor  # [C, 7] of the colliders at the start
    poses_after: Tensor  # [C, 7] at the end
    pairs: Pairs  # [m]
    normal: Tensor  # [m] N, lambda
    tangential: Tensor  # [m, 3] N, lambda_t


@dataclass(frozen=True)
class ContactGradients:
    """Gradients of a loss; those of material arrays by the names of their rows."""

    positions: Tensor  # [V, 3]
    velocities: Tensor  # [V, 3]
    forces: Tensor  # [V, 3] the multiplier l
    poses: Tensor  # [C, 7] at the start
    poses_after: Tensor  # [C, 7] at the end
    pins: Tensor  # [V, 3] targets of the hard pins, by vertex
    friction: Tensor  # [m]
    thickness: Tensor  # [m]
    material: dict[str, Array]
    states: Tensor  # [m] 0 smooth, 1 slides, 2 sticks


def _features(corners: Tensor, points: int) -> tuple[Tensor, Tensor, Tensor]:
    """Base weights [m, 4], moves [m, 2, 4], and whether the frame may turn [m], of the closest points of pairs."""
    base, moves, turns = (corners.new_zeros((len(corners), *shape)) for shape in ((4,), (2, 4), ()))
    for number, corner in enumerate(corners):
        found = []
        for start, own in _OF_POINTS if number < points else _OF_EDGES:
            steps = torch.tensor(np.array([*own, *[np.zeros(4)] * (2 - len(own))]))
            weights, diff = _closest(corner[None], torch.tensor(start)[None], steps[None])
            ends = weights[0] * torch.tensor([1.0, *([1.0, -1.0] if number >= points else [-1.0, -1.0]), -1.0])
            if bool((ends >= -TIE).all()) and bool(weights.isfinite().all()):
                found.append((float(diff[0].norm()), torch.tensor(start), steps))
        least = min(distance for distance, *_ in found)
        # those with more shares come first
        _, base[number], moves[number] = next(one for one in found if one[0] <= least * (1.0 + TIE))
        first, second = corner[1] - corner[0], corner[3] - corner[2]
        sine = torch.linalg.cross(first, second).norm() / (first.norm() * second.norm())
        turns[number] = float(number < points or float(sine) > PARALLEL)
    return base, moves, turns


def _closest(corners: Tensor, base: Tensor, moves: Tensor) -> tuple[Tensor, Tensor]:
    """Weights [m, 4] and differences [m, 3] m of the closest points of features."""
    along = moves @ corners  # [m, 2, 3]
    unused = torch.diag_embed((moves == 0.0).all(dim=2).to(corners.dtype))
    start = (base[:, None] @ corners)[:, 0]
    share = torch.linalg.solve_ex(along @ along.mT + unused, -(along @ start[:, :, None]))[0][:, :, 0]
    weights = base + (share[:, None] @ moves)[:, 0]
    return weights, (weights[:, None] @ corners)[:, 0]


def pair_frames(corners: Tensor, points: int) -> tuple[Tensor, Tensor, Tensor]:
    """Weights [m, 4], normals [m, 3] and distances [m] m of pairs [m, 4, 3], differentiable.

    Weights and normals of edges that are nearly parallel are constant: they would jump from end to end.
    """
    base, moves, turns = _features(corners.detach(), points)
    weights, diff = _closest(corners, base, moves)
    distance = diff.norm(dim=1)
    normals = diff / distance[:, None]
    frozen = turns == 0.0
    still = weights.detach()
    weights = torch.where(frozen[:, None], still, weights)
    normals = torch.where(frozen[:, None], normals.detach(), normals)
    along = (normals.detach() * (still[:, None] @ corners)[:, 0]).sum(dim=1)
    return weights, normals, torch.where(frozen, along, distance)


class _Pairs:
    """Loads and constraints of pairs at places of all vertices."""

    def __init__(self, solved: SolvedContact, start: Tensor, end: Tensor) -> None:
        self.solved, self.pairs = solved, solved.pairs
        weights, normals, _ = pair_frames(self.pairs.corners(end), self.pairs.points)
        slip, _ = self._slips(weights, normals, start, end)
        free = torch.tensor(solved.problem.free)
        inverse = torch.zeros(len(end), dtype=end.dtype)
        inverse[: len(free)] = torch.where(free, 1.0 / torch.tensor(solved.problem.weighted_diagonal), 0.0)
        each = inverse[self.pairs.vertices]
        bound = self.pairs.friction * solved.normal
        slipped, reach = slip.norm(dim=1), bound * (weights**2 * each).sum(dim=1)
        held = (solved.tangential.norm(dim=1) < (1.0 - STICKING) * bound) & (slipped <= reach)
        held |= slipped <= STICKING * reach
        self.states = torch.where(bound > 0.0, torch.where(held, 2, 1), 0)
        sums = torch.zeros_like(inverse).index_add(0, self.pairs.vertices.reshape(-1), weights.abs().reshape(-1))
        self.steps = 1.0 / (weights.abs() * sums[self.pairs.vertices] * each).sum(dim=1)
        basis = torch.linalg.svd(normals[:, None])[2][:, 1:]  # [m, 2, 3]
        self.basis = basis.detach()

    def _slips(self, weights: Tensor, normals: Tensor, start: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
        moved = (weights[:, None] @ self.pairs.corners(end - start))[:, 0]
        return moved - (moved * normals).sum(dim=1, keepdim=True) * normals, moved

    def directions(self, start: Tensor, end: Tensor, friction: Tensor) -> tuple[Tensor, Tensor]:
        """Weights [m, 4], and forces [m, 3] per unit of the normal force, without those that stick."""
        weights, normals, _ = pair_frames(self.pairs.corners(end), self.pairs.points)
        slip, _ = self._slips(weights, normals, start, end)
        slides = self.states == 1
        length = torch.where(slides, slip.norm(dim=1), 1.0)
        against = torch.where(slides, friction / length, 0.0)[:, None] * slip
        return weights, normals - against

    def load(self, start: Tensor, end: Tensor, friction: Tensor) -> Tensor:
        """-sum w (x) f [N, 3] N."""
        weights, directions = self.directions(start, end, friction)
        stuck = (self.states == 2)[:, None]
        each = self.solved.normal[:, None] * directions + torch.where(stuck, self.solved.tangential, 0.0)
        spread = (weights[:, :, None] * each[:, None]).reshape(-1, 3)
        return torch.zeros_like(end).index_add(0, self.pairs.vertices.reshape(-1), -spread)

    def constraints(self, start: Tensor, end: Tensor, thickness: Tensor) -> Tensor:
        """Gaps of all pairs, then both slips of those that stick [n] m."""
        weights, normals, distance = pair_frames(self.pairs.corners(end), self.pairs.points)
        slip, _ = self._slips(weights, normals, start, end)
        stuck = self.states == 2
        along = (self.basis[stuck] @ slip[stuck][:, :, None]).reshape(-1)
        return torch.cat([distance - thickness, along])

    def columns(self, start: Tensor, end: Tensor) -> Tensor:
        """B [n, N, 3]: change of w (x) f by each multiplier, in the order of the constraints."""
        weights, directions = self.directions(start, end, self.pairs.friction)
        stuck = self.states == 2
        of = torch.cat([torch.arange(len(weights)), stuck.nonzero()[:, 0].repeat_interleave(2)])
        along = torch.cat([directions, self.basis[stuck].reshape(-1, 3)])
        made = torch.zeros((len(of), *end.shape), dtype=end.dtype)
        for corner in range(4):
            rows = (torch.arange(len(of)), self.pairs.vertices[of, corner])
            made.index_put_(rows, weights[of, corner, None] * along, accumulate=True)
        self.row_steps = self.steps[of]
        return made


def contact_adjoint(solved: SolvedContact, grad_positions: Tensor, grad_velocities: Tensor) -> ContactGradients:
    """Gradients of a loss by what a converged step depends on, from those by its end [V, 3]."""
    problem, h = solved.problem, solved.problem.time_step
    count = len(solved.after)
    jacobian: Any = torch.autograd.functional.jacobian
    before = torch.tensor(problem.positions)

    def whole(bodies: Tensor, poses: Tensor) -> Tensor:
        return torch.cat([bodies, placed(poses[solved.collider[count:]], solved.points)])

    start, end = whole(before, solved.poses), whole(solved.after, solved.poses_after)
    pairs, own = _Pairs(solved, start, end), solved.pairs
    size = 3 * len(end)
    K = torch.zeros((size, size), dtype=end.dtype)
    u = solved.after.numpy() - problem.positions
    K[: 3 * count, : 3 * count] = torch.tensor(problem.hessian(u).toarray())
    by_start, by_end = jacobian(lambda a, b: pairs.load(a, b, own.friction), (start, end))
    K = K + by_end.reshape(size, size)
    rows_start, C = (
        part.reshape(-1, size) for part in jacobian(lambda a, b: pairs.constraints(a, b, own.thickness), (start, end))
    )
    B = pairs.columns(start, end).reshape(-1, size)
    free = torch.zeros(size, dtype=torch.bool)
    free[: 3 * count] = torch.tensor(problem.free).repeat_interleave(3)
    loss = torch.zeros(size, dtype=end.dtype)
    loss[: 3 * count] = (grad_positions + grad_velocities / h).reshape(-1)
    f, n = int(free.sum()), len(C)
    reached = C[:, free].T @ (pairs.row_steps[:, None] * B[:, free])
    matrix = torch.zeros((2 * f, f + n), dtype=end.dtype)
    matrix[:f, :f], matrix[:f, f:], matrix[f:, :f] = K[free][:, free].T, C[:, free].T, reached
    scale = K.diagonal()[free].abs().mean()
    matrix[f:, :f] *= scale * scale / reached.abs().amax().clamp(min=1e-300) if n else 1.0
    matrix[:f, f:] *= scale
    found = torch.linalg.lstsq(matrix, torch.cat([loss[free], loss.new_zeros(f)])[:, None], driver="gelsd", rcond=1e-12)
    field, nu = torch.zeros(size, dtype=end.dtype), scale * found.solution[f:, 0]
    field[free] = found.solution[:f, 0]
    left = loss - K.T @ field - C.T @ nu
    from_start = -(by_start.reshape(size, size).T @ field + rows_start.T @ nu)
    multiplier = field.reshape(-1, 3)[:count]
    inertia = torch.tensor(problem.values.masses)[:, None] / h**2
    damped = inertia * (1.0 + float(problem.values.damping) * h)
    friction, thickness = own.friction.clone().requires_grad_(), own.thickness.clone().requires_grad_()
    work = (pairs.load(start, end, friction) * field.reshape(-1, 3)).sum() + nu @ pairs.constraints(
        start, end, thickness
    )
    by_friction, by_thickness = torch.autograd.grad(-work, (friction, thickness))
    poses = [
        torch.autograd.functional.vjp(lambda of: placed(of[solved.collider[count:]], solved.points), given, grads)[1]
        for given, grads in (
            (solved.poses, from_start.reshape(-1, 3)[count:]),
            (solved.poses_after, left.reshape(-1, 3)[count:]),
        )
    ]
    hard = torch.tensor(~problem.free)[:, None]
    return ContactGradients(
        positions=damped * multiplier - grad_velocities / h + from_start.reshape(-1, 3)[:count],
        velocities=inertia * h * multiplier,
        forces=multiplier,
        poses=poses[0],
        poses_after=poses[1],
        pins=torch.where(hard, left.reshape(-1, 3)[:count], 0.0),
        friction=by_friction,
        thickness=by_thickness,
        material=problem.material_products(u, -multiplier.numpy()),
        states=pairs.states,
    )
