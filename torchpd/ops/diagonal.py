"""Inertia and diagonal of every vertex, for estimates and preconditioners; a step computes its own."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..common.tables import EFFECT_ROWS, MATERIAL_TABLE, MaterialRow

__all__ = [
    "CORE_COUNT",
    "STIFFNESS_PLACE",
    "elastic_material",
    "elastic_rows",
    "has_damping",
    "named_material",
    "pinned_vertices",
    "step_diagonal",
    "step_inertia",
]

STIFFNESS_PLACE = [row.name for row in MATERIAL_TABLE].index("stiffness")
CORE_COUNT = len(MATERIAL_TABLE) - len(EFFECT_ROWS)  # arrays that every scene has


def named_material(arrays: Sequence[Tensor]) -> dict[str, Tensor]:
    """Material arrays by name: those of every scene, or all of the table."""
    rows = MATERIAL_TABLE[: len(arrays)]
    return {row.name: array for row, array in zip(rows, arrays, strict=True)}


def elastic_material(material: Sequence[Tensor]) -> list[Tensor]:
    """Material for the ops of the elastic energy, which read and keep the stiffness and the effects alone."""
    stiffness = named_material(material)["stiffness"]
    unread = torch.empty(0, dtype=stiffness.dtype, device=stiffness.device)
    rows = MATERIAL_TABLE[: len(material)]
    return [
        array if row.effect or row.name == "stiffness" else unread for row, array in zip(rows, material, strict=True)
    ]


def elastic_rows(material: Sequence[Tensor]) -> list[tuple[MaterialRow, Tensor]]:
    """Arrays of the material that the elastic energy depends on, with their rows of the table."""
    rows = MATERIAL_TABLE[: len(material)]
    pairs = zip(rows, material, strict=True)
    return [(row, array) for row, array in pairs if row.name == "stiffness" or row.effect]


def has_damping(material: Sequence[Tensor]) -> bool:
    """Whether a material has stiffness-proportional damping."""
    damping = named_material(material).get("stiffness_damping")
    return damping is not None and damping.shape[-1] > 0


def pinned_vertices(plan: Sequence[Tensor]) -> Tensor:
    """Number of each pinned vertex in the user's order [P]."""
    _, vertex_order, pin_vertex, *_ = plan
    return vertex_order[pin_vertex.long()].long()


def step_inertia(plan: Sequence[Tensor], material_arrays: Sequence[Tensor], time_step: float) -> Tensor:
    """Inertia a_i = m_i / h^2 (1 + damping h) + k_i of every vertex, [V] or [B, V], in N/m; inf at hard pins."""
    material = named_material(material_arrays)
    masses, springs = material["masses"], material["pin_stiffness"]
    held = masses.new_zeros((*springs.shape[:-1], masses.shape[-1]))
    held = held.index_copy(-1, pinned_vertices(plan), springs)
    return masses / time_step**2 * (1 + material["damping"].unsqueeze(-1) * time_step) + held


def step_diagonal(
    plan: Sequence[Tensor], material_arrays: Sequence[Tensor], time_step: float, *, weighted: bool = True
) -> tuple[Tensor, Tensor]:
    """Inertia a and diagonal D of every vertex, [V] or [B, V], in N/m; inf at hard pins.

    D_i = a_i + sum_e l_e w_e V_e |grad N_i|^2, l_e = 1 when not weighted. With Poisson's ratio 2 mu l_e + 4 lambda
    takes the place of l_e w_e, and 2 mu + lambda that of w_e. Other elements add theirs, damping 2 mu beta / h l_e.
    """
    inertia = step_inertia(plan, material_arrays, time_step)
    return inertia, inertia + torch.ops.torchpd.elastic_diagonal(
        list(material_arrays), list(plan), weighted=weighted, time_step=time_step
    )
