"""A step of bodies that touch each other, on a given list of pairs: multipliers and coarse corrections.

An iteration projects on all pairs in the metric of D. With z before contacts and c = theta omega, four sweeps of

    X = z + c / D sum w (l n + t)
    l <- max(0, l - beta gap(X))        t <- t - beta slip(X), cut to friction l        1 / beta = c sum |w| S / D

follow, S_i the sum of |w| over the active pairs of a vertex. A correction joins the bodies by the envelopes of the
pairs, anchored at l and t, and returns both.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .coarse import MotionsOf, RigidMotions, correct
from .envelopes import Envelopes, PairContacts, contacts_at, pushes_of
from .piece_step import piece_motions
from .pieces import Pieces, PieceSpace
from .schedules import Guarded

if TYPE_CHECKING:
    from .problem import StepProblem

__all__ = ["pair_chebyshev"]

Array = NDArray[np.float64]

SWEEPS = 4
RISE = 1e-5  # relative rise of the guarded energy that counts as rounding


def pair_chebyshev(
    problem: StepProblem,
    pairs: PairContacts,
    *,
    iterations: int,
    every: int = 0,
    pieces: Pieces | None = None,
    corrections: bool = True,
    relaxation: float = 1.9,
) -> tuple[Array, PairContacts]:
    """Displacement [V, 3] m after guarded Chebyshev iterations, and the pairs with their forces then.

    `every` and `pieces` are those of `coarse_chebyshev`.
    """
    current, pairs = _first(problem, pairs) if corrections else (problem.unsolved(), pairs)
    moves = RigidMotions if pieces is None else piece_motions(PieceSpace(problem, pieces, current))
    schedule = Guarded(min(0.99999, 1.0 - relaxation * problem.smallest_ratio), RISE)
    previous, checked = current, current
    scale = problem.weighted_diagonal[:, None]
    for k in range(iterations):
        gradient = problem.gradient(current)
        if k % 4 == 0:
            # both by the multipliers of now
            schedule.last = guarded_energy(problem, pairs, checked) if k else np.inf
            schedule.check(guarded_energy(problem, pairs, current))
            checked = current
        omega = schedule.omega(k)
        if corrections and every and (k or pieces is not None) and k % every == 0 and iterations - k > 2:
            shifted, pairs = corrected_pairs(problem, pairs, current, moves)
            previous, current = previous + shifted - current, shifted
            gradient = problem.gradient(current)
        following = previous + omega * (current - relaxation * gradient / scale - previous)
        moved, pairs = project_pairs(problem, pairs, following, relaxation * omega)
        previous, current = current, problem.project(moved, current)
    return corrected_pairs(problem, pairs, current) if corrections else (current, pairs)


def _first(problem: StepProblem, pairs: PairContacts) -> tuple[Array, PairContacts]:
    """The bodies in their present shape, corrected with the forces of the last step."""
    still = problem.project(problem.hold(np.zeros_like(problem.positions)))
    pull = np.where(problem.free[:, None], problem.weight[:, None] * (still - problem.target), 0.0)
    forces = pushes_of(problem, still, problem.gradient(still) - pull)
    moved = correct(problem, still, forces, pairs)
    return moved.displacement, replace(pairs, forces=moved.forces)


def corrected_pairs(
    problem: StepProblem, pairs: PairContacts, displacement: Array, motions: MotionsOf = RigidMotions
) -> tuple[Array, PairContacts]:
    """Displacement [V, 3] m and pairs after a coarse correction."""
    # the forces of planes answer the elastic forces and those of the pairs
    gradient = problem.gradient(displacement) - nodal(problem, pairs, pairs.forces)
    moved = correct(problem, displacement, pushes_of(problem, displacement, gradient), pairs, motions=motions)
    return moved.displacement, replace(pairs, forces=moved.forces)


def nodal(problem: StepProblem, pairs: PairContacts, forces: Array) -> Array:
    """Forces [V, 3] N on vertices, zero at hard pins."""
    out = np.zeros_like(problem.positions)
    np.add.at(out, pairs.vertices.reshape(-1), (pairs.weights[:, :, None] * forces[:, None, :]).reshape(-1, 3))
    return np.where(problem.free[:, None], out, 0.0)


def pair_envelopes(problem: StepProblem, pairs: PairContacts, displacement: Array) -> Envelopes:
    nothing = np.zeros((len(problem.values.planes) + len(problem.values.spheres), *displacement.shape))
    return contacts_at(problem, displacement, nothing, np.zeros(0, np.int64), pairs)


def guarded_energy(problem: StepProblem, pairs: PairContacts, displacement: Array) -> float:
    """E and the augmented Lagrangian of the pairs [J]."""
    envelopes = pair_envelopes(problem, pairs, displacement)
    return problem.energy(displacement) + envelopes.energy(pairs.friction * envelopes.normal_anchors)


def project_pairs(
    problem: StepProblem, pairs: PairContacts, displacement: Array, relaxation: float
) -> tuple[Array, PairContacts]:
    """z [V, 3] m projected on the pairs in the metric of D, and the pairs with their multipliers."""
    scale = relaxation / problem.weighted_diagonal
    give = np.where(problem.free, scale, 0.0)[pairs.vertices]
    at = pair_envelopes(problem, pairs, displacement)
    normal, tangent, n = at.normal_anchors, at.tangent_anchors, pairs.normals
    active = (normal > 0.0) | (at.gaps < 0.0)
    sums = np.bincount(pairs.vertices[active].reshape(-1), np.abs(pairs.weights[active]).reshape(-1), len(displacement))
    beta = 1.0 / np.maximum((np.abs(pairs.weights) * sums[pairs.vertices] * give).sum(axis=1), 1e-300)
    for _ in range(SWEEPS):
        forces = nodal(problem, pairs, normal[:, None] * n + tangent)
        trial = pair_envelopes(problem, pairs, displacement + scale[:, None] * forces)
        normal = np.where(active, np.maximum(0.0, normal - beta * trial.gaps), 0.0)
        rub = tangent - np.where(active, beta, 0.0)[:, None] * trial.slips
        size = np.linalg.norm(rub, axis=1)
        tangent = np.minimum(1.0, pairs.friction * normal / np.maximum(size, 1e-300))[:, None] * rub
    forces = normal[:, None] * n + tangent
    moved = displacement + scale[:, None] * nodal(problem, pairs, forces)
    return moved, replace(pairs, forces=forces)
