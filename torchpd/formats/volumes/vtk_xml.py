"""VTK's XML files: .vtu and .vtp with all of their pieces, and .pvtu and .pvtp, which refer to files of pieces.

Format: https://docs.vtk.org/en/latest/design_documents/VTKFileFormats.html.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from ..content import Array, Index, MeshContent
from .vtk_arrays import Document
from .vtk_cells import Piece, content_of, offsets_of

__all__ = ["read"]

# sections of polygonal data: attribute of their count, cell type, and cell type by small node count
_POLYS = {
    "Verts": ("NumberOfVerts", 2, {1: 1}),
    "Lines": ("NumberOfLines", 4, {2: 3}),
    "Strips": ("NumberOfStrips", 6, {}),
    "Polys": ("NumberOfPolys", 7, {3: 5, 4: 9}),
}


def read(path: Path) -> MeshContent:
    """Read all pieces of an unstructured grid or of polygonal data."""
    notes: list[str] = []
    content = content_of(_pieces(path, notes))
    content.notes.extend(notes)
    return content


def _pieces(path: Path, notes: list[str], *, nested: bool = False) -> list[Piece]:
    document = Document(path.read_bytes())
    kind = document.root.get("type", "")
    grids = [element for element in document.root if element.tag == kind]
    if not grids:
        raise ValueError(f"it must hold <{kind}>, which its type names")
    pieces = [piece for grid in grids for piece in grid.iter("Piece")]
    if kind in ("PUnstructuredGrid", "PPolyData"):
        if nested:
            raise ValueError(f"a piece names {path.name}, which names pieces itself")
        found: list[Piece] = []
        for piece in pieces:
            source = path.parent / piece.get("Source", "")
            if not source.is_file():
                raise FileNotFoundError(f"its piece {piece.get('Source')!r} is missing beside it")
            found += _pieces(source, notes, nested=True)
        return found
    if kind not in ("UnstructuredGrid", "PolyData"):
        raise ValueError(f"a data set {kind[:40]} is not read; save it as an unstructured grid")
    return [_piece(document, piece, notes, polygons=kind == "PolyData") for piece in pieces]


def _count(element: Element, name: str) -> int:
    text = element.get(name, "0").strip()
    if not text.isdigit():
        raise ValueError(f"{name} must be a count, got {text[:40]!r}")
    return int(text)


def _piece(document: Document, element: Element, notes: list[str], *, polygons: bool) -> Piece:
    points = _points(document, element)
    sections = []
    for tag, (attribute, usual, special) in (_POLYS if polygons else {"Cells": ("NumberOfCells", 0, {})}).items():
        count = _count(element, attribute)
        section = element.find(tag)
        if section is not None and (count or len(section)):
            sections.append(_cells(document, section, count, None if not polygons else (usual, special)))
        elif count:
            raise ValueError(f"a piece declares {count} cells in {attribute}, but has no <{tag}>")
    types, nodes, sizes = (
        np.concatenate([np.empty(0, dtype=np.int64), *(section[k] for section in sections)]) for k in range(3)
    )
    piece = Piece(points, types, nodes, offsets_of(np.cumsum(sizes), nodes, "cells"))
    ghosts = None
    for array in element.iterfind("CellData/DataArray"):
        name = array.get("Name", "")
        try:
            values = document.array(array)
        except ValueError as error:
            notes.append(f"an array of the cells could not be read ({error})")
            continue
        if name in ("vtkGhostType", "vtkGhostLevels") and len(values) == len(types):
            ghosts = values != 0
        piece.data[name] = values
    return piece if ghosts is None or not ghosts.any() else _without(piece, ghosts, notes)


def _points(document: Document, element: Element) -> Array:
    declared = _count(element, "NumberOfPoints")
    array = element.find("Points/DataArray")
    points = np.empty((0, 3)) if array is None else document.array(array).astype(np.float64)
    if not points.size:
        points = points.reshape(0, 3)
    if points.shape != (declared, 3):
        raise ValueError(f"a piece declares {declared} points of 3 coordinates, got {list(points.shape)}")
    return points


def _cells(
    document: Document, section: Element, count: int, kinds: tuple[int, dict[int, int]] | None
) -> tuple[Index, Index, Index]:
    """Types, concatenated nodes, and sizes of the cells of a section."""
    arrays = {array.get("Name", ""): array for array in section.iter("DataArray")}
    needed = ("connectivity", "offsets") if kinds else ("connectivity", "offsets", "types")
    missing = [name for name in needed if name not in arrays]
    if missing:
        raise ValueError(f"<{section.tag}> has no array {missing[0]!r}")
    nodes, ends = (_whole(document.array(arrays[name]), name) for name in ("connectivity", "offsets"))
    if len(ends) != count:
        raise ValueError(f"a piece declares {count} cells in <{section.tag}>, got {len(ends)}")
    sizes = np.diff(offsets_of(ends, nodes, section.tag))
    if kinds is None:
        types = _whole(document.array(arrays["types"]), "types")
        if len(types) != count:
            raise ValueError(f"a piece declares {count} cells, got {len(types)} types")
        return types, nodes, sizes
    types = np.full(count, kinds[0])
    for size, kind in kinds[1].items():
        types[sizes == size] = kind
    return types, nodes, sizes


def _whole(values: NDArray[Any], name: str) -> Index:
    if values.ndim != 1 or values.dtype.kind not in "iu":
        raise ValueError(f"array {name} must hold integers, got {values.dtype} {list(values.shape)}")
    return values.astype(np.int64)


def _without(piece: Piece, ghosts: NDArray[np.bool_], notes: list[str]) -> Piece:
    """Copy of a piece without ghost cells, which another piece has too."""
    notes.append(f"{int(ghosts.sum())} ghost cells, which belong to other pieces, were left out")
    sizes = np.diff(piece.starts)
    data = {name: values[~ghosts] for name, values in piece.data.items() if len(values) == len(ghosts)}
    starts = np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(sizes[~ghosts])])
    return Piece(piece.points, piece.types[~ghosts], piece.nodes[np.repeat(~ghosts, sizes)], starts, data)
