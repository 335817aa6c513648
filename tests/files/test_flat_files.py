"""Files of flat cloth from before such scenes left `rest_curvature` out."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

import torchpd as pd
from torchpd.api import simulator as api
from torchpd.files.simulation_file import load_simulation


def saved_sheet(path: str) -> pd.Simulator:
    mesh = pd.TriMesh([[0, 0, 0], [1, 0, 0], [0, 0, 1], [1, 0, 1]], [[0, 2, 1], [1, 2, 3]])
    sim = pd.Simulator(pd.Scene(pd.Cloth(mesh, 1e5, 1e-3, 0.2), pd.Gravity()), progress=False)
    sim.save(path)
    return sim


def test_zeros_of_flat_hinges_are_left_out(tmp_path: Path) -> None:
    path = str(tmp_path / "flat.sim")
    sim, saved = saved_sheet(path), load_simulation(path)
    former = {**saved.material, "rest_curvature": torch.zeros(1)}
    restored = api._restored(dataclasses.replace(saved, material=former, trained=[*saved.trained, "rest_curvature"]))
    assert restored.material_names == sim.material_names
    assert torch.equal(restored(sim.rest_state()).positions, sim(sim.rest_state()).positions)


def test_a_curvature_of_a_flat_scene_is_refused(tmp_path: Path) -> None:
    path = str(tmp_path / "flat.sim")
    saved_sheet(path)
    saved = load_simulation(path)
    with pytest.raises(TypeError, match="no array 'rest_curvature'"):
        api._restored(dataclasses.replace(saved, material={**saved.material, "rest_curvature": torch.ones(1)}))
