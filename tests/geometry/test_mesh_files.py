"""Files of meshes: what survives them, what they cannot hold, and what is said of those that do not fit."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import meshio
import numpy as np
import pytest
import trimesh
from mesh_cases import jittered_box, signed_volumes

from torchpd import MeshWarning, TetMesh, TriMesh
from torchpd.geometry import shapes
from torchpd.geometry.embedding import embed_triangles
from torchpd.scene.effects import Solid

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
TET = np.array([[0, 1, 2, 3]])


@pytest.mark.parametrize("suffix", [".mesh", ".msh", ".vtk", ".vtu"])
def test_tets_survive_a_file(tmp_path: Path, suffix: str) -> None:
    mesh = jittered_box()
    mesh.to_file(tmp_path / f"box{suffix}")
    again = TetMesh.from_file(tmp_path / f"box{suffix}")
    np.testing.assert_array_equal(again.tets, mesh.tets)
    np.testing.assert_allclose(again.vertices, mesh.vertices, atol=1e-15)


def test_triangles_of_a_volume_file_ride_along(tmp_path: Path) -> None:
    mesh = jittered_box()
    meshio.Mesh(mesh.vertices, [("tetra", mesh.tets), ("triangle", mesh.boundary())]).write(tmp_path / "both.vtu")
    both = TetMesh.from_file(tmp_path / "both.vtu")
    assert both.embedding is not None
    np.testing.assert_array_equal(both.embedding.apply(both.vertices), both.embedding.surface.vertices)
    assert both.embedding.surface.volume() == pytest.approx(signed_volumes(mesh).sum(), rel=1e-12)
    surface = TriMesh.from_file(tmp_path / "both.vtu")
    np.testing.assert_array_equal(surface.triangles, both.embedding.surface.triangles)


def test_unreferenced_vertices_of_a_file_are_dropped_and_reported(tmp_path: Path) -> None:
    meshio.Mesh(np.vstack([CORNERS, [[5.0, 5, 5]]]), [("tetra", TET)]).write(tmp_path / "loose.vtk")
    with pytest.warns(MeshWarning, match="1 of 5 vertices"):
        mesh = TetMesh.from_file(tmp_path / "loose.vtk")
    assert len(mesh.vertices) == 4


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".stl", ".glb"])
def test_surfaces_survive_a_file(tmp_path: Path, suffix: str) -> None:
    mesh = shapes.box((1.0, 2.0, 3.0), (2, 2, 2))
    surface = embed_triangles(mesh.vertices, mesh.tets, mesh.boundary()).surface
    surface.to_file(tmp_path / f"box{suffix}")
    again = TriMesh.from_file(tmp_path / f"box{suffix}")
    assert len(again.triangles) == len(surface.triangles)
    # The formats keep float32 at least: relative 6e-8 in each of three coordinates.
    assert again.volume() == pytest.approx(6.0, rel=1e-6)


def test_texture_coordinates_and_quads_survive(tmp_path: Path) -> None:
    lines = ["v 0 0 0", "v 1 0 0", "v 1 1 0", "v 0 1 0", "vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1", "f 1/1 2/2 3/3 4/4"]
    (tmp_path / "quad.obj").write_text("\n".join(lines) + "\n")
    surface = TriMesh.from_file(tmp_path / "quad.obj")
    assert len(surface.triangles) == 2
    assert surface.uvs is not None
    np.testing.assert_allclose(surface.uvs, surface.vertices[:, :2])
    assert TriMesh.from_trimesh(surface.to_trimesh()).uvs is not None


def test_scenes_are_joined_with_their_places() -> None:
    one = trimesh.creation.box((1, 1, 1))
    scene = trimesh.Scene()
    scene.add_geometry(one)
    scene.add_geometry(one, transform=trimesh.transformations.translation_matrix([3, 0, 0]))
    surface = TriMesh.from_trimesh(scene)
    np.testing.assert_allclose(surface.bounds, [[-0.5, -0.5, -0.5], [3.5, 0.5, 0.5]])
    scene.add_geometry(trimesh.PointCloud(np.zeros((1, 3))))
    with pytest.warns(MeshWarning, match=r"left out: PointCloud"):
        assert len(TriMesh.from_trimesh(scene).triangles) == 24
    with pytest.raises(TypeError, match=r"surface .*got int"):
        TriMesh.from_trimesh(3)


def test_files_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no such mesh file: .*nothing\.mesh"):
        TetMesh.from_file(tmp_path / "nothing.mesh")
    with pytest.raises(FileNotFoundError, match="no such mesh file"):
        TriMesh.from_file(tmp_path / "nothing.obj")
    (tmp_path / "broken.vtu").write_text("this is not a mesh")
    with pytest.raises(ValueError, match=r"cannot read broken\.vtu"):
        TetMesh.from_file(tmp_path / "broken.vtu")
    (tmp_path / "what.xyzzy").write_text("this is not a mesh")
    for kind in (TetMesh, TriMesh):
        with pytest.raises(ValueError, match=r"cannot read what\.xyzzy"):
            kind.from_file(tmp_path / "what.xyzzy")
    surface_file = tmp_path / "surface.vtk"
    meshio.Mesh(CORNERS[:3], [("triangle", [[0, 1, 2]])]).write(surface_file)
    with pytest.raises(ValueError, match=r"must hold tetrahedra.*got a surface .*triangle.*torchpd\.tetrahedralize"):
        TetMesh.from_file(surface_file)
    # texture coordinates that are not one a vertex stop meshio
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS[:3]) + "vt 0 0\nvt 1 0\nvt 0 1\nvt 1 1\n"
    (tmp_path / "textured.obj").write_text(corners + "f 1/1 2/2 3/4\n")
    assert len(TriMesh.from_file(tmp_path / "textured.obj").triangles) == 1
    with pytest.raises(ValueError, match=r"textured\.obj .*got a surface .*torchpd\.tetrahedralize"):
        TetMesh.from_file(tmp_path / "textured.obj")
    shapes.single_tet().to_file(tmp_path / "tets.vtk")
    with pytest.raises(ValueError, match="holds no triangles"):
        TriMesh.from_file(tmp_path / "tets.vtk")


def test_a_file_says_what_it_leaves_out(tmp_path: Path) -> None:
    mesh = shapes.single_tet()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh.to_file(tmp_path / "bare.vtu")
    carrying = mesh.with_embedding(embed_triangles(mesh.vertices, mesh.tets, mesh.boundary()))
    with pytest.warns(MeshWarning, match=r"a\.vtu .*surface.*Simulator\.save"):
        carrying.to_file(tmp_path / "a.vtu")
    partly = TetMesh(mesh.vertices, mesh.tets, fill=[0.5])
    with pytest.warns(MeshWarning, match=r"b\.vtu .*fill"):
        partly.to_file(tmp_path / "b.vtu")


@pytest.mark.parametrize(
    "name", ["tets.xyz", "tets", "tets.stl", "tets.obj", "tets.svg", "tets.ply", "tets.wkt", "tets.ugrid"]
)
def test_files_that_cannot_hold_tets_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match=rf"cannot write .*{name}.*must end in \.mesh, \.msh, \.vtk or \.vtu"):
        shapes.single_tet().to_file(tmp_path / name)


def test_a_folder_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"TetMesh\.to_file: there .*folder .*nowhere for tets\.vtu"):
        shapes.single_tet().to_file(tmp_path / "nowhere" / "tets.vtu")


def test_what_is_wrong_with_a_file_is_said(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "broken.mesh").write_text("MeshVersionFormatted 2\nDimension 3\nVertices\n2\n0 0\n")
    with pytest.raises(ValueError, match=r"cannot read broken\.mesh \(Medit\): Vertices should be 8 numbers"):
        TetMesh.from_file(tmp_path / "broken.mesh")
    (tmp_path / "hello.mesh").write_text("hello\n")
    with pytest.raises(ValueError, match=r"cannot read hello\.mesh \(Medit\): .* MeshVersionFormatted, got 'hello'"):
        TetMesh.from_file(tmp_path / "hello.mesh")
    assert capfd.readouterr() == ("", "")
    (tmp_path / "what.xyz").write_text("0 0 0")
    with pytest.raises(ValueError, match=r"cannot read what\.xyz: .*must end in \.mesh, \.msh, \.vtk or \.vtu"):
        TetMesh.from_file(tmp_path / "what.xyz")


# Regions:


@pytest.mark.parametrize("suffix", [".mesh", ".msh", ".vtk", ".vtu"])
def test_regions_survive_a_file(tmp_path: Path, suffix: str) -> None:
    box = jittered_box()
    mesh = TetMesh(box.vertices, box.tets, regions=np.arange(len(box.tets)) % 3 + 1)
    mesh.to_file(tmp_path / f"box{suffix}")
    again = TetMesh.from_file(tmp_path / f"box{suffix}")
    np.testing.assert_array_equal(again.regions, mesh.regions)
    for other in (mesh.transformed(np.diag([1.0, -1.0, 1.0])), mesh.with_embedding(None)):
        np.testing.assert_array_equal(other.regions, mesh.regions)
    youngs = np.where(mesh.regions == 2, 1e6, 1e5)
    assert Solid(mesh, youngs).youngs[1] == 1e6
    assert box.regions is None


@pytest.mark.parametrize(
    "name", ["a.avs", "a.bdf", "a.dato", "a.f3grid", "a.inp", "a.mdpa", "a.nas", "a.node", "a.xml"]
)
def test_formats_without_regions_say_so_and_keep_the_tets(tmp_path: Path, name: str) -> None:
    box = shapes.box((1.0, 1.0, 1.0), (2, 2, 2))
    mesh = TetMesh(box.vertices, box.tets, regions=np.arange(len(box.tets)) % 3 + 1)
    with pytest.warns(MeshWarning, match=rf"{name} omits the regions; \.mesh, .* hold them"):
        mesh.to_file(tmp_path / name)
    again = TetMesh.from_file(tmp_path / name)
    np.testing.assert_array_equal(again.tets, mesh.tets)
    assert again.regions is None


def test_numbers_that_do_not_fit_a_format_are_refused(tmp_path: Path) -> None:
    mesh = TetMesh([[-1.23456789012e-3, 0.0, 0.0], *CORNERS[1:]], TET)  # a column of .nas is 16 characters wide
    with pytest.raises(ValueError, match=r"cannot write .*a\.nas .*numbers"):
        mesh.to_file(tmp_path / "a.nas")


@pytest.mark.parametrize("suffix", [".dat", ".meshb", ".tec"])
def test_other_formats_that_keep_regions_do_not_warn(tmp_path: Path, suffix: str) -> None:
    mesh = TetMesh(CORNERS, TET, regions=[5])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh.to_file(tmp_path / f"a{suffix}")
    assert np.array_equal(TetMesh.from_file(tmp_path / f"a{suffix}").regions, [5])


@pytest.mark.parametrize(("name", "package"), [("a.xdmf", "h5py"), ("a.med", "h5py"), ("a.e", "netCDF4")])
def test_packages_that_a_format_needs_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, package: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ModuleNotFoundError, match=rf"to_file cannot write .*{name}: .* pip install {package}"):
        shapes.single_tet().to_file(tmp_path / name)
    if name != "a.xdmf":  # of which the head tells whether
        (tmp_path / name).write_text("of which nothing is read")
        with pytest.raises(ModuleNotFoundError, match=rf"from_file cannot read {name} .*: .* pip install {package}"):
            TetMesh.from_file(tmp_path / name)


def test_physical_groups_of_gmsh_become_regions(tmp_path: Path) -> None:
    # Two volumes, and a surface with a group of its own, which is no region of tets.
    points = np.vstack([CORNERS, [[1.0, 1.0, 1.0]]])
    blocks = [("triangle", [[0, 1, 2]]), ("tetra", TET), ("tetra", [[1, 2, 3, 4]])]
    groups = [np.array([9]), np.array([1]), np.array([2])]
    data = {"gmsh:physical": groups, "gmsh:geometrical": groups}
    meshio.Mesh(points, blocks, cell_data=data).write(tmp_path / "two.msh", file_format="gmsh22")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MeshWarning)
        mesh = TetMesh.from_file(tmp_path / "two.msh")
    assert mesh.regions is not None
    assert mesh.regions.tolist() == [1, 2]
    assert mesh.embedding is not None


def test_physical_groups_of_the_newer_format_become_regions(tmp_path: Path) -> None:
    (tmp_path / "two.msh").write_text(
        "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n"
        "$Entities\n0 0 0 2\n1 0 0 0 1 1 1 1 7 0\n2 0 0 0 1 1 1 1 8 0\n$EndEntities\n"
        "$Nodes\n1 5 1 5\n3 1 0 5\n1\n2\n3\n4\n5\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 1 1\n$EndNodes\n"
        "$Elements\n2 2 1 2\n3 1 4 1\n1 1 2 3 4\n3 2 4 1\n2 2 3 4 5\n$EndElements\n"
    )
    mesh = TetMesh.from_file(tmp_path / "two.msh")
    assert mesh.regions is not None
    assert mesh.regions.tolist() == [7, 8]


def test_bad_regions_are_refused() -> None:
    with pytest.raises(ValueError, match=r"TetMesh\.regions .*got \[2\]"):
        TetMesh(CORNERS, TET, regions=[1, 2])
    with pytest.raises(TypeError, match=r"TetMesh\.regions .*got float64"):
        TetMesh(CORNERS, TET, regions=[1.5])


def test_reading_prints_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A .msh is tried as a file of another program first, whose reader says nothing, and a line break after it."""
    path = tmp_path / "box.msh"
    box = shapes.box((1.0, 1.0, 1.0), (1, 1, 1))
    meshio.write(path, meshio.Mesh(box.vertices, [("tetra", box.tets)]), file_format="gmsh")
    capfd.readouterr()
    TetMesh.from_file(path)
    assert capfd.readouterr() == ("", "")
