"""After what a GPU has no memory or no room for, it steps on as before, and what was refused has changed nothing."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import pytest
import torch
from devices import require_gpu
from on_gpu import DTYPES, GPU, KERNELS, bar, has_clusters, moved, small_on_gpu, still_works
from runs import moving, same_bits, simulate, simulator, small, state_of

import torchpd as pd
from torchpd.common.gpu import Properties
from torchpd.plan import kernel_choice as regimes
from torchpd.plan import placement as placing

require_gpu()

RUNNERS = (*KERNELS, "levels")


def simulator_of(runner: str, dtype: torch.dtype) -> tuple[pd.Simulator, pd.State]:
    """A small one, stepped by one of RUNNERS."""
    return small(dtype, GPU, solver=pd.Multilevel()) if runner == "levels" else small_on_gpu(dtype, runner)


def settings_of(runner: str) -> dict[str, Any]:
    """Of a simulator that one of RUNNERS is to step, or "auto"."""
    return {"solver": pd.Multilevel()} if runner == "levels" else {"kernel": runner}


def ways_to_step(sim: pd.Simulator, own: pd.State, state: pd.State) -> dict[str, Callable[[], Any]]:
    """Those that write their results elsewhere, and those that overwrite `own`."""
    rows = torch.empty((len(state.positions), 7), dtype=torch.float64, device=GPU)
    return {
        "a step": lambda: sim(state),
        "a rollout": lambda: sim.rollout(state, 3),
        "in place": lambda: sim.step_(own, info=rows),
        "a recording": lambda: sim.capture(own),
    }


@contextmanager
def full_device() -> Iterator[None]:
    """Torch gets no more from the driver than it has, and all of that is taken: 512 bytes are too many.

    The limit is of this process, so that others who use the device notice nothing.
    """
    gc.collect()
    torch.cuda.empty_cache()
    total = torch.cuda.get_device_properties(GPU).total_memory
    torch.cuda.set_per_process_memory_fraction(torch.cuda.memory_reserved(GPU) / total, GPU)
    taken = []
    try:
        for size in (1 << 24, 1 << 20, 1 << 16, 512):
            with suppress(torch.OutOfMemoryError):
                while True:
                    taken.append(torch.empty(size, dtype=torch.uint8, device=GPU))
        yield
    finally:
        taken.clear()
        torch.cuda.set_per_process_memory_fraction(1.0, GPU)


def finds_memory(call: Callable[[], Any]) -> bool:
    try:
        call()
    except RuntimeError as error:
        if "memory" not in str(error):
            raise
        return False
    return True


@pytest.mark.parametrize("precision", DTYPES)
@pytest.mark.parametrize("runner", RUNNERS)
def test_a_step_that_finds_no_memory_changes_nothing(runner: str, precision: str) -> None:
    """Not for results, nor for the workspace of a step in place, nor for the copy of the state of a recording."""
    sim, state = simulator_of(runner, DTYPES[precision])
    own = state.clone()
    expected, track = sim(state), sim.rollout(state, 3)
    ways = ways_to_step(sim, own, state)
    if (runner, precision) == ("cluster", "float32"):
        del ways["in place"]  # has all that it needs in shared memory
    with full_device():
        assert [name for name, step in ways.items() if finds_memory(step)] == []
    assert same_bits(own, state)
    assert same_bits(sim(state), expected)
    assert same_bits(sim.rollout(state, 3), track)
    recording = sim.capture(own)
    recording.replay()
    assert same_bits(own, expected)
    still_works()


def test_more_than_the_device_has_is_refused() -> None:
    """By the driver: a state, its successor, and the record of a rollout."""
    sim, state = small_on_gpu(torch.float32, "block")
    expected = sim(state)
    total = torch.cuda.get_device_properties(GPU).total_memory
    of_one = 4 * 3 * sim.vertices  # bytes
    batch = total // of_one + 1
    wide = pd.State(*(t[:1].expand(batch, -1, -1) for t in state))  # takes no memory itself
    requests: tuple[Callable[[], Any], ...] = (
        lambda: sim.rest_state(batch),
        lambda: sim(wide),
        lambda: sim.rollout(state, total // (3 * of_one) + 1),
    )
    for request in requests:
        with pytest.raises(RuntimeError, match="memory"):
            request()
        assert same_bits(sim(state), expected)
    still_works()


@pytest.mark.parametrize("runner", ["auto", "stream", "levels"])
def test_a_simulator_that_finds_no_memory_stays_where_it_is(runner: str) -> None:
    sim, other = (simulate(torch.float32, **settings_of(runner)) for _ in range(2))
    state = moving(sim)
    expected = sim(state)
    with full_device(), pytest.raises(RuntimeError, match="memory"):
        sim.to(GPU)
    assert {t.device.type for t in (*sim.parameters(), *sim.buffers(), *sim.plan.arrays)} == {"cpu"}
    assert same_bits(sim(state), expected)
    there = moved(state, GPU)
    assert same_bits(sim.to(GPU)(there), other.to(GPU)(there))
    still_works()


def test_a_plan_larger_than_what_is_free_is_refused_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    sim = simulate(torch.float32)
    state = moving(sim)
    expected = sim(state)
    with monkeypatch.context() as patch:
        patch.setattr(placing, "free_memory", lambda device: 1000)
        with pytest.raises(RuntimeError, match=r"need [\d,]+ B of memory on the GPU and 1,000 B are free"):
            sim.to(GPU)
    assert sim.device.type == "cpu"
    assert same_bits(sim(state), expected)
    still_works()


def test_settings_that_find_no_memory_are_not_set() -> None:
    sim, state = small_on_gpu(torch.float32, "stream")
    expected, arrays = sim(state), [t.data_ptr() for t in (*sim.material(), *sim.plan.arrays)]
    own_stiffness = sim.stiffness.expand(3, -1).clone()

    def set_solver() -> None:
        sim.solver = pd.Multilevel()

    def set_batch() -> None:
        sim.batch = 1024

    def set_kernel() -> None:
        sim.kernel = "grid"

    with full_device():
        for change in (
            set_solver,
            set_batch,
            set_kernel,
            sim.double,
            lambda: sim.set_material(stiffness=own_stiffness),
        ):
            with pytest.raises(RuntimeError, match="memory"):
                change()
    assert sim.solver == pd.Chebyshev()
    assert (sim.batch, sim.kernel) == (None, "stream")
    assert sim.dtype == torch.float32
    assert [t.data_ptr() for t in (*sim.material(), *sim.plan.arrays)] == arrays
    assert same_bits(sim(state), expected)
    still_works()


@pytest.mark.parametrize("runner", RUNNERS)
def test_a_refusal_ends_a_recording_and_no_more(runner: str) -> None:
    sim, state = simulator_of(runner, torch.float32)
    expected, elsewhere = sim(state), moved(state, "cpu")

    def record() -> None:
        with torch.cuda.graph(torch.cuda.CUDAGraph()):
            sim(state)
            sim(elsewhere)

    with pytest.raises(TypeError, match="state must be"):
        record()
    assert same_bits(sim(state), expected)
    own = state.clone()
    sim.capture(own).replay()
    assert same_bits(own, expected)
    still_works()


# ---- launches


@pytest.mark.parametrize("precision", DTYPES)
@pytest.mark.parametrize("runner", RUNNERS)
def test_a_launch_that_the_device_refuses_changes_nothing(
    runner: str, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a plan for another device, whose blocks have 16 MB of shared memory: patches of 7680 tetrahedra and more.

    A patch of a cluster has a block's threads for its vertices; there balls want the memory, 32 or 64 bytes each.
    """
    dtype = DTYPES[precision]
    if runner == "cluster":
        if not has_clusters():
            pytest.skip("clusters of blocks need compute capability 9.0")
        case = bar((4, 2, 2), *(pd.Sphere((0.0, -100.0 - number, 0.0), 0.1) for number in range(8000)))
    else:
        case = bar((40, 8, 8))
    other = Properties(multiprocessors=2, shared=1 << 24, cluster=2)
    with monkeypatch.context() as patch:
        patch.setattr(placing, "properties_of", lambda device: other)
        patch.setattr(placing, "step_bytes", lambda *_: 0)  # asks the device, which would refuse the simulator
        patch.setitem(regimes._STREAM_TETS, dtype, 10**6)
        patch.setattr(regimes, "_MAX_BLOCK_TETS", 10**6)
        sim = simulator(case, dtype, GPU, iterations=2, **settings_of(runner))
    state = state_of(case, sim)
    own = state.clone()
    ways = ways_to_step(sim, own, state)
    if runner != "cluster":
        ways["a field"] = lambda: sim.gradient(state.positions)
    for step in ways.values():
        with pytest.raises(RuntimeError, match="bytes of shared memory"):
            step()
        still_works()
    assert same_bits(own, state)
    assert torch.cuda.current_stream() == torch.cuda.default_stream()
