"""The adjoint of vertices that slide against friction.

Of one contact with normal n, friction mu and slip s against the surface, a solved step has, with the gradient r of its
objective at the vertex, P = 1 - n n^T and d = s / |s|,

    P r + mu (n . r) d = 0        beside n . x' = const.

The derivative by x' is G H P + kappa Q, G = P + mu d n^T, and Q = 1 - n n^T - d d^T, by which the slip turns, with
kappa = mu (n . r) / |s|. So for a loss L the multiplier is l = G^T y, where P H G^T y + kappa Q y = P dL/dx', and
dL/dp = -l . dr/dp for all that r depends on; the start of the slip has kappa Q y besides. On a ball of radius R, from
the centre to the vertex, the normal turns too: P H P less (n . r) / R, as without friction, less mu^2 (n . r) / R along
d, and kappa Q times 1 - m / R, m the motion along the normal.

That system is not symmetric. Most of it is, P H P + kappa Q, which `conjugate_gradients` solves: times its inverse the
rest is near the identity, and generalised conjugate residuals (Eisenstat, Elman and Schultz 1983) take a few
iterations, fewer the smaller mu is.

Of a vertex between two planes P leaves the edge alone, d lies along it and does not turn, and in place of mu n stands
the sum of mu_k m_k, the m_k dual to the normals: r is the sum of (m_k . r) n_k. The steps themselves take the friction
of a plane against the slip before the other has pushed back, which differs by (push / (D |s|))^2 where that one is
smooth, without the square where both are rough. A vertex that more contacts hold, or a ball and another, counts as
frictionless.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from . import _C
from .adjoint import ADJOINT_TOLERANCE, is_recording
from .warn import warn_user

__all__ = ["slide_adjoint"]

_ITERATIONS = 24  # at most
_UNASKED = 10  # on a GPU, which would have to be waited for


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Of every environment [B, 1, 1]."""
    each: Tensor = torch.linalg.vecdot(a.flatten(1), b.flatten(1))
    return each[:, None, None]


def _along(direction: Tensor, field: Tensor) -> Tensor:
    """Part of a field [B, V, 3], as numbers [B, V, 1]."""
    return (direction * field).sum(-1, keepdim=True)


def _ratio(a: Tensor, b: Tensor) -> Tensor:
    """a / b, 0 where b is 0."""
    return torch.where(b != 0.0, a / torch.where(b != 0.0, b, 1.0), 0.0)


def conjugate_residuals(
    product: Callable[[Tensor], Tensor], right: Tensor, tolerance: float, *, asks: bool
) -> tuple[Tensor, Tensor]:
    """Solve for each environment of [B, V, 3]; returns the solution and the relative residual [B].

    One that is done keeps its bits while others go on.

    Args:
        product: with a matrix near the identity, zero of zero.
        right: right side.
        tolerance: of the residual, relative to the right side.
        asks: whether to ask before every iteration if any environment goes on.
    """
    solution, residual = torch.zeros_like(right), right
    scale = _dot(right, right).sqrt()
    directions: list[tuple[Tensor, Tensor]] = []
    for _ in range(_ITERATIONS if asks else _UNASKED):
        active = _dot(residual, residual).sqrt() > tolerance * scale
        if asks and not bool(active.any()):
            break
        direction = torch.where(active, residual, 0.0)
        image = product(direction)
        for earlier, its_image in directions:
            share = _ratio(_dot(image, its_image), _dot(its_image, its_image))
            direction, image = direction - share * earlier, image - share * its_image
        directions.append((direction, image))
        step = _ratio(_dot(residual, image), _dot(image, image))
        solution, residual = solution + step * direction, residual - step * image
    return solution, _ratio(_dot(residual, residual).sqrt(), scale).flatten()


def slide_adjoint(
    solution: Tensor,
    error: Tensor,
    after: Tensor,
    inertia: Tensor,
    inverse: Tensor,
    projector: Tensor,
    sliding: Tensor,
    stiffness: Tensor,
    plan: Sequence[Tensor],
) -> Tensor:
    """The multiplier l [B, V, 3] of a step in which vertices slide, with a warning where it is not found.

    Args:
        solution: of P H P + kappa Q [B, V, 3].
        error: its relative residual [B]; where the solve has failed friction is left out.
        after: x' [B, V, 3].
        inertia: [V] or [B, V] N/m.
        inverse: 1 / D, 0 where a vertex does not move, of the same shape.
        projector: of what contacts let through [B, V, 3, 3].
        sliding: what vertices slide along [B, V, 5, 3], see csrc/plan/views.h.
        stiffness: [E] or [B, E] Pa.
        plan: of the scene.
    """
    ops, arrays, tolerance = torch.ops.torchpd, list(plan), ADJOINT_TOLERANCE[solution.dtype]
    limit = _C.adjoint_failed * tolerance
    solved = (error <= limit)[:, None, None]
    known = torch.where(solved.unsqueeze(-1), sliding, 0.0)
    along, normal, across, bend, lean = known.unbind(-2)
    slides = (known != 0.0).flatten(1).any(1)[:, None, None]
    moves = (inverse != 0.0).unsqueeze(-1) & slides
    x = torch.where(solved, after, 0.0)
    worst = torch.zeros_like(error)

    def pressed(y: Tensor) -> Tensor:
        """What G^T y has of a normal."""
        return normal * _along(along, y)

    def product(y: Tensor) -> Tensor:
        force = ops.hessian_product(x, pressed(y), stiffness, arrays)
        force = force - bend * _along(bend, y) - lean * _along(across, y)
        force = torch.where(moves, (projector * force.unsqueeze(-2)).sum(-1), 0.0)
        back, inner = ops.conjugate_gradients(
            x, force, inertia, inverse, projector, stiffness, arrays, known, tolerance=tolerance
        )
        torch.maximum(worst, inner, out=worst)
        return y + torch.where(slides, back, 0.0)

    # in units that leave room for squares, of two so that nothing is rounded
    start = torch.where(slides, solution, 0.0)
    _, exponent = torch.frexp(start.abs().amax((1, 2), keepdim=True))
    unit = torch.ldexp(torch.ones_like(start[:, :1, :1]), exponent - 1)
    y, left = conjugate_residuals(product, start / unit, 10.0 * tolerance, asks=not after.is_cuda)
    failed = ~((left <= limit) & (worst <= limit))
    if not is_recording(after) and bool(failed.any()):
        warn_user(
            f"torchpd: the adjoint of a step in which vertices slide is not solved in {int(failed.sum())} of "
            f"{len(failed)} environments (relative residual {float(left.max()):.1e}): friction jams there. Their "
            "gradients are approximate."
        )
    y = unit * y
    return torch.where(slides, y + pressed(y), solution)
