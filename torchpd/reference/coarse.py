"""Coarse correction of an iterate: the motions of bodies with the least energy, contacts as envelopes.

Each body moves by a twist q about its centre, as far as its hard pins leave it free; an island is a body, or bodies
that pairs join. Elastic energy does not change, so q minimises

    Phi(q) = sum a / 2 |u(q) - s|^2 + sum of the envelopes (`reference.envelopes`) at u(q),

with a fixed friction radius r. Pieces of bodies move alike (`reference.piece_step`), with E in place of the first sum.
An outer step minimises the quadratic model of Phi by Newton passes, and moves r toward friction l in between. It halves
the motion until Phi has not risen. The pushes p of the touching vertices follow. At a converged step q = 0 and p = 0.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from .envelopes import Envelopes, PairContacts, contacts_at
from .geometry import twists

if TYPE_CHECKING:
    from .problem import StepProblem

__all__ = ["Motions", "MotionsOf", "RigidMotions", "correct", "islands"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

PASSES = 12  # Newton passes of an outer step
SETTLE = 4  # minimisations of an outer step, between which friction radii go half of the way to friction l
HALVINGS = 8
HELD = 1e-8  # eigenvalue of the pins' mean square displacement, in lengths of the body, below which a twist is free
EXACT = 1e-12  # rounding: relative change of an energy, and motion over the size of a body, that count as none


@dataclass(frozen=True)
class Motions(ABC):
    """N motions of the bodies of one island at an iterate, and the energy that they change.

    All sums run over the vertices of the island alone, so that their bits do not depend on other bodies.
    """

    problem: StepProblem
    displacement: Array  # [V, 3] m, of the whole scene
    bodies: tuple[Index, ...]  # vertices of every body

    outer: ClassVar[int]  # outer steps, which take turns, gaps and friction radii anew

    @cached_property
    def free(self) -> list[Index]:
        """Vertices without hard pins of every body."""
        return [body[self.problem.free[body]] for body in self.bodies]

    @cached_property
    def vertices(self) -> Index:
        """[n] vertices without hard pins of the island."""
        return np.concatenate(self.free)

    @cached_property
    def size(self) -> float:
        """Extent of the largest body [m]."""
        return max(float(np.ptp(self.problem.positions[body], axis=0).max()) for body in self.bodies)

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

    @abstractmethod
    def moved(self, motion: Array) -> Array:
        """Displacement [V, 3] m after motions [N]; hard pins stay."""

    @abstractmethod
    def energy(self, displacement: Array) -> float:
        """The energy [J] of the island."""

    def jacobian(self, contacts: Envelopes) -> Array:
        """Derivative [m, 3, N] of the relative displacements of contacts by the motions."""
        place = np.full(len(self.displacement), -1)  # the row of zeros, for hard pins
        place[self.vertices] = np.arange(len(self.vertices))
        modes = np.concatenate([self.modes, np.zeros((1, *self.modes.shape[1:]))])
        return np.asarray(np.einsum("mw,mwin->min", contacts.weights, modes[place[contacts.vertices]]))


@dataclass(frozen=True)
class RigidMotions(Motions):
    """Twists (v, w) of the bodies: y = c + exp([w]x) (y - c) + v with the centre c, and sum a / 2 |u - s|^2."""

    outer = 3

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
        lengths = np.repeat([1.0, float(np.linalg.norm(y - centre, axis=1).max())], 3)
        pinned = twists(y[~free] - centre).reshape(-1, 6) / lengths
        values, vectors = np.linalg.eigh(pinned.T @ pinned / int((~free).sum()))
        return centre, vectors[:, values < HELD] / lengths[:, None]

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
        hessian = np.einsum("vin,v,vik->nk", self.modes, self.problem.weight[self.vertices], self.modes, optimize=True)
        for _, arms, basis, rows, columns in self.parts:
            exact = hessian[columns, columns] + basis.T @ _curvature(self.pull[rows], arms) @ basis
            if basis.shape[1] and np.linalg.eigvalsh(exact)[0] > 0.0:
                hessian[columns, columns] = exact
        return np.asarray(hessian)

    def moved(self, motion: Array) -> Array:
        """Displacement [V, 3] m after finite motions along the twists [N]; hard pins stay."""
        displacement = self.displacement.copy()
        for own, arms, basis, _, columns in self.parts:
            displacement[own] += _finite(basis @ motion[columns], arms)
        return displacement

    def energy(self, displacement: Array) -> float:
        """sum a / 2 |u - s|^2 [J] of the free vertices of the island."""
        left = (displacement - self.problem.target)[self.vertices]
        return 0.5 * float(self.problem.weight[self.vertices] @ (left**2).sum(axis=1))


# makes the motions of an island from the problem, the displacement and the vertices of its bodies
MotionsOf = Callable[["StepProblem", Array, tuple[Index, ...]], Motions]


def correct(
    problem: StepProblem,
    displacement: Array,
    forces: Array,
    pairs: PairContacts | None = None,
    *,
    motions: MotionsOf = RigidMotions,
) -> tuple[Array, Array]:
    """The coarse correction of every island: displacement [V, 3] m, and forces [m, 3] N of the pairs after it.

    Args:
        problem: the step.
        displacement: [V, 3] m; hard pins at their targets.
        forces: [C, V, 3] N of every plane and sphere at the iterate, see `pushes_of`.
        pairs: contacts between bodies, with their forces at the iterate.
        motions: makes the motions of an island.
    """
    corrected, after = displacement.copy(), np.zeros((0, 3)) if pairs is None else pairs.forces.copy()
    for bodies, of in islands(problem, pairs):
        own = None if pairs is None or not len(of) else pairs.chosen(of)
        corrected, each = _correct_island(motions(problem, corrected, bodies), forces, own)
        after[of] = each[len(each) - len(of) :]
    return corrected, after


def islands(problem: StepProblem, pairs: PairContacts | None = None) -> Iterator[tuple[tuple[Index, ...], Index]]:
    """The bodies of every island, as their vertices, and the numbers of its pairs."""
    component = problem.values.component
    ends = np.zeros((0, 2), np.int64) if pairs is None else component[pairs.vertices[:, [0, 3]]]
    count = int(component.max()) + 1
    links = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    number = connected_components(links, directed=False)[1]
    for island in range(int(number.max()) + 1):
        members = np.flatnonzero(number == island)
        bodies = tuple(np.flatnonzero(component == body) for body in members)
        yield bodies, np.flatnonzero(number[ends[:, 0]] == island)


def _correct_island(motions: Motions, forces: Array, pairs: PairContacts | None) -> tuple[Array, Array]:
    """Displacement [V, 3] m and forces [m, 3] N of all contacts after the correction."""
    problem, vertices = motions.problem, np.concatenate(motions.bodies)
    contacts = contacts_at(problem, motions.displacement, forces, vertices, pairs)
    radius = contacts.friction * contacts.normal_anchors
    for _ in range(motions.outer):
        if not motions.modes.shape[2]:
            break
        jacobian = motions.jacobian(contacts)
        motion, radius = _settled(motions, contacts, jacobian, radius)
        energy = motions.energy(motions.displacement) + contacts.energy(radius)
        for _ in range(HALVINGS):
            moved = motions.moved(motion)
            after = contacts_at(problem, moved, forces, vertices, pairs)
            way = (contacts.weights[:, :, None] * (moved - motions.displacement)[contacts.vertices]).sum(axis=1)
            trial = replace(contacts.shifted(way), gaps=after.gaps)
            if motions.energy(moved) + trial.energy(radius) <= energy * (1.0 + EXACT):
                break
            motion = 0.5 * motion
        else:
            break
        still, motions, contacts = motions, replace(motions, displacement=moved), after
        radius = contacts.friction * trial.normal_forces()
        if np.abs(moved - still.displacement).max() < EXACT * motions.size:
            break
    return _pushed(motions, contacts, radius), contacts.forces(radius)


def _settled(motions: Motions, contacts: Envelopes, jacobian: Array, radius: Array) -> tuple[Array, Array]:
    """Motions [N] of the quadratic model, and friction radii [m] N near those of the normal forces that they leave.

    Radii that follow the normal forces at once oscillate where a stiff body lands on rough ground; half of the way
    settles. Each radius waits for the minimum: an unfinished one leads to other contact forces in a rough corner. The
    motions minimise the model for the radii returned, which the guard needs.
    """
    motion = np.zeros(len(motions.gradient))
    for _ in range(SETTLE - 1):
        motion = _newton_passes(motions, contacts, jacobian, radius, motion)
        lag = contacts.friction * contacts.shifted(jacobian @ motion).normal_forces() - radius
        if np.linalg.norm(lag) <= EXACT * np.linalg.norm(radius):
            return motion, radius
        radius = radius + 0.5 * lag
    return _newton_passes(motions, contacts, jacobian, radius, motion), radius


def _newton_passes(motions: Motions, contacts: Envelopes, jacobian: Array, radius: Array, motion: Array) -> Array:
    """Motions [N] of least quadratic model of Phi for fixed friction radii [m] N, from given ones."""
    gradient, hessian = motions.gradient, motions.hessian

    def model(motion: Array, moved: Envelopes) -> float:
        return moved.energy(radius) + float((gradient + 0.5 * hessian @ motion) @ motion)

    trial = contacts.shifted(jacobian @ motion)
    energy = model(motion, trial)
    for _ in range(PASSES):
        forces, second = trial.forces(radius), trial.second_derivatives(radius)
        on = second.any(axis=(1, 2))
        matrix = hessian + np.einsum("min,mij,mjk->nk", jacobian[on], second[on], jacobian[on], optimize=True)
        step = np.linalg.solve(matrix, np.einsum("min,mi->n", jacobian, forces) - gradient - hessian @ motion)
        for _ in range(HALVINGS):
            moved = contacts.shifted(jacobian @ (motion + step))
            reached = model(motion + step, moved)
            if reached <= energy + EXACT * abs(energy):
                break
            step = 0.5 * step
        else:
            break
        motion, trial, energy = motion + step, moved, reached
        if np.abs(motions.modes @ step).max() < EXACT * motions.size:
            break
    return motion


def _pushed(motions: Motions, contacts: Envelopes, radius: Array) -> Array:
    """Displacement [V, 3] m after the pushes w (f - f0) / D of all contacts and the projection of the island."""
    problem = motions.problem
    before = contacts.normal_anchors[:, None] * contacts.normals + contacts.tangent_anchors
    each = contacts.weights[:, :, None] * (contacts.forces(radius) - before)[:, None, :]
    forces = np.zeros_like(motions.displacement)
    np.add.at(forces, contacts.vertices.reshape(-1), each.reshape(-1, 3))
    pushed = motions.displacement + np.where(problem.free[:, None], forces / problem.weighted_diagonal[:, None], 0.0)
    moved, own = motions.displacement.copy(), np.concatenate(motions.bodies)
    moved[own] = problem.project(pushed)[own]
    return moved


def _cross(vectors: Array) -> Array:
    """[v]x [..., 3, 3] with [v]x b = v x b."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    nothing = np.zeros_like(x)
    rows = [[nothing, -z, y], [z, nothing, -x], [-y, x, nothing]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _curvature(left: Array, arms: Array) -> Array:
    """Second derivative [6, 6] of -sum left . (finite motion - its first order) by the twist; left = a (s - u)."""
    moment = left.T @ arms
    curvature = np.zeros((6, 6))
    curvature[3:, 3:] = np.trace(moment) * np.eye(3) - 0.5 * (moment + moment.T)
    return curvature


def _finite(twist: Array, arms: Array) -> Array:
    """Finite displacement [n, 3] of points at arms [n, 3] by a twist (v, w): (exp [w]x - 1) r + v."""
    w, angle = _cross(twist[3:]), float(np.linalg.norm(twist[3:]))
    half = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2  # (1 - cos angle) / angle^2
    turn = np.sinc(angle / np.pi) * w + half * w @ w
    return np.asarray(arms @ turn.T + twist[:3])
