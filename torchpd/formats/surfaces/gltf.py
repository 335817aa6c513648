"""glTF 2.0, .gltf and .glb: the triangles of the default scene, each mesh at its node, in metres, y up."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..content import Array, Cells, Index, MeshContent
from .faces import check_corners, fan_triangles, join, join_uvs, left_out, strip_triangles
from .gltf_buffers import Document

__all__ = ["read_gltf"]

_Node = tuple[int, Array]  # its number, and the transform of its parent

# extensions that change no position: materials, textures, lights, names, metadata
_HARMLESS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "KHR_lights_", "EXT_lights_", "KHR_xmp")
_READ = ("KHR_mesh_quantization",)
_ADVICE = {
    "KHR_draco_mesh_compression": "decompress it, as with gltf-transform: gltf-transform cp in.glb out.glb",
    "EXT_meshopt_compression": "decompress it, as with gltf-transform: gltf-transform cp in.glb out.glb",
    "KHR_meshopt_compression": "decompress it, as with gltf-transform: gltf-transform cp in.glb out.glb",
    "EXT_mesh_gpu_instancing": "write each instance as a node of its own",
}
_POINTS_AND_LINES = {0: "points", 1: "lines", 2: "line loops", 3: "line strips"}


def read_gltf(path: Path) -> MeshContent:
    """Read the triangles of all nodes of the default scene (without one: of all nodes)."""
    document = Document.load(path)
    for name in document.names("extensionsRequired"):
        if name not in _READ and not name.startswith(_HARMLESS):
            fix = _ADVICE.get(name, "write it without this extension")
            raise ValueError(f"it requires the extension {name}, which is not read; {fix}")
    reading = _Reading(document)
    for node, above in _nodes(document, reading.notes):
        reading.take(node, above)
    return reading.content()


def _nodes(document: Document, notes: list[str]) -> list[tuple[dict[str, Any], Array]]:
    """Every node of the scene with its transform [4, 4] to the axes of the scene."""
    nodes, scenes = document.items("nodes"), document.items("scenes")
    children = {child for node in nodes for child in document.numbers(node, "children")}
    if "scene" in document.root:
        scene = document.item("scenes", document.root["scene"])
        roots = document.numbers(scene, "nodes")
        if len(scenes) > 1:
            notes.append(f"of {len(scenes)} scenes only the default one was read")
    else:
        roots = [number for number in range(len(nodes)) if number not in children]
    stack: list[_Node] = [(number, np.eye(4)) for number in reversed(roots)]
    seen: set[int] = set()
    found = []
    while stack:
        number, above = stack.pop()
        node = document.item("nodes", number)
        if number in seen:
            raise ValueError(f"node {number} has more than one parent, or is below itself")
        seen.add(number)
        transform = above @ _local(node, number)
        found.append((node, transform))
        stack += [(child, transform) for child in reversed(document.numbers(node, "children"))]
    if "scene" not in document.root and len(seen) < len(nodes):
        raise ValueError("some of its nodes are below themselves")
    return found


def _local(node: dict[str, Any], number: int) -> Array:
    """Transform of a node [4, 4] from its matrix (by columns) or its translation, rotation and scale."""

    def values(name: str, default: list[float]) -> Array:
        array = np.array(node.get(name, default), dtype=np.float64)
        if array.shape != (len(default),) or not np.isfinite(array).all():
            raise ValueError(f"{name} of node {number} must be {len(default)} finite numbers")
        return array

    transform = np.eye(4)
    if "matrix" in node:
        transform[:] = values("matrix", [0.0] * 16).reshape(4, 4).T
        if not np.array_equal(transform[3], [0.0, 0.0, 0.0, 1.0]):
            raise ValueError(f"matrix of node {number} must be affine, but its last row is {transform[3].tolist()}")
        return transform
    x, y, z, w = values("rotation", [0.0, 0.0, 0.0, 1.0])
    length = x * x + y * y + z * z + w * w
    if length == 0.0:
        raise ValueError(f"rotation of node {number} must not be zero")
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    transform[:3, :3] += 2.0 / length * (w * cross + cross @ cross)
    transform[:3, :3] *= values("scale", [1.0, 1.0, 1.0])
    transform[:3, 3] = values("translation", [0.0, 0.0, 0.0])
    return transform


class _Reading:
    """Points and triangles of the nodes so far."""

    def __init__(self, document: Document) -> None:
        self.document = document
        self.points: list[Array] = []
        self.uvs: list[Array | None] = []
        self.triangles: list[Index] = []
        self.count = 0
        self.notes: list[str] = []
        self.others: Counter[str] = Counter()
        self.used: set[int] = set()

    def take(self, node: dict[str, Any], transform: Array) -> None:
        """Add the mesh of a node."""
        extensions = node.get("extensions", {})
        if "EXT_mesh_gpu_instancing" in extensions:
            raise ValueError(
                f"it uses EXT_mesh_gpu_instancing, which is not read; {_ADVICE['EXT_mesh_gpu_instancing']}"
            )
        if "mesh" not in node:
            return
        self.used.add(node["mesh"])
        mesh = self.document.item("meshes", node["mesh"])
        if extensions.get("KHR_node_visibility", {}).get("visible") is False:
            self.others["invisible meshes"] += 1
            return
        if "skin" in node:
            self.others["skins, of meshes in their bind pose"] += 1
        offsets: dict[tuple[int, int | None], int] = {}  # primitives of a mesh may share their vertices
        for primitive in self.document.items("primitives", mesh):
            self._take_primitive(primitive, transform, offsets)

    def _take_primitive(
        self, primitive: dict[str, Any], transform: Array, offsets: dict[tuple[int, int | None], int]
    ) -> None:
        mode = primitive.get("mode", 4)
        attributes = primitive.get("attributes", {})
        if mode in _POINTS_AND_LINES:
            self.others[f"primitives of {_POINTS_AND_LINES[mode]}"] += 1
            return
        if mode not in (4, 5, 6):
            raise ValueError(f"mode of a primitive must be 0 to 6, got {mode}")
        if "POSITION" not in attributes:
            self.others["primitives without positions"] += 1
            return
        if primitive.get("targets"):
            self.others["sets of morph targets"] += 1
        key = (attributes["POSITION"], attributes.get("TEXCOORD_0"))
        points = self.document.accessor(key[0], ("VEC3",))
        if key not in offsets:
            offsets[key] = self.count
            self._add_points(points, key[1], transform)
        if "indices" in primitive:
            corners = self.document.accessor(primitive["indices"], ("SCALAR",)).reshape(-1)
            if corners.dtype.kind != "i":
                raise ValueError(f"indices of a primitive must be whole numbers, got {corners.dtype}")
        else:
            corners = np.arange(len(points))
        check_corners(corners, len(points), "vertices of a primitive")
        triangles = self._triangles(corners, mode)
        # A reflection reverses triangles: the winding in the file is that of the node's axes.
        if np.linalg.det(transform[:3, :3]) < 0:
            triangles = triangles[:, ::-1]
        self.triangles.append(triangles + offsets[key])

    def _triangles(self, corners: Index, mode: int) -> Index:
        if mode == 5:
            return strip_triangles(corners)
        if mode == 6:
            return fan_triangles(corners)
        if len(corners) % 3:
            raise ValueError(f"a primitive of triangles must have 3 corners for each, got {len(corners)} in all")
        return corners.reshape(-1, 3)

    def _add_points(self, points: NDArray[Any], texture: int | None, transform: Array) -> None:
        coordinates = None
        if texture is not None:
            coordinates = self.document.accessor(texture, ("VEC2",)).astype(np.float64)
            if len(coordinates) != len(points):
                raise ValueError(f"{len(points)} positions of a primitive have {len(coordinates)} texture coordinates")
            coordinates[:, 1] = 1.0 - coordinates[:, 1]  # glTF counts down from the upper edge of an image
        self.points.append(points.astype(np.float64) @ transform[:3, :3].T + transform[:3, 3])
        self.uvs.append(coordinates)
        self.count += len(points)

    def content(self) -> MeshContent:
        points = np.concatenate(self.points) if self.points else np.empty((0, 3))
        triangles = join([part.reshape(-1) for part in self.triangles]).reshape(-1, 3)
        self.others["meshes in no node of the scene"] = len(self.document.items("meshes")) - len(self.used)
        self.others["animations"] = len(self.document.items("animations"))
        notes = self.notes + left_out(+self.others)
        uvs = join_uvs(self.uvs, notes)
        return MeshContent(points, [Cells("triangle", triangles)] if len(triangles) else [], uvs, notes)
