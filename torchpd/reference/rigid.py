"""Coarse corrections of a step by rigid motions of bodies: at its start and at its end."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .coarse import MotionsOf, RigidMotions, correct
from .envelopes import pushes_of

if TYPE_CHECKING:
    from .objective import Objective

__all__ = ["corrected", "first_iterate"]

Array = NDArray[np.float64]


def corrected(
    problem: Objective,
    displacement: Array,
    gradient: Array | None = None,
    motions: MotionsOf = RigidMotions,
) -> Array:
    """Displacement [V, 3] m after a coarse correction, from the forces of the contacts at the iterate."""
    gradient = problem.gradient(displacement) if gradient is None else gradient
    return correct(problem, displacement, pushes_of(problem, displacement, gradient), motions=motions).displacement


def first_iterate(problem: Objective, guess: Array) -> Array:
    """u_0 [V, 3] m: every solid in its present shape, after a coarse correction; clamped ones at a guess [V, 3] m.

    Cloth and rods take the guess, too: their energy is that of stretches, which iterations remove before anything else.
    """
    component = problem.values.component
    present = np.where(problem.values.solid[component, None], 0.0, guess)
    start, clamped = (problem.project(problem.hold(u)) for u in (present, guess))
    after = correct(problem, start, pushes_of(problem, start, problem.gradient(start)))
    return np.where(after.moves[component, None], after.displacement, clamped)
