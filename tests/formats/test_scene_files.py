"""COLLADA and 3MF: meshes in metres, where the nodes of a scene or the items of a build put them."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from torchpd import MeshWarning, TriMesh

BOX = np.array([[x, y, z] for z in (0.0, 3.0) for y in (0.0, 2.0) for x in (0.0, 1.0)])
QUADS = [[2, 3, 1, 0], [4, 5, 7, 6], [0, 1, 5, 4], [3, 2, 6, 7], [1, 3, 7, 5], [2, 0, 4, 6]]
TRIANGLES = [[a, b, c] for q in QUADS for a, b, c in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))]


def words(table: object) -> str:
    return " ".join(f"{value:g}" for value in np.asarray(table).reshape(-1))


def refuse(path: Path, match: str) -> None:
    with pytest.raises(ValueError, match=rf"TriMesh\.from_file cannot read {path.name} .*{match}"):
        TriMesh.from_file(path)


# COLLADA:

POLYLIST = (
    '<polylist count="6"><input semantic="VERTEX" source="#v" offset="0"/>'
    '<input semantic="NORMAL" source="#n" offset="1"/>'
    f"<vcount>{'4 ' * 6}</vcount><p>{' '.join(f'{k} 0' for q in QUADS for k in q)}</p></polylist>"
)
PLACED = '<node id="a"><instance_geometry url="#box"/></node>'


def collada(faces: str = POLYLIST, nodes: str = PLACED, asset: str = '<unit meter="1"/><up_axis>Y_UP</up_axis>') -> str:
    return (
        '<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">'
        f'<asset>{asset}</asset><library_geometries><geometry id="box"><mesh>'
        f'<source id="p"><float_array id="pa" count="24">{words(BOX)}</float_array><technique_common>'
        '<accessor source="#pa" count="8" stride="3"/></technique_common></source>'
        '<source id="t"><float_array id="ta" count="8">0 0 1 0 1 1 0 1</float_array><technique_common>'
        '<accessor source="#ta" count="4" stride="2"/></technique_common></source>'
        f'<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>{faces}'
        "</mesh></geometry></library_geometries>"
        f'<library_visual_scenes><visual_scene id="s">{nodes}</visual_scene></library_visual_scenes>'
        '<scene><instance_visual_scene url="#s"/></scene></COLLADA>'
    )


def primitive(kind: str, count: int, *lists: list[int]) -> str:
    parts = "".join(f"<p>{words(part)}</p>" for part in lists)
    return f'<{kind} count="{count}"><input semantic="VERTEX" source="#v" offset="0"/>{parts}</{kind}>'


@pytest.mark.parametrize(
    "faces",
    [
        POLYLIST,
        primitive("triangles", 12, [k for t in TRIANGLES for k in t]),
        primitive("polygons", 6, *QUADS),
        primitive("trifans", 6, *QUADS),
        primitive("tristrips", 6, *([q[1], q[2], q[0], q[3]] for q in QUADS)),
    ],
    ids=["polylist", "triangles", "polygons", "trifans", "tristrips"],
)
def test_faces_of_all_kinds_are_read(tmp_path: Path, faces: str) -> None:
    (tmp_path / "a.dae").write_text(collada(faces))
    surface = TriMesh.from_file(tmp_path / "a.dae")
    np.testing.assert_array_equal(surface.vertices, BOX)
    assert len(surface.triangles) == 12
    assert surface.volume() == pytest.approx(6.0)


def test_nodes_put_geometries_in_their_places(tmp_path: Path) -> None:
    inner = '<node id="in"><scale>-1 1 1</scale><instance_geometry url="#box"/></node>'
    nodes = (
        f'<node id="a"><translate>5 0 0</translate><rotate>0 0 1 90</rotate>{inner}</node>'
        '<node id="b"><matrix>0 -1 0 0 1 0 0 0 0 0 1 10 0 0 0 1</matrix><instance_node url="#in"/></node>'
    )
    (tmp_path / "a.dae").write_text(collada(nodes=nodes))
    surface = TriMesh.from_file(tmp_path / "a.dae")
    x, y, z = BOX.T
    one, two = surface.vertices.reshape(2, 8, 3)
    np.testing.assert_allclose(one, np.stack([5 - y, -x, z], axis=1), atol=1e-12)
    np.testing.assert_allclose(two, np.stack([-y, -x, z + 10], axis=1), atol=1e-12)
    assert surface.volume() == pytest.approx(12.0)


def test_units_axes_and_texture_coordinates_of_collada(tmp_path: Path) -> None:
    textured = (
        '<triangles count="1"><input semantic="VERTEX" source="#v" offset="0"/>'
        '<input semantic="TEXCOORD" source="#t" offset="1" set="0"/><p>0 0 1 1 3 2</p></triangles>'
    )
    (tmp_path / "a.dae").write_text(collada(textured))
    with pytest.warns(MeshWarning, match=r"5 of 8 vertices"):
        surface = TriMesh.from_file(tmp_path / "a.dae")
    np.testing.assert_array_equal(surface.uvs, [[0, 0], [1, 0], [1, 1]])
    for up, turned in (("Z_UP", BOX[:, [0, 2, 1]] * [1, 1, -1]), ("X_UP", BOX[:, [1, 0, 2]] * [-1, 1, 1])):
        (tmp_path / "b.dae").write_text(collada(asset=f'<unit meter="0.01"/><up_axis>{up}</up_axis>'))
        with pytest.warns(MeshWarning, match=rf"unit is 0\.01 m.*its {up[0].lower()} axis is up"):
            surface = TriMesh.from_file(tmp_path / "b.dae")
        np.testing.assert_allclose(surface.vertices, 0.01 * turned, atol=1e-15)
        assert surface.volume() == pytest.approx(6e-6)


def test_parts_of_parts_without_end_are_refused(tmp_path: Path) -> None:
    twice = "".join(f'<node id="n{k}">' + f'<instance_node url="#n{k + 1}"/>' * 2 + "</node>" for k in range(40))
    (tmp_path / "a.dae").write_text(collada(nodes=twice + '<node id="n40"/>'))
    refuse(tmp_path / "a.dae", "more than 100,000 instances")
    pairs = [f'<component objectid="{k + 1}"/>' * 2 for k in range(1, 40)]
    objects = "".join(
        f'<object id="{k}"><components>{pair}</components></object>' for k, pair in enumerate(pairs, start=1)
    )
    text = model(objects + f'<object id="40">{MESH}</object>', '<item objectid="1"/>')
    refuse(pack(tmp_path / "a.3mf", text), "more than 100,000 instances")


def test_a_collada_says_what_it_leaves_out(tmp_path: Path) -> None:
    text = collada(POLYLIST + primitive("lines", 1, [0, 1]) + primitive("polygons", 1, [0, 1]))
    (tmp_path / "a.dae").write_text(text.replace("</library_geometries>", '<geometry id="x"/></library_geometries>'))
    with pytest.warns(MeshWarning, match="line primitives") as said:
        assert len(TriMesh.from_file(tmp_path / "a.dae").triangles) == 12
    for part in ("line primitives (1)", "fewer than 3 corners (1)", "geometries in no node of the scene (1)"):
        assert part in str(said[0].message)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('count="24"', 'count="23"', "float_array of 'p' declares 23 numbers, got 24"),
        ('count="8" stride="3"', 'count="1000000000000000" stride="3"', "declares 1000000000000000 rows of 3 in 24"),
        ('<polylist count="6"', '<polylist count="7"', "polylist declare 7 faces and have 6"),
        ("<vcount>4 ", "<vcount>5 ", "with 25 corners, of which 24 are there"),
        ("<p>2 0", "<p>8 0", "vertices in polylist that are not there: 8"),
        ("</library_geometries>", '<geometry id="box"/></library_geometries>', "several of its elements have this id"),
        ('url="#box"', 'url="other.dae#box"', "refers to 'other.dae#box', which is not within the file"),
        ('url="#box"', 'url="#lost"', "refers to the geometry '#lost', which is not there"),
        ('<node id="a">', '<node id="a"><instance_node url="#a"/>', "one of its parts contains itself"),
        ('<node id="a">', '<node id="a"><skew>0 0 0 0 0 0 0</skew>', "the transform 'skew', which is not read"),
        ("Y_UP", "W_UP", "up_axis must be"),
        ('meter="1"', 'meter="0"', "must be a positive number of metres"),
        ("</COLLADA>", "", "it is no complete XML document"),
    ],
)
def test_a_collada_that_breaks_its_word_is_refused(tmp_path: Path, old: str, new: str, match: str) -> None:
    assert old in collada()
    (tmp_path / "a.dae").write_text(collada().replace(old, new, 1))
    refuse(tmp_path / "a.dae", match)


# 3MF:

MESH = (
    "<mesh><vertices>" + "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in BOX) + "</vertices><triangles>"
    + "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in TRIANGLES) + "</triangles></mesh>"
)  # fmt: skip
CORE = 'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"'


def model(objects: str, items: str, more: str = 'unit="meter"') -> str:
    return f"<model {CORE} {more}><resources>{objects}</resources><build>{items}</build></model>"


def pack(path: Path, text: str, **others: str) -> Path:
    kind = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(
            "_rels/.rels", f'<Relationships><Relationship Target="/3D/a.model" Id="r" Type="{kind}"/></Relationships>'
        )
        archive.writestr("3D/a.model", text)
        for name, other in others.items():
            archive.writestr(f"3D/{name}.model", other)
    return path


def test_items_and_components_are_put_in_their_places(tmp_path: Path) -> None:
    objects = (
        f'<object id="1">{MESH}</object><object id="2"><components><component objectid="1"/>'
        '<component objectid="1" transform="-1 0 0 0 1 0 0 0 1 10 0 0"/></components></object>'
    )
    items = '<item objectid="2" transform="0 1 0 -1 0 0 0 0 1 0 0 7"/><item objectid="1"/>'
    surface = TriMesh.from_file(pack(tmp_path / "a.3mf", model(objects, items)))
    x, y, z = BOX.T
    one, two, three = surface.vertices.reshape(3, 8, 3)
    np.testing.assert_allclose(one, np.stack([-y, x, z + 7], axis=1), atol=1e-12)
    np.testing.assert_allclose(two, np.stack([-y, 10 - x, z + 7], axis=1), atol=1e-12)
    np.testing.assert_array_equal(three, BOX)
    assert surface.volume() == pytest.approx(18.0)


def test_units_of_3mf_and_what_is_left_out(tmp_path: Path) -> None:
    objects = (
        f'<object id="1">{MESH}</object><object id="2" type="support">{MESH}</object><object id="3">{MESH}</object>'
    )
    items = '<item objectid="1"/><item objectid="2"/>'
    with pytest.warns(MeshWarning, match="millimeter") as said:
        surface = TriMesh.from_file(pack(tmp_path / "a.3mf", model(objects, items, "")))
    np.testing.assert_allclose(surface.vertices, BOX / 1000.0)
    assert "objects of type support (1), objects that are no part of the build (1)" in str(said[0].message)


def test_objects_in_other_parts_are_read(tmp_path: Path) -> None:
    more = (
        'unit="meter" xmlns:p="http://schemas.microsoft.com/3dmanufacturing/production/2015/06" requiredextensions="p"'
    )
    objects = '<object id="2"><components><component p:path="/3D/b.model" objectid="1"/></components></object>'
    other = model(f'<object id="1">{MESH}</object>', "")
    surface = TriMesh.from_file(pack(tmp_path / "a.3mf", model(objects, '<item objectid="2"/>', more), b=other))
    np.testing.assert_array_equal(surface.vertices, BOX)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("</resources>", '<object id="1"/></resources>', "object '1' of 3D/a.model comes twice"),
        ('unit="meter"', 'unit="mile"', r"unit .*got 'mile'"),
        (
            'unit="meter"',
            'requiredextensions="b" xmlns:b="http://x/beamlattice/2017/02"',
            "extension http://x/beamlattice",
        ),
        ('v1="2"', 'v1="8"', "vertices of object 1 that are not there: 8"),
        ('x="0.0"', 'x="nan"', r"point 0 .*got .*nan"),
        ('<item objectid="1"/>', '<item objectid="5"/>', "object '5' of 3D/a.model is used, but is not there"),
        ("<mesh>", '<components><component objectid="1"/></components><mesh>', "one of its parts contains itself"),
        ('<item objectid="1"/>', '<item objectid="1" transform="1 0 0"/>', "a transform must be 12 finite numbers"),
        ("</model>", "", "3D/a.model is no sound XML"),
    ],
)
def test_a_3mf_that_breaks_its_word_is_refused(tmp_path: Path, old: str, new: str, match: str) -> None:
    text = model(f'<object id="1">{MESH}</object>', '<item objectid="1"/>')
    assert old in text
    refuse(pack(tmp_path / "a.3mf", text.replace(old, new, 1)), match)


def test_an_archive_that_is_none_is_refused(tmp_path: Path) -> None:
    text = model(f'<object id="1">{MESH}</object>', '<item objectid="1"/>')
    data = pack(tmp_path / "a.3mf", text).read_bytes()
    (tmp_path / "b.3mf").write_bytes(data[:-40])
    refuse(tmp_path / "b.3mf", "its archive cannot be read")
    with zipfile.ZipFile(tmp_path / "c.3mf", "w") as archive:
        archive.writestr("hello", "world")
    refuse(tmp_path / "c.3mf", "is it a 3MF")
