"""Clusters of 32 sides of one body, in the order of a tree, as a search reads them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .contact_tree import FAN_OUT, ContactTree

__all__ = ["Clusters", "contact_clusters"]

Numbers = NDArray[np.int32]
_ROWS = 4  # the number of a side and its corners


class Clusters(NamedTuple):
    """Clusters of the vertices of surfaces, then of their edges, then of their triangles."""

    leaves: Numbers  # [n, 4, 32] numbers of sides, -1 past the last one; and their corners, the last one repeated
    body: Numbers  # [n] body of each cluster
    counts: tuple[int, int]  # clusters of vertices, and of edges


def contact_clusters(trees: list[ContactTree], sides: list[Numbers], body: Numbers) -> Clusters:
    """Cut the orders of trees over vertices [S, 1], edges [E, 2] and triangles [T, 3], of bodies [N], by bodies."""
    parts = [_cut(tree.order, corners, body) for tree, corners in zip(trees, sides, strict=True)]
    leaves, of = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Clusters(leaves, of, (len(parts[0][1]), len(parts[1][1])))


def _cut(order: Numbers, corners: Numbers, body: Numbers) -> tuple[Numbers, Numbers]:
    of = body[corners[order, 0]]
    bodies, counts = np.unique(of, return_counts=True)
    clusters = -(-counts // FAN_OUT)
    # places of the sides among whole clusters
    rank = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    at = np.repeat(FAN_OUT * (np.cumsum(clusters) - clusters), counts) + rank
    leaves = np.full((FAN_OUT * clusters.sum(), _ROWS), -1, dtype=np.int32)
    leaves[at, 0] = order
    for corner in range(_ROWS - 1):
        leaves[at, 1 + corner] = corners[order, min(corner, corners.shape[1] - 1)]
    grouped = leaves.reshape(-1, FAN_OUT, _ROWS).transpose(0, 2, 1)
    return np.ascontiguousarray(grouped), np.repeat(bodies, clusters).astype(np.int32)
