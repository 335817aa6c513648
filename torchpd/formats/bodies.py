"""Bodies and surfaces of mesh files: tets with an embedded surface, or a surface alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..common.units import Unit
from . import split
from .content import CELLS, Array, Index, MeshContent
from .guard import PathLike, read

__all__ = ["Body", "Surface", "holds_body", "read_body", "read_surface"]


@dataclass(frozen=True, eq=False)
class Body:
    """Tets of a file, and triangles beside them.

    Args:
        points: [N, 3], without the edge nodes of cells of higher order.
        tets: point numbers [E, 4].
        regions: a number for each tet [E], or None.
        triangles: point numbers [T, 3] of triangles whose corners belong to tets.
        notes: differences from the file, a sentence each.
    """

    points: Array
    tets: Index
    regions: Index | None
    triangles: Index
    notes: list[str]


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles of a file [T, 3], their points [N, 3], texture coordinates [N, 2] or None, and notes."""

    points: Array
    triangles: Index
    uvs: Array | None
    notes: list[str]


def holds_body(owner: str, path: PathLike) -> bool:
    """Whether a file has cells with a volume."""
    return any(len(block) and CELLS.get(block.kind, (0, 0))[1] == 3 for block in read(owner, path).cells)


def read_body(owner: str, path: PathLike, unit: Unit | None = None) -> Body:
    """Read a body of tets; a `ValueError` if the file holds none. `unit`: see `torchpd.common.units`."""
    content = read(owner, path, unit)
    solid = split.tets_of(content)
    name = Path(path).name
    if not len(solid.elements):
        raise ValueError(_without_tets(owner, name, content))
    flat = split.triangles_of(content)
    used = np.zeros(len(solid.points), dtype=bool)
    used[solid.elements] = True
    within: NDArray[np.bool_] = np.asarray(used[flat.elements].all(axis=1))
    notes = [*content.notes, *solid.notes, *flat.notes]
    if not within.all():
        outside = int((~within).sum())
        notes.append(f"{outside} of {len(within)} triangles have corners that belong to no tet, and were left out")
    # The notes cover points of cells of other kinds; the mesh reports the others, which no cell uses.
    kept = _kept(content, used, notes)
    number = np.cumsum(kept) - 1
    return Body(
        solid.points[kept], number[solid.elements], solid.regions, number[flat.elements[within]].reshape(-1, 3), notes
    )


def read_surface(owner: str, path: PathLike, unit: Unit | None = None) -> Surface:
    """Read a surface; a `ValueError` if the file holds no face. `unit`: see `torchpd.common.units`."""
    content = read(owner, path, unit)
    flat = split.triangles_of(content)
    if not len(flat.elements):
        raise ValueError(f"{owner}: {Path(path).name} holds no triangles, but {_kinds(content)}{_noted(content)}")
    used = np.zeros(len(content.points), dtype=bool)
    used[flat.elements] = True
    # The vertices inside of a volume are no part of its surface: their omission is nothing to report.
    notes = [*content.notes, *flat.notes]
    kept = _kept(content, used, notes)
    number = np.cumsum(kept) - 1
    uvs = None if content.uvs is None else content.uvs[kept]
    if uvs is not None and not np.isfinite(uvs).all():
        notes.append(f"texture coordinates left out: {int((~np.isfinite(uvs)).any(axis=1).sum())} are not finite")
        uvs = None
    return Surface(content.points[kept], number[flat.elements], uvs, notes)


def _kept(content: MeshContent, used: NDArray[np.bool_], notes: list[str]) -> NDArray[np.bool_]:
    """Mask of the points to keep: those in use, and finite ones that no cell of the file uses."""
    strays = np.zeros(len(used), dtype=bool)
    strays[: len(content.points)] = ~content.in_cells()
    finite: NDArray[np.bool_] = np.asarray(np.isfinite(content.points).all(axis=1))
    lost = int((~finite).sum())
    if lost:
        notes.append(f"{lost} vertices that no cell uses are not finite and were left out")
        strays[: len(finite)] &= finite
    return used | strays


def _kinds(content: MeshContent) -> str:
    counts: dict[str, int] = {}
    for block in content.cells:
        counts[block.kind] = counts.get(block.kind, 0) + len(block)
    return ", ".join(f"{count} of kind {kind}" for kind, count in sorted(counts.items())) or "no cells"


def _without_tets(owner: str, name: str, content: MeshContent) -> str:
    flat = sum(len(block) for block in content.cells if block.kind in ("triangle", "quad", "polygon"))
    came = f"a surface ({_kinds(content)})" if flat else _kinds(content)
    fix = "turn a surface into tetrahedra with torchpd.tetrahedralize(path, cells=...)"
    if not flat:
        fix = "export it with its cells"
    must = "must hold tetrahedra, hexahedra, wedges or pyramids"
    return f"{owner}: {name} {must}, got {came}{_noted(content)}; {fix}"


def _noted(content: MeshContent) -> str:
    return f" ({'; '.join(content.notes)})" if content.notes else ""
