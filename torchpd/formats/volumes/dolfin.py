"""DOLFIN's .xml: vertices and cells of one kind.

Format: https://people.sc.fsu.edu/~jburkardt/data/dolfin_xml/dolfin_xml.html.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ..content import MeshContent
from ..numbers import xml_of
from .gather import as_3d, block

__all__ = ["read"]

_KINDS = {"tetrahedron": ("tetra", 4), "triangle": ("triangle", 3), "interval": ("line", 2)}


def read(path: Path) -> MeshContent:
    """Read one mesh."""
    root = xml_of(path.read_bytes())
    meshes = list(root.iter("mesh"))
    if len(meshes) != 1:
        raise ValueError(f"it must hold one mesh, got {len(meshes)}")
    mesh = meshes[0]
    cell, dimension = mesh.get("celltype", ""), mesh.get("dim", "")
    if cell not in _KINDS or dimension not in ("1", "2", "3"):
        raise ValueError(f"cells must be tetrahedron, triangle or interval in dim 1 to 3, got {cell!r}, {dimension!r}")
    kind, corners = _KINDS[cell]
    axes = ["x", "y", "z"][: int(dimension)]
    points = _table(mesh, "vertices", "vertex", axes).astype(np.float64)
    cells = _table(mesh, "cells", cell, [f"v{k}" for k in range(corners)]).astype(np.int64)
    if len(axes) == 1:
        points = np.column_stack([points, np.zeros(len(points))])
    return MeshContent(as_3d(points), [block(kind, cells)])


def _table(
    mesh: ElementTree.Element, group: str, tag: str, names: list[str]
) -> np.ndarray[tuple[int, int], np.dtype[np.str_]]:
    """Attributes of all entries of a group, in the order of their indices."""
    groups = mesh.findall(group)
    entries = [entry for part in groups for entry in part]
    declared = sum(int(part.get("size", "-1")) for part in groups)
    if declared != len(entries) or any(entry.tag != tag for entry in entries):
        raise ValueError(f"it declares {declared} entries <{tag}>, got {len(entries)} in <{group}>")
    order = [int(entry.get("index", "-1")) for entry in entries]
    if sorted(order) != list(range(len(entries))):
        raise ValueError(f"indices of <{tag}> must be 0 to {len(entries) - 1}, each once")
    table = np.array([[entry.attrib[name] for name in names] for entry in entries], dtype=np.str_)
    return table[np.argsort(order)].reshape(len(entries), len(names))
