"""Nastran's bulk data: GRID and the solid and flat elements, in free, small and large fields.

Format: NX Nastran Quick Reference Guide. The property number (PID) is the region.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..content import CELLS, MeshContent
from ..numbers import text_of
from .gather import Numbering, blocks_of

__all__ = ["read"]

# kind of an element, and its largest number of nodes; other fields follow those of flat ones
_KINDS = {
    "CTETRA": ("tetra", 10),
    "CPYRAM": ("pyramid", 13),
    "CPYRA": ("pyramid", 13),
    "CPENTA": ("wedge", 15),
    "CHEXA": ("hexahedron", 20),
    "CTRIA3": ("triangle", 3),
    "CTRIA6": ("triangle", 6),
    "CTRIAR": ("triangle", 3),
    "CQUAD4": ("quad", 4),
    "CQUAD8": ("quad", 8),
    "CQUAD": ("quad", 9),
    "CQUADR": ("quad", 4),
    "CSHEAR": ("quad", 4),
}
# structural elements without a volume, which the notes name
_OTHERS = re.compile(
    r"C(BAR|BEAM|BEAM3|BEND|ROD|TUBE|BUSH|BUSH1D|GAP|ELAS\d|DAMP\d|MASS\d|VISC|WELD|FAST|ONROD|ONM\d)$"
)


def read(path: Path) -> MeshContent:
    """Read points and elements; local coordinate systems are refused."""
    numbers, points, kinds, nodes, regions = [], [], list[str](), list[list[int]](), list[int]()
    others: dict[str, int] = {}
    for card, fields in _cards(text_of(path)):
        if card == "INCLUDE":
            raise ValueError("INCLUDE names another file, which is not read; put it in")
        if card == "GRID":
            if fields[1] not in ("", "0"):
                raise ValueError(
                    f"GRID {fields[0]} is in coordinate system {fields[1]}; write basic coordinates (CP 0)"
                )
            numbers.append(_whole(fields[0], card))
            points.append([_real(field) for field in fields[2:5]])
        elif card == "GRDSET" and fields[1] not in ("", "0"):
            raise ValueError(f"GRDSET sets coordinate system {fields[1]}; write basic coordinates (CP 0)")
        elif card in _KINDS:
            kind, most = _KINDS[card]
            row = [_whole(field, card) for field in fields[2 : 2 + most] if field]
            corners = CELLS[kind][0]
            if len(row) < corners or 0 in row[:corners]:
                raise ValueError(f"{card} {fields[0]} must have {corners} corners, got {row}")
            kinds.append(kind)
            nodes.append([node for node in row if node] if len(row) > corners else row)
            regions.append(_whole(fields[1] or "0", card))
        elif _OTHERS.match(card):
            others[card] = others.get(card, 0) + 1
    place = Numbering(np.array(numbers, dtype=np.int64), "GRID")
    blocks = [
        replace(b, corners=place(b.corners), beyond=None if b.beyond is None else place(b.beyond))
        for b in blocks_of(kinds, nodes, regions if any(regions) else None)
    ]
    notes = [f"{count} elements {card} left out" for card, count in sorted(others.items())]
    return MeshContent(np.array(points, dtype=np.float64).reshape(-1, 3), blocks, notes=notes)


def _cards(text: str) -> Iterator[tuple[str, list[str]]]:
    """Cards with their fields, at least nine, including those of continuation lines."""
    lines = [line.split("$")[0].rstrip().expandtabs(8) for line in text.split("\n")]
    begin = [n for n, line in enumerate(lines) if re.match(r"\s*BEGIN\s+(BULK|SUPER)", line.upper())]
    if len(begin) > 1:
        raise ValueError(f"it has {len(begin)} sections BEGIN, parts that are not put together; write it as one")
    name, fields = "", list[str]()
    for line in lines[begin[0] + 1 if begin else 0 :]:
        if not line.strip():
            continue
        first, data = _fields(line)
        if first.startswith(("+", "*")) or not first:
            fields += data
            continue
        if name:
            yield name, fields + [""] * 9
        name, fields = first.rstrip("*").strip().upper(), data
        if name.startswith("ENDDATA"):
            return
    if begin:
        raise ValueError("it has no ENDDATA: the file was cut off")
    if name:
        yield name, fields + [""] * 9


def _fields(line: str) -> tuple[str, list[str]]:
    """First field of a line, and its eight data fields, or four of double width."""
    if "," in line:
        first, *rest = (field.strip() for field in line.split(","))
        count = 4 if first.endswith("*") else 8
        return first, (rest + [""] * count)[:count]
    if line.upper().startswith("INCLUDE"):
        return "INCLUDE", []
    first = line[:8].strip()
    width = 16 if "*" in first else 8
    body = line[8:72].ljust(64)
    return first, [body[k : k + width].strip() for k in range(0, 64, width)]


def _whole(field: str, card: str) -> int:
    if not re.fullmatch(r"[-+]?\d+", field):
        raise ValueError(f"{card} must hold integers, got {field[:40]!r}")
    return int(field)


def _real(field: str) -> float:
    """Parse a real number; an exponent may have no letter, as in 1.5-3, or that of Fortran."""
    match = re.fullmatch(r"([-+]?(?:\d+\.?\d*|\.\d+))(?:[eEdD]?([-+]\d+)|[eEdD](\d+))?", field.strip() or "0")
    if match is None:
        raise ValueError(f"GRID must hold real numbers, got {field[:40]!r}")
    return float(f"{match.group(1)}e{match.group(2) or match.group(3) or 0}")
