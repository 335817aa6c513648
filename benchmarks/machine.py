"""Where numbers come from: the machine, the versions, the speed of its multiply-adds, and times."""

from __future__ import annotations

import datetime
import os
import platform
import shlex
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torchpd as pd
from torchpd import _C

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
    build = _C.build_info()
    return {
        "command": shlex.join(["python", "benchmarks/run.py", *sys.argv[1:]]),
        "created": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        "commit": _git_commit(),
        "machine": {
            "cpu": _cpu_name(),
            "logical_cores": os.cpu_count(),
            "threads": threads,
            "simd": build["simd"],
            "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
            "platform": platform.platform(),
        },
        "versions": {
            "torchpd": pd.__version__,
            "torch": torch.__version__,
            "python": platform.python_version(),
            "numpy": np.__version__,
            "compiler": build["compiler"],
        },
    }


def _cpu_name() -> str:
    """The name that the processor gives itself."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _git_commit() -> str:
    """Of the working tree, with a plus when it has changes; "unknown" outside of a repository."""

    def ask(*words: str) -> str:
        folder = Path(__file__).parent
        return subprocess.run(["git", *words], cwd=folder, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return ask("rev-parse", "HEAD") + ("+" if ask("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
