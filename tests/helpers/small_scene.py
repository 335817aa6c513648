"""A small scene with every effect, and the step op with some of its arguments replaced."""

from __future__ import annotations

from typing import Any

import torch
from cases import box

import torchpd as pd

ops = torch.ops.torchpd


def body() -> pd.Solid:
    return pd.Solid(pd.TetMesh(*box((0.2, 0.2, 0.2), (2, 2, 2))), youngs=1e5)


def scene() -> pd.Scene:
    solid = body()
    return pd.Scene(
        solid, pd.Pin(solid, [0, 1]), pd.Pin(solid, [5], 1e3), pd.Gravity(), pd.Ground(), pd.Sphere((0, -1, 0), 0.5)
    )


def small_simulator() -> pd.Simulator:
    return pd.Simulator(scene(), 1 / 60, 2)


def settings(sim: pd.Simulator, **changed: Any) -> dict[str, Any]:
    return {**sim.step_settings(inertial=False, report=False), "iterations": 2, **changed}


def call_step(sim: pd.Simulator, **changed: Any) -> Any:
    """The op, with some arguments replaced."""
    state = sim.rest_state(2)
    tensors = {
        "positions": state.positions, "velocities": state.velocities, "forces": None, "start": None,
        "material": sim.material(), "plan": list(sim.plan.arrays),
    }  # fmt: skip
    keywords = settings(sim, **{k: v for k, v in changed.items() if k not in tensors})
    return ops.step(*(changed.get(name, tensor) for name, tensor in tensors.items()), **keywords)
