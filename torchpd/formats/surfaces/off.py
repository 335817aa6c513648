"""OFF, the text format of Geomview: vertices and polygons, with optional colours, normals and texture coordinates."""

from __future__ import annotations

import re
from array import array
from pathlib import Path

import numpy as np

from ..content import Array, Index, MeshContent
from .faces import check_corners, face_blocks

__all__ = ["read_off"]

_Line = tuple[int, list[bytes]]


def read_off(path: Path) -> MeshContent:
    """Read all faces of a file, with one vertex or face per line."""
    lines = [
        (number, words)
        for number, line in enumerate(path.read_bytes().removeprefix(b"\xef\xbb\xbf").splitlines(), start=1)
        if (words := line.split(b"#")[0].split())
    ]
    with_uvs, lines = _head(lines)
    vertices, faces = _counts(lines)
    if len(lines) - 1 != vertices + faces:
        raise ValueError(
            f"it declares {vertices} vertices and {faces} faces, a line each, but {len(lines) - 1} lines follow"
        )
    table = _table(lines[1 : vertices + 1], with_uvs)
    points, uvs = table[:, :3], table[:, 3:] if with_uvs else None
    corners, sizes = _polygons(lines[vertices + 1 :])
    check_corners(corners, vertices)
    notes: list[str] = []
    return MeshContent(points, face_blocks(corners, sizes, notes), uvs, notes)


def _head(lines: list[_Line]) -> tuple[bool, list[_Line]]:
    """Whether vertices have texture coordinates, and the lines from the counts on."""
    if not lines:
        raise ValueError("it is empty; an OFF file begins with 'OFF'")
    number, (word, *rest) = lines[0]
    match = re.fullmatch(rb"(ST)?C?N?(4?n?)OFF(\d*)", word, flags=re.IGNORECASE)
    if not match:
        raise ValueError(f"line {number}: the word 'OFF' must come first, got {word[:20].decode('ascii', 'replace')!r}")
    if match.group(3):  # ModelNet's files omit the blank
        rest.insert(0, match.group(3))
    if match.group(2) or b"BINARY" in rest:
        raise ValueError("only OFF files of text, with three coordinates a vertex, are read; write it as plain OFF")
    return match.group(1) is not None, [(number, rest), *lines[1:]] if rest else lines[1:]


def _counts(lines: list[_Line]) -> tuple[int, int]:
    number, words = lines[0] if lines else (0, [])
    try:
        vertices, faces = (int(word) for word in words[:2])
    except ValueError:
        vertices = faces = -1
    if vertices < 0 or faces < 0:
        raise ValueError(f"line {number}: the numbers of vertices and faces must come after 'OFF'")
    return vertices, faces


def _table(lines: list[_Line], with_uvs: bool) -> Array:
    """Coordinates of each vertex [n, 3], and its texture coordinates [n, 2] from the end of its line."""
    values, width, line = array("d"), 5 if with_uvs else 3, 0
    try:
        for number, words in lines:
            line = number
            if len(words) < width:
                raise ValueError(f"a vertex needs 3 coordinates{' and 2 of its texture' * with_uvs}, got {len(words)}")
            values.extend(map(float, words[:3] + words[-2:] if with_uvs else words[:3]))
    except ValueError as error:
        raise ValueError(f"line {line}: {error}") from None
    return np.array(values).reshape(-1, width)


def _polygons(lines: list[_Line]) -> tuple[Index, Index]:
    """Corners of all faces, and corner count of each; a colour may follow on the line."""
    corners, sizes = array("q"), array("q")
    line = 0
    try:
        for number, words in lines:
            line = number
            size = int(words[0])
            if not 0 <= size < len(words):
                raise ValueError(f"a face of {size} corners, but {len(words) - 1} numbers follow")
            corners.extend(map(int, words[1 : size + 1]))
            sizes.append(size)
    except (ValueError, OverflowError) as error:
        raise ValueError(f"line {line}: {error}") from None
    return np.array(corners, dtype=np.int64), np.array(sizes, dtype=np.int64)
