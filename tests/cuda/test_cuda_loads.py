"""Pressure and wind on a GPU: the forces of the CPU, no wait of the host, and captured steps that read them anew."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from devices import require_gpu
from on_gpu import DTYPES, GPU, host_waits
from runs import noise, same_bits
from torch import Tensor

import torchpd as pd

require_gpu()

pytestmark = pytest.mark.parametrize("precision", DTYPES)


def hollow(precision: str) -> tuple[pd.Simulator, dict[Any, Tensor]]:
    """A cube with a gas in its middle third, in the wind, and other numbers for a step."""
    mesh = pd.shapes.box((0.3, 0.3, 0.3), (3, 3, 3))
    inner = (np.abs(mesh.vertices[mesh.tets].mean(axis=1) - 0.15) < 0.05).all(axis=1)
    body = pd.Solid(pd.TetMesh(mesh.vertices, mesh.tets[~inner], drop_unreferenced=False), 1e5)
    gas, wind = pd.Pressure(body, 1e3, gas=True), pd.Wind((5.0, 1.0, 0.5))
    sim = pd.Simulator(pd.Scene(body, gas, wind, pd.Gravity()), iterations=20, dtype=DTYPES[precision], device=GPU)
    pascals = torch.tensor([500.0, 2e3], dtype=sim.dtype, device=GPU)
    return sim, {gas: pascals, wind: torch.tensor([0.0, 9.0, 1.0], dtype=sim.dtype, device=GPU)}


def test_forces_are_those_of_the_cpu(precision: str) -> None:
    sim, targets = hollow(precision)
    state = sim.rest_state(2)
    state = pd.State(state.positions + 0.01 * noise(state.positions), noise(state.positions, 1))
    found = sim.load_forces(state, targets)
    own = {part: value.cpu() for part, value in targets.items()}
    expected = sim.to("cpu").load_forces(state.to("cpu"), own)
    tolerance = 100.0 * torch.finfo(found.dtype).eps * float(expected.abs().max())
    torch.testing.assert_close(found.cpu(), expected, rtol=0.0, atol=tolerance)


def test_a_step_does_not_wait(precision: str) -> None:
    sim, targets = hollow(precision)
    state = sim.rest_state(2)
    sim(state, targets=targets)
    assert not host_waits(lambda: sim(state, targets=targets))
    assert not host_waits(lambda: sim.rollout(state, 3, targets=targets))


def test_a_captured_step_reads_loads_anew(precision: str) -> None:
    sim, targets = hollow(precision)
    start = sim.rest_state(2)
    own, eager = start.clone(), start.clone()
    step = sim.capture(own, None, targets)
    for number in range(3):
        for value in targets.values():
            value.mul_(1.1)
        step.replay()
        sim.step_(eager, None, targets)
        assert same_bits(own, eager), number
    still = sim.capture(own)
    sim.wind.mul_(2.0)
    still.replay()
    sim.step_(eager)
    assert same_bits(own, eager)
