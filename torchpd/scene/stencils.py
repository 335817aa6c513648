"""Stencils: elements of up to five vertices, as flat arrays by kind.

A stencil has n vertices with constant vectors g_a in R^d that add up to zero. Its deformation is F = sum_a x_a g_a^T
[3, d], and its energy V psi(F; parameters). The tetrahedra of solids have arrays of their own.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["KINDS", "Kind", "StencilGroup", "merge_groups"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class Kind(NamedTuple):
    """Sizes of a kind, and the names of its material rows."""

    corners: int  # n
    columns: int  # d, columns of F
    constants: int  # c, further constants of a stencil
    rows: tuple[str, ...]
    of_tets: bool = False  # whether these are rows of tetrahedra, so that the kind has none of its own
    quadratic: int = 0  # its first rows, which make a quadratic energy where the others are zero; 0: none do

    @property
    def own_rows(self) -> tuple[str, ...]:
        """Names of the rows that the kind has for each of its stencils."""
        return () if self.of_tets else self.rows


# In the order in which a scene lists them.
KINDS: dict[str, Kind] = {
    "triangle": Kind(3, 2, 0, ("membrane_youngs", "membrane_poisson", "thickness")),
    "hinge": Kind(4, 1, 0, ("bending", "rest_curvature"), quadratic=1),
    "spring": Kind(2, 1, 0, ("spring_stiffness", "rest_length")),
    "tie": Kind(5, 1, 0, ("tie_stiffness",), quadratic=1),
    "fibre": Kind(4, 1, 1, ("fibre_stiffness", "fibre_length")),
    "thread": Kind(3, 1, 0, ("thread_stiffness",)),
    "solid_limit": Kind(4, 3, 0, ("solid_limit",)),
    "cloth_limit": Kind(3, 2, 0, ("cloth_limit",)),
    "volume": Kind(4, 3, 0, ("stiffness", "poisson"), of_tets=True),
    "damper": Kind(4, 3, 0, ("stiffness", "poisson", "stiffness_damping"), of_tets=True),
    "plastic": Kind(
        4,
        3,
        0,
        ("plastic_youngs", "plastic_poisson", "yield_strain", "hardening", "creep_time", "max_flow", "flow"),
    ),
}


@dataclass(frozen=True, eq=False)
class StencilGroup:
    """Stencils of one kind, with what their F, V and psi are.

    - triangle: F maps its rest plane, V is its area [m^2]; the corotated membrane of Y = youngs thickness.
    - hinge: F is a curvature vector [1/m]; V is the area of two triangles [m^2], or of a rod a length [m]. psi is
      kb/2 (|F| - k0)^2.
    - spring: F is x1 - x0 [m], V is 1; k/2 (|F| - L)^2.
    - tie: F is x0 - sum b_a x_a [m], V is 1; k/2 |F|^2.
    - fibre: F is that of its tetrahedron times f, V the volume of its material [m^3]; w/2 (|F| - L)^2.
    - thread: F is that of its triangle times f, V the area [m^2]; w/2 (|F| - 1)^2.
    - solid_limit, cloth_limit: F and V of a tetrahedron or a triangle; k/2 dist^2(F, {stretches in [lo, hi]}), also
      det F > 0 of a tetrahedron.
    - volume: F and V of a tetrahedron; 3 lambda/2 dist^2(F, {det F = 1}).
    - plastic: F and V of a tetrahedron; the corotated law of a solid on F Fp^-1, Fp of the row `flow`.
    - damper: F and V of a tetrahedron; mu beta/h |F - R U_t|^2, U_t the stretch at the start of a step.
    """

    kind: str
    corners: Index  # [N, n] vertices of the scene; one with g_a = 0 may repeat another
    gradients: Array  # [N, n, d] g_a; the rows of a stencil add up to zero
    measure: Array  # [N] V
    constants: Array  # [N, c]; of a fibre: 1 if it has no energy for |F| < L, else 0
    material: dict[str, Array]  # trainable rows by name, [N] or [N, width]
    tets: Index | None = None  # [N] tetrahedra whose rows of the material the kind reads instead of its own

    def __len__(self) -> int:
        return len(self.corners)

    @property
    def is_quadratic(self) -> bool:
        """Whether the energy is w/2 |F|^2 and stays so: rows that would change it are zero, and left out."""
        count = KINDS[self.kind].quadratic
        return count > 0 and not any(self.material[name].any() for name in KINDS[self.kind].rows[count:])

    @property
    def trainable(self) -> dict[str, Array]:
        """Rows of the material that a simulator has."""
        count = KINDS[self.kind].quadratic if self.is_quadratic else len(KINDS[self.kind].rows)
        return {name: self.material[name] for name in KINDS[self.kind].own_rows[:count]}

    @staticmethod
    def of(
        kind: str,
        corners: Index,
        gradients: Array,
        measure: Array,
        *,
        constants: Array | None = None,
        tets: Index | None = None,
        **rows: Array,
    ) -> StencilGroup:
        """Build a group, without constants by default; rows come in the order of the kind."""
        given = np.zeros((len(corners), 0)) if constants is None else constants
        own = {name: rows[name] for name in KINDS[kind].own_rows}
        return StencilGroup(kind, corners, gradients, measure, given, own, tets)


def merge_groups(groups: Iterable[StencilGroup]) -> tuple[StencilGroup, ...]:
    """At most one group per kind, in the order of `KINDS`; stencils of a kind keep the order of the groups."""
    by_kind: dict[str, list[StencilGroup]] = {kind: [] for kind in KINDS}
    for group in groups:
        by_kind[group.kind].append(group)
    return tuple(_joined(kind, own) for kind, own in by_kind.items() if sum(map(len, own)))


def _joined(kind: str, groups: Sequence[StencilGroup]) -> StencilGroup:
    return StencilGroup(
        kind=kind,
        corners=np.concatenate([group.corners for group in groups]),
        gradients=np.concatenate([group.gradients for group in groups]),
        measure=np.concatenate([group.measure for group in groups]),
        constants=np.concatenate([group.constants for group in groups]),
        material={name: np.concatenate([group.material[name] for group in groups]) for name in KINDS[kind].own_rows},
        tets=np.concatenate([group.tets for group in groups if group.tets is not None])
        if KINDS[kind].of_tets
        else None,
    )
