"""Formats that meshio reads."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from .content import CELLS, Cells, Index, MeshContent

__all__ = ["NAMES", "read"]

NAMES = {
    ".cgns": "CGNS",
    ".dato": "Permas",
    ".e": "Exodus",
    ".ex2": "Exodus",
    ".exo": "Exodus",
    ".f3grid": "FLAC3D",
    ".h5m": "MOAB",
    ".hmf": "HMF",
    ".mdpa": "Kratos",
    ".med": "MED",
    ".post": "Permas",
    ".su2": "SU2",
    ".ugrid": "UGRID",
    ".vol": "Netgen",
    ".xdmf": "XDMF",
    ".xmf": "XDMF",
    ".xml": "DOLFIN XML",
}


def read(path: Path) -> MeshContent:
    """Read a file with meshio."""
    import meshio

    return content_of(meshio.read(path))


def content_of(mesh: Any) -> MeshContent:
    """Points, cells and regions of a `meshio.Mesh`."""
    points = np.asarray(mesh.points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise ValueError(f"points must have two or three coordinates, got an array {list(points.shape)}")
    if points.shape[1] == 2:
        points = np.column_stack([points, np.zeros(len(points))])
    cells = []
    for number, block in enumerate(mesh.cells):
        if not len(block.data):
            continue
        regions = _regions(mesh.cell_data, number)
        cells.append(_cells(block.type, block.data, regions))
    return MeshContent(points, cells)


def _cells(kind: str, nodes: Any, regions: Index | None) -> Cells:
    name = re.sub(r"\d+$", "", kind)
    if name not in CELLS:
        sizes = np.array([len(row) for row in nodes], dtype=np.int64)
        corners = np.concatenate([np.asarray(row).reshape(-1) for row in nodes]).astype(np.int64)
        return Cells(name, corners, sizes, regions)
    nodes = np.asarray(nodes).astype(np.int64)
    count = CELLS[name][0]
    return Cells(name, nodes[:, :count], None, regions, 1 if nodes.shape[1] == count else 2, nodes[:, count:])


def _regions(data: dict[str, Any], number: int) -> Index | None:
    for name in ("gmsh:physical", "medit:ref"):
        if name in data:
            return np.asarray(data[name][number]).astype(np.int64)
    return None
