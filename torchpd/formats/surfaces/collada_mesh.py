"""A mesh of a COLLADA file: its sources, and faces of all primitives."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..content import Array, Cells, Index
from .faces import check_corners, face_blocks, fan_triangles, join, one_uv_each, strip_triangles, turn_faces

__all__ = ["Mesh", "read_mesh"]

_Find = Callable[[str | None, str], Any]
_NO_FACES = {"lines": "line primitives", "linestrips": "line strips"}
_FACES = ("triangles", "polylist", "polygons", "trifans", "tristrips")


@dataclass
class Mesh:
    """Points [N, 3], corners of all faces and corner count of each, texture coordinates [N, 2] or None."""

    points: Array
    corners: Index
    sizes: Index
    uvs: Array | None

    def placed(self, first: int, *, turned: bool) -> list[Cells]:
        """The faces with vertex numbers from `first` on, reversed if `turned`."""
        corners = turn_faces(self.corners, self.sizes) if turned else self.corners
        return face_blocks(corners + first, self.sizes, [])


def read_mesh(mesh: Any, find: _Find, others: Counter[str]) -> Mesh:
    """Read the faces of a mesh; other primitives are counted in `others`."""
    places = mesh.find("{*}vertices/{*}input[@semantic='POSITION']")
    if places is None:
        raise ValueError("a mesh has no positions")
    points = _source(find(places.get("source"), "source"), 3)
    parts, textures, sizes = list[Index](), list[tuple[Index, Array] | None](), list[Index]()
    for element in mesh:
        name = element.tag.rpartition("}")[2]
        if name in _NO_FACES:
            others[_NO_FACES[name]] += 1
        elif name in _FACES:
            rows, counts, inputs = _rows(element, name)
            if not len(counts):
                continue
            if "VERTEX" not in inputs:
                raise ValueError(f"{name} of a mesh have no input VERTEX")
            check_corners(rows[:, inputs["VERTEX"][0]], len(points), f"vertices in {name}")
            parts.append(rows[:, inputs["VERTEX"][0]])
            sizes.append(counts)
            textures.append(None)
            if "TEXCOORD" in inputs:
                offset, url = inputs["TEXCOORD"]
                uvs = _source(find(url, "source"), 2)
                check_corners(rows[:, offset], len(uvs), f"texture coordinates in {name}")
                textures[-1] = rows[:, offset], uvs
    corners, coordinates = join(parts), None
    if textures and all(pair is not None for pair in textures):
        numbers, tables = zip(*(pair for pair in textures if pair is not None), strict=True)
        begins = np.cumsum([0, *(len(table) for table in tables[:-1])])
        joined = np.concatenate([part + begin for part, begin in zip(numbers, begins, strict=True)])
        points, corners, coordinates = one_uv_each(points, corners, joined, np.concatenate(tables))
    others["faces with fewer than 3 corners"] += int((join(sizes) < 3).sum())
    return Mesh(points, corners, join(sizes), coordinates)


def _source(source: Any, width: int) -> Array:
    """The first `width` columns of the rows of a source."""
    array = source.find("{*}float_array")
    accessor = source.find("{*}technique_common/{*}accessor")
    if array is None or accessor is None:
        raise ValueError(f"source {source.get('id')!r} must have a float_array and an accessor")
    values = np.array((array.text or "").split(), dtype=np.float64)
    if int(array.get("count", len(values))) != len(values):
        raise ValueError(
            f"float_array of {source.get('id')!r} declares {array.get('count')} numbers, got {len(values)}"
        )
    count, stride, offset = (
        int(accessor.get(name, default)) for name, default in (("count", 0), ("stride", 1), ("offset", 0))
    )
    if stride < width or offset < 0 or count < 0 or offset + count * stride > len(values):
        raise ValueError(f"source {source.get('id')!r} declares {count} rows of {stride} in {len(values)} numbers")
    return values[offset : offset + count * stride].reshape(count, stride)[:, :width]


def _rows(element: Any, name: str) -> tuple[Index, Index, dict[str, tuple[int, str | None]]]:
    """For each corner its number in each source [n, inputs]; face sizes; and offset and source of the inputs."""
    inputs: dict[str, tuple[int, str | None]] = {}
    width = 1
    for row in element.iterfind("{*}input"):
        offset = int(row.get("offset", 0))
        if offset < 0:
            raise ValueError(f"offset of an input must not be negative, got {offset}")
        inputs.setdefault(row.get("semantic", ""), (offset, row.get("source")))
        width = max(width, offset + 1)
    if element.find("{*}ph") is not None:
        raise ValueError("its polygons have holes, which are not read; write it as triangles")
    lists = [np.array((p.text or "").split(), dtype=np.int64) for p in element.iterfind("{*}p")]
    if any(len(values) % width for values in lists):
        raise ValueError(f"p of {name} must have {width} numbers for each corner")
    rows = [values.reshape(-1, width) for values in lists]
    if name in ("trifans", "tristrips"):
        pieces = fan_triangles if name == "trifans" else strip_triangles
        rows = [_pick(part, pieces, inputs) for part in rows]
    if name == "polylist":
        sizes = np.array((element.findtext("{*}vcount") or "").split(), dtype=np.int64)
    elif name == "polygons":
        sizes = np.array([len(part) for part in rows], dtype=np.int64)
    else:
        sizes = np.full(sum(len(part) for part in rows) // 3, 3)
    declared = len(lists) if name in ("trifans", "tristrips") else len(sizes)
    table = np.concatenate([np.empty((0, width), dtype=np.int64), *rows])
    if int(element.get("count", declared)) != declared or (sizes < 0).any() or int(sizes.sum()) != len(table):
        raise ValueError(
            f"{name} declare {element.get('count')} faces and have {declared}, with {int(sizes.sum())} corners, of "
            f"which {len(table)} are there"
        )
    return table, sizes, inputs


def _pick(rows: Index, pieces: Callable[[Index], Index], inputs: dict[str, tuple[int, str | None]]) -> Index:
    """Rows of the triangle corners of a strip or a fan."""
    vertices = rows[:, inputs["VERTEX"][0]] if "VERTEX" in inputs else np.arange(len(rows))
    triangles = pieces(np.arange(len(rows)))
    a, b, c = vertices[triangles].T
    corners: Index = triangles[(a != b) & (b != c) & (c != a)].reshape(-1)
    return rows[corners]
