"""PLY, text and binary of either byte order: faces of any size, triangle strips, texture coordinates."""

from __future__ import annotations

import re
import struct
from array import array
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..content import Array, Cells, Index, MeshContent
from .faces import check_corners, face_blocks, join, left_out, one_uv_each, strip_triangles

__all__ = ["read_ply"]

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_UVS = (("texture_u", "texture_v"), ("texture_s", "texture_t"), ("u", "v"), ("s", "t"))
_CODES = dict(zip(("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"), "bBhHiIqQfd", strict=True))
_CORNERS = ("vertex_indices", "vertex_index")


@dataclass
class _Property:
    name: str
    kind: str  # NumPy type code, without byte order
    counter: str = ""  # list: type code of its length


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)
    values: dict[str, NDArray[Any]] = field(default_factory=dict)  # list: all items, one row after another
    sizes: dict[str, Index] = field(default_factory=dict)  # list: number of items of each row

    def find(self, names: tuple[str, ...]) -> str | None:
        return next((name for name in names if name in self.values), None)


def read_ply(path: Path) -> MeshContent:
    """Read vertices, faces and strips of a file; other elements are skipped, and noted if they have rows."""
    order, elements, body = _head(path.read_bytes())
    rest = _read_text(body, elements) if order == "" else _read_binary(body, elements, order)
    if rest:
        raise ValueError(f"{rest} follow what its head declares")
    return _content(elements)


def _head(data: bytes) -> tuple[str, list[_Element], bytes]:
    """Byte order ("" for text), elements declared in the head, and the data after the head."""
    last = re.search(rb"(?<=[\r\n])end_header", data)
    if not data.startswith(b"ply") or last is None:
        raise ValueError("a PLY begins with 'ply' and has a line 'end_header'; the file is empty, cut off or no PLY")
    end = b"\r\n" if data.startswith(b"ply\r\n") else data[3:4]
    order, elements = None, list[_Element]()
    for number, line in enumerate(data[: last.start()].decode("latin-1").splitlines()[1:], start=2):
        words = line.split()
        try:
            if not words or words[0] in ("comment", "obj_info"):
                continue
            if words[0] == "format":
                order = _FORMATS[words[1]]
            elif words[0] == "element":
                elements.append(_Element(words[1], int(words[2])))
                if elements[-1].count < 0:
                    raise ValueError
            elif words[0] == "property" and words[1] == "list":
                elements[-1].properties.append(_Property(words[4], _TYPES[words[3]], _TYPES[words[2]]))
            elif words[0] == "property":
                elements[-1].properties.append(_Property(words[2], _TYPES[words[1]]))
            else:
                raise ValueError
        except (KeyError, IndexError, ValueError):
            raise ValueError(f"line {number} of its head cannot be read: {line.strip()[:60]!r}") from None
    if order is None:
        raise ValueError("its head has no line 'format ascii|binary_little_endian|binary_big_endian 1.0'")
    for element in elements:
        names = [p.name for p in element.properties]
        if len(set(names)) < len(names) or not names or any(p.counter[:1] == "f" for p in element.properties):
            raise ValueError(f"the properties of its element {element.name!r} must be different ones: {names}")
    return order, elements, data[last.end() :].removeprefix(end)


def _read_text(body: bytes, elements: list[_Element]) -> str:
    """Fill the elements from a text of doubles; returns the rest of it."""
    try:
        numbers = np.array(body.split(), dtype="<f8")
    except ValueError as error:
        raise ValueError(f"its rows must hold numbers: {error}") from None
    for element in elements:
        element.properties = [_Property(p.name, "f8", "f8" if p.counter else "") for p in element.properties]
    return _read_binary(numbers.tobytes(), elements, "<", "numbers")


def _read_binary(body: bytes, elements: list[_Element], order: str, unit: str = "bytes") -> str:
    """Fill the elements one after another; returns the rest of the bytes."""
    place, width = 0, 8 if unit == "numbers" else 1
    for element in elements:
        left = len(body) - place
        least = sum(np.dtype(p.counter or p.kind).itemsize for p in element.properties)
        if element.count * least > left:
            raise ValueError(
                f"its head declares {element.count:,} rows of {element.name!r}, but only "
                f"{left // width:,} {unit} are left for them"
            )
        place = _fill_alike(element, body, place, order) or _fill_each(element, body, place, order)
    return f"{(len(body) - place) // width:,} {unit}" if body[place:].strip() else ""


def _fill_alike(element: _Element, body: bytes, place: int, order: str) -> int:
    """Fill an element if all rows have lists as long as the first; returns the end, or 0 otherwise."""
    lengths, offsets, row = [], [], 0
    for p in element.properties:
        length = 1
        if p.counter:
            length = _length(element, body, place + row, order + p.counter) if element.count else 0
            row += np.dtype(p.counter).itemsize
        lengths.append(length)
        offsets.append(row)
        row += length * np.dtype(p.kind).itemsize
    if place + element.count * row > len(body):
        return 0
    for p, length, offset in zip(element.properties, lengths, offsets, strict=True):
        kind = np.dtype(order + p.kind)
        if p.counter:
            counter = np.dtype(order + p.counter)
            begin = place + offset - counter.itemsize
            sizes = np.ndarray(element.count, counter, body, begin, (row,)) if element.count else np.empty(0)
            if (sizes != length).any():
                return 0
            element.sizes[p.name] = np.full(element.count, length, dtype=np.int64)
        if element.count and length:
            shape, strides = (element.count, length), (row, kind.itemsize)
            element.values[p.name] = np.ndarray(shape, kind, body, place + offset, strides).reshape(-1)
        else:
            element.values[p.name] = np.empty(0, kind)
    return place + element.count * row


def _fill_each(element: _Element, body: bytes, place: int, order: str) -> int:
    """Fill an element row by row; returns the end."""
    begins: list[array[int]] = [array("q") for _ in element.properties]
    lengths: list[array[int]] = [array("q") for _ in element.properties]
    steps = [(np.dtype(p.counter).itemsize if p.counter else 0, np.dtype(p.kind).itemsize) for p in element.properties]
    for _ in range(element.count):
        for k, p in enumerate(element.properties):
            length = _length(element, body, place, order + p.counter) if p.counter else 1
            lengths[k].append(length)
            begins[k].append(place + steps[k][0])
            place += steps[k][0] + length * steps[k][1]
        if place > len(body):
            raise ValueError(f"the rows of its element {element.name!r} go on beyond its end; it was cut off")
    data = np.frombuffer(body, np.uint8)
    for k, p in enumerate(element.properties):
        sizes, item = np.array(lengths[k], dtype=np.int64), steps[k][1]
        within = np.arange(int(sizes.sum())) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        first = np.repeat(np.array(begins[k], dtype=np.int64), sizes) + item * within
        element.values[p.name] = data[first[:, None] + np.arange(item)].view(order + p.kind).reshape(-1)
        element.sizes[p.name] = sizes
    return place


def _length(element: _Element, body: bytes, place: int, code: str) -> int:
    """Number of items of the list that begins at a place."""
    kind = np.dtype(code)
    if place + kind.itemsize > len(body):
        raise ValueError(f"the rows of its element {element.name!r} go on beyond its end; it was cut off")
    (value,) = struct.unpack_from(code[0] + _CODES[code[1:]], body, place)
    if not 0 <= value <= len(body) or value != int(value):
        raise ValueError(f"a list of its element {element.name!r} cannot have {value:g} items")
    return int(value)


def _content(elements: list[_Element]) -> MeshContent:
    kinds = [element.name for element in elements]
    if kinds.count("vertex") != 1:
        raise ValueError(f"it must have one element 'vertex', got {', '.join(kinds) or 'none'}")
    vertex = elements[kinds.index("vertex")]
    if vertex.find(("x",)) is None or vertex.find(("y",)) is None or vertex.find(("z",)) is None:
        raise ValueError(f"its vertices must have x, y and z, got {', '.join(vertex.values)}")
    points = np.stack([vertex.values[axis].astype(np.float64) for axis in "xyz"], axis=1)
    uvs = next((_columns(vertex, pair) for pair in _UVS if vertex.find(pair[:1]) and vertex.find(pair[1:])), None)
    content = MeshContent(points, [], uvs)
    for element in elements:
        if element.name == "face":
            content = _with_faces(content, element)
        elif element.name == "tristrips" and element.find(_CORNERS):
            content.cells.extend(_strips(element, len(points)))
        elif element.name != "vertex" and element.count:
            content.notes.extend(left_out({f"rows of the element {element.name!r}": element.count}))
    return content


def _columns(vertex: _Element, names: tuple[str, str]) -> Array:
    return np.stack([vertex.values[name].astype(np.float64) for name in names], axis=1)


def _whole(element: _Element, name: str, count: int) -> Index:
    """Check the vertex numbers of a list."""
    values = element.values[name]
    if not (np.abs(values.astype(np.float64)) < 2.0**53).all() or (values != values.astype(np.int64)).any():
        raise ValueError(f"{name} of its element {element.name!r} must be vertex numbers, got {values.max()}")
    corners = values.astype(np.int64)
    check_corners(corners[corners != -1] if element.name == "tristrips" else corners, count)
    return corners


def _with_faces(content: MeshContent, face: _Element) -> MeshContent:
    """Add the faces; returns their own texture coordinates (a list of u, v of every corner), if any."""
    name = face.find(_CORNERS)
    if name is None or name not in face.sizes:
        raise ValueError(f"its faces must have a list vertex_indices, got {', '.join(face.values)}")
    points, uvs, notes = content.points, content.uvs, content.notes
    corners, sizes = _whole(face, name, len(points)), face.sizes[name]
    if "texcoord" in face.sizes and len(corners):
        if np.array_equal(face.sizes["texcoord"], 2 * sizes) and not content.cells:
            values = face.values["texcoord"].astype(np.float64).reshape(-1, 2)
            values, numbers = np.unique(values, axis=0, return_inverse=True)
            points, corners, uvs = one_uv_each(points, corners, numbers.reshape(-1), values)
        else:
            notes.append("texture coordinates left out: some faces have none")
    return MeshContent(points, [*content.cells, *face_blocks(corners, sizes, notes)], uvs, notes)


def _strips(element: _Element, count: int) -> list[Cells]:
    """Triangles of strips; -1 begins a new strip."""
    name = element.find(_CORNERS) or ""
    numbers = np.split(_whole(element, name, count), np.cumsum(element.sizes[name])[:-1])
    runs = [run[run >= 0] for strip in numbers for run in np.split(strip, np.flatnonzero(strip == -1))]
    triangles = join([strip_triangles(run).reshape(-1) for run in runs]).reshape(-1, 3)
    return [Cells("triangle", triangles)] if len(triangles) else []
