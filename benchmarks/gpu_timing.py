"""Times on a GPU: events around work that a CUDA graph has recorded, so that the host does not enter."""

from __future__ import annotations

import statistics
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

Work = Callable[[], object]

DEFAULT_CLOCK = 1.98e9  # Hz, of an H100 SXM at its highest
LANES = 4 * 32  # instructions that a multiprocessor issues a clock, times threads of a warp
INSTRUCTIONS = 202.0  # a tetrahedron and iteration in float32, of kernel "block": tools/instructions.py fused_float
STREAM_BYTES = 244.0  # of a vertex and iteration in float32, with kernels for every iteration: the arrays of one-1M


@dataclass(frozen=True)
class Device:
    """What the floors follow from."""

    name: str
    multiprocessors: int
    clock: float  # Hz
    copy_bandwidth: float  # bytes/s, read and written
    memory: int

    @property
    def lane_instructions(self) -> float:
        """A second, when every scheduler issues one a clock."""
        return self.multiprocessors * LANES * self.clock

    def issue_floor(self, tets: int, batch: int) -> float:
        """Seconds of an iteration when nothing but instructions takes time."""
        return INSTRUCTIONS * tets * batch / self.lane_instructions

    def bandwidth_floor(self, vertices: int, batch: int, real: int) -> float:
        """Seconds of an iteration of the stream kernels when nothing but memory takes time."""
        return STREAM_BYTES * real / 4 * vertices * batch / self.copy_bandwidth


def describe_device(device: torch.device) -> Device:
    """The name, size and speed of a GPU; its bandwidth is measured."""
    facts = torch.cuda.get_device_properties(device)
    return Device(
        facts.name, facts.multi_processor_count, clock_of(facts, device), copy_bandwidth(device), facts.total_memory
    )


def clock_of(facts: Any, device: torch.device) -> float:
    """Highest clock of the multiprocessors in Hz: as torch knows it (in kHz), as nvidia-smi does, or the usual one."""
    kilohertz = getattr(facts, "clock_rate", 0)
    if kilohertz:
        return 1e3 * kilohertz
    command = ["nvidia-smi", f"--id={device.index or 0}", "--query-gpu=clocks.max.sm", "--format=csv,noheader,nounits"]
    try:
        said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        return 1e6 * float(said.splitlines()[0])
    except (OSError, subprocess.CalledProcessError, ValueError, IndexError):
        return DEFAULT_CLOCK


def copy_bandwidth(device: torch.device, size: int = 1 << 30) -> float:
    """Bytes read and written a second by a large copy."""
    source = torch.zeros(size, dtype=torch.uint8, device=device)
    to = torch.empty_like(source)
    seconds = statistics.median(event_times(lambda: to.copy_(source), repetitions=10, seconds=0.0))
    return 2.0 * size / seconds


def event_times(work: Work, *, repetitions: int, seconds: float) -> list[float]:
    """Seconds of at least so many runs, and until so much time has passed, each between two events."""
    for _ in range(2):
        work()
    times: list[float] = []
    while len(times) < repetitions or sum(times) < seconds:
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        begin.record()
        work()
        end.record()
        end.synchronize()
        times.append(1e-3 * begin.elapsed_time(end))
    return times


def recorded(work: Work, runs: int) -> torch.cuda.CUDAGraph:
    """A graph with so many runs."""
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        work()
    torch.cuda.current_stream().wait_stream(side)
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        for _ in range(runs):
            work()
    return graph


def graph_times(work: Work, *, repetitions: int, seconds: float) -> list[float]:
    """Seconds of one run: a graph holds as many as take some milliseconds."""
    once = min(event_times(work, repetitions=3, seconds=0.0))
    runs = max(1, min(50, round(3e-3 / max(once, 1e-6))))
    graph = recorded(work, runs)
    return [t / runs for t in event_times(graph.replay, repetitions=repetitions, seconds=seconds)]


def host_seconds(work: Work, runs: int) -> float:
    """Of the call alone: the device catches up afterwards."""
    for _ in range(3):
        work()
    times = []
    for _ in range(runs):
        torch.cuda.synchronize()
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    torch.cuda.synchronize()
    return statistics.median(times)


def kernel_seconds(work: Work, runs: int) -> float | None:
    """What the kernels of one run take by the profiler's account; None where it sees none."""
    work()
    torch.cuda.synchronize()
    kinds = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=kinds) as profile:
        for _ in range(runs):
            work()
        torch.cuda.synchronize()
    on_device = (e for e in profile.events() if e.device_type == torch.autograd.DeviceType.CUDA)
    microseconds = sum(e.time_range.elapsed_us() for e in on_device)
    return 1e-6 * microseconds / runs if microseconds else None
