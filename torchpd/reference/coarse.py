"""Coarse correction of an iterate: the motions of bodies with the least energy, contacts as envelopes.

Each body moves by a twist q about its centre, as far as its hard pins leave it free; an island is a body, or bodies
that pairs join. Elastic energy does not change, so q minimises

    Phi(q) = sum a / 2 |u(q) - s|^2 + sum of the envelopes (`reference.envelopes`) at u(q),

with a fixed friction radius r. Pieces of bodies move alike (`reference.piece_step`), with E in place of the first sum.
Newton's steps, each a finite motion, shortened where Phi rises or has turned upward. In between, r moves toward
friction l. The last step is small, and unchecked. The pushes p of the touching vertices follow, contact by contact. At
a converged step q = 0 and p = 0.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from .envelopes import Envelopes, PairContacts, contacts_at
from .geometry import twists

if TYPE_CHECKING:
    from .objective import Objective

__all__ = ["Correction", "Motions", "MotionsOf", "RigidMotions", "correct", "curvature", "finite", "islands"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

PASSES = 1024  # states at which Phi is looked at
ONE_POINT = 1e-6  # of the distance of pins from the origin, which float32 rounds: so near they lie at a point
ONE_LINE = 1e-4  # of what they are apart: how far pins on one line are from it
STILL = 1e-7  # of the size of a body: a step that ends the passes
LAG = 1e-6  # of the friction radii: how far behind friction l a correction may leave them
NOTHING = 1e-12  # of that size: a share of a step that moves a body by rounding
SETTLED = 0.1  # of the motion since radii moved: a step with which they move again; of them: a lag made up at once
FLAT = 0.5  # of the slope of Phi at the start of a step: an upward one at its end
ROUNDING = 1e-14  # of the energy that moves a body by its size, and of that of the contacts: a rise that counts as none


@dataclass(frozen=True)
class Motions(ABC):
    """N motions of the bodies of one island at an iterate, and the energy that they change.

    All sums run over the vertices of the island alone, so that their bits do not depend on other bodies.
    """

    problem: Objective
    displacement: Array  # [V, 3] m, of the whole scene
    bodies: tuple[Index, ...]  # vertices of every body

    @cached_property
    def free(self) -> list[Index]:
        """Vertices without hard pins of every body."""
        return [body[self.problem.free[body]] for body in self.bodies]

    @cached_property
    def vertices(self) -> Index:
        """[n] vertices without hard pins of the island."""
        return np.concatenate(self.free)

    @property
    @abstractmethod
    def modes(self) -> Array:
        """Z [n, 3, N]: displacements by the motions to first order."""

    @property
    @abstractmethod
    def gradient(self) -> Array:
        """Derivative [N] of the energy by the motions."""

    @property
    @abstractmethod
    def hessian(self) -> Array:
        """Second derivative [N, N] by the motions, positive definite."""

    @property
    @abstractmethod
    def scale(self) -> float:
        """The energy [J] that moves the island by its size."""

    @abstractmethod
    def share(self, motion: Array) -> float:
        """Motions [N] over the size of the island."""

    @abstractmethod
    def after(self, motion: Array) -> Self:
        """The same after motions [N]; hard pins stay."""

    def way(self, motion: Array) -> Array:
        """Motions [N] here by which a share of `motion`, which led here, changes."""
        return motion

    @property
    @abstractmethod
    def energy(self) -> float:
        """The energy [J] of the island."""

    def jacobian(self, contacts: Envelopes) -> Array:
        """Derivative [m, 3, N] of the relative displacements of contacts by the motions."""
        place = np.full(len(self.displacement), -1)  # the row of zeros, for hard pins
        place[self.vertices] = np.arange(len(self.vertices))
        modes = np.concatenate([self.modes, np.zeros((1, *self.modes.shape[1:]))])
        return np.asarray(np.einsum("mw,mwin->min", contacts.weights, modes[place[contacts.vertices]]))


@dataclass(frozen=True)
class RigidMotions(Motions):
    """Twists (v, w) of the bodies, and sum a / 2 |u - s|^2: y = c + R (y - c) + v, R about w by 2 atan(|w| / 2)."""

    @cached_property
    def bases(self) -> list[tuple[Array, Array]]:
        """Centre [3] and twists [6, d] that its pins leave free, of every body."""
        return [self._basis(body) for body in self.bodies]

    def _basis(self, body: Index) -> tuple[Array, Array]:
        y, free = self.problem.positions[body] + self.displacement[body], self.problem.free[body]
        if free.all():
            weight = self.problem.weight[body, None]
            return (weight * y).sum(axis=0) / weight.sum(), np.eye(6)
        # about the mean of the pins: what they leave free are turns alone
        centre = y[~free].mean(axis=0)
        arms = y[~free] - centre
        apart, axes = np.linalg.eigh(arms.T @ arms / len(arms))
        turns = axes
        if apart[2] > ONE_POINT**2 * float(centre @ centre):
            turns = axes[:, 2:] if apart[1] <= ONE_LINE**2 * apart[2] else axes[:, :0]
        return centre, np.concatenate([np.zeros_like(turns), turns])

    @cached_property
    def parts(self) -> list[tuple[Index, Array, Array, slice, slice]]:
        """Of every body: free vertices, their arms, the basis, and the places of both in the arrays of the island."""
        out, row, column = [], 0, 0
        for own, (centre, basis) in zip(self.free, self.bases, strict=True):
            arms = self.problem.positions[own] + self.displacement[own] - centre
            rows, columns = slice(row, row + len(own)), slice(column, column + basis.shape[1])
            out.append((own, arms, basis, rows, columns))
            row, column = rows.stop, columns.stop
        return out

    @cached_property
    def modes(self) -> Array:
        """Z [n, 3, N]: displacements by the twists to first order."""
        modes = np.zeros((len(self.vertices), 3, sum(basis.shape[1] for _, basis in self.bases)))
        for _, arms, basis, rows, columns in self.parts:
            modes[rows, :, columns] = twists(arms) @ basis
        return modes

    @cached_property
    def pull(self) -> Array:
        """a (s - u) [n, 3] N."""
        own = self.vertices
        return np.asarray(self.problem.weight[own, None] * (self.problem.target[own] - self.displacement[own]))

    @cached_property
    def gradient(self) -> Array:
        """Derivative [N] of sum a / 2 |u - s|^2 by the twists."""
        return np.asarray(-np.einsum("vin,vi->n", self.modes, self.pull))

    @cached_property
    def hessian(self) -> Array:
        """Second derivative [N, N] by the twists: exact where it is positive definite, else without curvature."""
        flat = self.modes.reshape(-1, self.modes.shape[2])
        hessian = flat.T @ (np.repeat(self.problem.weight[self.vertices], 3)[:, None] * flat)
        for _, arms, basis, rows, columns in self.parts:
            exact = hessian[columns, columns] + basis.T @ curvature(self.pull[rows], arms) @ basis
            if basis.shape[1] and np.linalg.eigvalsh(exact)[0] > 0.0:
                hessian[columns, columns] = exact
        return np.asarray(hessian)

    @property
    def scale(self) -> float:
        """Sum of a |arm|^2 [J]."""
        weight = self.problem.weight
        return sum(float(weight[own] @ (arms**2).sum(axis=1)) for own, arms, *_ in self.parts)

    def share(self, motion: Array) -> float:
        """Largest of |v| / l + |w| over the bodies, l^2 the mean of |arm|^2 by a."""
        shares = [0.0]
        for own, arms, basis, _, columns in self.parts:
            if not basis.shape[1]:
                continue
            weight, twist = self.problem.weight[own], basis @ motion[columns]
            size = float(np.sqrt(weight @ (arms**2).sum(axis=1) / weight.sum()))
            shares.append(float(np.linalg.norm(twist[:3])) / size + float(np.linalg.norm(twist[3:])))
        return max(shares)

    def after(self, motion: Array) -> RigidMotions:
        """The same after finite motions along the twists [N]; hard pins stay."""
        displacement = self.displacement.copy()
        for own, arms, basis, _, columns in self.parts:
            displacement[own] += finite(basis @ motion[columns], arms)
        return replace(self, displacement=displacement)

    def way(self, motion: Array) -> Array:
        way = motion.copy()
        for _, _, basis, _, columns in self.parts:
            turn = (basis @ motion[columns])[3:]
            # about the axis of the turn; a body with pins only turns
            way[columns][-3:] *= 1.0 / (1.0 + 0.25 * float(turn @ turn))
        return way

    @property
    def energy(self) -> float:
        """sum a / 2 |u - s|^2 [J] of the free vertices of the island."""
        left = (self.displacement - self.problem.target)[self.vertices]
        return 0.5 * float(self.problem.weight[self.vertices] @ (left**2).sum(axis=1))


# makes the motions of an island from the problem, the displacement and the vertices of its bodies
MotionsOf = Callable[["Objective", Array, tuple[Index, ...]], Motions]


class Correction(NamedTuple):
    """What a coarse correction leaves."""

    displacement: Array  # [V, 3] m
    forces: Array  # [m, 3] N of the pairs
    energies: Array  # [components] J: Phi of its island, before the pushes; inf where pins leave no motion
    pushes: Array  # [V, 3] m: after the motion, by the contacts and the projection


def correct(
    problem: Objective,
    displacement: Array,
    forces: Array,
    pairs: PairContacts | None = None,
    *,
    motions: MotionsOf = RigidMotions,
    push_pairs: bool = True,
    passes: int = PASSES,
) -> Correction:
    """The coarse correction of every island.

    Args:
        problem: the step.
        displacement: [V, 3] m; hard pins at their targets.
        forces: [C, V, 3] N of every plane and sphere at the iterate, see `pushes_of`.
        pairs: contacts between bodies, with their forces at the iterate.
        motions: makes the motions of an island.
        push_pairs: whether pairs push their vertices after the motion; an iteration with multipliers does it, too.
        passes: most states of an island with pairs at which Phi is looked at.
    """
    corrected, after = displacement.copy(), np.zeros((0, 3)) if pairs is None else pairs.forces.copy()
    energies, pushes = np.full(int(problem.values.component.max()) + 1, np.inf), np.zeros_like(displacement)
    for bodies, of in islands(problem, pairs, motions):
        own, moving = None if pairs is None or not len(of) else pairs.chosen(of), motions(problem, corrected, bodies)
        if not moving.modes.shape[2]:
            continue
        most = PASSES if own is None else passes
        corrected, push, each, energy = _correct_island(moving, forces, own, push_pairs, most)
        pushes = pushes + push
        after[of] = each[len(each) - len(of) :]
        energies[problem.values.component[[body[0] for body in bodies]]] = energy
    return Correction(corrected, after, energies, pushes)


def islands(
    problem: Objective, pairs: PairContacts | None = None, motions: MotionsOf = RigidMotions
) -> Iterator[tuple[tuple[Index, ...], Index]]:
    """The bodies of every island, as their vertices, and the numbers of its pairs.

    Bodies that pins leave no motion are islands of their own, without pairs.
    """
    component, still = problem.values.component, np.zeros_like(problem.positions)
    ends = np.zeros((0, 2), np.int64) if pairs is None else component[pairs.vertices[:, [0, 3]]]
    of = [np.flatnonzero(component == body) for body in range(int(component.max()) + 1)]
    # those of pairs alone: which other bodies move does not matter
    moves = np.array(
        [not (ends == n).any() or motions(problem, still, (body,)).modes.shape[2] > 0 for n, body in enumerate(of)]
    )
    both = ends[moves[ends].all(axis=1)]
    links = coo_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(len(of), len(of)))
    number = connected_components(links, directed=False)[1]
    owner = np.where(moves[ends[:, 0]], number[ends[:, 0]], number[ends[:, 1]])
    owner[~moves[ends].any(axis=1)] = -1
    for island in range(int(number.max()) + 1):
        members = np.flatnonzero(number == island)
        yield tuple(of[body] for body in members), np.flatnonzero(owner == island)


def _correct_island(
    motions: Motions, forces: Array, pairs: PairContacts | None, push_pairs: bool, passes: int
) -> tuple[Array, Array, Array, float]:
    """Displacement and pushes [V, 3] m, forces [m, 3] N of all contacts and Phi [J] after the correction."""
    problem, vertices = motions.problem, np.concatenate(motions.bodies)

    def contacts_of(motions: Motions) -> Envelopes:
        return contacts_at(problem, motions.displacement, forces, vertices, pairs)

    contacts = contacts_of(motions)
    radius = contacts.friction * contacts.normal_anchors
    phi, moved, left = motions.energy + contacts.energy(radius), 0.0, passes - 1
    while True:
        hessian, force = _newton_terms(motions, contacts, radius)
        # a line has no inertia about itself
        step: Array = np.asarray(np.linalg.lstsq(hessian, force, rcond=1e-12)[0], np.float64)
        length = motions.share(step)
        lag = contacts.friction * contacts.normal_forces() - radius
        lagging, size = float(np.linalg.norm(lag)), float(np.linalg.norm(radius))
        if lagging > LAG * size and length <= max(STILL, SETTLED * moved):
            if not left:
                break
            left -= 1
            radius, moved = radius + (1.0 if lagging <= SETTLED * size else 0.5) * lag, 0.0
            continue
        if lagging <= LAG * size and length <= STILL:
            motions = motions.after(step)
            contacts = contacts_of(motions)
            break
        share, energy = 1.0, motions.energy + contacts.energy(radius)
        rounding = ROUNDING * (motions.scale + contacts.energy(radius))
        while left and share * length > NOTHING:  # else every later step ends here, too
            left -= 1
            trial = motions.after(share * step)
            there = contacts_of(trial)
            moved_by = (trial.displacement - motions.displacement)[contacts.vertices]
            moves = (contacts.weights[:, :, None] * moved_by).sum(axis=1)
            # by the normals of before, so that both energies are of one function
            reached = trial.energy + replace(contacts.shifted(moves), gaps=there.gaps).energy(radius)
            second, down = _newton_terms(trial, there, radius)
            way = trial.way(share * step) / share
            slope = -float(down @ way)
            if reached <= energy + rounding and slope <= FLAT * float(force @ step):
                break
            # Newton's step from there, or half of it
            nearer = share - slope / float(way @ second @ way)
            share = nearer if 0.0 < nearer < share else 0.5 * share
        else:
            break
        motions, contacts, phi, moved = trial, there, reached, moved + share * length
    return *_pushed(motions, contacts, radius, push_pairs), contacts.forces(radius), phi


def _newton_terms(motions: Motions, contacts: Envelopes, radius: Array) -> tuple[Array, Array]:
    """The second derivative [N, N] of Phi by the motions, and minus the first [N]."""
    jacobian, second = motions.jacobian(contacts), contacts.majoriser(radius)
    on, columns = second.any(axis=(1, 2)), jacobian.shape[2]
    flat = jacobian[on].reshape(-1, columns)
    matrix = motions.hessian + flat.T @ (second[on] @ jacobian[on]).reshape(-1, columns)
    return matrix, contacts.forces(radius).reshape(-1) @ jacobian.reshape(-1, columns) - motions.gradient


def _pushed(motions: Motions, contacts: Envelopes, radius: Array, push_pairs: bool) -> tuple[Array, Array]:
    """Displacement [V, 3] m after the pushes w (f - f0) / D of all contacts and the projection, and these changes.

    A vertex that touches several planes and spheres is pushed by one after another.
    """
    problem, own = motions.problem, np.concatenate(motions.bodies)
    several = len(problem.values.planes) + len(problem.values.spheres)
    rows = np.array_split(np.arange(several * len(motions.vertices)), max(several, 1))
    pushed = motions.displacement.copy()
    last = [np.arange(several * len(motions.vertices), len(contacts.gaps))] if push_pairs else []
    for of in [*rows, *last]:
        each = contacts.chosen(of)
        way = (each.weights[:, :, None] * (pushed - motions.displacement)[each.vertices]).sum(axis=1)
        before = each.normal_anchors[:, None] * each.normals + each.tangent_anchors
        push = each.weights[:, :, None] * (each.shifted(way).forces(radius[of]) - before)[:, None, :]
        forces = np.zeros_like(pushed)
        np.add.at(forces, each.vertices.reshape(-1), push.reshape(-1, 3))
        pushed = pushed + np.where(problem.free[:, None], forces / problem.diagonal[:, None], 0.0)
    moved = motions.displacement.copy()
    moved[own] = problem.project(pushed)[own]
    return moved, moved - motions.displacement


def _cross(vectors: Array) -> Array:
    """[v]x [..., 3, 3] with [v]x b = v x b."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    nothing = np.zeros_like(x)
    rows = [[nothing, -z, y], [z, nothing, -x], [-y, x, nothing]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def curvature(left: Array, arms: Array) -> Array:
    """Second derivative [6, 6] of -sum left . (finite motion - its first order) by the twist; left = a (s - u)."""
    moment = left.T @ arms
    curvature = np.zeros((6, 6))
    curvature[3:, 3:] = np.trace(moment) * np.eye(3) - 0.5 * (moment + moment.T)
    return curvature


def finite(twist: Array, arms: Array) -> Array:
    """Displacement of arms [n, 3] by a twist (v, w): (R - 1) r + v, R the turn about w by 2 atan(|w| / 2) (Cayley)."""
    half = _cross(0.5 * twist[3:])
    turn = 2.0 / (1.0 + 0.25 * float(twist[3:] @ twist[3:])) * (half + half @ half)
    return np.asarray(arms @ turn.T + twist[:3])
