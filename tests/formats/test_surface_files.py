"""Files of surfaces: the box of 1 x 2 x 3 m that they describe comes back, or an error says what is wrong."""

from __future__ import annotations

import struct
import warnings
from pathlib import Path

import numpy as np
import pytest

from torchpd import MeshWarning, TetMesh, TriMesh

BOX = np.array([[x, y, z] for z in (0.0, 3.0) for y in (0.0, 2.0) for x in (0.0, 1.0)])
QUADS = [[2, 3, 1, 0], [4, 5, 7, 6], [0, 1, 5, 4], [3, 2, 6, 7], [1, 3, 7, 5], [2, 0, 4, 6]]
TRIANGLES = [[a, b, c] for q in QUADS for a, b, c in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))]
MIXED = [*TRIANGLES[:4], *QUADS[2:]]


def read(path: Path, data: str | bytes) -> TriMesh:
    """The surface of a file with this content, of which nothing has to be said."""
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return TriMesh.from_file(path)


def refuse(path: Path, data: str | bytes, match: str) -> None:
    """The file is refused with a `ValueError` that names it and says what was met."""
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    with pytest.raises(ValueError, match=rf"TriMesh\.from_file.*{path.name}.*{match}"):
        TriMesh.from_file(path)


def is_box(surface: TriMesh, vertices: int = 8) -> bool:
    return len(surface.vertices) == vertices and len(surface.triangles) == 12 and abs(surface.volume() - 6.0) < 1e-6


def rows(*tables: object) -> str:
    return "".join(" ".join(f"{value}" for value in row) + "\n" for table in tables for row in table)  # type: ignore


def obj(faces: list[list[int]], first: int = 1) -> str:
    lines = [f"v {x:g} {y:g} {z:g}\n" for x, y, z in BOX]
    return "".join(lines + ["f " + " ".join(str(k + first) for k in face) + "\n" for face in faces])


# OBJ:


@pytest.mark.parametrize(
    "data",
    [
        obj(MIXED),
        obj(QUADS, first=-8),
        b"\xef\xbb\xbf" + obj(QUADS).encode(),
        obj(QUADS).encode("utf-16"),
        b"# K\xf6rper\no K\xf6rper\n" + obj(TRIANGLES).encode(),
        obj(QUADS).replace("f 3 4", "f \\\n3 \\\n  4").replace("\n", "\r\n"),
        obj(QUADS).replace("\n", " 1.0 0.5 0.25\n", 8).replace("f 3 4 2 1", "g one\nusemtl red\ns off\nf 3 4 2 1"),
        "vn 0 0 1\n" + obj(QUADS).replace("f 3 4 2 1", "f 3//1 4//1 2//1 1//1"),
        "# a comment that ends in a folder C:\\\n" + obj(QUADS),
    ],
    ids=["mixed", "relative", "mark", "utf-16", "latin-1", "continued", "colours", "normals", "backslash"],
)
def test_every_obj_of_the_box_is_read(tmp_path: Path, data: str | bytes) -> None:
    surface = read(tmp_path / "box.obj", data)
    assert is_box(surface)
    np.testing.assert_array_equal(surface.vertices, BOX)


def test_relative_numbers_count_back_from_where_they_stand(tmp_path: Path) -> None:
    lines = "".join(f"v {x} 0 0\nv {x} 1 0\nv {x} 0 1\nf -3 -2 -1\n" for x in range(3))
    surface = read(tmp_path / "a.obj", lines)
    np.testing.assert_array_equal(surface.triangles, np.arange(9).reshape(3, 3))
    np.testing.assert_array_equal(surface.vertices[::3, 0], [0, 1, 2])
    corners = "v 0 0 0\nv 1 0 0\nvt 0 0\nvt 1 0\nv 1 1 0\nvt 1 1\nvt 0.5 0.5\nf -3/-4 -2/-3 -1/-2\n"
    np.testing.assert_array_equal(read(tmp_path / "b.obj", corners).uvs, [[0, 0], [1, 0], [1, 1]])


def test_a_vertex_with_two_texture_coordinates_becomes_two(tmp_path: Path) -> None:
    lines = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvt 0.5 0.5\n"
    surface = read(tmp_path / "a.obj", lines + "f 1/1 2/2 3/3\nf 1/5 3/3 4/4\n")
    np.testing.assert_array_equal(surface.vertices, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 0]])
    np.testing.assert_array_equal(surface.triangles, [[0, 1, 2], [4, 2, 3]])
    np.testing.assert_array_equal(surface.uvs, [[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0.5]])


def test_an_obj_says_what_it_leaves_out(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(
        "vt 0 0\n" + obj(QUADS).replace("f 3 4 2 1", "f 3/1 4/1 2/1 1/1") + "l 1 2\np 1\nx 1\n"
    )
    with pytest.warns(MeshWarning, match=r"a\.obj: .*lines \(1\).*points \(1\).*'x' \(1\).*5 of 6 faces have none"):
        surface = TriMesh.from_file(tmp_path / "a.obj")
    assert is_box(surface)
    assert surface.uvs is None


def test_texture_coordinates_that_are_none_cost_no_surface(tmp_path: Path) -> None:
    lines = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt -nan(ind) 0\nvt 0\nf 1/1 2/2 3/3\n"
    (tmp_path / "a.obj").write_text(lines)
    with pytest.warns(MeshWarning, match=r"texture coordinates .*1 .*not finite"):
        surface = TriMesh.from_file(tmp_path / "a.obj")
    assert surface.uvs is None
    assert len(surface.triangles) == 1
    uvs = read(tmp_path / "b.obj", lines.replace("-nan(ind)", "1")).uvs
    np.testing.assert_array_equal(uvs, [[0, 0], [1, 0], [0, 0]])


@pytest.mark.parametrize(
    ("data", "match"),
    [
        ("v 0 0 0\nv 1 0\nv 0 1 0\nf 1 2 3\n", "line 2: v needs 3 numbers, got 2"),
        ("v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n", r"point 1 \(counted from 0\) must be finite"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 x\nf 1 2 3\n", "line 3: could not convert"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2\n", r"line 4: .* 3 corners, got 2"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", r"line 4: .*vertex 0"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf -4 -2 -1\n", r"line 4: .*vertex \(3 so far\)"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 5\n", r"faces name vertices that are not there: 5 .*there are 3"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999999999999999\n", "line 4: "),
        ("call other.obj\n", "line 1: the file takes in another one"),
        ("v 0 0 0\n", "holds no triangles"),
    ],
)
def test_a_wrong_line_of_an_obj_is_named(tmp_path: Path, data: str, match: str) -> None:
    refuse(tmp_path / "a.obj", data, match)


# PLY:


def ply_head(kind: str, lines: list[str], mark: str = "\n") -> bytes:
    return mark.join(["ply", f"format {kind} 1.0", "comment K\xf6rper", *lines, "end_header", ""]).encode("latin-1")


VERTEX = ["element vertex 8", "property float x", "property float y", "property float z"]


def faces_of(faces: list[list[int]]) -> list[str]:
    return [f"element face {len(faces)}", "property list uchar int vertex_indices"]


@pytest.mark.parametrize("faces", [TRIANGLES, QUADS, MIXED], ids=["triangles", "quads", "mixed"])
@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_every_ply_of_the_box_is_read(tmp_path: Path, kind: str, faces: list[list[int]]) -> None:
    head = ply_head(kind, VERTEX + faces_of(faces), "\r\n" if kind == "binary_big_endian" else "\n")
    if kind == "ascii":
        body = rows(BOX, [[len(face), *face] for face in faces]).encode()
    else:
        order = "<" if "little" in kind else ">"
        body = BOX.astype(order + "f4").tobytes()
        body += b"".join(struct.pack(f"{order}B{len(face)}i", len(face), *face) for face in faces)
    surface = read(tmp_path / "box.ply", head + body)
    assert is_box(surface)
    np.testing.assert_array_equal(surface.vertices, BOX)


def test_elements_and_properties_beside_the_faces_are_skipped(tmp_path: Path) -> None:
    lines = ["element camera 1", "property float view", "property list uchar short marks", "element vertex 8"]
    lines += ["property uchar red", "property double x", "property double y", "property double z", "property float s"]
    lines += ["property float t", f"element face {len(MIXED)}", "property uchar flag"]
    lines += ["property list uchar uint vertex_index", "property list int float quality"]
    body = struct.pack("<fB2h", 1.5, 2, 7, 8)
    body += b"".join(struct.pack("<B3d2f", 9, *corner, corner[0], corner[1]) for corner in BOX)
    for number, face in enumerate(MIXED):
        body += struct.pack(f"<BB{len(face)}Ii{number % 3}f", 1, len(face), *face, number % 3, *[0.5] * (number % 3))
    (tmp_path / "a.ply").write_bytes(ply_head("binary_little_endian", lines) + body)
    with pytest.warns(MeshWarning, match=r"left out: .*'camera' \(1\)$"):
        surface = TriMesh.from_file(tmp_path / "a.ply")
    assert is_box(surface)
    np.testing.assert_array_equal(surface.uvs, BOX[:, :2])


def test_strips_and_texture_coordinates_of_faces(tmp_path: Path) -> None:
    lines = ["element vertex 4", *VERTEX[1:], "element tristrips 1", "property list int int vertex_indices"]
    surface = read(
        tmp_path / "a.ply", ply_head("ascii", lines) + rows(BOX[:4], [[8, 0, 1, 2, 3, -1, 0, 2, 1]]).encode()
    )
    np.testing.assert_array_equal(surface.triangles, [[0, 1, 2], [2, 1, 3], [0, 2, 1]])
    lines = ["element vertex 4", *VERTEX[1:], "element face 2", "property list uchar int vertex_indices"]
    faces = [[3, 0, 1, 2, 6, 0, 0, 1, 0, 0, 1], [3, 2, 1, 3, 6, 0, 1, 0.5, 0.5, 1, 1]]
    head = ply_head("ascii", [*lines, "property list uchar float texcoord"])
    surface = read(tmp_path / "b.ply", head + rows(BOX[:4], faces).encode())
    assert len(surface.vertices) == 5  # vertex 1 has two texture coordinates
    assert surface.uvs is not None
    np.testing.assert_array_equal(surface.uvs[surface.triangles[1]], [[0, 1], [0.5, 0.5], [1, 1]])


@pytest.mark.parametrize(
    ("lines", "body", "match"),
    [
        (["element vertex 1000000000000000", *VERTEX[1:]], "0 0 0", r"declares 1,000,000,000,000,000 rows of 'vertex'"),
        (VERTEX + faces_of(QUADS), rows(BOX, [[4, *q] for q in QUADS[:5]]), "'face'"),
        (VERTEX + faces_of(QUADS), rows(BOX, [[4, *q] for q in QUADS]) + "1 2", "2 numbers follow what its head"),
        (VERTEX + faces_of(QUADS), rows(BOX, [[4, 8, *q[1:]] for q in QUADS]), "are not there: 8 "),
        (VERTEX + faces_of(QUADS), rows(BOX, [[-4, *q] for q in QUADS]), "cannot have -4 items"),
        (VERTEX + faces_of(QUADS), rows([["nan", 0, 0]], BOX[1:], [[4, *q] for q in QUADS]), "must be finite"),
        (["element vertex -1", *VERTEX[1:]], "", "line 4 of its head"),
        (["element vertex 8", "property half x"], "", "line 5 of its head cannot be read: 'property half x'"),
        (["element face 1", "property list uchar int vertex_indices"], "3 0 0 0", "one element 'vertex'"),
    ],
)
def test_a_ply_that_breaks_its_word_is_refused(tmp_path: Path, lines: list[str], body: str, match: str) -> None:
    refuse(tmp_path / "a.ply", ply_head("ascii", lines) + body.encode(), match)


# STL:


def binary_stl(head: bytes = b"") -> bytes:
    data = head.ljust(80) + struct.pack("<I", 12)
    return data + b"".join(struct.pack("<12fH", 0, 0, 0, *BOX[face].reshape(-1), 0) for face in TRIANGLES)


def text_stl(faces: list[list[int]], name: str = "box") -> str:
    facets = [
        "facet normal 0 0 0\n outer loop\n" + "".join(f"  vertex {x} {y} {z}\n" for x, y, z in BOX[face])
        + " endloop\nendfacet\n" for face in faces
    ]  # fmt: skip
    return f"solid {name}\n" + "".join(facets) + f"endsolid {name}\n"


@pytest.mark.parametrize(
    "data",
    [
        binary_stl(b"made by hand"),
        binary_stl(b"solid made by hand"),
        text_stl(TRIANGLES),
        text_stl(TRIANGLES).upper().encode(),
        b"\xef\xbb\xbf" + text_stl(TRIANGLES).encode(),
        text_stl(TRIANGLES, "K\xf6rper").encode("latin-1"),
        text_stl(TRIANGLES[:5]) + text_stl(TRIANGLES[5:], "the rest"),
    ],
    ids=["binary", "binary solid", "text", "upper case", "mark", "latin-1", "two solids"],
)
def test_every_stl_of_the_box_is_read_with_shared_vertices(tmp_path: Path, data: str | bytes) -> None:
    assert is_box(read(tmp_path / "box.stl", data))


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (binary_stl()[:-30], r"declares 12 triangles \(684 bytes\), but the file has 654 bytes; it was cut off"),
        (binary_stl(b"solid box")[:-30], "was cut off"),
        (binary_stl() + bytes(50), r"declares 12 triangles \(684 bytes\), but the file has 734 bytes"),
        (binary_stl()[:80] + b"\xff\xff\xff\xff" + binary_stl()[84:], "declares 4,294,967,295 triangles"),
        (text_stl(TRIANGLES)[:-14], "must begin with 'endsolid'; the file was cut off"),
        (text_stl(TRIANGLES)[:-60], "line 82: a vertex needs 3 numbers, got 1"),
        (text_stl(TRIANGLES).replace("vertex 0.0 2.0 0.0", "vertex 0.0 2.0", 1), "line 4: a vertex needs 3 numbers"),
        (text_stl(TRIANGLES).replace(" endloop\n", "", 1), r"line 7: 'endloop' .*got 'endfacet'"),
        (text_stl(TRIANGLES).replace("vertex 0.0", "vertex inf", 1), "must be finite, got .*inf"),
        (text_stl([]), "holds no triangles"),
        ("hello", "it holds 5 bytes"),
    ],
)
def test_an_stl_that_breaks_its_word_is_refused(tmp_path: Path, data: str | bytes, match: str) -> None:
    refuse(tmp_path / "a.stl", data, match)


# OFF:


@pytest.mark.parametrize(
    "data",
    [
        "OFF\n# a comment\n8 6 12\n\n" + rows(BOX, [[4, *q] for q in QUADS]),
        "OFF 8 8 0\n" + rows(BOX, [[len(f), *f, 255, 0, 0] for f in MIXED]),
        "COFF\n8 6 12\n" + rows([[*p, 255, 0, 0, 255] for p in BOX], [[4, *q] for q in QUADS]),
        "NOFF\n8 6 12 # counts\n" + rows([[*p, 0, 0, 1] for p in BOX], [[4, *q, 0.5, 0.5, 0.5] for q in QUADS]),
    ],
    ids=["comments", "one line", "colours", "normals"],
)
def test_every_off_of_the_box_is_read(tmp_path: Path, data: str) -> None:
    assert is_box(read(tmp_path / "box.off", data))


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (
            "OFF\n8 6 12\n" + rows(BOX, [[4, *q] for q in QUADS[:5]]),
            r"8 vertices and 6 .*but 13 lines",
        ),
        ("OFF\n7 6 12\n" + rows(BOX, [[4, *q] for q in QUADS]), r"7 vertices and 6 .*but 14 lines"),
        ("OFF\n1000000000000000 6 12\n" + rows(BOX), "but 8 lines follow"),
        ("OFF\n-1 6\n", "line 2: the numbers of vertices and faces"),
        ("OFF\n8 6 12\n" + rows(BOX, [[5, *q] for q in QUADS]), "line 11: a face of 5 corners, but 4 numbers follow"),
        ("OFF\n8 6 12\n" + rows(BOX, [[4, 8, *q[1:]] for q in QUADS]), "are not there: 8 "),
        ("4OFF\n8 6 12\n", "only OFF files of text"),
        ("OFF BINARY\n", "only OFF files of text"),
        ("hello\n", r"line 1: the word 'OFF' .*got 'hello'"),
    ],
)
def test_an_off_that_breaks_its_word_is_refused(tmp_path: Path, data: str, match: str) -> None:
    refuse(tmp_path / "a.off", data, match)


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".stl", ".off", ".gltf", ".glb"])
def test_a_surface_is_no_body(tmp_path: Path, suffix: str) -> None:
    surface = TriMesh(BOX, TRIANGLES)
    path = tmp_path / f"box{suffix}"
    surface.to_trimesh().export(path)
    with pytest.raises(ValueError, match=rf"box\{suffix} must hold tetrahedra.*tetrahedralize"):
        TetMesh.from_file(path)
