"""Reference for the tests: one step of projective dynamics in float64, plain NumPy and SciPy, no code shared with C++.

The unknown is the displacement u = x - x_t of one step of length h. Every vertex effect folds into one weight a_i and
one target s_i. The step is the variational form of implicit Euler (Bouaziz et al. 2014); drag and soft pins are
quadratic too:

    a_i     = m_i / h^2 (1 + damping h) + k_i
    a_i s_i = m_i / h^2 (h v_i + h^2 (g + f_i / m_i)) + k_i (target_i - x_t,i)
    E(u)    = sum_i a_i / 2 |u_i - s_i|^2 + sum_e w_e V_e / 2 |F_e(x_t + u) - R_e|^2

with F = sum_a x_a (x) grad N_a and R its nearest rotation. Hard pins hold u_i = target_i - x_t,i and add nothing to E.
`reference.solvers` holds the methods that minimise E.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csr_array, diags_array, kron

from ..common.tables import PLANES, SPHERES
from ..scene.scene import SceneValues
from .rigid import align, begin
from .rigid_piece import gaps_of

__all__ = [
    "Elements",
    "StepProblem",
    "elastic_energy",
    "elements",
    "gradient_operator",
    "kinetic_energy",
    "nearest_rotation",
    "nearest_rotation_fast",
    "potential_energy",
    "singular_frames",
    "step_problem",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Elements:
    """Geometry of the tetrahedra, computed from the rest shape."""

    rest_inverse: Array  # [E, 3, 3] Dm^-1, the columns of Dm being the edges x_1 - x_0, x_2 - x_0, x_3 - x_0 [1/m]
    volumes: Array  # [E] m^3
    shape_gradients: Array  # [E, 4, 3] grad N_a [1/m]
    eigenvalue_bound: Array  # [E] l_e = lambda_max(diag(K)^-1/2 K diag(K)^-1/2), K = grad N grad N^T, between 4/3 and 4


def elements(rest_positions: Array, tets: Index) -> Elements:
    """Geometry of linear tetrahedra; grad N_1..3 are the rows of Dm^-1 and grad N_0 is minus their sum."""
    corners = rest_positions[tets]
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    rest_inverse = np.linalg.inv(edges)
    gradients = np.concatenate([-rest_inverse.sum(axis=1, keepdims=True), rest_inverse], axis=1)
    directions = gradients / np.linalg.norm(gradients, axis=2, keepdims=True)
    eigenvalue_bound = np.linalg.eigvalsh(directions @ np.swapaxes(directions, 1, 2))[:, -1]
    return Elements(np.asarray(rest_inverse, np.float64), np.linalg.det(edges) / 6.0, gradients, eigenvalue_bound)


def gradient_operator(shape_gradients: Array, tets: Index, count: int) -> csr_array:
    """The sparse G [3E, V] with (G x) in rows 3e..3e+2 equal to F_e^T."""
    rows = np.repeat(np.arange(3 * len(tets)), 4)
    columns = np.repeat(tets, 3, axis=0).reshape(-1)
    entries = np.swapaxes(shape_gradients, 1, 2).reshape(-1)
    return csr_array((entries, (rows, columns)), shape=(3 * len(tets), count))


def singular_frames(matrices: Array) -> tuple[Array, Array, Array]:
    """F = U diag(s) V^T with U and V rotations: s_1 >= s_2 >= |s_3|, and s_3 takes the sign of det F."""
    left, values, right = np.linalg.svd(matrices)
    # flip the last singular direction of a frame that reflects, and s_3 with it
    left_sign, right_sign = np.sign(np.linalg.det(left)), np.sign(np.linalg.det(right))
    left[..., :, 2] *= left_sign[..., None]
    right[..., 2, :] *= right_sign[..., None]
    values[..., 2] *= left_sign * right_sign
    return left, values, right


def nearest_rotation(matrices: Array) -> Array:
    """The nearest rotation of every F [..., 3, 3]: R with det R = +1 minimises |F - R|; U V^T of the signed SVD."""
    left, _, right = singular_frames(matrices)
    return left @ right


# indices into a row-major 3x3 matrix: the products of these entries are its cofactors
_NEXT, _LAST = (1, 2, 0), (2, 0, 1)
_ENTRIES = [[3 * i + j for i in rows for j in columns] for rows, columns in
            ((_NEXT, _NEXT), (_LAST, _LAST), (_NEXT, _LAST), (_LAST, _NEXT))]  # fmt: skip


def _cofactors(m: Array) -> Array:
    """Cofactor matrices of m [3, 3, n]: row i is the cross product of the other two rows."""
    a, b, c, d = (m.reshape(9, -1).take(entries, axis=0) for entries in _ENTRIES)
    return np.asarray((a * b - c * d).reshape(m.shape))


def nearest_rotation_fast(matrices: Array, *, sweeps: int = 9) -> Array:
    """`nearest_rotation` of F [n, 3, 3], about ten times faster where F is far from singular and not inverted.

    Higham's Newton iteration X <- (X + X^-T) / 2 converges quadratically to the rotation of the polar decomposition
    when det F > 0 (Higham 1986). The SVD handles matrices for which it has not converged to rounding.
    """
    x = np.ascontiguousarray(np.moveaxis(matrices, 0, 2))
    scale = np.abs(x).max(axis=(0, 1)) ** 3
    sound = (x[0] * _cofactors(x)[0]).sum(axis=0) > 1e-3 * scale
    x[:, :, ~sound] = np.eye(3)[:, :, None]
    change = np.zeros(len(matrices))
    for _ in range(sweeps):
        cofactors = _cofactors(x)
        determinants = (x[0] * cofactors[0]).sum(axis=0)
        following = 0.5 * (x + cofactors / determinants)
        change, x = np.abs(following - x).max(axis=(0, 1)), following
        if change.max(initial=0.0) < 1e-9:  # quadratic convergence: the error is now of the order of 1e-18
            break
    rotations = np.ascontiguousarray(np.moveaxis(x, 2, 0))
    rest = ~sound | (change >= 1e-9)
    if rest.any():
        rotations[rest] = nearest_rotation(matrices[rest])
    return rotations


@dataclass(frozen=True)
class StepProblem:
    """The minimisation of one step, built by `step_problem`. Displacements u are [V, 3] in metres."""

    values: SceneValues
    time_step: float  # h, s
    positions: Array  # [V, 3] x_t
    velocities: Array  # [V, 3]
    weight: Array  # [V] a_i, N/m
    target: Array  # [V, 3] s_i; at a hard pin target_i - x_t,i
    free: Mask  # [V] not hard-pinned
    sphere_centers: Array  # [S, 3] at the end of the step
    sphere_motions: Array  # [S, 3] displacement of the centres during the step

    @cached_property
    def geometry(self) -> Elements:
        """Geometry of the tetrahedra at rest."""
        return elements(self.values.rest_positions, self.values.tets)

    @cached_property
    def operator(self) -> csr_array:
        """G [3E, V]: (G x) in rows 3e..3e+2 is F_e^T."""
        return gradient_operator(self.geometry.shape_gradients, self.values.tets, len(self.positions))

    @cached_property
    def _adjoint(self) -> csr_array:
        return csr_array(self.operator.T)

    @cached_property
    def element_weight(self) -> Array:
        """w_e V_e [E] in J."""
        return self.values.stiffness * self.geometry.volumes

    @cached_property
    def _start_gradients(self) -> Array:
        return np.asarray(self.operator @ self.positions)

    def _diagonal(self, factor: Array) -> Array:
        shares = (factor * self.element_weight)[:, None] * (self.geometry.shape_gradients**2).sum(axis=2)
        sums = np.bincount(self.values.tets.reshape(-1), weights=shares.reshape(-1), minlength=len(self.positions))
        return self.weight + sums

    @cached_property
    def plain_diagonal(self) -> Array:
        """D_i = a_i + sum_e w_e V_e |grad N_i|^2 [V]: the diagonal of A, N/m."""
        return self._diagonal(np.ones(len(self.element_weight)))

    @cached_property
    def weighted_diagonal(self) -> Array:
        """Dbar_i = a_i + sum_e l_e w_e V_e |grad N_i|^2 [V], N/m: A <= Dbar on every mesh."""
        return self._diagonal(self.geometry.eigenvalue_bound)

    @cached_property
    def matrix(self) -> csr_array:
        """A [V, V] = diag(a) + G^T diag(w V) G: the constant matrix of projective dynamics, the same for every axis."""
        scaled = diags_array(np.repeat(self.element_weight, 3)) @ self.operator
        return csr_array(diags_array(self.weight) + self._adjoint @ scaled)

    @cached_property
    def smallest_ratio(self) -> float:
        """mu = min over free vertices of a_i / Dbar_i <= lambda_min(Dbar^-1 A)."""
        return float(np.min((self.weight / self.weighted_diagonal)[self.free], initial=1.0))

    def deformation_gradients(self, displacement: Array) -> Array:
        """F [E, 3, 3] at x_t + u."""
        stacked = self._start_gradients + self.operator @ displacement
        return np.swapaxes(stacked.reshape(-1, 3, 3), 1, 2)

    def evaluate(self, displacement: Array) -> tuple[float, Array]:
        """E(u) [J] and grad E(u) [V, 3] in N, zero at hard pins."""
        deformation = self.deformation_gradients(displacement)
        strain = np.swapaxes(deformation - nearest_rotation_fast(deformation), 1, 2)
        pull = np.where(self.free[:, None], displacement - self.target, 0.0)
        stress = self.element_weight[:, None, None] * strain
        energy = 0.5 * float(self.weight @ (pull**2).sum(axis=1)) + 0.5 * float((stress * strain).sum())
        gradient = self.weight[:, None] * pull + self._adjoint @ stress.reshape(-1, 3)
        return energy, np.where(self.free[:, None], gradient, 0.0)

    def energy(self, displacement: Array) -> float:
        """E(u) [J]."""
        return self.evaluate(displacement)[0]

    def gradient(self, displacement: Array) -> Array:
        """grad E(u) [V, 3] in N, zero at hard pins."""
        return self.evaluate(displacement)[1]

    def hessian(self, displacement: Array, *, positive: bool = False) -> csr_array:
        """Exact Hessian [3V, 3V] N/m, with the derivative of the rotation; rows and columns of hard pins included.

        The derivative of |F - R|^2 / 2 is the identity less 2 / (s_i + s_j) on each twist
        U (e_i e_j^T - e_j e_i^T) V^T / sqrt 2 (Smith, De Goes and Kim 2019). `positive` clamps those eigenvalues,
        1 - 2 / (s_i + s_j), at zero: the nearest positive semidefinite element Hessian.
        """
        left, values, right = singular_frames(self.deformation_gradients(displacement))
        blocks = np.repeat(np.eye(9)[None], len(left), axis=0)
        for i, j in ((0, 1), (1, 2), (2, 0)):
            twist = np.zeros((3, 3))
            twist[i, j], twist[j, i] = np.sqrt(0.5), -np.sqrt(0.5)
            # the operator acts on F^T, row by row
            mode = np.swapaxes(left @ twist @ right, 1, 2).reshape(-1, 9)
            softening = 2.0 / np.maximum(values[:, i] + values[:, j], 1e-12)
            softening = np.minimum(softening, 1.0) if positive else softening
            blocks -= softening[:, None, None] * mode[:, :, None] * mode[:, None, :]
        blocks *= self.element_weight[:, None, None]
        count = len(blocks)
        inner = bsr_array((blocks, np.arange(count), np.arange(count + 1)), shape=(9 * count, 9 * count))
        wide = csr_array(kron(self.operator, np.eye(3)))
        return csr_array(diags_array(np.repeat(self.weight, 3)) + wide.T @ (inner @ wide))

    def first_iterate(self, start: str | Array = "velocity", *, weighted: bool = True) -> Array:
        """u_0 [V, 3] m with pins at their targets, contacts projected and rigid motions applied.

        `start` is "velocity" (h v), "inertial" (s) or positions [V, 3]. With a named start, a component keeps its
        current position where the contacts would squeeze it by more energy than the motion gains (`begin`).
        `weighted` chooses the diagonal that the iterations use.
        """
        if isinstance(start, str):
            guesses = {"velocity": self.time_step * self.velocities, "inertial": self.target}
            if start not in guesses:
                raise ValueError(f'start must be "velocity", "inertial" or positions [V, 3], got "{start}"')
            guess = self.hold(guesses[start])
            begun = begin(self, guess, self.weighted_diagonal if weighted else self.plain_diagonal)
            return self.align(begun, first=True)
        guess = self.hold(np.asarray(start, dtype=np.float64) - self.positions)
        return self.project(guess, guess)

    def unsolved(self) -> Array:
        """The unsolved step [V, 3] m: h v with pins at their targets and contacts projected."""
        guess = self.hold(self.time_step * self.velocities)
        return self.project(guess, guess)

    def hold(self, displacement: Array) -> Array:
        return np.where(self.free[:, None], displacement, self.target)

    def align(self, displacement: Array, *, first: bool = False) -> Array:
        """Move every component rigidly to the least E that its pins and contacts allow."""
        return align(self, displacement, nearest_rotation, first=first)

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
        moved = displacement
        for plane in self.values.planes:
            normal = plane[PLANES["normal"]]
            gaps = (self.positions + moved) @ normal - plane[PLANES["height"]]
            normals = np.broadcast_to(normal, moved.shape)
            moved = _push_out(moved, normals, gaps, np.zeros(3), float(plane[PLANES["friction"]]))
        for center, motion, sphere in zip(self.sphere_centers, self.sphere_motions, self.values.spheres, strict=True):
            arms = self.positions + (moved if around is None else around) - center
            lengths = np.linalg.norm(arms, axis=1, keepdims=True)
            normals = np.where(lengths > 0.0, arms / np.maximum(lengths, 1e-300), [0.0, 1.0, 0.0])
            gaps = ((self.positions + moved - center) * normals).sum(axis=1) - sphere[SPHERES["radius"]]
            moved = _push_out(moved, normals, gaps, motion, float(sphere[SPHERES["friction"]]))
        return np.where(self.free[:, None], moved, displacement)

    def residual(self, displacement: Array, diagonal: Array | None = None) -> Array:
        """D (u - P(u - g / D)) [V, 3] N: zero at a solution, grad E where nothing touches; D is Dbar by default."""
        scale = (self.weighted_diagonal if diagonal is None else diagonal)[:, None]
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


def step_problem(
    values: SceneValues,
    positions: Array,
    velocities: Array,
    time_step: float,
    *,
    forces: Array | None = None,
    pin_targets: Array | None = None,
    sphere_centers: Array | None = None,
    sphere_starts: Array | None = None,
) -> StepProblem:
    """Build the minimisation of one step.

    Args:
        values: the scene.
        positions: [V, 3] x_t, m.
        velocities: [V, 3] m/s.
        time_step: h [s].
        forces: [V, 3] N; default none.
        pin_targets: [P, 3] m in the order of values.pin_vertices; default: those of the scene.
        sphere_centers: [S, 3] m at the end of the step; default: those of the scene.
        sphere_starts: [S, 3] m at the start of the step; default: `sphere_centers`. Friction acts on the relative
            motion.
    """
    positions, velocities = np.asarray(positions, dtype=np.float64), np.asarray(velocities, dtype=np.float64)
    held, springs = values.pin_vertices, values.pin_stiffness
    targets = values.pin_targets if pin_targets is None else np.asarray(pin_targets, dtype=np.float64)
    placed = values.spheres[:, SPHERES["center"]]
    centers = placed if sphere_centers is None else np.asarray(sphere_centers, dtype=np.float64)
    starts = centers if sphere_starts is None else np.asarray(sphere_starts, dtype=np.float64)
    inertia = values.masses / time_step**2
    force = values.masses[:, None] * (velocities / time_step + values.gravity)
    if forces is not None:
        force = force + forces
    soft = np.isfinite(springs)
    spring = np.zeros(len(positions))
    spring[held[soft]] = springs[soft]
    force[held[soft]] += springs[soft, None] * (targets - positions[held])[soft]
    weight = inertia * (1.0 + values.damping * time_step) + spring
    target = force / weight[:, None]
    target[held[~soft]] = (targets - positions[held])[~soft]
    free = np.ones(len(positions), dtype=np.bool_)
    free[held[~soft]] = False
    return StepProblem(
        values=values,
        time_step=time_step,
        positions=positions,
        velocities=velocities,
        weight=weight,
        target=target,
        free=free,
        sphere_centers=centers,
        sphere_motions=centers - starts,
    )


def elastic_energy(values: SceneValues, positions: Array) -> float:
    """Elastic energy sum_e w_e V_e / 2 |F_e - R_e|^2 [J] at positions [V, 3]."""
    geometry = elements(values.rest_positions, values.tets)
    corners = positions[values.tets]
    deformation = np.einsum("eai,eaj->eij", corners, geometry.shape_gradients)
    strain = deformation - nearest_rotation(deformation)
    return 0.5 * float(values.stiffness * geometry.volumes @ (strain**2).sum(axis=(1, 2)))


def potential_energy(values: SceneValues, positions: Array, *, pin_targets: Array | None = None) -> float:
    """Elastic energy, soft pins k / 2 |x - target|^2 and gravity -m g . x [J]."""
    targets = values.pin_targets if pin_targets is None else pin_targets
    soft = np.isfinite(values.pin_stiffness)
    stretch = (positions[values.pin_vertices] - targets)[soft]
    springs = 0.5 * float(values.pin_stiffness[soft] @ (stretch**2).sum(axis=1))
    weight = -float(values.masses @ (positions @ values.gravity))
    return elastic_energy(values, positions) + springs + weight


def kinetic_energy(values: SceneValues, velocities: Array) -> float:
    """Kinetic energy sum_i m_i / 2 |v_i|^2 [J]."""
    return 0.5 * float(values.masses @ (velocities**2).sum(axis=1))
