"""A step by guarded Chebyshev iterations with coarse corrections before, between and after them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .coarse import EXACT, PASSES, MotionsOf, RigidMotions, correct, islands
from .envelopes import pushes_of
from .piece_step import piece_motions
from .pieces import Pieces, PieceSpace
from .schedules import Guarded
from .solvers import guard_tolerance

if TYPE_CHECKING:
    from .problem import StepProblem

__all__ = ["coarse_chebyshev", "corrected", "first_iterate", "rigid_fit"]

Array = NDArray[np.float64]


def corrected(
    problem: StepProblem,
    displacement: Array,
    gradient: Array | None = None,
    motions: MotionsOf = RigidMotions,
) -> Array:
    """Displacement [V, 3] m after a coarse correction, from the forces of the contacts at the iterate."""
    gradient = problem.gradient(displacement) if gradient is None else gradient
    return correct(problem, displacement, pushes_of(problem, displacement, gradient), motions=motions)[0]


def first_iterate(problem: StepProblem) -> Array:
    """u_0 [V, 3] m: every body in its present shape, or at h v if that has the lower energy; both corrected.

    Contacts start from the forces that answer the gradients of either state; that of the present shape has no inertia.
    Elastic energies differ by the work of the mean of both elastic gradients, which a rigid motion does not change.
    """
    still, guess = (problem.hold(u) for u in (np.zeros_like(problem.positions), problem.time_step * problem.velocities))
    states = [problem.project(still), problem.project(guess)]
    gradients = [problem.gradient(u) for u in states]
    pulls = [np.where(problem.free[:, None], problem.weight[:, None] * (u - problem.target), 0.0) for u in states]
    forces = [gradients[0] - pulls[0], gradients[1]]
    kept, moved = (
        correct(problem, u, pushes_of(problem, u, force))[0] for u, force in zip(states, forces, strict=True)
    )
    work = 0.5 * ((forces[0] + forces[1] - pulls[1]) * (states[1] - states[0])).sum(axis=1)
    inertia = [0.5 * problem.weight * ((u - problem.target) ** 2).sum(axis=1) for u in (kept, moved)]
    component = problem.values.component
    rise = np.bincount(component, work + np.where(problem.free, inertia[1] - inertia[0], 0.0))
    return np.where((rise < 0.0)[component, None], moved, kept)


def rigid_fit(problem: StepProblem, displacement: Array, goal: Array) -> Array:
    """The rigid motions [V, 3] m of the bodies that bring an iterate nearest to a goal; contacts are ignored."""
    toward = replace(problem, target=goal)
    for bodies, _ in islands(problem):
        for _ in range(PASSES):
            rigid = RigidMotions(toward, displacement, bodies)
            twists = np.asarray(-np.linalg.solve(rigid.hessian, rigid.gradient), np.float64)
            displacement = rigid.after(twists).displacement
            if np.abs(rigid.modes @ twists).max(initial=0.0) < EXACT * rigid.size:
                break
    return displacement


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
    current = first_iterate(problem) if first is None else first
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
        ahead = previous + omega * (step - previous)
        previous, current = current, problem.project(ahead, current)
        if observe is not None:
            observe(k + 1, current)
    if LAST and iterations:
        forces, before = [], ahead
        for after in problem.projections(ahead, previous):
            forces.append(np.where(problem.free[:, None], scale * (after - before), 0.0)/(relaxation*omega))
            before = after
        return correct(problem, current, np.stack(forces) if forces else np.zeros((0, *current.shape)))[0]
    return corrected(problem, current)


LAST = 1
