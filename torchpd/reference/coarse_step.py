"""A step by guarded Chebyshev iterations with coarse corrections before, between and after them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .coarse import MotionsOf, RigidMotions, correct
from .envelopes import pushes_of
from .piece_step import piece_motions
from .pieces import Pieces, PieceSpace
from .schedules import Guarded
from .solvers import guard_tolerance

if TYPE_CHECKING:
    from .problem import StepProblem

__all__ = ["coarse_chebyshev", "corrected", "first_iterate"]

Array = NDArray[np.float64]


def corrected(
    problem: StepProblem,
    displacement: Array,
    gradient: Array | None = None,
    motions: MotionsOf = RigidMotions,
) -> Array:
    """Displacement [V, 3] m after a coarse correction, from the forces of the contacts at the iterate."""
    gradient = problem.gradient(displacement) if gradient is None else gradient
    return correct(problem, displacement, pushes_of(problem, displacement, gradient), motions=motions).displacement


def first_iterate(problem: StepProblem, guess: Array) -> Array:
    """u_0 [V, 3] m: every body in its present shape, or at a guess [V, 3] m if that has the lower energy.

    Both are corrected. The energy is Phi less |f0|^2 / (2 D). Elastic energies differ by the work of the mean elastic
    force, to third order: internal forces have no torque, so rigid motions do not change it. For the present shape,
    contacts answer the elastic forces alone.
    """
    states = [problem.project(problem.hold(u)) for u in (np.zeros_like(guess), guess)]
    gradients = [problem.gradient(u) for u in states]
    elastic = [
        gradient - np.where(problem.free[:, None], problem.weight[:, None] * (u - problem.target), 0.0)
        for gradient, u in zip(gradients, states, strict=True)
    ]
    forces = [pushes_of(problem, u, g) for u, g in zip(states, (elastic[0], gradients[1]), strict=True)]
    kept, moved = (correct(problem, u, f) for u, f in zip(states, forces, strict=True))
    anchors = [0.5 * (f**2).sum(axis=(0, 2)) / problem.weighted_diagonal for f in forces]
    work = 0.5 * ((elastic[0] + elastic[1]) * (states[1] - states[0])).sum(axis=1) + anchors[0] - anchors[1]
    component = problem.values.component
    # clamped bodies have no Phi, and take the guess
    lower = ~(moved.energies + np.bincount(component, work) >= kept.energies) | np.isinf(kept.energies)
    return np.where(lower[component, None], moved.displacement, kept.displacement)


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
    guess = problem.time_step * problem.velocities
    current = first_iterate(problem, guess) if first is None else first
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
