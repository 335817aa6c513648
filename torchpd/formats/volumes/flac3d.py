"""FLAC3D's .f3grid: grid points, zones, faces, and the groups of zones as regions."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ..content import MeshContent
from ..numbers import parse, text_of, words
from . import through_meshio
from .gather import Numbering, blocks_of, renumbered

__all__ = ["read"]

# kind, and the corners in the order of VTK; B7 is a brick with one corner twice
_KINDS = {
    "T4": ("tetra", [0, 1, 2, 3]),
    "P5": ("pyramid", [0, 1, 4, 2, 3]),
    "W6": ("wedge", [0, 1, 3, 2, 4, 5]),
    "B7": ("hexahedron", [0, 1, 4, 2, 3, 6, 6, 5]),
    "B8": ("hexahedron", [0, 1, 4, 2, 3, 6, 7, 5]),
    "T3": ("triangle", [0, 1, 2]),
    "Q4": ("quad", [0, 1, 2, 3]),
}


def read(path: Path) -> MeshContent:
    """Read text or, for a binary file, the result of meshio."""
    if b"\0" in path.read_bytes()[:8]:
        return through_meshio.read(path)
    numbers, points, kinds, nodes, zones = list[int](), list[str](), list[str](), list[list[int]](), list[int]()
    groups: dict[str, list[int]] = {}
    members: list[int] | None = None
    for line in text_of(path).split("\n"):
        fields = line.split()
        key = fields[0].upper() if fields else "*"
        if key.startswith("*"):
            continue
        if key == "G":
            numbers.append(int(fields[1]))
            points.append(" ".join(fields[2:5]))
        elif key in ("Z", "F"):
            kind, order = _KINDS.get(fields[1].upper(), ("", []))
            if len(fields) != 4 + max(order, default=0):
                raise ValueError(f"a zone or face must be type, number and corners, got {line[:40]!r}")
            kinds.append(kind)
            nodes.append([int(fields[3 + k]) for k in order])
            zones.append(int(fields[2]) if key == "Z" else -1)
        elif key in ("ZGROUP", "FGROUP"):
            members = groups.setdefault(words(line)[1], []) if key == "ZGROUP" else []
        elif members is not None and re.fullmatch(r"\d+", key):
            members.extend(int(field) for field in fields)
        else:
            raise ValueError(f"a line must begin with G, Z, F, ZGROUP or FGROUP, got {line[:40]!r}")
    region = {zone: k for k, name in reversed(list(enumerate(groups, 1))) for zone in groups[name]}
    place = Numbering(np.array(numbers, dtype=np.int64), "grid point")
    marks = [region.get(zone, 0) for zone in zones] if region else None
    cells = renumbered(blocks_of(kinds, nodes, marks), place)
    notes = [f"regions are numbers of groups: {', '.join(f'{k} is {name}' for k, name in enumerate(groups, 1))}"]
    table = parse("\n".join(points).encode(), np.float64, "grid points").reshape(-1, 3)
    return MeshContent(table, cells, notes=notes if groups else [])
