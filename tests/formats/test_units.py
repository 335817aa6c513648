"""`unit` says in which unit a file is, once; what is made of it is in metres."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from pxr import Usd, UsdGeom

import torchpd as pd

BAR = trimesh.creation.box((40.0, 10.0, 10.0))
LENGTHS = {"m": 40.0, "cm": 0.4, "mm": 0.04, "in": 1.016, "ft": 12.192}  # of forty units [m]


@pytest.mark.parametrize(("unit", "length"), LENGTHS.items())
def test_numbers_of_a_file_become_metres(unit: Any, length: float, tmp_path: Path) -> None:
    pd.shapes.box((40.0, 10.0, 10.0), (4, 1, 1)).to_file(tmp_path / "bar.vtk")
    BAR.export(tmp_path / "bar.stl")
    made = [
        pd.TetMesh.from_file(tmp_path / "bar.vtk", unit=unit),
        pd.TriMesh.from_file(tmp_path / "bar.stl", unit=unit),
        pd.TriMesh.from_trimesh(BAR, unit=unit),
        pd.tetrahedralize(tmp_path / "bar.stl", cells=4, unit=unit).embedding.surface,
        pd.tetrahedralize(BAR, cells=4, unit=unit).embedding.surface,
    ]
    for mesh in made:
        assert np.ptp(mesh.bounds, axis=0).max() == pytest.approx(length, rel=1e-12)


def test_a_declared_unit_is_not_overruled(tmp_path: Path) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "bar.usda"))
    shape = UsdGeom.Mesh.Define(stage, "/bar")
    shape.CreatePointsAttr(BAR.vertices.tolist())
    shape.CreateFaceVertexCountsAttr([3] * len(BAR.faces))
    shape.CreateFaceVertexIndicesAttr(BAR.faces.reshape(-1).tolist())
    stage.Save()
    with pytest.warns(pd.MeshWarning, match="declares no metersPerUnit"):
        assert np.ptp(pd.TriMesh.from_file(tmp_path / "bar.usda", unit="mm").bounds) == pytest.approx(0.04)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.Save()
    with pytest.raises(ValueError, match=r"unit must be None for bar\.usda, .*got 'mm'"):
        pd.TriMesh.from_file(tmp_path / "bar.usda", unit="mm")


@pytest.mark.parametrize("unit", ["inch", 0.001])
def test_other_units_are_named(unit: Any, tmp_path: Path) -> None:
    BAR.export(tmp_path / "bar.stl")
    with pytest.raises(ValueError, match=rf"unit .*'m', 'cm', 'mm', 'in', 'ft' .*got {unit!r}"):
        pd.TriMesh.from_file(tmp_path / "bar.stl", unit=unit)
    with pytest.raises(ValueError, match="unit must be None for a TriMesh"):
        pd.tetrahedralize(pd.TriMesh.from_trimesh(BAR), unit="mm")
