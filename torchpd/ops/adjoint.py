"""Gradients through a time step by the implicit function theorem.

At a converged step r(x') = a (x' - x - s) + dE/dx'(x') = 0 on the vertices that move, so for a loss L(x', v')

    H l = dL/dx' + dL/dv' / h,     dL/dp = -l . dr/dp          for every input p of the step,

H the exact Hessian of the step's objective (the rotations' derivative included), solved by conjugate gradients with
the weighted diagonal, or with the multilevel preconditioner of a plan that has one: `Multilevel` makes it, and any
solver with `Simulator(adjoint="multilevel")`. The error of the gradient follows
the error of the step: iterate far enough, and look at the residual.

A GPU solves every environment in one launch, however many iterations it takes (of half a million vertices and more in a
few, as many as the plan and batch ask for), so a CUDA graph can record it. An environment that is done does nothing.

Contacts: the normal direction of a vertex that a contact holds is taken out of the system; a vertex that friction holds
moves with its start, on a ball about its centre. Where vertices slide against friction the system is not symmetric:
csrc/solver/adjoint/friction.h. What contacts themselves get stands in csrc/solver/adjoint/contact_gradients.h.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from .. import _C
from ..common.warn import warn_user
from .diagonal import named_material, pinned_vertices, step_diagonal

__all__ = ["ADJOINT_TOLERANCE", "AdjointCall", "is_recording", "mend_adjoint", "step_gradient"]

# see csrc/solver/adjoint/system.h
ADJOINT_TOLERANCE = dict(zip((torch.float32, torch.float64), _C.adjoint_tolerance, strict=True))
# A body stretched this much turns so little that its Hessian is the constant, positive majoriser but for 1e-4.
_STRETCH = 1e4


@dataclass(frozen=True)
class AdjointCall:
    """A step that was taken: its inputs, and the positions that it reached."""

    positions: Tensor  # x [B, V, 3]
    velocities: Tensor  # v
    forces: Tensor | None
    after: Tensor  # x'
    material: list[Tensor]
    plan: list[Tensor]
    time_step: float


def is_recording(tensor: Tensor) -> bool:
    """Whether what is done with a tensor is recorded for a CUDA graph, where nobody can ask what comes out."""
    if not tensor.is_cuda:
        return False
    with torch.cuda.device(tensor.device):
        return torch.cuda.is_current_stream_capturing()


def _inertial(material: dict[str, Tensor], time_step: float) -> Tensor:
    """m / h^2 (1 + damping h) [V, 1] or [B, V, 1]."""
    damping = material["damping"].unsqueeze(-1).unsqueeze(-1)
    return material["masses"].unsqueeze(-1) / time_step**2 * (1 + damping * time_step)


def step_gradient(call: AdjointCall) -> Tensor:
    """Gradient of the step's objective at `call.after` [B, V, 3] N; contacts do not enter, hard pins have none.

    m / h^2 (1 + damping h) (x' - x) - m (v / h + gravity) - forces + springs + elastic gradient.
    """
    material = named_material(call.material)
    masses, gravity = material["masses"].unsqueeze(-1), material["gravity"].unsqueeze(-2)
    pull = masses * (call.velocities / call.time_step + gravity)
    gradient = _inertial(material, call.time_step) * (call.after - call.positions) - pull
    gradient = gradient + torch.ops.torchpd.gradient(call.after, call.material, call.plan)
    pins = pinned_vertices(call.plan)
    springs = material["pin_stiffness"].unsqueeze(-1)
    hard = torch.isinf(springs)
    pulled = torch.where(hard, 0.0, springs) * (call.after[:, pins] - material["pin_targets"])
    gradient = gradient.index_add(1, pins, pulled.expand(len(gradient), -1, -1))
    held = torch.zeros_like(gradient).index_add(1, pins, hard.to(gradient.dtype).expand(len(gradient), -1, 3))
    gradient = gradient if call.forces is None else gradient - call.forces
    return torch.where(held > 0, torch.zeros_like(gradient), gradient)


def _warn_of(failed: Tensor, error: Tensor) -> None:
    warn_user(
        f"torchpd: the adjoint of a step has no solution in {int(failed.sum())} of {len(failed)} environments "
        f"(relative residual {float(error[failed].max()):.1e}): their states are far from an equilibrium (more "
        "iterations in the step help), at an unstable one, or have negative stiffness or masses. Their gradients "
        "take the rotations as constant.",
    )


def _warn_of_friction(failed: Tensor, error: Tensor) -> None:
    warn_user(
        f"torchpd: the adjoint of a step in which vertices slide is not solved in {int(failed.sum())} of "
        f"{len(failed)} environments (relative residual {float(error[failed].max()):.1e}): friction jams there. Their "
        "gradients are approximate."
    )


def mend_adjoint(
    solution: Tensor,
    error: Tensor,
    friction: Tensor | None,
    after: Tensor,
    right: Tensor,
    inverse: Tensor,
    projector: Tensor | None,
    material: Sequence[Tensor],
    plan: Sequence[Tensor],
    *,
    time_step: float,
) -> Tensor:
    """The multiplier l [B, V, 3]: where H turned out not to be positive that of constant rotations, with a warning.

    A warning says too where the system with friction is not solved: `solution` stays there. While a CUDA graph records,
    nobody can ask whether a solve has failed, and there is no warning.

    Args:
        solution: the multiplier that was found [B, V, 3].
        error: the relative residual of the system with H [B].
        friction: that of the system with friction [B], without contacts None.
        after: x' [B, V, 3].
        right: right side on what moves [B, V, 3].
        inverse: 1 / D, 0 where a vertex does not move, [V] or [B, V].
        projector: of what contacts let through [B, V, 3, 3].
        material: of the step.
        plan: of its scene.
        time_step: h [s].
    """
    arrays, tolerance = list(plan), ADJOINT_TOLERANCE[right.dtype]
    limit = _C.adjoint_failed * tolerance
    failed = error > limit
    if not is_recording(right):
        if friction is not None and bool((friction > limit).any()):
            _warn_of_friction(friction > limit, friction)
        if not bool(failed.any()):
            return solution.clone()
        _warn_of(failed, error)
    # the curvature of what is slid on has no part in the majoriser
    inertia, _ = step_diagonal(arrays, material, time_step)
    instead, _ = torch.ops.torchpd.conjugate_gradients(
        _STRETCH * after,
        torch.where(failed[:, None, None], right, 0.0),
        torch.where(torch.isfinite(inertia), inertia, 0.0),
        inverse,
        projector,
        list(material),
        arrays,
        tolerance=tolerance,
    )
    return torch.where(failed[:, None, None], instead, solution)
