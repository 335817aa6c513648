"""Stencils: elements of up to five vertices, as flat arrays by kind.

A stencil has n vertices with constant vectors g_a in R^d that add up to zero. Its deformation is F = sum_a x_a g_a^T
[3, d], and its energy V psi(F; parameters). The tetrahedra of solids have arrays of their own.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..common.tables import KINDS

__all__ = ["KINDS", "StencilGroup", "merge_groups"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class StencilGroup:
    """Stencils of one kind.

    | kind | F | V | psi |
    |---|---|---|---|
    | triangle | deformation gradient from the rest plane | rest area [m^2] | membrane, Y = youngs thickness |
    | hinge | curvature vector [1/m] | area of both triangles [m^2], or length of a rod [m] | kb/2 (abs(F) - k0)^2 |
    | spring | x1 - x0 [m] | 1 | k/2 (abs(F) - L)^2 |
    | tie | x0 - sum b_a x_a [m] | 1 | k/2 abs(F)^2 |
    | fibre | F f of its tetrahedron | volume, without empty parts [m^3] | w/2 (abs(F) - L)^2 |
    | thread | F f of its triangle | rest area [m^2] | w/2 (abs(F) - 1)^2 |
    """

    kind: str
    corners: Index  # [N, n] vertices of the scene; one with g_a = 0 may repeat another
    gradients: Array  # [N, n, d] g_a; the rows of a stencil add up to zero
    measure: Array  # [N] V
    constants: Array  # [N, c]; of a fibre: 1 if it has no energy for abs(F) < L, else 0
    material: dict[str, Array]  # trainable rows by name, [N] or [N, width]

    def __len__(self) -> int:
        return len(self.corners)

    @staticmethod
    def of(
        kind: str, corners: Index, gradients: Array, measure: Array, *, constants: Array | None = None, **rows: Array
    ) -> StencilGroup:
        """Build a group, without constants by default; rows come in the order of the kind."""
        given = np.zeros((len(corners), 0)) if constants is None else constants
        return StencilGroup(kind, corners, gradients, measure, given, {name: rows[name] for name in KINDS[kind].rows})


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
        material={name: np.concatenate([group.material[name] for group in groups]) for name in KINDS[kind].rows},
    )
