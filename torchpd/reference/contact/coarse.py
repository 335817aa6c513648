"""Coarse correction of bodies in contact: rigid motions that the listed pairs join, as far as other bodies let them.

The motions minimise the energy of `reference.coarse`. The envelopes of the pairs between bodies are their augmented
Lagrangian: 1 / k = sum w^2 / D, gap = d - r, anchored at the multipliers. An island, the bodies that pairs join, goes
by one common share of its motion, else it would lose momentum. A share turns each body about its axis by less, so that
no distance within a body changes: pairs of a body with itself bound nothing.

Pairs of different bodies bound the share. One direction each keeps their sides apart at both ends, and so on the
straight way. Pairs that are not listed are safe while vertices stay in their balls. A longer way finds the pairs of its
swept boxes itself, and a search must follow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..envelopes import Envelopes, PairContacts
from ..objective import Objective
from .approach import directions_of
from .distance import Closest
from .limit import halved, into_balls
from .lists import Contacts
from .planes import gap_along, gap_bounds
from .search import boxed_pairs
from .surfaces import Pairs, Surfaces

__all__ = ["RigidWay", "changed_forces", "pairs_between", "share_of"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

HALVINGS = 6  # of the interval of a share: another motion follows one that is cut
LEAST_TURN = 1e-12  # share of the moment by which turns count that places do not decide
BOW = 0.25  # of the chord of a turn up to a right angle: how far a share of it leaves the straight way


def pairs_between(
    problem: Objective, contacts: Contacts, near: Closest, places: Tensor, begin: Tensor
) -> tuple[Index, PairContacts]:
    """Numbers of the listed pairs of different components that can yield, and these for a correction.

    Args:
        problem: the step.
        contacts: the list, with its multipliers.
        near: closest points at the iterate.
        places: [N, 3] m of the iterate.
        begin: [N, 3] m at the step's start.
    """
    pairs, count = contacts.pairs, len(problem.positions)
    own = np.concatenate([problem.values.component, -1 - np.arange(len(places) - count)])
    free = np.concatenate([problem.free, np.zeros(len(places) - count, np.bool_)])
    vertices = pairs.vertices.numpy()
    weights = near.weights.double().numpy()
    yields = (np.abs(weights) * free[vertices]).sum(axis=1) > 1e-6
    inside = vertices < count
    ends = own[vertices[:, [0, 3]]]
    chosen = np.flatnonzero(yields & (ends[:, 0] != ends[:, 1]))
    vertices, weights, inside = vertices[chosen], weights[chosen], inside[chosen]
    normals = contacts.normals(near).double().numpy()[chosen]
    moves = (places - begin).double().numpy()[vertices]
    carried = (np.where(inside, 0.0, weights)[:, :, None] * moves).sum(axis=1)
    moved = (np.where(inside, weights, 0.0)[:, :, None] * moves).sum(axis=1)
    gap = (near.distance - pairs.thickness).double().numpy()[chosen]
    held = contacts.held
    tangent = held.tangential.double().numpy()[chosen]
    tangent = tangent - (tangent * normals).sum(axis=1, keepdims=True) * normals
    # vertices of colliders have no row in the problem: another vertex of the pair stands for them, with weight 0
    other = np.where(inside[:, 0], vertices[:, 0], vertices[:, 3])
    return chosen, PairContacts(
        vertices=np.where(inside, vertices, other[:, None]),
        weights=np.where(inside, weights, 0.0),
        normals=normals,
        offsets=gap - (normals * moved).sum(axis=1),
        friction=pairs.friction.double().numpy()[chosen],
        forces=held.normal.double().numpy()[chosen, None] * normals + tangent,
        carried=carried,
    )


def changed_forces(before: Envelopes, after: Array) -> Array:
    """Forces [m, 3] N of pairs, changed by motions from those of the envelopes `before` to `after` [m, 3] N.

    What gaps and slips of the iterate add is left to iterations: forces that grow with them while nothing yields would
    swing.
    """
    bound = before.friction * (after * before.normals).sum(axis=1)
    anchors = before.normal_anchors[:, None] * before.normals + before.tangent_anchors
    forces = anchors + (after - before.forces(bound))
    normal = np.maximum(0.0, (forces * before.normals).sum(axis=1))
    across = before.tangential(forces)
    size, bound = np.linalg.norm(across, axis=1), before.friction * normal
    share = np.where(size > bound, bound / np.where(size > bound, size, 1.0), 1.0)
    return np.asarray(normal[:, None] * before.normals + share[:, None] * across)


@dataclass(frozen=True)
class RigidWay:
    """The motion of a body about a centre: arms turn by 2 atan(|w| / 2) about w, the centre shifts."""

    vertices: Index  # [n]
    arms: Array  # [n, 3] m
    center: Array  # [3] m
    shift: Array  # [3] m
    turn: Array  # [3] w

    @staticmethod
    def between(vertices: Index, before: Array, after: Array, center: Array) -> RigidWay:
        """The motion from places `before` to `after` [n, 3] m, about a centre [3] m."""
        first, last = before.mean(axis=0), after.mean(axis=0)
        moment = (after - last).T @ (before - first)
        # a straight rod turns about its own axis as little as it may
        left, _, right = np.linalg.svd(moment + LEAST_TURN * np.linalg.norm(moment) * np.eye(3))
        turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
        skew = turn - turn.T
        axis = 2.0 / (1.0 + np.trace(turn)) * np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
        return RigidWay(vertices, before - center, center, last - turn @ (first - center) - center, axis)

    @property
    def is_valid(self) -> bool:
        """Whether it turns by a right angle at most: where a body turns further, other pairs would hold it."""
        return bool(np.linalg.norm(self.turn) <= 2.0)

    @property
    def chords(self) -> Array:
        """How far the turn moves the vertices [n] m."""
        return np.asarray(np.linalg.norm(self.at(1.0) - self.center - self.shift - self.arms, axis=1))

    def at(self, share: float) -> Array:
        """Places [n, 3] m after a share of the motion."""
        x, y, z = share * self.turn
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        turn = (cross + 0.5 * cross @ cross) / (1.0 + 0.25 * share**2 * float(self.turn @ self.turn))
        return np.asarray(self.center + share * self.shift + self.arms + self.arms @ turn.T)


def share_of(
    surfaces: Surfaces,
    component: Tensor,
    contacts: Contacts | None,
    places: Tensor,
    way: Callable[[float], Tensor],
    chords: Tensor,
    moving: Tensor,
) -> tuple[float, bool]:
    """Largest share of the motion of an island that other bodies and its own leave, and whether it leaves the list.

    Args:
        surfaces: all bodies.
        component: [N] of every vertex; pairs within one bound nothing.
        contacts: the list; None if it is out of date.
        places: [N, 3] m.
        way: [N, 3] m after a share.
        chords: [N] m, how far turns move the vertices.
        moving: [N] vertices of the island.
    """
    end = way(1.0)
    swept = contacts is None or bool(into_balls(contacts.balls, end)[1][moving].any())
    if contacts is not None and not swept:
        pairs = contacts.pairs
    else:
        low, high = torch.minimum(places, end), torch.maximum(places, end)
        pairs = boxed_pairs(surfaces, low, high, BOW * chords + 0.5 * surfaces.thickness)
    pairs = _across(pairs, component, moving)
    normals, least = directions_of(pairs, places, end)

    def allowed(share: Tensor) -> Tensor:
        corners = pairs.corners(way(float(share[0])))
        gap = gap_along(normals[:, None], corners, pairs.points)[:, 0]
        return ~((gap < least) | (gap <= gap_bounds(corners))).any()[None]

    share = float(halved(allowed, torch.zeros(1, dtype=torch.bool), places.dtype, HALVINGS)[0])
    return share, swept


def _across(pairs: Pairs, component: Tensor, moving: Tensor) -> Pairs:
    """The pairs of different components, one of them of the island."""
    of = component[pairs.vertices[:, [0, 3]]]
    return pairs.chosen((of[:, 0] != of[:, 1]) & moving[pairs.vertices].any(dim=1))
