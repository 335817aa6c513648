"""Colliders with a mass on a GPU: as on the CPU, free of crossings, the same bits in any batch and twice."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from body_scenes import THICKNESS, crossed, simulator
from devices import require_gpu
from on_gpu import GPU
from torch import Tensor

import torchpd as pd
from torchpd.simulation.state import chosen

require_gpu()


def box(size: float, cells: int) -> pd.TetMesh:
    return pd.shapes.box((size,) * 3, (cells,) * 3).translated((-0.5 * size,) * 3)  # type: ignore[arg-type]


def meeting(iterations: int, batch: int = 1, **options: Any) -> tuple[pd.Simulator, pd.HistoryState]:
    """Two turned rigid cubes fly into a soft one from both sides."""
    bodies = [pd.Collider(box(0.08, 2), mass=mass, pose=pose) for mass, pose in (
        (0.5, (0.02, 0.12, 0.013, 0.97, 0.1, 0.15, 0.05)), (0.05, (-0.01, -0.121, 0.01, 0.95, -0.1, 0.05, 0.2)),
    )]  # fmt: skip
    soft = pd.Solid(box(0.1, 3), youngs=1e5, density=1000.0)
    scene = pd.Scene(soft, *bodies, pd.Contact(friction=0.3, thickness=THICKNESS), pd.Gravity((0.0, -1.0, 0.0)))
    sim = simulator(scene, iterations, **options)
    state: Any = sim.rest_state(batch)
    speed = torch.linspace(1.0, 2.0, batch, dtype=sim.dtype, device=sim.device)
    state.history.motion[:, 0] = torch.tensor([0.3, -1.0, 0.1, 3.0, 1.0, -2.0], dtype=sim.dtype, device=sim.device)
    state.history.motion[:, 1, 1] = speed
    state.history.motion[:, 0] *= speed[:, None]
    return sim, state


def arrays(state: pd.HistoryState) -> list[Tensor]:
    return [state.positions, state.velocities, *state.history]


@pytest.mark.parametrize("iterations", [4, 16, 64])
def test_a_step_equals_that_of_the_cpu(iterations: int) -> None:
    """Each step from the state of the CPU, places to 1e-9 of the longest way, once pairs have forces on both."""
    host, state = meeting(iterations)
    device, _ = meeting(iterations, device=GPU)
    compared = 0
    for _ in range(8):
        before, state = state, host(state)
        own = device(before.to(GPU))
        if not bool((before.history.keys >= 0).any()):
            continue
        compared += 1
        way = max(float((state.positions - before.positions).abs().max()), 1e-6)
        assert float((own.positions.cpu() - state.positions).abs().max()) <= 1e-9 * way
        torch.testing.assert_close(own.history.poses.cpu(), state.history.poses, rtol=0.0, atol=1e-9)
        torch.testing.assert_close(own.history.motion.cpu(), state.history.motion, rtol=0.0, atol=1e-6)
    assert compared >= 2


@pytest.mark.parametrize("iterations", [4, 64])
def test_environments_have_the_bits_that_they_have_alone(iterations: int, dtype: torch.dtype) -> None:
    sim, start = meeting(iterations, 65, dtype=dtype, device=GPU)
    both, again, alone, met = start, start, chosen(start, [40]), False
    for _ in range(6):
        both, again, alone = sim(both), sim(again), sim(alone)
        assert crossed(sim, both, 40) == 0
        met = met or bool((both.history.keys >= 0).any())
    assert met
    for first, second, single in zip(arrays(both), arrays(again), arrays(alone), strict=True):
        assert torch.equal(first, second)
        assert torch.equal(first[[40]], single)
