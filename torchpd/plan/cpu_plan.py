"""The plan of a scene: its constant arrays (order, partition, weights), compiled once into flat tensors."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm.auto import tqdm

from .. import _C
from ..common.checks import tensor_of
from ..common.tables import DEVICE_PLAN_TABLE, DEVICE_SIZES, KINDS, PLAN_TABLE, ROW_SIZES, STENCIL_TABLE, PlanRow
from ..scene.scene import SceneValues

__all__ = [
    "KERNELS",
    "Plan",
    "compile_plan",
    "compile_progress",
    "internal_numbers",
    "kernel_of",
    "loose_pieces",
    "quoted_choices",
    "stencil_arrays",
    "with_loose_components",
]

Index = NDArray[np.int64]
Reals = NDArray[np.float64]

_WORTH_A_BAR = 200_000  # tetrahedra from which a progress bar is shown
# in the order of their numbers in the `sizes` of a GPU plan
KERNELS = ("block", "cluster", "grid", "stream")
_SIZE_COMPONENTS, _SIZE_SOLID = 3, 10  # places in PlanSize of csrc/views/views.h


def kernel_of(arrays: Sequence[Tensor]) -> str:
    """Name of the kernel that the arrays of a GPU plan were compiled for."""
    sizes, *_ = arrays
    return KERNELS[int(sizes[DEVICE_SIZES.index("kernel")])]


@dataclass(frozen=True, eq=False)
class Plan:
    """The constant arrays of a scene, in the order of a C++ table and by name, as in `plan.vertex_order`.

    The CPU and the GPU have a table each. The arrays of a multilevel preconditioner, if present, follow at the end.

    Args:
        arrays: the tensors, one for each row of `table`.
        table: the rows that C++ declares.
        why: reason for the choice of the GPU kernel, shown to the user.
        for_multilevel: whether the patches were sized for a multilevel solver.
        many: whether they were sized for so many environments that each has few multiprocessors.
        loose: [components] whether a step may move a connected component rigidly (hard pins prevent it); None: unknown.
    """

    arrays: tuple[Tensor, ...]
    table: tuple[PlanRow, ...] = PLAN_TABLE
    why: str = ""
    for_multilevel: bool = False
    many: bool = False
    loose: NDArray[np.bool_] | None = None

    def __getattr__(self, name: str) -> Tensor:
        for number, row in enumerate(self.table):
            if row.name == name:
                return self.arrays[number]
        names = ", ".join(row.name for row in self.table)
        raise AttributeError(f"Plan has no array {name!r}; it has {names}")

    def __repr__(self) -> str:
        kernel = "" if self.kernel is None else f", kernel {self.kernel}"
        sizes = f"{self.vertices} vertices, {self.patches} patches{kernel}, {self.bytes:,} B"
        return f"Plan({sizes}, {str(self.dtype).removeprefix('torch.')}, {self.device})"

    @property
    def kernel(self) -> str | None:
        """Name of the GPU kernel that the plan is for: "block", "cluster", "grid" or "stream"; None on the CPU."""
        return kernel_of(self.arrays) if self.table[: len(DEVICE_PLAN_TABLE)] == DEVICE_PLAN_TABLE else None

    def size(self, name: str) -> int:
        """A size of a GPU plan by its name in DEVICE_SIZES."""
        return int(self.sizes[DEVICE_SIZES.index(name)])

    @property
    def step_entries(self) -> int:
        """Most entries of forces in a patch of a GPU plan in a step, padding included."""
        if not any(row.name == "row_sizes" for row in self.table):
            return self.size("most_entries")
        rows = self.row_sizes
        return int(rows[ROW_SIZES["step_entries"]]) if rows[ROW_SIZES["blocks"]] else self.size("most_entries")

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the real arrays."""
        return next(array.dtype for array in self.arrays if array.is_floating_point())

    @property
    def device(self) -> torch.device:
        """Device of the arrays."""
        return self.vertex_order.device

    @property
    def vertices(self) -> int:
        """Number of vertices of all bodies."""
        return len(self.vertex_order)

    @property
    def patches(self) -> int:
        """Number of mesh patches. The CPU processes one at a time; a GPU has a thread block for each."""
        return len(self.patch_block) - 1

    @property
    def bytes(self) -> int:
        """Memory of all arrays in bytes."""
        return sum(array.numel() * array.element_size() for array in self.arrays)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Plan:
        """Copy the plan to another device or, on the CPU, to another precision.

        The CPU and the GPU need different plans: `Simulator.to` compiles the right one. Widening to float64 does not
        restore lost digits. `sizes` stay on the CPU, so that the host reads them without waiting for the device.

        Raises:
            ValueError: another precision for a GPU plan.
        """
        if self.kernel is not None and dtype not in (None, self.dtype):
            raise ValueError(
                f"Plan.to: dtype must be {self.dtype} for a GPU plan, got {dtype}; sim.to({dtype}) compiles the plan "
                "again"
            )

        def moved(row: PlanRow, array: Tensor) -> Tensor:
            if row.rows.endswith("size"):
                return array
            return array.to(device=device, dtype=dtype if array.is_floating_point() else None)

        return replace(self, arrays=tuple(map(moved, self.table, self.arrays)))


@contextmanager
def compile_progress(tets: int, progress: bool) -> Iterator[Callable[[float], None]]:
    """Show a progress bar for a large mesh; yields a callback that takes the fraction done."""
    with tqdm(total=100, desc="compiling the scene", leave=False, disable=not progress or tets < _WORTH_A_BAR) as bar:
        yield lambda done: _advance(bar, done)


def _advance(bar: tqdm[Any], done: float) -> None:
    bar.update(int(100 * done) - bar.n)


def _patch_size(tets: int) -> int:
    """Elements per patch: small enough for the cache, in a patch count that two or four threads share evenly.

    Larger patches share fewer vertices: 1.6 slots per vertex at 1024 tetrahedra, 1.4 at 2048.
    """
    patches = max(1, -(-tets // 2048))
    patches = -(-patches // 4) * 4 if tets >= 1024 else min(2, max(1, tets // 256))
    return max(16, -(-tets // patches))


def quoted_choices(names: Sequence[str]) -> str:
    """Join names into a choice for an error message: "block", "grid" or "stream"."""
    *before, last = (f'"{name}"' for name in names)
    return f"{', '.join(before)} or {last}" if before else last


def loose_pieces(values: SceneValues) -> tuple[NDArray[np.int32], int, int]:
    """Number of the rigidly moving component of each vertex [V] (-1: none), their count, and how many are solid.

    Solid ones come first.
    """
    number = np.full(len(values.loose), -1)
    order = np.concatenate([np.flatnonzero(values.loose & solid) for solid in (values.solid, ~values.solid)])
    number[order] = np.arange(len(order))
    return number[values.component].astype(np.int32), len(order), int((values.loose & values.solid).sum())


def with_loose_components(plan: Plan, values: SceneValues) -> Plan:
    """Copy of a CPU plan for another set of components that a step may move rigidly."""
    if plan.kernel is not None:
        raise ValueError("with_loose_components: plan must be a CPU plan, got a GPU plan; compile it again")
    group, *counts = loose_pieces(values)
    sizes = plan.sizes.clone()
    sizes[_SIZE_COMPONENTS], sizes[_SIZE_SOLID] = counts
    new = {"vertex_component": tensor_of(group)[plan.vertex_order.long()], "sizes": sizes}
    arrays = tuple(new.get(row.name, array) for row, array in zip(plan.table, plan.arrays, strict=True))
    return replace(plan, arrays=arrays, loose=values.loose)


def _sizes(arrays: dict[str, NDArray[Any]], tets: int, components: int, solid: int, members: Any) -> NDArray[np.int32]:
    """Counts of a CPU plan, in the order of PlanSize in csrc/views/views.h."""
    slots = np.diff(arrays["patch_slot"])
    counts = (
        len(arrays["vertex_order"]), tets, len(arrays["pin_vertex"]), components, len(arrays["tet_order"]),
        len(slots), len(arrays["slot_vertex"]), len(arrays["shared_start"]) - 1, slots.max(), members, solid,
    )  # fmt: skip
    return np.array(counts, dtype=np.int32)


def internal_numbers(vertex_order: NDArray[np.int32]) -> NDArray[np.int32]:
    """Internal number of each vertex in the user's order [V]."""
    internal = np.empty_like(vertex_order)
    internal[vertex_order] = np.arange(len(vertex_order), dtype=vertex_order.dtype)
    return internal


def stencil_arrays(values: SceneValues) -> list[tuple[int, Index, Reals, Reals, Reals, Index | None, bool]]:
    """Stencils of a scene as C++ takes them.

    Number of the kind, corners, g_a, measures, constants, tetrahedra, and whether the energy is quadratic.
    """
    return [
        (
            list(KINDS).index(group.kind), group.corners, group.gradients, group.measure, group.constants, group.tets,
            group.is_quadratic,
        )
        for group in values.stencils
    ]  # fmt: skip


def compile_plan(
    values: SceneValues, *, dtype: torch.dtype = torch.float32, patch_size: int | None = None, progress: bool = True
) -> Plan:
    """Order, partition and weight a scene for the CPU kernels. `Plan.to` moves the result.

    Args:
        values: the flat arrays of `Scene.values`.
        dtype: torch.float32 or torch.float64.
        patch_size: elements per patch, 16 to 8192; None chooses by mesh size.
        progress: show a bar when the mesh is large.
    """
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(f"dtype must be torch.float32 or torch.float64, got {dtype!r}")
    tets = len(values.tets)
    elements = tets + sum(len(group) for group in values.stencils)
    stencils = stencil_arrays(values)
    with compile_progress(elements, progress) as advance:
        arrays: dict[str, NDArray[Any]] = _C.build_plan(
            values.rest_positions, values.tets, stencils, values.tet_group, patch_size or _patch_size(elements), advance
        )
    members = arrays.pop("members")
    internal = internal_numbers(arrays["vertex_order"])
    group, components, solid = loose_pieces(values)
    arrays["vertex_component"] = group[arrays["vertex_order"]]
    arrays["pin_vertex"] = internal[values.pin_vertices].astype(np.int32)
    arrays["sizes"] = _sizes(arrays, tets, components, solid, members)
    table = PLAN_TABLE + STENCIL_TABLE if stencils else PLAN_TABLE
    tensors = (tensor_of(arrays[row.name]) for row in table)
    reals = tuple(t.to(dtype) if t.is_floating_point() else t for t in tensors)
    return Plan(reals, table=table, loose=values.loose)
