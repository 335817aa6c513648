"""The linear system of a step's adjoint: solved by the op, and of torch operations and Hessian products."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpd.plan.preconditioner import has_preconditioner, stored_reference

__all__ = ["System", "conjugate_gradients", "stabilised_gradients"]

Map = Callable[[Tensor], Tensor]

ops = torch.ops.torchpd


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Of every environment [B, 1, 1]."""
    each: Tensor = torch.linalg.vecdot(a.flatten(1), b.flatten(1))
    return each[:, None, None]


def conjugate_gradients(
    product: Map, precondition: Map, right: Tensor, tolerance: float, iterations: int = 2000
) -> tuple[Tensor, Tensor, Tensor]:
    """Solve for each environment of [B, V, 3]; returns solution, residual and r . z of the last one [B].

    An environment whose matrix turns out not to be positive along a direction keeps what it has by then, as does
    one that is done.
    """
    solution, residual = torch.zeros_like(right), right.clone()
    direction = precondition(residual)
    rho, scale = _dot(residual, direction), _dot(right, right).sqrt()
    active = scale > 0
    for _ in range(iterations):
        if not bool(active.any()):
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
    return solution, residual, rho.flatten()


def stabilised_gradients(
    product: Map, precondition: Map, right: Tensor, tolerance: float, most: int = 2000
) -> tuple[Tensor, int]:
    """Solve for one environment, [1, V, 3], by BiCGStab (van der Vorst 1992); the solution, and its products."""
    solution, residual = torch.zeros_like(right), right.clone()
    direction, rho = residual, _dot(residual, residual)
    for products in range(2, most, 2):
        step_direction = precondition(direction)
        image = product(step_direction)
        step = rho / _dot(right, image)
        half = residual - step * image
        smoothing = precondition(half)
        smoothed = product(smoothing)
        weight = _dot(smoothed, half) / _dot(smoothed, smoothed)
        solution = solution + step * step_direction + weight * smoothing
        residual = half - weight * smoothed
        if bool(_dot(residual, residual) <= tolerance**2 * _dot(right, right)):
            return solution, products
        last, rho = rho, _dot(right, residual)
        direction = residual + (rho / last) * (step / weight) * (direction - weight * image)
    return solution, most


@dataclass(frozen=True)
class System:
    """H of a step's objective, on what moves: P (inertia + elastic Hessian) P, and the diagonal for it."""

    inertia: Tensor  # [1, V] or [B, V] N/m
    inverse: Tensor  # 1 / D of the same shape, 0 where a vertex does not move
    projector: Tensor | None  # of what contacts let through [B, V, 3, 3]
    material: list[Tensor]
    plan: list[Tensor]

    def allowed(self, field: Tensor) -> Tensor:
        """The part of a field [B, V, 3] that may move."""
        return self.off_normals(torch.where(self.inverse.unsqueeze(-1) != 0, field, 0.0))

    def off_normals(self, field: Tensor) -> Tensor:
        """The part of a field [B, V, 3] that contacts let through."""
        return field if self.projector is None else (self.projector * field.unsqueeze(-2)).sum(-1)

    def solve(self, positions: Tensor, right: Tensor, tolerance: float) -> tuple[Tensor, Tensor]:
        """Solution and relative residual, by the op; `right` is `allowed`."""
        found: tuple[Tensor, Tensor] = ops.conjugate_gradients(
            positions, right, self.inertia, self.inverse, self.projector, self.material, self.plan, tolerance=tolerance
        )
        return found

    def product_at(self, positions: Tensor) -> Map:
        """H of fields at some positions."""
        inertia = self.inertia.unsqueeze(-1)

        def product(field: Tensor) -> Tensor:
            elastic = ops.hessian_product(positions, field.contiguous(), self.material, self.plan)
            return self.allowed(torch.addcmul(elastic, inertia, field))

        return product

    def friction_product_at(self, positions: Tensor, sliding: Tensor) -> Map:
        """What vertices that slide make of H: see csrc/solver/adjoint/friction.h."""
        along, normal, across, bend, lean = sliding.unbind(-2)
        inertia = self.inertia.unsqueeze(-1)

        def part(vector: Tensor, field: Tensor) -> Tensor:
            return (vector * field).sum(-1, keepdim=True)

        def product(field: Tensor) -> Tensor:
            pressed = field + normal * part(along, field)
            elastic = ops.hessian_product(positions, pressed, self.material, self.plan)
            turned = (across - lean) * part(across, field) - bend * part(bend, field)
            return self.allowed(elastic + inertia * field + turned)

        return product

    def preconditioner(self) -> Map:
        """M of the levels, and the diagonal where they have no say: on vertices that were held when M was made."""
        inverse = self.inverse.unsqueeze(-1)
        if not has_preconditioner(self.plan):
            return lambda field: inverse * field
        _, inertia_of_levels = stored_reference(self.plan)
        known = (inverse != 0) & torch.isfinite(inertia_of_levels).unsqueeze(-1)

        def precondition(field: Tensor) -> Tensor:
            of_levels = ops.precondition(field, self.plan)
            return self.off_normals(torch.where(known, of_levels, inverse * field))

        return precondition
