"""A step by guarded Chebyshev iterations with coarse corrections before, between and after them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .coarse import MotionsOf, RigidMotions
from .piece_step import piece_motions
from .pieces import Pieces, PieceSpace
from .rigid import corrected
from .schedules import Guarded
from .solvers import guard_tolerance

if TYPE_CHECKING:
    from .problem import StepProblem

__all__ = ["coarse_chebyshev"]

Array = NDArray[np.float64]


def coarse_chebyshev(
    problem: StepProblem,
    first: Array | None = None,
    *,
    iterations: int,
    every: int = 0,
    pieces: Pieces | None = None,
    remake: int = 0,
    relaxation: float = 1.9,
    observe: Callable[[int, Array], None] | None = None,
) -> Array:
    """Displacement [V, 3] m after guarded Chebyshev iterations and coarse corrections.

    A correction precedes and follows the iterations. With `every` another comes after each so many iterations; it
    shifts both iterates alike, so that momentum goes on. With `pieces` these move the pieces, and the first comes at
    once. Their space is made there, and with `remake` anew after each so many iterations. `observe(k, u_k)` is called
    with every iterate.
    """
    current = problem.first_iterate() if first is None else first
    radius = min(0.99999, 1.0 - relaxation * problem.smallest_ratio)
    schedule = Guarded(radius, guard_tolerance(problem))
    previous, scale, coming = current, problem.weighted_diagonal[:, None], schedule.omega(0)
    moves: MotionsOf = RigidMotions
    for k in range(iterations):
        energy, gradient = problem.evaluate(current)
        omega, coming = coming, schedule.omega(k + 1)
        if k % 4 == 0:
            schedule.check(energy)
        if every and (k or pieces is not None) and k % every == 0 and iterations - k > 2:
            if pieces is not None and (not k or (remake and k % remake == 0)):
                moves = piece_motions(PieceSpace(problem, pieces, current))
            shifted = corrected(problem, current, gradient, moves)
            previous, current = previous + shifted - current, shifted
            gradient = problem.gradient(current)
        step = current - relaxation * gradient / scale
        previous, current = current, problem.project(previous + omega * (step - previous), current)
        if observe is not None:
            observe(k + 1, current)
    return corrected(problem, current)
