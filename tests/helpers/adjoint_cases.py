"""A body whose gradients are looked at, in float64."""

from __future__ import annotations

import torch

import torchpd as pd

__all__ = ["body"]


def body(*extra: pd.scene.Part, iterations: int = 600) -> tuple[pd.Simulator, pd.State]:
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (4, 2, 2))
    solid = pd.Solid(mesh, youngs=2e4, density=1000.0)
    parts = [
        pd.Pin(solid, mesh.vertices[:, 0] == 0.0),
        pd.Pin(solid, mesh.vertices[:, 0] == 1.0, stiffness=50.0),
        pd.Gravity(),
        pd.Damping(0.5),
    ]
    sim = pd.Simulator(pd.Scene(solid, *parts, *extra), 1 / 30, iterations, dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    noise = [torch.randn(sim.rest_state(2).positions.shape, generator=generator, dtype=torch.float64) for _ in range(2)]
    state = sim.rest_state(2)
    return sim, pd.State(state.positions + 0.01 * noise[0], 0.3 * noise[1])
