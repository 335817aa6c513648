"""Static trees over the primitives of surfaces, and the pairs of primitives whose boxes meet."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["FAN_OUT", "Boxes", "ContactTree", "contact_tree", "meeting"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

FAN_OUT = 32  # primitives of a cluster, and clusters of a cluster
_BITS = 21  # of a Morton code along each axis
_CHUNK = 1 << 13  # clusters opened at a time, to bound memory


@dataclass(frozen=True, eq=False)
class ContactTree:
    """A tree of which every node has 32 children, but for the last node of a level.

    Cluster k of level 1 holds the primitives `order[32 k : 32 k + 32]`, cluster k of level n + 1 the clusters 32 k to
    32 k + 31 of level n. The last level is one root.
    """

    order: NDArray[np.int32]  # [n] numbers of the primitives, body by body and there by Morton code
    levels: tuple[int, ...]  # number of clusters of level 1, 2, ..., 1


def contact_tree(centroids: Array, body: Index) -> ContactTree:
    """Tree over primitives with centroids [n, 3] m at rest, of bodies [n]."""
    order = np.lexsort((_morton(centroids, body), body)).astype(np.int32)
    levels = [-(-len(order) // FAN_OUT)]
    while levels[-1] > 1:
        levels.append(-(-levels[-1] // FAN_OUT))
    return ContactTree(order, tuple(levels))


def _morton(points: Array, body: Index) -> NDArray[np.uint64]:
    """Interleaved bits of the coordinates of each point [n] in the cube around its body."""
    count = int(body.max(initial=-1)) + 1
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, body, points)
    np.maximum.at(high, body, points)
    side = (high - low).max(axis=1)
    side[~(side > 0.0)] = 1.0  # one point, or no point at all
    cells = (points - low[body]) / side[body, None] * (2.0**_BITS - 1.0)
    codes = np.zeros(len(points), dtype=np.uint64)
    for axis in range(3):
        codes |= _spread(cells[:, axis].astype(np.uint64)) << np.uint64(axis)
    return codes


def _spread(numbers: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Move bit k of 21-bit numbers to bit 3 k."""
    for shift, mask in (
        (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):  # fmt: skip
        numbers = (numbers | (numbers << np.uint64(shift))) & np.uint64(mask)
    return numbers


@dataclass(frozen=True, eq=False)
class Boxes:
    """Axis-aligned boxes of the primitives, in the order of a tree, and of its clusters level by level."""

    order: NDArray[np.int32]
    low: tuple[Array, ...]  # [n, 3], then [clusters, 3] of each level
    high: tuple[Array, ...]

    @staticmethod
    def of(tree: ContactTree, low: Array, high: Array) -> Boxes:
        """Boxes of primitives [n, 3] m; one with infinite `low` meets nothing."""
        lows, highs = [low[tree.order]], [high[tree.order]]
        for _ in tree.levels:
            starts = np.arange(0, len(lows[-1]), FAN_OUT)
            lows.append(np.minimum.reduceat(lows[-1], starts, axis=0))
            highs.append(np.maximum.reduceat(highs[-1], starts, axis=0))
        return Boxes(tree.order, tuple(lows), tuple(highs))


def meeting(one: Boxes, other: Boxes) -> tuple[Index, Index]:
    """Numbers [m] and [m] of the primitives of two trees whose boxes meet; each pair once where the trees are one."""
    same = one is other
    if not len(one.order) or not len(other.order):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    first = second = np.zeros(1, dtype=np.int64)
    level, beside = len(one.low) - 1, len(other.low) - 1
    while level or beside:
        opens_first = level >= beside
        level, beside = (level - 1, beside) if opens_first else (level, beside - 1)
        found = []
        for i, j in _opened(first, second, opens_first, (one.low[level], other.low[beside])):
            low, high, other_low, other_high = one.low[level], one.high[level], other.low[beside], other.high[beside]
            for axis in range(3):
                meet = low[i, axis] <= other_high[j, axis]
                meet &= other_low[j, axis] <= high[i, axis]
                i, j = i[meet], j[meet]
            if same and level == beside:
                ahead = i <= j if level else i < j
                i, j = i[ahead], j[ahead]
            found.append((i, j))
        first, second = (np.concatenate(column) for column in zip(*found, strict=True))
    return one.order[first].astype(np.int64), other.order[second].astype(np.int64)


def _opened(
    first: Index, second: Index, opens_first: bool, below: tuple[Array, Array]
) -> Iterator[tuple[Index, Index]]:
    """Pairs with the children of one side in its place, in chunks; `below` has a row for each child."""
    parents, count = (first, len(below[0])) if opens_first else (second, len(below[1]))
    others = second if opens_first else first
    for start in range(0, max(1, len(parents)), _CHUNK):
        some = slice(start, start + _CHUNK)
        children = (FAN_OUT * parents[some, None] + np.arange(FAN_OUT)).reshape(-1)
        kept = np.repeat(others[some], FAN_OUT)
        there = children < count
        pair = children[there], kept[there]
        yield pair if opens_first else pair[::-1]
