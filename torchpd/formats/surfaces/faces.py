"""Faces of a surface file: checked corners, blocks by kind, and one texture coordinate per vertex."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..content import Array, Cells, Index

__all__ = [
    "MOST_INSTANCES",
    "check_corners",
    "check_instances",
    "check_tree",
    "face_blocks",
    "fan_triangles",
    "join",
    "join_uvs",
    "left_out",
    "one_uv_each",
    "strip_triangles",
    "turn_faces",
]


def check_instances(count: int) -> None:
    """Refuse scenes with endlessly nested parts: twenty levels of two references each are a million parts."""
    if count > MOST_INSTANCES:
        raise ValueError(f"it has more than {MOST_INSTANCES:,} instances, some of them nested")


def check_tree(roots: Iterable[Hashable], parts_of: Callable[[Any], Iterable[Hashable]]) -> None:
    """Refuse parts that contain themselves and, before they are placed, too many instances."""
    sizes: dict[Hashable, int] = {}  # 0: in progress

    def size(part: Hashable) -> int:
        if part not in sizes:
            sizes[part] = 0
            sizes[part] = 1 + sum(size(inner) for inner in parts_of(part))
        elif not sizes[part]:
            raise ValueError("one of its parts contains itself")
        return sizes[part]

    check_instances(sum(size(root) for root in roots))


def left_out(others: Mapping[str, int]) -> list[str]:
    """Note that counts the omitted objects of a file by name; empty if there are none."""
    return ["left out: " + ", ".join(f"{kind} ({count:,})" for kind, count in others.items())] if others else []


MOST_INSTANCES = 100_000  # nodes or components of a scene


def check_corners(corners: Index, count: int, nouns: str = "vertices", first: int = 0) -> None:
    """Refuse numbers of missing vertices; `first` is the file's number of the first vertex."""
    bad = np.flatnonzero((corners < 0) | (corners >= count))
    if bad.size:
        raise ValueError(
            f"faces name {nouns} that are not there: {int(corners[bad[0]]) + first} ({bad.size} such corners); there "
            f"are {count}, counted from {first}"
        )


def face_blocks(corners: Index, sizes: Index, notes: list[str]) -> list[Cells]:
    """Faces in the order of the file as one block of triangles, quads or polygons; smaller faces are noted."""
    few = sizes < 3
    if few.any():
        notes += left_out({"faces with fewer than 3 corners": int(few.sum())})
        corners, sizes = corners[np.repeat(~few, sizes)], sizes[~few]
    for size, kind in ((3, "triangle"), (4, "quad")):
        if len(sizes) and (sizes == size).all():
            return [Cells(kind, corners.reshape(-1, size))]
    return [Cells("polygon", corners, sizes=sizes)] if len(sizes) else []


def strip_triangles(strip: Index) -> Index:
    """Triangles of a strip [n] with consistent winding; restarts give triangles with a repeated vertex."""
    if len(strip) < 3:
        return np.empty((0, 3), np.int64)
    triangles = np.stack([strip[:-2], strip[1:-1], strip[2:]], axis=1)
    triangles[1::2] = triangles[1::2, [1, 0, 2]]
    a, b, c = triangles.T
    kept: NDArray[np.bool_] = (a != b) & (b != c) & (c != a)
    return triangles[kept]


def fan_triangles(fan: Index) -> Index:
    """Triangles of a fan [n] around its first vertex: [n - 2, 3]."""
    if len(fan) < 3:
        return np.empty((0, 3), np.int64)
    return np.stack([np.broadcast_to(fan[0], len(fan) - 2), fan[1:-1], fan[2:]], axis=1)


def one_uv_each(points: Array, corners: Index, numbers: Index, uvs: Array) -> tuple[Array, Index, Array]:
    """Duplicate vertices until each has one texture coordinate; returns points, corners and uvs.

    Corner k has point `corners[k]` and texture coordinate `numbers[k]`. Vertices keep their numbers and take their
    first texture coordinate. A copy of the vertex at the end takes each further one.
    """
    pairs, first, inverse = np.unique(corners * len(uvs) + numbers, return_index=True, return_inverse=True)
    order = np.argsort(first)  # pairs in order of appearance
    vertex, number = np.divmod(pairs[order], len(uvs))
    leads = np.zeros(len(pairs), dtype=bool)
    leads[np.unique(vertex, return_index=True)[1]] = True
    target = np.where(leads, vertex, len(points) - 1 + np.cumsum(~leads))
    coordinates = np.zeros((len(points) + int((~leads).sum()), 2))
    coordinates[target] = uvs[number]
    place = np.empty(len(pairs), dtype=np.int64)
    place[order] = target
    return np.concatenate([points, points[vertex[~leads]]]), place[inverse.reshape(-1)], coordinates


def turn_faces(corners: Index, sizes: Index) -> Index:
    """Reverse the corners of each face."""
    begins = np.repeat(np.cumsum(sizes) - sizes, sizes)
    return corners[2 * begins + np.repeat(sizes, sizes) - 1 - np.arange(len(corners))]


def join_uvs(parts: Sequence[Array | None], notes: list[str]) -> Array | None:
    """Texture coordinates of all parts of a scene; None, with a note, if only some parts have them."""
    found = [part for part in parts if part is not None]
    if found and len(found) < len(parts):
        notes.append(f"texture coordinates left out: {len(parts) - len(found)} of its {len(parts)} parts have none")
        return None
    return np.concatenate(found) if found else None


def join(parts: Sequence[Index]) -> Index:
    """Concatenate arrays; an empty list is allowed."""
    return np.concatenate(parts) if parts else np.empty(0, dtype=np.int64)
