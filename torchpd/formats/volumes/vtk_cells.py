"""Cells of VTK's data model, from legacy and XML files: types, connectivity, and the region array."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..content import CELLS, Array, Cells, Index, MeshContent
from .gather import block, renumbered
from .regions import can_hold_regions, choose_regions

__all__ = ["Piece", "content_of", "offsets_of"]

# Kind of each type, all with corners first: https://vtk.org/doc/nightly/html/vtkCellType_8h_source.html.
_KINDS: dict[int, str] = {
    0: "empty cell",
    1: "vertex",
    **dict.fromkeys((3, 21, 35, 60, 68, 75), "line"),
    **dict.fromkeys((5, 22, 34, 61, 69, 76), "triangle"),
    **dict.fromkeys((8, 9, 23, 28, 30, 62, 70, 77), "quad"),
    **dict.fromkeys((10, 24, 64, 71, 78), "tetra"),
    **dict.fromkeys((11, 12, 25, 29, 33, 67, 72, 79), "hexahedron"),
    **dict.fromkeys((13, 26, 31, 32, 65, 73, 80), "wedge"),
    **dict.fromkeys((14, 27, 37, 66, 74, 81), "pyramid"),
    2: "cloud of vertices",
    4: "polyline",
    6: "triangle strip",
    7: "polygon",
    15: "pentagonal prism",
    16: "hexagonal prism",
    36: "polygon of higher order",
    41: "convex point set",
    42: "polyhedron",
    63: "polygon of higher order",
}
_PIXELS = {8: [0, 1, 3, 2], 11: [0, 1, 3, 2, 4, 5, 7, 6]}  # corners in the order of the axes
_STRIP = 6


@dataclass(eq=False)
class Piece:
    """One piece of a file: points [N, 3], cell types [n], concatenated nodes, and cell arrays."""

    points: Array
    types: Index
    nodes: Index
    starts: Index  # start of the nodes of each cell [n + 1]
    data: dict[str, NDArray[Any]] = field(default_factory=dict)


def offsets_of(ends: Index, nodes: Index, what: str) -> Index:
    """Start of the nodes of each cell [n + 1], from their ends [n]."""
    starts = np.concatenate([np.zeros(1, dtype=np.int64), ends])
    if (np.diff(starts) < 0).any() or starts[-1] != len(nodes):
        raise ValueError(f"offsets of {what} must rise to {len(nodes)}, the count of their nodes, got {starts[-1]}")
    return starts


def content_of(pieces: list[Piece]) -> MeshContent:
    """One mesh of all pieces."""
    notes: list[str] = []
    regions = _regions(pieces, notes)
    cells, first = [], 0
    for piece, marks in zip(pieces, regions, strict=True):
        outside = (piece.nodes < 0) | (piece.nodes >= len(piece.points))
        if outside.any():
            wrong = int(piece.nodes[outside][0])
            raise ValueError(f"cells name point {wrong}, but there are {len(piece.points)} (counted from 0)")
        cells += _blocks(piece, marks, first)
        first += len(piece.points)
    points = np.concatenate([piece.points for piece in pieces]) if pieces else np.empty((0, 3))
    if len(pieces) > 1:
        owners = np.repeat(np.arange(len(pieces)), [len(piece.points) for piece in pieces])
        points, number = _joined(points, owners, notes)
        cells = renumbered(cells, number.__getitem__)
    return MeshContent(points, cells, notes=notes)


def _joined(points: Array, owners: Index, notes: list[str]) -> tuple[Array, Index]:
    """Merge points that several pieces have at the same place; returns the points and the new number of each.

    Parallel writers cut a mesh into pieces, each with the points on the cut. If one piece has two points at a place,
    they are different and stay.
    """
    _, first, place = np.unique(points, axis=0, return_index=True, return_inverse=True)
    place = place.reshape(-1)
    order = np.lexsort((owners, place))
    doubled = (place[order][1:] == place[order][:-1]) & (owners[order][1:] == owners[order][:-1])
    apart = np.zeros(len(first), dtype=bool)
    apart[place[order][1:][doubled]] = True
    chosen = np.where(apart[place], np.arange(len(points)), first[place])
    kept = chosen == np.arange(len(points))
    if not kept.all():
        notes.append(f"{int((~kept).sum())} points that several pieces have at the same place were joined")
    return points[kept], (np.cumsum(kept) - 1)[chosen]


def _blocks(piece: Piece, marks: Index | None, first: int) -> list[Cells]:
    """Blocks of all cells of one type and size."""
    sizes = np.diff(piece.starts)
    form = piece.types * (int(sizes.max(initial=0)) + 1) + sizes  # one number for each pair
    blocks = []
    for number in np.unique(form):
        which = np.flatnonzero(form == number)
        kind, size = int(piece.types[which[0]]), int(sizes[which[0]])
        nodes = piece.nodes[piece.starts[which][:, None] + np.arange(size)] + first
        own = None if marks is None else marks[which]
        name = _KINDS.get(kind, f"cell of VTK type {kind}")
        if kind == _STRIP:
            blocks.append(_unroll(nodes, own))
        elif name in CELLS:
            blocks.append(block(name, nodes[:, _PIXELS[kind]] if kind in _PIXELS else nodes, own))
        else:
            blocks.append(Cells(name, nodes.reshape(-1), np.full(len(which), size), own))
    return blocks


def _unroll(nodes: Index, marks: Index | None) -> Cells:
    """Triangles of strips of one length; every second one has the opposite winding."""
    count = max(nodes.shape[1] - 2, 0)
    rows: Index = np.arange(count)[:, None] + np.arange(3)
    rows[1::2] = rows[1::2, [1, 0, 2]]
    return Cells("triangle", nodes[:, rows].reshape(-1, 3), None, None if marks is None else np.repeat(marks, count))


def _regions(pieces: list[Piece], notes: list[str]) -> list[Index | None]:
    """Region numbers of the cells of each piece, from an array with a usual name, or the only integer array."""
    arrays: dict[str, list[NDArray[Any]]] = {}
    for piece in pieces:
        for name, values in piece.data.items():
            if not name.lower().startswith("vtk") and len(values) == len(piece.types):
                arrays.setdefault(name, []).append(values)
    chosen = choose_regions(
        (name for name, parts in arrays.items() if all(can_hold_regions(name, part) for part in parts)), notes
    )
    if chosen is None:
        return [None for _ in pieces]
    return [
        piece.data[chosen].astype(np.int64)
        if chosen in piece.data and len(piece.data[chosen]) == len(piece.types)
        else np.zeros(len(piece.types), dtype=np.int64)
        for piece in pieces
    ]
