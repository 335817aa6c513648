"""Rigid motions of the reference: each component moves to its least energy as far as pins and contacts allow.

Along rigid motions E is sum a / 2 |x + u - (x + s)|^2, a weighted fit of two point sets (Kabsch 1976).
The constraints leave these motions:

- Hard pins at one point or along a line leave rotations about it.
- Frictionless planes leave the rotation about their normal and the translation along all of them.
- One plane with friction, or the edge of two planes, leaves the translation along it, shortened by Coulomb's law.
- On one plane a component may also tip or roll (`reference.tipping`).
- A component above all planes moves until it reaches the first.
- An element that joins a component to another one, such as a tie, leaves none.

All other contacts leave no motion. Where a motion ends at a contact, the next one continues from there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .rigid_piece import (
    FRICTION,
    HEIGHT,
    LYING,
    NORMAL,
    NearestRotation,
    Problem,
    RigidComponent,
    fraction_of,
    gaps_of,
    turn_about,
)
from .tipping import RollingContact

__all__ = ["align", "begin"]

Array = NDArray[np.float64]

DISTINCT_PLANES = 8  # planes that are treated one by one
LEGS = 4  # successive motions, each ended by a contact
SQUEEZE = 0.5  # fraction of the upper bound of the squeeze energy that is counted
LIFT = 6.0  # bound of the squeeze energy, over the cost of shifting the component by the mean push
WORTH = 0.01  # least squeeze energy, over the remaining energy, for which the current position is chosen


def begin(problem: Problem, guess: Array, diagonal: Array) -> Array:
    """The first iterate [V, 3] m before rigid motions: `guess` after projection, or the current position per component.

    Contacts push each vertex out by p. This squeezes a component by at most sum k / 2 |p - mean p|^2, with k = D - a.
    A component starts at its current position when this leaves less energy, half of the squeeze counted, there or after
    rigid motions; shifting it by the push d costs sum a / 2 d^2. It must have no hard pins, and its target must lie
    outside all contacts but the first planes.
    """
    planes, out = problem.values.planes, problem.project(guess, guess)
    kept = problem.hold(np.zeros_like(guess))
    still, begun, there = problem.project(kept, kept), out.copy(), problem.positions + problem.target
    others = gaps_of(there, planes[DISTINCT_PLANES:], problem.sphere_centers, problem.values.spheres) <= 0.0
    for number in range(int(problem.values.component.max()) + 1):
        of = problem.values.component == number
        a, push = problem.weight[of, None], (out - guess)[of]
        if (others | ~problem.free)[of].any():
            continue
        k = diagonal[of, None] - a
        squeeze = SQUEEZE * float((k * (push - (k * push).sum(axis=0) / max(k.sum(), 1e-300)) ** 2).sum())
        left, before = (float((a * (u - problem.target)[of] ** 2).sum()) for u in (out, still))
        pushed = float(k[push.any(axis=1)].sum())
        lift = LIFT * float(a.sum()) * float((k * push**2).sum()) / max(pushed, 1e-300)
        if squeeze > min(before - left, lift) and squeeze > WORTH * left:
            begun[of] = still[of]
    return begun


def align(problem: Problem, displacement: Array, nearest_rotation: NearestRotation, *, first: bool = False) -> Array:
    """Displacements [V, 3] m after the rigid motion of every component; `first`: before any iteration."""
    values, moved = problem.values, displacement.copy()
    for number in range(int(values.component.max()) + 1):
        of = values.component == number
        for _ in range(LEGS):
            component = RigidComponent(problem, moved, of, nearest_rotation, first)
            way = np.zeros_like(moved)
            way[of] = rigid_motion(component)
            moved = np.where(problem.free[:, None], moved + way, moved)
            if not component.meets_contact:
                break
    return moved


def rigid_motion(component: RigidComponent) -> Array:
    """Displacement [n, 3] m of every vertex of the component."""
    turn, pivot, shift = component.nearest_rotation(component.covariance), component.centroid, component.target_offset
    still = np.zeros_like(component.u)
    if component.pinned.any():
        at_rest, at = component.rest[component.pinned], component.y[component.pinned]
        if np.linalg.matrix_rank(at_rest - at_rest.mean(axis=0), tol=1e-6) > 1:
            return still
        pivot, shift = at.mean(axis=0), np.zeros(3)
        _, sizes, directions = np.linalg.svd(at - pivot, full_matrices=True)
        apart = 1e-4 * np.sqrt(component.gyration_squared * component.pinned.sum())
        if (sizes[1:] > apart).any():
            return still
        covariance = component.covariance_about(pivot, pivot)
        turn = turn_about(directions[0], covariance) if sizes[0] > apart else component.nearest_rotation(covariance)
    free = (component.y - pivot) @ turn.T + pivot + shift
    if component.gaps_after(free, component.planes[DISTINCT_PLANES:]).min() <= 0.0:
        return still
    first = component.planes[:DISTINCT_PLANES]
    touched = np.array([bool((free @ plane[NORMAL] <= plane[HEIGHT]).any()) for plane in first], dtype=bool)
    if not touched.any():
        return np.asarray(free - component.y)
    planes = first[touched]
    if len(planes) == 1 and not component.pinned.any():
        tipped = RollingContact(component, planes[0]).motion(free)
        if tipped is not None:
            return tipped
    share = component.fraction_to(planes, free)
    if share > LYING:
        component.meets_contact = True
        part = fraction_of(turn, share) @ (component.y - pivot).T
        return np.asarray(part.T + pivot + share * shift - component.y)
    if component.pinned.any():
        return still
    turn, shift = np.eye(3), component.translation_along(planes)
    if np.linalg.matrix_rank(planes[:, NORMAL], tol=1e-6) == 1 and not planes[:, FRICTION].any():
        turn = turn_about(planes[0, NORMAL], component.covariance)
    along = (component.y - component.centroid) @ (turn - np.eye(3)).T + shift
    beside = min(
        component.gaps(component.y + along, first[~touched], with_spheres=False).min(),
        component.gaps_after(component.y + along, component.planes[DISTINCT_PLANES:]).min(),
    )
    return np.asarray(along if beside > 0.0 else still)
