"""Split cells of any kind into tets and triangles that fill them exactly and match across shared faces.

A quad face is cut from its vertex of the lowest number, so that both of its sides are cut alike. A cell is then the
cone from one of its corners over the faces without that corner.

Source: Dompierre, Labbé, Vallet and Camarero, "How to subdivide pyramids, prisms and hexahedra into tetrahedra", 1999.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from .content import CELLS, Array, Cells, Index, MeshContent
from .polygons import FaultyPolygons, triangulate

__all__ = ["Split", "tets_of", "triangles_of"]

Mask = NDArray[np.bool_]

# triangles and quads of each cell, corners counter-clockwise seen from outside, in the order of VTK
_TRIANGLES: dict[str, list[list[int]]] = {
    "tetra": [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]],
    "pyramid": [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]],
    "wedge": [[0, 2, 1], [3, 4, 5]],
    "hexahedron": [],
}
_QUADS: dict[str, list[list[int]]] = {
    "tetra": [],
    "pyramid": [[0, 3, 2, 1]],
    "wedge": [[0, 1, 4, 3], [1, 2, 5, 4], [2, 0, 3, 5]],
    "hexahedron": [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]],
}
_PLURALS = {"hexahedron": "hexahedra", "tetra": "tets", "polyhedron": "polyhedra", "vertex": "vertices"}


@dataclass(frozen=True, eq=False)
class Split:
    """Elements of one kind made of the cells of a file.

    Args:
        points: [N, 3] those of the file, followed by centres of cells of which no corner can be the apex.
        elements: point numbers [E, 4] of tets or [E, 3] of triangles, in the order of the file.
        regions: region number of each element [E], or None if the file has none.
        notes: splits and omissions, a sentence each.
    """

    points: Array
    elements: Index
    regions: Index | None
    notes: list[str]


def tets_of(content: MeshContent) -> Split:
    """Split all cells that have a volume into tets."""
    solid = [block for block in content.cells if block.kind in _TRIANGLES and len(block)]
    points, elements, owners, folded = content.points, [], [], 0
    made: Counter[str] = Counter()
    for block, diagonal in zip(solid, _choose_diagonals(solid), strict=True):
        if block.kind == "tetra":
            tets, cells = block.corners, np.arange(len(block))
        else:
            points, tets, cells, bad = _cones(points, block, diagonal)
            made[block.kind] += len(tets)
            folded += bad
        elements.append(tets)
        owners.append(cells)
    cells_of = _counts(solid)
    notes = [*_omissions(content), *_of_higher_order(solid)]
    notes += [f"{_count_words(cells_of[kind], kind)} became {count} tets" for kind, count in made.items()]
    if folded:
        notes.append(f"{folded} of the cells that became tets are folded or flat, and so are some of their tets")
    return Split(points, _joined(elements, 4), _regions(solid, owners), notes)


def triangles_of(content: MeshContent) -> Split:
    """Split all triangles, quads and polygons into triangles."""
    flat = [block for block in content.cells if block.kind in ("triangle", "quad", "polygon") and len(block)]
    elements, owners, wrong = [], [], FaultyPolygons(0, 0)
    for block in flat:
        if block.kind == "triangle":
            triangles, cells = block.corners, np.arange(len(block))
        else:
            sizes = np.full(len(block), 4) if block.sizes is None else block.sizes
            triangles, cells, bad = triangulate(content.points, block.corners.reshape(-1), sizes)
            wrong = FaultyPolygons(wrong.small + bad.small, wrong.crossed + bad.crossed)
        elements.append(triangles)
        owners.append(cells)
    notes = _of_higher_order(flat)
    if wrong.small:
        notes.append(f"{wrong.small} polygons of fewer than three corners were left out")
    if wrong.crossed:
        notes.append(f"{wrong.crossed} polygons cross themselves and were cut into fans")
    return Split(content.points, _joined(elements, 3), _regions(flat, owners), notes)


def _joined(elements: list[Index], corners: int) -> Index:
    return np.concatenate([np.empty((0, corners), dtype=np.int64), *elements])


def _regions(blocks: list[Cells], owners: list[Index]) -> Index | None:
    """Region of each element: that of its cell, 0 if a block has none."""
    if all(block.regions is None for block in blocks):
        return None
    pairs = zip(blocks, owners, strict=True)
    return np.concatenate([np.zeros(len(o), np.int64) if b.regions is None else b.regions[o] for b, o in pairs])


def _counts(blocks: list[Cells]) -> Counter[str]:
    counts: Counter[str] = Counter()
    for block in blocks:
        counts[block.kind] += len(block)
    return counts


def _count_words(count: int, kind: str) -> str:
    """Count of cells as words."""
    return f"{count} {kind if count == 1 else _PLURALS.get(kind, f'{kind}s')}"


def _of_higher_order(blocks: list[Cells]) -> list[str]:
    counts = _counts([block for block in blocks if block.order > 1])
    straight = "of higher order: corners kept, nodes on edges left out, so that edges are straight"
    return [f"{_count_words(count, kind)} {straight}" for kind, count in counts.items()]


def _omissions(content: MeshContent) -> list[str]:
    """Notes on cells of other kinds, and on lines and vertices that lie on no other cell."""
    known = [block for block in content.cells if block.kind == "polygon" or CELLS.get(block.kind, (0, 0))[1] >= 2]
    used = np.zeros(len(content.points), dtype=bool)
    for block in known:
        used[block.corners] = True
    # Meshers describe the edges of a volume as lines and points, which are no part of it.
    others = [
        block
        for block in content.cells
        if len(block)
        and not any(block is other for other in known)
        and not (block.kind in ("line", "vertex") and used[block.corners].all())
    ]
    notes = []
    for kind, count in _counts(others).items():
        volume = sum(_hull_volume(content.points, block) for block in others if block.kind == kind)
        notes.append(f"{_count_words(count, kind)} left out" + (f", {volume:.4g} m^3" if volume else ""))
    return notes


def _hull_volume(points: Array, block: Cells) -> float:
    """Volume of the convex hulls of cells of any shape."""
    if block.sizes is None:
        return 0.0
    total = 0.0
    for corners in np.split(block.corners, np.cumsum(block.sizes)[:-1]):
        if np.linalg.matrix_rank(points[corners] - points[corners[:1]]) == 3:
            total += float(ConvexHull(points[corners]).volume)
    return total


def _choose_diagonals(blocks: list[Cells]) -> list[Index]:
    """For each quad face [n, quads], corner 0 or 1 at which its diagonal starts.

    The diagonal runs through the lowest vertex, unless triangles of other cells lie on the face: then it is theirs.
    """
    quads = [_faces(block, _QUADS[block.kind], 4) for block in blocks]
    chosen: list[Index] = [np.asarray(quad.argmin(axis=2) % 2, dtype=np.int64) for quad in quads]
    corners = np.concatenate([np.empty((0, 4), dtype=np.int64), *(quad.reshape(-1, 4) for quad in quads)])
    if not len(corners):
        return chosen
    sides = [_faces(block, _TRIANGLES[block.kind], 3).reshape(-1, 3) for block in blocks]
    triangles = np.concatenate([np.empty((0, 3), dtype=np.int64), *sides])
    on_quads = np.zeros(int(max(triangles.max(initial=0), corners.max())) + 1, dtype=bool)
    on_quads[corners] = True
    triangles = triangles[on_quads[triangles].all(axis=1)]
    if not len(triangles):
        return chosen
    halves = [corners[:, cut] for cut in ([0, 1, 2], [0, 2, 3], [1, 2, 3], [1, 3, 0])]
    met = _rows_in(np.concatenate(halves), triangles).reshape(4, -1)
    first, second = met[0] | met[1], met[2] | met[3]
    start = 0
    for number, quad in enumerate(quads):
        shape, stop = quad.shape[:2], start + quad.shape[0] * quad.shape[1]
        zero, one = first[start:stop].reshape(shape), second[start:stop].reshape(shape)
        chosen[number] = np.where(zero == one, chosen[number], one.astype(np.int64))
        start = stop
    return chosen


def _faces(block: Cells, corners: list[list[int]], width: int) -> Index:
    """Vertex numbers of some faces of all cells [n, faces, corners]."""
    return block.corners[:, np.array(corners, dtype=np.int64).reshape(-1, width)]


def _rows_in(some: Index, others: Index) -> Mask:
    """Mask of the rows of `some` that have the vertices of a row of `others`, in any order."""
    rows = np.sort(np.concatenate([some, others]), axis=1)
    number = np.unique(rows, axis=0, return_inverse=True)[1].reshape(-1)
    there = np.zeros(int(number.max()) + 1, dtype=bool)
    there[number[len(some) :]] = True
    return there[number[: len(some)]]


def _cones(points: Array, block: Cells, diagonals: Index) -> tuple[Array, Index, Index, int]:
    """Points, tets, the cell of each tet, and the number of cells with a tet of no positive volume for every apex.

    The apex is the corner of the lowest number. If that inverts tets or contradicts a prescribed diagonal, it is the
    next valid corner, and else the centre, which becomes a point.
    """
    corners, count = block.corners, len(block)
    faces, around = _cut_faces(block, diagonals)
    signs = np.where(_volumes(points, points[corners].mean(axis=1), faces).sum(axis=1) < 0, -1.0, 1.0)
    lowest = np.take_along_axis(corners, corners.argmin(axis=1)[:, None], axis=1)
    apexes = np.concatenate([lowest, corners], axis=1)
    places = np.concatenate([points[apexes], points[corners].mean(axis=1, keepdims=True)], axis=1)
    apexes = np.concatenate([apexes, np.full((count, 1), -1)], axis=1)  # -1: the centre
    chosen, left = np.zeros(count, dtype=np.int64), np.arange(count)
    for rank in range(apexes.shape[1]):
        real = _are_tets(apexes[left, rank], faces[left])
        volumes = _volumes(points, places[left, rank], faces[left]) * signs[left, None]
        # A triangle next to the apex in a face of the apex means that this face has the other diagonal.
        beside = (around[left] == apexes[left, rank, None, None]).any(axis=2)
        good = (~real | ((volumes > 0) & ~beside)).all(axis=1)
        chosen[left[good]] = rank
        left = left[~good]
    apex = apexes[np.arange(count), chosen]
    centred = np.flatnonzero(apex < 0)
    apex[centred] = len(points) + np.arange(len(centred))
    points = np.concatenate([points, places[centred, -1]])
    tets = np.concatenate([np.broadcast_to(apex[:, None, None], (*faces.shape[:2], 1)), faces], axis=2)
    turned = signs < 0
    tets[turned] = tets[turned][..., [0, 1, 3, 2]]
    kept = _are_tets(apex, faces)
    owners = np.broadcast_to(np.arange(count)[:, None], kept.shape)
    return points, tets[kept], owners[kept], len(left)


def _cut_faces(block: Cells, diagonals: Index) -> tuple[Index, Index]:
    """All faces of each cell as triangles [n, faces, 3], and the corners of the source face of each."""
    quads = _faces(block, _QUADS[block.kind], 4)
    cuts = np.array([[[0, 1, 2], [0, 2, 3]], [[1, 2, 3], [1, 3, 0]]])[diagonals]  # [n, quads, 2, 3]
    halves = np.take_along_axis(quads, cuts.reshape(*quads.shape[:2], 6), axis=2).reshape(len(block), -1, 3)
    around = np.repeat(quads, 2, axis=1)
    triangles = _faces(block, _TRIANGLES[block.kind], 3)
    return (
        np.concatenate([triangles, halves], axis=1),
        np.concatenate([triangles[..., [0, 1, 2, 2]], around], axis=1),
    )


def _volumes(points: Array, apex: Array, faces: Index) -> Array:
    """Six times the volume of the cone from each apex [n, 3] over each of its triangles [n, faces, 3]."""
    a, b, c = (points[faces[..., k]] - apex[:, None] for k in range(3))
    return np.asarray(np.einsum("nfk,nfk->nf", a, np.cross(b, c)))


def _are_tets(apex: Index, faces: Index) -> Mask:
    """Mask of cones with four different corners; triangles of a collapsed cell may have a repeated vertex."""
    a, b, c = (faces[..., k] for k in range(3))
    holds = (faces == apex[:, None, None]).any(axis=2)
    return np.asarray(~holds & (a != b) & (b != c) & (c != a))
