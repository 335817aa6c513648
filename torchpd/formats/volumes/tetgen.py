"""TetGen's .node and .ele, read together: points, tets and the first attribute of each as its region.

Format: https://wias-berlin.de/software/tetgen/fformats.html. Triangles come from a .face beside them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..content import Array, Cells, Index, MeshContent
from ..numbers import Text, check_rows, lines_of
from .gather import Numbering, block

__all__ = ["read"]


def read(path: Path) -> MeshContent:
    """Read a .node or .ele, and the file beside it that belongs to it."""
    beside = {ending: path.with_suffix(ending) for ending in (".node", ".ele", ".face")}
    beside[path.suffix.lower()] = path
    for ending in (".node", ".ele"):
        if not beside[ending].is_file():
            raise FileNotFoundError(f"the file {beside[ending].name} must lie beside it")
    head, table = _table(beside[".node"], "points")
    if len(head) < 2 or head[1] != 3:
        raise ValueError(f"points of {beside['.node'].name} must have 3 coordinates, got a head of {head}")
    if table.shape[1] < 4:
        raise ValueError(f"a point must have number and 3 coordinates, got {table.shape[1]} columns")
    place = Numbering(table[:, 0].astype(np.int64), "point")
    notes: list[str] = []
    head, rows = _table(beside[".ele"], "tets")
    corners = head[1] if len(head) > 1 else 4
    if corners not in (4, 10) or rows.shape[1] < 1 + corners:
        raise ValueError(f"tets of {beside['.ele'].name} must have 4 or 10 nodes, got a head of {head}")
    regions = _whole(rows[:, 1 + corners], notes) if rows.shape[1] > 1 + corners else None
    cells: list[Cells] = [block("tetra", place(_whole(rows[:, 1 : 1 + corners], [])), regions)]
    if beside[".face"].is_file() and beside[".face"].stat().st_size:
        try:
            _, faces = _table(beside[".face"], "faces")
            cells.append(block("triangle", place(_whole(faces[:, 1:4], []))))
        except ValueError as error:
            notes.append(f"{beside['.face'].name} could not be read ({error})")
    return MeshContent(table[:, 1:4], cells, notes=notes)


def _table(path: Path, what: str) -> tuple[list[int], Array]:
    """Numbers of the first line, and the following rows, whose count is the first of these numbers."""
    lines = lines_of(path, "#")
    head = lines[0].split() if lines else []
    if not head or not all(word.isdigit() for word in head):
        raise ValueError(f"{path.name} must begin with the number of {what}, got {' '.join(head)[:40] or 'nothing'!r}")
    count = int(head[0])
    check_rows(lines[1:], count, what)
    text = "\n".join(lines[1:]).encode()
    width = len(lines[1].split()) if count else 0
    values = Text(text).floats(count * width, what)
    uneven = any(len(line.split()) != width for line in lines[1:])
    if uneven:
        raise ValueError(f"rows of {path.name} must all have {width} numbers")
    return [int(word) for word in head], values.reshape(count, width) if count else np.empty((0, 5))


def _whole(values: Array, notes: list[str]) -> Index:
    """Convert numbers to integers, with a note if they are not whole."""
    numbers = np.rint(values)
    if (numbers != values).any():
        notes.append("attributes of tets are no whole numbers, and were rounded to those of regions")
    return numbers.astype(np.int64)
