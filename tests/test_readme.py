"""Every block of Python in README.md and docs/ runs, those of a file one after another, with smaller numbers."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from devices import missing_gpu
from programs import ROOT

import torchpd as pd

SMALLER = {
    "cells=12": "cells=4", "batch=32": "batch=2", "rand(32, 1)": "rand(2, 1)", "steps=60": "steps=2",
    "batch=1024": "batch=2", "batch=64": "batch=2", "steps=120": "steps=2", "range(120)": "range(2)",
    "quadrics=100, patches=400": "quadrics=4, patches=60", "(512, 384)": "(16, 12)",
}  # fmt: skip


# blocks of each
FILES = {
    "README.md": 4,
    "docs/accuracy.md": 2,
    "docs/distributed.md": 1,
    "docs/gpu.md": 2,
    "docs/patches.md": 1,
    "docs/readouts.md": 4,
}


def blocks(file: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / file).read_text(encoding="utf-8"), re.DOTALL)


def test_every_file_with_code_is_tried() -> None:
    files = [path.relative_to(ROOT).as_posix() for path in (ROOT / "README.md", *ROOT.glob("docs/*.md"))]
    assert {file: len(blocks(file)) for file in files if blocks(file)} == FILES
    assert all(any(usual in block for file in FILES for block in blocks(file)) for usual in SMALLER)


def stiff_middle() -> pd.Scene:
    """What the block with RigidPieces takes for granted."""
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (10, 2, 2))
    middle = np.abs(mesh.vertices[mesh.tets].mean(axis=1)[:, 0]) < 0.2
    assert 0 < middle.sum() < len(middle)
    return pd.Scene(pd.Solid(mesh, youngs=np.where(middle, 1e7, 1e4)), pd.Gravity())


def one_rank() -> dict[str, Any]:
    """What the block about saving takes for granted: rank 0 of a training with a network and a simulator."""
    wrapped = SimpleNamespace(module=SimpleNamespace(network=torch.nn.Linear(2, 3)))
    sim = pd.Simulator(stiff_middle(), iterations=256, progress=False)
    return {"dist": SimpleNamespace(get_rank=lambda: 0), "model": wrapped, "sim": sim}


def swinging() -> tuple[pd.Simulator, pd.State]:
    """What the blocks with `tune` take for granted."""
    sim = pd.Simulator(stiff_middle(), iterations=256, progress=False)
    state = sim.rest_state()
    state.velocities[..., 1] = state.positions[..., 0] ** 2
    return sim, state


@pytest.mark.parametrize("file", FILES)
def test_every_block_runs(
    file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    body = trimesh.creation.icosphere(subdivisions=2)
    body.apply_scale([1.0, 0.7, 0.8])
    body.export("spot.obj")
    values: dict[str, Any] = {}
    if file != "README.md":  # which says what to import
        values = {"torch": torch, "trimesh": trimesh, "pd": pd, "scene": stiff_middle()}
    names: dict[str, torch.Tensor] = {}
    for block in blocks(file):
        if '"cuda"' in block and missing_gpu():
            continue
        for usual, fewer in SMALLER.items():
            block = block.replace(usual, fewer)
        if "dist.get_rank" in block:
            values |= one_rank()
        if "sim.tune" in block:
            values["sim"], values["state"] = swinging()
        if "RigidPieces" in block:
            values["scene"] = stiff_middle()
            values["state"] = pd.Simulator(values["scene"], iterations=256, progress=False).rest_state()
        torch.manual_seed(0)
        exec(block, values)
        names |= {name: value for name, value in values.items() if isinstance(value, torch.Tensor)}
    assert all(bool(value.isfinite().all()) for value in names.values())
    if file == "README.md":
        assert names
        assert "Simulator(" in capsys.readouterr().out
    if "patches" in "".join(blocks(file)):
        assert (tmp_path / "spot.glb").stat().st_size > 0
