"""A cube that comes to rest, for tests of the forces on it."""

from __future__ import annotations

from typing import Any

import torch
from cases import box

import torchpd as pd

SIDE = 0.2  # m, of the cube
MESH = pd.TetMesh(*box((SIDE, SIDE, SIDE), (2, 2, 2)))
G = 9.81


def cube(*parts: Any, youngs: float = 1e5, iterations: int = 400, **options: Any) -> tuple[pd.Simulator, pd.Solid]:
    solid = pd.Solid(MESH, youngs=youngs, density=1000.0)
    given = {"dtype": torch.float64, "progress": False, **options}
    return pd.Simulator(pd.Scene(solid, *parts), 1 / 60, iterations, **given), solid


def settled(sim: pd.Simulator, steps: int = 200, batch: int = 1) -> tuple[pd.State, pd.State]:
    """The last step of a rollout."""
    state = sim.rollout(sim.rest_state(batch), steps).state()
    return state, sim(state)


def weight(sim: pd.Simulator) -> float:
    return G * float(sim.masses.sum())
