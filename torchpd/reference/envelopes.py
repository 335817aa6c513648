"""Contacts as envelopes: forces that grow from those of the present iterate with the stiffness of the fine iteration.

A contact couples vertices with weights w_a (one vertex and w = 1 for a plane or a sphere; four that add up to zero for
a pair). With its gap, its slip t along the surface, and the forces l0 (normal) and t0 (tangential) at the iterate:

    e     = max(0, l0 - k gap)^2 / (2 k) + huber_r(t0 - k slip) / k
    1 / k = sum_a w_a^2 / D_a        huber_r(b) = |b|^2 / 2 where |b| <= r, else r |b| - r^2 / 2

e is convex and continuously differentiable for a fixed radius r = friction l. It is what remains of D / 2 |p|^2 after
the contact has chosen the push p of its vertices: p_a = w_a (f - f0) / D_a, with the force f = l n + t of e.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..common.tables import PLANES, SPHERES
from .geometry import sphere_normals

if TYPE_CHECKING:
    from .objective import Objective

__all__ = ["Envelopes", "PairContacts", "contacts_at", "pushes_of"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class PairContacts:
    """Contacts between bodies, given as a list: the gap is offset + n . sum_a w_a u_a.

    Vertices of rigid colliders are none of the problem: their weights are zero, and their part is in the last row.
    """

    vertices: Index  # [m, 4]
    weights: Array  # [m, 4] they add up to zero
    normals: Array  # [m, 3] toward the side of positive weights
    offsets: Array  # [m] gap at u = 0, m
    friction: Array  # [m]
    forces: Array  # [m, 3] l n + t on the side of positive weights, N
    carried: Array  # [m, 3] sum w u of vertices that are none of the problem, m

    def chosen(self, of: Index) -> PairContacts:
        """Some of the contacts."""
        return PairContacts(*(getattr(self, item.name)[of] for item in fields(self)))


@dataclass(frozen=True)
class Envelopes:
    """m contacts, with their gaps and slips at one iterate."""

    vertices: Index  # [m, w]
    weights: Array  # [m, w]
    normals: Array  # [m, 3]
    gaps: Array  # [m] m
    slips: Array  # [m, 3] along the surface, m
    friction: Array  # [m]
    stiffness: Array  # [m] k, N/m
    normal_anchors: Array  # [m] l0, N
    tangent_anchors: Array  # [m, 3] t0, N

    def chosen(self, of: Index) -> Envelopes:
        """Some of the contacts."""
        return Envelopes(*(getattr(self, item.name)[of] for item in fields(self)))

    def tangential(self, vectors: Array) -> Array:
        """The part of vectors [m, 3] along the surfaces."""
        return np.asarray(vectors - (vectors * self.normals).sum(axis=1, keepdims=True) * self.normals)

    def shifted(self, motion: Array) -> Envelopes:
        """The same contacts after relative displacements [m, 3] m, to first order."""
        gaps = self.gaps + (motion * self.normals).sum(axis=1)
        return replace(self, gaps=gaps, slips=self.slips + self.tangential(motion))

    def normal_forces(self) -> Array:
        """l [m] N."""
        return np.asarray(np.maximum(0.0, self.normal_anchors - self.stiffness * self.gaps))

    def tangent_forces(self, radius: Array) -> tuple[Array, Array]:
        """t [m, 3] N, and the fraction r / |b| <= 1 to which b = t0 - k slip is cut; both zero where r = 0."""
        pull = self.tangent_anchors - self.stiffness[:, None] * self.slips
        share = np.minimum(1.0, radius / np.maximum(np.linalg.norm(pull, axis=1), 1e-300))
        return share[:, None] * pull, share

    def forces(self, radius: Array) -> Array:
        """f = l n + t [m, 3] N."""
        return self.normal_forces()[:, None] * self.normals + self.tangent_forces(radius)[0]

    def energy(self, radius: Array) -> float:
        """Sum of e [J]."""
        t, share = self.tangent_forces(radius)
        size = np.linalg.norm(t, axis=1)
        # r |b| - r^2 / 2 with |b| = r / share, which is |b|^2 / 2 for share = 1
        huber = np.where(share > 0.0, size**2 * (1.0 / np.maximum(share, 1e-300) - 0.5), 0.0)
        return float(((0.5 * self.normal_forces() ** 2 + huber) / self.stiffness).sum())

    def majoriser(self, radius: Array) -> Array:
        """Second derivatives [m, 3, 3] N/m, for a fixed radius, of a quadratic above e that touches it.

        Along a slip that is cut they are r / |b| k, not 0: Newton's step stops where friction begins to hold.
        """
        n, share = self.normals, self.tangent_forces(radius)[1]
        normal = n[:, :, None] * n[:, None, :]
        pushed = (self.normal_forces() > 0.0)[:, None, None]
        flat = share[:, None, None] * (np.eye(3) - normal)
        return np.asarray(self.stiffness[:, None, None] * (np.where(pushed, normal, 0.0) + flat))


def contacts_at(
    problem: Objective, displacement: Array, forces: Array, vertices: Index, pairs: PairContacts | None = None
) -> Envelopes:
    """Contacts of free vertices with all planes and spheres, then the pairs, at an iterate.

    `forces` [C, V, 3] N are those of every plane and sphere (`pushes_of`). P projects out of one after another; so each
    has its gap and slip where P comes to it: before the pushes of those after it.
    """
    values, free = problem.values, vertices[problem.free[vertices]]
    u, y = displacement[free], problem.positions[free] + displacement[free]
    normals, gaps, slips, friction = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros((0, 3))], [np.zeros(0)]
    # how far the contacts after each one push a vertex in a plain iteration
    onto = np.cumsum(forces[::-1, free], axis=0)[::-1] - forces[:, free]
    onto /= problem.diagonal[free, None]
    for plane, later in zip(values.planes, onto, strict=False):
        normals.append(np.tile(plane[PLANES["normal"]], (len(free), 1)))
        gaps.append((y - later) @ plane[PLANES["normal"]] - plane[PLANES["height"]])
        slips.append(u - later)
        friction.append(np.full(len(free), plane[PLANES["friction"]]))
    spheres = zip(problem.sphere_centers, problem.sphere_motions, values.spheres, strict=True)
    for (center, motion, sphere), later in zip(spheres, onto[len(values.planes) :], strict=True):
        outward, lengths = sphere_normals(y, center)
        normals.append(outward)
        gaps.append(lengths - (later * outward).sum(axis=1) - sphere[SPHERES["radius"]])
        slips.append(u - motion - later)
        friction.append(np.full(len(free), sphere[SPHERES["friction"]]))
    index = np.tile(free, len(values.planes) + len(values.spheres))[:, None]
    weights, anchors = np.ones(index.shape), forces[:, free].reshape(-1, 3)
    if pairs is not None:
        moved = (pairs.weights[:, :, None] * displacement[pairs.vertices]).sum(axis=1)
        normals.append(pairs.normals)
        gaps.append(pairs.offsets + (pairs.normals * moved).sum(axis=1))
        slips.append(moved + pairs.carried)
        friction.append(pairs.friction)
        # contacts of one vertex repeat it with weight zero
        index = np.concatenate([np.repeat(index, 4, axis=1), pairs.vertices])
        weights = np.concatenate([np.pad(weights, ((0, 0), (0, 3))), pairs.weights])
        anchors = np.concatenate([anchors, pairs.forces])
    normal = np.concatenate(normals)
    inverse = np.where(problem.free[index], weights**2 / problem.diagonal[index], 0.0).sum(axis=1)
    contacts = Envelopes(
        vertices=index,
        weights=weights,
        normals=normal,
        gaps=np.concatenate(gaps),
        slips=np.concatenate(slips),
        friction=np.concatenate(friction),
        stiffness=1.0 / inverse,
        normal_anchors=np.maximum(0.0, (anchors * normal).sum(axis=1)),
        tangent_anchors=anchors,
    )
    along = contacts.tangential
    return replace(contacts, slips=along(contacts.slips), tangent_anchors=along(anchors))


def pushes_of(problem: Objective, displacement: Array, gradient: Array) -> Array:
    """Forces [C, V, 3] N of every plane and sphere in the next plain iteration: D times what P(u - g / D) moves."""
    scale = problem.diagonal[:, None]
    before, forces = displacement - gradient / scale, []
    for after in problem.projections(before, displacement):
        forces.append(np.where(problem.free[:, None], scale * (after - before), 0.0))
        before = after
    return np.stack(forces) if forces else np.zeros((0, *displacement.shape))
