"""Gradients through a time step by the implicit function theorem.

At a converged step r(x') = a (x' - x - s) + dE/dx'(x') = 0 on the vertices that move, so for a loss L(x', v')

    H l = dL/dx' + dL/dv' / h,     dL/dp = -l . dr/dp          for every input p of the step,

H the exact Hessian of the step's objective (the rotations' derivative included), solved by conjugate gradients with
the weighted diagonal, or with the multilevel preconditioner of a plan that has one. The error of the gradient follows
the error of the step: iterate far enough, and look at the residual.

A GPU's kernel "block" solves every environment in one launch, whatever it takes, so a CUDA graph can record it.

Contacts: the normal direction of a vertex that a contact holds is taken out of the system; a vertex that friction holds
moves with its start. A sliding vertex counts as frictionless: its friction force is taken as constant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import torch
from torch import Tensor

from .diagonal import named_material, pinned_vertices, step_diagonal
from .multilevel import has_levels, reference_of_levels
from .plan import kernel_of
from .tables import MATERIAL_TABLE
from .warn import warn_user

__all__ = ["AdjointCall", "step_adjoint", "step_gradient"]

# Relative residual of the adjoint system at which the solve stops: near the rounding floor of each precision.
_TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-10}
_MOST_ITERATIONS = 2000
_ASKED_EVERY = 10  # iterations: asking whether any environment goes on waits for a GPU
_MOST_OF_A_BLOCK = 16384  # vertices of an environment that one thread block is quick enough with
# A body stretched this much turns so little that its Hessian is the constant, positive majoriser but for 1e-4.
_STRETCH = 1e4
_SPANNED = 1e-6  # square of what earlier normals leave of one that they span
_STICKING = 1e-3  # of what friction could take back: slip below it counts as none


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


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum((1, 2))


def conjugate_gradients(
    product: Callable[[Tensor], Tensor],
    precondition: Callable[[Tensor], Tensor],
    right: Tensor,
    tolerance: float,
) -> tuple[Tensor, Tensor]:
    """Solve for each environment of [B, V, 3]; returns the solution and the relative residual [B].

    An environment whose matrix turns out not to be positive along a direction keeps what it has by then, as does
    one that is done: the host asks every tenth iteration only whether any goes on.
    """
    solution, residual = torch.zeros_like(right), right
    preconditioned = precondition(residual)
    direction, rho = preconditioned, _dot(residual, preconditioned)
    scale = _dot(right, right).sqrt()
    active = scale > 0
    for iteration in range(_MOST_ITERATIONS):
        if iteration % _ASKED_EVERY == 0 and not bool(active.any()):
            break
        image = product(direction)
        curvature = _dot(direction, image)
        active = active & (curvature > 0)
        step = torch.where(active, rho / curvature.where(active, torch.ones_like(curvature)), torch.zeros_like(rho))
        solution = solution + step[:, None, None] * direction
        residual = residual - step[:, None, None] * image
        active = active & (_dot(residual, residual).sqrt() > tolerance * scale)
        preconditioned = precondition(residual)
        last, rho = rho, _dot(residual, preconditioned)
        ratio = torch.where(active, rho / last.where(active, torch.ones_like(last)), torch.zeros_like(rho))
        direction = torch.where(active[:, None, None], preconditioned + ratio[:, None, None] * direction, direction)
    return solution, _relative(residual, scale)


def _recording(tensor: Tensor) -> bool:
    """Whether what is done with a tensor is recorded for a CUDA graph, where nobody can ask what comes out."""
    if not tensor.is_cuda:
        return False
    with torch.cuda.device(tensor.device):
        return torch.cuda.is_current_stream_capturing()


def _asks(plan: list[Tensor], right: Tensor) -> bool:
    """Whether a solve on a GPU asks the host between its iterations; "block", which has no levels, does all at once."""
    return right.is_cuda and kernel_of(plan) != "block"


def _relative(residual: Tensor, scale: Tensor) -> Tensor:
    return _dot(residual, residual).sqrt() / torch.where(scale > 0, scale, torch.ones_like(scale))


@dataclass(frozen=True)
class _System:
    """H of a step's objective, on what moves: P (inertia + elastic Hessian) P, and the diagonal for it."""

    inertia: Tensor  # [V, 1] or [B, V, 1] N/m, without the curvature of what is slid on
    inverse: Tensor  # 1 / D [B, V, 1], 0 where a vertex does not move
    projector: Tensor | None  # of what contacts let through [B, V, 3, 3]
    stiffness: Tensor
    plan: list[Tensor]

    def allowed(self, field: Tensor) -> Tensor:
        """The part of a field [B, V, 3] that may move."""
        field = torch.where(self.inverse != 0, field, 0.0)
        return field if self.projector is None else (self.projector * field.unsqueeze(-2)).sum(-1)

    def solve(self, positions: Tensor, right: Tensor, tolerance: float) -> tuple[Tensor, Tensor]:
        """As `conjugate_gradients`, with the elastic Hessian at some positions; `right` is `allowed`."""
        asks = _asks(self.plan, right)
        if asks and _recording(right):
            raise RuntimeError(
                'torchpd: a CUDA graph can record the gradient of a step with kernel "block" alone, since others and '
                "Multilevel ask the host whether to go on; for meshes of up to about a thousand vertices in float32 "
                'make the simulator with kernel="block" and the Chebyshev or Jacobi solver, else leave backward out of '
                "the graph"
            )
        if has_levels(self.plan) or (right.is_cuda and right.shape[1] > _MOST_OF_A_BLOCK):
            return conjugate_gradients(lambda f: self._product(positions, f), self._precondition, right, tolerance)
        # what many operations on small tensors would spend their time with
        solution, residual, direction = torch.zeros_like(right), right.clone(), torch.empty_like(right)
        progress = right.new_full((len(right), 3), -1.0, dtype=torch.float64)
        steps = _ASKED_EVERY if asks else _MOST_ITERATIONS
        for _ in range(0, _MOST_ITERATIONS, steps):
            torch.ops.torchpd.conjugate_gradients_(
                solution, residual, direction, progress, positions, self.inertia.squeeze(-1),
                self.inverse.squeeze(-1), self.projector, self.stiffness, self.plan,
                tolerance=tolerance, iterations=steps,
            )  # fmt: skip
            if not asks or not bool(progress[:, 2].any()):
                break
        return solution, _relative(residual, progress[:, 1].to(right.dtype))

    def _product(self, positions: Tensor, field: Tensor) -> Tensor:
        elastic = torch.ops.torchpd.hessian_product(positions, field.contiguous(), self.stiffness, self.plan)
        return self.allowed(self.inertia * field + elastic)

    def _precondition(self, field: Tensor) -> Tensor:
        plain = self.inverse * field
        if not has_levels(self.plan):
            return plain
        # M has no say on vertices that were held when it was made
        _, inertia_of_levels = reference_of_levels(self.plan)
        known = torch.isfinite(inertia_of_levels).unsqueeze(-1)
        return self.allowed(torch.where(known, torch.ops.torchpd.precondition(field, self.plan), plain))


@dataclass(frozen=True)
class _Held:
    """What contacts do to the vertices of a solved step."""

    projector: Tensor  # off the normals that hold a vertex [B, V, 3, 3]
    stuck: Tensor  # bool [B, V, 1]: friction holds it
    curvature: Tensor  # of the surface it slides on, times the push [B, V, 1] N/m

    def off_normals(self, field: Tensor) -> Tensor:
        """The part of a field [B, V, 3] that contacts let through."""
        return (self.projector * field.unsqueeze(-2)).sum(-1)


def _surfaces(material: dict[str, Tensor], x: Tensor) -> list[tuple[Tensor, Tensor, Tensor, Tensor, Tensor]]:
    """(normal, gap, friction, motion, curvature) of every contact at positions x [B, V, 3]."""
    found = []
    for plane in material["planes"].unbind(-2):
        normal, height, friction = plane[..., None, :3], plane[..., None, 3], plane[..., None, 4]
        rest = torch.zeros_like(x)
        found.append((normal.expand_as(x), (x * normal).sum(-1) - height, friction, rest, rest[..., 0]))
    for ball in material["spheres"].unbind(-2):
        offset = x - ball[..., None, :3]
        length = offset.norm(dim=-1).clamp_min(torch.finfo(x.dtype).tiny)
        motion = ball[..., None, 5:].expand_as(x)
        normal = offset / length.unsqueeze(-1)
        found.append((normal, length - ball[..., None, 3], ball[..., None, 4], motion, 1 / length))
    return found


def _held_by_contacts(call: AdjointCall, residual: Tensor, diagonal: Tensor) -> _Held:
    """A contact holds a vertex when one unaccelerated iteration, x' - r / D, would end inside it."""
    projector = torch.eye(3, dtype=residual.dtype, device=residual.device).expand(*residual.shape, 3)
    stuck = torch.zeros_like(residual[..., 0], dtype=torch.bool)
    total = torch.zeros_like(residual[..., 0])
    moved = call.after - call.positions
    for normal, gap, friction, motion, curvature in _surfaces(named_material(call.material), call.after):
        push = (residual * normal).sum(-1)
        holds = (push > 0) & (gap < push / diagonal.squeeze(-1))
        slip = moved - motion
        slip = (slip - (slip * normal).sum(-1, keepdim=True) * normal).norm(dim=-1)
        # what friction can take back in one iteration is more than what has slipped
        stuck = stuck | (holds & (friction > 0) & (slip * diagonal.squeeze(-1) < _STICKING * friction * push))
        # what earlier contacts leave of the normal, so that all together are a projector: take_directions in C++
        left = (projector * normal.unsqueeze(-2)).sum(-1)
        size = (left * left).sum(-1)
        takes = holds & (size > _SPANNED)
        share = torch.where(takes, 1.0 / torch.where(takes, size, 1.0), 0.0)[..., None, None]
        projector = projector - share * left.unsqueeze(-1) * left.unsqueeze(-2)
        total = total + torch.where(holds, push * curvature, torch.zeros_like(push))
    return _Held(projector, stuck.unsqueeze(-1), total.unsqueeze(-1))


def _reduce(gradient: Tensor, like: Tensor, dims: int) -> Tensor:
    """Sum over environments for an array that they share."""
    return gradient.sum(0) if like.dim() == dims else gradient.sum_to_size(like.shape)


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
    gradient = gradient + torch.ops.torchpd.gradient(call.after, material["stiffness"], call.plan)
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


def _solve(call: AdjointCall, right: Tensor) -> tuple[Tensor, _Held | None]:
    """The multiplier l of H l = dL/dx' on what moves, and what contacts hold."""
    inertia, diagonal = (t.unsqueeze(-1) for t in step_diagonal(call.plan, call.material, call.time_step))
    free = torch.isfinite(inertia)
    inertia = torch.where(free, inertia, torch.zeros_like(inertia))
    diagonal = torch.where(free, diagonal, torch.ones_like(diagonal)).expand(len(right), -1, -1)
    material = named_material(call.material)
    contacts = material["planes"].shape[-2] + material["spheres"].shape[-2] > 0
    held = _held_by_contacts(call, step_gradient(call), diagonal) if contacts else None

    moves = free if held is None else free & ~held.stuck
    system = _System(
        inertia=inertia if held is None else inertia - held.curvature,
        inverse=torch.where(moves, 1.0 / diagonal, 0.0),
        projector=None if held is None else held.projector,
        stiffness=material["stiffness"],
        plan=call.plan,
    )
    tolerance = _TOLERANCE[right.dtype]
    right = system.allowed(right)
    multiplier, error = system.solve(call.after, right, tolerance)
    # a loss or a state that is no number has a gradient that is none, as those who watch for it expect
    # one of them is enough: 0 times what is no finite number is no number, and so is its sum
    lost = ((right + call.after) * 0.0).sum((1, 2)).isnan()
    multiplier = torch.where(lost[:, None, None], torch.nan, multiplier)
    failed = ~(error <= 1e3 * tolerance) & ~lost
    unasked = _recording(right)
    if unasked or bool(failed.any()):
        if not unasked:
            _warn_of(failed, error)
        wanted = torch.where(failed[:, None, None], right, 0.0)
        # the curvature of what is slid on has no part in the majoriser either
        instead, _ = replace(system, inertia=inertia).solve(_STRETCH * call.after, wanted, tolerance)
        multiplier = torch.where(failed[:, None, None], instead, multiplier)
    return multiplier.contiguous(), held


def _elastic_product(call: AdjointCall, field: Tensor, positions: Tensor) -> Tensor:
    stiffness = named_material(call.material)["stiffness"]
    result: Tensor = torch.ops.torchpd.hessian_product(positions, field.contiguous(), stiffness, call.plan)
    return result


def step_adjoint(
    call: AdjointCall, grad_after: Tensor, grad_velocities: Tensor, wanted: Sequence[bool]
) -> list[Tensor]:
    """Gradients of a loss for positions, velocities, forces [B, V, 3], then material arrays; contacts get zeros.

    Args:
        call: the step.
        grad_after: dL/dx' [B, V, 3].
        grad_velocities: dL/dv' [B, V, 3].
        wanted: which material arrays, in their order; the others are left out, and cost nothing.
    """
    h, material = call.time_step, named_material(call.material)
    masses, inertial = material["masses"].unsqueeze(-1), _inertial(material, h)
    right = grad_after + grad_velocities / h
    multiplier, held = _solve(call, right)

    @cache
    def passed_on() -> Tensor:
        """What vertices that are held pass on: to the targets of pins, to the start of those that friction holds."""
        return right - _elastic_product(call, multiplier, call.after)

    grad_positions = inertial * multiplier - grad_velocities / h
    if held is not None:
        grad_positions = grad_positions + torch.where(held.stuck, held.off_normals(passed_on()), 0.0)
    by_name = _for_material(call, multiplier)
    by_name["pin_targets"] = lambda: _for_targets(call, multiplier, passed_on())
    grads = [
        _reduce(by_name[row.name](), array, row.dims) if row.name in by_name else torch.zeros_like(array)
        for row, array, asked in zip(MATERIAL_TABLE, call.material, wanted, strict=True)
        if asked
    ]
    return [grad_positions, masses / h * multiplier, multiplier, *grads]


def _for_material(call: AdjointCall, multiplier: Tensor) -> dict[str, Callable[[], Tensor]]:
    """-l . dr/dp of every environment for each array p of the material but the targets of pins."""
    h, material = call.time_step, named_material(call.material)
    masses = material["masses"].unsqueeze(-1)

    def rate() -> Tensor:
        return (call.after - call.positions) / h

    def for_stiffness() -> Tensor:
        unit = torch.ones_like(material["stiffness"])
        product: Tensor = torch.ops.torchpd.element_energy_product(call.after, multiplier, unit, call.plan)
        return -product

    def for_masses() -> Tensor:
        pull = _inertial(material, h) / masses * h * rate() - call.velocities / h - material["gravity"].unsqueeze(-2)
        return -(multiplier * pull).sum(-1)

    def for_pin_stiffness() -> Tensor:
        pins = pinned_vertices(call.plan)
        stretch = call.after[:, pins] - material["pin_targets"]
        hard = torch.isinf(material["pin_stiffness"])
        return torch.where(hard, 0.0, -(multiplier[:, pins] * stretch).sum(-1))

    return {
        "stiffness": for_stiffness,
        "masses": for_masses,
        "gravity": lambda: (masses * multiplier).sum(1),
        "damping": lambda: -(masses * multiplier * rate()).sum((1, 2)),
        "pin_stiffness": for_pin_stiffness,
    }


def _for_targets(call: AdjointCall, multiplier: Tensor, passed_on: Tensor) -> Tensor:
    """The same for the targets of pins: hard ones take on what their vertices pass on."""
    pins, springs = pinned_vertices(call.plan), named_material(call.material)["pin_stiffness"].unsqueeze(-1)
    hard = torch.isinf(springs)
    return torch.where(hard, passed_on[:, pins], torch.where(hard, 0.0, springs) * multiplier[:, pins])
