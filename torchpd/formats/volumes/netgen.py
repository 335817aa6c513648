"""Netgen's .vol: points, volume and surface elements, and the material of each as its region.

Format: https://github.com/NGSolve/netgen, libsrc/meshing/meshclass.cpp.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..content import MeshContent
from ..numbers import check_rows, lines_of, parse
from .gather import as_3d, blocks_of

__all__ = ["read"]

# kind of an element by its node count, and its corners in the order of VTK
_SOLIDS = {
    4: ("tetra", [0, 2, 1, 3]),
    5: ("pyramid", [0, 3, 2, 1, 4]),
    6: ("wedge", [0, 2, 1, 3, 5, 4]),
    8: ("hexahedron", [0, 3, 2, 1, 4, 7, 6, 5]),
}
_SOLIDS |= {10: _SOLIDS[4], 13: _SOLIDS[5], 15: _SOLIDS[6], 20: _SOLIDS[8]}
_FLATS = {3: ("triangle", [0, 1, 2]), 4: ("quad", [0, 1, 2, 3])}
_FLATS |= {6: _FLATS[3], 8: _FLATS[4]}


def read(path: Path) -> MeshContent:
    """Read a mesh of Netgen."""
    lines = lines_of(path, "#")
    if not lines or lines[0] != "mesh3d":
        raise ValueError(f"it must begin with mesh3d, got {lines[0][:40] if lines else 'nothing'!r}")
    sections: dict[str, list[str]] = {}
    rows: list[str] = []
    for line in lines:
        if line[0].isalpha():
            rows = sections.setdefault(line.split()[0], [])
        else:
            rows.append(line)
    if "points" not in sections:
        raise ValueError("it has no section points")
    if "endmesh" not in sections:
        raise ValueError("it has no endmesh: the file was cut off")
    text = "\n".join(_declared(sections["points"], "points")).encode()
    points = parse(text, np.float64, "points").reshape(-1, 3)
    kinds, nodes, regions = list[str](), list[list[int]](), list[int]()
    for name, rows in sections.items():
        solid = name == "volumeelements"
        if not solid and not name.startswith("surfaceelements"):
            continue
        table, region, size = (_SOLIDS, 0, 1) if solid else (_FLATS, 1, 4)
        for row in _declared(rows, name):
            numbers = [int(word) for word in row.split()[: size + 21]]
            count = numbers[size] if len(numbers) > size else 0
            if count not in table or len(numbers) < size + 1 + count:
                raise ValueError(f"a row of {name} must name its nodes, got {row[:40]!r}")
            kind, order = table[count]
            own = [number - 1 for number in numbers[size + 1 : size + 1 + count]]
            kinds.append(kind)
            nodes.append([own[k] for k in order] + own[len(order) :])
            regions.append(numbers[region])
    names = [" is ".join(row.split(None, 1)) for row in sections.get("materials", [])[1:]]
    notes = [f"regions keep their numbers, not their names: {', '.join(names)}"] if names else []
    return MeshContent(as_3d(points), blocks_of(kinds, nodes, regions), notes=notes)


def _declared(rows: list[str], what: str) -> list[str]:
    """Rows after their count."""
    count = int(parse(rows[0].encode() if rows else b"x", np.int64, f"the count of {what}")[0])
    check_rows(rows[1:], count, what)
    return rows[1:]
