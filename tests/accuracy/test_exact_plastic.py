"""Exact steps of plastic solids start from the flow of the state."""

from __future__ import annotations

import numpy as np
import torch

import torchpd as pd
from torchpd.accuracy.error import exact_steps


def test_an_exact_step_goes_on_from_the_flow_of_its_state() -> None:
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (6, 1, 1))
    body = pd.Solid(mesh, youngs=1e6, poisson=0.3, plastic=pd.Plastic(yield_strain=0.02))
    scene = pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity())
    sim = pd.Simulator(scene, 1 / 60, iterations=2000, dtype=torch.float64, progress=False)
    state = sim.rest_state()
    state.velocities[..., 1] = -10.0 * state.positions[..., 0] ** 2
    for _ in range(3):
        state = sim(state)
    assert state.history.flow[..., -1].max() > 0.05
    (step,) = exact_steps(sim, state)
    reached = (sim(state).velocities[0] * sim.time_step).detach().numpy()
    assert step.uncertainty <= 1e-10
    np.testing.assert_allclose(step.solution, reached, rtol=0.0, atol=1e-9 * np.abs(reached).max())
