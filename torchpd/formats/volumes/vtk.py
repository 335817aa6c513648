"""Legacy .vtk files, as text or binary: unstructured grids and polygonal data, of all versions.

Format: https://docs.vtk.org/en/latest/design_documents/VTKFileFormats.html.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..content import Index, MeshContent
from ..numbers import Binary, Text, parse
from .vtk_cells import Piece, content_of, offsets_of

__all__ = ["read"]

_TYPES = {
    "bit": "u1",
    "char": "i1",
    "signed_char": "i1",
    "unsigned_char": "u1",
    "short": "i2",
    "unsigned_short": "u2",
    "int": "i4",
    "unsigned_int": "u4",
    "long": "i8",
    "unsigned_long": "u8",
    "vtktypeint64": "i8",
    "vtktypeuint64": "u8",
    "vtkidtype": "i8",
    "float": "f4",
    "double": "f8",
}
# cells of polygonal data: type of a row, and of a row of one or two nodes
_POLYS = {"VERTICES": (2, {1: 1}), "LINES": (4, {2: 3}), "POLYGONS": (7, {3: 5, 4: 9}), "TRIANGLE_STRIPS": (6, {})}


class _Legacy:
    """A file, read from its start to its end."""

    def __init__(self, data: bytes) -> None:
        self.text = Text(data)
        head = self.text.line() or ""
        if "vtk" not in head.lower():
            raise ValueError(f"its first line must be '# vtk DataFile Version ...', got {head[:40]!r}")
        self.text.line()
        mode = (self.text.row() or "").upper()
        if mode not in ("ASCII", "BINARY"):
            raise ValueError(f"its third line must be ASCII or BINARY, got {mode[:40]!r}")
        self.binary = mode == "BINARY"
        self.points: NDArray[np.float64] | None = None
        self.types: list[Index] = []
        self.nodes: list[Index] = []
        self.sizes: list[Index] = []
        self.data: dict[str, NDArray[Any]] = {}

    def values(self, count: int, kind: str, what: str) -> NDArray[Any]:
        """Read the next numbers of a type that the file names."""
        if kind.lower() not in _TYPES:
            raise ValueError(f"{what} must be of a type of VTK, got {kind[:40]!r}")
        dtype = np.dtype(">" + _TYPES[kind.lower()])
        if not self.binary:
            return parse(self.text.words(count, what), np.float64 if dtype.kind == "f" else np.int64, what)
        if kind.lower() == "bit":
            count = (count + 7) // 8
        numbers = Binary(self.text.data, self.text.at, ">i4", ">f8")
        values = numbers.take(dtype, count, what)
        self.text.at = numbers.at
        return values.astype(dtype.newbyteorder("="))

    def ints(self, count: int, kind: str, what: str) -> Index:
        return self.values(count, kind, what).astype(np.int64)


def read(path: Path) -> MeshContent:
    """Read an unstructured grid or polygonal data."""
    file = _Legacy(path.read_bytes())
    kind = (file.text.row() or "").split()
    while kind and kind[0].upper() in ("FIELD", "METADATA"):
        _skip_metadata(file) if kind[0].upper() == "METADATA" else _read_field(file, int(kind[2]), {})
        kind = (file.text.row() or "").split()
    if len(kind) < 2 or kind[0].upper() != "DATASET":
        raise ValueError(f"DATASET must follow its head, got {' '.join(kind)[:40]!r}")
    if kind[1].upper() not in ("UNSTRUCTURED_GRID", "POLYDATA"):
        raise ValueError(f"a data set {kind[1].upper()} is not read; save it as an unstructured grid")
    notes = _read_sections(file)
    if file.points is None:
        raise ValueError("it has no POINTS")
    empty = [np.empty(0, dtype=np.int64)]
    types, sizes = np.concatenate(file.types or empty), np.concatenate(file.sizes or empty)
    nodes = np.concatenate(file.nodes or empty)
    if len(types) != len(sizes):
        raise ValueError(f"it declares {len(sizes)} cells, but {len(types)} types of cells")
    starts = offsets_of(np.cumsum(sizes), nodes, "cells")
    content = content_of([Piece(file.points, types, nodes, starts, file.data)])
    content.notes.extend(notes)
    return content


def _read_sections(file: _Legacy) -> list[str]:
    """Read all sections; an error in data beside the mesh is noted and ends the reading."""
    target: dict[str, NDArray[Any]] | None = None
    while (row := file.text.row()) is not None:
        fields = row.split()
        key = fields[0].upper()
        if key in ("CELL_DATA", "POINT_DATA"):
            target = file.data if key == "CELL_DATA" else {}
            count = _whole(fields, 1, key)
        elif key == "METADATA":
            _skip_metadata(file)
        elif target is None:
            _read_mesh(file, key, fields)
        else:
            try:
                _read_array(file, key, fields, count, target)
            except (ValueError, IndexError) as error:
                return [f"data beside the mesh could not be read ({error})"]
    return []


def _whole(fields: list[str], place: int, what: str) -> int:
    if len(fields) <= place or not fields[place].isdigit():
        raise ValueError(f"{what} must be followed by a count, got {' '.join(fields)[:40]!r}")
    return int(fields[place])


def _read_mesh(file: _Legacy, key: str, fields: list[str]) -> None:
    if key == "POINTS":
        count = _whole(fields, 1, key)
        kind = fields[2] if len(fields) > 2 else "float"
        file.points = file.values(3 * count, kind, "points").astype(np.float64).reshape(count, 3)
    elif key == "CELLS":
        nodes, sizes = _read_rows(file, fields)
        file.nodes.append(nodes)
        file.sizes.append(sizes)
    elif key == "CELL_TYPES":
        file.types.append(file.ints(_whole(fields, 1, key), "int", "types of cells"))
    elif key in _POLYS:
        nodes, sizes = _read_rows(file, fields)
        usual, special = _POLYS[key]
        file.nodes.append(nodes)
        file.sizes.append(sizes)
        types = np.full(len(sizes), usual)
        for size, other in special.items():
            types[sizes == size] = other
        file.types.append(types)
    elif key == "FIELD":
        _read_field(file, _whole(fields, 2, key), {})
    else:
        raise ValueError(f"section {key[:40]!r} is not known")


def _read_rows(file: _Legacy, fields: list[str]) -> tuple[Index, Index]:
    """Nodes of all cells and node count of each: rows with a leading length or, since version 5.1, offsets."""
    key = fields[0].upper()
    count, size = _whole(fields, 1, key), _whole(fields, 2, key)
    start = file.text.at
    following = (file.text.row() or "").split()
    if following and following[0].upper() == "OFFSETS":
        offsets = file.ints(count, following[1], f"offsets of {key}")
        nodes_head = (file.text.row() or "").split()
        if len(nodes_head) < 2 or nodes_head[0].upper() != "CONNECTIVITY":
            raise ValueError(f"CONNECTIVITY must follow the offsets of {key}, got {' '.join(nodes_head)[:40]!r}")
        nodes = file.ints(size, nodes_head[1], f"nodes of {key}")
        if count and offsets[0]:
            raise ValueError(f"offsets of {key} must begin with 0, got {offsets[0]}")
        return nodes, np.diff(offsets_of(offsets[1:], nodes, key))
    file.text.at = start
    values = file.ints(size, "int", key)
    sizes, heads, at = [], [], 0
    plain = values.tolist()
    for _ in range(count):
        if at >= len(plain) or plain[at] < 0:
            break
        sizes.append(plain[at])
        heads.append(at)
        at += 1 + plain[at]
    if len(sizes) != count or at != len(plain):
        raise ValueError(f"{key} declares {count} rows of {size} numbers in all, which these do not fill")
    keep = np.ones(len(values), dtype=bool)
    keep[heads] = False
    return values[keep], np.array(sizes, dtype=np.int64)


def _skip_metadata(file: _Legacy) -> None:
    """Skip metadata, which end with a blank line."""
    while file.text.line():
        pass


def _read_field(file: _Legacy, count: int, target: dict[str, NDArray[Any]]) -> None:
    for _ in range(count):
        row = file.text.row()
        while row is not None and row.upper().startswith("METADATA"):
            _skip_metadata(file)
            row = file.text.row()
        fields = (row or "").split()
        if len(fields) < 4:
            raise ValueError(f"an array of a field must have name, components, tuples and type, got {fields}")
        components, tuples = _whole(fields, 1, fields[0]), _whole(fields, 2, fields[0])
        if fields[3].lower() == "string":
            for _ in range(components * tuples):
                if file.text.line() is None:
                    raise ValueError("it ends among texts")
            continue
        values = file.values(components * tuples, fields[3], f"array {fields[0]}")
        target[fields[0]] = values if components == 1 else values.reshape(tuples, components)


def _read_array(file: _Legacy, key: str, fields: list[str], count: int, target: dict[str, NDArray[Any]]) -> None:
    """Read one array of points or cells."""
    widths = {"VECTORS": 3, "NORMALS": 3, "TENSORS": 9, "TENSORS6": 6, "GLOBAL_IDS": 1, "PEDIGREE_IDS": 1}
    if key == "FIELD":
        _read_field(file, _whole(fields, 2, key), target)
    elif key == "SCALARS":
        width = int(fields[3]) if len(fields) > 3 else 1
        at = file.text.at
        if not (file.text.row() or "").upper().startswith("LOOKUP_TABLE"):
            file.text.at = at
        values = file.values(width * count, fields[2], f"array {fields[1]}")
        target[fields[1]] = values if width == 1 else values.reshape(count, width)
    elif key in widths:
        file.values(widths[key] * count, fields[2], f"array {fields[1]}")
    elif key == "TEXTURE_COORDINATES":
        file.values(int(fields[2]) * count, fields[3], f"array {fields[1]}")
    elif key in ("COLOR_SCALARS", "LOOKUP_TABLE"):
        length = int(fields[2]) * count if key == "COLOR_SCALARS" else 4 * int(fields[2])
        file.values(length, "unsigned_char" if file.binary else "float", key)
    else:
        raise ValueError(f"section {key[:40]!r} is not known")
