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

import torch
from torch import Tensor

from . import _C
from .diagonal import named_material, pinned_vertices, step_diagonal
from .multilevel import has_levels, reference_of_levels
from .plan import kernel_of
from .warn import warn_user

__all__ = ["AdjointCall", "solve_adjoint", "step_gradient"]

# see csrc/solver/adjoint.h
_TOLERANCE = dict(zip((torch.float32, torch.float64), _C.adjoint_tolerance, strict=True))
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


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Of every environment [B, 1, 1]."""
    each: Tensor = torch.linalg.vecdot(a.flatten(1), b.flatten(1))
    return each[:, None, None]


def _times(matrices: Tensor, field: Tensor) -> Tensor:
    return (matrices * field.unsqueeze(-2)).sum(-1)


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
    solution, residual = torch.zeros_like(right), right.clone()
    direction = precondition(residual)
    rho, scale = _dot(residual, direction), _dot(right, right).sqrt()
    active = scale > 0
    for iteration in range(_C.adjoint_iterations):
        if iteration % _C.adjoint_asked_every == 0 and not bool(active.any()):
            break
        image = product(direction)
        curvature = _dot(direction, image)
        active &= curvature > 0
        step = torch.where(active, rho / curvature, 0.0)
        solution.addcmul_(step, direction)
        residual.addcmul_(step, image, value=-1.0)
        active &= _dot(residual, residual).sqrt() > tolerance * scale
        preconditioned = precondition(residual)
        last, rho = rho, _dot(residual, preconditioned)
        # without a step what is done takes no harm from its direction
        direction = torch.addcmul(preconditioned, torch.where(active, rho / last, 0.0), direction)
    error = _dot(residual, residual).sqrt() / torch.where(scale > 0, scale, 1.0)
    return solution, error.flatten()


def _recording(tensor: Tensor) -> bool:
    """Whether what is done with a tensor is recorded for a CUDA graph, where nobody can ask what comes out."""
    if not tensor.is_cuda:
        return False
    with torch.cuda.device(tensor.device):
        return torch.cuda.is_current_stream_capturing()


def _asks(plan: list[Tensor], right: Tensor) -> bool:
    """Whether a solve on a GPU asks the host between its iterations; "block", which has no levels, does all at once."""
    return right.is_cuda and kernel_of(plan) != "block"


@dataclass(frozen=True)
class _System:
    """H of a step's objective, on what moves: P (inertia + elastic Hessian) P, and the diagonal for it."""

    inertia: Tensor  # [1, V] or [B, V] N/m, without the curvature of what is slid on
    inverse: Tensor  # 1 / D of the same shape, 0 where a vertex does not move
    projector: Tensor | None  # of what contacts let through [B, V, 3, 3]
    stiffness: Tensor
    plan: list[Tensor]

    def allowed(self, field: Tensor) -> Tensor:
        """The part of a field [B, V, 3] that may move."""
        return self.off_normals(torch.where(self.inverse.unsqueeze(-1) != 0, field, 0.0))

    def off_normals(self, field: Tensor) -> Tensor:
        """The part of a field [B, V, 3] that contacts let through."""
        return field if self.projector is None else _times(self.projector, field)

    def solve(self, positions: Tensor, right: Tensor, tolerance: float) -> tuple[Tensor, Tensor]:
        """As `conjugate_gradients`, with the elastic Hessian at some positions; `right` is `allowed`.

        The residual is float64, and no number where positions or right side are none.
        """
        asks = _asks(self.plan, right)
        if asks and _recording(right):
            raise RuntimeError(
                'torchpd: a CUDA graph can record the gradient of a step with kernel "block" alone, since others and '
                "Multilevel ask the host whether to go on; for meshes of up to about a thousand vertices in float32 "
                'make the simulator with kernel="block" and the Chebyshev or Jacobi solver, else leave backward out of '
                "the graph"
            )
        if has_levels(self.plan):
            return self.solve_by_operations(positions, right, tolerance)
        # what many operations on small tensors would spend their time with
        found: tuple[Tensor, Tensor] = torch.ops.torchpd.conjugate_gradients(
            positions, right, self.inertia, self.inverse, self.projector, self.stiffness, self.plan, tolerance=tolerance
        )
        return found

    def solve_by_operations(self, positions: Tensor, right: Tensor, tolerance: float) -> tuple[Tensor, Tensor]:
        """`solve`, of torch operations and Hessian products."""
        # in units that leave room for squares
        largest = right.abs().amax((1, 2), keepdim=True)
        unit = torch.where((largest > 0) & torch.isfinite(largest), largest, 1.0)
        solution, error = conjugate_gradients(
            self.product_at(positions), self.preconditioner(), right / unit, tolerance
        )
        solution = unit * solution
        # one of them is enough: 0 times what is no finite number is no number, and so is its sum
        lost = ((right + positions) * 0.0).sum((1, 2)).isnan()
        return solution, torch.where(lost, torch.nan, error.nan_to_num(nan=torch.inf)).double()

    def product_at(self, positions: Tensor) -> Callable[[Tensor], Tensor]:
        """H of fields at some positions."""
        inertia = self.inertia.unsqueeze(-1)

        def product(field: Tensor) -> Tensor:
            elastic = torch.ops.torchpd.hessian_product(positions, field.contiguous(), self.stiffness, self.plan)
            return self.allowed(torch.addcmul(elastic, inertia, field))

        return product

    def preconditioner(self) -> Callable[[Tensor], Tensor]:
        """M of the levels, and the diagonal where they have no say: on vertices that were held when M was made."""
        inverse = self.inverse.unsqueeze(-1)
        if not has_levels(self.plan):
            return lambda field: inverse * field
        _, inertia_of_levels = reference_of_levels(self.plan)
        known = (inverse != 0) & torch.isfinite(inertia_of_levels).unsqueeze(-1)

        def precondition(field: Tensor) -> Tensor:
            of_levels = torch.ops.torchpd.precondition(field, self.plan)
            return self.off_normals(torch.where(known, of_levels, inverse * field))

        return precondition


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


def solve_adjoint(
    after: Tensor,
    right: Tensor,
    inertia: Tensor,
    inverse: Tensor,
    projector: Tensor | None,
    material: Sequence[Tensor],
    plan: Sequence[Tensor],
    solution: Tensor | None = None,
    error: Tensor | None = None,
    *,
    time_step: float,
) -> tuple[Tensor, Tensor]:
    """The multiplier l, and its relative residual [B], no number where the loss or the state has none.

    Where H turns out not to be positive, that of constant rotations stands in, with a warning.

    Args:
        after: x' [B, V, 3].
        right: right side on what moves [B, V, 3].
        inertia: [V] or [B, V] N/m.
        inverse: 1 / D, 0 where a vertex does not move, of the same shape.
        projector: of what contacts let through [B, V, 3, 3].
        material: of the step.
        plan: of its scene.
        solution: what a solve has come to already [B, V, 3], and
        error: its relative residual [B].
        time_step: h [s].
    """
    arrays = list(plan)
    system = _System(inertia, inverse, projector, named_material(material)["stiffness"], arrays)
    tolerance = _TOLERANCE[right.dtype]
    if solution is None or error is None:
        solution, error = system.solve(after, right, tolerance)
    failed = error > _C.adjoint_failed * tolerance
    unasked = _recording(right)
    if unasked or bool(failed.any()):
        if not unasked:
            _warn_of(failed, error)
        wanted = torch.where(failed[:, None, None], right, 0.0)
        # the curvature of what is slid on has no part in the majoriser either
        plain, _ = step_diagonal(arrays, material, time_step)
        plain = torch.where(torch.isfinite(plain), plain, 0.0)
        instead, _ = replace(system, inertia=plain).solve(_STRETCH * after, wanted, tolerance)
        solution = torch.where(failed[:, None, None], instead, solution)
    return solution.clone(), error.clone()
