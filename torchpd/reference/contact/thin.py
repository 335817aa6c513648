"""Rigid motions of bodies in contact, of which those that are thin about an axis resist turns about it.

A force beside the axis of a nearly straight rod turns it about itself by its displacement over that arm: many times
round. The turn is resisted as by points beside the axis whose targets are where they start, and which no shift moves:

    E = 1/2 sum |(R - 1) p|^2,   sum p p^T = (I - a a^T) lacks / 2

It is 0 without motion, so that no fixed point moves, and linear momentum is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..coarse import RigidMotions, curvature, finite
from ..geometry import twists

__all__ = ["ThinMotions"]

Array = NDArray[np.float64]

THIN = 0.01  # of sum a |arm|^2: least moment of inertia about an axis


@dataclass(frozen=True)
class ThinMotions(RigidMotions):
    """Rigid motions with a least moment of inertia about every axis of a body."""

    moved: tuple[tuple[Array, Array], ...] | None = None  # of each body: p at the iterate and now [2, 3]

    @cached_property
    def points(self) -> tuple[tuple[Array, Array], ...]:
        if self.moved is not None:
            return self.moved
        found = []
        for own, arms, *_ in self.parts:
            moments, axes = np.linalg.eigh((self.problem.weight[own, None] * arms).T @ arms)
            lacks = max(THIN * moments.sum() - moments[0] - moments[1], 0.0)
            beside = np.sqrt(0.5 * lacks) * axes[:, :2].T
            found.append((beside, beside))
        return tuple(found)

    @cached_property
    def gradient(self) -> Array:
        gradient = super().gradient.copy()
        for (before, now), (_, _, basis, _, columns) in zip(self.points, self.parts, strict=True):
            gradient[columns] += basis[3:].T @ np.cross(now, now - before).sum(axis=0)
        return gradient

    @cached_property
    def hessian(self) -> Array:
        flat = self.modes.reshape(-1, self.modes.shape[2])
        hessian = flat.T @ (np.repeat(self.problem.weight[self.vertices], 3)[:, None] * flat)
        for (before, now), (_, arms, basis, rows, columns) in zip(self.points, self.parts, strict=True):
            turns = (twists(now) @ basis).reshape(-1, basis.shape[1])
            turns -= np.tile(basis[:3], (len(now), 1))  # shifts do not move them
            hessian[columns, columns] += turns.T @ turns
            bent = curvature(self.pull[rows], arms) + curvature(before - now, now)
            exact = hessian[columns, columns] + basis.T @ bent @ basis
            if basis.shape[1] and np.linalg.eigvalsh(exact)[0] > 0.0:
                hessian[columns, columns] = exact
        return np.asarray(hessian)

    def after(self, motion: Array) -> ThinMotions:
        points = []
        for (before, now), (_, _, basis, _, columns) in zip(self.points, self.parts, strict=True):
            twist = basis @ motion[columns]
            points.append((before, now + finite(np.concatenate([np.zeros(3), twist[3:]]), now)))
        return replace(self, displacement=super().after(motion).displacement, moved=tuple(points))

    @property
    def energy(self) -> float:
        return super().energy + 0.5 * sum(float(((now - before) ** 2).sum()) for before, now in self.points)
