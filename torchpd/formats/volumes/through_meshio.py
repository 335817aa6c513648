"""Formats that meshio reads."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import numpy as np

from ..content import CELLS, Cells, Index, MeshContent
from .gather import as_3d, block
from .regions import can_hold_regions, choose_regions

__all__ = ["NAMES", "read"]

NAMES = {
    ".cgns": "CGNS",
    ".e": "Exodus",
    ".ex2": "Exodus",
    ".exo": "Exodus",
    ".h5m": "MOAB",
    ".hmf": "HMF",
    ".med": "MED",
    ".xdmf": "XDMF",
    ".xmf": "XDMF",
}


# formats whose element blocks are the regions
_BLOCKS = {".e", ".ex2", ".exo"}
_TETRA_4 = 10  # CGNS


def read(path: Path) -> MeshContent:
    """Read a file with meshio."""
    import meshio

    if path.suffix.lower() == ".msh":
        return _read_fluent(path)
    if path.suffix.lower() in (".cgns", ".hmf"):
        _check_sections(path)
    return content_of(meshio.read(path), by_block=path.suffix.lower() in _BLOCKS)


def _read_fluent(path: Path) -> MeshContent:
    """Read a Fluent .msh, whose cells must list their corners."""
    import meshio

    data = path.read_bytes()
    if re.search(rb"\(\s*(20|30)?13\s*\(", data):
        raise ValueError("it is a mesh of Fluent, which lists faces, not corners of cells; write it as .vtu")
    with path.open("rb", buffering=0) as raw:
        content = content_of(meshio.read(_EndGuard(raw), file_format="ansys"))
    head = re.search(rb"\(\s*12\s*\(\s*0\s+1\s+([0-9a-fA-F]+)", data)
    came = sum(map(len, content.cells))
    if head is None or int(head.group(1), 16) != came:
        listed = "no number of cells" if head is None else f"{int(head.group(1), 16)} cells"
        raise ValueError(f"it is a mesh of Fluent that declares {listed}, got {came}")
    return content


def _check_sections(path: Path) -> None:
    """Refuse files with sections that meshio would not read: it reads one of cells, of one kind in an .hmf."""
    import h5py

    found: list[str] = []
    with h5py.File(path) as file:
        label = {b"Zone_t": "zone", b"Elements_t": "section of cells"}
        file.visititems(lambda name, item: found.append(label.get(bytes(item.attrs.get("label", b"")), "")))
        section = file.get("Base/Zone1/GridElements/ data")
        kind = _TETRA_4 if section is None else int(section[0])
        if kind != _TETRA_4:
            raise ValueError(f"its cells must be tetrahedra of four nodes (TETRA_4), got type {kind} of CGNS")
        cells = [item.attrs.get("TopologyType") for item in file.get("domain/grid", {}).values()]
    named = {name: found.count(name) for name in ("zone", "section of cells")}
    named["topology of one type"] = max((cells.count(kind) for kind in cells if kind is not None), default=0)
    for name, count in named.items():
        if count > 1:
            raise ValueError(f"it holds {count} times a {name}, of which one would be read; write them one by one")


class _EndGuard(io.BufferedReader):
    """File that raises at its end, where meshio's readers would wait for a bracket forever."""

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        if not data and size:
            raise EOFError("the file ends too early")
        return data


def content_of(mesh: Any, *, by_block: bool = False) -> MeshContent:
    """Points, cells and regions of a `meshio.Mesh`; cell blocks are the regions if there are no others."""
    notes: list[str] = []
    chosen = choose_regions(
        (name for name, parts in mesh.cell_data.items() if all(can_hold_regions(name, part) for part in parts)), notes
    )
    cells = []
    for number, part in enumerate(mesh.cells):
        if not len(part.data):
            continue
        regions = None
        if chosen is not None:
            regions = np.asarray(mesh.cell_data[chosen][number]).astype(np.int64).reshape(-1)
        elif by_block and len(mesh.cells) > 1:
            regions = np.full(len(part.data), number + 1)
        cells.append(_cells(part.type, part.data, regions))
    if chosen is None and by_block and len(mesh.cells) > 1:
        notes.append("regions are the blocks of elements, counted from 1")
    names = getattr(mesh, "cell_tags", None)  # of MED
    if chosen == "cell_tags" and names:
        listed = ", ".join(f"{number} is {' and '.join(map(str, groups))}" for number, groups in names.items())
        notes.append(f"regions keep their numbers, not their names: {listed}")
    return MeshContent(as_3d(mesh.points), cells, notes=notes)


def _cells(kind: str, nodes: Any, regions: Index | None) -> Cells:
    name = re.sub(r"\d+$", "", kind)
    if name not in CELLS:
        sizes = np.array([len(row) for row in nodes], dtype=np.int64)
        corners = np.concatenate([np.asarray(row).reshape(-1) for row in nodes]).astype(np.int64)
        return Cells(name, corners, sizes, regions)
    return block(name, np.asarray(nodes).astype(np.int64).reshape(len(nodes), -1), regions)
