"""A step leaves the host alone: it does not wait for the device, and after the first calls takes no memory from it."""

from __future__ import annotations

import gc
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from devices import require_gpu
from on_gpu import DTYPES, GPU, KERNELS, host_waits, poll, small_on_gpu
from runs import noise, small

import torchpd as pd
from torchpd.scene.pins import hold_exactly

require_gpu()

OUTER = ("lbfgs", "momentum")  # of Multilevel, which has a kernel of its own
Calls = dict[str, Callable[[], Any]]


def simulator_of(runner: str, dtype: torch.dtype, device: torch.device = GPU) -> tuple[pd.Simulator, pd.State]:
    """Pins, drag, a ground and a ball with friction, stepped by one of KERNELS or OUTER."""
    if runner in OUTER:
        return small(dtype, device, solver=pd.Multilevel(runner))  # type: ignore[arg-type]
    return small_on_gpu(dtype, runner)


def give_everything(sim: pd.Simulator, batch: int = 3) -> None:
    """Environments that stop each by itself, with a material of their own."""
    sim.tolerance = 1e-3
    factor = torch.linspace(0.5, 2.0, batch, dtype=sim.dtype, device=sim.device)
    sim.set_material(
        stiffness=sim.stiffness * factor[:, None],
        masses=sim.masses * factor.flip(0)[:, None],
        gravity=sim.gravity * factor[:, None],
        damping=sim.damping * factor,
        pin_stiffness=hold_exactly(sim.pin_stiffness * factor[:, None], sim.pin_hard),
        pin_targets=sim.pin_targets + 0.01 * factor[:, None, None],
        planes=sim.planes.expand(batch, -1, -1),
        spheres=sim.spheres.expand(batch, -1, -1),
    )


def calls_of(sim: pd.Simulator, state: pd.State) -> dict[str, Calls]:
    """All ways to step and what goes into them: steps, rollouts, and what else is asked of a simulator."""
    pin, ball = sim.scene.pins[1], sim.scene.spheres[0]
    forces, own = noise(state.positions), state.clone()
    held, centres = state.positions[:, pin.vertices].clone(), sim.spheres[..., 0, :3].expand(3, -1).clone()
    goals = {pin: held, ball: torch.cat([centres, 0.1 + centres], dim=-1)}
    rows = torch.empty((3, 7), dtype=torch.float64, device=sim.device)
    leaf = state.positions.clone().requires_grad_()
    steps: Calls = {
        "forces": lambda: sim(state, forces),
        "a report": lambda: sim(state, return_info=True),
        "targets": lambda: sim(state, None, goals, start="inertial"),
        "targets of all pins": lambda: sim(state, targets=sim.pin_targets + 0.01),
        "a start": lambda: sim(state, start=state.positions),
        "a history for gradients": lambda: sim(pd.State(leaf, state.velocities)),
        "in place": lambda: sim.step_(own, forces, goals, start="inertial"),
        "in place, with a report": lambda: sim.step_(own, info=rows, start=state.positions),
    }
    rollouts: Calls = {
        "forces": lambda: sim.rollout(state, 2, forces=forces),
        "targets": lambda: sim.rollout(state, 2, 2, targets=goals, start="inertial", return_info=True),
        "functions": lambda: sim.rollout(
            state, 2, forces=lambda step: step * forces, targets=lambda step: {pin: held, ball: centres + 0.01 * step}
        ),
        "a history for gradients": lambda: sim.rollout(pd.State(leaf, state.velocities), 2),
    }
    others: Calls = {
        "energy": lambda: sim.energy(state),
        "gradient": lambda: sim.gradient(state.positions),
        "residual": lambda: sim.step_gradient(state, state.positions, forces, sim.pin_targets),
        "contacts": lambda: sim.contact_forces(state, state.positions, forces, goals),
        "reactions": lambda: sim.reactions(state, state.positions, forces, goals),
        "stress": lambda: sim.vertex_average(sim.stress(state).cauchy),
    }
    # shows what is done, not what is asked for
    bars: Calls = {"a bar": lambda: sim.rollout(state, 2, targets=goals, progress=True)}
    return {"steps": steps, "rollouts": rollouts, "others": others, "bars": bars}


def call_all(calls: Calls, results: dict[str, Any]) -> None:
    """A result lives until its successor is there, as in `state = sim(state)`."""
    for name, call in calls.items():
        results[name] = call()


@pytest.mark.parametrize("precision", DTYPES)
@pytest.mark.parametrize("everything", [False, True], ids=["plain", "everything"])
@pytest.mark.parametrize("runner", [*KERNELS, *OUTER])
def test_a_bar_alone_waits_for_the_device(runner: str, everything: bool, precision: str) -> None:
    sim, state = simulator_of(runner, DTYPES[precision])
    if everything:
        give_everything(sim)
    for name, calls in calls_of(sim, state).items():
        results: dict[str, Any] = {}
        for _ in range(2):
            call_all(calls, results)  # modules are loaded and memory is allocated by the first ones
        assert host_waits(partial(call_all, calls, results)) == (name == "bars"), name


def test_a_wait_is_noticed() -> None:
    """Controls: one that torch knows of, and one that it does not."""
    ones = torch.ones(8, device=GPU)
    with pytest.raises(RuntimeError, match="synchronizing"):
        host_waits(lambda: ones.sum().item())
    assert host_waits(poll)


def taken_from_the_device() -> dict[str, int]:
    """How often the driver was asked for memory, cudaMalloc, or given some back, and the segments that torch had."""
    stats = torch.cuda.memory_stats(GPU)
    names = ("num_device_alloc", "num_device_free", "num_alloc_retries", "segment.all.allocated", "segment.all.freed")
    return {name: stats[name] for name in names}


@pytest.mark.parametrize("precision", DTYPES)
@pytest.mark.parametrize("everything", [False, True], ids=["plain", "everything"])
@pytest.mark.parametrize("runner", [*KERNELS, *OUTER])
def test_no_memory_is_taken_from_the_device_after_the_first_calls(
    runner: str, everything: bool, precision: str
) -> None:
    """No cudaMalloc: torch hands out again what it got for the first ones, and nothing is kept beside the results."""
    sim, state = simulator_of(runner, DTYPES[precision])
    if everything:
        give_everything(sim)
    results: dict[str, dict[str, Any]] = {}

    def round_of_calls() -> None:
        for name, calls in calls_of(sim, state).items():
            call_all(calls, results.setdefault(name, {}))

    for _ in range(3):
        round_of_calls()
    gc.collect()
    before, held = taken_from_the_device(), torch.cuda.memory_allocated(GPU)
    for _ in range(5):
        round_of_calls()
    assert taken_from_the_device() == before
    gc.collect()
    assert torch.cuda.memory_allocated(GPU) == held


@pytest.mark.parametrize("precision", DTYPES)
@pytest.mark.parametrize("runner", [*KERNELS, *OUTER])
def test_a_step_in_place_holds_no_memory(runner: str, precision: str) -> None:
    """Nothing of torch's after fifty of them, and meanwhile never more than one needs."""
    sim, state = simulator_of(runner, DTYPES[precision])
    gc.collect()
    rows = torch.empty((3, 7), dtype=torch.float64, device=GPU)

    def peak_of(count: int) -> int:
        torch.cuda.reset_peak_memory_stats(GPU)
        for _ in range(count):
            sim.step_(state, info=rows)
        return torch.cuda.max_memory_allocated(GPU)

    first, held = peak_of(1), torch.cuda.memory_allocated(GPU)
    assert peak_of(50) == first
    assert torch.cuda.memory_allocated(GPU) == held
