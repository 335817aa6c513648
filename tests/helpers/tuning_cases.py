"""Beams to tune, and how wrong their steps are."""

from __future__ import annotations

import torchpd as pd
from torchpd.accuracy.error import exact_steps, frictionless

CANDIDATES = ["guarded Chebyshev", "damped Jacobi", "Multilevel"]  # of `tune`, in its order


def bar(youngs: float = 1e5, time_step: float = 1 / 60, **options: object) -> pd.Simulator:
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (6, 2, 2))
    body = pd.Solid(mesh, youngs=youngs)
    scene = pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity())
    return pd.Simulator(scene, time_step, progress=False, **options)  # type: ignore[arg-type]


def swinging(sim: pd.Simulator, batch: int = 1, speed: float = 5.0) -> pd.State:
    state = sim.rest_state(batch)
    state.velocities[..., 1] = -speed * state.positions[..., 0] ** 2
    return state


def worst_error(sim: pd.Simulator, state: pd.State) -> float:
    """Of one step of each environment."""
    smooth = frictionless(sim)
    after = smooth(state).velocities.double().numpy() * sim.time_step
    steps = exact_steps(sim, state)
    return max(step.error_beyond_rounding(u, sim.dtype) for step, u in zip(steps, after, strict=True))
