"""Tecplot's text files: points and cells of all finite-element zones.

Format: Tecplot 360 Data Format Guide. Points of different zones stay apart.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..content import Array, Cells, Index, MeshContent
from ..numbers import Text, check_room, text_of
from .gather import block

__all__ = ["read"]

_KINDS = {
    "LINESEG": ("line", 2),
    "TRIANGLE": ("triangle", 3),
    "QUADRILATERAL": ("quad", 4),
    "TETRAHEDRON": ("tetra", 4),
    "BRICK": ("hexahedron", 8),
}
_WORD = re.compile(r"\s*(\"[^\"]*\"|'[^']*'|\([^()]*(?:\([^()]*\)[^()]*)*\)|[^\s,=()\"']+|[=,])")
_REGIONS = ("gmsh:physical", "medit:ref", "region", "regions", "material")


@dataclass(eq=False)
class _Zone:
    """Declarations in the head of a zone."""

    kind: str
    corners: int
    nodes: int
    cells: int
    packed: bool  # one variable after another
    centred: set[int]  # cell variables


def read(path: Path) -> MeshContent:
    """Read all zones; ordered zones, and zones that share data with others, are refused."""
    text = text_of(path)
    text = re.sub(r"(?m)^\s*#[^\n]*", "", text)
    # a head line begins with a letter or a quote, a data line with a digit, a sign or a point
    parts = re.split(r"(?im)^\s*(?=zone\b)", text)
    names = _variables(parts[0])
    lowered = [name.lower() for name in names]
    axes = [lowered.index(axis) for axis in ("x", "y", "z") if axis in lowered]
    if len(parts) < 2 or axes[:2] != [lowered.index(axis) for axis in ("x", "y") if axis in lowered] or len(axes) < 2:
        raise ValueError(f"it must name VARIABLES with x and y, and hold a ZONE, got variables {names}")
    marked = next((lowered.index(name) for name in _REGIONS if name in lowered), None)
    points: list[Array] = []
    cells: list[Cells] = []
    first = 0
    for part in parts[1:]:
        place, zone_cells = _read_zone(part, len(names), axes, marked)
        points.append(place)
        cells.append(block(zone_cells.kind, zone_cells.corners + first, zone_cells.regions))
        first += len(place)
    return MeshContent(np.concatenate(points), cells)


def _variables(head: str) -> list[str]:
    match = re.search(r"(?is)variables\s*=(.*)", head)
    if match is None:
        return []
    words = [word.strip("\"'") for word in _WORD.findall(match.group(1)) if word != ","]
    stop = next((n for n, word in enumerate(words) if word == "="), len(words) + 1)
    return words[: max(stop - 1, 0)]


def _read_zone(part: str, count: int, axes: list[int], marked: int | None) -> tuple[Array, Cells]:
    """Read points and cells of a zone."""
    lines = part.split("\n")
    end = next((n for n, line in enumerate(lines) if n and re.match(r"\s*[-+.\d]", line)), len(lines))
    zone = _head(" ".join(lines[:end]), count)
    numbers = Text("\n".join(lines[end:]).encode())
    _expand(numbers)
    room = len(numbers.data)
    check_room(zone.nodes, 2, room + 1, "points")
    check_room(zone.cells, 2, room + 1, "cells")
    columns: dict[int, Array] = {}
    if zone.packed:
        for number in range(count):
            length = zone.cells if number in zone.centred else zone.nodes
            columns[number] = numbers.floats(length, f"variable {number + 1}")
    else:
        if zone.centred:
            raise ValueError("variables of cells need DATAPACKING=BLOCK")
        table = numbers.floats(zone.nodes * count, "points").reshape(zone.nodes, count)
        columns = dict(enumerate(table.T))
    corners: Index = numbers.ints(zone.cells * zone.corners, "cells").reshape(zone.cells, zone.corners) - 1
    if more := numbers.left():
        raise ValueError(f"a zone of {zone.cells} cells has {more} numbers more")
    if corners.size and (corners.min() < 0 or corners.max() >= zone.nodes):
        raise ValueError(f"cells of a zone name point {int(corners.max()) + 1}, but it has {zone.nodes}")
    points = np.zeros((zone.nodes, 3))
    for axis, number in enumerate(axes):
        points[:, axis] = columns[number]
    regions = None
    if marked is not None and marked in zone.centred:
        regions = np.rint(columns[marked]).astype(np.int64)
    return points, Cells(zone.kind, corners, None, regions)


def _expand(numbers: Text) -> None:
    """Expand repeated numbers, as in 3*1.5."""
    if b"*" in numbers.data:
        limit = 64 * len(numbers.data) + 1024
        size = sum(int(n) for n in re.findall(rb"(\d+)\*", numbers.data))
        if size > limit:
            raise ValueError(f"it repeats {size} numbers, more than {limit}; write them out")
        repeat = re.compile(rb"(\d+)\*(\S+)")
        numbers.data = repeat.sub(lambda m: b" ".join([m.group(2)] * int(m.group(1))), numbers.data)


def _head(text: str, count: int) -> _Zone:
    """Parse the text after the word ZONE."""
    words = [word for word in _WORD.findall(text)[1:] if word != ","]
    pairs = {words[n - 1].upper(): words[n + 1].strip("\"'") for n in range(1, len(words) - 1) if words[n] == "="}
    for key in ("VARSHARELIST", "CONNECTIVITYSHAREZONE", "D", "PASSIVEVARLIST", "PARENTZONE"):
        if key in pairs:
            raise ValueError(f"a zone with {key} takes numbers from another zone, which is not read; write them out")
    kind = (pairs.get("ZONETYPE") or pairs.get("ET") or "ORDERED").upper().removeprefix("FE")
    if kind not in _KINDS:
        raise ValueError(f"zones of type {kind[:40]} are not read; write tetrahedra, bricks, triangles or quads")
    sizes = [pairs.get("NODES", pairs.get("N", "")), pairs.get("ELEMENTS", pairs.get("E", ""))]
    if not all(size.isdigit() for size in sizes):
        raise ValueError(f"a zone must declare its nodes and elements, got {sizes}")
    packing = (pairs.get("DATAPACKING") or pairs.get("F", "POINT")).upper().removeprefix("FE")
    centred: set[int] = set()
    for places, where in re.findall(r"\[([-\d,\s]+)\]\s*=\s*(\w+)", pairs.get("VARLOCATION", "")):
        for span in places.split(",") if where.upper() == "CELLCENTERED" else ():
            low, _, high = span.strip().partition("-")
            centred |= set(range(int(low) - 1, min(int(high or low), count)))
    return _Zone(*_KINDS[kind], int(sizes[0]), int(sizes[1]), packing == "BLOCK", centred)
