"""Types of the compiled module; csrc/module.cpp implements it."""

from collections.abc import Callable
from typing import Any

from numpy import float64, int32, int64
from numpy.typing import NDArray

def build_plan(
    positions: NDArray[float64], tets: NDArray[int64], patch_size: int, progress: Callable[[float], None]
) -> dict[str, NDArray[Any]]: ...
def build_device_plan(
    positions: NDArray[float64],
    tets: NDArray[int64],
    patches: int,
    kernel: int,
    fixed: bool,
    piece: NDArray[int32],
    progress: Callable[[float], None],
) -> dict[str, NDArray[Any]]: ...
def build_multilevel(
    positions: NDArray[float64],
    tets: NDArray[int64],
    vertex_order: NDArray[int32],
    stiffness: NDArray[float64],
    inertia: NDArray[float64],
    threads: int,
    progress: Callable[[float], None],
) -> dict[str, NDArray[Any]]: ...
def plan_table() -> list[tuple[str, str, int, str, str]]: ...
def multilevel_table() -> list[tuple[str, str, int, str, str]]: ...
def device_plan_table() -> list[tuple[str, str, int, str, str]]: ...
def device_sizes() -> list[str]: ...
def material_table() -> list[tuple[str, int, str, str]]: ...
def fused_shared_bytes(real: int, many: bool, slots: int, entries: int, planes: int, balls: int) -> int: ...
def cluster_shared_bytes(real: int, fused_bytes: int, slots: int, seats: int, patches: int) -> int: ...

most_cluster_blocks: int
outer_static_bytes: int
pass_static_bytes: int

def pass_shared_bytes(real: int, slots: int, entries: int, fields: int) -> int: ...
def build_info() -> dict[str, Any]: ...
def multiply_adds_per_second() -> float: ...
