"""Rigid motions of the oracle: components go as far as pins and contacts leave them to where their energy is least.

Along them E is sum a / 2 |x + u - (x + s)|^2, a weighted fit of two sets of points (Kabsch 1976). Hard pins at a point
or along a line leave turns about that; smooth planes the turn about their normal and the way along all of them; a plane
with friction, or the edge of two planes, the way along it, shortened as by Coulomb. On one plane a component may tip
besides (`reference_tipping`); one that hovers goes as far as the first plane. Other contacts leave it nothing. Where a
motion ends since the component comes to a contact, it goes on from there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .rigid_piece import FRICTION, HEIGHT, LYING, NORMAL, NearestRotation, Piece, Problem, gaps_of, part_of, turn_about
from .tipping import Tipping

__all__ = ["align", "begin"]

Array = NDArray[np.float64]

TOLD = 8  # planes that are told apart
LEGS = 4  # parts of a motion that contacts end one after the other
SQUEEZE = 0.5  # of the most that pushes of contacts may squeeze a component by
LIFT = 6.0  # of what it costs to shift it as a whole by that push
WORTH = 0.01  # of what is left: less squeeze is no reason to give up the course


def begin(problem: Problem, guess: Array, diagonal: Array) -> Array:
    """The first iterate [V, 3], before rigid motions: `guess` out of the contacts, or components where they are.

    Contacts push vertices out each for itself, by p, which squeezes a component by sum k / 2 |p - mean p|^2 at most,
    k = D - a. One that starts from where it is has less energy left, half of that counted, there or after rigid
    motions: a shift by how far contacts push, d, costs sum a / 2 d^2. It has no hard pins, and forces would take it
    into no other contacts than the first planes.
    """
    planes, out = problem.values.planes, problem.project(guess, guess)
    kept = problem.hold(np.zeros_like(guess))
    still, begun, there = problem.project(kept, kept), out.copy(), problem.positions + problem.target
    others = gaps_of(there, planes[TOLD:], problem.sphere_centers, problem.values.spheres) <= 0.0
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
    """Displacements [V, 3] after the rigid motion of every component; `first`: before any iteration."""
    values, moved = problem.values, displacement.copy()
    for number in range(int(values.component.max()) + 1):
        of = values.component == number
        for _ in range(LEGS):
            piece = Piece(problem, moved, of, nearest_rotation, first)
            way = np.zeros_like(moved)
            way[of] = motion_of(piece)
            moved = np.where(problem.free[:, None], moved + way, moved)
            if not piece.comes:
                break
    return moved


def motion_of(piece: Piece) -> Array:
    """What every vertex is to be moved by [n, 3]."""
    turn, pivot, shift = piece.nearest_rotation(piece.covariance), piece.middle, piece.lag
    still = np.zeros_like(piece.u)
    if piece.pinned.any():
        at_rest, at = piece.rest[piece.pinned], piece.y[piece.pinned]
        if np.linalg.matrix_rank(at_rest - at_rest.mean(axis=0), tol=1e-6) > 1:
            return still
        pivot, shift = at.mean(axis=0), np.zeros(3)
        _, sizes, directions = np.linalg.svd(at - pivot, full_matrices=True)
        apart = 1e-4 * np.sqrt(piece.square * piece.pinned.sum())
        if (sizes[1:] > apart).any():
            return still
        covariance = piece.about(pivot, pivot)
        turn = turn_about(directions[0], covariance) if sizes[0] > apart else piece.nearest_rotation(covariance)
    free = (piece.y - pivot) @ turn.T + pivot + shift
    if piece.left(free, piece.planes[TOLD:]).min() <= 0.0:
        return still
    first = piece.planes[:TOLD]
    touched = np.array([bool((free @ plane[NORMAL] <= plane[HEIGHT]).any()) for plane in first], dtype=bool)
    if not touched.any():
        return np.asarray(free - piece.y)
    planes = first[touched]
    if len(planes) == 1 and not piece.pinned.any():
        tipped = Tipping(piece, planes[0]).motion(free)
        if tipped is not None:
            return tipped
    share = piece.share_to(planes, free)
    if share > LYING:
        piece.comes = True
        part = part_of(turn, share) @ (piece.y - pivot).T
        return np.asarray(part.T + pivot + share * shift - piece.y)
    if piece.pinned.any():
        return still
    turn, shift = np.eye(3), piece.way_on(planes)
    if np.linalg.matrix_rank(planes[:, NORMAL], tol=1e-6) == 1 and not planes[:, FRICTION].any():
        turn = turn_about(planes[0, NORMAL], piece.covariance)
    along = (piece.y - piece.middle) @ (turn - np.eye(3)).T + shift
    beside = min(
        piece.gaps(piece.y + along, first[~touched], balls=False).min(),
        piece.left(piece.y + along, piece.planes[TOLD:]).min(),
    )
    return np.asarray(along if beside > 0.0 else still)
