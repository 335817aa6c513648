"""JSON of a glTF and the numbers in its buffers, with every reference and length checked."""

from __future__ import annotations

import base64
import binascii
import json
import struct
import urllib.parse
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Document"]

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_JSON, _BIN = 0x4E4F534A, 0x004E4942
_PACKED = "its vertices are compressed by an extension and are not there without it"

Table = dict[str, Any]


@dataclass
class Document:
    """A glTF file: its JSON, the binary chunk of a .glb, and the folder of the buffers beside it."""

    root: Table
    chunk: bytes | None
    folder: Path
    size: int  # size of the file [bytes]
    _buffers: dict[int, bytes] = field(default_factory=dict)
    _accessors: dict[int, NDArray[Any]] = field(default_factory=dict)

    @classmethod
    def load(cls, path: Path) -> Document:
        data = path.read_bytes()
        text, chunk = _chunks(data) if data.startswith(b"glTF") else (data, None)
        try:
            root = json.loads(text.decode("utf-8-sig"))
        except (ValueError, RecursionError) as error:
            raise ValueError(f"its JSON cannot be read: {error}") from None
        if not isinstance(root, dict):
            raise ValueError("its JSON must be an object")
        version = root.get("asset", {}).get("version", "") if isinstance(root.get("asset"), dict) else ""
        if not str(version).startswith("2."):
            raise ValueError(f"glTF 2.0 is read; asset.version is {version!r}")
        return cls(root, chunk, path.parent, len(data))

    def items(self, name: str, table: Table | None = None) -> list[Table]:
        """A list of objects in the JSON or in one of its objects; empty if there is no such list."""
        found = (self.root if table is None else table).get(name, [])
        if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
            raise ValueError(f"{name} must be a list of objects")
        return found

    def item(self, name: str, number: Any) -> Table:
        """An item of a list in the JSON, by its number."""
        items = self.items(name)
        if type(number) is not int or not 0 <= number < len(items):
            raise ValueError(f"{name} {number!r} is named, but there are {len(items)}, counted from 0")
        return items[number]

    def numbers(self, table: Table, name: str) -> list[int]:
        found = table.get(name, [])
        if not isinstance(found, list) or not all(type(item) is int for item in found):
            raise ValueError(f"{name} must be a list of numbers")
        return found

    def names(self, name: str) -> list[str]:
        found = self.root.get(name, [])
        if not isinstance(found, list):
            raise ValueError(f"{name} must be a list of names")
        return [str(item) for item in found]

    def accessor(self, number: Any, kinds: tuple[str, ...]) -> NDArray[Any]:
        """Rows of an accessor [count, width]: whole numbers as int64, others and normalised ones as float64."""
        table = self.item("accessors", number)
        if table.get("type") not in kinds:
            raise ValueError(f"accessor {number} must be {' or '.join(kinds)}, got {table.get('type')!r}")
        if number not in self._accessors:
            self._accessors[number] = self._read_accessor(table, f"accessor {number}")
        return self._accessors[number]

    def _read_accessor(self, table: Table, name: str) -> NDArray[Any]:
        count, width = _length(table, "count", name), _WIDTHS[table["type"]]
        code = _COMPONENTS.get(table.get("componentType", 0))
        if code is None:
            raise ValueError(f"{name} has the unknown componentType {table.get('componentType')!r}")
        if "bufferView" in table:
            rows = self._rows(table, np.dtype(code), width, count, name).copy()
        elif "sparse" not in table:
            raise ValueError(f"{name} has no bufferView: {_PACKED}")
        elif count > self.size:
            raise ValueError(f"{name} declares {count:,} rows, in a file of {self.size:,} bytes")
        else:
            rows = np.zeros((count, width), code)
        if "sparse" in table:
            self._replace_rows(rows, table["sparse"], name)
        if table.get("normalized") and code != "<f4":
            # c / (2^bits - 1), signed ones c / (2^(bits - 1) - 1) and -1 at least (glTF 2.0, section 3.11)
            return np.maximum(rows.astype(np.float64) / np.iinfo(rows.dtype).max, -1.0)
        return rows.astype(np.float64 if code == "<f4" else np.int64)

    def _replace_rows(self, rows: NDArray[Any], sparse: Any, name: str) -> None:
        """Write the rows of a sparse accessor to their places."""
        if not isinstance(sparse, dict) or not all(isinstance(sparse.get(k), dict) for k in ("indices", "values")):
            raise ValueError(f"sparse of {name} must hold indices and values")
        count = _length(sparse, "count", name)
        code = _COMPONENTS.get(sparse["indices"].get("componentType", 0), "<f4")
        if code[1] != "u":
            raise ValueError(f"sparse indices of {name} must be unsigned")
        places = self._rows(sparse["indices"], np.dtype(code), 1, count, name).reshape(-1).astype(np.int64)
        if count and int(places.max()) >= len(rows):
            raise ValueError(f"sparse indices of {name} go up to {int(places.max())}, but it has {len(rows)} rows")
        rows[places] = self._rows(sparse["values"], rows.dtype, rows.shape[1], count, name)

    def _rows(self, table: Table, kind: np.dtype[Any], width: int, count: int, name: str) -> NDArray[Any]:
        """Rows of a bufferView [count, width], at its stride; all must be in the buffer."""
        view = self.item("bufferViews", table.get("bufferView"))
        if {"EXT_meshopt_compression", "KHR_meshopt_compression"} & set(view.get("extensions", {})):
            raise ValueError(f"{name} is compressed by meshopt; decompress the file, as with gltf-transform")
        buffer = self._buffer(view.get("buffer"))
        offset, length = _length(view, "byteOffset", name, 0), _length(view, "byteLength", name)
        if offset + length > len(buffer):
            raise ValueError(f"{name} needs {offset + length:,} bytes of a buffer that has {len(buffer):,}")
        begin, row = _length(table, "byteOffset", name, 0), width * kind.itemsize
        stride = _length(view, "byteStride", name, row)
        if stride < row or begin + max(count - 1, 0) * stride + min(count, 1) * row > length:
            raise ValueError(
                f"{name} declares {count:,} rows of {row} bytes, {stride} bytes apart, which its bufferView of "
                f"{length:,} bytes does not hold"
            )
        if not count:
            return np.empty((0, width), kind)
        return np.ndarray((count, width), kind, buffer, offset + begin, (stride, kind.itemsize))

    def _buffer(self, number: Any) -> bytes:
        table = self.item("buffers", number)
        if number not in self._buffers:
            uri = table.get("uri")
            data = self.chunk if uri is None and number == 0 else None if uri is None else self._fetch(str(uri))
            if data is None:
                raise ValueError(f"buffer {number} has no data: {_PACKED}")
            if len(data) < _length(table, "byteLength", f"buffer {number}"):
                raise ValueError(
                    f"buffer {number} declares {table['byteLength']:,} bytes and has {len(data):,}; it was cut off"
                )
            self._buffers[number] = data
        return self._buffers[number]

    def _fetch(self, uri: str) -> bytes:
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            try:
                return (
                    base64.b64decode(body, validate=True)
                    if head.endswith(";base64")
                    else urllib.parse.unquote_to_bytes(body)
                )
            except binascii.Error as error:
                raise ValueError(f"the data of a buffer cannot be read: {error}") from None
        name = urllib.parse.unquote(uri)
        file = (self.folder / name).resolve()
        if "\0" in name or "://" in name or not file.is_relative_to(self.folder.resolve()):
            raise ValueError(f"its buffer {name[:80]!r} must lie beside the file or below its folder")
        if not file.is_file():
            raise ValueError(f"its buffer {name[:80]!r} is missing; it must lie beside the file, in {self.folder}")
        return file.read_bytes()


def _length(table: Table, key: str, name: str, default: int | None = None) -> int:
    value = table.get(key, default)
    if type(value) is not int or not 0 <= value < 2**53:
        raise ValueError(f"{key} of {name} must be a whole number, got {value!r}")
    return value


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """JSON and binary chunk of a .glb."""
    version, total = struct.unpack("<II", data[4:12]) if len(data) >= 12 else (2, 12)
    if version != 2:
        raise ValueError(f"version 2 of the .glb container is read, got {version}")
    if total != len(data):
        raise ValueError(f"its head declares {total:,} bytes, but the file has {len(data):,}; was it cut off?")
    found: dict[int, bytes] = {}
    place = 12
    while place + 8 <= total:
        length, kind = struct.unpack("<II", data[place : place + 8])
        if place + 8 + length > total:
            raise ValueError(f"a chunk of {length:,} bytes goes on beyond the end of the file")
        found.setdefault(kind, data[place + 8 : place + 8 + length])
        place += 8 + length
    if _JSON not in found:
        raise ValueError("it has no chunk of JSON")
    return found[_JSON].rstrip(b"\0 "), found.get(_BIN)
