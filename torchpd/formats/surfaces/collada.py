"""COLLADA (.dae): the meshes of the scene, each at the place of its node, in metres and y up."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from ..content import Array, Cells, MeshContent
from ..numbers import xml_of
from ..transforms import Z_UP, rotation
from .collada_mesh import Mesh, read_mesh
from .faces import check_tree, join_uvs, left_out

__all__ = ["read_collada"]

_UP = {
    "Y_UP": np.eye(3),
    "Z_UP": Z_UP,
    "X_UP": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
}


def read_collada(path: Path) -> MeshContent:
    """Read all meshes of the scene of a file."""
    root = xml_of(path.read_bytes())
    if root.tag.rpartition("}")[2] != "COLLADA":
        raise ValueError(f"its first element must be COLLADA, got {root.tag[:60]!r}")
    reading = _Reading(root)
    nodes = reading.scene().findall("{*}node")
    check_tree(nodes, reading.nodes_below)
    for node in nodes:
        reading.take(node, np.eye(4))
    return reading.content()


def _numbers(element: Any, count: int) -> Array:
    values = np.array((element.text or "").split(), dtype=np.float64)
    name = element.tag.rpartition("}")[2]
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError(f"{name} of a node must be {count} finite numbers, got {len(values)}")
    return values


def _local(node: Any) -> Array:
    """Transform of a node [4, 4]: product of its elements in their order."""
    matrix = np.eye(4)
    for element in node:
        step = np.eye(4)
        name = element.tag.rpartition("}")[2]
        if name == "matrix":
            step = _numbers(element, 16).reshape(4, 4)
        elif name == "translate":
            step[:3, 3] = _numbers(element, 3)
        elif name == "scale":
            step[:3, :3] = np.diag(_numbers(element, 3))
        elif name == "rotate":
            *axis, angle = _numbers(element, 4)
            step[:3, :3] = rotation(np.array(axis), angle)
        elif name in ("lookat", "skew"):
            raise ValueError(f"a node has the transform {name!r}, which is not read; write it as a matrix")
        matrix = matrix @ step
    if not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]):
        raise ValueError(f"the matrix of a node must be affine, but its last row is {matrix[3].tolist()}")
    return matrix


class _Reading:
    """Points and faces of the nodes so far."""

    def __init__(self, root: Any) -> None:
        self.root = root
        named = [element for element in root.iter() if element.get("id")]
        self.by_id = {element.get("id"): element for element in named}
        self.twice = {name for name, count in Counter(e.get("id") for e in named).items() if count > 1}
        self.meshes: dict[str, Mesh] = {}
        self.points: list[Array] = []
        self.uvs: list[Array | None] = []
        self.cells: list[Cells] = []
        self.count = 0
        self.used: set[str] = set()
        self.others: Counter[str] = Counter()

    def find(self, url: str | None, kind: str) -> Any:
        """Find the element of a kind by its reference."""
        name = url or ""
        if not name.startswith("#"):
            raise ValueError(f"it refers to {name[:80]!r}, which is not within the file and is not read")
        found = self.by_id.get(name[1:])
        if found is None or found.tag.rpartition("}")[2] != kind:
            raise ValueError(f"it refers to the {kind} {name[:80]!r}, which is not there")
        if name[1:] in self.twice:
            raise ValueError(f"it refers to {name[:80]!r}, but several of its elements have this id")
        return found

    def scene(self) -> Any:
        """The scene to draw."""
        instance = self.root.find("{*}scene/{*}instance_visual_scene")
        if instance is not None:
            return self.find(instance.get("url"), "visual_scene")
        scenes = self.root.findall("{*}library_visual_scenes/{*}visual_scene")
        if len(scenes) != 1:
            raise ValueError(f"it must say which scene is drawn, or have one, got {len(scenes)}")
        return scenes[0]

    def nodes_below(self, node: Any) -> list[Any]:
        """Child nodes of a node, its own and referenced ones."""
        instances = node.iterfind("{*}instance_node")
        return [*node.iterfind("{*}node"), *(self.find(instance.get("url"), "node") for instance in instances)]

    def take(self, node: Any, above: Array) -> None:
        """Add the meshes of a node and of its descendants."""
        matrix = above @ _local(node)
        for below in self.nodes_below(node):
            self.take(below, matrix)
        for child in node:
            name = child.tag.rpartition("}")[2]
            if name == "instance_geometry":
                self._take_geometry(child.get("url"), matrix)
            elif name == "instance_controller":
                self._take_controller(child.get("url"), matrix)

    def _take_controller(self, url: str | None, matrix: Array) -> None:
        controller = self.find(url, "controller")
        for form in controller:
            name = form.tag.rpartition("}")[2]
            if name not in ("skin", "morph"):
                continue
            self.others["skins, of meshes in their bind pose" if name == "skin" else "sets of morph targets"] += 1
            shape = form.find("{*}bind_shape_matrix")
            place = matrix if shape is None else matrix @ _numbers(shape, 16).reshape(4, 4)
            target = self.by_id.get((form.get("source") or "")[1:])
            if target is not None and target.tag.endswith("}controller") and target is not controller:
                raise ValueError("a controller acts on another controller, which is not read")
            self._take_geometry(form.get("source"), place)

    def _take_geometry(self, url: str | None, matrix: Array) -> None:
        geometry = self.find(url, "geometry")
        name = geometry.get("id")
        self.used.add(name)
        if geometry.find("{*}mesh") is None:
            self.others["geometries without a mesh"] += 1
            return
        if name not in self.meshes:
            self.meshes[name] = read_mesh(geometry.find("{*}mesh"), self.find, self.others)
        mesh = self.meshes[name]
        self.others["geometries without faces"] += not len(mesh.corners)
        turned = np.linalg.det(matrix[:3, :3]) < 0
        self.cells += [cells for cells in mesh.placed(self.count, turned=bool(turned)) if len(cells)]
        self.points.append(mesh.points @ matrix[:3, :3].T + matrix[:3, 3])
        self.uvs.append(mesh.uvs)
        self.count += len(mesh.points)

    def content(self) -> MeshContent:
        geometries = self.root.findall("{*}library_geometries/{*}geometry")
        self.others["geometries in no node of the scene"] = sum(g.get("id") not in self.used for g in geometries)
        notes = left_out(+self.others)
        points = np.concatenate([np.empty((0, 3)), *self.points]) @ self._axes(notes).T
        declared = self.root.find("{*}asset/{*}unit") is not None
        return MeshContent(points, self.cells, join_uvs(self.uvs, notes), notes, declared)

    def _axes(self, notes: list[str]) -> Array:
        """Matrix from the numbers of the file to metres with y up [3, 3]."""
        unit = self.root.find("{*}asset/{*}unit")
        scale = float(unit.get("meter", "1")) if unit is not None else 1.0
        if not 0.0 < scale < np.inf:
            raise ValueError(f"the unit of the file must be a positive number of metres, got {scale}")
        if scale != 1.0:
            notes.append(f"its unit is {scale:g} m, and its numbers were turned into metres")
        up = (self.root.findtext("{*}asset/{*}up_axis") or "Y_UP").strip()
        if up not in _UP:
            raise ValueError(f"up_axis must be {', '.join(_UP)}, got {up[:40]!r}")
        if up != "Y_UP":
            notes.append(f"its {up[0].lower()} axis is up, and it was turned so that y is")
        return scale * _UP[up]
