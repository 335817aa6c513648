"""Newton's method for a step with frictionless contacts, float64: exact to rounding where first-order methods stagnate.

Every iteration predicts the touching vertices from the end of a projected Jacobi step. Those vertices move within their
contact surfaces, all others freely. The method is a semismooth Newton method for the fixed point of that iteration, and
quadratic once the active set is right. Source: Hintermueller, Ito and Kunisch 2003 (primal-dual active sets).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ..common.tables import PLANES, SPHERES
from ..reference.problem import StepProblem
from .newton_krylov import NewtonKrylov, Observer

__all__ = ["ContactNewton"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_INNER = 1000  # upper limit of iterations of conjugate gradients
_LINEAR = 1e-3  # relative residual at which they stop
_SHORTEST = 2.0**-12  # least step length of the line search
_SWEEPS = 50  # sweeps over the contacts of a vertex
_LEVEL = 1e-12  # relative difference of energies below which it is rounding


@dataclass(frozen=True)
class _ActiveContacts:
    """Active contacts of a displacement, which leave n free directions."""

    gradient: Array  # [V, 3] N
    normal_step: Array  # [V, 3] m: displacement of touching vertices onto their surfaces
    tangents: csr_array  # [3 V, n], orthonormal
    sphere_stiffness: Array  # [V] N/m: force of a sphere over its radius, by which its curvature softens the tangents

    def project(self, vectors: Array) -> Array:
        """Project vectors [V, 3] onto the free directions."""
        return np.asarray(self.tangents @ (self.tangents.T @ vectors.reshape(-1))).reshape(-1, 3)


def _active_contacts(problem: StepProblem, displacement: Array) -> _ActiveContacts:
    gradient, diagonal = problem.gradient(displacement), problem.weighted_diagonal
    places, count = problem.positions + displacement, len(problem.positions)
    stepped = places - gradient / diagonal[:, None]
    planes, spheres = problem.values.planes, problem.values.spheres
    normals, radii = np.zeros((len(planes) + len(spheres), count, 3)), np.full((len(spheres), count), np.inf)
    gaps, depths = np.zeros(normals.shape[:2]), np.zeros(normals.shape[:2])
    for k, plane in enumerate(planes):
        normals[k] = normal = plane[PLANES["normal"]]
        gaps[k] = places @ normal - plane[PLANES["height"]]
        depths[k] = plane[PLANES["height"]] - stepped @ normal
    for k, (center, sphere) in enumerate(zip(problem.sphere_centers, spheres, strict=True)):
        arms = places - center
        radii[k] = np.maximum(np.linalg.norm(arms, axis=1), 1e-300)
        normals[len(planes) + k] = outwards = arms / radii[k][:, None]
        gaps[len(planes) + k] = radii[k] - sphere[SPHERES["radius"]]
        depths[len(planes) + k] = sphere[SPHERES["radius"]] - ((stepped - center) * outwards).sum(axis=1)
    pushes = _contact_displacements(normals, depths) * problem.free
    sphere_stiffness = (diagonal * pushes[len(planes) :] / radii).sum(axis=0)
    return _ActiveContacts(gradient, *_tangents(pushes > 0.0, normals, gaps, problem.free), sphere_stiffness)


def _contact_displacements(normals: Array, depths: Array) -> Array:
    """Least displacement [C, V] m by which each contact moves each vertex out of all contacts (Hildreth).

    A contact is inactive (0) for a vertex that other contacts already keep outside it.
    """
    pushes = np.zeros_like(depths)
    for _ in range(_SWEEPS if len(depths) > 1 else 1):
        for k, normal in enumerate(normals):
            others = np.einsum("cv,cvi->vi", pushes, normals) - pushes[k][:, None] * normal
            pushes[k] = np.maximum(depths[k] - (others * normal).sum(axis=1), 0.0)
    return pushes


def _tangents(held: Mask, normals: Array, gaps: Array, free: Mask) -> tuple[Array, csr_array]:
    """Displacements [V, 3] m of held vertices onto their surfaces, and the free directions of all vertices."""
    normal_step = np.zeros((len(free), 3))
    rows, entries = [], []
    for vertex in np.flatnonzero(held.any(axis=0)):
        own = np.flatnonzero(held[:, vertex])
        across = normals[own, vertex]
        normal_step[vertex] = -np.linalg.pinv(across) @ gaps[own, vertex]
        _, sizes, axes = np.linalg.svd(across)
        for tangent in axes[int((sizes > 1e-9).sum()) :]:
            rows.append(3 * vertex + np.arange(3))
            entries.append(tangent)
    loose = np.flatnonzero(np.repeat(free & ~held.any(axis=0), 3))
    columns = np.concatenate([np.repeat(np.arange(len(rows)), 3), len(rows) + np.arange(len(loose))])
    values = np.concatenate([*entries, np.ones(len(loose))])
    shape = (3 * len(free), len(rows) + len(loose))
    return normal_step, csr_array((values, (np.concatenate([*rows, loose]), columns)), shape=shape)


class ContactNewton:
    """Newton's method for one step, with contacts or without; conjugate gradients solve its linear systems.

    Args:
        problem: the step; friction is ignored.
        passes: a counter [1], incremented by every product with the Hessian.
    """

    def __init__(self, problem: StepProblem, passes: list[int] | None = None) -> None:
        self.problem = problem
        self.krylov = NewtonKrylov(problem, [0] if passes is None else passes)

    def step(self, displacement: Array) -> tuple[Array, bool]:
        """Newton step [V, 3] m from u: to the minimum of the quadratic model of E under the active contacts.

        Returns the step and True. With False the step only descends: there is no minimum, or it was not reached.
        """
        found = _active_contacts(self.problem, displacement)
        here = torch.from_numpy(displacement)

        def multiply(p: Array) -> Array:
            image = self.krylov.product(here, torch.from_numpy(p)).numpy()
            return np.asarray(image - found.sphere_stiffness[:, None] * p)

        residual = -found.project(found.gradient + multiply(found.normal_step))
        goal = _LINEAR * float(np.linalg.norm(residual))
        step, search, rho = np.zeros_like(residual), residual, 0.0
        for inner in range(_INNER):
            if float(np.linalg.norm(residual)) <= goal:
                return found.normal_step + step, True
            smooth = found.project(self.krylov.precondition(torch.from_numpy(residual)).numpy())
            last, rho = rho, float((residual * smooth).sum())
            search = smooth + (rho / last) * search if inner else smooth
            image = found.project(multiply(search))
            curvature = float((search * image).sum())
            if curvature <= 0.0:
                return found.normal_step + (step if inner else search), False
            step = step + (rho / curvature) * search
            residual = residual - (rho / curvature) * image
        return found.normal_step + step, False

    def minimise(self, displacement: Array, *, iterations: int = 50, observe: Observer | None = None) -> Array:
        """Take steps from u [V, 3] m while the energy falls, or the residual once energies differ only by rounding."""
        u, energy = displacement, self.problem.energy(displacement)
        size = float(np.linalg.norm(self.problem.residual(u)))
        for k in range(iterations):
            found = self._descend(u, energy, size, self.step(u)[0])
            if found is None:
                break
            u, energy, size = found
            if observe is not None:
                observe(k + 1, u)
        return u

    def _descend(self, u: Array, energy: float, size: float, step: Array) -> tuple[Array, float, float] | None:
        """Backtrack along `step`; None if no step descends."""
        length = 1.0
        while length >= _SHORTEST:
            trial = self.problem.project(u + length * step)
            reached, left = self.problem.energy(trial), float(np.linalg.norm(self.problem.residual(trial)))
            level = abs(reached - energy) <= _LEVEL * abs(energy)
            if left < 0.9 * size if level else reached < energy:
                return trial, reached, left
            length *= 0.5
        return None
