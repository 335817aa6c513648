"""About how long an iteration takes with each kernel of a GPU, from seven numbers: the rule behind `kernel="auto"`.

    time = turns (latency + rate tets),   tets: those of one environment on its busiest multiprocessor

A multiprocessor takes `rate` microseconds for a tetrahedron, whatever the kernel; a kernel adds its latency, and what
does not run at once takes turns. The numbers are rounded from Chebyshev steps on an H100, 64 to 38,125 vertices
(`benchmarks/kernels_by_batch.py`): in 218 batches the kernel with the least time here takes at most 1.02 times as long
as the quickest. The times themselves are within a third of the measured ones in float32, within 1.8 times in float64.
Only the order of the kernels matters, so that other GPUs need only be alike in proportion.
"""

from __future__ import annotations

import torch

from .. import _C
from ..common.gpu import Properties
from .cpu_plan import Plan

__all__ = ["clusters_together", "iteration_microseconds", "kernel_microseconds"]

_LATENCY = {"block": 1.0, "cluster": 1.0, "grid": 1.6, "stream": 8.0}
_RATE = {torch.float32: 2.0e-3, torch.float64: 7.0e-3}
_STREAM = 1.2  # times the rate: positions and forces pass through the GPU's memory
# registers of a multiprocessor, and of a thread of a cluster (benchmarks/results/cuda-registers.csv)
_REGISTERS, _CLUSTER_REGISTERS = 65536, {torch.float32: 168, torch.float64: 256}
# multiprocessors that blocks of a cluster are neighbours in, and the share of a GPU that has as many together
_NEIGHBOURS, _SHARE = 16, 7 / 8


def clusters_together(plan: Plan, gpu: Properties) -> int:
    """Environments that run at a time with a plan for "cluster"."""
    real = torch.finfo(plan.dtype).bits // 8
    threads = _C.cluster_threads(real, plan.size("most_pairs"), plan.size("most_interior"))
    each = max(1, _REGISTERS // (threads * _CLUSTER_REGISTERS[plan.dtype]))
    if plan.patches <= 2:  # neighbours are everywhere
        return max(1, each * gpu.multiprocessors // plan.patches)
    groups = int(_SHARE * gpu.multiprocessors / _NEIGHBOURS)
    return max(1, groups * (each * _NEIGHBOURS // plan.patches))


def kernel_microseconds(
    kernel: str, patches: int, tets: int, batch: int, dtype: torch.dtype, gpu: Properties, together: int = 1
) -> float:
    """Of an iteration of a whole batch.

    Args:
        kernel: "block", "cluster", "grid" or "stream".
        patches: blocks of one environment, for "cluster" and "grid".
        tets: tetrahedra of one environment.
        batch: environments.
        dtype: precision.
        gpu: what the device has.
        together: environments that run at a time, for "cluster"; see `clusters_together`.
    """
    latency, rate = _LATENCY[kernel], _RATE[dtype]
    if kernel == "stream":
        return latency + _STREAM * rate * tets * batch / gpu.multiprocessors
    if kernel == "block":
        return latency + rate * tets * -(-batch // gpu.multiprocessors)
    if kernel == "grid":
        together = max(1, gpu.multiprocessors // patches)
    return -(-batch // together) * (latency + rate * tets / patches)


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
    kernel = str(plan.kernel)
    together = clusters_together(plan, gpu) if kernel == "cluster" else 1
    return kernel_microseconds(kernel, plan.patches, tets, batch, dtype or plan.dtype, gpu, together)
