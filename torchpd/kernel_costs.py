"""About how long an iteration of a step takes with each kernel of a GPU, whatever the number of environments.

Fitted to steps of 64 iterations on an H100, a share of what a step costs beside them included: Chebyshev with the
guard, regular bars of 64 to 38,125 vertices in batches of 1 to 8192, by `benchmarks/kernels_by_batch.py`, which shows
what it measures beside these. What matters is which kernel takes least, so other GPUs need only be alike in proportion.
"""

from __future__ import annotations

from typing import NamedTuple

import torch

from . import _C
from .gpu import Properties
from .plan import Plan

__all__ = [
    "block_microseconds",
    "clusters_together",
    "grid_microseconds",
    "iteration_microseconds",
    "stream_microseconds",
]


class _Fit(NamedTuple):
    """Microseconds of an iteration, and microseconds that each tetrahedron adds."""

    small_block: tuple[float, float]  # alone, a block waits: of a mesh so small that many may share one
    block: tuple[float, float]  # of others
    full_block: tuple[float, float]  # many are issued by one multiprocessor
    cluster: tuple[float, float]  # of one that runs with others, whatever the patches
    grid: tuple[float, float]  # of a patch
    least_grid: float  # an exchange takes so long
    stream: tuple[float, float]  # of all environments


_FITS = {
    torch.float32: _Fit((1.2, 1.0e-3), (1.5, 1.5e-3), (0.5, 2.0e-3), (1.1, 1.3e-4), (1.7, 2.0e-3), 1.9, (7.0, 1.75e-5)),
    torch.float64: _Fit((2.0, 4.7e-3), (2.0, 4.7e-3), (0.5, 6.4e-3), (1.5, 6.0e-4), (1.5, 7.2e-3), 2.8, (8.0, 7.4e-5)),
}
_MEASURED_ON = 132  # multiprocessors
_SMALL_TETS = 2 * _C.most_sharing_pairs  # where all have partners
# registers of a multiprocessor, and of a thread of a cluster (benchmarks/results/cuda-registers.csv)
_REGISTERS, _CLUSTER_REGISTERS = 65536, {torch.float32: 168, torch.float64: 256}
# multiprocessors that blocks of a cluster are neighbours in, and the share of a GPU that has as many together
_NEIGHBOURS, _SHARE = 16, 7 / 8


def _line(fit: tuple[float, float], tets: float) -> float:
    return fit[0] + fit[1] * tets


def clusters_together(plan: Plan, gpu: Properties) -> int:
    """Environments that run at a time with a plan for "cluster"."""
    real = torch.finfo(plan.dtype).bits // 8
    threads = _C.cluster_threads(real, plan.size("most_pairs"), plan.size("most_interior"))
    each = max(1, _REGISTERS // (threads * _CLUSTER_REGISTERS[plan.dtype]))
    if plan.patches <= 2:  # neighbours are everywhere
        return max(1, each * gpu.multiprocessors // plan.patches)
    groups = int(_SHARE * gpu.multiprocessors / _NEIGHBOURS)
    return max(1, groups * (each * _NEIGHBOURS // plan.patches))


def block_microseconds(tets: int, batch: int, dtype: torch.dtype, gpu: Properties) -> float:
    """With a block an environment, or several small ones."""
    each = -(-batch // gpu.multiprocessors)
    fit = _FITS[dtype]
    alone = fit.small_block if tets <= _SMALL_TETS else fit.block
    return max(_line(alone, tets), _line(fit.full_block, each * tets))


def grid_microseconds(tets: int, patches: int, batch: int, dtype: torch.dtype, gpu: Properties) -> float:
    """With a block a patch; as many environments at a time as leave every block a multiprocessor.

    Very small patches share one, and take less than this where there are many; then another kernel takes less still.
    """
    turns = -(-batch // max(1, gpu.multiprocessors // patches))
    return turns * max(_FITS[dtype].least_grid, _line(_FITS[dtype].grid, tets / patches))


def stream_microseconds(tets: int, batch: int, dtype: torch.dtype, gpu: Properties) -> float:
    """With launches for every iteration."""
    return _line(_FITS[dtype].stream, _MEASURED_ON / gpu.multiprocessors * tets * batch)


def iteration_microseconds(
    plan: Plan, tets: int, batch: int, gpu: Properties, dtype: torch.dtype | None = None
) -> float:
    """Of an iteration of the whole batch, with the kernel that a plan is for.

    Args:
        plan: of a GPU.
        tets: tetrahedra of an environment; the plan counts those of neighbouring patches twice.
        batch: environments of a step.
        gpu: what the device has.
        dtype: precision to take instead of the plan's.
    """
    dtype = plan.dtype if dtype is None else dtype
    if plan.kernel == "block":
        return block_microseconds(tets, batch, dtype, gpu)
    if plan.kernel == "cluster":
        return -(-batch // clusters_together(plan, gpu)) * _line(_FITS[dtype].cluster, tets)
    if plan.kernel == "grid":
        return grid_microseconds(tets, plan.patches, batch, dtype, gpu)
    return stream_microseconds(tets, batch, dtype, gpu)
