"""Input files of solvers: Abaqus, Nastran, Tecplot; parts, places, sets and coordinate systems."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from torchpd import MeshWarning, TetMesh

POINTS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
NODES = "".join(f"{n + 1}, {x}, {y}, {z}\n" for n, (x, y, z) in enumerate(POINTS.tolist()))
TETS = "*ELEMENT, TYPE=C3D4\n1, 1, 2, 3, 4\n2, 2, 3, 4, 5\n"


def volume(mesh: TetMesh) -> float:
    corners = mesh.vertices[mesh.tets]
    return float(np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 6)


def abaqus(folder: Path, text: str) -> TetMesh:
    (folder / "a.inp").write_text(text)
    return TetMesh.from_file(folder / "a.inp")


@pytest.mark.parametrize("kind", ["C3D4", "c3d4h", "C3D4T", "DC3D4", "AC3D4", "Q3D4"])
def test_elements_of_abaqus_by_their_shape(tmp_path: Path, kind: str) -> None:
    head = f"** made by hand\n*Heading\nany text\n*Node, nset=all\n{NODES}"
    text = f"{head}*Element, type={kind}\n1, 1, 2,\n3, 4\n2, 2,3,4,5\n"
    mesh = abaqus(tmp_path, text)
    np.testing.assert_array_equal(mesh.vertices, POINTS)
    assert mesh.tets.tolist() == [[0, 1, 2, 3], [1, 2, 3, 4]]
    assert mesh.regions is None


def test_other_elements_of_abaqus(tmp_path: Path) -> None:
    cube = "*NODE\n" + "".join(f"{n}, {p}\n" for n, p in enumerate(["0,0,0", "1,0", "1,1,0", "0,1.,"], 1))
    cube += "5, 0,0,1\n6, 1.D0,0,1\n7, 1,1,1,0,0,1\n8, 0,1,1\n9, .5, .5, 2\n"
    elements = "*ELEMENT, TYPE=C3D8R\n7, 1,2,3,4,5,6,\n7,8\n*ELEMENT, TYPE=C3D5\n8, 5,6,7,8,9\n"
    # rods along edges are how meshers write these; beams are parts of the body
    with pytest.warns(MeshWarning, match=r"^[^;]*1 element of type B31 left out; .*1 hexahedron became 6 tets") as said:
        mesh = abaqus(tmp_path, cube + elements + "*ELEMENT, TYPE=T3D2\n1, 1,2\n*ELEMENT, TYPE=B31\n2, 1,2\n")
    assert len(said) == 1
    assert volume(mesh) == pytest.approx(4 / 3, rel=1e-14)


PART = "*PART, NAME={}\n*NODE\n" + NODES + TETS + "{}*END PART\n"


def test_instances_of_abaqus_stand_where_they_are_put(tmp_path: Path) -> None:
    places = (
        "*ASSEMBLY, NAME=all\n*INSTANCE, NAME=one, PART=a\n*END INSTANCE\n"
        "*INSTANCE, NAME=two, PART=A\n10., 0., 0.\n9., 0., 0., 9., 0., 1., 90.\n*END INSTANCE\n"
        "*NODE\n1, 9., 9., 9.\n*NSET, NSET=ref\n1\n*ELSET, ELSET=e, INSTANCE=one\n1\n*END ASSEMBLY\n"
    )
    with pytest.warns(MeshWarning, match=r"part 'b'.*1 is one, 2 is two"):
        mesh = abaqus(tmp_path, PART.format("a", "") + PART.format("b", "") + places)
    # moved by 10 along x, then turned by 90 degrees about the vertical through x = 9
    turned = POINTS @ np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) + [9, 1, 0]
    np.testing.assert_allclose(mesh.vertices, np.concatenate([POINTS, turned]), atol=1e-14)
    assert mesh.regions is not None
    assert mesh.regions.tolist() == [1, 1, 2, 2]


def test_instances_of_abaqus_may_hold_the_mesh_themselves(tmp_path: Path) -> None:
    own = "*NODE\n" + NODES + TETS + "*ELSET, ELSET=e\n2\n"
    text = "*PART, NAME=p\n*END PART\n*ASSEMBLY, NAME=all\n"
    for name, x in (("one", 0), ("two", 5)):
        text += f"*INSTANCE, NAME={name}, PART=p\n{x}.\n{own}*END INSTANCE\n"
    with pytest.warns(MeshWarning, match=r"1 is one\.E, 2 is two\.E") as said:
        mesh = abaqus(tmp_path, text + "*ELEMENT, TYPE=CONN3D2\n1, one.1, two.1\n*END ASSEMBLY\n")
    assert "1 lines of elements of type CONN3D2, which join instances, left out" in str(said[0].message)
    assert mesh.bounds.tolist() == [[0, 0, 0], [6, 1, 1]]
    assert mesh.regions is not None
    assert mesh.regions.tolist() == [0, 1, 0, 2]


def test_sets_of_abaqus_are_regions(tmp_path: Path) -> None:
    sets = "*ELSET, ELSET=Soft, GENERATE\n1, 1, 1\n*ELSET, ELSET=rest\n2\n*ELSET, ELSET=Hard\nREST\n"
    sets += "*ELSET, ELSET=all\n1,2\n"
    sections = "*SOLID SECTION, ELSET=HARD, MATERIAL=m\n1.\n*SOLID SECTION, ELSET=soft, MATERIAL=n\n"
    with pytest.warns(MeshWarning, match=r"left out: REST, ALL; .*1 is HARD, 2 is SOFT"):
        mesh = abaqus(tmp_path, "*NODE\n" + NODES + TETS + sets + sections)
    assert mesh.regions is not None
    assert mesh.regions.tolist() == [2, 1]
    with pytest.warns(MeshWarning, match="1 is LEFT"):
        mesh = abaqus(tmp_path, "*NODE\n" + NODES + TETS.replace("C3D4\n", "C3D4, ELSET=left\n", 1))
    assert mesh.regions is not None
    assert mesh.regions.tolist() == [1, 1]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("*INCLUDE, INPUT=more.inp\n", r"\*INCLUDE, INPUT=more\.inp is not read"),
        ("*NODE, INPUT=more.inp\n", r"\*NODE, INPUT=more\.inp names another file"),
        ("*NODE, SYSTEM=C\n6, 1., 90., 0.\n", r"\*NODE, SYSTEM=C is not read"),
        ("*SYSTEM\n1., 0., 0.\n", r"\*SYSTEM, .* is not read"),
        ("*NGEN\n1, 5, 1\n", r"\*NGEN is not read"),
        ("*ELEMENT, TYPE=C3D4\n3, 1, 2, 3\n", "C3D4 must have 4 nodes, got 4 numbers"),
        ("*ELEMENT, TYPE=C3D4\n3, 1, 2, 3, 9\n", "name node 9, which is missing"),
        ("*NODE\n5, 0, 0, 0\n", "node 5 comes twice"),
        ("*PART, NAME=p\n", r"\*PART has no \*END PART: the file was cut off"),
        ("*INSTANCE, NAME=i, PART=p\n", "names part 'p', which is not defined"),
    ],
)
def test_what_abaqus_files_mean_and_is_not_read_is_refused(tmp_path: Path, more: str, words: str) -> None:
    with pytest.raises(ValueError, match=rf"cannot read a\.inp \(Abaqus\): .*{words}"):
        abaqus(tmp_path, "*NODE\n" + NODES + TETS + more)


def test_avs_has_the_suffix_of_abaqus_too(tmp_path: Path) -> None:
    text = "# made by hand\n5 2 0 0 0\n" + NODES.replace(",", " ") + "1 7 tet 1 2 4 3\n2 8 tet 2 3 5 4\n"
    mesh = abaqus(tmp_path, text)
    assert volume(mesh) == pytest.approx(0.5)
    assert mesh.regions is not None
    assert mesh.regions.tolist() == [7, 8]


# Nastran:


def grids() -> str:
    return "".join(f"GRID    {n + 1:<8d}        {x:<8g}{y:<8g}{z:<8g}\n" for n, (x, y, z) in enumerate(POINTS.tolist()))


def test_fields_of_nastran(tmp_path: Path) -> None:
    text = (
        "$ made by hand\nSOL 101\nCEND\nBEGIN BULK\n"
        "GRID,1,,0.,0.,0.\nGRID           2       0      1.     0.0      0.       0\n"
        "GRID*                  3                              0.         10.-1\n*                     0.\n"
        "grid,4,0,0.,0.,1.D0\nGRID    5                1.      1.      1.\n"
        "CTETRA  1       7       1       2       3       4\n"
        "CTETRA,2,8,2,3,4,5,,,+\n+,,,,\n"
        "CBAR    9       1       1       2       0.      0.      1.\nENDDATA\n"
    )
    (tmp_path / "a.bdf").write_text(text)
    with pytest.warns(MeshWarning, match="1 elements CBAR left out"):
        mesh = TetMesh.from_file(tmp_path / "a.bdf")
    np.testing.assert_allclose(mesh.vertices, POINTS, rtol=1e-15)
    assert mesh.regions is not None
    assert mesh.regions.tolist() == [7, 8]


def test_cells_of_nastran_go_on_in_the_next_line(tmp_path: Path) -> None:
    points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
    lines = [f"GRID,{n},,{x}.,{y}.,{z}." for n, (x, y, z) in enumerate(points, 1)]
    cells = ["CHEXA   1       1       1       2       3       4       5       6       +A", "+A      7       8"]
    (tmp_path / "a.nas").write_text("\n".join([*lines, *cells]))
    with pytest.warns(MeshWarning, match="1 hexahedron became 6 tets"):
        assert volume(TetMesh.from_file(tmp_path / "a.nas")) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (grids() + "GRID    6       3       0.      0.      0.\n", r"GRID 6 .*system 3"),
        ("GRDSET          2\n" + grids(), "GRDSET sets coordinate system 2"),
        ("INCLUDE 'more.bdf'\n" + grids(), "INCLUDE names another file"),
        (grids() + "CTETRA,1,1,1,2,3\n", "CTETRA 1 must have 4 corners"),
        ("BEGIN BULK\n" + grids(), "no ENDDATA: the file was cut off"),
        ("BEGIN BULK\n" + grids() + "BEGIN SUPER=1\nENDDATA\n", "has 2 sections BEGIN"),
    ],
)
def test_what_nastran_files_mean_and_is_not_read_is_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "a.bdf").write_text(text)
    with pytest.raises(ValueError, match=rf"cannot read a\.bdf \(Nastran\): .*{words}"):
        TetMesh.from_file(tmp_path / "a.bdf")


# Tecplot:

ZONE = 'ZONE T="{}", N=4, E=1, DATAPACKING=POINT, ZONETYPE=FETETRAHEDRON\n'


def test_all_zones_of_tecplot_are_read(tmp_path: Path) -> None:
    text = 'TITLE = "zone of two"\nVARIABLES = "X" "Y", "Z"\n'
    for x in (0, 5):
        text += ZONE.format(x) + f"{x} 0 0\n{x + 1} 0 0\n{x} 1 0\n{x} 0 1\n1 2 3 4\n"
    block = (
        "zone nodes = 8, elements = 1\n datapacking = block zonetype = febrick\n"
        "0 1 1 0 0 1 1 0\n0 0 1 1 0 0 1 1\n4*5 4*6\n1 2 3 4 5 6 7 8\n"
    )
    (tmp_path / "a.tec").write_text(text + block)
    with pytest.warns(MeshWarning, match="1 hexahedron became 6 tets"):
        mesh = TetMesh.from_file(tmp_path / "a.tec")
    assert len(mesh.tets) == 8
    assert mesh.bounds.tolist() == [[0, 0, 0], [6, 1, 6]]
    assert volume(mesh) == pytest.approx(4 / 3)


@pytest.mark.parametrize(
    ("zone", "words"),
    [
        ("ZONE I=2, J=2, K=2, F=POINT\n0 0 0\n", "zones of type ORDERED are not read"),
        (ZONE.replace("N=4", "N=5").format(1) + "0 0 0 1 0 0 0 1 0 0 0 1\n1 2 3 4\n", "cells should be 4 numbers"),
        (ZONE.replace("E=1", "E=1, VARSHARELIST=([1-3]=1)").format(1) + "1 2 3 4\n", "VARSHARELIST takes numbers"),
        (ZONE.format(1) + "0 0 0 1 0 0 0 1 0 0 0 1\n1 2 3 5\n", "name point 5, but it has 4"),
        (ZONE.format(1) + "0 0 0 1 0 0 0 1 0 0 0 1\n1 2 3 4\n1 2 3 4\n", "4 numbers more"),
    ],
)
def test_zones_of_tecplot_that_are_not_read_are_refused(tmp_path: Path, zone: str, words: str) -> None:
    (tmp_path / "a.dat").write_text("VARIABLES = X, Y, Z\n" + zone)
    with pytest.raises(ValueError, match=rf"cannot read a\.dat \(Tecplot\): .*{words}"):
        TetMesh.from_file(tmp_path / "a.dat")


# Others, each with the two tets and regions 7 and 8 where it has any:

PLAIN = "".join(f"{x} {y} {z}\n" for x, y, z in POINTS.tolist())
NUMBERED = NODES.replace(",", " ")
OTHERS = {
    "a.su2": "% made by hand\nNDIME= 3\nNELEM= 2\n10 0 1 2 3 0\n10 1 2 3 4 1\nNPOIN= 5\n"
    + PLAIN
    + "NMARK= 1\nMARKER_TAG= wall\nMARKER_ELEMS= 1\n5 0 1 2\n",
    "a.ugrid": "5 1 0 2 0 0 0\n" + PLAIN + "1 2 3\n4\n1 2 3 4\n2 3 4 5\n",
    "a.vol": "mesh3d\ndimension\n3\ngeomtype\n0\nsurfaceelements\n1\n1 1 1 0 3 1 2 3\n"
    "volumeelements\n2\n7 4 1 3 2 4\n8 4 2 4 3 5\npoints\n5\n" + PLAIN + "materials\n1\n7 soft\nendmesh\n",
    "a.f3grid": "* made by hand\n"
    + "".join(f"G {row}\n" for row in NUMBERED.splitlines())
    + "Z T4 1 1 2 3 4\nZ T4 2 2 3 4 5\nF T3 1 1 2 3\n"
    + 'ZGROUP "a" SLOT 1\n' * 2
    + "1\nZGROUP 'b c' SLOT 1\n2\n",
    "a.mdpa": "Begin Nodes\n" + NUMBERED + "End Nodes\nBegin Elements SmallDisplacementElement3D4N// of solids\n"
    "1 7 1 2 3 4\n2 8 2 3 4 5\nEnd Elements\nBegin Conditions SurfaceCondition3D3N\n1 0 1 2 3\nEnd Conditions\n",
    "a.dato": "! made by hand\n$ENTER COMPONENT NAME=a\n$STRUCTURE\n$COOR\n"
    + NUMBERED
    + "$ELEMENT TYPE=TET4 ESET=one\n1 1 2 3 4\n$ELEMENT TYPE=TET4 ESET=two\n2 2 3 &\n& 4 5\n"
    "$ELEMENT TYPE=SHELL3\n3 1 2 3\n$NSET NAME=all\n1 2\n$END STRUCTURE\n$EXIT COMPONENT\n$FIN\n",
    "a.xml": '<dolfin><mesh celltype="tetrahedron" dim="3"><vertices size="5">'
    + "".join(f'<vertex index="{n}" x="{x}" y="{y}" z="{z}"/>' for n, (x, y, z) in enumerate(POINTS.tolist()))
    + '</vertices><cells size="2"><tetrahedron index="1" v0="1" v1="2" v2="3" v3="4"/>'
    '<tetrahedron index="0" v0="0" v1="1" v2="2" v3="3"/></cells></mesh></dolfin>',
}


@pytest.mark.filterwarnings("ignore:.*regions:torchpd.MeshWarning")
@pytest.mark.parametrize("name", sorted(OTHERS))
def test_other_formats(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(OTHERS[name])
    mesh = TetMesh.from_file(tmp_path / name)
    np.testing.assert_array_equal(mesh.vertices, POINTS)
    assert np.sort(mesh.tets).tolist() == [[0, 1, 2, 3], [1, 2, 3, 4]]
    assert mesh.flipped == 0
    assert (mesh.embedding is None) == (name == "a.xml")
    regions = {"a.vol": [7, 8], "a.mdpa": [7, 8], "a.f3grid": [1, 2], "a.dato": [1, 2]}.get(name)
    assert (None if mesh.regions is None else mesh.regions.tolist()) == regions


def test_corners_of_permas_stand_between_nodes_on_edges(tmp_path: Path) -> None:
    rows = ["0 0 0", "1 0 0", "2 0 0", "1 1 0", "0 2 0", "0 1 0", "0 0 1", "1 0 1", "0 1 1", "0 0 2"]
    text = "$COOR\n" + "".join(f"{n} {row}\n" for n, row in enumerate(rows, 1))
    (tmp_path / "a.dato").write_text(text + "$ELEMENT TYPE=TET10\n1 1 2 3 4 5 6 7 8 9 10\n")
    with pytest.warns(MeshWarning, match=r"1 tetra .*corners") as said:
        assert volume(TetMesh.from_file(tmp_path / "a.dato")) == pytest.approx(8 / 6)
    assert len(said) == 1


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        ("a.su2", "NELEM= 2", "NELEM= 3", "declares 3 cells, but '0.0 0.0 0.0' follows them"),
        ("a.su2", "NMARK= 1", "NMARK= 2", "declares 2 markers, got 1"),
        ("a.dato", "$EXIT COMPONENT\n", "", "cut off"),
        ("a.su2", "NDIME= 3", "NZONE= 2\nNDIME= 3", "holds 2 zones"),
        ("a.ugrid", "5 1 0 2", "5 1 0 3", "tetra should be 12 numbers"),
        ("a.vol", "volumeelements\n2", "volumeelements\n3", "declares 3 volumeelements"),
        ("a.vol", "endmesh\n", "", "cut off"),
        ("a.mdpa", "End Conditions\n", "", "block Conditions has no end"),
        ("a.dato", "2 2 3 &", "2 2 &", "TET4 must have 5 numbers each, got 4"),
        ("a.dato", "TYPE=TET4", "TYPE=HEXE20", "type 'HEXE20' are not read"),
        ("a.xml", 'cells size="2"', 'cells size="3"', "declares 3 entries <tetrahedron>, got 2"),
        ("a.xml", 'index="1" v0', 'index="0" v0', "indices of <tetrahedron>"),
    ],
)
def test_counts_of_other_formats_are_compared(tmp_path: Path, name: str, old: str, new: str, words: str) -> None:
    (tmp_path / name).write_text(OTHERS[name].replace(old, new))
    with pytest.raises(ValueError, match=rf"cannot read {name} \(.*\): .*{words}"):
        TetMesh.from_file(tmp_path / name)
