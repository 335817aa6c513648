"""Compilation of the GPU plan: the constant arrays of a scene in the layout of the GPU kernels."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .. import _C
from ..common.checks import tensor_of
from ..common.tables import DEVICE_PLAN_TABLE, DEVICE_SIZES, DEVICE_STENCIL_TABLE, PlanRow
from ..scene.scene import SceneValues
from .cpu_plan import KERNELS, compile_progress, internal_numbers, loose_pieces, stencil_arrays

__all__ = ["compile_device_plan", "device_table"]

_SIZE_PINS, _SIZE_SOLID = DEVICE_SIZES.index("pins"), DEVICE_SIZES.index("solid_pieces")


def device_table(values: SceneValues) -> tuple[PlanRow, ...]:
    """Rows of the arrays of a scene's GPU plan."""
    return DEVICE_PLAN_TABLE + DEVICE_STENCIL_TABLE if values.stencils else DEVICE_PLAN_TABLE


def compile_device_plan(
    values: SceneValues, patches: int, kernel: int, dtype: torch.dtype, progress: bool = True
) -> tuple[Tensor, ...]:
    """Order, partition and weight a scene for the GPU kernels.

    Args:
        values: the flat arrays of `Scene.values`.
        patches: number of mesh patches, one thread block each: 1 to the number of elements. A cluster takes at most
            16 and at most the number of vertices. Indices in a patch have 16 bits, so about 20 000 tetrahedra need a
            second patch.
        kernel: 0 (block), 1 (cluster), 2 (grid) or 3 (stream), the index into `KERNELS`; 0 or 3 with stencils.
        dtype: torch.float32 or torch.float64.
        progress: show a bar when the mesh is large.

    Returns:
        The arrays of csrc/views/gpu_plan.def in its order, then, with stencils, of gpu_stencils.def and
        gpu_step_rows.def, on the CPU.
    """
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(f"dtype must be torch.float32 or torch.float64, got {dtype}")
    if kernel not in range(len(KERNELS)):
        raise ValueError(f"kernel must be 0, 1, 2 or 3, got {kernel}")
    piece, _, solid = loose_pieces(values)
    elements = len(values.tets) + sum(len(group) for group in values.stencils)
    with compile_progress(elements, progress) as advance:
        arrays: dict[str, NDArray[Any]] = _C.build_device_plan(
            values.rest_positions, values.tets, stencil_arrays(values), patches, kernel, dtype == torch.float32, piece,
            advance, values.tet_group,
        )  # fmt: skip
    pins = len(values.pin_vertices)
    arrays["sizes"][_SIZE_PINS] = pins
    arrays["sizes"][_SIZE_SOLID] = solid
    if pins:
        arrays["pin_vertex"] = internal_numbers(arrays["vertex_order"])[values.pin_vertices]
        arrays["vertex_pin"] = np.full(len(values.rest_positions), -1, dtype=np.int32)
        arrays["vertex_pin"][arrays["pin_vertex"]] = np.arange(pins)
    tensors = (tensor_of(arrays[row.name]) for row in device_table(values))
    return tuple(t.to(dtype) if t.is_floating_point() else t for t in tensors)
