"""Times of a call: on one thread of a CPU those of the processor, on a GPU those that the host waits."""

from __future__ import annotations

import time
from collections.abc import Callable

_LEAST, _SECONDS = 2, 0.3


def fastest(work: Callable[[], object], device: str, wait: Callable[[], object] | None = None) -> float:
    """Milliseconds of the fastest of some runs; the first is not counted when a run is short.

    Args:
        work: to be timed.
        device: "cpu" or "cuda".
        wait: for the device to be done; torch's by default.
    """
    if device == "cuda" and wait is None:
        import torch

        wait = torch.cuda.synchronize
    clock = time.perf_counter if device == "cuda" else time.process_time
    times: list[float] = []
    while len(times) < _LEAST or sum(times) < _SECONDS:
        if wait is not None:
            wait()
        begin = clock()
        work()
        if wait is not None:
            wait()
        times.append(clock() - begin)
        if times[0] > 5.0:
            break
    return 1e3 * min(times)
