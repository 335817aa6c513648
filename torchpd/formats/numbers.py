"""Numbers in files, as text or bytes; every declared count is compared with the remaining size before reading."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Protocol
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from .content import Array, Index

__all__ = ["Binary", "Numbers", "Text", "check_room", "check_rows", "lines_of", "parse", "text_of", "words", "xml_of"]

_CHUNK = 1 << 20
_SPACE = b" \t\n\r\x0b\x0c"


def check_room(count: int, least: int, room: int, what: str) -> None:
    """Refuse a declared count if the rest of the file is too small for it at the given bytes per row."""
    if count < 0 or count * least > room:
        raise ValueError(f"it declares {count} {what}, but the {room} bytes that are left have no room for them")


def check_rows(lines: list[str], count: int, what: str) -> None:
    """Refuse a file with more or fewer lines than the rows that it declares."""
    if len(lines) != count:
        raise ValueError(f"it declares {count} {what}, a line each, got {len(lines)} lines")


def text_of(path: Path) -> str:
    """Text of a file as UTF-8 or else Latin-1, without a byte-order mark, with newlines as line ends."""
    data = path.read_bytes()
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        text = data.decode("utf-16")
    else:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = data.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def xml_of(data: bytes) -> ElementTree.Element:
    """Root element of an XML document."""
    try:
        return ElementTree.fromstring(data.lstrip())
    except ElementTree.ParseError as error:
        raise ValueError(f"it is no complete XML document: {error}") from None


def lines_of(path: Path, comment: str) -> list[str]:
    """Lines of a text file without comments, surrounding blanks and empty lines."""
    lines = (line.partition(comment)[0].strip() for line in text_of(path).split("\n"))
    return [line for line in lines if line]


def _starts(data: bytes) -> Index:
    """Positions at which words begin."""
    letters = ~np.isin(np.frombuffer(data, dtype=np.uint8), np.frombuffer(_SPACE, dtype=np.uint8))
    begins = letters.copy()
    begins[1:] &= ~letters[:-1]
    return np.flatnonzero(begins)


def parse(text: bytes, dtype: Any, what: str) -> NDArray[Any]:
    """Parse all numbers of a text; Fortran exponents (1.0D+00) are accepted."""
    try:
        values = np.fromstring(text, dtype=dtype, sep=" ")
        if len(values) == len(_starts(text)):
            return values
    except ValueError:  # newer versions of NumPy raise; older ones return the numbers before the first word
        pass
    tokens = text.split()
    try:
        return np.array([token.replace(b"D", b"E").replace(b"d", b"e") for token in tokens], dtype=dtype)
    except (ValueError, OverflowError):
        good = re.compile(rb"[-+]?\d+" if np.dtype(dtype).kind in "iu" else rb"[-+]?(\d+\.?\d*|\.\d+)([eEdD][-+]?\d+)?")
        bad = next((token for token in tokens if not good.fullmatch(token)), b"")
        word = bad.decode("latin-1")[:40]
        raise ValueError(f"{what} must be numbers, got {word!r}") from None


class Numbers(Protocol):
    """Integers and real numbers of a file, one after another."""

    def ints(self, count: int, what: str) -> Index: ...
    def sizes(self, count: int, what: str) -> Index: ...
    def floats(self, count: int, what: str) -> Array: ...
    def left(self) -> int: ...


class Text:
    """Reads lines and numbers of a text from `at` on."""

    def __init__(self, data: bytes, at: int = 0) -> None:
        self.data, self.at = data, at

    def line(self) -> str | None:
        """Read the next line, without surrounding blanks; None at the end."""
        if self.at >= len(self.data):
            return None
        end = self.data.find(b"\n", self.at)
        end = len(self.data) if end < 0 else end
        line = self.data[self.at : end]
        self.at = end + 1
        return line.decode("latin-1").strip()

    def row(self) -> str | None:
        """Read the next line that is not blank; None at the end."""
        line = self.line()
        while line is not None and not line:
            line = self.line()
        return line

    def words(self, count: int, what: str) -> bytes:
        """Read the text of the next words."""
        if not 0 <= 2 * count <= len(self.data) - self.at + 1:
            raise ValueError(f"{what} should be {count} numbers, but {len(self.data) - self.at} bytes are left")
        begin, found, chunk = self.at, 0, 32 * count + 64
        while found < count:
            if self.at >= len(self.data):
                raise ValueError(f"it ends among {what}: expected {count} numbers, got {found}")
            end = self.at + min(chunk, _CHUNK)
            # a chunk ends with a word
            while end < len(self.data) and self.data[end - 1] not in _SPACE:
                end += 1
            starts = _starts(self.data[self.at : end])
            if found + len(starts) > count:
                self.at += int(starts[count - found])
                break
            found += len(starts)
            self.at = min(end, len(self.data))
        return self.data[begin : self.at]

    def left(self) -> int:
        """Number of remaining words."""
        return len(self.data[self.at :].split())

    def ints(self, count: int, what: str) -> Index:
        return np.asarray(parse(self.words(count, what), np.int64, what))

    sizes = ints

    def floats(self, count: int, what: str) -> Array:
        return np.asarray(parse(self.words(count, what), np.float64, what))


class Binary:
    """Reads numbers of a block of bytes from `at` on: integers and real numbers of these types."""

    def __init__(self, data: bytes, at: int, integer: str, real: str, size: str = "") -> None:
        self.data, self.at = data, at
        self.integer, self.real, self.size = np.dtype(integer), np.dtype(real), np.dtype(size or integer)

    def take(self, dtype: Any, count: int, what: str) -> NDArray[Any]:
        """Read the next numbers or records of any type."""
        kind = np.dtype(dtype)
        if not 0 <= count * kind.itemsize <= len(self.data) - self.at:
            left = len(self.data) - self.at
            raise ValueError(f"{what} should be {count} times {kind.itemsize} bytes, but {left} bytes are left")
        values = np.frombuffer(self.data, kind, count, self.at)
        self.at += count * kind.itemsize
        return values

    def left(self) -> int:
        """Number of remaining bytes."""
        return len(self.data) - self.at

    def ints(self, count: int, what: str) -> Index:
        return self.take(self.integer, count, what).astype(np.int64)

    def sizes(self, count: int, what: str) -> Index:
        return self.take(self.size, count, what).astype(np.int64)

    def floats(self, count: int, what: str) -> Array:
        return self.take(self.real, count, what).astype(np.float64)


def words(line: str) -> list[str]:
    """Words of a line; words in quotes may contain blanks."""
    return [a or b or c for a, b, c in re.findall(r"\"([^\"]*)\"|'([^']*)'|(\S+)", line)]
