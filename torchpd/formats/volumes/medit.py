"""Medit's .mesh and .meshb: vertices, cells and their references.

Format: https://github.com/LoicMarechal/libMeshb. Other fields are skipped.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ..content import Array, Cells, MeshContent
from ..numbers import Binary, Text, text_of
from .gather import as_3d, block

__all__ = ["read"]

# kind and node count of the cells of a field, by its name in text: order 1, and orders 2 to 4
_NODES = {
    "edges": ("line", "p", (2, 3, 4, 5)),
    "triangles": ("triangle", "p", (3, 6, 10, 15)),
    "quadrilaterals": ("quad", "q", (4, 9, 16, 25)),
    "tetrahedra": ("tetra", "p", (4, 10, 20, 35)),
    "pyramids": ("pyramid", "p", (5, 14, 30, 55)),
    "prisms": ("wedge", "p", (6, 18, 40, 75)),
    "hexahedra": ("hexahedron", "q", (8, 27, 64, 125)),
    "hexaedra": ("hexahedron", "q", (8, 27, 64, 125)),  # spelling of some writers
}
_CELLS = {
    name + (f"{letter}{order}" if order > 1 else ""): (kind, count)
    for name, (kind, letter, counts) in _NODES.items()
    for order, count in enumerate(counts, start=1)
}
# numbers of these fields in binary files
_CODES = {5: "edges", 6: "triangles", 7: "quadrilaterals", 8: "tetrahedra", 9: "prisms", 10: "hexahedra"}
_CODES |= {49: "pyramids", 24: "trianglesp2", 25: "edgesp2", 30: "tetrahedrap2", 33: "hexahedraq2"}
_CODES |= {27: "quadrilateralsq2", 86: "prismsp2", 87: "pyramidsp2"}
_VERTICES, _END, _DIMENSION = 4, 54, 3


def read(path: Path) -> MeshContent:
    """Read text or, from a .meshb, bytes."""
    binary = path.suffix.lower() == ".meshb"
    points, cells, ended = _read_binary(path.read_bytes()) if binary else _read_text(path)
    if points is None:
        raise ValueError("it has no Vertices")
    return MeshContent(as_3d(points), cells, notes=[] if ended else ["no End: was the file cut off?"])


def _read_text(path: Path) -> tuple[Array | None, list[Cells], bool]:
    text = re.sub(r"#[^\n]*", "", text_of(path))
    parts = re.split(r"(?m)(?<![^\s])([A-Za-z][A-Za-z0-9_]*)(?!\S)", re.sub(r"\"[^\"]*\"", " ", text))
    if parts[0].strip():
        raise ValueError(f"it must begin with a keyword, got {parts[0].strip()[:40]!r}")
    if len(parts) < 2 or parts[1].lower() != "meshversionformatted":
        raise ValueError(f"it must begin with MeshVersionFormatted, got {''.join(parts[1:2])[:40]!r}")
    dimension, points, cells = 3, None, list[Cells]()
    for key, body in zip(parts[1::2], parts[2::2], strict=True):
        name, numbers = key.lower(), Text(body.encode())
        if name == "end":
            return points, cells, True
        if name == "dimension":
            dimension = int(numbers.ints(1, key)[0])
            if dimension not in (2, 3):
                raise ValueError(f"Dimension must be 2 or 3, got {dimension}")
        elif name == "vertices":
            points = _rows(numbers, dimension + 1, key)[:, :dimension]
        elif name in _CELLS:
            kind, nodes = _CELLS[name]
            rows = _rows(numbers, nodes + 1, key).astype(np.int64)
            cells.append(block(kind, rows[:, :nodes] - 1, rows[:, nodes]))
    return points, cells, False


def _rows(numbers: Text, width: int, key: str) -> Array:
    """As many rows as the leading count says, and nothing after them."""
    count = int(numbers.ints(1, key)[0])
    rows = numbers.floats(width * count, key).reshape(count, width)
    if more := numbers.left():
        raise ValueError(f"{key} should be {count} rows of {width} numbers, got {more} more")
    return rows


def _read_binary(data: bytes) -> tuple[Array | None, list[Cells], bool]:
    order = {b"\x01\x00\x00\x00": "<", b"\x00\x00\x00\x01": ">"}.get(data[:4])
    if order is None:
        raise ValueError("it must begin with the number 1 in four bytes")
    version = int(Binary(data, 4, order + "i4", order + "f8").ints(1, "versions")[0])
    if version not in (1, 2, 3, 4):
        raise ValueError(f"its version must be 1 to 4, got {version}")
    numbers = Binary(data, 8, order + ("i8" if version > 3 else "i4"), order + ("f4" if version < 2 else "f8"))
    place = order + ("i8" if version > 2 else "i4")
    dimension, points, cells = 0, None, list[Cells]()
    while True:
        code = int(numbers.take(order + "i4", 1, "fields")[0])
        if code == _END:
            return points, cells, True
        following = int(numbers.take(place, 1, "places of fields")[0])
        begin = numbers.at
        if code == _DIMENSION:
            dimension = int(numbers.take(order + "i4", 1, "dimensions")[0])
            if dimension not in (2, 3):
                raise ValueError(f"its dimension must be 2 or 3, got {dimension}")
        elif code == _VERTICES:
            count = int(numbers.ints(1, "vertices")[0])
            row = [("x", numbers.real, (dimension,)), ("r", numbers.integer)]
            points = numbers.take(row, count, "vertices")["x"].astype(np.float64)
        elif code in _CODES:
            kind, nodes = _CELLS[_CODES[code]]
            count = int(numbers.ints(1, kind)[0])
            rows = numbers.ints(count * (nodes + 1), kind).reshape(count, nodes + 1)
            cells.append(block(kind, rows[:, :nodes] - 1, rows[:, nodes]))
        if following == 0:  # last field, after which some files have no end
            return points, cells, True
        if not begin <= following <= len(data):
            raise ValueError(f"a field should end at byte {following}, beyond the {len(data)} bytes of the file")
        numbers.at = following
