"""AVS' unstructured cell data: points, cells and the material of each as its region.

Format: https://lanl.github.io/LaGriT/pages/docs/read_avs.html.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..content import MeshContent
from ..numbers import check_room, check_rows, lines_of, parse
from .gather import Numbering, blocks_of, renumbered

__all__ = ["read"]

# kind, number of corners, and their order in VTK
_KINDS = {
    "pt": ("vertex", [0]),
    "line": ("line", [0, 1]),
    "tri": ("triangle", [0, 1, 2]),
    "quad": ("quad", [0, 1, 2, 3]),
    "tet": ("tetra", [0, 1, 3, 2]),
    "pyr": ("pyramid", [1, 2, 3, 4, 0]),
    "prism": ("wedge", [3, 4, 5, 0, 1, 2]),
    "hex": ("hexahedron", [4, 5, 6, 7, 0, 1, 2, 3]),
}


def read(path: Path) -> MeshContent:
    """Read points and cells; data of points and cells after them are skipped."""
    lines = lines_of(path, "#")
    head = parse(lines[0].encode() if lines else b"", np.int64, "counts")
    if len(head) < 2:
        raise ValueError(f"it must begin with counts of points and of cells, got {head.tolist()}")
    count, total = int(head[0]), int(head[1])
    check_room(count, 1, len(lines) - 1, "points, a line each,")
    check_room(total, 1, len(lines) - 1 - count, "cells, a line each,")
    if not head[2:4].any():  # neither point data nor cell data
        check_rows(lines[1 + count :], total, "cells")
    table = parse("\n".join(lines[1 : 1 + count]).encode(), np.float64, "points")
    if len(table) != 4 * count:
        raise ValueError(f"its {count} points must have number, x, y and z, got {len(table)} numbers")
    rows = table.reshape(count, 4)
    place = Numbering(rows[:, 0].astype(np.int64), "point")
    kinds, nodes, regions = list[str](), list[list[int]](), list[int]()
    for line in lines[1 + count : 1 + count + total]:
        fields = line.split()
        if len(fields) < 4 or fields[2].lower() not in _KINDS:
            raise ValueError(f"a cell must be number, material, type and corners, got {line[:40]!r}")
        kind, order = _KINDS[fields[2].lower()]
        if len(fields) != 3 + len(order):
            raise ValueError(f"a {kind} must have {len(order)} corners, got {line[:40]!r}")
        corners = [int(field) for field in fields[3:]]
        kinds.append(kind)
        nodes.append([corners[k] for k in order])
        regions.append(int(fields[1]))
    cells = renumbered(blocks_of(kinds, nodes, regions if any(regions) else None), place)
    return MeshContent(rows[:, 1:], cells)
