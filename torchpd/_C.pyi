"""Types of the compiled module; csrc/binding/module.cpp implements it."""

from collections.abc import Callable
from typing import Any

from numpy import float64, int32, int64
from numpy.typing import NDArray

Stencils = list[
    tuple[int, NDArray[int64], NDArray[float64], NDArray[float64], NDArray[float64], NDArray[int64] | None, bool]
]

def build_plan(
    positions: NDArray[float64],
    tets: NDArray[int64],
    stencils: Stencils,
    tet_group: NDArray[int64] | None,
    patch_size: int,
    progress: Callable[[float], None],
) -> dict[str, Any]: ...
def build_device_plan(
    positions: NDArray[float64],
    tets: NDArray[int64],
    stencils: Stencils,
    patches: int,
    kernel: int,
    fixed: bool,
    piece: NDArray[int32],
    progress: Callable[[float], None],
    tet_group: NDArray[int64] | None = None,
) -> dict[str, NDArray[Any]]: ...
def build_multilevel(
    positions: NDArray[float64],
    tets: NDArray[int64],
    stencils: Stencils,
    vertex_order: NDArray[int32],
    stiffness: NDArray[float64],
    inertia: NDArray[float64],
    most_direct: int,
    folded: bool,
    threads: int,
    progress: Callable[[float], None],
) -> dict[str, NDArray[Any]]: ...
def list_pieces(
    pieces: int,
    piece_of: NDArray[int32],
    piece_weight: NDArray[float64],
    fine_start: NDArray[int32],
    fine_column: NDArray[int32],
    corners: NDArray[int32],
) -> dict[str, NDArray[int32]]: ...
def plan_table() -> list[tuple[str, str, int, str, str]]: ...
def stencil_table() -> list[tuple[str, str, int, str, str]]: ...
def kind_table() -> list[tuple[str, int, int, int, tuple[str, ...], str, int, bool]]: ...
def row_sizes() -> dict[str, int]: ...
def multilevel_table() -> list[tuple[str, str, int, str, str]]: ...
def device_plan_table() -> list[tuple[str, str, int, str, str]]: ...
def device_stencil_table() -> list[tuple[str, str, int, str, str]]: ...
def device_sizes() -> list[str]: ...
def material_table() -> list[tuple[str, int, str, str, bool, bool]]: ...
def material_columns() -> list[tuple[str, str, int, int, str]]: ...
def settings_table() -> list[tuple[str, str, float, str, str]]: ...
def fused_shared_bytes(real: int, many: bool, slots: int, entries: int, planes: int, spheres: int) -> int: ...
def cluster_shared_bytes(real: int, slots: int, entries: int, interior: int, planes: int, spheres: int) -> int: ...
def fits_cluster(real: int, pairs: int, interior: int) -> bool: ...
def cluster_threads(real: int, pairs: int, interior: int) -> int: ...

most_cluster_blocks: int

def largest_cluster() -> int: ...
def step_bytes(
    real: int,
    sizes: NDArray[int32],
    level_sizes: NDArray[int32],
    stencil_sizes: NDArray[int32],
    row_sizes: NDArray[int32],
    schedule: int,
    batch: int,
    planes: int,
    spheres: int,
    own_stiffness: bool,
    own_effects: bool,
) -> int: ...

info_numbers: int
slide_vectors: int
outer_static_bytes: int
pieces_bytes: int
outlier_ratio: float
adjoint_tolerance: tuple[float, float]
adjoint_failed: float
adjoint_iterations: int
pass_static_bytes: int
most_environments: int
most_sharing_pairs: int

def pass_shared_bytes(real: int, slots: int, entries: int, fields: int) -> int: ...
def outer_shared_bytes(real: int, slots: int, entries: int) -> int: ...
def build_info() -> dict[str, Any]: ...
def multiply_adds_per_second() -> float: ...
