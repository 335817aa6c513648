"""Gradients through a time step by the implicit function theorem.

At a converged step r(x') = a (x' - x - s) + dE/dx'(x') = 0 on the vertices that move, so for a loss L(x', v')

    H l = dL/dx' + dL/dv' / h,     dL/dp = -l . dr/dp          for every input p of the step,

H the exact Hessian of the step's objective (the rotations' derivative included), solved by conjugate gradients with
the weighted diagonal. The error of the gradient follows the error of the step: iterate far enough, and look at the
residual.

Contacts: the normal direction of a vertex that a contact holds is taken out of the system; a vertex that friction holds
moves with its start. A sliding vertex counts as frictionless: its friction force is taken as constant.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from .diagonal import named_material, named_plan, pinned_vertices, step_diagonal
from .tables import MATERIAL_TABLE

__all__ = ["AdjointCall", "step_adjoint"]

# Relative residual of the adjoint system at which the solve stops: near the rounding floor of each precision.
_TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-10}
_MOST_ITERATIONS = 2000
_TOUCHING = 1e-4  # of a vertex's displacement scale: how near a contact counts as held


@dataclass(frozen=True)
class AdjointCall:
    """A step that was taken: its inputs, and the positions that it reached."""

    positions: Tensor  # x [B, V, 3]
    velocities: Tensor  # v
    after: Tensor  # x'
    material: list[Tensor]
    plan: list[Tensor]
    time_step: float


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum((1, 2))


def conjugate_gradients(
    product: Callable[[Tensor], Tensor], diagonal: Tensor, right: Tensor, tolerance: float
) -> tuple[Tensor, Tensor]:
    """Solve for each environment of [B, V, 3]; returns the solution and the relative residual [B].

    An environment whose matrix turns out not to be positive along a direction keeps what it has by then.
    """
    solution, residual = torch.zeros_like(right), right
    preconditioned = residual / diagonal
    direction, rho = preconditioned, _dot(residual, preconditioned)
    scale = _dot(right, right).sqrt()
    active = scale > 0
    for _ in range(_MOST_ITERATIONS):
        if not bool(active.any()):
            break
        image = product(direction)
        curvature = _dot(direction, image)
        active = active & (curvature > 0)
        step = torch.where(active, rho / curvature.where(active, torch.ones_like(curvature)), torch.zeros_like(rho))
        solution = solution + step[:, None, None] * direction
        residual = residual - step[:, None, None] * image
        active = active & (_dot(residual, residual).sqrt() > tolerance * scale)
        preconditioned = residual / diagonal
        last, rho = rho, _dot(residual, preconditioned)
        ratio = torch.where(active, rho / last.where(active, torch.ones_like(last)), torch.zeros_like(rho))
        direction = torch.where(active[:, None, None], preconditioned + ratio[:, None, None] * direction, direction)
    return solution, _dot(residual, residual).sqrt() / torch.where(scale > 0, scale, torch.ones_like(scale))


def _plane_normals(material: dict[str, Tensor], x: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
    """(normal, gap, friction) of every contact at positions x: broadcastable to [B, V, 3], [B, V], [B, V]."""
    found = []
    for plane in material["planes"].unbind(-2):
        normal, height, friction = plane[..., None, :3], plane[..., None, 3], plane[..., None, 4]
        found.append((normal.expand_as(x), (x * normal).sum(-1) - height, friction))
    for ball in material["spheres"].unbind(-2):
        offset = x - ball[..., None, :3]
        length = offset.norm(dim=-1)
        normal = offset / length.clamp_min(torch.finfo(x.dtype).tiny).unsqueeze(-1)
        found.append((normal, length - ball[..., None, 3], ball[..., None, 4]))
    return found


def _held_by_contacts(call: AdjointCall, residual: Tensor) -> tuple[Tensor, Tensor]:
    """Projector off the normals that hold a vertex [B, V, 3, 3], and which vertices friction holds [B, V]."""
    material = named_material(call.material)
    identity = torch.eye(3, dtype=residual.dtype, device=residual.device)
    projector = identity.expand(*residual.shape, 3)
    stuck = residual.new_zeros(residual.shape[:2], dtype=torch.bool)
    moved = call.after - call.positions
    extent = (call.positions.amax((1, 2)) - call.positions.amin((1, 2))).unsqueeze(-1)
    for normal, gap, friction in _plane_normals(material, call.after):
        push = (residual * normal).sum(-1)
        holds = (gap.abs() <= _TOUCHING * extent) & (push > 0)
        # a push larger than what the tangential residual needs: Coulomb's cone is not reached
        tangential = (residual - push.unsqueeze(-1) * normal).norm(dim=-1)
        slip = (moved - (moved * normal).sum(-1, keepdim=True) * normal).norm(dim=-1)
        sticks = holds & (friction > 0) & (tangential <= friction * push) & (slip <= _TOUCHING * extent)
        outer = normal.unsqueeze(-1) * normal.unsqueeze(-2)
        projector = torch.where(holds[..., None, None], projector - outer @ projector, projector)
        stuck = stuck | sticks
    return projector, stuck


def _reduce(gradient: Tensor, like: Tensor, dims: int) -> Tensor:
    """Sum over environments for an array that they share."""
    return gradient.sum(0) if like.dim() == dims else gradient.sum_to_size(like.shape)


def step_adjoint(call: AdjointCall, grad_after: Tensor, grad_velocities: Tensor) -> list[Tensor]:
    """Gradients of a loss for positions, velocities, forces [B, V, 3], then every material array; contacts get zeros.

    Args:
        call: the step.
        grad_after: dL/dx' [B, V, 3].
        grad_velocities: dL/dv' [B, V, 3].
    """
    ops = torch.ops.torchpd
    h, x, v, after = call.time_step, call.positions, call.velocities, call.after
    material, plan = named_material(call.material), named_plan(call.plan)
    stiffness, masses = material["stiffness"], material["masses"].unsqueeze(-1)
    gravity, damping = material["gravity"].unsqueeze(-2), material["damping"].unsqueeze(-1).unsqueeze(-1)
    inertia, diagonal = (t.unsqueeze(-1) for t in step_diagonal(call.plan, call.material, h))
    free = torch.isfinite(inertia)
    inertia = torch.where(free, inertia, torch.zeros_like(inertia))
    diagonal = torch.where(free, diagonal, torch.ones_like(diagonal)).expand(x.shape[0], -1, -1)

    pins = pinned_vertices(plan)
    springs = material["pin_stiffness"]
    hard = torch.isinf(springs).unsqueeze(-1)
    springs = torch.where(hard, torch.zeros_like(springs.unsqueeze(-1)), springs.unsqueeze(-1))
    inertial = masses / h**2 * (1 + damping * h)
    moved = after - x
    residual = inertial * moved - masses * (v / h + gravity) + ops.gradient(after, stiffness, call.plan)
    residual = residual.index_add(
        1, pins, (springs * (after[:, pins] - material["pin_targets"])).expand(len(x), -1, -1)
    )
    contacts = material["planes"].shape[-2] + material["spheres"].shape[-2] > 0
    projector, stuck = _held_by_contacts(call, residual) if contacts else (None, None)

    def tangential(field: Tensor) -> Tensor:
        return field if projector is None else (projector @ field.unsqueeze(-1)).squeeze(-1)

    def allowed(field: Tensor) -> Tensor:
        moves = free if stuck is None else free & ~stuck.unsqueeze(-1)
        return tangential(torch.where(moves, field, torch.zeros_like(field)))

    def hessian(field: Tensor) -> Tensor:
        result: Tensor = inertia * field + ops.hessian_product(after, field.contiguous(), stiffness, call.plan)
        return result

    right = grad_after + grad_velocities / h
    multiplier, error = conjugate_gradients(
        lambda p: allowed(hessian(p)), diagonal, allowed(right), _TOLERANCE[x.dtype]
    )
    worst = float(error.max()) if len(error) else 0.0
    if not worst <= 1e3 * _TOLERANCE[x.dtype]:
        warnings.warn(
            f"torchpd: the adjoint of a step was solved to a relative residual of {worst:.1e} only; the state is far "
            "from an equilibrium (more iterations in the step help) or at an unstable one",
            stacklevel=2,
        )

    multiplier = multiplier.contiguous()
    passed_on = right - ops.hessian_product(after, multiplier, stiffness, call.plan)
    grad_x = inertial * torch.where(free, multiplier, torch.zeros_like(multiplier)) - grad_velocities / h
    if stuck is not None:
        grad_x = grad_x + torch.where(stuck.unsqueeze(-1), tangential(passed_on), torch.zeros_like(right))
    at_pins = multiplier[:, pins]
    rate = moved / h
    by_name = {
        "stiffness": -ops.element_energy_product(after, multiplier, torch.ones_like(stiffness), call.plan),
        "masses": -(multiplier * ((1 + damping * h) * rate / h - v / h - gravity)).sum(-1),
        "gravity": (masses * multiplier).sum(1),
        "damping": -(masses * multiplier * rate).sum((1, 2)),
        "pin_stiffness": torch.where(hard, 0.0, -at_pins * (after[:, pins] - material["pin_targets"])).sum(-1),
        "pin_targets": torch.where(hard, passed_on[:, pins], springs * at_pins),
    }
    grads = [
        _reduce(by_name[row.name], array, row.dims) if row.name in by_name else torch.zeros_like(array)
        for row, array in zip(MATERIAL_TABLE, call.material, strict=True)
    ]
    return [grad_x, masses / h * multiplier, multiplier, *grads]
