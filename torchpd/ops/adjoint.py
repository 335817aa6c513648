"""Gradients through a time step by the implicit function theorem.

At a converged step r(x') = a (x' - x - s) + dE/dx'(x') = 0 on the free vertices. For a loss L(x', v')

    H l = dL/dx' + dL/dv' / h,     dL/dp = -l . dr/dp          for every input p of the step.

H is the exact Hessian of the step objective, including the derivative of the rotations. Conjugate gradients solve the
system, preconditioned by the weighted diagonal or by the multilevel preconditioner of the plan. `Multilevel` builds the
latter, and any solver with `Simulator(adjoint="multilevel")`. The error of the gradient follows the error of the step:
iterate far enough, and check the residual.

A GPU solves every environment in one launch for any number of iterations, so a CUDA graph can record it. Meshes of half
a million vertices and more take a few launches, fixed by the plan and batch. A converged environment does no work.

Contacts: the normal direction of a touching vertex is removed from the system. A sticking vertex moves with its start,
on a sphere about the centre of that sphere. Sliding friction makes the system unsymmetric
(csrc/solver/adjoint/friction.h). Gradients of the contacts themselves are in csrc/solver/adjoint/contact_gradients.h.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from .. import _C
from ..common.warn import warn_user
from .diagonal import has_damping, named_material, pinned_vertices, step_inertia
from .fake_kernels import CONTACT_LOCAL, CONTACT_RIGID

__all__ = ["ADJOINT_TOLERANCE", "AdjointCall", "adjoint_fallback", "is_recording", "step_gradient"]

# see csrc/solver/adjoint/system.h
ADJOINT_TOLERANCE = dict(zip((torch.float32, torch.float64), _C.adjoint_tolerance, strict=True))
# At this stretch the rotations hardly change, so the Hessian equals the constant, positive majoriser within 1e-4.
_STRETCH = 1e4
# In csrc/binding/contact_adjoint_ops.h: positions before and after a step, and points of colliders; poses; masses.
_CONTACT = 7
_PLACES_OF_PAIRS, _POSES_OF_PAIRS = (0, 1, _CONTACT + CONTACT_LOCAL), (2, 3, 4)
_RIGID_OF_PAIRS = _CONTACT + CONTACT_RIGID
# Powers of the stretch in a row of masses: mass, centre, moment of inertia, angular momentum.
_RIGID_POWERS = (0, *[1] * 3, *[2] * 6, *[2] * 3)


@dataclass(frozen=True)
class AdjointCall:
    """Inputs of a step, and the positions after it."""

    positions: Tensor  # x [B, V, 3]
    velocities: Tensor  # v
    forces: Tensor | None
    after: Tensor  # x'
    material: list[Tensor]
    plan: list[Tensor]
    time_step: float


def is_recording(tensor: Tensor) -> bool:
    """Whether a CUDA graph records the work on a tensor, so that no value may be read."""
    if not tensor.is_cuda:
        return False
    with torch.cuda.device(tensor.device):
        return torch.cuda.is_current_stream_capturing()


def _inertial(material: dict[str, Tensor], time_step: float) -> Tensor:
    """m / h^2 (1 + damping h) [V, 1] or [B, V, 1]."""
    damping = material["damping"].unsqueeze(-1).unsqueeze(-1)
    return material["masses"].unsqueeze(-1) / time_step**2 * (1 + damping * time_step)


def step_gradient(call: AdjointCall) -> Tensor:
    """Gradient of the step objective at `call.after` [B, V, 3] N, without contacts; zero at hard pins.

    m / h^2 (1 + damping h) (x' - x) - m (v / h + gravity) - forces + springs + elastic gradient + that of
    stiffness-proportional damping.
    """
    material = named_material(call.material)
    masses, gravity = material["masses"].unsqueeze(-1), material["gravity"].unsqueeze(-2)
    pull = masses * (call.velocities / call.time_step + gravity)
    gradient = _inertial(material, call.time_step) * (call.after - call.positions) - pull
    gradient = gradient + torch.ops.torchpd.gradient(call.after, call.material, call.plan)
    if has_damping(call.material):
        damping = torch.ops.torchpd.damping_gradient
        gradient = gradient + damping(call.after, call.positions, call.material, call.plan, time_step=call.time_step)
    pins = pinned_vertices(call.plan)
    springs = material["pin_stiffness"].unsqueeze(-1)
    hard = torch.isinf(springs)
    pulled = torch.where(hard, 0.0, springs) * (call.after[:, pins] - material["pin_targets"])
    gradient = gradient.index_add(1, pins, pulled.expand(len(gradient), -1, -1))
    held = torch.zeros_like(gradient).index_add(1, pins, hard.to(gradient.dtype).expand(len(gradient), -1, 3))
    gradient = gradient if call.forces is None else gradient - call.forces
    return torch.where(held > 0, torch.zeros_like(gradient), gradient)


def _warn_of_no_solution(failed: Tensor, error: Tensor) -> None:
    warn_user(
        f"torchpd: the adjoint of a step has no solution in {int(failed.sum())} of {len(failed)} environments "
        f"(relative residual {float(error[failed].max()):.1e}). Their states are far from an equilibrium (more "
        "iterations in the step help), at an unstable one, or have negative stiffness or masses. Their gradients "
        "treat the rotations as constant.",
    )


def _warn_of_friction(failed: Tensor, error: Tensor) -> None:
    warn_user(
        f"torchpd: the adjoint of a step with sliding friction is not solved in {int(failed.sum())} of {len(failed)} "
        f"environments (relative residual {float(error[failed].max()):.1e}), where friction jams. Their gradients are "
        "approximate."
    )


def _stretched(pairs: Sequence[Tensor]) -> list[Tensor]:
    """Pairs at the stretch of the positions: their directions stay, and the curvature of distances vanishes."""
    made = list(pairs)
    for place in _PLACES_OF_PAIRS:
        made[place] = _STRETCH * made[place]
    for place in _POSES_OF_PAIRS:
        origin, turn = made[place].split([3, 4], dim=-1)
        made[place] = torch.cat([_STRETCH * origin, turn], dim=-1)
    made[_RIGID_OF_PAIRS] = made[_RIGID_OF_PAIRS] * _STRETCH ** made[_RIGID_OF_PAIRS].new_tensor(_RIGID_POWERS)
    return made


def _with_colliders(inertia: Tensor, right: Tensor, pairs: Sequence[Tensor]) -> Tensor:
    """Inertia of all vertices of a system, which colliders with a mass have last: a shift and a turn each."""
    if right.shape[1] == inertia.shape[-1]:
        return inertia
    mass = pairs[_RIGID_OF_PAIRS][:, 0].unflatten(0, (len(right), -1))
    of_colliders = torch.stack([mass, torch.zeros_like(mass)], dim=-1).flatten(1)
    return torch.cat([inertia.expand(len(right), -1), of_colliders], dim=1)


def adjoint_fallback(
    solution: Tensor,
    error: Tensor,
    friction: Tensor | None,
    after: Tensor,
    right: Tensor,
    inverse: Tensor,
    projector: Tensor | None,
    material: Sequence[Tensor],
    plan: Sequence[Tensor],
    start: Tensor | None = None,
    pairs: Sequence[Tensor] = (),
    *,
    time_step: float,
) -> Tensor:
    """Multiplier l [B, V, 3]; where H is not positive definite, that of constant rotations, with a warning.

    A second warning tells of an unsolved system with friction, whose approximate `solution` stays. While a CUDA graph
    records, failures cannot be read: there is no warning.

    Args:
        solution: multiplier found by the solver [B, V, 3].
        error: relative residual of the system with H [B].
        friction: relative residual of the system with friction [B]; None without contacts.
        after: x' [B, V, 3].
        right: right side, zero at vertices that do not move [B, V, 3].
        inverse: 1 / D, 0 at vertices that do not move, [V] or [B, V].
        projector: contact projector [B, V, 3, 3].
        material: of the step.
        plan: of the scene.
        start: x [B, V, 3], in scenes with stiffness-proportional damping.
        pairs: of surfaces in contact, csrc/binding/contact_adjoint_ops.h.
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
        _warn_of_no_solution(failed, error)
    # the curvature of contact surfaces is no part of the majoriser
    inertia = _with_colliders(step_inertia(arrays, material, time_step), right, pairs)
    system = (
        _STRETCH * after,
        torch.where(failed[:, None, None], right, 0.0),
        torch.where(torch.isfinite(inertia), inertia, 0.0),
        inverse,
        projector,
        list(material),
        arrays,
        None,
        start,
    )
    accuracy = {"tolerance": tolerance, "time_step": time_step}
    if pairs:
        instead, _ = torch.ops.torchpd.contact_conjugate(*system, _stretched(pairs), **accuracy)
    else:
        instead, _ = torch.ops.torchpd.conjugate_gradients(*system, **accuracy)
    return torch.where(failed[:, None, None], instead, solution)
