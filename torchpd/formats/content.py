"""Content of a mesh file: the value that every reader returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

__all__ = ["CELLS", "Cells", "MeshContent", "Reader"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Corners and dimension of each kind of cell, by meshio's names. Corners come first in cells of higher order, so that
# kinds of higher order (tetra10, hexahedron20, triangle6, ...) are named with their linear kind.
CELLS = {
    "vertex": (1, 0),
    "line": (2, 1),
    "triangle": (3, 2),
    "quad": (4, 2),
    "tetra": (4, 3),
    "pyramid": (5, 3),
    "wedge": (6, 3),
    "hexahedron": (8, 3),
}


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of one kind, in the order of the file.

    Args:
        kind: a name of `CELLS`, "polygon", or "polyhedron" or another name of a cell that is not read further.
        corners: vertex numbers [n, corners] in the order of VTK (polygons: all corners, one polygon after another).
        sizes: number of corners of each polygon [n]; None for other kinds.
        regions: region number of each cell [n], or None.
        order: polynomial order in the file.
        beyond: nodes beyond the corners of cells of higher order [n, k], unused by torchpd, or None.
    """

    kind: str
    corners: Index
    sizes: Index | None = None
    regions: Index | None = None
    order: int = 1
    beyond: Index | None = None

    def __len__(self) -> int:
        return len(self.corners) if self.sizes is None else len(self.sizes)


@dataclass(frozen=True, eq=False)
class MeshContent:
    """Points and cells of a file, and notes about its omitted parts.

    Args:
        points: [N, 3] in the unit of the file, or in metres.
        cells: blocks of cells, in the order of the file.
        uvs: texture coordinates of the points [N, 2], or None.
        notes: omissions, repairs and assumptions, a sentence each; the caller puts them into one `MeshWarning`.
        in_metres: whether the file declares its unit, and the reader converted it to metres.
    """

    points: Array
    cells: list[Cells]
    uvs: Array | None = None
    notes: list[str] = field(default_factory=list)
    in_metres: bool = False

    def in_cells(self) -> NDArray[np.bool_]:
        """Mask of the points that a cell uses [N], as a corner or beyond."""
        used = np.zeros(len(self.points), dtype=bool)
        for block in self.cells:
            used[block.corners] = True
            if block.beyond is not None:
                used[block.beyond] = True
        return used


Reader = Callable[[Path], MeshContent]
