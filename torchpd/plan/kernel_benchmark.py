"""`kernel="benchmark"`: time a few steps with every kernel that fits, and keep the fastest.

The times are cached in the process by GPU, scene sizes, batch and iterations, as in the benchmark mode of cuDNN.
Kernels sum forces in different orders, so the bits of a result depend on the kernel, and thus on the clock.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Hashable, Iterator
from dataclasses import replace

import torch

from .compiled import CompiledScene
from .cpu_plan import Plan

__all__ = ["benchmark_steps", "fastest_plan"]

_REPETITIONS = 5
_TIMES: dict[Hashable, dict[str, float]] = {}  # milliseconds per step by kernel


def benchmark_steps(
    scene: CompiledScene, dtype: torch.dtype, device: torch.device
) -> tuple[Hashable, Callable[[Plan], Callable[[], object]]]:
    """Cache key and step function of `fastest_plan` for a scene on a GPU; steps start at rest."""
    values, batch = scene.scene.values(), scene.environments
    numbers = {
        **scene.solver.settings(),
        "iterations": scene.iterations,
        "time_step": scene.time_step,
        "tolerance": 0.0,
        "inertial": False,
        "report": False,
    }
    key = (
        torch.cuda.get_device_name(device), dtype, len(values.tets), len(values.rest_positions), len(values.planes),
        len(values.spheres), len(values.pin_vertices), batch, scene.iterations, scene.solver,
    )  # fmt: skip

    def step(plan: Plan) -> Callable[[], object]:
        rest = torch.as_tensor(values.rest_positions).to(device, dtype).expand(batch, -1, -1).contiguous()
        material = [array.detach().to(device, dtype) for array in scene.material]
        arrays = list(plan.to(device).arrays)
        still = torch.zeros_like(rest)
        return lambda: torch.ops.torchpd.step(rest, still, None, None, material, arrays, **numbers)

    return key, step


def fastest_plan(plans: Iterator[Plan], key: Hashable, step: Callable[[Plan], Callable[[], object]]) -> Plan:
    """The plan with the fastest steps.

    Args:
        plans: one for every kernel that fits, on the CPU.
        key: cache key of the times.
        step: moves a plan to its GPU and returns a function that takes one step. It may raise
            `torch.cuda.OutOfMemoryError`.
    """
    candidates = list(plans)
    if key not in _TIMES:
        _TIMES[key] = {str(plan.kernel): _milliseconds(step, plan) for plan in candidates}
    times = _TIMES[key]
    best = min(candidates, key=lambda plan: times[str(plan.kernel)])
    words = ", ".join(f"{kernel} {time:.3g} ms" for kernel, time in sorted(times.items(), key=lambda item: item[1]))
    return replace(best, why=f"the fastest kernel, milliseconds per step: {words}")


def _milliseconds(step: Callable[[Plan], Callable[[], object]], plan: Plan) -> float:
    """Median milliseconds per step; inf if memory does not suffice."""
    try:
        run = step(plan)
        run()  # the first step loads the kernel
        return statistics.median(_timed(run) for _ in range(_REPETITIONS))
    except torch.cuda.OutOfMemoryError:
        return float("inf")


def _timed(run: Callable[[], object]) -> float:
    start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    start.record()
    run()
    end.record()
    end.synchronize()
    return float(start.elapsed_time(end))
