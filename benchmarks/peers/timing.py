"""Time a call: processor time on one CPU thread, waiting time of the host on a GPU."""

from __future__ import annotations

import time
from collections.abc import Callable

_LEAST, _SECONDS = 2, 0.3


def fastest(work: Callable[[], object], device: str, wait: Callable[[], object] | None = None) -> float:
    """Milliseconds of the fastest of some runs; for short runs the first is not counted.

    Args:
        work: the call to time.
        device: "cpu" or "cuda".
        wait: waits for the device; default: torch's synchronisation.
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
