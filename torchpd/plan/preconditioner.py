"""Construction of the multilevel preconditioner from a reference material; its arrays follow those of the plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .. import _C
from ..common.checks import tensor_of
from ..common.tables import DEVICE_PLAN_TABLE, MULTILEVEL_TABLE, PLAN_TABLE, STENCIL_TABLE
from ..ops.diagonal import step_diagonal
from ..scene.scene import SceneValues
from .cpu_plan import Plan, compile_progress, stencil_arrays

__all__ = [
    "ReferenceMaterial",
    "has_outliers",
    "has_preconditioner",
    "precondition_plan",
    "reference_material",
    "stored_reference",
    "without_preconditioner",
]

# Up to this size two dense products are faster than the many short phases of a V-cycle, each of which synchronises all
# blocks. With many environments of one or two blocks each, the V-cycle is faster, except on a mesh of one patch.
MOST_DIRECT = 1024

# Stiffness at rest [elements], of tetrahedra Young's modulus [Pa]; inertia a [V] N/m in the user's order, inf where
# pinned
ReferenceMaterial = tuple[Tensor, Tensor]


def has_preconditioner(plan: Sequence[Tensor]) -> bool:
    """Whether the arrays of a CPU or GPU plan include a multilevel preconditioner."""
    plans = (PLAN_TABLE, PLAN_TABLE + STENCIL_TABLE, DEVICE_PLAN_TABLE)
    return len(plan) - len(MULTILEVEL_TABLE) in map(len, plans)


def stored_reference(plan: Sequence[Tensor]) -> ReferenceMaterial:
    """Reference material that the preconditioner of a plan was built from."""
    levels = dict(zip((row.name for row in MULTILEVEL_TABLE), plan[-len(MULTILEVEL_TABLE) :], strict=True))
    _, vertex_order, *_ = plan
    stored = levels["reference_inertia"]
    return levels["reference_stiffness"], torch.zeros_like(stored).index_copy(0, vertex_order.long(), stored)


def without_preconditioner(plan: Plan) -> Plan:
    """The plan without the arrays of its preconditioner."""
    if not has_preconditioner(plan.arrays):
        return plan
    count = len(MULTILEVEL_TABLE)
    return replace(plan, arrays=plan.arrays[:-count], table=plan.table[:-count])


def reference_material(plan: Plan, material: Sequence[Tensor], time_step: float) -> ReferenceMaterial:
    """Reference material of a preconditioner for all environments: the largest stiffness and inertia of any.

    A vertex counts as pinned where a hard pin holds it in every environment. A uniform scale s costs nothing: M / s is
    exact for an environment whose values are all s times these.
    """
    arrays, material = without_preconditioner(plan).arrays, [array.detach() for array in material]
    stiffness = torch.ops.torchpd.stiffness_at_rest(material, list(arrays), time_step=time_step)
    inertia, _ = step_diagonal(arrays, material, time_step)
    stiffness = stiffness.amax(0) if stiffness.dim() == 2 else stiffness
    if inertia.dim() == 2:
        largest = torch.where(inertia.isinf(), 0.0, inertia).amax(0)
        inertia = torch.where(inertia.isinf().all(0), torch.inf, largest)
    return stiffness, inertia


def has_outliers(plan: Plan, material: Sequence[Tensor], time_step: float) -> bool:
    """Whether springs hold a vertex so much harder than the reference that only the diagonal applies there."""
    former, current = stored_reference(plan.arrays), reference_material(plan, material, time_step)
    elements, inertias = ((new / old)[old.isfinite() & (old > 0.0)] for new, old in zip(current, former, strict=True))
    inertias = inertias[inertias.isfinite()]
    if not len(inertias):
        return False
    # as in csrc/solver/multilevel/material_mismatch.h: a uniform growth of the material is no mismatch
    scale = torch.maximum(elements.max(), inertias.min())
    return bool(inertias.max() > _C.outlier_ratio * scale)


def precondition_plan(
    plan: Plan,
    values: SceneValues,
    stiffness: Tensor,
    inertia: Tensor,
    *,
    most_direct: int | None = None,
    progress: bool = False,
) -> Plan:
    """Add a multilevel approximation of A^-1 to a plan, see csrc/plan/multilevel/build.h.

    Args:
        plan: on any device.
        values: of the scene that the plan was compiled from.
        stiffness: at rest [elements]: Young's modulus of tetrahedra [Pa], then that of stencils kind by kind.
        inertia: a of each vertex [V] N/m in the user's order, inf where pinned.
        most_direct: largest number of vertices for which M is A^-1, without levels. None: 0 on the CPU; `MOST_DIRECT`
            on a GPU, but 0 for many environments of a mesh of several patches.
        progress: show a bar when the mesh is large.
    """
    plan = without_preconditioner(plan)
    order = plan.vertex_order.cpu().numpy()
    if most_direct is None:
        cycles = plan.kernel is None or (plan.many and plan.patches > 1)
        most_direct = 0 if cycles else MOST_DIRECT

    def rounded(values: Tensor) -> NDArray[np.float64]:
        """Convert to the precision of the plan, which decides the bits."""
        return np.asarray(values.detach().to("cpu", plan.dtype).double().numpy())

    with compile_progress(len(values.tets), progress) as advance:
        arrays: dict[str, NDArray[Any]] = _C.build_multilevel(
            values.rest_positions, values.tets, stencil_arrays(values), order, rounded(stiffness), rounded(inertia),
            most_direct, plan.kernel is not None, torch.get_num_threads(), advance,
        )  # fmt: skip
    if plan.kernel is not None:
        arrays["coarse_columns"] = _by_columns(arrays["coarse_factor"])
        arrays |= _list_pieces(plan, values, arrays)
    else:
        arrays |= _pack_tets(plan, arrays)
    levels = (
        tensor_of(arrays[row.name]).to(
            # `sizes` stay on the host, which must not wait for a device
            device=None if row.rows.endswith("size") else plan.device,
            dtype=plan.dtype if row.type == "real" else None,
        )
        for row in MULTILEVEL_TABLE
    )
    return replace(plan, arrays=(*plan.arrays, *levels), table=plan.table + MULTILEVEL_TABLE)


def _by_columns(packed: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rearrange a lower triangle from row-major to column-major order."""
    size = int(np.sqrt(2 * len(packed)))
    column, row = np.triu_indices(size)
    return np.asarray(packed[row * (row + 1) // 2 + column])


_LANES = 16  # of a pack, as in csrc/views/multilevel.def
# places in level_sizes, as in csrc/views/views.h
_PIECES, _PACKS, _LISTS = 7, 8, slice(9, 13)
_PAIR_LANES = 32  # as in csrc/views/gpu_plan.def


def _list_pieces(plan: Plan, values: SceneValues, arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Rows of A and tetrahedra by pairs of pieces, for a GPU; tetrahedra by their places in the plan."""
    tets = plan.pair_tet.cpu().numpy().reshape(-1, 2, _PAIR_LANES).swapaxes(1, 2).reshape(-1)
    place = np.flatnonzero(tets >= 0).astype(np.int32)
    internal = np.empty(len(plan.vertex_order), np.int32)
    internal[plan.vertex_order.cpu().numpy()] = np.arange(len(internal), dtype=np.int32)
    lists = _C.list_pieces(
        int(arrays["level_sizes"][_PIECES]), arrays["piece_of"], arrays["piece_weight"], arrays["fine_start"],
        arrays["fine_column"], internal[values.tets[tets[place]]],
    )  # fmt: skip
    blocks = np.diff(plan.patch_block.cpu().numpy())
    patch = np.repeat(np.arange(len(blocks), dtype=np.int32), blocks)
    found = place[lists["piece_tet"]]
    lists["piece_tet"] = np.stack([found, patch[found // (2 * _PAIR_LANES)]], axis=1)
    sizes = arrays["level_sizes"].copy()
    sizes[_LISTS] = [len(lists[name]) for name in ("piece_row_task", "piece_row", "piece_tet_task", "piece_tet")]
    return {**lists, "level_sizes": sizes}


def _pack_tets(plan: Plan, arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Packs of the tetrahedra that pieces move, patch by patch, those that the same pieces move together."""
    of, weight = (arrays[name].reshape(-1, 4) for name in ("piece_of", "piece_weight"))
    moved = np.bitwise_or.reduce(np.where(weight > 0.0, np.uint64(1) << of.astype(np.uint64), np.uint64(0)), axis=1)
    blocks = plan.patch_block.numpy()
    patch = np.repeat(np.arange(len(blocks) - 1), np.diff(blocks))
    slots = plan.tet_corner.numpy().reshape(-1, 4, _LANES) + plan.patch_slot.numpy()[patch, None, None]
    pieces = np.bitwise_or.reduce(moved[plan.slot_vertex.numpy()[slots]], axis=1).reshape(-1)
    place = np.flatnonzero((pieces != 0) & (plan.tet_volume.numpy().reshape(-1) > 0.0))
    place = place[np.lexsort((place, pieces[place], patch[place // _LANES]))]
    own = patch[place // _LANES]
    counts = np.bincount(own, minlength=len(blocks) - 1)
    packs = -(-counts // _LANES)
    first = _LANES * (np.cumsum(packs) - packs)
    tets = np.full(_LANES * int(packs.sum()), -1, np.int32)
    tets[first[own] + np.arange(len(own)) - (np.cumsum(counts) - counts)[own]] = place
    sizes = arrays["level_sizes"].copy()
    sizes[_PACKS] = packs.sum()
    patches = np.repeat(np.arange(len(packs), dtype=np.int32), packs)
    return {"level_sizes": sizes, "piece_pack_patch": patches, "piece_pack_tet": tets.reshape(-1, _LANES)}
