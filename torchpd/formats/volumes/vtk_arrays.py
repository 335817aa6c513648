"""Arrays of VTK's XML files: text, base64 or bytes, inline or appended, plain or compressed."""

from __future__ import annotations

import base64
import lzma
import re
import zlib
from importlib import import_module
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from ..numbers import check_room, parse, xml_of

__all__ = ["Document"]

_TYPES = {
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}


class Document:
    """A VTK XML file: its element tree and its arrays."""

    def __init__(self, data: bytes) -> None:
        self.appended, self.encoding = b"", "raw"
        head = re.search(rb"<AppendedData[^>]*>\s*_", data)
        if head is not None:
            end = data.rfind(b"</AppendedData>")
            if end < head.end():
                raise ValueError("its appended data have no end: the file was cut off")
            self.appended = data[head.end() : end]
            data = data[: head.end() - 1] + data[end:]
        self.root = xml_of(data)
        if self.root.tag != "VTKFile":
            raise ValueError(f"it must be a VTKFile, got <{self.root.tag[:40]}>")
        order = self.root.get("byte_order", "LittleEndian")
        if order not in ("LittleEndian", "BigEndian"):
            raise ValueError(f"byte_order must be LittleEndian or BigEndian, got {order[:40]!r}")
        self.order = "<" if order == "LittleEndian" else ">"
        self.header = self._dtype(self.root.get("header_type", "UInt32"))
        self.compressor = self.root.get("compressor", "")
        places = self.root.find("AppendedData")
        if places is not None:
            self.encoding = places.get("encoding", "raw")
        self.offsets = sorted({int(a.get("offset", "0")) for a in self.root.iter("DataArray")} | {len(self.appended)})

    def _dtype(self, name: str) -> Any:
        if name.lower() not in _TYPES:
            raise ValueError(f"arrays must be of a type of VTK, got {name[:40]!r}")
        return np.dtype(self.order + _TYPES[name.lower()])

    def array(self, element: ElementTree.Element) -> NDArray[Any]:
        """Values of a DataArray, [tuples, components] for several components."""
        name = element.get("Name", "points")
        dtype = self._dtype(element.get("type", ""))
        form = element.get("format", "ascii")
        text = (element.text or "").encode()
        if form == "ascii":
            values = parse(text, np.float64 if dtype.kind == "f" else np.int64, f"array {name}")
        elif form == "binary":
            values = self._numbers(_decode(text), dtype, name)
        elif form == "appended":
            values = self._numbers(self._appended(int(element.get("offset", "-1"))), dtype, name)
        else:
            raise ValueError(f"format of array {name} must be ascii, binary or appended, got {form[:40]!r}")
        components = int(element.get("NumberOfComponents") or 1)
        if components < 1 or len(values) % components:
            raise ValueError(f"array {name} must hold tuples of {components} numbers, got {len(values)} numbers")
        values = values.astype(values.dtype.newbyteorder("="))
        return values if components == 1 else values.reshape(-1, components)

    def _appended(self, offset: int) -> bytes | memoryview:
        if not 0 <= offset < len(self.appended):
            raise ValueError(f"an array begins at {offset} of the appended data, which have {len(self.appended)} bytes")
        if self.encoding == "raw":
            return memoryview(self.appended)[offset:]
        return _decode(self.appended[offset : next(end for end in self.offsets if end > offset)])

    def _numbers(self, data: bytes | memoryview, dtype: Any, name: str) -> NDArray[Any]:
        """Decode values after their header: the byte count, or the sizes of compressed blocks."""
        size = self.header.itemsize
        if not data and not self.compressor:
            return np.empty(0, dtype=dtype)
        check_room(1, size, len(data), f"headers of array {name}")
        count = int(np.frombuffer(data, self.header, 1)[0])
        if not self.compressor:
            check_room(count, 1, len(data) - size, f"bytes of array {name}")
            data = data[size : size + count]
        else:
            check_room(count + 3 if count else 1, size, len(data), f"blocks of array {name}")
            sizes = np.frombuffer(data, self.header, count + 3 if count else 1).tolist()
            data = self._decompressed(data, sizes, name)
        if len(data) % dtype.itemsize:
            raise ValueError(f"array {name} must hold whole numbers of {dtype.itemsize} bytes, got {len(data)} bytes")
        return np.frombuffer(data, dtype)

    def _decompressed(self, data: bytes | memoryview, sizes: list[int], name: str) -> bytes:
        if len(sizes) == 1:
            return b""
        count, full, last = sizes[:3]
        at, parts = len(sizes) * self.header.itemsize, []
        for number, length in enumerate(sizes[3:]):
            check_room(length, 1, len(data) - at, f"bytes of a block of array {name}")
            expected = last if number == count - 1 and last else full
            part = _unpack(self.compressor, data[at : at + length], expected)
            if len(part) != expected:
                raise ValueError(f"a block of array {name} should have {expected} bytes, got {len(part)}")
            parts.append(part)
            at += length
        return b"".join(parts)


def _decode(text: bytes) -> bytes:
    """Decode base64 of one or more parts, each with its own padding."""
    letters = b"".join(text.split())
    parts = re.findall(rb"[A-Za-z0-9+/]+={0,2}", letters)
    if sum(map(len, parts)) != len(letters):
        raise ValueError("its base64 holds other characters")
    return b"".join(base64.b64decode(part) for part in parts)


def _unpack(compressor: str, data: bytes | memoryview, expected: int) -> bytes:
    try:
        if compressor == "vtkZLibDataCompressor":
            return zlib.decompressobj().decompress(data, expected + 1)
        if compressor == "vtkLZMADataCompressor":
            return lzma.LZMADecompressor().decompress(data, expected + 1)
        if compressor == "vtkLZ4DataCompressor":
            check_room(expected, 1, 256 * len(data), "bytes of a block")  # LZ4 expands a byte by this factor at most
            return bytes(import_module("lz4.block").decompress(data, uncompressed_size=expected))
    except (zlib.error, lzma.LZMAError) as error:
        raise ValueError(f"a compressed block is damaged: {error}") from None
    raise ValueError(f"compressor {compressor[:40]!r} is not known; save without compression")
