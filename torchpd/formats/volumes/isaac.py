"""The .tet of Isaac Gym: a line `v x y z` for each vertex, `t i j k l` for each tet, counted from 0."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..content import MeshContent
from ..numbers import lines_of, parse
from .gather import block

__all__ = ["read"]


def read(path: Path) -> MeshContent:
    """Read vertices and tets; a line of another kind is refused."""
    rows: dict[str, list[str]] = {"v": [], "t": []}
    widths = {"v": 3, "t": 4}
    for line in lines_of(path, "#"):
        key, *rest = line.split()
        if key not in rows or len(rest) != widths[key]:
            raise ValueError(f"a line must be `v x y z` or `t i j k l`, got {line[:40]!r}")
        rows[key].append(" ".join(rest))
    points = parse("\n".join(rows["v"]).encode(), np.float64, "vertices").reshape(-1, 3)
    tets = parse("\n".join(rows["t"]).encode(), np.int64, "tets").reshape(-1, 4)
    return MeshContent(points, [block("tetra", tets)])
