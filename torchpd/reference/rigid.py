"""Coarse corrections of a step by rigid motions of bodies: at its start and at its end."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .coarse import MotionsOf, RigidMotions, correct
from .envelopes import pushes_of

if TYPE_CHECKING:
    from .problem import StepProblem

__all__ = ["corrected", "first_iterate"]

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
    """u_0 [V, 3] m: every body in its present shape, or at a guess [V, 3] m if that has the lower Phi; both corrected.

    Contacts answer the elastic forces of the present shape. Elastic energies differ by the work of the mean elastic
    force from one to the other, to third order: internal forces have no torque, so rigid motions do not change it.
    """
    states = [problem.project(problem.hold(u)) for u in (np.zeros_like(guess), guess)]
    elastic = [
        problem.gradient(u) - np.where(problem.free[:, None], problem.weight[:, None] * (u - problem.target), 0.0)
        for u in states
    ]
    forces = pushes_of(problem, states[0], elastic[0])
    kept, moved = (correct(problem, u, forces) for u in states)
    component = problem.values.component
    work = 0.5 * ((elastic[0] + elastic[1]) * (states[1] - states[0])).sum(axis=1)
    # clamped bodies have no Phi, and take the guess
    lower = ~(moved.energies + np.bincount(component, work) >= kept.energies) | np.isinf(kept.energies)
    return np.where(lower[component, None], moved.displacement, kept.displacement)
