"""Coarse corrections by the pieces of bodies: beside contacts, and in the preconditioner of L-BFGS."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .coarse import Motions, MotionsOf
from .pieces import Pieces, PieceSpace, thinned

if TYPE_CHECKING:
    from .objective import Objective

__all__ = ["PieceCycle", "PieceMotions", "piece_motions"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class PieceMotions(Motions):
    """Motions Z q of the pieces of one island, and E with the Hessian Hc where the space was made."""

    space: PieceSpace

    @cached_property
    def columns(self) -> Index:
        """[N] the unknowns of the island among those of the space."""
        return np.flatnonzero(np.isin(self.space.piece, self.space.pieces.of[self.vertices]))

    @cached_property
    def modes(self) -> Array:
        rows = (3 * self.vertices[:, None] + np.arange(3)).reshape(-1)
        return np.asarray(self.space.prolongation[rows][:, self.columns].toarray()).reshape(len(self.vertices), 3, -1)

    @cached_property
    def gradient(self) -> Array:
        forces = self.problem.gradient(self.displacement)[self.vertices]
        return np.asarray(np.einsum("vin,vi->n", self.modes, forces))

    @cached_property
    def hessian(self) -> Array:
        return np.asarray(self.space.hessian[np.ix_(self.columns, self.columns)])

    @property
    def scale(self) -> float:
        return abs(self.energy)

    def share(self, motion: Array) -> float:
        size = max(float(np.ptp(self.problem.positions[body], axis=0).max()) for body in self.bodies)
        return float(np.abs(self.modes @ motion).max(initial=0.0)) / size

    def after(self, motion: Array) -> PieceMotions:
        displacement = self.displacement.copy()
        displacement[self.vertices] += self.modes @ motion
        moved = replace(self, displacement=displacement)
        # the model: what changes linearly, and the same space
        for name, value in (("modes", self.modes), ("hessian", self.hessian), ("columns", self.columns)):
            moved.__dict__[name] = value
        moved.__dict__["gradient"] = self.gradient + self.hessian @ motion
        return moved

    @cached_property
    def energy(self) -> float:
        components = self.problem.values.component[[body[0] for body in self.bodies]]
        return float(self.problem.energies(self.displacement)[components].sum())


def piece_motions(space: PieceSpace) -> MotionsOf:
    """The motions of the pieces of an island, for `coarse.correct`."""
    return lambda problem, displacement, bodies: PieceMotions(problem, displacement, bodies, space)


NOISE = 1e-12  # of the diagonal of Ac: pieces that move together depend on each other
SLOW = 0.75  # share of the decrease that the slope promises
TRIALS = 2  # iterations in a row that fall short of it, after which the space is made anew


@dataclass
class PieceCycle:
    """The preconditioner M + Z (Hc^-1 / relaxation - Ac^-1) Z^T of L-BFGS, which multiplies it by the relaxation.

    A is far too stiff for pieces that turn: it penalises every departure from the current rotations. The sum is
    positive where M has 1 - 1 / relaxation of A^-1 on Z, because Hc <= Ac for nu = 0. Before the iterate `first` it is
    M alone; there Z, Hc and Ac are made. They are made anew after `TRIALS` iterations in a row that lowered E by less
    than `SLOW` of half the slope, which they would if H were still what it was. The secant pairs stay.

    `encloses`: Z Hc^-1 Z^T / relaxation + (I - Z Ac^-1 Z^T A) M (I - A Z Ac^-1 Z^T) instead, positive whatever M is.
    """

    problem: Objective
    cycle: Callable[[Array], Array]  # applies M
    pieces: Pieces
    remakes: bool = True
    first: int = 2
    relaxation: float = 1.8
    encloses: bool = False
    made: int = field(default=0, init=False)  # how many times
    _small: tuple[PieceSpace, Array, Array] | None = field(default=None, init=False)
    _slow: int = field(default=0, init=False)
    _last: tuple[Array, float, Array] | None = field(default=None, init=False)  # u, E and its gradient

    def observe(self, iteration: int, displacement: Array) -> None:
        """Make the coarse space if it is time; the observer of `preconditioned_lbfgs`."""
        energy, gradient = self.problem.evaluate(displacement)
        if self._last is not None:
            before, energy_before, gradient_before = self._last
            promised = -0.5 * float(np.vdot(gradient_before, displacement - before))
            if promised > 1e-12 * abs(energy_before):
                self._slow = 0 if energy_before - energy >= SLOW * promised else self._slow + 1
        self._last = displacement, energy, gradient
        if iteration == self.first or (self.remakes and self.made and self._slow >= TRIALS):
            space = PieceSpace(self.problem, thinned(self.pieces), displacement)
            noise = NOISE * np.diag(np.diag(space.matrix))
            soft, stiff = (np.asarray(np.linalg.inv(m + noise), float) for m in (space.hessian_alone, space.matrix))
            self._small = space, soft / self.relaxation, stiff
            self._slow, self.made = 0, self.made + 1

    def __call__(self, gradient: Array) -> Array:
        if self._small is None:
            return self.cycle(gradient)
        space, soft, stiff = self._small
        motion = space.restrict(gradient)
        if not self.encloses:
            return self.cycle(gradient) + space.prolong((soft - stiff) @ motion)
        product = self.cycle(gradient - self._resists(space.prolong(stiff @ motion)))
        return product + space.prolong(soft @ motion - stiff @ space.restrict(self._resists(product)))

    def _resists(self, field: Array) -> Array:
        """A times a field [V, 3], zero at hard pins."""
        return np.where(self.problem.free[:, None], self.problem.matrix @ field, 0.0)
