"""3MF: the meshes of all build items, at the places of their transforms, in metres; axes are as in the file."""

from __future__ import annotations

import posixpath
import zipfile
from collections import Counter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ..content import Array, Cells, Index, MeshContent
from .faces import check_corners, check_tree, join, left_out

__all__ = ["read_3mf"]

_UNITS = {"micron": 1e-6, "millimeter": 1e-3, "centimeter": 1e-2, "inch": 0.0254, "foot": 0.3048, "meter": 1.0}
# namespace suffixes of extensions that are read (production) or change no position (materials)
_EXTENSIONS = ("/production/2015/06", "/material/2015/02")
_SUPPORT = "support"

_Key = tuple[str, str]  # part of the package that holds an object, and its number there


def read_3mf(path: Path) -> MeshContent:
    """Read all build items; other objects are omitted."""
    try:
        with zipfile.ZipFile(path) as archive:
            package = _Package(archive)
    except (zipfile.BadZipFile, NotImplementedError, EOFError) as error:
        raise ValueError(f"its archive cannot be read: {error}") from None
    reading = _Reading(package)
    items = [(_key(item, package.main), _transform(item)) for item in package.root.iterfind("{*}build/{*}item")]
    check_tree([key for key, _ in items], reading.parts_of)
    for key, matrix in items:
        reading.take(key, matrix)
    return reading.content()


class _Package:
    """Models of an archive, and their objects."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        names = archive.namelist()
        relations = next((name for name in names if name.lower() == "_rels/.rels"), None)
        if relations is None:
            raise ValueError("it has no _rels/.rels, which names its model; is it a 3MF?")
        targets = [
            row.get("Target", "")
            for row in _parse(archive, relations).iterfind("{*}Relationship")
            if row.get("Type", "").endswith("/3dmodel")
        ]
        if len(targets) != 1:
            raise ValueError(f"_rels/.rels must name one model, got {len(targets)}")
        self.main = _part(targets[0])
        self.objects: dict[_Key, Any] = {}
        parts = [name for name in names if name.lower().endswith(".model")]
        if self.main not in parts:
            raise ValueError(f"its model {self.main!r} is missing")
        for part in parts:
            root = _parse(archive, part)
            self._check_extensions(archive, part, root)
            if part == self.main:
                self.root = root
            for thing in root.iterfind("{*}resources/{*}object"):
                key = part, thing.get("id", "")
                if key in self.objects:
                    raise ValueError(f"object {key[1]!r} of {part} comes twice")
                self.objects[key] = thing
        unit = self.root.get("unit", "millimeter")
        if unit not in _UNITS:
            raise ValueError(f"unit must be {', '.join(_UNITS)}, got {unit!r}")
        self.unit, self.scale = unit, _UNITS[unit]

    def _check_extensions(self, archive: zipfile.ZipFile, part: str, root: Any) -> None:
        """Refuse extensions that a model requires and that are not read."""
        required = root.get("requiredextensions", "").split()
        if not required:
            return
        with archive.open(part) as file:
            spaces = dict(pair for _, pair in ElementTree.iterparse(file, events=["start-ns"]))
        for prefix in required:
            space = spaces.get(prefix, prefix)
            if not space.endswith(_EXTENSIONS):
                raise ValueError(f"it requires the extension {space}, which is not read; write it without")


def _parse(archive: zipfile.ZipFile, name: str) -> Any:
    try:
        return ElementTree.fromstring(archive.read(name))
    except ElementTree.ParseError as error:
        raise ValueError(f"{name} is no sound XML: {error}") from None


def _part(name: str) -> str:
    return posixpath.normpath(name).lstrip("/")


def _key(reference: Any, part: str) -> _Key:
    """Key of the object of an item or a component; the production extension refers to other parts."""
    path = next((value for name, value in reference.attrib.items() if name.endswith("}path")), None)
    return part if path is None else _part(path), reference.get("objectid", "")


def _transform(reference: Any) -> Array:
    """Matrix of an item or a component [4, 3], acting on rows (3MF core specification, section 3.3)."""
    words = reference.get("transform", "1 0 0 0 1 0 0 0 1 0 0 0").split()
    matrix = np.array(words, dtype=np.float64)
    if matrix.shape != (12,) or not np.isfinite(matrix).all():
        raise ValueError(f"a transform must be 12 finite numbers, got {len(words)}")
    return matrix.reshape(4, 3)


class _Reading:
    """Points and triangles of the items so far."""

    def __init__(self, package: _Package) -> None:
        self.package = package
        self.meshes: dict[_Key, tuple[Array, Index]] = {}
        self.points: list[Array] = []
        self.triangles: list[Index] = []
        self.count = 0
        self.used: set[_Key] = set()
        self.others: Counter[str] = Counter()

    def parts_of(self, key: _Key) -> list[_Key]:
        """Components of an object."""
        thing = self.package.objects.get(key)
        if thing is None:
            raise ValueError(f"object {key[1]!r} of {key[0]} is used, but is not there")
        return [_key(part, key[0]) for part in thing.iterfind("{*}components/{*}component")]

    def take(self, key: _Key, matrix: Array) -> None:
        """Add an object with its components."""
        thing = self.package.objects[key]
        self.used.add(key)
        if thing.get("type") == _SUPPORT:
            self.others["objects of type support"] += 1
            return
        for part in thing.iterfind("{*}components/{*}component"):
            inner = _transform(part)
            joint = np.vstack([inner[:3] @ matrix[:3], inner[3] @ matrix[:3] + matrix[3]])
            self.take(_key(part, key[0]), joint)
        if thing.find("{*}mesh") is not None:
            points, triangles = self._mesh(key, thing.find("{*}mesh"))
            self.others["objects without triangles"] += not len(triangles)
            turned = np.linalg.det(matrix[:3]) < 0
            self.triangles.append((triangles[:, ::-1] if turned else triangles) + self.count)
            self.points.append((points @ matrix[:3] + matrix[3]) * self.package.scale)
            self.count += len(points)

    def _mesh(self, key: _Key, mesh: Any) -> tuple[Array, Index]:
        if key not in self.meshes:
            corners = [[row.get(name, "") for name in "xyz"] for row in mesh.iterfind("{*}vertices/{*}vertex")]
            faces = mesh.iterfind("{*}triangles/{*}triangle")
            names = [[row.get(name, "") for name in ("v1", "v2", "v3")] for row in faces]
            points = np.array(corners, dtype=np.float64).reshape(-1, 3)
            triangles = np.array(names or [], dtype=np.int64).reshape(-1, 3)
            check_corners(triangles.reshape(-1), len(points), f"vertices of object {key[1]}")
            for part in mesh:
                name = part.tag.rpartition("}")[2]
                if name not in ("vertices", "triangles", "trianglesets"):
                    self.others[f"elements {name!r} of meshes"] += 1
            self.meshes[key] = points, triangles
        return self.meshes[key]

    def content(self) -> MeshContent:
        self.others["objects that are no part of the build"] = len(self.package.objects) - len(self.used)
        triangles = join([part.reshape(-1) for part in self.triangles]).reshape(-1, 3)
        cells = [Cells("triangle", triangles)] if len(triangles) else []
        notes = left_out(+self.others)
        if self.package.scale != 1.0:
            notes.append(f"its unit is the {self.package.unit}, and its numbers were turned into metres")
        return MeshContent(np.concatenate([np.empty((0, 3)), *self.points]), cells, None, notes, in_metres=True)
