"""Estimated time of an iteration with each GPU kernel, from seven numbers: the rule behind `kernel="auto"`.

    time = turns (latency + rate tets)

`tets` counts the tetrahedra of one environment on its busiest multiprocessor. A multiprocessor takes `rate`
microseconds per tetrahedron with every kernel; a kernel adds its latency. Environments that do not run concurrently
take turns.

The numbers are rounded from Chebyshev steps on an H100, for meshes of 64 to 38,125 vertices
(`benchmarks/kernels_by_batch.py`). In 218 batches the chosen kernel takes at most 1.046 times as long as the fastest.
The times agree with the measurement within 35 % in float32 and within a factor 1.8 in float64. Only the order of the
kernels matters, so other GPUs need only have similar ratios.
"""

from __future__ import annotations

import torch

from .. import _C
from ..common.gpu import Properties
from .cpu_plan import Plan

__all__ = ["concurrent_environments", "iteration_microseconds", "kernel_microseconds"]

_LATENCY = {"block": 1.0, "cluster": 1.0, "grid": 1.6, "stream": 8.0}
_RATE = {torch.float32: 2.0e-3, torch.float64: 7.0e-3}
_STREAM = 1.2  # factor on the rate: positions and forces pass through global memory
# registers per multiprocessor, and per thread of a cluster (benchmarks/results/cuda-registers.csv)
_REGISTERS, _CLUSTER_REGISTERS = 65536, {torch.float32: 168, torch.float64: 256}
# multiprocessors per group that can hold a cluster, and the share of a GPU in complete groups
_NEIGHBOURS, _SHARE = 16, 7 / 8


def concurrent_environments(plan: Plan, gpu: Properties) -> int:
    """Number of environments that run concurrently with a plan for "cluster"."""
    real = torch.finfo(plan.dtype).bits // 8
    threads = _C.cluster_threads(real, plan.size("most_pairs"), plan.size("most_interior"))
    each = max(1, _REGISTERS // (threads * _CLUSTER_REGISTERS[plan.dtype]))
    if plan.patches <= 2:  # two blocks fit in any group
        return max(1, each * gpu.multiprocessors // plan.patches)
    groups = int(_SHARE * gpu.multiprocessors / _NEIGHBOURS)
    return max(1, groups * (each * _NEIGHBOURS // plan.patches))


def kernel_microseconds(
    kernel: str, patches: int, tets: int, batch: int, dtype: torch.dtype, gpu: Properties, concurrent: int = 1
) -> float:
    """Estimated microseconds per iteration of a whole batch.

    Args:
        kernel: "block", "cluster", "grid" or "stream".
        patches: blocks per environment, for "cluster" and "grid".
        tets: tetrahedra per environment.
        batch: number of environments.
        dtype: precision.
        gpu: properties of the device.
        concurrent: environments that run concurrently, for "cluster"; see `concurrent_environments`.
    """
    latency, rate = _LATENCY[kernel], _RATE[dtype]
    if kernel == "stream":
        return latency + _STREAM * rate * tets * batch / gpu.multiprocessors
    if kernel == "block":
        return latency + rate * tets * -(-batch // gpu.multiprocessors)
    if kernel == "grid":
        concurrent = max(1, gpu.multiprocessors // patches)
    return -(-batch // concurrent) * (latency + rate * tets / patches)


def iteration_microseconds(
    plan: Plan, tets: int, batch: int, gpu: Properties, dtype: torch.dtype | None = None
) -> float:
    """Estimated microseconds per iteration of the whole batch, with the kernel of a plan.

    Args:
        plan: of a GPU.
        tets: tetrahedra per environment; the plan counts those at patch borders more than once.
        batch: number of environments.
        gpu: properties of the device.
        dtype: precision to use instead of that of the plan.
    """
    kernel = str(plan.kernel)
    concurrent = concurrent_environments(plan, gpu) if kernel == "cluster" else 1
    return kernel_microseconds(kernel, plan.patches, tets, batch, dtype or plan.dtype, gpu, concurrent)
