"""Coarse corrections by the pieces of bodies: beside contacts, and in the preconditioner of L-BFGS."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .coarse import Motions, MotionsOf
from .pieces import Pieces, PieceSpace

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


@dataclass
class PieceCycle:
    """The preconditioner M + Z (Hc^-1 - Ac^-1) Z^T / relaxation of L-BFGS, which multiplies it by the relaxation.

    A is far too stiff for pieces that turn: it penalises every departure from the current rotations. For nu = 0 the sum
    is at least M, because Hc <= Ac; else it takes at most 2 / 3 of Ac^-1 from 1.8 M. Before the iterate `first` it is
    M alone; there, and after every `every` further iterations, Z, Hc and Ac are made anew. The secant pairs stay.
    """

    problem: Objective
    cycle: Callable[[Array], Array]  # applies M
    pieces: Pieces
    every: int = 0  # 0: made once
    first: int = 2
    relaxation: float = 1.8
    made: int = field(default=0, init=False)  # how many times
    _small: tuple[PieceSpace, Array] | None = field(default=None, init=False)

    def observe(self, iteration: int, displacement: Array) -> None:
        """Make the coarse space if it is time; the observer of `preconditioned_lbfgs`."""
        since = iteration - self.first
        if since == 0 or (self.every and since > 0 and since % self.every == 0):
            space = PieceSpace(self.problem, self.pieces, displacement)
            self._small = space, np.linalg.inv(space.hessian) - np.linalg.inv(space.matrix)
            self.made += 1

    def __call__(self, gradient: Array) -> Array:
        product = self.cycle(gradient)
        if self._small is not None:
            space, difference = self._small
            product = product + space.prolong(difference @ space.restrict(gradient)) / self.relaxation
        return product
