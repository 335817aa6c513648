"""GPU times from events around work in a CUDA graph, which excludes the host."""

from __future__ import annotations

import statistics
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

Work = Callable[[], object]

DEFAULT_CLOCK = 1.98e9  # Hz, highest clock of an H100 SXM
LANES = 4 * 32  # instructions issued per clock and multiprocessor, times threads of a warp
INSTRUCTIONS = 202.0  # per tetrahedron and iteration in float32, kernel "block": tools/instructions.py fused_float
STREAM_BYTES = 244.0  # per vertex and iteration in float32, with one kernel per iteration: the arrays of one-1M


@dataclass(frozen=True)
class Device:
    """Facts of a GPU that determine the lower bounds."""

    name: str
    multiprocessors: int
    clock: float  # Hz
    copy_bandwidth: float  # bytes/s, read plus written
    memory: int

    @property
    def lane_instructions(self) -> float:
        """Lane instructions per second, with every scheduler issuing one per clock."""
        return self.multiprocessors * LANES * self.clock

    def issue_floor(self, tets: int, batch: int) -> float:
        """Lower bound [s] of an iteration from its instructions."""
        return INSTRUCTIONS * tets * batch / self.lane_instructions

    def bandwidth_floor(self, vertices: int, batch: int, real: int) -> float:
        """Lower bound [s] of an iteration of the stream kernels from its memory traffic."""
        return STREAM_BYTES * real / 4 * vertices * batch / self.copy_bandwidth


def describe_device(device: torch.device) -> Device:
    """Name, size and speed of a GPU; its bandwidth is measured."""
    facts = torch.cuda.get_device_properties(device)
    return Device(
        facts.name, facts.multi_processor_count, clock_of(facts, device), copy_bandwidth(device), facts.total_memory
    )


def clock_of(facts: Any, device: torch.device) -> float:
    """Highest clock of the multiprocessors [Hz]: from torch (in kHz), from nvidia-smi, or the usual one."""
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
    """Bytes read plus written per second by a large copy."""
    source = torch.zeros(size, dtype=torch.uint8, device=device)
    to = torch.empty_like(source)
    seconds = statistics.median(event_times(lambda: to.copy_(source), repetitions=10, seconds=0.0))
    return 2.0 * size / seconds


def event_times(work: Work, *, repetitions: int, seconds: float) -> list[float]:
    """Seconds of runs, each between two events: at least `repetitions` of them and for at least `seconds`."""
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
    """A graph of `runs` runs."""
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
    """Seconds of one run; a graph holds enough runs to take some milliseconds."""
    once = min(event_times(work, repetitions=3, seconds=0.0))
    runs = max(1, min(50, round(3e-3 / max(once, 1e-6))))
    graph = recorded(work, runs)
    return [t / runs for t in event_times(graph.replay, repetitions=repetitions, seconds=seconds)]


def host_seconds(work: Work, runs: int) -> float:
    """Seconds of the call alone; the device catches up afterwards."""
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
    """Seconds of the kernels of one run according to the profiler; None if it sees none."""
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
