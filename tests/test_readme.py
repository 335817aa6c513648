"""Every block of Python in the README runs, one after another, with smaller numbers."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from devices import missing_gpu

import torchpd as pd

SMALLER = {
    "cells=12": "cells=4", "batch=32": "batch=2", "rand(32, 1)": "rand(2, 1)", "steps=60": "steps=2",
    "batch=1024": "batch=2", "batch=64": "batch=2", "steps=120": "steps=2", "range(120)": "range(2)",
    "quadrics=100, patches=400": "quadrics=4, patches=60", "(512, 384)": "(16, 12)",
}  # fmt: skip


def blocks() -> list[str]:
    text = (Path(__file__).parents[1] / "README.md").read_text()
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


def stiff_middle() -> pd.Scene:
    """What the block with RigidPieces takes for granted."""
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (10, 2, 2))
    middle = np.abs(mesh.vertices[mesh.tets].mean(axis=1)[:, 0]) < 0.2
    assert 0 < middle.sum() < len(middle)
    return pd.Scene(pd.Solid(mesh, youngs=np.where(middle, 1e7, 1e4)), pd.Gravity())


def swinging() -> tuple[pd.Simulator, pd.State]:
    """What the block with `tune` takes for granted."""
    sim = pd.Simulator(stiff_middle(), iterations=256, progress=False)
    state = sim.rest_state()
    state.velocities[..., 1] = state.positions[..., 0] ** 2
    return sim, state


def test_every_block_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    body = trimesh.creation.icosphere(subdivisions=2)
    body.apply_scale([1.0, 0.7, 0.8])
    body.export("spot.obj")
    found, names, used = blocks(), {}, set[str]()
    assert len(found) == 6
    values: dict[str, Any] = {}
    for block in found:
        small = block
        for usual, fewer in SMALLER.items():
            used |= {usual} if usual in small else set()
            small = small.replace(usual, fewer)
        if '"cuda"' in block and missing_gpu():
            continue
        if "sim.tune" in block:
            values["sim"], values["state"] = swinging()
        if "RigidPieces" in block:
            values["scene"] = stiff_middle()
            values["state"] = pd.Simulator(values["scene"], iterations=256, progress=False).rest_state()
        torch.manual_seed(0)
        exec(small, values)
        names |= {name: value for name, value in values.items() if isinstance(value, torch.Tensor)}
    assert used == set(SMALLER)
    assert all(bool(value.isfinite().all()) for value in names.values())
    assert "Simulator(" in capsys.readouterr().out
    assert (tmp_path / "spot.glb").stat().st_size > 0
