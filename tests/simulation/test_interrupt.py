"""What signals ask for happens within a long call on the CPU: Ctrl-C ends it, and leaves its state alone."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

import pytest
import torch
from runs import moving, same_bits
from small_scene import scene

import torchpd as pd

ENDLESS = 1_000_000_000


class StoppedError(Exception):
    """As KeyboardInterrupt, but it does not end pytest where it comes too late."""


def stop(_signal: int, _frame: FrameType | None) -> None:
    raise StoppedError


@contextmanager
def stopped_after(seconds: float) -> Iterator[None]:
    """Ends what is within, in less than two seconds more."""
    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    begin = time.perf_counter()
    try:
        with pytest.raises(StoppedError):
            yield
        assert time.perf_counter() - begin < seconds + 2
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def simulator(solver: pd.Chebyshev | pd.Multilevel, iterations: int) -> pd.Simulator:
    return pd.Simulator(scene(), 1 / 60, iterations, solver, progress=False)


def in_place(sim: pd.Simulator, state: pd.State) -> None:
    sim.step_(pd.State(state.positions.clone(), state.velocities.clone()))


@pytest.mark.parametrize("solver", [pd.Chebyshev(), pd.Multilevel()], ids=["Chebyshev", "Multilevel"])
@pytest.mark.parametrize("batch", [1, 20])  # by a team, and by every thread alone
@pytest.mark.parametrize("call", [lambda sim, state: sim(state), in_place], ids=["step", "in place"])
def test_a_long_step_ends(
    solver: pd.Chebyshev | pd.Multilevel,
    batch: int,
    call: Callable[[pd.Simulator, pd.State], object],
    two_threads: None,
) -> None:
    sim = simulator(solver, 3)
    state = moving(sim, batch)
    before, expected = [t.clone() for t in state], sim(state)
    sim.iterations = ENDLESS
    with stopped_after(0.1):
        call(sim, state)
    assert all(torch.equal(one, other) for one, other in zip(before, state, strict=True))
    sim.iterations = 3
    assert same_bits(sim(state), expected)


@pytest.mark.parametrize("progress", [False, True])
@pytest.mark.parametrize("every", [1, ENDLESS])
def test_a_long_rollout_ends(progress: bool, every: int) -> None:
    sim = simulator(pd.Chebyshev(), 3)
    steps = ENDLESS if every > 1 else 200_000  # of which memory is reserved
    with stopped_after(0.3):
        sim.rollout(moving(sim, 4), steps, every, progress=progress)


def test_signals_wait_for_calls_of_other_threads() -> None:
    """Python runs handlers in its main thread alone."""
    sim = simulator(pd.Chebyshev(), 30_000)
    state, done = moving(sim), []
    other = threading.Thread(target=lambda: done.append(sim(state)))
    with stopped_after(0.1):
        other.start()
        time.sleep(10)
    other.join()
    assert same_bits(done[0], sim(state))
