"""Files as other programs write them: what lies beside a sound mesh costs nothing, and counts are those of the file."""

from __future__ import annotations

import struct
import warnings
from pathlib import Path

import meshio
import numpy as np
import pytest

from torchpd import MeshWarning, TetMesh, TriMesh

# Two tets, which fill 1/6 and 1/3 m^3, and the faces around the first.
POINTS = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 1.0]]
TETS = [[0, 1, 2, 3], [1, 2, 3, 4]]
FACES = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]


def rows(table: list[list[float]] | list[list[int]], *, first: int = 0, shift: int = 0, lead: str = "") -> str:
    """A line for each row, behind its number counted from `first`, or behind `lead`."""
    words = ((lead or str(n + first), *(str(value + shift) for value in row)) for n, row in enumerate(table))
    return "".join(" ".join(line) + "\n" for line in words)


def bare(table: list[list[float]] | list[list[int]], shift: int = 0, end: str = "") -> str:
    return "".join(" ".join(str(value + shift) for value in row) + end + "\n" for row in table)


def gmsh_2(nodes: int = 5, more: str = "") -> str:
    points = f"$Nodes\n{nodes}\n{rows(POINTS, first=1)}{more}$EndNodes\n"
    cells = f"$Elements\n2\n1 4 0 {bare(TETS[:1], 1)}2 4 0 {bare(TETS[1:], 1)}$EndElements\n"
    return f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n{points}{cells}"


def gmsh_4(entities: str = "", blocks: int = 2) -> str:
    nodes = f"$Nodes\n1 5 1 5\n3 1 0 5\n1\n2\n3\n4\n5\n{bare(POINTS)}$EndNodes\n"
    cells = "".join(f"3 {n} 4 1\n{rows(TETS[n - 1 : n], first=n, shift=1)}" for n in (1, 2))
    head = f"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n{entities}{nodes}"
    return f"{head}$Elements\n{blocks} {blocks} 1 2\n{cells}$EndElements\n"


def partitions(count: int) -> str:
    """Two volumes, in the partitions 1 and 2 of so many."""
    volumes = "".join(f"{n} 3 1 1 {n} 0 0 0 1 1 1 0 0\n" for n in (1, 2))
    return f"$PartitionedEntities\n{count}\n0\n0 0 0 2\n{volumes}$EndPartitionedEntities\n"


def netgen(cells: int = 2, points: int = 5) -> str:
    solids = bare([[1, 4, *tet] for tet in [[1, 3, 2, 4], [2, 4, 3, 5]]])
    return f"mesh3d\nvolumeelements\n{cells}\n{solids}\npoints\n{points}\n{bare(POINTS)}\nendmesh\n"


def su2(cells: int = 2, points: int = 5) -> str:
    solids = rows(TETS, lead="10")
    return f"NDIME= 3\nNELEM= {cells}\n{solids}NPOIN= {points}\n{bare(POINTS)}NMARK= 0\n"


def avs(cells: int = 2) -> str:
    solids = rows(TETS, shift=1, lead="1 1 tet")
    return f"5 {cells} 0 0 0\n{rows(POINTS, first=1)}{solids}"


def ugrid(cells: int = 2) -> str:
    return f"5 0 0 {cells} 0 0 0\n{bare(POINTS)}{bare(TETS, 1)}"


def tetgen(tmp_path: Path, nodes: int = 5, cells: int = 2) -> Path:
    (tmp_path / "a.node").write_text(f"{nodes} 3 0 0\n{rows(POINTS)}")
    (tmp_path / "a.ele").write_text(f"{cells} 4 0\n{rows(TETS)}")
    return tmp_path / "a.ele"


def tets_in(path: Path) -> TetMesh:
    """The mesh of a file of the two tets."""
    mesh = TetMesh.from_file(path)
    assert mesh.quality().volumes.sum() == pytest.approx(0.5, rel=1e-6)
    return mesh


def surface_of(path: Path, data: str | bytes) -> TriMesh:
    """The faces of the first tet, of which nothing has to be said."""
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        surface = TriMesh.from_file(path)
    assert surface.volume() == pytest.approx(1 / 6, rel=1e-6)
    return surface


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("a.msh", gmsh_2(nodes=4), "more than"),
        ("a.msh", gmsh_4(blocks=1), "more than"),
        ("a.vol", netgen(cells=1), "declares 1 volumeelements.* 2 "),
        ("a.vol", netgen(points=4), "declares 4 points.* 5 "),
        ("a.su2", su2(cells=1), "declares 1 cells"),
        ("a.su2", su2(points=4), "declares 4 points"),
        ("a.avs", avs(cells=1), "declares 1 cells.* 2 "),
    ],
)
def test_more_rows_than_declared_are_refused(tmp_path: Path, name: str, text: str, match: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"TetMesh\.from_file.*{name}.*{match}"):
        TetMesh.from_file(path)


@pytest.mark.parametrize("name", ["a.msh", "b.msh", "a.vol", "a.su2", "a.avs", "a.ugrid"])
def test_as_many_rows_as_declared_are_read(tmp_path: Path, name: str) -> None:
    texts = {
        "a.msh": gmsh_2(),
        "b.msh": gmsh_4(),
        "a.vol": netgen(),
        "a.su2": su2(),
        "a.avs": avs(),
        "a.ugrid": ugrid(),
    }
    (tmp_path / name).write_text(texts[name])
    tets_in(tmp_path / name)


def test_more_blocks_than_declared_are_refused_in_binary_gmsh_files(tmp_path: Path) -> None:
    path = tmp_path / "a.msh"
    mesh = meshio.Mesh(POINTS, [("tetra", TETS)])
    meshio.gmsh.write(path, mesh, fmt_version="4.1", binary=True)
    tets_in(path)
    block = struct.pack("<3iQ5Q", 3, 2, 4, 1, 3, 1, 2, 3, 5)
    path.write_bytes(path.read_bytes().replace(b"\n$EndElements", block + b"\n$EndElements"))
    with pytest.raises(ValueError, match=r"section \$Elements .*declares"):
        TetMesh.from_file(path)


@pytest.mark.parametrize(("nodes", "cells"), [(4, 2), (5, 1)])
def test_tetgen_files_have_no_more_rows_than_declared(tmp_path: Path, nodes: int, cells: int) -> None:
    tets_in(tetgen(tmp_path))
    with pytest.raises(ValueError, match=r"declares [41] "):
        TetMesh.from_file(tetgen(tmp_path, nodes, cells))


def test_numbers_behind_the_cells_of_ugrid_are_said(tmp_path: Path) -> None:
    path = tmp_path / "a.ugrid"
    path.write_text(ugrid(cells=1))
    with pytest.warns(MeshWarning, match=r"4 numbers .*left out"):
        TetMesh.from_file(path)


def test_partitions_of_gmsh_that_do_not_come_are_said(tmp_path: Path) -> None:
    path = tmp_path / "a.msh"
    path.write_text(gmsh_4(partitions(2)))
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*partitions")
        tets_in(path)
    path.write_text(gmsh_4(partitions(3)))
    with pytest.warns(MeshWarning, match="2 of its 3 partitions"):
        tets_in(path)


def test_points_that_no_cell_uses_need_not_be_finite(tmp_path: Path) -> None:
    """As depth cameras write them where they see nothing."""
    path = tmp_path / "a.msh"
    path.write_text(gmsh_2(nodes=6, more="6 nan nan nan\n"))
    with pytest.warns(MeshWarning, match=r"1 vertices .*not finite .*left out"):
        assert len(tets_in(path).vertices) == 5
    path = tmp_path / "a.obj"
    path.write_text("v nan nan nan\n" + rows(POINTS[:4], lead="v") + rows(FACES, shift=2, lead="f"))
    with pytest.warns(MeshWarning, match=r"1 vertices .*not finite"):
        assert len(TriMesh.from_file(path).vertices) == 4


def test_isaac_words_are_separated_by_any_blanks(tmp_path: Path) -> None:
    path = tmp_path / "a.tet"
    path.write_text((rows(POINTS, lead="v") + rows(TETS, lead="t")).replace(" ", "\t"))
    tets_in(path)


def test_comments_end_lines_of_obj(tmp_path: Path) -> None:
    text = rows(POINTS[:4], lead="v").replace("\n", " # vertex\n") + rows(FACES, shift=1, lead="f").replace(
        "\n", " #1\n"
    )
    surface_of(tmp_path / "a.obj", text)


def test_counts_glued_to_the_first_word_of_off(tmp_path: Path) -> None:
    """As in files of ModelNet."""
    surface_of(tmp_path / "a.off", f"OFF4 4 6\n{bare(POINTS[:4])}{rows(FACES, lead='3')}")


def test_ply_ends_with_a_newline_and_may_speak_of_its_end(tmp_path: Path) -> None:
    head = (
        "ply\nformat binary_little_endian 1.0\ncomment before end_header come elements\nelement vertex 4\n"
        "property float x\nproperty float y\nproperty float z\nelement face 4\n"
        "property list uint uint vertex_index\nend_header\n"
    )
    body = np.array(POINTS[:4], dtype="<f4").tobytes() + b"".join(struct.pack("<4I", 3, *face) for face in FACES)
    surface_of(tmp_path / "a.ply", head.encode() + body + b"\r\n")
    surface_of(tmp_path / "a.ply", head.replace("\n", "\r\n").encode() + body)


def test_a_binary_stl_of_another_length_that_begins_with_solid(tmp_path: Path) -> None:
    path = tmp_path / "a.stl"
    corners = np.array(POINTS)[np.array(FACES)]
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *face.reshape(-1), 0) for face in corners)
    path.write_bytes(b"solid of another program".ljust(80) + struct.pack("<I", 9) + body)
    with pytest.raises(ValueError, match="declares 9 triangles"):
        TriMesh.from_file(path)


@pytest.mark.parametrize("suffix", [".vtk", ".vtu"])
def test_whole_numbers_of_floats_are_regions_where_their_name_says_so(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    for name, values, regions in (
        ("MaterialIDs", [1.0, 2.0], [1, 2]),
        ("label", [0.5, 1], None),
        ("E", [1.0, 2], None),
    ):
        meshio.Mesh(POINTS, [("tetra", TETS)], cell_data={name: [np.array(values)]}).write(path)
        mesh = tets_in(path)
        assert (None if mesh.regions is None else mesh.regions.tolist()) == regions


def test_names_of_abaqus_in_quotes_hold_commas(tmp_path: Path) -> None:
    path = tmp_path / "a.inp"
    nodes = rows(POINTS, first=1).replace(" ", ", ")
    sets = "".join(f'*ELEMENT, TYPE=C3D4, ELSET="bone, {side}"\n{{}}' for side in ("left", "right"))
    cells = [rows(TETS[k : k + 1], first=k + 1, shift=1).replace(" ", ", ") for k in (0, 1)]
    both = '*ELSET, ELSET=all\n"bone, left", "bone, right"\n'
    path.write_text("*NODE\n" + nodes + sets.format(*cells))
    with pytest.warns(MeshWarning, match=r"1 is BONE, LEFT, 2 is BONE, RIGHT"):
        mesh = tets_in(path)
    assert mesh.regions is not None
    assert mesh.regions.tolist() == [1, 2]
    path.write_text("*NODE\n" + nodes + sets.format(*cells) + both + "*SOLID SECTION, ELSET=all\n")
    with pytest.warns(MeshWarning, match="1 is ALL"):
        mesh = tets_in(path)
    assert mesh.regions is not None
    assert mesh.regions.tolist() == [1, 1]


def test_errors_of_libraries_say_nothing_of_their_own_names(tmp_path: Path) -> None:
    path = tmp_path / "a.xdmf"
    path.write_text('<Xdmf Version="3.0"><Domain><Grid><Time Value="1"/></Grid></Domain></Xdmf>')
    with pytest.raises(ValueError, match=r"a\.xdmf \(XDMF\): .*'Time'"):
        TetMesh.from_file(path)
