"""Permas' .dato and .post: nodes, elements, and the set of an element block as its region."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ..content import MeshContent
from ..numbers import lines_of, parse
from .gather import Numbering, blocks_of, renumbered

__all__ = ["read"]

# kind and node count of each type, and its corners: edge nodes stand between them
_SOLIDS = {
    "TET4": ("tetra", 4, [0, 1, 2, 3]),
    "TET10": ("tetra", 10, [0, 2, 4, 9]),
    "PYRA5": ("pyramid", 5, [0, 1, 2, 3, 4]),
    "PENTA6": ("wedge", 6, [0, 1, 2, 3, 4, 5]),
    "PENTA15": ("wedge", 15, [0, 2, 4, 9, 11, 13]),
    "HEXE8": ("hexahedron", 8, [0, 1, 2, 3, 4, 5, 6, 7]),
    "HEXFO8": ("hexahedron", 8, [0, 1, 2, 3, 4, 5, 6, 7]),
}
_FLATS = {
    3: ("triangle", 3, [0, 1, 2]),
    6: ("triangle", 6, [0, 2, 4]),
    4: ("quad", 4, [0, 1, 2, 3]),
    9: ("quad", 9, [0, 2, 8, 6]),
}
_FLAT = re.compile(r"(?:TRIA|TRIMS|SHELL|PLOTA|LOADA|QUAD|QUAMS)([3469])")


def read(path: Path) -> MeshContent:
    """Read one component; types with an unknown node order are refused."""
    sections: list[tuple[list[str], list[str]]] = []
    for line in lines_of(path, "!"):
        if line.startswith("$"):
            sections.append((line[1:].upper().split(), []))
        elif sections:
            sections[-1][1].append(line)
        else:
            raise ValueError(f"it must begin with $, got {line[:40]!r}")
    components = sum(head[:2] == ["ENTER", "COMPONENT"] for head, _ in sections)
    if components > 1:
        raise ValueError(f"it holds {components} components, which are not put together; write them one by one")
    if components and not any(head[:2] == ["EXIT", "COMPONENT"] for head, _ in sections):
        raise ValueError("it has no $EXIT COMPONENT: the file was cut off")
    tables = [_table(rows, 4, "nodes") for head, rows in sections if head[:1] == ["COOR"]]
    table = np.concatenate([np.empty((0, 4)), *tables])
    place = Numbering(table[:, 0].astype(np.int64))
    kinds, nodes, marks, names = list[str](), list[list[int]](), list[int](), list[str]()
    for head, rows in sections:
        if head[:1] != ["ELEMENT"]:
            continue
        options = dict(re.findall(r"(\w+)\s*=\s*(\S+)", " ".join(head)))
        name = options.get("TYPE", "")
        match = _FLAT.match(name)
        kind, count, corners = _SOLIDS.get(name) or (_FLATS[int(match.group(1))] if match else ("", 0, []))
        if not kind:
            raise ValueError(f"elements of type {name[:40]!r} are not read; leave them out")
        if (target := options.get("ESET", "")) and target not in names:
            names.append(target)
        others = [k for k in range(count) if k not in corners]
        for row in _table(rows, count + 1, f"elements {name}")[:, 1:].astype(np.int64).tolist():
            kinds.append(kind)
            nodes.append([row[k] for k in corners + others])
            marks.append(names.index(target) + 1 if target else 0)
    cells = renumbered(blocks_of(kinds, nodes, marks if names else None), place)
    notes = [f"regions are numbers of sets: {', '.join(f'{k} is {name}' for k, name in enumerate(names, 1))}"]
    return MeshContent(table[:, 1:], cells, notes=notes if names else [])


def _table(rows: list[str], width: int, what: str) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Rows of `width` numbers, which & joins across lines."""
    values = parse(" ".join(rows).replace("&", " ").encode(), np.float64, what)
    if len(values) % width:
        raise ValueError(f"{what} must have {width} numbers each, got {len(values)}")
    return np.asarray(values.reshape(-1, width))
