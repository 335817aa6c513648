"""Helpers of the readers: cells by kind, points by number."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..content import CELLS, Cells, Index

__all__ = ["SOLIDS", "Numbering", "as_3d", "block", "blocks_of", "renumbered"]


# kind of a solid by its node count
SOLIDS = {4: "tetra", 10: "tetra", 5: "pyramid", 13: "pyramid", 6: "wedge", 15: "wedge", 18: "wedge"}
SOLIDS |= {8: "hexahedron", 20: "hexahedron", 27: "hexahedron"}


def renumbered(cells: list[Cells], place: Callable[[Index], Index]) -> list[Cells]:
    """Cells with point numbers mapped by `place`."""
    return [replace(c, corners=place(c.corners), beyond=None if c.beyond is None else place(c.beyond)) for c in cells]


def as_3d(points: Any) -> Any:
    """Points [N, 3]; a missing third coordinate is 0."""
    array = np.asarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] not in (2, 3):
        raise ValueError(f"points must have two or three coordinates, got an array {list(array.shape)}")
    return array if array.shape[1] == 3 else np.column_stack([array, np.zeros(len(array))])


def block(kind: str, nodes: Index, regions: Index | None = None) -> Cells:
    """Cells of one kind of `CELLS` from all of their nodes [n, k], corners first."""
    count = CELLS[kind][0]
    if nodes.shape[1] < count:
        raise ValueError(f"a {kind} must have {count} corners, got {nodes.shape[1]}")
    beyond = nodes[:, count:] if nodes.shape[1] > count else None
    return Cells(kind, nodes[:, :count], None, regions, 1 if beyond is None else 2, beyond)


def blocks_of(kinds: list[str], rows: Sequence[Sequence[int]], regions: list[int] | None = None) -> list[Cells]:
    """Group single cells, each with its kind and nodes, into one block for each kind and length."""
    groups: dict[tuple[str, int], list[int]] = {}
    for number, (kind, row) in enumerate(zip(kinds, rows, strict=True)):
        groups.setdefault((kind, len(row)), []).append(number)
    blocks = []
    for (kind, length), numbers in groups.items():
        nodes = np.array([rows[n] for n in numbers], dtype=np.int64).reshape(len(numbers), length)
        marks = None if regions is None else np.array([regions[n] for n in numbers], dtype=np.int64)
        if kind in CELLS:
            blocks.append(block(kind, nodes, marks))
        else:
            blocks.append(Cells(kind, nodes.reshape(-1), np.full(len(numbers), length), marks))
    return blocks


class Numbering:
    """Map from the point numbers of a file to positions in the file.

    Args:
        numbers: the number of each point, in any order.
        what: name of the points in errors.
    """

    def __init__(self, numbers: Index, what: str = "node") -> None:
        self.what = what
        self.order = np.argsort(numbers, kind="stable")
        self.numbers = np.asarray(numbers)[self.order]
        twice = np.flatnonzero(self.numbers[1:] == self.numbers[:-1])
        if len(twice):
            raise ValueError(f"{what} {int(self.numbers[twice[0]])} comes twice ({len(twice)} such in all)")

    def __call__(self, used: Index) -> Index:
        if not used.size:
            return used
        place = np.searchsorted(self.numbers, used)
        inside = np.minimum(place, max(len(self.numbers) - 1, 0))
        missing = self.numbers[inside] != used if len(self.numbers) else np.ones(used.shape, dtype=bool)
        if missing.any():
            lost = used[missing]
            raise ValueError(f"cells name {self.what} {int(lost[0])}, which is missing ({len(lost)} such in all)")
        return np.asarray(self.order[inside], dtype=np.int64)
