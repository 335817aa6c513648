"""`kernel="benchmark"`: time a few steps with every kernel that fits, and keep the fastest.

The times are cached in the process by GPU, scene sizes, batch and iterations, as in the benchmark mode of cuDNN.
Kernels sum forces in different orders, so the bits of a result depend on the kernel, and thus on the clock.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Hashable, Iterator
from dataclasses import replace
from functools import partial

import torch

from .compiled import CompiledScene
from .cpu_plan import Plan

__all__ = ["fastest_plan"]

_REPETITIONS = 5
_TIMES: dict[Hashable, dict[str, float]] = {}  # milliseconds per step by kernel


Step = Callable[[], object]


def fastest_plan(plans: Iterator[Plan], scene: CompiledScene, dtype: torch.dtype, device: torch.device) -> Plan:
    """The plan with the fastest steps from rest.

    Args:
        plans: one for every kernel that fits, on the CPU.
        scene: gives material, settings and batch of the steps.
        dtype: precision of the plans.
        device: the GPU.
    """
    candidates, values = list(plans), scene.scene.values()
    key = (
        torch.cuda.get_device_name(device), dtype, len(values.tets), len(values.rest_positions), len(values.planes),
        len(values.spheres), len(values.pin_vertices), *((group.kind, len(group)) for group in values.stencils),
        scene.environments, scene.iterations, scene.solver,
        *((plan.kernel, plan.patches) for plan in candidates),
    )  # fmt: skip
    if key not in _TIMES:
        steps = {str(plan.kernel): partial(_step, plan, scene, device) for plan in candidates}
        _TIMES[key] = {kernel: _milliseconds(step, device) for kernel, step in steps.items()}
    times = _TIMES[key]
    best = min(candidates, key=lambda plan: times[str(plan.kernel)])
    words = ", ".join(f"{kernel} {time:.3g} ms" for kernel, time in sorted(times.items(), key=lambda item: item[1]))
    return replace(best, why=f"the fastest kernel, milliseconds per step: {words}")


def _step(plan: Plan, scene: CompiledScene, device: torch.device) -> Step:
    """Move a plan to its GPU, and return a function that takes one step from rest."""
    settings = {
        **scene.solver.settings(),
        "iterations": scene.iterations,
        "time_step": scene.time_step,
        "tolerance": 0.0,
        "inertial": False,
        "report": False,
    }
    rest = torch.as_tensor(scene.scene.values().rest_positions).to(device, plan.dtype)
    rest = rest.expand(scene.environments, -1, -1).contiguous()
    still = torch.zeros_like(rest)
    material = [array.detach().to(device, plan.dtype) for array in scene.material]
    arrays = list(plan.to(device).arrays)
    return lambda: torch.ops.torchpd.step(rest, still, None, None, material, arrays, **settings)


def _milliseconds(prepare: Callable[[], Step], device: torch.device) -> float:
    """Median milliseconds per step; inf if memory does not suffice."""
    try:
        with torch.cuda.device(device):
            step = prepare()
            step()  # the first step loads the kernel
            return statistics.median(_timed(step) for _ in range(_REPETITIONS))
    except torch.cuda.OutOfMemoryError:
        return float("inf")


def _timed(step: Step) -> float:
    start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    start.record()
    step()
    end.record()
    end.synchronize()
    return float(start.elapsed_time(end))
