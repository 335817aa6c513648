"""Readers of volume meshes: each version and encoding of a format gives the same cells."""

from __future__ import annotations

import base64
import warnings
from pathlib import Path

import meshio
import numpy as np
import pytest

from torchpd import MeshWarning, TetMesh, TriMesh
from torchpd.formats.content import MeshContent
from torchpd.formats.guard import read

POINTS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
TETS = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])
VOLUME = 0.5  # 1/6 and 1/3

# A cube, a wedge and a pyramid on it, a tet beside, and what lies on them.
PLACES = np.array(
    [
        *([0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]),
        *([0.5, 0.5, 2], [2, 0, 0.5], [2, 1, 0.5], [3, 0.5, 0.5]),
    ]
)
CELLS = {
    "tetra": ([[5, 9, 6, 11], [9, 10, 6, 11]], [4, 5]),
    "hexahedron": ([[0, 1, 2, 3, 4, 5, 6, 7]], [1]),
    "wedge": ([[1, 5, 9, 2, 6, 10]], [2]),
    "pyramid": ([[4, 5, 6, 7, 8]], [3]),
    "triangle": ([[4, 5, 8], [5, 6, 8]], [6, 6]),
    "quad": ([[0, 3, 2, 1]], [7]),
}


def mixed(name: str = "gmsh:physical") -> meshio.Mesh:
    regions = [np.array(numbers) for _, numbers in CELLS.values()]
    data = {name: regions, "gmsh:geometrical": regions} if name.startswith("gmsh") else {name: regions}
    return meshio.Mesh(PLACES, [(kind, corners) for kind, (corners, _) in CELLS.items()], cell_data=data)


def content_of(path: Path) -> MeshContent:
    return read("test", path)


def expect_mixed(content: MeshContent, *, regions: bool = True) -> None:
    np.testing.assert_allclose(content.points, PLACES, atol=1e-7)
    assert {block.kind for block in content.cells} == set(CELLS)
    for block in content.cells:
        corners, numbers = CELLS[block.kind]
        order = [0, 2, 1, 3, 5, 4] if (block.corners != corners).any() else slice(None)  # as VTK has wedges
        np.testing.assert_array_equal(block.corners[:, order], corners)
        if regions:
            assert block.regions is not None
            assert block.regions.tolist() == numbers


def tets_in(path: Path) -> TetMesh:
    """The mesh of a file of two tets."""
    mesh = TetMesh.from_file(path)
    np.testing.assert_allclose(mesh.vertices, POINTS, atol=1e-7)
    corners = mesh.vertices[mesh.tets]
    assert np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 6 == pytest.approx(VOLUME, rel=1e-6)
    return mesh


# Gmsh:


@pytest.mark.parametrize("version", ["2.2", "4.0", "4.1"])
@pytest.mark.parametrize("binary", [False, True])
def test_gmsh_of_all_versions(tmp_path: Path, version: str, binary: bool) -> None:
    mesh = mixed()
    path = tmp_path / "a.msh"
    if version == "4.1":
        mesh.point_data["gmsh:dim_tags"] = np.array([[3, 1]] * len(PLACES))
    meshio.gmsh.write(path, mesh, fmt_version=version, binary=binary)
    expect_mixed(content_of(path), regions=version == "2.2")


GMSH_NODES = "5\n" + "".join(f"{n + 1} {x:g} {y:g} {z:g}\n" for n, (x, y, z) in enumerate(POINTS))


def test_gmsh_1(tmp_path: Path) -> None:
    text = f"$NOD\n{GMSH_NODES}$ENDNOD\n$ELM\n3\n1 2 9 1 3 1 2 3\n2 4 7 1 4 1 2 3 4\n3 4 8 2 4 2 3 4 5\n$ENDELM\n"
    (tmp_path / "a.msh").write_text(text)
    mesh = tets_in(tmp_path / "a.msh")
    assert mesh.regions is not None
    assert mesh.regions.tolist() == [7, 8]
    assert mesh.embedding is not None


def gmsh(elements: str, *, names: str = "", more: str = "", version: str = "2.2") -> str:
    return (
        f"$MeshFormat\n{version} 0 8\n$EndMeshFormat\n{names}$Nodes\n{GMSH_NODES}$EndNodes\n"
        f"$Elements\n{elements}$EndElements\n{more}"
    )


def test_gmsh_beside_the_mesh(tmp_path: Path) -> None:
    names = '$PhysicalNames\n2\n3 7 "soft part"\n2 1 "skin"\n$EndPhysicalNames\n'
    elements = "2\n1 4 2 7 1 1 2 3 4\n2 4 2 0 2 2 3 4 5\n"
    data = "$ElementData\n1\nbroken\n$EndElementData\n$Comments\nwhat\n$EndComments\n$NodeData\ncut off"
    (tmp_path / "a.msh").write_bytes(gmsh(elements, names=names, more=data).replace("\n", "\r\n").encode())
    with pytest.warns(MeshWarning, match="7 is 'soft part'"):
        mesh = tets_in(tmp_path / "a.msh")
    assert mesh.regions is not None
    assert mesh.regions.tolist() == [7, 0]
    # without groups, volumes of the geometry are regions; an element of two groups comes twice
    (tmp_path / "b.msh").write_text(gmsh("2\n1 4 2 0 1 1 2 3 4\n2 4 2 0 2 2 3 4 5\n"))
    regions = tets_in(tmp_path / "b.msh").regions
    assert regions is not None
    assert regions.tolist() == [1, 2]
    (tmp_path / "c.msh").write_text(gmsh("3\n1 4 2 5 1 1 2 3 4\n2 4 2 6 2 2 3 4 5\n3 4 2 7 2 2 3 4 5\n"))
    with pytest.warns(MeshWarning, match="1 repeated elements"):
        regions = tets_in(tmp_path / "c.msh").regions
    assert regions is not None
    assert regions.tolist() == [5, 6]


def test_gmsh_with_partitions(tmp_path: Path) -> None:
    text = (
        "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Entities\n0 0 0 1\n1 0 0 0 1 1 1 1 7 0\n$EndEntities\n"
        "$PartitionedEntities\n2\n0\n0 0 0 2\n2 3 1 1 1 0 0 0 1 1 1 1 7 0\n3 3 1 1 2 0 0 0 1 1 1 0 0\n"
        "$EndPartitionedEntities\n$Nodes\n1 5 10 50\n3 2 1 5\n10\n20\n30\n40\n50\n"
        "0 0 0 .1 .1 .1\n1 0 0 .1 .1 .1\n0 1 0 .1 .1 .1\n0 0 1 .1 .1 .1\n1 1 1 .1 .1 .1\n$EndNodes\n"
        "$Elements\n2 2 1 2\n3 2 4 1\n1 10 20 30 40\n3 3 4 1\n2 20 30 40 50\n$EndElements\n"
    )
    (tmp_path / "a.msh").write_text(text)
    regions = tets_in(tmp_path / "a.msh").regions
    assert regions is not None
    assert regions.tolist() == [7, 0]


@pytest.mark.parametrize(
    ("elements", "words"),
    [
        ("3\n1 4 2 7 1 1 2 3 4\n2 4 2 7 2 2 3 4 5\n", "declares 3 elements, got 2"),
        ("1\n1 4 2 7 1 1 2 3 4\n2 4 2 7 2 2 3 4 5\n", "1 elements should have 9 numbers"),
        ("1\n1 4 2 7 1 1 2 3 6\n", "name node 6, which is missing"),
        ("1\n1 777 2 7 1 1 2 3 6\n", "type 777"),
        ("1000000000000000\n1 4 2 7 1 1 2 3 4\n", "1000000000000000 elements"),
    ],
)
def test_gmsh_counts_are_compared(tmp_path: Path, elements: str, words: str) -> None:
    (tmp_path / "a.msh").write_text(gmsh(elements))
    with pytest.raises(ValueError, match=rf"cannot read a\.msh \(Gmsh\): .*{words}"):
        TetMesh.from_file(tmp_path / "a.msh")


def test_gmsh_4_counts_are_compared(tmp_path: Path) -> None:
    nodes = "$Nodes\n1 4 1 4\n3 1 0 4\n1\n2\n3\n4\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n$EndNodes\n"
    for wrong in (nodes.replace("1 4 1 4", "1 5 1 4"), nodes):
        text = f"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n{wrong}$Elements\n1 2 1 2\n3 1 4 1\n1 1 2 3 4\n$EndElements\n"
        (tmp_path / "a.msh").write_text(text)
        with pytest.raises(ValueError, match=r"a\.msh \(Gmsh\): it declares (5 nodes, got 4|2 elements, got 1)"):
            TetMesh.from_file(tmp_path / "a.msh")


@pytest.mark.parametrize("binary", [False, True])
def test_meshes_of_fluent_share_the_suffix_of_gmsh(tmp_path: Path, binary: bool) -> None:
    path = tmp_path / "a.msh"
    meshio.ansys.write(path, mixed(), binary=binary)
    expect_mixed(content_of(path), regions=False)
    data = path.read_bytes()
    path.write_bytes(data.replace(b"(12 (0 1 8 0))", b"(12 (0 1 9 0))"))
    with pytest.raises(ValueError, match=r"a\.msh \(Gmsh\): .*Fluent .*9 cells, .*8"):
        TetMesh.from_file(path)
    path.write_bytes(data + b"(13 (2 1 1 2 3)(\n1 2 3 1 0\n))\n")
    with pytest.raises(ValueError, match="a mesh of Fluent, which lists faces"):
        TetMesh.from_file(path)
    path.write_bytes(b"(12 (1 1 2")
    with pytest.raises(ValueError, match=r"cannot read a\.msh"):
        TetMesh.from_file(path)


# VTK:


@pytest.mark.parametrize("name", ["vtk42", "vtk51"])
@pytest.mark.parametrize("binary", [False, True])
def test_legacy_vtk(tmp_path: Path, name: str, binary: bool) -> None:
    meshio.write(tmp_path / "a.vtk", mixed("MaterialIds"), file_format=name, binary=binary)
    expect_mixed(content_of(tmp_path / "a.vtk"))


@pytest.mark.parametrize(("binary", "compression"), [(False, None), (True, None), (True, "zlib"), (True, "lzma")])
@pytest.mark.parametrize("header", ["UInt32", "UInt64"])
def test_vtu_of_all_encodings(tmp_path: Path, binary: bool, compression: str | None, header: str) -> None:
    path = tmp_path / "a.vtu"
    meshio.vtu.write(path, mixed("MaterialIds"), binary=binary, compression=compression, header_type=header)
    expect_mixed(content_of(path))


def piece(arrays: dict[str, str], points: int = 5, cells: int = 2, more: str = "") -> str:
    return (
        f'<Piece NumberOfPoints="{points}" NumberOfCells="{cells}"><Points>{arrays["points"]}</Points>'
        f"<Cells>{arrays['connectivity']}{arrays['offsets']}{arrays['types']}</Cells>{more}</Piece>"
    )


def vtu(pieces: str, more: str = "", attributes: str = "") -> str:
    return (
        f'<?xml version="1.0"?><VTKFile type="UnstructuredGrid" {attributes}><UnstructuredGrid>{pieces}'
        f"</UnstructuredGrid>{more}</VTKFile>"
    )


def ascii_arrays(points: np.ndarray, tets: np.ndarray) -> dict[str, str]:
    def array(name: str, kind: str, values: np.ndarray, more: str = "") -> str:
        text = " ".join(map(str, np.ravel(values)))
        return f'<DataArray type="{kind}" Name="{name}" {more} format="ascii">{text}</DataArray>'

    return {
        "points": array("Points", "Float64", points, 'NumberOfComponents="3"'),
        "connectivity": array("connectivity", "Int64", tets),
        "offsets": array("offsets", "Int64", 4 * np.arange(1, len(tets) + 1)),
        "types": array("types", "UInt8", np.full(len(tets), 10)),
    }


@pytest.mark.parametrize("encoding", ["raw", "base64"])
def test_vtu_with_appended_data(tmp_path: Path, encoding: str) -> None:
    values = {
        "points": (POINTS.astype(">f4"), "Float32", 'NumberOfComponents="3"'),
        "connectivity": (TETS.astype(">i4"), "Int32", ""),
        "offsets": (np.array([4, 8], ">i4"), "Int32", ""),
        "types": (np.array([10, 10], "u1"), "UInt8", ""),
    }
    data, arrays = b"", {}
    for name, (value, kind, more) in values.items():
        arrays[name] = f'<DataArray type="{kind}" Name="{name}" {more} format="appended" offset="{len(data)}"/>'
        part = np.array([value.nbytes], ">u8").tobytes() + value.tobytes()
        data += part if encoding == "raw" else base64.b64encode(part)
    head, _, tail = vtu(
        piece(arrays),
        f'<AppendedData encoding="{encoding}">_@</AppendedData>',
        'byte_order="BigEndian" header_type="UInt64"',
    ).partition("@")
    (tmp_path / "a.vtu").write_bytes(head.encode() + data + tail.encode())
    np.testing.assert_array_equal(tets_in(tmp_path / "a.vtu").tets, TETS)


def test_pieces_of_vtu_share_the_points_on_their_cut(tmp_path: Path) -> None:
    first = piece(ascii_arrays(POINTS[:4], TETS[:1]), 4, 1)
    second = piece(ascii_arrays(POINTS[1:], TETS[:1]), 4, 1)
    (tmp_path / "a.vtu").write_text(vtu(first + second))
    with pytest.warns(MeshWarning, match=r"3 points .*pieces"):
        mesh = tets_in(tmp_path / "a.vtu")
    assert len(mesh.boundary()) == 6
    # the same in files of their own
    (tmp_path / "one.vtu").write_text(vtu(first))
    (tmp_path / "two.vtu").write_text(vtu(second))
    names = '<Piece Source="one.vtu"/><Piece Source="two.vtu"/>'
    text = f'<VTKFile type="PUnstructuredGrid"><PUnstructuredGrid GhostLevel="0">{names}</PUnstructuredGrid></VTKFile>'
    (tmp_path / "a.pvtu").write_text(text)
    with pytest.warns(MeshWarning, match=r"3 points .*pieces"):
        assert len(tets_in(tmp_path / "a.pvtu").boundary()) == 6
    (tmp_path / "two.vtu").unlink()
    with pytest.raises(FileNotFoundError, match=r"a\.pvtu .*'two\.vtu' is missing"):
        TetMesh.from_file(tmp_path / "a.pvtu")


def test_ghost_cells_belong_to_other_pieces(tmp_path: Path) -> None:
    ghosts = '<CellData><DataArray type="UInt8" Name="vtkGhostType" format="ascii">0 1</DataArray></CellData>'
    text = vtu(piece(ascii_arrays(POINTS, TETS), more=ghosts) + piece(ascii_arrays(POINTS[1:], TETS[:1]), 4, 1))
    (tmp_path / "a.vtu").write_text(text)
    with pytest.warns(MeshWarning, match="1 ghost cells"):
        assert len(tets_in(tmp_path / "a.vtu").tets) == 2


def test_counts_of_vtu_are_compared(tmp_path: Path) -> None:
    arrays = ascii_arrays(POINTS, TETS)
    cases = {
        "declares 6 points": piece(arrays, points=6),
        "declares 3 cells": piece(arrays, cells=3),
        "offsets of Cells must rise": piece({**arrays, "offsets": arrays["offsets"].replace("4 8", "4 9")}),
        "name point 7": piece({**arrays, "connectivity": arrays["connectivity"].replace("1 2 3 4", "1 2 3 7")}),
        "no array 'types'": piece({**arrays, "types": ""}),
        r"must .*got 'x'": piece({**arrays, "types": arrays["types"].replace("10 10", "10 x")}),
    }
    for words, text in cases.items():
        (tmp_path / "a.vtu").write_text(vtu(text))
        with pytest.raises(ValueError, match=rf"cannot read a\.vtu \(VTK XML\): .*{words}"):
            TetMesh.from_file(tmp_path / "a.vtu")


VTK_HEAD = "# vtk DataFile Version 3.0\ntitle\nASCII\nDATASET {}\nPOINTS 5 double\n0 0 0 1 0 0 0 1 0 0 0 1 1 1 1\n"
VTK_TETS = VTK_HEAD.format("UNSTRUCTURED_GRID") + "CELLS 2 10\n4 0 1 2 3\n4 1 2 3 4\nCELL_TYPES 2\n10 10\n"


def test_regions_of_vtk(tmp_path: Path) -> None:
    scalars = "SCALARS {} int 1\nLOOKUP_TABLE default\n7 8\n"
    floats = "SCALARS E double\nLOOKUP_TABLE default\n1e5 2D5\nMETADATA\nINFORMATION 0\n\n"
    path = tmp_path / "a.vtk"
    path.write_text(
        VTK_TETS + "CELL_DATA 2\n" + floats + scalars.format("mine") + "POINT_DATA 5\nVECTORS u float\nshort"
    )
    with pytest.warns(MeshWarning, match=r"'mine'.*could not be read"):
        regions = tets_in(path).regions
    assert regions is not None
    assert regions.tolist() == [7, 8]
    path.write_text(VTK_TETS + "CELL_DATA 2\n" + scalars.format("b") + "FIELD f 1\na 1 2 int\n1 2\n")
    with pytest.warns(MeshWarning, match=r"a\.vtk: .*integers \(a, b\)"):
        assert tets_in(path).regions is None


def test_polygonal_data(tmp_path: Path) -> None:
    text = (
        VTK_HEAD.format("POLYDATA")
        + "LINES 1 3\n2 0 1\nPOLYGONS 2 8\n3 0 1 2\n3 1 2 3\nTRIANGLE_STRIPS 1 5\n4 1 2 3 4\n"
    )
    (tmp_path / "a.vtk").write_text(text)
    surface = TriMesh.from_file(tmp_path / "a.vtk")
    assert surface.triangles.tolist() == [[0, 1, 2], [1, 2, 3], [1, 2, 3], [3, 2, 4]]
    polys = (
        '<VTKFile type="PolyData"><PolyData><Piece NumberOfPoints="5" NumberOfPolys="2">'
        f"<Points>{ascii_arrays(POINTS, TETS)['points']}</Points><Polys>"
        '<DataArray type="Int32" Name="connectivity" format="ascii">0 1 2 0 1 4 3</DataArray>'
        '<DataArray type="Int32" Name="offsets" format="ascii">3 7</DataArray></Polys></Piece></PolyData></VTKFile>'
    )
    (tmp_path / "a.vtp").write_text(polys)
    assert len(TriMesh.from_file(tmp_path / "a.vtp").triangles) == 3
    with pytest.raises(ValueError, match=r"a\.vtp .*tetrahedralize"):
        TetMesh.from_file(tmp_path / "a.vtp")


def test_structured_grids_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.vtk").write_text(VTK_HEAD.format("STRUCTURED_GRID"))
    with pytest.raises(ValueError, match=r"a\.vtk .*STRUCTURED_GRID .*not read"):
        TetMesh.from_file(tmp_path / "a.vtk")


def test_cells_of_other_types_are_named(tmp_path: Path) -> None:
    arrays = ascii_arrays(POINTS, TETS)
    arrays["types"] = arrays["types"].replace("10 10", "10 42")
    (tmp_path / "a.vtu").write_text(vtu(piece(arrays)))
    with pytest.warns(MeshWarning, match=r"1 polyhedron left out, 0\.3333 m\^3"):
        assert len(TetMesh.from_file(tmp_path / "a.vtu").tets) == 1


# TetGen, Medit, Isaac Gym:


def test_tetgen(tmp_path: Path) -> None:
    nodes = "# five\n5 3 1 0\n" + "".join(f"{n + 1} {x} {y} {z} 0.5 # a\n" for n, (x, y, z) in enumerate(POINTS))
    (tmp_path / "a.node").write_text(nodes)
    (tmp_path / "a.ele").write_text("2  4  1\n1  1 2 3 4  7\n2  2 3 4 5  8\n# made by hand")
    (tmp_path / "a.face").write_text("1 1\n1 1 3 2 -1\n")
    for name in ("a.node", "a.ele"):
        mesh = tets_in(tmp_path / name)
        assert mesh.regions is not None
        assert mesh.regions.tolist() == [7, 8]
        assert mesh.embedding is not None
    (tmp_path / "a.ele").write_text("3 4 0\n1 1 2 3 4\n2 2 3 4 5\n")
    with pytest.raises(ValueError, match=r"a\.node .*declares 3 tets"):
        TetMesh.from_file(tmp_path / "a.node")
    (tmp_path / "a.ele").unlink()
    with pytest.raises(FileNotFoundError, match=r"a\.node .*a\.ele"):
        TetMesh.from_file(tmp_path / "a.node")


def test_medit(tmp_path: Path) -> None:
    text = (
        "\ufeffMeshVersionFormatted 2 # as written by hand\ndimension\n3\nVertices 5\n"
        + "".join(f"{x} {y} {z} 0\n".replace("e", "D") for x, y, z in POINTS)
        + "Corners\n1\n1\nTetrahedra\n2\n1 2 3 4 7\n2 3 4 5 8\nRidges 0\nEnd\n"
    )
    (tmp_path / "a.mesh").write_bytes(text.replace("\n", "\r\n").encode())
    regions = tets_in(tmp_path / "a.mesh").regions
    assert regions is not None
    assert regions.tolist() == [7, 8]
    (tmp_path / "a.mesh").write_text(text.replace("Tetrahedra\n2", "Tetrahedra\n1"))
    with pytest.raises(ValueError, match=r"a\.mesh \(Medit\): Tetrahedra should be 1 rows of 5 numbers, got 5 more"):
        TetMesh.from_file(tmp_path / "a.mesh")
    (tmp_path / "a.mesh").write_text(text.partition("Ridges")[0])
    with pytest.warns(MeshWarning, match=r"no End"):
        tets_in(tmp_path / "a.mesh")
    (tmp_path / "b.mesh").write_text("MFEM mesh v1.0\n")
    with pytest.raises(ValueError, match=r"b\.mesh .*MeshVersionFormatted, got 'MFEM'"):
        TetMesh.from_file(tmp_path / "b.mesh")
    for name in ("c.mesh", "c.meshb"):
        meshio.write(tmp_path / name, mixed("medit:ref"))
        expect_mixed(content_of(tmp_path / name))


def test_isaac_gym(tmp_path: Path) -> None:
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in POINTS)
    (tmp_path / "a.tet").write_text(f"# Tetrahedral mesh\n\n{vertices}\nt 0 1 2 3\nt 1 2 3 4\n")
    np.testing.assert_array_equal(tets_in(tmp_path / "a.tet").tets, TETS)
    (tmp_path / "b.tet").write_text(vertices + "t 0 1 2\n")
    with pytest.raises(ValueError, match=r"b\.tet \(Isaac Gym\): .*got 't 0 1 2'"):
        TetMesh.from_file(tmp_path / "b.tet")


# Second order:


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh", ".inp"])
def test_cells_of_second_order_keep_their_corners(tmp_path: Path, suffix: str) -> None:
    edges = [[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]]
    points = np.concatenate([POINTS[:4], POINTS[edges].mean(axis=1)])
    kind = "gmsh22" if suffix == ".msh" else None
    meshio.write(tmp_path / f"a{suffix}", meshio.Mesh(points, [("tetra10", np.arange(10)[None])]), file_format=kind)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        mesh = TetMesh.from_file(tmp_path / f"a{suffix}")
    assert len(said) == 1  # nodes on edges are no strays
    assert "1 tetra of higher order: corners kept" in str(said[0].message)
    np.testing.assert_array_equal(mesh.vertices, POINTS[:4])
    points = np.concatenate([PLACES[:8], np.full((12, 3), 0.5)])
    meshio.write(
        tmp_path / f"b{suffix}", meshio.Mesh(points, [("hexahedron20", np.arange(20)[None])]), file_format=kind
    )
    with pytest.warns(MeshWarning, match=r"1 hexahedron .*higher order.*1 hexahedron became 6 tets"):
        assert len(TetMesh.from_file(tmp_path / f"b{suffix}").tets) == 6
