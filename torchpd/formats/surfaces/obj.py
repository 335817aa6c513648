"""Wavefront OBJ: vertices, faces and texture coordinates of all objects and groups.

Read from bytes, so that comments and names may be in any encoding. Numbers count from 1. Negative ones count back from
the line in which they stand (appendix B1 of Wavefront's Advanced Visualizer manual).
"""

from __future__ import annotations

import codecs
from array import array
from collections import Counter
from collections.abc import Iterator
from math import nan
from pathlib import Path

import numpy as np

from ..content import Array, MeshContent
from .faces import check_corners, face_blocks, left_out, one_uv_each

__all__ = ["read_obj"]

_OTHER = {b"l": "lines", b"p": "points", b"curv": "curves", b"curv2": "curves", b"surf": "free-form surfaces"}
# names, materials, normals and free-form parameters, which change no face
_BESIDE = frozenset(
    b"vn vp g o s mg usemtl usemap mtllib maplib bevel c_interp d_interp lod shadow_obj trace_obj ctech stech cstype "
    b"deg bmat step parm trim hole scrv sp end con bzp bsp cdc cdp res".split()
)


def read_obj(path: Path) -> MeshContent:
    """Read all faces of a file; vertices keep their order, with copies at the end for further uvs."""
    reading = _Reading()
    try:
        for reading.line, words in _lines(path.read_bytes()):
            reading.take(words)
    except (ValueError, OverflowError) as error:
        raise ValueError(f"line {reading.line}: {error}") from None
    return reading.content()


def _lines(data: bytes) -> Iterator[tuple[int, list[bytes]]]:
    """Number and words of each line that is no comment; continued lines are joined."""
    for mark, encoding in ((codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16")):
        if data.startswith(mark):
            data = data.decode(encoding, errors="replace").encode()
    held: list[bytes] = []
    for number, line in enumerate(data.removeprefix(codecs.BOM_UTF8).splitlines(), start=1):
        words = line.split(b"#")[0].split()
        if words and words[-1].endswith(b"\\"):
            held += [word for word in (*words[:-1], words[-1][:-1]) if word]
        elif words or held:
            yield number, held + words
            held = []
    if held:
        yield number, held


class _Reading:
    """Content of the lines so far."""

    def __init__(self) -> None:
        self.line = 0
        self.points = array("d")
        self.uvs = array("d")
        self.corners = array("q")
        self.numbers = array("q")  # texture coordinates at the corners of faces that have them all
        self.sizes = array("q")
        self.plain = 0  # faces without texture coordinates
        self.others: Counter[str] = Counter()
        self.unknown, self.first_unknown = 0, ""

    def take(self, words: list[bytes]) -> None:
        key = words[0]
        if key == b"v":
            self.points.extend(_numbers(words, 3))
        elif key == b"vt":
            self.uvs.extend(_texture(words[1:]))
        elif key in (b"f", b"fo"):
            self._take_face(words[1:])
        elif key in _OTHER:
            self.others[_OTHER[key]] += 1
        elif key in (b"call", b"csh"):
            raise ValueError(f"the file takes in another one ({b' '.join(words[:2])!r}), which is not followed")
        elif key not in _BESIDE:
            self.first_unknown = self.first_unknown or repr(key[:20])[1:]
            self.unknown += 1

    def _take_face(self, words: list[bytes]) -> None:
        if len(words) < 3:
            raise ValueError(f"a face needs at least 3 corners, got {len(words)}")
        parts = [word.split(b"/") for word in words] if any(b"/" in word for word in words) else None
        names = words if parts is None else [part[0] for part in parts]
        self.corners.extend(_counted(names, len(self.points) // 3, "vertex"))
        self.sizes.append(len(words))
        textures = [] if parts is None else [part[1] for part in parts if len(part) > 1 and part[1]]
        if len(textures) == len(words):
            self.numbers.extend(_counted(textures, len(self.uvs) // 2, "texture coordinate"))
        else:
            self.plain += 1

    def content(self) -> MeshContent:
        points = np.array(self.points).reshape(-1, 3)
        corners, sizes = np.array(self.corners, dtype=np.int64), np.array(self.sizes, dtype=np.int64)
        check_corners(corners, len(points), first=1)
        if self.unknown:
            self.others[f"lines of unknown kind, the first {self.first_unknown}"] = self.unknown
        notes = left_out(self.others)
        uvs: Array | None = None
        if self.numbers and self.plain:
            notes.append(f"texture coordinates left out: {self.plain:,} of {len(sizes):,} faces have none")
        elif self.numbers:
            numbers, values = np.array(self.numbers, dtype=np.int64), np.array(self.uvs).reshape(-1, 2)
            check_corners(numbers, len(values), "texture coordinates", first=1)
            points, corners, uvs = one_uv_each(points, corners, numbers, values)
        return MeshContent(points, face_blocks(corners, sizes, notes), uvs, notes)


def _numbers(words: list[bytes], count: int) -> list[float]:
    if len(words) <= count:
        raise ValueError(f"{words[0].decode()} needs {count} numbers, got {len(words) - 1}")
    return [float(word) for word in words[1 : count + 1]]


def _texture(words: list[bytes]) -> list[float]:
    """Parse two texture coordinates; a faulty one such as "nan(ind)" drops them, but not the surface."""
    try:
        return [float(word) for word in (words + [b"0"])[:2]] if words else [nan, nan]
    except ValueError:
        return [nan, nan]


def _counted(words: list[bytes], so_far: int, noun: str) -> list[int]:
    """Convert to numbers from 0; negative ones count back from the last one so far."""
    values = [int(word) for word in words]
    if min(values) < 0:
        values = [so_far + value + 1 if value < 0 else value for value in values]
        if min(values) < 1:
            raise ValueError(f"a face counts back beyond the first {noun} ({so_far} so far)")
    elif min(values) == 0:
        raise ValueError(f"a face names {noun} 0; they count from 1")
    return [value - 1 for value in values]
