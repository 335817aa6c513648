"""A step with contact equals the reference, which finds pairs by brute force and knows nothing of lanes or trees."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from contact_scenes import block, each, falling
from torch import Tensor

import torchpd as pd
from torchpd.reference.contact import contact_scene, contact_step

H, THICKNESS = 1.0 / 60.0, 1e-3


def two_cubes() -> tuple[pd.Solid, pd.Solid]:
    return block(0.1, 2), block(0.1, 2, center=(0.12, 0.02, 0.013))


def two_rods() -> tuple[pd.Rod, pd.Rod]:
    """Rods that cross, bent by less than a hundredth of their length: they are thin about themselves."""
    bow = 1e-3 * np.sin(np.linspace(0.0, np.pi, 7))[:, None]
    lines = np.linspace((-0.1, 0.0, 0.0), (0.1, 0.0, 0.0), 7), np.linspace((0.02, 0.02, -0.1), (0.017, 0.02, 0.12), 7)
    lower, upper = (pd.Rod(line + bow * side, 1e6, 2e-3) for line, side in zip(lines, np.eye(3)[[2, 0]], strict=True))
    return lower, upper


BODIES: dict[str, tuple[Callable[[], tuple[Any, Any]], list[tuple[float, float, float]], int]] = {
    "cubes": (two_cubes, [(1.0, 0.2, 0.0), (-1.0, 0.0, 0.0)], 2),
    "rods": (two_rods, [(0.1, 0.5, 0.0), (0.0, -0.8, 0.1)], 1),
}


@pytest.mark.parametrize("iterations", [4, 16, 48])
@pytest.mark.parametrize("friction", [0.0, 0.5])
@pytest.mark.parametrize("name", BODIES)
def test_bodies_that_meet(name: str, iterations: int, friction: float) -> None:
    """Two steps of cubes, one of rods. Later they part, and a step corrects rigid motions of what touches nothing.

    With 64 iterations the guard restarts once more or less, by the rounding of energies that hardly change.
    """
    make, speeds, steps = BODIES[name]
    bodies = make()
    plain = falling(*bodies, g=0.0)
    velocities = torch.tensor(each(plain, *speeds))
    reference = contact_scene(plain, thickness=THICKNESS, friction=friction)
    scene = pd.Scene(*bodies, pd.Contact(thickness=THICKNESS, friction=friction))
    sim = pd.Simulator(scene, H, iterations, pd.Chebyshev(relaxation=1.9), torch.float64, progress=False)
    state = pd.HistoryState(sim.rest_positions[None].clone(), velocities[None], sim.rest_state().history)
    x: Tensor = sim.rest_positions
    v, history, touched = velocities, None, False
    for _ in range(steps):
        theirs = contact_step(reference, x, v, H, iterations=iterations, history=history)
        x, v, history = theirs.positions, theirs.velocities, theirs.history
        state, info = sim(state, return_info=True)
        way = float((v * H).norm(dim=1).max())
        assert float((state.positions[0] - x).abs().max()) <= 1e-10 * way
        assert float(info.contact_gap) == pytest.approx(theirs.gap, rel=1e-9)
        touched = touched or bool(theirs.forces.any())
        given = float(state.history.forces[0, :, 0].sum())
        assert given == pytest.approx(float(history.normal.sum()), rel=1e-9, abs=1e-9)
    assert touched
