"""Timing, the multiply-add rate of this machine, and the provenance of results."""

from __future__ import annotations

import fcntl
import json
import os
import shlex
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from torchpd import _C
from torchpd.common import provenance

Record = dict[str, Any]

PROVENANCE = ("command", "created", "commit")


def multiply_adds_per_second() -> float:
    """Float32 multiply-adds per second of one thread, by the extension's loop; the goals are scaled by it."""
    return max(_C.multiply_adds_per_second() for _ in range(3))


def measure(work: Callable[[], object], device: torch.device, *, repetitions: int, seconds: float) -> list[float]:
    """Seconds of runs: at least `repetitions` of them and for at least `seconds`. The first run is not counted."""
    times: list[float] = []
    work()
    while len(times) < repetitions or sum(times) < seconds:
        wait_for(device)
        begin = time.perf_counter()
        work()
        wait_for(device)
        times.append(time.perf_counter() - begin)
    return times


def wait_for(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def milliseconds(times: list[float]) -> Record:
    """Summary statistics of times [ms]."""
    return {"median": 1e3 * statistics.median(times), "min": 1e3 * min(times), "repetitions": len(times)}


def cell(value: float | None, places: int, scale: float = 1.0) -> str:
    """Format a number of a table."""
    return "-" if value is None else f"{value * scale:,.{places}f}"


def aligned(lines: list[list[str]]) -> str:
    """Format a table with right-aligned columns."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(map(str.rjust, line, widths)) for line in lines)


def write_result(path: Path, result: Record, merge: Callable[[Record, Record], Record] | None = None) -> None:
    """Write a result; `merge` combines it with the file's. Safe with concurrent writers."""
    if path.exists() and not path.is_file():  # a pipe or a terminal
        path.write_text(json.dumps(result, indent=1) + "\n")
        return
    path = path.resolve()
    path.parent.mkdir(parents=True, exist_ok=True)
    folder = os.open(path.parent, os.O_RDONLY)  # locking the folder leaves no lock file
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        whole = merge(result, json.loads(path.read_text())) if merge and path.exists() else result
        # replaced at once, so that a killed run leaves the old file
        part = path.with_name(f"{path.name}.part")
        part.write_text(json.dumps(whole, indent=1) + "\n")
        part.replace(path)
    finally:
        os.close(folder)


def run_of(result: Record) -> Record:
    """The provenance of a row, for files that combine several runs."""
    machine = ", ".join(str(result["machine"][name]) for name in ("cpu", "simd", "device"))
    return {**{name: result[name] for name in PROVENANCE}, "machine": machine, "torch": result["versions"]["torch"]}


def earlier_rows(path: Path | None) -> list[Record]:
    """The rows of a result file, each with its run; empty without a file."""
    if path is None or not path.exists():
        return []
    earlier = json.loads(path.read_text())
    return [{"run": run_of(earlier), **row} for row in earlier["rows"]]


def describe_run(device: torch.device, threads: int) -> Record:
    """Everything needed to compare this run with another."""
    command = shlex.join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *sys.argv[1:]])
    return provenance.describe_run(command, device, threads)
