"""Times, the speed of the multiply-adds of this machine, and where numbers come from."""

from __future__ import annotations

import shlex
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from torchpd import _C, provenance

Record = dict[str, Any]


def multiply_adds_per_second() -> float:
    """Float32 multiply-adds of one thread, by the loop of the extension: what the goals are scaled by."""
    return max(_C.multiply_adds_per_second() for _ in range(3))


def measure(work: Callable[[], object], device: torch.device, *, repetitions: int, seconds: float) -> list[float]:
    """Seconds of at least so many runs, and until so much time has passed. The first run is not counted."""
    times: list[float] = []
    work()
    while len(times) < repetitions or sum(times) < seconds:
        _wait_for(device)
        begin = time.perf_counter()
        work()
        _wait_for(device)
        times.append(time.perf_counter() - begin)
    return times


def _wait_for(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def milliseconds(times: list[float]) -> Record:
    """A summary of times."""
    return {"median": 1e3 * statistics.median(times), "min": 1e3 * min(times), "repetitions": len(times)}


def describe_run(device: torch.device, threads: int) -> Record:
    """Everything that another run needs to be compared with this one."""
    command = shlex.join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *sys.argv[1:]])
    return provenance.describe_run(command, device, threads)
