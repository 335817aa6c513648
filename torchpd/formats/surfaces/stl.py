"""STL, binary and text; equal corners of triangles become one vertex."""

from __future__ import annotations

import codecs
from array import array
from pathlib import Path

import numpy as np

from ..content import Array, Cells, MeshContent

__all__ = ["read_stl"]

_ROW = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEAD = 80  # bytes before the number of triangles
# lines of a facet; "outer loop" and "endloop" are recognised by their first words
_FACET = [b"facet", b"outer", b"vertex", b"vertex", b"vertex", b"endloop", b"endfacet"]


def read_stl(path: Path) -> MeshContent:
    """Read the triangles of all solids of a file; a binary file may begin with "solid" too."""
    data = path.read_bytes()
    text = data.removeprefix(codecs.BOM_UTF8)
    declared = int.from_bytes(data[_HEAD : _HEAD + 4], "little")
    room = len(data) - _HEAD - 4
    if room >= 0 and room == declared * _ROW.itemsize:
        corners = np.frombuffer(data, _ROW, declared, _HEAD + 4)["corners"].astype(np.float64)
    elif text.lstrip()[:5].lower() == b"solid" and b"\0" not in text:
        corners = _read_text(text)
    elif room < 0:
        raise ValueError(f"it holds {len(data)} bytes; a text file begins with 'solid', a binary one has 84 or more")
    else:
        raise ValueError(
            f"its head declares {declared:,} triangles ({84 + declared * _ROW.itemsize:,} bytes), but the file has "
            f"{len(data):,} bytes; it was cut off or is no STL"
        )
    points = corners.reshape(-1, 3)
    points, numbers = _merge(points)
    return MeshContent(points, [Cells("triangle", numbers.reshape(-1, 3))] if len(numbers) else [])


def _read_text(data: bytes) -> Array:
    """Corners [n, 3, 3]."""
    corners = array("d")
    line, step, inside = 0, 0, False
    try:
        for line, text in enumerate(data.lower().splitlines(), start=1):  # noqa: B007
            words = text.split()
            if not words:
                continue
            if inside and words[0] == _FACET[step]:
                if step in (2, 3, 4):
                    if len(words) != 4:
                        raise ValueError(f"a vertex needs 3 numbers, got {len(words) - 1}")
                    corners.extend(map(float, words[1:]))
                step = (step + 1) % 7
            elif step == 0 and words[0] == (b"endsolid" if inside else b"solid"):
                inside = not inside
            else:
                wanted = _FACET[step].decode() if inside else "solid"
                came = words[0][:20].decode("ascii", "replace")
                raise ValueError(f"{wanted!r} must come here, got {came!r}")
    except ValueError as error:
        raise ValueError(f"line {line}: {error}") from None
    if inside:
        raise ValueError("its last line must begin with 'endsolid'; the file was cut off")
    return np.array(corners).reshape(-1, 3, 3)


def _merge(points: Array) -> tuple[Array, np.ndarray[tuple[int, ...], np.dtype[np.int64]]]:
    """Unique points in order of first appearance, and the new number of each."""
    points = points + 0.0  # -0.0 becomes 0.0
    keys = np.ascontiguousarray(points).view(np.dtype((np.void, points.itemsize * 3))).reshape(-1)
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    order = np.argsort(first)
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    return points[first[order]], place[inverse.reshape(-1)]
