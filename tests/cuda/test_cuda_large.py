"""More numbers than 32 bits count, in rollouts and in the fields that gradients are made of. Takes 40 GB of a GPU."""

from __future__ import annotations

import os
from collections.abc import Callable

import pytest
import torch
from devices import require_gpu
from on_gpu import GPU, bar, on_gpu
from runs import material_with, noise, plan_of, same_bits
from torch import Tensor

import torchpd as pd

require_gpu()

ops = torch.ops.torchpd
MANY, KINDS = 1 << 31, 7  # different environments that take turns: what is read from or written to a wrong one shows
# as large as suits the kernel, so that environments are few; "far": a grid with several tetrahedra a thread
CELLS = {"block": (8, 3, 3), "cluster": (8, 5, 5), "far": (24, 12, 12), "stream": (24, 12, 12)}
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif("TORCHPD_LARGE_TESTS" not in os.environ, reason="TORCHPD_LARGE_TESTS=1 runs it; needs 40 GB"),
    pytest.mark.parametrize("kernel", CELLS),
]


def large(kernel: str) -> tuple[pd.Simulator, pd.State]:
    """A simulator with one of CELLS, and KINDS environments."""
    torch.cuda.empty_cache()
    free, _ = torch.cuda.mem_get_info()
    if free < 40e9:
        pytest.skip("needs 40 GB")
    sim = on_gpu(bar(CELLS[kernel], pd.Gravity()), torch.float32, kernel, iterations=2)
    rest = sim.rest_state(KINDS)
    return sim, pd.State(rest.positions + 0.01 * noise(rest.positions, 1), noise(rest.positions, 2))


def turns_for(numbers: int) -> int:
    """How often each kind comes, until environments of so many numbers have more than 32 bits count."""
    return MANY // (KINDS * numbers) + 1


def takes_turns(found: Tensor, expected: Tensor) -> bool:
    """Whether the first dimension repeats that of `expected`, KINDS long, bit by bit."""
    return all(bool((part == expected).all()) for part in found.unflatten(0, (-1, KINDS)).split(1 << 12))


def test_rollouts(kernel: str) -> None:
    """Records that have so many together, of states that have less."""
    sim, kinds = large(kernel)
    steps = 12
    turns = turns_for(3 * sim.vertices * steps)
    expected = sim.rollout(kinds, steps)
    assert not same_bits(expected.state(0), expected.state(1))
    track = sim.rollout(pd.State(*(t.repeat(turns, 1, 1) for t in kinds)), steps)
    assert track.positions.numel() > MANY
    for record in range(steps):
        for found, want in zip(track.state(record), expected.state(record), strict=True):
            assert takes_turns(found, want), record


def test_fields(kernel: str) -> None:
    """Products with the Hessian, gradients, energies, and the diagonal."""
    sim, kinds = large(kernel)
    x, w, plan = kinds.positions, sim.stiffness.detach(), plan_of(sim)
    own = w * torch.linspace(0.5, 2.0, KINDS, device=GPU)[:, None]
    fields: tuple[tuple[Tensor, int, Callable[[Tensor], Tensor]], ...] = (
        (x, 3 * sim.vertices, lambda x: ops.gradient(x, material_with(sim, w), plan)),
        (x, 3 * sim.vertices, lambda x: ops.hessian_product(x, x, material_with(sim, w), plan)),
        (x, len(w), lambda x: ops.element_energy(x, material_with(sim, w), plan)),
        (x, len(w), lambda x: ops.element_energy_product(x, x, material_with(sim, w), plan)),
        (own, len(w), lambda own: ops.elastic_diagonal(material_with(sim, own), plan, weighted=True)),
    )
    for number, (given, numbers, field) in enumerate(fields):
        expected = field(given)
        found = field(given.repeat(turns_for(numbers), *[1] * (given.dim() - 1)))
        assert max(found.numel(), given.numel() * turns_for(numbers)) > MANY
        assert takes_turns(found, expected), number
        del found
