"""Reference for the tests: one step of projective dynamics in float64, plain NumPy and SciPy, no code shared with C++.

The unknown is the displacement u = x - x_t of one step of length h. Every vertex effect folds into one weight a_i and
one target s_i. The step is the variational form of implicit Euler (Bouaziz et al. 2014); drag and soft pins are
quadratic too:

    a_i     = m_i / h^2 (1 + damping h) + k_i
    a_i s_i = m_i / h^2 (h v_i + h^2 (g + f_i / m_i)) + k_i (target_i - x_t,i)
    E(u)    = sum_i a_i / 2 |u_i - s_i|^2 + sum_e V_e psi_e(F_e(x_t + u))

with F = sum_a x_a (x) g_a over the corners of an element and psi by its kind (`reference.kinds`): for tetrahedra with
nu = 0, w / 2 |F - R|^2 with R the nearest rotation. Hard pins hold u_i = target_i - x_t,i and add nothing to E.
`reference.solvers` holds the methods that minimise E.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array

from ..common.tables import PLANES, SPHERES
from ..scene.scene import SceneValues
from .geometry import gaps_of, sphere_normals
from .groups import ElementGroup, groups_of

__all__ = ["Objective"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Objective:
    """E of one step, the pins and the contacts. Displacements u are [V, 3] in metres."""

    values: SceneValues
    time_step: float  # h, s
    positions: Array  # [V, 3] x_t
    velocities: Array  # [V, 3]
    weight: Array  # [V] a_i, N/m
    target: Array  # [V, 3] s_i; at a hard pin target_i - x_t,i
    free: Mask  # [V] not hard-pinned
    sphere_centers: Array  # [S, 3] at the end of the step
    sphere_motions: Array  # [S, 3] displacement of the centres during the step
    weighted: bool = True  # whether `diagonal` has the bounds of the elements

    @cached_property
    def groups(self) -> tuple[ElementGroup, ...]:
        """The elements by kind."""
        return tuple(groups_of(self.values, self.positions, self.time_step))

    @cached_property
    def plain_diagonal(self) -> Array:
        """D_i = a_i + sum_e w_e V_e |g_i|^2 [V]: the diagonal of A, N/m."""
        return self.weight + sum(group.plain_diagonal for group in self.groups)

    @cached_property
    def weighted_diagonal(self) -> Array:
        """Dbar_i = a_i + sum_e (q_e l_e + n k_e) V_e |g_i|^2 [V], N/m: no step 1.9 Dbar^-1 grad E raises E."""
        return self.weight + sum(group.weighted_diagonal for group in self.groups)

    @property
    def diagonal(self) -> Array:
        """D [V], N/m, of iterations and coarse corrections."""
        return self.weighted_diagonal if self.weighted else self.plain_diagonal

    def with_diagonal(self, *, weighted: bool) -> Self:
        """The same with the weighted or the plain diagonal."""
        return self if weighted == self.weighted else replace(self, weighted=weighted)

    @cached_property
    def matrix(self) -> csr_array:
        """A [V, V] = diag(a) + sum_e w_e V_e g g^T: the constant matrix, the same for every axis.

        w is 2 mu + max(lambda, 0) for solids and membranes, else the stiffness of the element.
        """
        matrix = csr_array(diags_array(self.weight))
        for group in self.groups:
            matrix = csr_array(matrix + group.matrix)
        return matrix

    @cached_property
    def smallest_ratio(self) -> float:
        """mu = min over free vertices of a_i / Dbar_i <= lambda_min(Dbar^-1 A)."""
        return float(np.min((self.weight / self.weighted_diagonal)[self.free], initial=1.0))

    def evaluate(self, displacement: Array) -> tuple[float, Array]:
        """E(u) [J] and grad E(u) [V, 3] in N, zero at hard pins."""
        pull = np.where(self.free[:, None], displacement - self.target, 0.0)
        energy, gradient = 0.5 * float(self.weight @ (pull**2).sum(axis=1)), self.weight[:, None] * pull
        for group in self.groups:
            energies, stress = group.law.evaluate(group.deformation(displacement))
            energy, gradient = energy + float(energies.sum()), gradient + group.nodal(stress)
        return energy, np.where(self.free[:, None], gradient, 0.0)

    def energy(self, displacement: Array) -> float:
        """E(u) [J]."""
        return self.evaluate(displacement)[0]

    def energies(self, displacement: Array) -> Array:
        """E(u) [J] of every component."""
        component, count = self.values.component, int(self.values.component.max()) + 1
        pull = np.where(self.free[:, None], displacement - self.target, 0.0)
        energy = np.bincount(component, 0.5 * self.weight * (pull**2).sum(axis=1), count)
        for group in self.groups:
            each = group.law.evaluate(group.deformation(displacement))[0]
            energy = energy + np.bincount(component[group.stencils.corners[:, 0]], each, count)
        return np.asarray(energy, np.float64)

    def gradient(self, displacement: Array) -> Array:
        """grad E(u) [V, 3] in N, zero at hard pins."""
        return self.evaluate(displacement)[1]

    def hessian_product(self, displacement: Array, direction: Array) -> Array:
        """H v [V, 3] in N for a direction v [V, 3] m, with the derivative of the rotations; zero at hard pins."""
        direction = np.where(self.free[:, None], direction, 0.0)
        product = self.weight[:, None] * direction
        for group in self.groups:
            F, dF = group.deformation(displacement), group.change(direction)
            product = product + group.nodal(group.law.differential(F, dF))
        return np.where(self.free[:, None], product, 0.0)

    def hessian(self, displacement: Array, *, positive: bool = False) -> csr_array:
        """Exact Hessian [3V, 3V] N/m, with the derivative of the rotations; rows and columns of hard pins included.

        `positive` clamps the eigenvalues of every element's Hessian at zero.
        """
        hessian = csr_array(diags_array(np.repeat(self.weight, 3)))
        for group in self.groups:
            hessian = csr_array(hessian + group.hessian(displacement, positive=positive))
        return hessian

    def material_products(self, displacement: Array, direction: Array) -> dict[str, Array]:
        """v^T dg/dp by the name of the row, g the gradient of E and v [V, 3] zero at hard pins.

        The adjoint -H^-1 dL/du in place of v gives dL/dp of a loss L of the converged step. Shapes are those of the
        rows. Without a Poisson's ratio in the scene, "poisson" is the derivative at nu = 0.
        """
        direction, products = np.where(self.free[:, None], direction, 0.0), dict[str, Array]()
        for group in self.groups:
            rates = group.law.products(group.deformation(displacement), group.change(direction))
            products |= group.material_rows(rates)
        return products

    def unsolved(self) -> Array:
        """The unsolved step [V, 3] m: h v with pins at their targets and contacts projected."""
        guess = self.hold(self.time_step * self.velocities)
        return self.project(guess, guess)

    def hold(self, displacement: Array) -> Array:
        return np.where(self.free[:, None], displacement, self.target)

    def smallest_gap(self, displacement: Array) -> Array:
        """Signed distance [V] m of every vertex to the nearest contact surface; inf without contacts."""
        positions = self.positions + displacement
        return gaps_of(positions, self.values.planes, self.sphere_centers, self.values.spheres)

    def project(self, displacement: Array, around: Array | None = None) -> Array:
        """P(u) [V, 3] m: project out of the planes one after another, then out of the spheres; hard pins stay.

        A sphere acts through its tangent half-space, with the normal at `around` (by default at u). The iterations
        pass their current iterate as `around`. With the normal of the unprojected step, the point where friction
        comes to rest would depend on the step length.
        """
        *_, moved = displacement, *self.projections(displacement, displacement if around is None else around)
        return np.where(self.free[:, None], moved, displacement)

    def projections(self, displacement: Array, around: Array) -> Iterator[Array]:
        """The displacement [V, 3] m after the projection out of each plane, then out of each sphere; see `project`."""
        moved = displacement
        for plane in self.values.planes:
            normal = plane[PLANES["normal"]]
            gaps = (self.positions + moved) @ normal - plane[PLANES["height"]]
            normals = np.broadcast_to(normal, moved.shape)
            moved = _push_out(moved, normals, gaps, np.zeros(3), float(plane[PLANES["friction"]]))
            yield moved
        for center, motion, sphere in zip(self.sphere_centers, self.sphere_motions, self.values.spheres, strict=True):
            normals, _ = sphere_normals(self.positions + around, center)
            gaps = ((self.positions + moved - center) * normals).sum(axis=1) - sphere[SPHERES["radius"]]
            moved = _push_out(moved, normals, gaps, motion, float(sphere[SPHERES["friction"]]))
            yield moved

    def residual(self, displacement: Array, diagonal: Array | None = None) -> Array:
        """D (u - P(u - g / D)) [V, 3] N: zero at a solution, grad E where nothing touches; `diagonal` by default."""
        scale = (self.diagonal if diagonal is None else diagonal)[:, None]
        stepped = displacement - self.gradient(displacement) / scale
        return np.asarray(scale * (displacement - self.project(stepped, displacement)))

    def relative_residual(self, displacement: Array, diagonal: Array | None = None) -> float:
        """|r| / max(|f|, |r|), with |f|^2 = sum_i |a_i (u_i - s_i)|^2 + |e_i|^2 and e_i the elastic forces.

        `Info.residual` is the same value less a bound of the rounding error of r.
        """
        left = float(np.linalg.norm(self.residual(displacement, diagonal)))
        pull = np.where(self.free[:, None], self.weight[:, None] * (displacement - self.target), 0.0)
        forces = float(np.hypot(np.linalg.norm(pull), np.linalg.norm(self.gradient(displacement) - pull)))
        return left / max(left, forces) if left > 0.0 else 0.0


def _push_out(displacement: Array, normals: Array, gaps: Array, motion: Array, friction: float) -> Array:
    """Move vertices with gap < 0 onto the surface, then undo slip up to friction times the depth (Coulomb)."""
    depth = np.maximum(-gaps, 0.0)
    moved = displacement + depth[:, None] * normals
    slip = moved - motion
    slip = slip - (slip * normals).sum(axis=1, keepdims=True) * normals
    length = np.linalg.norm(slip, axis=1)
    share = np.minimum(1.0, friction * depth / np.maximum(length, 1e-300))
    return np.asarray(moved - share[:, None] * slip)
