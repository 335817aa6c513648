"""AFLR's .ugrid, as text or, where the name ends in .b8.ugrid and the like, as bytes.

Format: https://www.simcenter.msstate.edu/software/documentation/ug_io/3d_grid_file_type_ugrid.html.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..content import MeshContent
from ..numbers import Binary, Numbers, Text, text_of
from .gather import block

__all__ = ["read"]

# byte order, real type, integer type, and whether Fortran records enclose them
_BINARY = {
    "b8l": (">", "f8", "i8", False),
    "b8": (">", "f8", "i4", False),
    "b4": (">", "f4", "i4", False),
    "lb8l": ("<", "f8", "i8", False),
    "lb8": ("<", "f8", "i4", False),
    "lb4": ("<", "f4", "i4", False),
    "r8": (">", "f8", "i4", True),
    "r4": (">", "f4", "i4", True),
    "lr8": ("<", "f8", "i4", True),
    "lr4": ("<", "f4", "i4", True),
}
_KINDS = {"triangle": 3, "quad": 4, "tetra": 4, "pyramid": 5, "wedge": 6, "hexahedron": 8}


def read(path: Path) -> MeshContent:
    """Read points and cells."""
    form = _BINARY.get(path.suffixes[-2].lower().lstrip(".")) if len(path.suffixes) > 1 else None
    numbers: Numbers
    if form is None:
        numbers, records = Text(text_of(path).encode()), False
    else:
        order, real, integer, records = form
        numbers = Binary(path.read_bytes(), 0, order + integer, order + real)
    if records:
        numbers.ints(1, "records")
    counts = dict(zip(["points", *_KINDS], numbers.ints(7, "counts").tolist(), strict=True))
    if records:
        numbers.ints(2, "records")
    points = numbers.floats(3 * counts["points"], "points").reshape(-1, 3)
    cells = []
    for kind, corners in _KINDS.items():
        rows = numbers.ints(corners * counts[kind], kind).reshape(-1, corners) - 1
        if kind == "quad":
            numbers.ints(counts["triangle"] + counts["quad"], "marks of faces")
        # the third corner is the apex of a pyramid
        cells.append(block(kind, rows[:, [1, 0, 3, 4, 2]] if kind == "pyramid" else rows))
    left = numbers.left() - 4 * records
    notes = [f"{left} {'bytes' if form else 'numbers'} behind its cells left out"] if left > 0 else []
    return MeshContent(np.asarray(points), cells, notes=notes)
