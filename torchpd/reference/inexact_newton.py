"""Inexact Newton: every direction by conjugate gradients with the positive part of the Hessian.

The preconditioner has two parts. P = Z Hc^-1 Z^T + 1.8 Q^T M Q with Q = I - A Z Ac^-1 Z^T is that of L-BFGS, with the
space Z of pieces made at every Newton iterate (`reference.piece_step`). It knows A, which resists out of the plane of
cloth as in it; H does not. So two steps of a Chebyshev iteration for H go before and after it, with 3 x 3 blocks
D >= H. They damp [1/4, 1] of D^-1 H and cannot diverge, so that the whole is positive where P is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from .piece_step import PieceCycle
from .pieces import Pieces
from .problem import StepProblem
from .solvers import Observer, _descend

__all__ = ["NewtonModel", "inexact_newton"]

Array = NDArray[np.float64]
FORCING = 0.3  # share of |grad E| that conjugate gradients leave


@dataclass(frozen=True)
class NewtonModel:
    """The quadratic model of E at u, and its preconditioner."""

    problem: StepProblem
    displacement: Array  # [V, 3] u, m
    coarse: Callable[[Array], Array]  # applies P

    @cached_property
    def hessian(self) -> csr_array:
        """H [3V, 3V], the Hessian of every element clamped at zero."""
        return csr_array(self.problem.hessian(self.displacement, positive=True))

    def moving(self, field: Array) -> Array:
        """The field [V, 3], zero at hard pins."""
        return np.where(self.problem.free[:, None], field, 0.0)

    def product(self, direction: Array) -> Array:
        """H v [V, 3]."""
        return self.moving(np.asarray(self.hessian @ direction.reshape(-1)).reshape(-1, 3))

    @cached_property
    def inverse(self) -> Array:
        """D^-1 [V, 3, 3], zero at hard pins: D = a + sum n_e K_aa of elements with n_e corners, so that H <= D."""
        blocks = self.problem.weight[:, None, None] * np.eye(3)
        for group in self.problem.groups:
            F, corners, gradients = group.deformation(self.displacement), group.stencils.corners, group.gradients
            own, joined = group.law.blocks(F, positive=True), group.law.coupling(F)
            if joined is not None:  # (sum of m numbers)^2 <= m times the sum of their squares
                rows = np.swapaxes(joined.rows, 1, 2).reshape(len(F), -1)
                factor = (np.bincount(joined.group) * joined.factor)[joined.group]
                own = own + factor[:, None, None] * rows[:, :, None] * rows[:, None, :]
            own = own.reshape(len(F), F.shape[2], 3, F.shape[2], 3)
            each = corners.shape[1] * np.einsum("naj,njikl,nak->nail", gradients, own, gradients)
            np.add.at(blocks, corners, each)
        return np.where(self.problem.free[:, None, None], np.linalg.inv(blocks), 0.0)

    def smooth(self, right: Array) -> Array:
        """Two steps of the Chebyshev iteration for H z = r from zero (Saad 2003, algorithm 12.1)."""
        middle, half = 0.625, 0.375
        step = np.einsum("vij,vj->vi", self.inverse, right) / middle
        rho = half / middle
        following = 1.0 / (2.0 * middle / half - rho)
        rest = right - self.product(step)
        return np.asarray(
            step + following * rho * step + 2.0 * following / half * np.einsum("vij,vj->vi", self.inverse, rest)
        )

    def precondition(self, right: Array) -> Array:
        """The preconditioner times a field [V, 3]."""
        z = self.smooth(right)
        z = z + self.moving(self.coarse(right - self.product(z)))
        return np.asarray(z + self.smooth(right - self.product(z)))


def inexact_newton(
    problem: StepProblem,
    first: Array,
    cycle: Callable[[Array], Array],
    pieces: Pieces,
    *,
    iterations: int,
    relaxation: float = 1.8,
    observe: Observer | None = None,
) -> Array:
    """The displacement [V, 3] m after so many iterations of conjugate gradients in all, in a step without contact.

    A Newton iterate ends them where they leave three tenths of |grad E|. A step that does not lower E is halved.

    Args:
        problem: the step.
        first: u_0 [V, 3] m.
        cycle: applies M to a gradient [V, 3] that is zero at hard pins.
        pieces: those of the coarse space.
        iterations: of conjugate gradients, at most; fewer where no step descends.
        relaxation: scale of M.
        observe: called with the number of iterations so far and u + d, d not yet shortened.
    """
    u, used = first, 0
    energy, gradient = problem.evaluate(u)
    while used < iterations and gradient.any():
        space = PieceCycle(problem, cycle, pieces, first=0, relaxation=relaxation, encloses=True)
        space.observe(0, u)
        model = NewtonModel(problem, u, lambda field, space=space: relaxation * space(field))  # type: ignore[misc]
        direction, rest = np.zeros_like(u), -gradient
        left, product, along = FORCING * float(np.linalg.norm(gradient)), 0.0, np.zeros_like(u)
        while used < iterations and float(np.linalg.norm(rest)) > left:
            z = model.precondition(rest)
            last, product = product, float(np.vdot(rest, z))
            along = z + (product / last if last > 0.0 else 0.0) * along
            image = model.product(along)
            length = product / float(np.vdot(along, image))
            direction, rest, used = direction + length * along, rest - length * image, used + 1
            if observe is not None:
                observe(used, u + direction)
        following, energy, gradient = _descend(problem, u, energy, gradient, direction)
        if following is u:
            break
        u = following
    return u
