"""The elements of a scene by kind: energy, forces, Hessian and diagonal of each group."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csr_array, diags_array, kron

from ..scene.scene import SceneValues
from ..scene.stencils import StencilGroup
from .geometry import elements, gradient_operator, spreads
from .kinds import KINDS, Given
from .laws import Law
from .plastic import flowed

__all__ = ["ElementGroup", "groups_of", "tetrahedra"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ElementGroup:
    """All elements of one kind, with the state and the time step at the start of a step."""

    stencils: StencilGroup
    group: NDArray[np.int64]  # [N] number of the group that shares its trace
    positions: Array  # [V, 3] x_t, m
    time_step: float  # h [s]

    @cached_property
    def gradients(self) -> Array:
        """g_a [N, n, d] of the energy: Fp^-T g_a after flow."""
        own = self.stencils
        return flowed(own, own.material["flow"][:, :9].reshape(-1, 3, 3)).gradients if _flows(own) else own.gradients

    @cached_property
    def operator(self) -> csr_array:
        """G [dN, V]: (G x) in rows dn..dn+d-1 is F_n^T."""
        return gradient_operator(self.gradients, self.stencils.corners, len(self.positions))

    @cached_property
    def adjoint(self) -> csr_array:
        return csr_array(self.operator.T)

    @cached_property
    def _start(self) -> Array:
        return np.asarray(self.operator @ self.positions)

    def _shaped(self, stacked: Array) -> Array:
        return np.swapaxes(stacked.reshape(len(self.stencils.corners), -1, 3), 1, 2)

    def deformation(self, displacement: Array) -> Array:
        """F [N, 3, d] at x_t + u."""
        return self._shaped(self._start + self.operator @ displacement)

    def change(self, direction: Array) -> Array:
        """dF [N, 3, d] along a direction [V, 3]."""
        return self._shaped(np.asarray(self.operator @ direction))

    def nodal(self, stress: Array) -> Array:
        """Forces [V, 3] of stresses [N, 3, d]: the sum of P g_a over the corners."""
        return np.asarray(self.adjoint @ np.swapaxes(stress, 1, 2).reshape(-1, 3))

    @cached_property
    def given(self) -> Given:
        """What the law is made from."""
        group = self.stencils
        start = self._shaped(self._start)
        return Given(group.material, group.constants, group.measure, self.group, start, self.time_step)

    @cached_property
    def law(self) -> Law:
        return KINDS[self.stencils.kind].law(self.given)

    def _gathered(self, weight: Array, gradients: Array) -> Array:
        """Sum [V] of weight_n |g_a|^2 over the corners."""
        shares = weight[:, None] * (gradients**2).sum(axis=2)
        corners = self.stencils.corners.reshape(-1)
        sums = np.bincount(corners, weights=shares.reshape(-1), minlength=len(self.positions))
        return np.asarray(sums, np.float64)

    @cached_property
    def weighted_diagonal(self) -> Array:
        """Entries [V] of Dbar, N/m: V (q l_e + n k) |g_a|^2 of each corner (`reference.laws`)."""
        gradients, law = self.gradients, self.law
        corners = (gradients != 0.0).any(axis=2).sum(axis=1)
        weight = spreads(gradients) * (law.quadratic * law.measure) + corners * (law.trace * law.measure)
        return self._gathered(weight, gradients)

    @cached_property
    def plain_diagonal(self) -> Array:
        """The diagonal [V] of `matrix`, N/m."""
        return self._gathered(self.law.matrix_weight * self.law.measure, self.gradients)

    @cached_property
    def matrix(self) -> csr_array:
        """The sum [V, V] of V w g g^T, N/m."""
        width = self.gradients.shape[2]
        weight = np.repeat(self.law.matrix_weight * self.law.measure, width)
        return csr_array(self.adjoint @ (diags_array(weight) @ self.operator))

    def hessian(self, displacement: Array, *, positive: bool) -> csr_array:
        """Second derivative of the energy [3V, 3V], N/m; `positive` clamps that of each element."""
        F = self.deformation(displacement)
        count, size = len(F), 3 * F.shape[2]
        blocks = self.law.blocks(F, positive=positive)
        hessian = bsr_array((blocks, np.arange(count), np.arange(count + 1)), shape=(size * count, size * count))
        wide = csr_array(kron(self.operator, np.eye(3)))
        joined = self.law.coupling(F)
        if joined is None or not joined.factor.any():
            return csr_array(wide.T @ (hessian @ wide))
        entries = np.swapaxes(joined.rows, 1, 2).reshape(-1)
        columns = np.arange(size * count)
        rows = csr_array((entries, (np.repeat(joined.group, size), columns)), shape=(len(joined.factor), size * count))
        along = csr_array(rows @ wide)
        return csr_array(wide.T @ (hessian @ wide) + along.T @ (diags_array(joined.factor) @ along))

    def material_rows(self, rates: dict[str, Array]) -> dict[str, Array]:
        """Derivatives by the rows of the material, from those by the parameters of the law."""
        return KINDS[self.stencils.kind].rows(self.given, rates)


def _flows(stencils: StencilGroup) -> bool:
    return "flow" in stencils.material


def tetrahedra(values: SceneValues) -> StencilGroup:
    """The tetrahedra of the solids as a group of kind "tet", with nu = 0 where the scene has no Poisson's ratio."""
    shape = elements(values.rest_positions, values.tets)
    return StencilGroup(
        kind="tet",
        corners=values.tets,
        gradients=shape.shape_gradients,
        measure=shape.volumes,
        constants=np.zeros((len(values.tets), 0)),
        material={
            "stiffness": values.stiffness,
            "poisson": np.zeros(len(values.tets)) if values.poisson is None else values.poisson,
        },
    )


def groups_of(values: SceneValues, positions: Array, time_step: float) -> Iterator[ElementGroup]:
    """The tetrahedra, if there are any, then every group of stencils."""
    if len(values.tets):
        group = np.arange(len(values.tets)) if values.tet_group is None else values.tet_group
        yield ElementGroup(tetrahedra(values), group, positions, time_step)
    for stencils in values.stencils:
        yield ElementGroup(_with_rows(stencils, values), np.arange(len(stencils)), positions, time_step)


def _with_rows(stencils: StencilGroup, values: SceneValues) -> StencilGroup:
    """The group with rows of its own in place of those of its tetrahedra."""
    if stencils.tets is None:
        return stencils
    youngs, nothing = values.stiffness, np.zeros(len(values.tets))
    nu = nothing if values.poisson is None else values.poisson
    seconds = nothing if values.stiffness_damping is None else values.stiffness_damping
    rows = {
        "volume": {"volume_stiffness": 3.0 * youngs * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))},
        "damper": {"viscosity": youngs / (1.0 + nu) * seconds},
    }[stencils.kind]
    return replace(stencils, material={name: row[stencils.tets] for name, row in rows.items()})
