"""Rigid motions of the oracle: components go as far as pins and contacts leave them to where their energy is least.

Along them E is sum a / 2 |x + u - (x + s)|^2, a weighted fit of two sets of points (Kabsch 1976). Hard pins at a point
or along a line leave turns about that; smooth planes the turn about their normal and the way along all of them; a plane
with friction, or the edge of two planes, the way along it, shortened as by Coulomb. On one plane a component may tip
besides (`reference_tipping`); one that hovers goes as far as the first plane. Other contacts leave it nothing. Where a
motion ends since the component comes to a contact, it goes on from there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from .reference_tipping import LYING, Tipping, part_of, turn_about

if TYPE_CHECKING:
    from .reference import StepProblem

__all__ = ["align", "begin", "gaps_of"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

TOLD = 8  # planes that are told apart
LEGS = 4  # parts of a motion that contacts end one after the other
SQUEEZE = 0.5  # of the most that pushes of contacts may squeeze a component by
LIFT = 6.0  # of what it costs to shift it as a whole by that push
WORTH = 0.01  # of what is left: less squeeze is no reason to give up the course


class NearestRotation(Protocol):
    def __call__(self, matrices: Array) -> Array: ...


def gaps_of(positions: Array, planes: Array, centers: Array, spheres: Array) -> Array:
    """Distance of every position to the nearest of planes and spheres [n]; inf without any."""
    gaps = np.full(len(positions), np.inf)
    for plane in planes:
        gaps = np.minimum(gaps, positions @ plane[:3] - plane[3])
    for center, sphere in zip(centers, spheres, strict=True):
        gaps = np.minimum(gaps, np.linalg.norm(positions - center, axis=1) - sphere[3])
    return gaps


def begin(problem: StepProblem, guess: Array, diagonal: Array) -> Array:
    """The first iterate [V, 3], before rigid motions: `guess` out of the contacts, or components where they are.

    Contacts push vertices out each for itself, by p, which squeezes a component by sum k / 2 |p - mean p|^2 at most,
    k = D - a. One that starts from where it is has less energy left, half of that counted, there or after rigid
    motions: a shift by how far contacts push, d, costs sum a / 2 d^2. It has no hard pins, and forces would take it
    into no other contacts than the first planes.
    """
    planes, out = problem.values.planes, problem.project(guess, guess)
    kept = problem._hold(np.zeros_like(guess))
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


def align(
    problem: StepProblem, displacement: Array, nearest_rotation: NearestRotation, *, first: bool = False
) -> Array:
    """Displacements [V, 3] after the rigid motion of every component; `first`: before any iteration."""
    values, moved = problem.values, displacement.copy()
    for number in range(int(values.component.max()) + 1):
        of = values.component == number
        for _ in range(LEGS):
            piece = Piece(problem, moved, of, nearest_rotation, first)
            way = np.zeros_like(moved)
            way[of] = piece.motion()
            moved = np.where(problem.free[:, None], moved + way, moved)
            if not piece.comes:
                break
    return moved


class Piece:
    """One component, its n vertices at y = x + u, their targets z = x + s."""

    def __init__(
        self, problem: StepProblem, displacement: Array, of: Mask, nearest_rotation: NearestRotation, first: bool
    ) -> None:
        self.problem, self.nearest_rotation, self.first = problem, nearest_rotation, first
        self.planes = problem.values.planes
        self.u, self.weight = displacement[of], problem.weight[of, None]
        self.y, self.z = problem.positions[of] + self.u, problem.positions[of] + problem.target[of]
        share = self.weight / self.weight.sum()
        self.middle, self.lag = (share * self.y).sum(axis=0), (share * (self.z - self.y)).sum(axis=0)
        self.square = float((share * (self.y - self.middle) ** 2).sum())  # of its radius of gyration
        self.covariance = self.about(self.middle + self.lag, self.middle)
        self.pinned = ~problem.free[of]
        self.rest = problem.values.rest_positions[of]
        self.comes = False  # its motion ends where it comes to a contact

    def about(self, goal: Array, pivot: Array) -> Array:
        """Sum of a (z - goal) (y - pivot)^T."""
        return np.asarray((self.weight * (self.z - goal)).T @ (self.y - pivot))

    def gaps(self, positions: Array, planes: Array, *, balls: bool = True) -> Array:
        spheres = self.problem.values.spheres if balls else np.zeros((0, 5))
        return gaps_of(positions, planes, self.problem.sphere_centers[: len(spheres)], spheres)

    def left(self, moved: Array, planes: Array) -> Array:
        """Gaps after a motion. After the iterations 0 or less too where a ball could keep a vertex from that motion.

        That is with a force within the cone of its friction, if the vertex lies on it: balls curve away from what goes
        along them. One ball alone holds nothing by friction that it does not push.
        """
        after, way, spheres = self.gaps(moved, planes), moved - self.y, self.problem.values.spheres
        if self.first:
            return after
        size, several = np.linalg.norm(way, axis=1), len(self.planes) + len(spheres) > 1
        for center, sphere in zip(self.problem.sphere_centers, spheres, strict=True):
            arm = self.y - center
            length = np.linalg.norm(arm, axis=1, keepdims=True)
            normals = np.where(length > 0.0, arm / np.maximum(length, 1e-300), [0.0, 1.0, 0.0])
            across = (normals * way).sum(axis=1)
            along = np.linalg.norm(way - across[:, None] * normals, axis=1)
            rounding = 4 * np.finfo(np.float64).eps * (np.linalg.norm(self.y, axis=1) + sphere[3])
            lies = length[:, 0] - sphere[3] <= LYING * size + rounding
            after = np.where(lies, np.minimum(after, across - several * sphere[4] * along), after)
        return after

    def gain(self, way: Array) -> float:
        """What a motion by that [n, 3] adds to the energy."""
        return float((0.5 * self.weight * ((self.y + way - self.z) ** 2 - (self.y - self.z) ** 2)).sum())

    def motion(self) -> Array:
        """What every vertex is to be moved by [n, 3]."""
        turn, pivot, shift = self.nearest_rotation(self.covariance), self.middle, self.lag
        still = np.zeros_like(self.u)
        if self.pinned.any():
            at_rest, at = self.rest[self.pinned], self.y[self.pinned]
            if np.linalg.matrix_rank(at_rest - at_rest.mean(axis=0), tol=1e-6) > 1:
                return still
            pivot, shift = at.mean(axis=0), np.zeros(3)
            _, sizes, directions = np.linalg.svd(at - pivot, full_matrices=True)
            apart = 1e-4 * np.sqrt(self.square * self.pinned.sum())
            if (sizes[1:] > apart).any():
                return still
            covariance = self.about(pivot, pivot)
            turn = turn_about(directions[0], covariance) if sizes[0] > apart else self.nearest_rotation(covariance)
        free = (self.y - pivot) @ turn.T + pivot + shift
        if self.left(free, self.planes[TOLD:]).min() <= 0.0:
            return still
        touched = np.array([bool((free @ plane[:3] <= plane[3]).any()) for plane in self.planes[:TOLD]], dtype=bool)
        if not touched.any():
            return np.asarray(free - self.y)
        planes = self.planes[:TOLD][touched]
        if len(planes) == 1 and not self.pinned.any():
            tipped = Tipping(self, planes[0]).motion(free)
            if tipped is not None:
                return tipped
        share = self.share_to(planes, free)
        if share > LYING:
            self.comes = True
            part = part_of(turn, share) @ (self.y - pivot).T
            return np.asarray(part.T + pivot + share * shift - self.y)
        if self.pinned.any():
            return still
        turn, shift = np.eye(3), self.way_on(planes)
        if np.linalg.matrix_rank(planes[:, :3], tol=1e-6) == 1 and not planes[:, 4].any():
            turn = turn_about(planes[0, :3], self.covariance)
        along = (self.y - self.middle) @ (turn - np.eye(3)).T + shift
        beside = min(
            self.gaps(self.y + along, self.planes[:TOLD][~touched], balls=False).min(),
            self.left(self.y + along, self.planes[TOLD:]).min(),
        )
        return np.asarray(along if beside > 0.0 else still)

    def share_to(self, planes: Array, free: Array) -> float:
        """Of its free motion, that brings it to planes."""
        least = 1.0
        for plane in planes:
            before, after = (y @ plane[:3] - plane[3] for y in (self.y, free))
            comes, touches = (before > 0.0) & (after <= 0.0), after <= 0.0
            shares = np.where(comes, before / np.where(comes, np.maximum(before - after, 1e-300), 1.0), 0.0)
            least = min(least, float(shares[touches].min(initial=1.0)))
        return least

    def slips(self, normal: Array) -> Array:
        return np.asarray(self.u - np.outer(self.u @ normal, normal))

    def way_on(self, planes: Array) -> Array:
        """How far it goes along all planes that it touches [3]."""
        normals, friction = planes[:, :3], planes[:, 4]
        _, sizes, directions = np.linalg.svd(normals)
        span = directions[: int((sizes > 1e-6).sum())]
        along = self.lag - span.T @ (span @ self.lag)
        if not friction.any():
            return along if len(span) < 3 else np.zeros(3)
        if len(span) != len(planes) or len(span) > 2:
            return np.zeros(3)
        if len(planes) == 1 and float(self.lag @ normals[0]) >= 0.0:
            return np.asarray(along)
        # how far the planes push it together, and the slips on those that are rough
        pushes = np.linalg.solve(normals @ normals.T, -normals @ self.lag)
        if len(planes) > 1 and not (pushes > 0.0).all():
            return np.zeros(3)
        rough = [plane for plane in planes if plane[4] > 0.0]
        lies = [self.y @ plane[:3] - plane[3] < -LYING * float(self.lag @ plane[:3]) for plane in rough]
        slips = np.concatenate([self.slips(plane[:3])[own] for plane, own in zip(rough, lies, strict=True)])
        if not len(slips):
            return np.zeros(3)
        mean = slips.mean(axis=0)
        if len(span) == 2:
            mean = mean - span.T @ (span @ mean)
        # slips that differ leave a doubt about where friction acts: what is within it is left to the iterations
        apart = 2.0 * float(np.linalg.norm(slips.max(axis=0) - slips.min(axis=0)))
        free, rub, slip = mean + along, float(friction @ pushes), float(np.linalg.norm(mean))
        left = float(np.linalg.norm(free)) - rub
        if left <= 0.0:
            return np.asarray(-mean if slip > max(apart, apart * rub / max(slip, 1e-300)) else np.zeros(3))
        way = left * free / np.linalg.norm(free) - mean
        doubt = rub * min(2.0, apart / left)
        return np.asarray(max(0.0, 1.0 - doubt / max(float(np.linalg.norm(way)), 1e-300)) * way)
