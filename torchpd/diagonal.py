"""Inertia and diagonal of every vertex, in plain torch: for estimates and preconditioners, not for the step itself."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .tables import MATERIAL_TABLE, PLAN_TABLE

__all__ = ["named_material", "named_plan", "pinned_vertices", "step_diagonal"]


def named_plan(arrays: Sequence[Tensor]) -> dict[str, Tensor]:
    """The plan's arrays by name."""
    return {row.name: array for row, array in zip(PLAN_TABLE, arrays, strict=True)}


def named_material(arrays: Sequence[Tensor]) -> dict[str, Tensor]:
    """The material's arrays by name."""
    return {row.name: array for row, array in zip(MATERIAL_TABLE, arrays, strict=True)}


def pinned_vertices(plan: dict[str, Tensor]) -> Tensor:
    """User's number of each pinned vertex [P]."""
    return plan["vertex_order"][plan["pin_vertex"].long()].long()


def _corner_vertices(plan: dict[str, Tensor]) -> Tensor:
    """User's number of the corners of every element in plan order, padding counted [16 blocks, 4]."""
    blocks = plan["patch_block"].diff().long()
    first_slot = plan["patch_slot"][:-1].repeat_interleave(blocks, output_size=len(plan["tet_corner"]))
    slots = plan["tet_corner"].unflatten(1, (4, 16)).transpose(1, 2).int() + first_slot[:, None, None]
    return plan["vertex_order"][plan["slot_vertex"][slots.flatten(0, 1).long()].long()].long()


def step_diagonal(
    plan_arrays: Sequence[Tensor], material_arrays: Sequence[Tensor], time_step: float, *, weighted: bool = True
) -> tuple[Tensor, Tensor]:
    """Inertia a and diagonal D of every vertex, [V] or [B, V], in N/m; infinite on hard pins.

    a_i = m_i / h^2 (1 + damping h) + k_i;  D_i = a_i + sum_e l_e w_e V_e |grad N_i|^2, l_e = 1 when not weighted.
    """
    plan, material = named_plan(plan_arrays), named_material(material_arrays)
    rest = plan["tet_rest"].unflatten(1, (3, 3, 16)).permute(0, 3, 1, 2).flatten(0, 1)
    slopes = torch.cat([-rest.sum(1, keepdim=True), rest], dim=1).square().sum(-1)
    volume = plan["tet_volume"].reshape(-1) * (plan["tet_bound"].reshape(-1) if weighted else 1.0)
    stiffness = material["stiffness"][..., plan["tet_order"].reshape(-1).long()]
    share = (stiffness * volume).unsqueeze(-1) * slopes

    masses, springs = material["masses"], material["pin_stiffness"]
    held = masses.new_zeros((*springs.shape[:-1], masses.shape[-1]))
    held = held.index_copy(-1, pinned_vertices(plan), springs)
    inertia = masses / time_step**2 * (1 + material["damping"].unsqueeze(-1) * time_step) + held
    elastic = masses.new_zeros((*share.shape[:-2], masses.shape[-1]))
    elastic = elastic.index_add(-1, _corner_vertices(plan).flatten(), share.flatten(-2))
    return inertia, inertia + elastic
