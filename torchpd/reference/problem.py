"""The minimisation of one time step, on `reference.objective`: its first iterate, and energies of a scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..common.tables import SPHERES
from ..scene.scene import SceneValues
from .groups import groups_of
from .objective import Objective
from .rigid import corrected, first_iterate

__all__ = ["StepProblem", "elastic_energy", "kinetic_energy", "potential_energy", "step_problem"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StepProblem(Objective):
    """The minimisation of one step, built by `step_problem`."""

    def first_iterate(self, start: str | Array = "velocity") -> Array:
        """u_0 [V, 3] m with pins at their targets and out of contacts.

        `start` is "velocity" (h v), "inertial" (s) or positions [V, 3]. With a named start every body takes that guess
        or its present shape, after a coarse correction (`reference.rigid`).
        """
        if isinstance(start, str):
            guesses = {"velocity": self.time_step * self.velocities, "inertial": self.target}
            if start not in guesses:
                raise ValueError(f'start must be "velocity", "inertial" or positions [V, 3], got "{start}"')
            return first_iterate(self, guesses[start])
        guess = self.hold(np.asarray(start, dtype=np.float64) - self.positions)
        return self.project(guess, guess)

    def align(self, displacement: Array) -> Array:
        """The coarse correction of a displacement [V, 3] m."""
        return corrected(self, displacement)


def step_problem(
    values: SceneValues,
    positions: Array,
    velocities: Array,
    time_step: float,
    *,
    forces: Array | None = None,
    pin_targets: Array | None = None,
    sphere_centers: Array | None = None,
    sphere_starts: Array | None = None,
) -> StepProblem:
    """Build the minimisation of one step.

    Args:
        values: the scene.
        positions: [V, 3] x_t, m.
        velocities: [V, 3] m/s.
        time_step: h [s].
        forces: [V, 3] N; default none.
        pin_targets: [P, 3] m in the order of values.pin_vertices; default: those of the scene.
        sphere_centers: [S, 3] m at the end of the step; default: those of the scene.
        sphere_starts: [S, 3] m at the start of the step; default: `sphere_centers`. Friction acts on the relative
            motion.
    """
    positions, velocities = np.asarray(positions, dtype=np.float64), np.asarray(velocities, dtype=np.float64)
    held, springs = values.pin_vertices, values.pin_stiffness
    targets = values.pin_targets if pin_targets is None else np.asarray(pin_targets, dtype=np.float64)
    placed = values.spheres[:, SPHERES["center"]]
    centers = placed if sphere_centers is None else np.asarray(sphere_centers, dtype=np.float64)
    starts = centers if sphere_starts is None else np.asarray(sphere_starts, dtype=np.float64)
    inertia = values.masses / time_step**2
    force = values.masses[:, None] * (velocities / time_step + values.gravity)
    if forces is not None:
        force = force + forces
    soft = np.isfinite(springs)
    spring = np.zeros(len(positions))
    spring[held[soft]] = springs[soft]
    force[held[soft]] += springs[soft, None] * (targets - positions[held])[soft]
    weight = inertia * (1.0 + values.damping * time_step) + spring
    target = force / weight[:, None]
    target[held[~soft]] = (targets - positions[held])[~soft]
    free = np.ones(len(positions), dtype=np.bool_)
    free[held[~soft]] = False
    return StepProblem(
        values=values,
        time_step=time_step,
        positions=positions,
        velocities=velocities,
        weight=weight,
        target=target,
        free=free,
        sphere_centers=centers,
        sphere_motions=centers - starts,
    )


def elastic_energy(values: SceneValues, positions: Array) -> float:
    """Elastic energy sum_e V_e psi_e(F_e) [J] at positions [V, 3]; damping has none."""
    groups = groups_of(values, positions, 1.0)
    still = np.zeros_like(positions)
    elastic = (group.law.evaluate(group.deformation(still))[0] for group in groups if group.stencils.kind != "damper")
    return float(sum(energies.sum() for energies in elastic))


def potential_energy(values: SceneValues, positions: Array, *, pin_targets: Array | None = None) -> float:
    """Elastic energy, soft pins k / 2 |x - target|^2 and gravity -m g . x [J]."""
    targets = values.pin_targets if pin_targets is None else pin_targets
    soft = np.isfinite(values.pin_stiffness)
    stretch = (positions[values.pin_vertices] - targets)[soft]
    springs = 0.5 * float(values.pin_stiffness[soft] @ (stretch**2).sum(axis=1))
    weight = -float(values.masses @ (positions @ values.gravity))
    return elastic_energy(values, positions) + springs + weight


def kinetic_energy(values: SceneValues, velocities: Array) -> float:
    """Kinetic energy sum_i m_i / 2 |v_i|^2 [J]."""
    return 0.5 * float(values.masses @ (velocities**2).sum(axis=1))
