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
    """u_0 [V, 3] m: every solid in its present shape, or at a guess [V, 3] m if that has the lower energy.

    Cloth and rods take the guess: their energy is that of stretches, which iterations remove before anything else.
    Both are corrected. The energy is Phi less |f0|^2 / (2 D). Elastic energies differ by the work of the mean elastic
    force, to third order: internal forces have no torque, so rigid motions do not change it. For the present shape,
    contacts answer the elastic forces alone. Phi has no work of the pushes on the inertia that f0 does not answer: all
    of it there, what the correction has changed at the guess.
    """
    states = [problem.project(problem.hold(u)) for u in (np.zeros_like(guess), guess)]
    gradients = [problem.gradient(u) for u in states]
    elastic = [
        gradient - np.where(problem.free[:, None], problem.weight[:, None] * (u - problem.target), 0.0)
        for gradient, u in zip(gradients, states, strict=True)
    ]
    forces = [pushes_of(problem, u, g) for u, g in zip(states, (elastic[0], gradients[1]), strict=True)]
    kept, moved = (correct(problem, u, f) for u, f in zip(states, forces, strict=True))
    anchors = [0.5 * (f**2).sum(axis=(0, 2)) / problem.diagonal for f in forces]
    work = 0.5 * ((elastic[0] + elastic[1]) * (states[1] - states[0])).sum(axis=1) + anchors[0] - anchors[1]
    for sign, after, answered in ((-1.0, kept, problem.target), (1.0, moved, states[1])):
        inertia = problem.weight[:, None] * (after.displacement - after.pushes - answered)
        work = work + sign * (inertia * after.pushes).sum(axis=1)
    component = problem.values.component
    # clamped bodies have no Phi, and take the guess
    stays = problem.values.solid & np.isfinite(kept.energies)
    lower = ~stays | ~(moved.energies + np.bincount(component, work) >= kept.energies)
    return np.where(lower[component, None], moved.displacement, kept.displacement)
