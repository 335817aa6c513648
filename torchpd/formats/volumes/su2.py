"""SU2's meshes: points, cells, and the faces of the markers.

Format: https://su2code.github.io/docs_v7/Mesh-File/.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..content import MeshContent
from ..numbers import check_room, lines_of, parse
from .gather import as_3d, blocks_of

__all__ = ["read"]

_KINDS = {
    3: ("line", 2),
    5: ("triangle", 3),
    9: ("quad", 4),
    10: ("tetra", 4),
    12: ("hexahedron", 8),
    13: ("wedge", 6),
    14: ("pyramid", 5),
}


def read(path: Path) -> MeshContent:
    """Read one zone; a file with several is refused."""
    lines = lines_of(path, "%")
    dimension, points, kinds, nodes = 3, None, list[str](), list[list[int]]()
    at, declared, markers = 0, 0, 0
    while at < len(lines):
        key, equals, value = (part.strip() for part in lines[at].partition("="))
        at += 1
        if not equals:
            continue
        if key.upper() in ("NELEM", "NPOIN", "MARKER_ELEMS", "NMARK", "NZONE", "NDIME"):
            count = int(parse(value.split()[0].encode() if value else b"x", np.int64, key)[0])
        if key.upper() == "NZONE" and count > 1:
            raise ValueError(f"it holds {count} zones, which are not put together; write them one by one")
        if key.upper() == "NDIME":
            dimension = count
            if dimension not in (2, 3):
                raise ValueError(f"NDIME must be 2 or 3, got {dimension}")
        elif key.upper() == "NMARK":
            declared = count
        elif key.upper() == "NPOIN":
            rows = _rows(lines, at, count, "points")
            text = "\n".join(" ".join(row.split()[:dimension]) for row in rows).encode()
            points = parse(text, np.float64, "points").reshape(count, dimension)
            at += count
        elif key.upper() in ("NELEM", "MARKER_ELEMS"):
            markers += key.upper() == "MARKER_ELEMS"
            for row in _rows(lines, at, count, "cells"):
                numbers = [int(word) for word in row.split()]
                kind, corners = _KINDS.get(numbers[0], ("", 0))
                if not kind or len(numbers) < 1 + corners:
                    raise ValueError(f"a cell must be a type of VTK and its corners, got {row[:40]!r}")
                kinds.append(kind)
                nodes.append(numbers[1 : 1 + corners])
            at += count
    if markers != declared:
        raise ValueError(f"it declares {declared} markers, got {markers}")
    if points is None:
        raise ValueError("it has no NPOIN")
    return MeshContent(as_3d(points), blocks_of(kinds, nodes))


def _rows(lines: list[str], at: int, count: int, what: str) -> list[str]:
    check_room(count, 1, len(lines) - at, f"{what}, a line each,")
    rows = lines[at : at + count]
    behind = lines[at + count : at + count + 1]
    if behind and "=" not in behind[0]:
        raise ValueError(f"it declares {count} {what}, but {behind[0][:40]!r} follows them")
    wrong = next((row for row in rows if "=" in row), None)
    if wrong is not None:
        raise ValueError(f"it declares {count} {what}, but {wrong[:40]!r} comes among them")
    return rows
