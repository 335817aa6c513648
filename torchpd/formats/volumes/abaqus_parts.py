"""Parts of an Abaqus file: their nodes, elements and sets, and the places of their instances."""

from __future__ import annotations

import re
from copy import deepcopy
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..content import CELLS, Array, Cells, Index, MeshContent
from ..numbers import parse
from ..transforms import rotation
from .gather import SOLIDS, Numbering, block

__all__ = ["Part", "Place", "content_of", "fields_of", "read_elements", "read_nodes", "read_set"]

# Solids by node count, for any physics; flat elements; trusses, which meshers write for edges.
_SOLID = re.compile(r"(?:(?:A|D|DC|EM)?C3D|Q3D)(4|5|6|8|10|13|15|18|20|27)(?!\d)|(?:SC|CSS)(6|8)")
_FLAT = re.compile(r"(?:S|DS|M3D|R3D|SFM3D|STRI|CPS|CPE|CPEG|CAX|CGAX|D?C2D|AC2D|DC2D|DCAX|ACAX)([34689])")
_FLATS = {3: "triangle", 6: "triangle", 4: "quad", 8: "quad", 9: "quad"}
_FIELD = re.compile(r'(?:"[^"]*"|[^,])+')
_TRUSS = re.compile(r"T[23]D([23])")


@dataclass(eq=False)
class Part:
    """Nodes, elements and element sets of a part, in its own numbering."""

    name: str
    numbers: list[Index] = field(default_factory=list)
    points: list[Array] = field(default_factory=list)
    elements: list[tuple[str, Index, Index]] = field(default_factory=list)  # kind, number of each, nodes of each
    # element numbers, ranges of them, and names of other sets
    sets: dict[str, list[Index | range | str]] = field(default_factory=dict)
    written: list[str] = field(default_factory=list)  # sets that *ELEMENT names
    sections: list[str] = field(default_factory=list)  # sets with a material


@dataclass(eq=False)
class Place:
    """An instance of a part: x -> rotation x + offset."""

    name: str
    part: Part  # a copy: an instance may add nodes and elements of its own
    rotation: Array
    offset: Array
    source: str = ""  # name of the part

    @classmethod
    def of(cls, name: str, part: Part, lines: list[str]) -> Place:
        """Parse the data of *INSTANCE: a translation, then two points on an axis and an angle [degrees]."""
        rows = [_reals(line) for line in lines]
        if len(rows) > 2 or (rows and len(rows[0]) > 3) or (len(rows) == 2 and len(rows[1]) != 7):
            raise ValueError(f"*INSTANCE {name} must have a translation and an axis with an angle, got {lines[:3]}")
        turn, offset = np.eye(3), np.zeros(3)
        if rows:
            offset[: len(rows[0])] = rows[0]
        if len(rows) == 2:
            start, end = rows[1][:3], rows[1][3:6]
            if not np.linalg.norm(end - start) > 0:
                raise ValueError(f"the axis of *INSTANCE {name} must have two different points")
            # The axis is in the assembly, so the part is translated before it rotates.
            turn = rotation(end - start, rows[1][6])
            offset = turn @ (offset - start) + start
        return cls(name, deepcopy(part), turn, offset, part.name)


def _reals(line: str) -> Array:
    """Numbers between the commas of a line; a missing one is 0."""
    fields = [entry.strip() or "0" for entry in line.rstrip(", ").split(",")]
    return np.asarray(parse(" ".join(fields).encode(), np.float64, "data"), dtype=np.float64)


def fields_of(line: str) -> list[str]:
    """Fields between the commas of a line outside of quotes."""
    return [field.strip() for field in (_FIELD.findall(line) if '"' in line else line.split(","))]


def _whole(text: str, what: str) -> Index:
    return np.asarray(parse(text.replace(",", " ").encode(), np.int64, what), dtype=np.int64)


def read_nodes(part: Part, lines: list[str]) -> None:
    """Read rows of number, x, y, z; directions after them are skipped."""
    if not lines:
        return
    widths = {line.rstrip(", ").count(",") for line in lines}
    if len(widths) == 1 and not any(",," in line.replace(" ", "") for line in lines):
        values = parse(" ".join(lines).replace(",", " ").encode(), np.float64, "nodes")
        table = values.reshape(len(lines), -1)
    else:
        rows = [_reals(line) for line in lines]
        table = np.zeros((len(rows), 4))
        for row, values in zip(table, rows, strict=True):
            row[: len(values)] = values[:4]
    points = np.zeros((len(table), 3))
    points[:, : table.shape[1] - 1] = table[:, 1:4]
    part.numbers.append(table[:, 0].astype(np.int64))
    part.points.append(points)


def _kind_of(name: str) -> tuple[str, int | None]:
    """Kind of an element type, and its node count if known."""
    for pattern, kinds in ((_SOLID, SOLIDS), (_FLAT, _FLATS)):
        if match := pattern.match(name):
            count = int(next(filter(None, match.groups())))
            return kinds[count], count
    if match := _TRUSS.match(name):
        return "line", int(match.group(1))
    return f"element of type {name}", None


def read_elements(part: Part, lines: list[str], options: dict[str, str]) -> None:
    """Read rows of number and nodes, which may continue in the next line."""
    name = options.get("TYPE", "").upper()
    if not name:
        raise ValueError("*ELEMENT must name a TYPE")
    kind, count = _kind_of(name)
    if count is None:
        joined = " ".join(line + ("" if line.endswith(",") else "\n") for line in lines)
        rows = [_whole(row, f"elements of type {name}") for row in joined.split("\n") if row.strip(", ")]
    else:
        values = _whole(" ".join(lines), f"elements of type {name}")
        if len(values) % (count + 1):
            raise ValueError(f"elements of type {name} must have {count} nodes, got {len(values)} numbers")
        rows = list(values.reshape(-1, count + 1))
    if not rows:
        return
    for length in sorted({len(row) for row in rows}):
        table = np.array([row for row in rows if len(row) == length], dtype=np.int64)
        part.elements.append((kind, table[:, 0], table[:, 1:]))
    if target := options.get("ELSET", "").upper():
        part.sets.setdefault(target, []).append(np.array([row[0] for row in rows], dtype=np.int64))
        if target not in part.written:
            part.written.append(target)


def read_set(part: Part, lines: list[str], options: dict[str, str]) -> None:
    """Read element numbers, names of other sets or, with GENERATE, rows of first, last and step."""
    found = part.sets.setdefault(options.get("ELSET", "").upper(), [])
    for line in lines:
        entries = [entry.strip('"') for entry in fields_of(line) if entry]
        if "GENERATE" in options:
            first, last, step = (*_whole(" ".join(entries), "*ELSET").tolist(), 1, 1)[:3]
            found.append(range(first, last + 1, max(step, 1)))
        else:
            numbers = [entry for entry in entries if entry.lstrip("+").isdigit()]
            found.append(_whole(" ".join(numbers), "*ELSET"))
            found.extend(entry.upper() for entry in entries if not entry.lstrip("+").isdigit())


def _members(part: Part, name: str, above: tuple[str, ...] = ()) -> list[Index]:
    """Element numbers of a set, including those of the sets that it names."""
    everything = np.concatenate([np.empty(0, dtype=np.int64), *(numbers for _, numbers, _ in part.elements)])
    found = [np.empty(0, dtype=np.int64)]
    for entry in part.sets.get(name, []):
        if isinstance(entry, str):
            found += [] if entry in above else _members(part, entry, (*above, name))
        elif isinstance(entry, range):
            inside = (everything >= entry.start) & (everything < entry.stop)
            found.append(everything[inside & ((everything - entry.start) % entry.step == 0)])
        else:
            found.append(entry)
    return found


def content_of(parts: list[Part], places: list[Place], notes: list[str]) -> MeshContent:
    """All parts at the places of their instances; without instances, each part as it is."""
    used = {place.source for place in places}
    lost = [part for part in parts if part.elements and part.name not in used]
    if places:
        notes += [f"part {part.name!r}, of which there is no instance, left out" for part in lost]
    else:
        places = [Place(part.name, part, np.eye(3), np.zeros(3)) for part in lost]
    if not places:
        raise ValueError("it has no *ELEMENT")
    points: list[Array] = []
    cells: list[Cells] = []
    names: list[str] = []
    first = 0
    for place in places:
        part = place.part
        if not part.points:
            raise ValueError(f"part {part.name!r} has elements, but no *NODE")
        own = np.concatenate(part.points)
        numbering = Numbering(np.concatenate(part.numbers))
        several = len(places) > 1
        chosen = part.sections or part.written or list(part.sets)
        label = [f"{place.name}.{name}" if several else name for name in chosen] or ([place.name] if several else [])
        regions = _Regions(part, chosen, len(names), several=several)
        names += label
        for kind, numbers, nodes in part.elements:
            marks = regions.of(numbers)
            if kind in CELLS:
                cells.append(block(kind, numbering(nodes) + first, marks))
            else:
                cells.append(Cells(kind, numbering(nodes).reshape(-1) + first, np.full(len(nodes), nodes.shape[1])))
        more = [name for name in part.sets if name not in chosen and not name.startswith("_")]
        if more:
            notes.append(f"sets that are no regions left out: {', '.join(more[:8])}{' ...' if len(more) > 8 else ''}")
        if regions.several:
            notes.append(f"{regions.several} elements belong to several sets, of which the first is their region")
        points.append(own @ place.rotation.T + place.offset)
        first += len(own)
    if names:
        notes.append(f"regions are numbers of sets: {', '.join(f'{k + 1} is {name}' for k, name in enumerate(names))}")
    return MeshContent(np.concatenate(points), cells, notes=list(dict.fromkeys(notes)))


class _Regions:
    """Region of each element of a part: number of its set among the chosen ones, counted from `first`."""

    def __init__(self, part: Part, chosen: list[str], first: int, *, several: bool) -> None:
        self.none = not chosen and not several
        self.default = first + 1 if not chosen else 0
        self.several = 0
        empty = np.empty(0, dtype=np.int64)
        sets = [np.unique(np.concatenate(_members(part, name))) for name in chosen]
        self.members = np.concatenate([empty, *sets])
        marks = np.concatenate([empty, *(np.full(len(s), first + 1 + k) for k, s in enumerate(sets))])
        self.members, index = np.unique(self.members, return_index=True)
        self.several = len(marks) - len(self.members)
        self.marks: NDArray[np.int64] = marks[index]

    def of(self, numbers: Index) -> Index | None:
        if self.none:
            return None
        marks = np.full(len(numbers), self.default)
        if len(self.members):
            place = np.minimum(np.searchsorted(self.members, numbers), len(self.members) - 1)
            there = self.members[place] == numbers
            marks[there] = self.marks[place[there]]
        return marks
