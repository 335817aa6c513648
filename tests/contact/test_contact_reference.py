"""A step with contact equals the reference, which finds pairs by brute force and knows nothing of lanes or trees."""

from __future__ import annotations

import pytest
import torch
from contact_scenes import block, each, falling
from torch import Tensor

import torchpd as pd
from torchpd.reference.contact import contact_scene, contact_step

H, THICKNESS = 1.0 / 60.0, 1e-3


def two_cubes() -> tuple[pd.Solid, pd.Solid]:
    return block(0.1, 2), block(0.1, 2, center=(0.12, 0.02, 0.013))


@pytest.mark.parametrize("iterations", [4, 16, 48])
@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_cubes_that_meet(iterations: int, friction: float) -> None:
    """Two steps. Later the cubes part, and a step corrects rigid motions of bodies that touch nothing.

    With 64 iterations the guard restarts once more or less, by the rounding of energies that hardly change.
    """
    bodies = two_cubes()
    plain = falling(*bodies, g=0.0)
    velocities = torch.tensor(each(plain, (1.0, 0.2, 0.0), (-1.0, 0.0, 0.0)))
    reference = contact_scene(plain, thickness=THICKNESS, friction=friction)
    scene = pd.Scene(*bodies, pd.Contact(thickness=THICKNESS, friction=friction))
    sim = pd.Simulator(scene, H, iterations, pd.Chebyshev(relaxation=1.9), torch.float64, progress=False)
    state = pd.HistoryState(sim.rest_positions[None].clone(), velocities[None], sim.rest_state().history)
    x: Tensor = sim.rest_positions
    v, history, touched = velocities, None, False
    for _ in range(2):
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
