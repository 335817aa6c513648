"""Static equilibrium of a scene to rounding error.

Energy and forces are those of the compiled ops. Newton's directions come from the Hessian of the reference, so the
result does not depend on a solver of steps, nor on a time step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

import torchpd as tpd
from torchpd.reference import step_problem

__all__ = ["Array", "Equilibrium", "equilibrium"]

Array = NDArray[np.float64]

# Inertia m / h^2 of an h [s] this long only keeps matrices regular where a body is free to move.
_LONG = 1e5


@dataclass(frozen=True)
class Equilibrium:
    """Positions at rest under the loads, and elastic forces there."""

    positions: Array  # [V, 3] m
    gradient: Array  # [V, 3] N, of the elastic energy: what pins and loads hold against
    error: float  # largest component of the Newton step that is left, relative to the size of the scene


def equilibrium(
    *parts: Any, start: Array | None = None, forces: Array | None = None, tolerance: float = 1e-11, most: int = 200
) -> Equilibrium:
    """Minimise elastic energy minus the work of gravity and forces; hard pins hold where `start` has them.

    Args:
        parts: those of a scene.
        start: first iterate [V, 3] m; None: at rest.
        forces: dead loads [V, 3] N.
        tolerance: of `Equilibrium.error`; iterations go on to rounding.
        most: Newton steps.

    Raises:
        RuntimeError: the tolerance was not met.
    """
    scene = tpd.Scene(*parts)
    values = scene.values()
    sim = tpd.Simulator(scene, 1.0, 1, dtype=torch.float64)
    x = np.array(values.rest_positions if start is None else start, dtype=np.float64)
    load = values.masses[:, None] * values.gravity + (0.0 if forces is None else forces)
    problem = step_problem(values, x, 0.0 * x, _LONG)
    free, size = np.flatnonzero(np.repeat(problem.free, 3)), float(np.ptp(x, axis=0).max())

    def evaluate(at: Array) -> tuple[float, Array]:
        """Potential energy, and the net force on free vertices."""
        positions = torch.from_numpy(at)[None]
        work = 0.0 if forces is None else float((forces * at).sum())
        net = sim.gradient(positions)[0].numpy() - load
        return float(sim.energy(positions)) - work, np.where(problem.free[:, None], net, 0.0)

    energy, net = evaluate(x)
    error = np.inf
    for _ in range(most):
        direction = _direction(problem, x - problem.positions, net, free)
        last, error = error, float(np.abs(direction).max()) / size
        accepted = _line_search(evaluate, x, direction, energy, net)
        if accepted is None or (error <= tolerance and error > 0.1 * last):
            break
        x, (energy, net) = accepted
    if not error <= tolerance:
        raise RuntimeError(f"equilibrium: the Newton step must fall to {tolerance:g} of the scene, got {error:.3g}")
    return Equilibrium(x, sim.gradient(torch.from_numpy(x)[None])[0].numpy(), error)


def _direction(problem: Any, displacement: Array, net: Array, free: NDArray[np.int64]) -> Array:
    """Newton direction [V, 3]; that of the positive semidefinite Hessian where the exact one does not descend."""
    flat, direction = net.reshape(-1)[free], np.zeros(net.size)
    for positive in (False, True):
        matrix = csc_array(problem.hessian(displacement, positive=positive)[free][:, free])
        direction[free] = -splu(matrix).solve(flat)
        slope = float(direction[free] @ flat)
        if slope < -1e-8 * np.linalg.norm(direction) * np.linalg.norm(flat):
            break
    return direction.reshape(net.shape)


def _line_search(
    evaluate: Any, x: Array, direction: Array, energy: float, net: Array
) -> tuple[Array, tuple[float, Array]] | None:
    """Halve the step until the energy falls (Armijo), or the net force where energies differ by rounding alone."""
    slope, force, length = float((direction * net).sum()), float(np.linalg.norm(net)), 1.0
    while length > 1e-9:
        trial = x + length * direction
        found = evaluate(trial)
        if abs(found[0] - energy) <= 1e-12 * max(abs(energy), abs(found[0])) + 1e-300:
            falls = float(np.linalg.norm(found[1])) < force
        else:
            falls = found[0] <= energy + 1e-4 * length * slope
        if falls:
            return trial, found
        length *= 0.5
    return None
