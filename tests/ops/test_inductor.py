"""torch.compile with its own code generator, and with CUDA graphs on a GPU: the same bits forward and backward."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
import torch._inductor.config
from devices import missing_gpu
from on_gpu import DTYPES, bar
from runs import noise, simulator, small, state_of
from torch import Tensor

import torchpd as pd

GRAPHS = "reduce-overhead"  # what torch calls CUDA graphs
# few, since compiling takes seconds
WAYS = (
    ("cpu", "default", "float32", "auto"),
    ("cpu", "default", "float64", "auto"),
    ("cuda", "default", "float32", "stream"),
    ("cuda", "default", "float64", "block"),
    ("cuda", GRAPHS, "float32", "block"),
    ("cuda", GRAPHS, "float64", "stream"),
)


@pytest.fixture(autouse=True)
def in_this_process() -> Iterator[None]:
    """Else torch starts processes that compile beside this one, of which each imports torch."""
    with torch._inductor.config.patch(compile_threads=1):
        yield


@pytest.mark.parametrize(("device", "mode", "precision", "kernel"), WAYS)
def test_inductor_changes_no_bit(device: str, mode: str, precision: str, kernel: str) -> None:
    """Of a step and a rollout and of their gradients; what is compiled around them rounds at most once.

    With CUDA graphs the first call warms up, the second records and the others replay with other numbers. The steps
    themselves stay between the graphs, since torch's cannot hand backward what a plan has on the CPU.
    """
    if device == "cuda" and missing_gpu():
        pytest.skip(missing_gpu())
    torch._dynamo.reset()
    torch._dynamo.utils.counters.clear()
    case = bar((4, 2, 2), pd.Gravity(), pd.Damping(0.5))
    sim = simulator(case, DTYPES[precision], device, iterations=200, kernel=kernel)
    sim.stiffness.requires_grad_()

    def play(x: Tensor, v: Tensor, f: Tensor) -> tuple[Tensor, Tensor]:
        after = sim(pd.State(2.0 * x - x, v), 2.0 * f)
        return after.positions + 1.0, 0.5 * sim.rollout(after, 2).velocities

    def all_of(function: Callable[..., Any], inputs: list[Tensor]) -> list[Tensor]:
        """Results and gradients; those of a graph are gone with the next replay."""
        torch.compiler.cudagraph_mark_step_begin()
        leaves = [t.clone().requires_grad_() for t in inputs]
        results = function(*leaves)
        weights = [noise(t, 10 + n) for n, t in enumerate(results)]
        grads = torch.autograd.grad(results, [*leaves, sim.stiffness], weights)
        return [t.detach().clone() for t in (*results, *grads)]

    compiled = torch.compile(play, fullgraph=True, mode=mode)
    state = state_of(case, sim, 2)
    for number in range(4):
        inputs = [state.positions, state.velocities * (1.0 + number), noise(state.positions, number)]
        for found, expected in zip(all_of(compiled, inputs), all_of(play, inputs), strict=True):
            assert torch.equal(found, expected)
            assert bool(expected.any())
    if mode == GRAPHS:
        counters = torch._dynamo.utils.counters["inductor"]
        assert counters["cudagraph_skips"] == 0
        assert counters["cudagraph_recorded_non_static_inputs"] > 0


def test_inductor_takes_rollouts_of_permuted_arrays() -> None:
    """Whose gradients are laid out as their fakes say."""
    sim, state = small(torch.float64, iterations=200)
    x, f = (t.transpose(0, -1).contiguous().transpose(0, -1) for t in (state.positions, noise(state.positions)))
    f.requires_grad_()

    def loss(x: Tensor, f: Tensor) -> Tensor:
        return sim.rollout(pd.State(x, state.velocities), 3, forces=f).positions.square().sum()

    found, expected = (torch.autograd.grad(play(x, f), f)[0] for play in (torch.compile(loss, fullgraph=True), loss))
    assert torch.allclose(found, expected, rtol=1e-9, atol=0.0)
