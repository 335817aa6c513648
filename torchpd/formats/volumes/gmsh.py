"""Gmsh's .msh of the versions 1, 2, 4.0 and 4.1, as text or binary: nodes, elements and physical groups.

Format: https://gmsh.info/doc/texinfo/gmsh.html#MSH-file-format. Other sections are skipped.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from ..content import Array, Cells, Index, MeshContent
from ..numbers import Binary, Numbers, Text, check_room, parse, words
from . import through_meshio
from .gather import Numbering, block
from .gmsh_types import TYPES

__all__ = ["read"]

_ENTITIES = ("points", "curves", "surfaces", "volumes")


class _File:
    """Content of the sections read so far."""

    def __init__(self) -> None:
        self.version, self.size, self.order = 1.0, 8, ""  # byte order of binary files: "<" or ">"
        self.numbers: list[Index] = []
        self.points: list[Array] = []
        self.elements: list[tuple[int, Index, Index, Index]] = []  # type, nodes, physical group, geometric entity
        self.partitions = 0
        self.parts: dict[tuple[int, int], list[int]] = {}  # partitions of an entity by (dimension, tag)
        self.present: set[int] = set()  # partitions of the elements
        self.groups: dict[tuple[int, int], list[int]] = {}  # physical groups of an entity by (dimension, tag)
        self.names: dict[tuple[int, int], str] = {}
        self.notes: list[str] = []


def read(path: Path) -> MeshContent:
    """Read a file of Gmsh, or of Fluent, which uses the same suffix."""
    data = path.read_bytes().removeprefix(b"\xef\xbb\xbf")
    if data.lstrip()[:1] == b"(":
        return through_meshio.read(path)
    file = _File()
    at = 0
    while True:
        start = _skip_blanks(data, at)
        if start >= len(data):
            break
        text = Text(data, start)
        name = text.line() or ""
        if not name.startswith("$"):
            raise ValueError(f"a section must begin with $, got {name[:40]!r}")
        at = _read_section(file, name[1:], data, text.at)
    if not file.points or not file.elements:
        raise ValueError("it must hold sections $Nodes and $Elements (one of them is missing or empty)")
    return _content(file)


def _skip_blanks(data: bytes, at: int) -> int:
    while at < len(data) and data[at] in b" \t\r\n":
        at += 1
    return at


def _read_section(file: _File, name: str, data: bytes, at: int) -> int:
    """Read a section that begins at `at`; returns the start of the next one."""
    readers = {
        "MeshFormat": _read_format,
        "PhysicalNames": _read_names,
        "Entities": _read_entities,
        "PartitionedEntities": _read_entities,
        "NOD": _read_nodes,
        "Nodes": _read_nodes,
        "ELM": _read_elements,
        "Elements": _read_elements,
    }
    if name == "ParametricNodes":
        raise ValueError("$ParametricNodes are not read; save without parametric coordinates")
    closing = b"$END" + name.encode("latin-1") if name in ("NOD", "ELM") else b"$End" + name.encode("latin-1")
    binary = bool(file.order) and name in readers and name not in ("MeshFormat", "PhysicalNames")
    if binary:
        small = "i4" if file.version < 4 else f"u{file.size}"
        numbers: Numbers = Binary(data, at, file.order + "i4", file.order + "f8", file.order + small)
        readers[name](file, numbers, name)
        at = numbers.at  # type: ignore[attr-defined]
    end = data.find(closing, at)
    if end < 0:
        if name in readers:
            raise ValueError(f"section ${name} has no end: the file was cut off")
        return len(data)  # data beside the mesh, unused
    rest = data[at:end]
    if name in readers and not binary:
        text = Text(rest)
        readers[name](file, text, name)
        rest = text.data[text.at :]
    if readers.get(name) in (_read_nodes, _read_elements) and rest.strip():
        raise ValueError(f"section ${name} holds more than it declares")
    return end + len(closing)


def _read_format(file: _File, text: Numbers, name: str) -> None:
    assert isinstance(text, Text)
    fields = (text.row() or "").split()
    if len(fields) < 3:
        raise ValueError(f"$MeshFormat must hold version, type and size, got {' '.join(fields)!r}")
    file.version = float(fields[0])
    if int(file.version) not in (1, 2, 4):
        raise ValueError(f"version {fields[0]} of the format is not read, but 1, 2 and 4; save as another version")
    file.size = int(fields[2])
    if int(fields[1]):
        one = text.data[text.at : text.at + 4]
        if one not in (struct.pack("<i", 1), struct.pack(">i", 1)) or file.size not in (4, 8):
            raise ValueError("its header is that of a binary file, but the number 1 does not follow")
        file.order = "<" if one[0] == 1 else ">"


def _read_names(file: _File, text: Numbers, name: str) -> None:
    assert isinstance(text, Text)
    text.row()
    while (row := text.row()) is not None:
        fields = words(row)
        if len(fields) == 3 and fields[0].isdigit() and fields[1].lstrip("-").isdigit():
            file.names[int(fields[0]), int(fields[1])] = fields[2]


def _read_entities(file: _File, numbers: Numbers, name: str) -> None:
    """Read the physical groups of each entity; entities of a partition refer to a parent."""
    split = name == "PartitionedEntities"
    if split:
        file.partitions, ghosts = map(int, numbers.sizes(2, "partitions"))
        numbers.ints(2 * ghosts, "ghost entities")
    counts = numbers.sizes(4, "entities")
    for dimension, count in enumerate(counts):
        box = 3 if dimension == 0 and file.version > 4.05 else 6
        for _ in range(int(count)):
            tag = int(numbers.ints(1, _ENTITIES[dimension])[0])
            if split:
                numbers.ints(2, "parents")
                held = int(numbers.sizes(1, "partitions")[0])
                file.parts[dimension, tag] = numbers.ints(held, "partitions").tolist()
            numbers.floats(box, "bounding boxes")
            groups = numbers.ints(int(numbers.sizes(1, "physical groups")[0]), "physical groups")
            file.groups[dimension, tag] = [abs(int(group)) for group in groups]
            if dimension:
                numbers.ints(int(numbers.sizes(1, "bounding entities")[0]), "bounding entities")


def _read_nodes(file: _File, numbers: Numbers, name: str) -> None:
    if file.version < 4:
        count = int(_first(numbers, 1, "nodes")[0])
        if isinstance(numbers, Binary):
            rows = numbers.take([("n", numbers.integer), ("x", numbers.real, 3)], count, "nodes")
            found, points = rows["n"].astype(np.int64), rows["x"].astype(np.float64)
        else:
            table = numbers.floats(4 * count, "nodes").reshape(count, 4)
            found, points = table[:, 0].astype(np.int64), table[:, 1:]
        file.numbers.append(found)
        file.points.append(points)
        return
    newer = file.version > 4.05
    head = numbers.sizes(4 if newer else 2, "nodes")
    for _ in range(int(head[0])):
        first = numbers.ints(3, "nodes")
        dimension, parametric = int(first[0 if newer else 1]), int(first[2])
        count = int(numbers.sizes(1, "nodes")[0])
        width = 3 + (dimension if parametric else 0)
        if newer:
            found = numbers.sizes(count, "node numbers")
            points = numbers.floats(width * count, "nodes").reshape(count, width)
        elif isinstance(numbers, Binary):
            rows = numbers.take([("n", numbers.integer), ("x", numbers.real, width)], count, "nodes")
            found, points = rows["n"].astype(np.int64), rows["x"].astype(np.float64).reshape(count, width)
        else:
            table = numbers.floats((width + 1) * count, "nodes").reshape(count, width + 1)
            found, points = table[:, 0].astype(np.int64), table[:, 1:]
        file.numbers.append(found)
        file.points.append(points[:, :3])
    _compare(sum(map(len, file.numbers)), int(head[1]), "nodes")


def _first(numbers: Numbers, count: int, what: str) -> Index:
    """Counts at the head of a section, which are text in binary files of version 2."""
    if isinstance(numbers, Binary):
        text = Text(numbers.data, numbers.at)
        values = parse((text.line() or "").encode("latin-1"), np.int64, what)
        numbers.at = text.at
        if len(values) != count:
            raise ValueError(f"{what} must begin with their number, got {values.tolist()}")
        return values
    return numbers.ints(count, what)


def _compare(came: int, declared: int, what: str) -> None:
    if came != declared:
        raise ValueError(f"it declares {declared} {what}, got {came}")


def _read_elements(file: _File, numbers: Numbers, name: str) -> None:
    if file.version >= 4:
        _read_entity_blocks(file, numbers)
    elif isinstance(numbers, Binary):
        _read_tagged_blocks(file, numbers)
    else:
        _read_rows(file, numbers)


def _nodes_of(kind: int) -> int:
    if kind not in TYPES:
        raise ValueError(f"elements of type {kind} are not read (Gmsh numbers its types); leave them out")
    return TYPES[kind][1]


def _read_entity_blocks(file: _File, numbers: Numbers) -> None:
    newer = file.version > 4.05
    head = numbers.sizes(4 if newer else 2, "elements")
    total, several = 0, 0
    for _ in range(int(head[0])):
        first = numbers.ints(3, "elements")
        dimension, tag = (int(first[0]), int(first[1])) if newer else (int(first[1]), int(first[0]))
        kind, count = int(first[2]), int(numbers.sizes(1, "elements")[0])
        width = 1 + _nodes_of(kind)
        read = numbers.sizes if newer else numbers.ints
        nodes = read(count * width, "elements").reshape(count, width)[:, 1:]
        file.present.update(file.parts.get((dimension, tag), []))
        groups = file.groups.get((dimension, tag), [])
        several += count if len(groups) > 1 else 0
        physical = groups[0] if groups else 0
        file.elements.append((kind, nodes, np.full(count, physical), np.full(count, tag)))
        total += count
    _compare(total, int(head[1]), "elements")
    if several:
        file.notes.append(f"{several} elements belong to several physical groups, of which the first is kept")


def _read_tagged_blocks(file: _File, numbers: Binary) -> None:
    total, found = int(_first(numbers, 1, "elements")[0]), 0
    while found < total:
        kind, count, tags = map(int, numbers.ints(3, "elements"))
        width = 1 + tags + _nodes_of(kind)
        if count < 1 or tags < 0:
            raise ValueError(f"a block of elements must hold some, got {count} with {tags} tags")
        rows = numbers.ints(count * width, "elements").reshape(count, width)
        none = np.zeros(count, dtype=np.int64)
        file.elements.append(
            (kind, rows[:, 1 + tags :], np.abs(rows[:, 1]) if tags else none, rows[:, 2] if tags > 1 else none)
        )
        found += count
    _compare(found, total, "elements")


def _read_rows(file: _File, text: Numbers) -> None:
    """Read elements as text rows of different lengths: number, type, count of tags, tags, nodes (version 2)."""
    assert isinstance(text, Text)
    total = int(text.ints(1, "elements")[0])
    values = parse(text.data[text.at :], np.int64, "elements")
    text.at = len(text.data)
    check_room(total, 4, len(values), "elements of at least four numbers")
    old = file.version < 2  # number, type, physical, elementary, count of nodes, nodes
    plain, at = values.tolist(), 0
    starts, kinds, tags = list[int](), list[int](), list[int]()
    for _ in range(total):
        if at + 3 > len(plain):
            raise ValueError(f"it declares {total} elements, got {len(starts)}")
        kind, count = plain[at + 1], 2 if old else plain[at + 2]
        if count < 0:
            raise ValueError(f"an element must have at least 0 tags, got {count}")
        starts.append(at)
        kinds.append(kind)
        tags.append(count)
        at += (5 if old else 3 + count) + _nodes_of(kind)
    if at != len(plain):
        raise ValueError(f"its {total} elements should have {at} numbers, got {len(plain)}")
    begin = np.array(starts, dtype=np.int64)
    form = np.column_stack([np.array(kinds, dtype=np.int64), np.array(tags, dtype=np.int64)]).reshape(-1, 2)
    for kind, count in np.unique(form, axis=0).tolist():
        rows = begin[(form == [kind, count]).all(axis=1)]
        skip = 5 if old else 3 + count
        none = np.zeros(len(rows), dtype=np.int64)
        physical = np.abs(values[rows + (2 if old else 3)]) if count else none
        entity = values[rows + (3 if old else 4)] if count > 1 else none
        nodes = values[rows[:, None] + skip + np.arange(_nodes_of(kind))]
        file.elements.append((kind, nodes, physical, entity))


def _content(file: _File) -> MeshContent:
    numbers = np.concatenate(file.numbers)
    place = Numbering(numbers)
    merged: dict[int, list[tuple[Index, Index, Index]]] = {}
    for kind, nodes, physical, entity in file.elements:
        if len(nodes):
            merged.setdefault(kind, []).append((nodes, physical, entity))
    solid, cells, repeated = [], [], 0
    for kind, parts in merged.items():
        nodes, physical, entity = (np.concatenate([part[k] for part in parts]) for k in range(3))
        # Version 2 repeats an element for each of its physical groups.
        first = np.sort(np.unique(nodes, axis=0, return_index=True)[1]) if file.version < 4 else np.arange(len(nodes))
        repeated += len(nodes) - len(first)
        cells.append((TYPES[kind][0], place(nodes[first]), physical[first], entity[first]))
        if TYPES[kind][2] == 3:
            solid.append(cells[-1])
    notes = list(file.notes)
    if len(file.present) < file.partitions:
        notes.append(f"only {len(file.present)} of its {file.partitions} partitions are there")
    if repeated:
        notes.append(f"{repeated} repeated elements, for other physical groups, were left out")
    # without physical groups, the volumes of the geometry are the regions if there are several
    grouped = any(physical.any() for _, _, physical, _ in (solid or cells))
    entities = np.unique(np.concatenate([entity for *_, entity in solid] or [np.zeros(1, np.int64)]))
    blocks: list[Cells] = []
    for name, nodes, physical, entity in cells:
        regions = physical if grouped else entity if len(entities) > 1 else None
        blocks.append(block(name, nodes, regions))
    names = [f"{tag} is {name!r}" for (dimension, tag), name in sorted(file.names.items()) if dimension == 3]
    if names and solid:
        notes.append(f"regions keep their numbers, not their names: {', '.join(names)}")
    return MeshContent(np.concatenate(file.points), blocks, notes=notes)
