"""Kratos' .mdpa: nodes, elements, conditions and geometries; the property number is the region.

Format: https://github.com/KratosMultiphysics/Kratos/wiki/Input-data.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ..content import MeshContent
from ..numbers import lines_of, parse
from .gather import SOLIDS, Numbering, blocks_of, renumbered

__all__ = ["read"]

_SHAPES = {
    "tetrahedra": "tetra",
    "hexahedra": "hexahedron",
    "prism": "wedge",
    "pyramid": "pyramid",
    "triangle": "triangle",
    "quadrilateral": "quad",
    "line": "line",
    "point": "vertex",
}
# shape by dimension and node count, for names without a shape
_FLATS = {1: "vertex", 2: "line", 3: "triangle", 6: "triangle", 4: "quad", 8: "quad", 9: "quad"}


def read(path: Path) -> MeshContent:
    """Read all blocks of nodes and cells."""
    rows, kinds, nodes, regions = list[str](), list[str](), list[list[int]](), list[int]()
    stack: list[list[str]] = []
    for line in lines_of(path, "//"):
        fields = line.split()
        if fields[0] == "Begin":
            stack.append(fields[1:] or [""])
        elif fields[0] == "End":
            if not stack or stack.pop()[0] != " ".join(fields[1:2]):
                raise ValueError(f"{line[:40]!r} must end the block that is open")
        elif stack and stack[-1][0] == "Nodes":
            if len(fields) != 4:
                raise ValueError(f"a node must be number, x, y and z, got {line[:40]!r}")
            rows.append(line)
        elif stack and stack[-1][0] in ("Elements", "Conditions", "Geometries"):
            bare = stack[-1][0] == "Geometries"  # without properties
            row = [int(field) for field in fields]
            own = row[1 if bare else 2 :]
            kinds.append(_kind(stack[-1], len(own)))
            nodes.append(own)
            regions.append(0 if bare or len(row) < 2 else row[1])
    if stack:
        raise ValueError(f"block {stack[-1][0]} has no end: the file was cut off")
    table = parse("\n".join(rows).encode(), np.float64, "nodes").reshape(-1, 4)
    place = Numbering(table[:, 0].astype(np.int64))
    cells = renumbered(blocks_of(kinds, nodes, regions if any(regions) else None), place)
    return MeshContent(table[:, 1:], cells)


def _kind(head: list[str], count: int) -> str:
    name = head[1] if len(head) > 1 else ""
    shape = re.search("|".join(_SHAPES), name.lower())
    if shape is not None and re.search(rf"\dD{count}N?$", name):
        return _SHAPES[shape.group()]
    flat = head[0] == "Conditions" or "2D" in name or re.search("shell|membrane|surface|face", name.lower()) is not None
    kind = (_FLATS if flat else {2: "line", 3: "triangle", **SOLIDS}).get(count)
    return kind or f"element {name} of {count} nodes"
