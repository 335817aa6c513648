"""Inexact Newton: conjugate gradients on the exact Hessian with the M of `Multilevel`; float64, on the CPU.

It measures the gain of a second-order method over L-BFGS with the same M. Elements, Hessian products and M are
compiled; the vector operations between them are torch's. Sources: Dembo, Eisenstat and Steihaug 1982 (inexact Newton);
Steihaug 1983 (stop at nonpositive curvature).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..ops.energy import elastic_energy
from ..plan.cpu_plan import compile_plan
from ..plan.material import material_of, material_rows
from ..plan.preconditioner import precondition_plan
from ..reference.problem import StepProblem

__all__ = ["NewtonKrylov", "Observer"]

Array = NDArray[np.float64]
Observer = Callable[[int, Array], None]

_ops = torch.ops.torchpd
_LOOSEST = 0.5  # relative residual at which the first linear solves stop; later ones at sqrt |g| / |g_0|
_INNER = 200  # upper limit of iterations in a linear solve
_SHORTEST = 2.0**-20  # least step length of the line search


class NewtonKrylov:
    """Minimisation of the step `problem` from a first iterate.

    Args:
        problem: a step without contacts.
        passes: a counter [1], incremented by every pass over the elements: E and grad E together, or one H p.
    """

    def __init__(self, problem: StepProblem, passes: list[int]) -> None:
        values = problem.values
        plan = compile_plan(values, dtype=torch.float64, progress=False)
        self.material = material_rows(material_of(values, torch.float64))
        inertia = torch.from_numpy(np.where(problem.free, problem.weight, np.inf))
        stiffness = _ops.stiffness_at_rest(self.material, list(plan.arrays))
        levels = precondition_plan(plan, values, stiffness, inertia)
        self.elements, self.levels = list(plan.arrays), list(levels.arrays)
        self.free = torch.from_numpy(problem.free.copy())[:, None]
        self.weight = torch.from_numpy(problem.weight.copy())[:, None]
        self.target = torch.from_numpy(problem.target.copy())
        self.start = torch.from_numpy(problem.positions.copy())
        self.passes = passes

    def evaluate(self, u: Tensor) -> tuple[float, Tensor]:
        """E(u) [J] and grad E(u) [V, 3] N, zero at hard pins."""
        self.passes[0] += 1
        x = (self.start + u)[None]
        pull = torch.where(self.free, u - self.target, 0.0)
        energy = 0.5 * (self.weight * pull.square()).sum()
        energy = energy + elastic_energy(x, self.material, self.elements)[0]
        gradient = self.weight * pull + _ops.gradient(x, self.material, self.elements)[0]
        return float(energy), torch.where(self.free, gradient, 0.0)

    def product(self, u: Tensor, p: Tensor) -> Tensor:
        """H(u) p [V, 3] N, with the derivative of the rotations."""
        self.passes[0] += 1
        elastic = _ops.hessian_product((self.start + u)[None], p[None], self.material, self.elements)[0]
        return torch.where(self.free, self.weight * p + elastic, 0.0)

    def precondition(self, g: Tensor) -> Tensor:
        """M g [V, 3] m."""
        out: Tensor = _ops.precondition(g[None], self.levels)[0]
        return out

    def direction(self, u: Tensor, gradient: Tensor, tolerance: float) -> Tensor:
        """Approximate -H^-1 grad E [V, 3] m by conjugate gradients, ended by the residual or the curvature."""
        p = torch.zeros_like(u)
        residual, z = -gradient, self.precondition(-gradient)
        search, rho, goal = z, float((residual * z).sum()), tolerance * float(gradient.norm())
        for inner in range(_INNER):
            image = self.product(u, search)
            curvature = float((search * image).sum())
            if curvature <= 0.0:
                return search if inner == 0 else p
            p = p + (rho / curvature) * search
            residual = residual - (rho / curvature) * image
            if float(residual.norm()) <= goal:
                break
            z = self.precondition(residual)
            last, rho = rho, float((residual * z).sum())
            search = z + (rho / last) * search
        return p

    def minimise(self, first: Array, iterations: int, observe: Observer) -> None:
        """Run Newton's iterations from `first` [V, 3] m until no step descends; `observe` sees each."""
        u = torch.from_numpy(first.copy())
        energy, gradient = self.evaluate(u)
        largest = size = float(gradient.norm())
        for k in range(iterations):
            if size == 0.0:
                return
            step = self.direction(u, gradient, min(_LOOSEST, math.sqrt(size / largest)))
            found = self._descend(u, energy, gradient, step)
            if found is None:
                return
            u, energy, gradient = found
            size = float(gradient.norm())
            largest = max(largest, size)
            observe(k + 1, u.numpy())

    def _descend(self, u: Tensor, energy: float, gradient: Tensor, step: Tensor) -> tuple[Tensor, float, Tensor] | None:
        """Backtrack on the energy, or on |grad E| once energies differ only by rounding; None if no step descends."""
        slope, size, length = float((step * gradient).sum()), float(gradient.norm()), 1.0
        while length >= _SHORTEST:
            trial = u + length * step
            reached, there = self.evaluate(trial)
            if abs(reached - energy) <= 1e-12 * abs(energy):
                descends = float(there.norm()) < size
            else:
                descends = reached <= energy + 1e-4 * length * slope
            if descends:
                return trial, reached, there
            length *= 0.5
        return None
