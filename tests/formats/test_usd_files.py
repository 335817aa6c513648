"""USD files: meshes and tet meshes in metres, y up, where their transforms put them."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from torchpd import MeshWarning, TetMesh, TriMesh

pytest.importorskip("pxr", reason="USD files need usd-core")
from pxr import Gf, Sdf, Usd, UsdGeom

BOX = np.array([[x, y, z] for z in (0.0, 3.0) for y in (0.0, 2.0) for x in (0.0, 1.0)])
QUADS = [[2, 3, 1, 0], [4, 5, 7, 6], [0, 1, 5, 4], [3, 2, 6, 7], [1, 3, 7, 5], [2, 0, 4, 6]]
TET = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])


def new_stage(unit: float = 1.0) -> Any:
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, unit)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    return stage


def add_box(stage: Any, path: str = "/box", faces: list[list[int]] | None = None) -> Any:
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr([tuple(point) for point in BOX])
    mesh.CreateFaceVertexCountsAttr([len(face) for face in faces or QUADS])
    mesh.CreateFaceVertexIndicesAttr([k for face in faces or QUADS for k in face])
    mesh.CreateSubdivisionSchemeAttr("none")
    return mesh


def add_tet(stage: Any, path: str = "/tet") -> Any:
    mesh = UsdGeom.TetMesh.Define(stage, path)
    mesh.CreatePointsAttr([tuple(point) for point in TET])
    mesh.CreateTetVertexIndicesAttr([Gf.Vec4i(0, 1, 2, 3)])
    mesh.CreateSurfaceFaceVertexIndicesAttr([Gf.Vec3i(*face) for face in ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))])
    return mesh


def write(stage: Any, path: Path) -> Path:
    assert stage.GetRootLayer().Export(str(path))
    return path


def read(stage: Any, path: Path) -> TriMesh:
    """The surface of a stage of which nothing has to be said."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return TriMesh.from_file(write(stage, path))


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usd"])
def test_meshes_are_read_where_they_are(tmp_path: Path, suffix: str) -> None:
    stage = new_stage()
    top = UsdGeom.Xform.Define(stage, "/top")
    top.AddTranslateOp().Set((5, 0, 0))
    top.AddRotateZOp().Set(90)
    add_box(stage, "/top/one")
    mirrored = add_box(stage, "/top/two")
    mirrored.AddScaleOp().Set((-2, 1, 1))
    left = add_box(stage, "/top/three", [face[::-1] for face in QUADS])
    left.CreateOrientationAttr("leftHanded")
    both = add_box(stage, "/top/four", [face[::-1] for face in QUADS])
    both.CreateOrientationAttr("leftHanded")
    both.AddScaleOp().Set((-2, 1, 1))
    surface = read(stage, tmp_path / f"a{suffix}")
    x, y, z = BOX.T
    one, two, three, four = surface.vertices.reshape(4, 8, 3)
    np.testing.assert_allclose(one, np.stack([5 - y, x, z], axis=1), atol=1e-12)
    np.testing.assert_allclose(two, np.stack([5 - y, -2 * x, z], axis=1), atol=1e-12)
    np.testing.assert_array_equal(three, one)
    np.testing.assert_array_equal(four, two)
    assert surface.volume() == pytest.approx((1 + 2 + 1 + 2) * 6.0)


def test_units_and_axes_are_read(tmp_path: Path) -> None:
    stage = new_stage(0.01)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    add_box(stage)
    with pytest.warns(MeshWarning, match=r"unit is 0\.01 m.*z axis is up"):
        surface = TriMesh.from_file(write(stage, tmp_path / "a.usda"))
    np.testing.assert_allclose(surface.bounds, [[0, 0, -0.02], [0.01, 0.03, 0]], atol=1e-12)
    assert surface.volume() == pytest.approx(6e-6)
    stage = Usd.Stage.CreateInMemory()
    add_box(stage)
    with pytest.warns(MeshWarning, match=r"no metersPerUnit"):
        surface = TriMesh.from_file(write(stage, tmp_path / "b.usda"))
    np.testing.assert_array_equal(surface.vertices, BOX)


def test_tet_meshes_become_bodies(tmp_path: Path) -> None:
    stage = new_stage()
    right = add_tet(stage, "/one")
    UsdGeom.Subset.CreateGeomSubset(right, "heart", UsdGeom.Tokens.tetrahedron, [0])
    left = add_tet(stage, "/two")
    left.CreateTetVertexIndicesAttr([Gf.Vec4i(0, 1, 3, 2)])
    left.CreateOrientationAttr("leftHanded")
    left.AddTranslateOp().Set((4, 0, 0))
    with pytest.warns(MeshWarning, match="region 1 is the subset heart") as said:
        mesh = TetMesh.from_file(write(stage, tmp_path / "a.usdc"))
    assert len(said) == 1
    np.testing.assert_array_equal(mesh.vertices, np.vstack([TET, TET + [4, 0, 0]]))
    np.testing.assert_array_equal(mesh.tets, [[0, 1, 2, 3], [4, 5, 6, 7]])
    assert mesh.regions is not None
    assert mesh.regions.tolist() == [1, 0]
    assert mesh.embedding is not None
    assert len(mesh.embedding.surface.triangles) == 8


def test_instances_and_texture_coordinates(tmp_path: Path) -> None:
    stage = new_stage()
    source = add_box(stage, "/source/mesh")
    stage.GetPrimAtPath("/source").SetSpecifier(Sdf.SpecifierClass)  # it is not drawn itself
    for number in range(2):
        copy = UsdGeom.Xform.Define(stage, f"/copy{number}")
        copy.GetPrim().GetReferences().AddInternalReference("/source")
        copy.GetPrim().SetInstanceable(True)
        copy.AddTranslateOp().Set((10.0 * number, 0, 0))
    primvar = UsdGeom.PrimvarsAPI(source).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray)
    primvar.SetInterpolation(UsdGeom.Tokens.vertex)
    primvar.Set([(float(x), float(y)) for x, y, _ in BOX])
    surface = read(stage, tmp_path / "a.usda")
    np.testing.assert_array_equal(surface.bounds, [[0, 0, 0], [11, 2, 3]])
    np.testing.assert_array_equal(surface.uvs, np.vstack([BOX[:, :2]] * 2))
    primvar.SetInterpolation(UsdGeom.Tokens.faceVarying)
    primvar.Set([(float(k), 0.0) for k in range(24)])
    assert len(read(stage, tmp_path / "b.usda").vertices) == 48  # every corner has its own


def test_what_is_left_out_is_said(tmp_path: Path) -> None:
    stage = new_stage()
    mesh = add_box(stage)
    mesh.CreateSubdivisionSchemeAttr("loop")
    mesh.CreateHoleIndicesAttr([1])
    mesh.GetPointsAttr().Clear()
    for time in (3.0, 4.0):
        mesh.GetPointsAttr().Set([tuple(point * time) for point in BOX], time)
    add_box(stage, "/guide").CreatePurposeAttr("guide")
    add_box(stage, "/hidden").CreateVisibilityAttr("invisible")
    UsdGeom.Sphere.Define(stage, "/ball")
    UsdGeom.Mesh.Define(stage, "/nothing")
    UsdGeom.PointInstancer.Define(stage, "/many")
    with pytest.warns(MeshWarning, match="PointInstancer") as said:
        surface = TriMesh.from_file(write(stage, tmp_path / "a.usdc"))
    np.testing.assert_array_equal(surface.bounds, [[0, 0, 0], [3, 6, 9]])
    assert len(surface.triangles) == 10
    words = str(said[0].message)
    for part in (
        "Mesh of purpose guide (1)", "invisible Mesh (1)", "Sphere (1)",
        "Mesh without faces (1)", "PointInstancer (1)", "declared holes (1)",
        "to be subdivided (loop)", "1 of its meshes move, and were read at their earliest time",
    ):  # fmt: skip
        assert part in words


def test_a_stage_without_meshes_says_what_it_has(tmp_path: Path) -> None:
    stage = new_stage()
    UsdGeom.Sphere.Define(stage, "/ball")
    with pytest.raises(ValueError, match=r"a\.usda holds no triangles.*Sphere \(1\)"):
        TriMesh.from_file(write(stage, tmp_path / "a.usda"))


def test_usd_files_that_break_their_word_are_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    def refuse(path: Path, match: str) -> None:
        with pytest.raises(ValueError, match=rf"cannot read {path.name} \(USD\): .*{match}"):
            TriMesh.from_file(path)

    stage = new_stage()
    mesh = add_box(stage)
    mesh.CreateFaceVertexCountsAttr([4] * 5)
    refuse(write(stage, tmp_path / "a.usda"), "/box has 24 faceVertexIndices; its faceVertexCounts add up to 20")
    mesh.CreateFaceVertexCountsAttr([4] * 6)
    mesh.CreateFaceVertexIndicesAttr([8] * 24)
    refuse(write(stage, tmp_path / "b.usda"), "points of /box that are not there: 8")
    (tmp_path / "c.usda").write_text('#usda 1.0\ndef "part" (references = @./lost.usda@) {}\n')
    refuse(tmp_path / "c.usda", "cannot read the whole of it: .*lost.usda")
    data = write(new_stage(), tmp_path / "d.usdc").read_bytes()
    (tmp_path / "d.usdc").write_bytes(data[:-1])
    refuse(tmp_path / "d.usdc", "names more than the")
    (tmp_path / "e.usda").write_text('#usda 1.0\ndef Mesh "a" { point3f[] points = [(1, 2] }\n')
    refuse(tmp_path / "e.usda", "parse error")
    assert capfd.readouterr() == ("", "")


def test_the_package_that_usd_needs_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(new_stage(), tmp_path / "a.usda")
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(ModuleNotFoundError, match=r"cannot read a\.usda .*pip install usd-core"):
        TriMesh.from_file(path)
