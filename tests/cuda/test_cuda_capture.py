"""A captured step is `step_`, bit by bit: it reads its inputs anew at every replay, and nobody can take them away."""

from __future__ import annotations

import copy
import gc
from dataclasses import replace

import pytest
import torch
from devices import require_gpu
from on_gpu import DTYPES, GPU, KERNELS, host_waits, small_on_gpu
from runs import noise, same_bits

import torchpd as pd
from torchpd.ops import INFO_WIDTH
from torchpd.simulation.state import Info

require_gpu()

pytestmark = [pytest.mark.parametrize("kernel", KERNELS), pytest.mark.parametrize("precision", DTYPES)]


def twins(state: pd.State, count: int) -> list[pd.State]:
    """Copies that can be overwritten."""
    return [pd.State(*(t.clone() for t in state)) for _ in range(count)]


def test_a_replay_is_a_step_in_place(kernel: str, precision: str) -> None:
    sim, start = small_on_gpu(DTYPES[precision], kernel)
    own, eager, deaf = twins(start, 3)
    forces = noise(start.positions)
    before = forces.clone()
    step = sim.capture(own, forces)
    assert step.state is own
    assert same_bits(own, start)  # recording leaves it as it is
    for number in range(1, 5):
        forces.copy_(noise(forces, number))
        step.replay()
        sim.step_(eager, forces)
        sim.step_(deaf, before)
        assert same_bits(own, eager)
        assert not same_bits(own, deaf)


def test_targets_and_a_given_start_are_read_anew(kernel: str, precision: str) -> None:
    sim, start = small_on_gpu(DTYPES[precision], kernel)
    own, eager, deaf = twins(start, 3)
    pin, ball = sim.scene.pins[1], sim.scene.spheres[0]
    targets = {pin: start.positions[:, pin.vertices].clone(), ball: sim.spheres[0, :3].clone()}
    guess = start.positions.clone()
    before, first = {part: place.clone() for part, place in targets.items()}, guess.clone()
    step = sim.capture(own, None, targets, guess)
    for number in range(3):
        for given in (guess, *targets.values()):
            given.add_(0.01 * noise(given, number))
        step.replay()
        sim.step_(eager, None, targets, guess)
        sim.step_(deaf, None, before, first)
        assert same_bits(own, eager)
        assert not same_bits(own, deaf)


def test_material_of_the_same_shape_is_read_anew(kernel: str, precision: str) -> None:
    sim, start = small_on_gpu(DTYPES[precision], kernel)
    own, eager, deaf = twins(start, 3)
    step = sim.capture(own)
    sim.step_(deaf)
    sim.set_material(stiffness=0.3 * sim.stiffness, damping=2.0)
    sim.pin_targets.add_(0.01)
    step.replay()
    sim.step_(eager)
    assert same_bits(own, eager)
    assert not same_bits(own, deaf)


def test_a_replay_for_another_plan_is_refused(kernel: str, precision: str) -> None:
    sim, start = small_on_gpu(DTYPES[precision], kernel)
    own, eager = twins(start, 2)
    step, plan = sim.capture(own), sim.plan
    sim.plan = replace(plan)
    with pytest.raises(RuntimeError, match="replay: the plan"):
        step.replay()
    sim.plan = plan
    step.replay()
    sim.step_(eager)
    assert same_bits(own, eager)


def test_settings_and_tensors_of_the_recording_stay(kernel: str, precision: str) -> None:
    """Also those that nobody else holds, when others are made in the memory that is free."""
    sim, start = small_on_gpu(DTYPES[precision], kernel)
    own, eager, other = twins(start, 3)
    forces, guess = noise(start.positions), start.positions + 0.01 * noise(start.positions, 1)
    sim.step_(eager, forces, None, guess)
    step = sim.capture(own, forces.clone(), None, guess.clone())
    sim.iterations = 1
    sim.set_material(stiffness=0.3 * sim.stiffness.expand(3, -1), masses=2.0 * sim.masses.expand(3, -1))
    gc.collect()
    sizes = [t.numel() for t in (forces, *sim.material(), *sim.plan.arrays)]
    taken = [torch.full((size,), float("nan"), dtype=sim.dtype, device=GPU) for size in sizes for _ in range(20)]
    step.replay()
    assert same_bits(own, eager)
    del taken  # kept until here
    sim.step_(other, forces, None, guess)
    assert not same_bits(other, eager)


def test_info_is_that_of_the_last_replay(kernel: str, precision: str) -> None:
    sim, start = small_on_gpu(DTYPES[precision], kernel)
    sim.tolerance = 0.1
    own, eager = twins(start, 2)
    rows = torch.full((3, INFO_WIDTH), float("nan"), dtype=torch.float64, device=GPU)
    step = sim.capture(own, return_info=True)
    energies = []
    for _ in range(3):
        step.replay()
        sim.step_(eager, info=rows)
        assert same_bits(own, eager)
        for name, found, expected in zip(Info._fields, step.info, Info.from_rows(rows), strict=True):
            assert torch.equal(found, expected), name
        energies.append(step.info.energy.tolist())
    assert energies[0] != energies[1] != energies[2]
    silent = sim.capture(own)
    silent.replay()
    with pytest.raises(RuntimeError, match=r"capture\(\.\.\., return_info=True\) records it"):
        silent.info  # noqa: B018


def test_a_replay_runs_on_the_current_stream_and_nobody_waits(kernel: str, precision: str) -> None:
    sim, start = small_on_gpu(DTYPES[precision], kernel)
    own, eager = twins(start, 2)
    late, forces = noise(start.positions), torch.zeros_like(start.positions)
    sim.step_(eager, late)
    step = sim.capture(own, forces)
    torch.cuda.synchronize()
    side = torch.cuda.Stream()
    with torch.cuda.stream(side):
        torch.cuda._sleep(200_000_000)  # a tenth of a second, in which nothing that runs elsewhere may overtake
        forces.copy_(late)
        step.replay()
    side.synchronize()
    assert same_bits(own, eager)
    assert not host_waits(step.replay)


def test_a_replay_takes_no_memory(kernel: str, precision: str) -> None:
    """None of torch either: the recording has its own."""
    sim, start = small_on_gpu(DTYPES[precision], kernel)
    (own,) = twins(start, 1)
    step = sim.capture(own, return_info=True)

    def taken() -> int:
        return int(torch.cuda.memory_stats(GPU)["allocation.all.allocated"])

    before = taken()
    for _ in range(20):
        step.replay()
    assert taken() == before
    sim.step_(own)  # control
    assert taken() > before


def test_two_recordings_take_turns(kernel: str, precision: str) -> None:
    """Of one simulator, for two states: neither is in the other's memory."""
    sim, start = small_on_gpu(DTYPES[precision], kernel)
    first, second, *eager = twins(start, 4)
    forces = noise(start.positions)
    steps = sim.capture(first), sim.capture(second, forces, start="inertial", return_info=True)
    for _ in range(3):
        for step in steps:
            step.replay()
        sim.step_(eager[0])
        sim.step_(eager[1], forces, start="inertial")
        assert same_bits(first, eager[0])
        assert same_bits(second, eager[1])
    assert not same_bits(first, second)


@pytest.mark.skipif("torch.cuda.device_count() < 2", reason="needs two GPUs")
def test_every_device_records_for_itself(kernel: str, precision: str) -> None:
    """Whichever was first: torch's own stream for recordings is of that one for good."""
    sim, start = small_on_gpu(DTYPES[precision], kernel)
    first = sim.capture(twins(start, 1)[0])
    there = copy.deepcopy(sim).to("cuda:1")
    own, eager = (pd.State(*(t.to("cuda:1") for t in start)) for _ in range(2))
    step = there.capture(own)
    assert same_bits(own, eager)  # recording leaves it as it is
    for _ in range(2):
        step.replay()
        there.step_(eager)
        assert same_bits(own, eager)
    sim.step_(start)
    first.replay()
    assert same_bits(first.state, start)
