"""glTF files: the box of 1 x 2 x 3 m comes back from every way to store it, or an error says why not."""

from __future__ import annotations

import base64
import copy
import json
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from torchpd import MeshWarning, TriMesh

BOX = np.array([[x, y, z] for z in (0.0, 3.0) for y in (0.0, 2.0) for x in (0.0, 1.0)])
QUADS = [[2, 3, 1, 0], [4, 5, 7, 6], [0, 1, 5, 4], [3, 2, 6, 7], [1, 3, 7, 5], [2, 0, 4, 6]]
CORNERS = np.array([[q[0], q[1], q[2], q[0], q[2], q[3]] for q in QUADS]).reshape(-1)
CODES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}


class Scene:
    """A document with one buffer, to which accessors are added."""

    def __init__(self) -> None:
        self.data = b""
        self.root: dict[str, Any] = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": []}

    def view(self, data: bytes, **more: Any) -> int:
        self.data += bytes(-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)} | more
        self.root["bufferViews"].append(view)
        self.data += data
        return len(self.root["bufferViews"]) - 1

    def add(self, array: np.ndarray, code: str, **more: Any) -> int:
        kind = {1: "SCALAR", 2: "VEC2", 3: "VEC3"}[1 if array.ndim == 1 else array.shape[1]]
        table = {"componentType": CODES[code], "count": len(array), "type": kind} | more
        if "bufferView" not in table:
            table["bufferView"] = self.view(array.astype("<" + code).tobytes())
        self.root["accessors"].append({k: v for k, v in table.items() if v is not None})
        return len(self.root["accessors"]) - 1

    def primitive(self, positions: int, indices: int | None = None, **more: Any) -> dict[str, Any]:
        found: dict[str, Any] = {"attributes": {"POSITION": positions}}
        return found | ({} if indices is None else {"indices": indices}) | more

    def put(self, primitives: list[dict[str, Any]], nodes: list[dict[str, Any]] | None = None, **more: Any) -> None:
        self.root |= {"meshes": [{"primitives": primitives}], "nodes": nodes or [{"mesh": 0}]} | more

    def text(self, uri: str | None = None) -> bytes:
        uri = uri or "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        return json.dumps(self.root | {"buffers": [{"uri": uri, "byteLength": len(self.data)}]}).encode()

    def binary(self) -> bytes:
        text = json.dumps(self.root | {"buffers": [{"byteLength": len(self.data)}]}).encode()
        text += b" " * (-len(text) % 4)
        data = self.data + bytes(-len(self.data) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def box() -> Scene:
    scene = Scene()
    scene.put([scene.primitive(scene.add(BOX, "f4"), scene.add(CORNERS, "u2"))])
    return scene


def read(path: Path, data: bytes) -> TriMesh:
    path.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return TriMesh.from_file(path)


def refuse(path: Path, data: bytes, match: str) -> None:
    path.write_bytes(data)
    with pytest.raises(ValueError, match=rf"TriMesh\.from_file cannot read {path.name}.*{match}"):
        TriMesh.from_file(path)


def check_box(surface: TriMesh, tolerance: float = 0.0) -> None:
    np.testing.assert_allclose(surface.vertices, BOX, atol=tolerance)
    np.testing.assert_array_equal(surface.triangles, CORNERS.reshape(-1, 3))


def test_buffers_within_the_file_and_beside_it(tmp_path: Path) -> None:
    check_box(read(tmp_path / "a.gltf", box().text()))
    check_box(read(tmp_path / "a.glb", box().binary()))
    check_box(read(tmp_path / "mark.gltf", b"\xef\xbb\xbf" + box().text()))
    (tmp_path / "my data.bin").write_bytes(box().data)
    check_box(read(tmp_path / "b.gltf", box().text("my%20data.bin")))
    (tmp_path / "c.gltf").write_bytes(box().text("lost.bin"))
    with pytest.raises(ValueError, match=r"c\.gltf .*'lost\.bin' is missing"):
        TriMesh.from_file(tmp_path / "c.gltf")
    (tmp_path / "below").mkdir()
    for uri in ("../my%20data.bin", str(tmp_path / "my data.bin"), "https://example.org/data.bin"):
        refuse(tmp_path / "below" / "d.gltf", box().text(uri), "must lie beside the file or below its folder")


@pytest.mark.parametrize(
    ("code", "scale"), [("i1", 127), ("u1", 255), ("i2", 32767), ("u2", 65535)], ids=["i1", "u1", "i2", "u2"]
)
def test_normalised_positions_are_fractions(tmp_path: Path, code: str, scale: int) -> None:
    scene = Scene()
    points = scene.add(np.round(BOX / 3.0 * scale), code, normalized=True)
    node = {"mesh": 0, "scale": [3.0, 3.0, 3.0]}
    needed = {"extensionsRequired": ["KHR_mesh_quantization"], "extensionsUsed": ["KHR_mesh_quantization"]}
    scene.put([scene.primitive(points, scene.add(CORNERS, "u1"))], [node], **needed)
    check_box(read(tmp_path / "a.glb", scene.binary()), tolerance=1.5 / scale)
    if code[0] == "i":  # the least number is -1 as well
        low = scene.add(np.full((8, 3), -scale - 1), code, normalized=True)
        scene.put([scene.primitive(low, scene.add(CORNERS, "u1"))], **needed)
        assert (read(tmp_path / "b.glb", scene.binary()).vertices == -1.0).all()


def test_strides_and_sparse_rows(tmp_path: Path) -> None:
    scene = Scene()
    rows = np.zeros((8, 5), "<f4")
    rows[:, 1:4] = BOX
    view = scene.view(rows.tobytes()[:-4], byteStride=20)
    strided = scene.add(BOX, "f4", bufferView=view, byteOffset=4)
    scene.put([scene.primitive(strided, scene.add(CORNERS, "u4"))])
    check_box(read(tmp_path / "a.glb", scene.binary()))
    for base in (np.vstack([BOX[:4], np.full((4, 3), 9.0)]), None):
        scene = Scene()
        start = 4 if base is not None else 0
        sparse = {
            "count": 8 - start,
            "indices": {"bufferView": scene.view(np.arange(start, 8, dtype="u1").tobytes()), "componentType": 5121},
            "values": {"bufferView": scene.view(BOX[start:].astype("<f4").tobytes())},
        }
        more = {} if base is not None else {"bufferView": None}
        points = scene.add(BOX if base is None else base, "f4", sparse=sparse, **more)
        scene.put([scene.primitive(points, scene.add(CORNERS, "u2"))])
        check_box(read(tmp_path / "b.glb", scene.binary()))


def test_nodes_put_meshes_in_their_places(tmp_path: Path) -> None:
    scene = box()
    half = np.sqrt(0.5)
    matrix = [0.0, 1.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 10.0, 1.0]  # by columns
    scene.root["nodes"] = [
        {"children": [1, 2], "translation": [5.0, 0.0, 0.0], "rotation": [0.0, 0.0, half, half], "scale": [2, 2, 2]},
        {"mesh": 0, "translation": [1.0, 0.0, 0.0]},
        {"mesh": 0, "scale": [-1.0, 1.0, 1.0]},
        {"mesh": 0, "matrix": matrix},
    ]
    surface = read(tmp_path / "a.glb", scene.binary())
    places = surface.vertices.reshape(3, 8, 3)
    x, y, z = BOX.T
    np.testing.assert_allclose(places[0], np.stack([5 - 2 * y, 2 * (x + 1), 2 * z], axis=1), atol=1e-12)
    np.testing.assert_allclose(places[1], np.stack([5 - 2 * y, -2 * x, 2 * z], axis=1), atol=1e-12)
    np.testing.assert_allclose(places[2], np.stack([-y, x, z + 10], axis=1), atol=1e-12)
    # a mirrored node has its triangles turned: every part encloses a positive volume
    assert surface.volume() == pytest.approx((8 + 8 + 1) * 6.0)


def test_the_default_scene_is_read_and_the_rest_said(tmp_path: Path) -> None:
    scene = box()
    scene.root["nodes"] = [{"mesh": 0}, {"mesh": 0, "translation": [9, 0, 0]}, {"mesh": 1, "translation": [18, 0, 0]}]
    scene.root["meshes"] *= 2
    assert read(tmp_path / "a.glb", scene.binary()).volume() == pytest.approx(18.0)
    scene.root |= {"scenes": [{"nodes": [0, 1]}, {"nodes": [1]}], "scene": 1}
    (tmp_path / "b.glb").write_bytes(scene.binary())
    with pytest.warns(MeshWarning, match=r"2 scenes .*default.*scene \(1\)"):
        surface = TriMesh.from_file(tmp_path / "b.glb")
    np.testing.assert_array_equal(surface.bounds, [[9, 0, 0], [10, 2, 3]])


def test_strips_fans_and_corners_without_numbers(tmp_path: Path) -> None:
    scene = Scene()
    square = scene.add(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]), "f4")
    strip = scene.primitive(square, scene.add(np.array([0, 1, 2, 3]), "u1"), mode=5)
    fan = scene.primitive(square, scene.add(np.array([0, 1, 3, 2]), "u1"), mode=6)
    plain = scene.primitive(scene.add(BOX[[0, 1, 2]], "f4"))
    scene.put([strip, fan, plain])
    surface = read(tmp_path / "a.glb", scene.binary())
    np.testing.assert_array_equal(surface.triangles, [[0, 1, 2], [2, 1, 3], [0, 1, 3], [0, 3, 2], [4, 5, 6]])
    assert len(surface.vertices) == 7  # the strip and the fan share theirs


def test_texture_coordinates_count_from_the_lower_edge(tmp_path: Path) -> None:
    scene = Scene()
    uvs = scene.add(np.array([[0, 0], [255, 51]] * 4), "u1", normalized=True)
    primitive = scene.primitive(scene.add(BOX, "f4"), scene.add(CORNERS, "u2"))
    primitive["attributes"]["TEXCOORD_0"] = uvs
    scene.put([primitive])
    np.testing.assert_allclose(read(tmp_path / "a.glb", scene.binary()).uvs, [[0.0, 1.0], [1.0, 0.8]] * 4)


def test_what_is_no_triangle_is_said(tmp_path: Path) -> None:
    scene = box()
    lines = [scene.primitive(0, 1, mode=mode) for mode in (0, 1, 3, 3)]
    scene.root["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": 0}]
    scene.root["meshes"][0]["primitives"] += lines
    scene.root |= {"nodes": [{"mesh": 0, "skin": 0}], "skins": [{"joints": [0]}], "animations": [{}]}
    (tmp_path / "a.glb").write_bytes(scene.binary())
    with pytest.warns(MeshWarning, match="morph targets") as said:
        check_box(TriMesh.from_file(tmp_path / "a.glb"))
    words = str(said[0].message)
    for part in (
        "points (1)",
        "lines (1)",
        "line strips (2)",
        "skins, of meshes in their bind pose (1)",
        "animations (1)",
    ):
        assert part in words


def change(scene: Scene, *path: Any, to: Any) -> bytes:
    """The binary file with one value of its JSON replaced."""
    again = copy.deepcopy(scene)
    table: Any = again.root
    for key in path[:-1]:
        table = table[key]
    table[path[-1]] = to
    return again.binary()


@pytest.mark.parametrize(
    ("path", "value", "match"),
    [
        (["extensionsRequired"], ["KHR_draco_mesh_compression"], "KHR_draco_mesh_compression, .*decompress"),
        (["extensionsRequired"], ["EXT_meshopt_compression"], "EXT_meshopt_compression, .*decompress"),
        (["extensionsRequired"], ["VENDOR_secret"], "requires the extension VENDOR_secret, which is not read"),
        (["nodes", 0, "extensions"], {"EXT_mesh_gpu_instancing": {}}, "uses EXT_mesh_gpu_instancing"),
        (["asset", "version"], "1.0", "glTF 2.0 is read; asset.version is '1.0'"),
        (["accessors", 0, "count"], 10**15, "declares 1,000,000,000,000,000 rows"),
        (["accessors", 0, "count"], -1, r"count of accessor 0 .*got -1"),
        (["accessors", 0, "componentType"], 5130, "unknown componentType 5130"),
        (["accessors", 0, "bufferView"], 7, "bufferViews 7 is named, but there are 2"),
        (["accessors", 1], {"count": 36, "componentType": 5123, "type": "SCALAR"}, "accessor 1 has no bufferView"),
        (["accessors", 1, "count"], 35, r"must have 3 .*got 35 in all"),
        (["accessors", 0, "count"], 7, "vertices of a primitive that are not there: 7"),
        (["bufferViews", 0, "byteStride"], 8, "rows of 12 bytes, 8 bytes apart"),
        (["bufferViews", 1, "byteLength"], 4000, "accessor 1 needs"),
        (["nodes", 0, "children"], [0], "some of its nodes are below themselves"),
        (["nodes"], [{"children": [1, 1]}, {"mesh": 0}], r"node 1 .*parent"),
        (["nodes", 0, "matrix"], [1.0] * 15, "matrix of node 0 must be 16 finite numbers"),
        (["nodes", 0, "rotation"], [0, 0, 0, 0], r"rotation of node 0 .*zero"),
        (["scene"], 0, "scenes 0 is named, but there are 0"),
        (["meshes", 0, "primitives", 0, "mode"], 9, r"mode .* 0 to 6, got 9"),
    ],
)
def test_what_cannot_be_read_is_refused(tmp_path: Path, path: list[Any], value: Any, match: str) -> None:
    scene = box()
    if path[0] == "scene":
        scene.root["scenes"] = []
    refuse(tmp_path / "a.glb", change(scene, *path, to=value), match)


def test_files_that_were_cut_off_are_refused(tmp_path: Path) -> None:
    data = box().binary()
    refuse(tmp_path / "a.glb", data[:-20], "its head declares .* was it cut off")
    refuse(tmp_path / "a.glb", data + data, "its head declares")
    text = json.dumps(box().root | {"buffers": [{"uri": "data.bin", "byteLength": len(box().data)}]}).encode()
    (tmp_path / "data.bin").write_bytes(box().data[:-8])
    refuse(tmp_path / "b.gltf", text, r"buffer 0 declares .* it was cut off")
    refuse(tmp_path / "c.gltf", text[:-8], "its JSON cannot be read")
