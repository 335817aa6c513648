"""Quiet opening of a USD stage: messages of usd-core become errors, its unit and axes a matrix."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np

from ..content import Array
from ..transforms import Z_UP

__all__ = ["axes_of", "check_lengths", "open_stage", "warnings_of"]


def check_lengths(path: Path) -> None:
    """Refuse a binary layer with sections beyond its end: usd-core would print and ask for input."""
    data = path.read_bytes()
    # an archive (.usdz) holds its layers uncompressed
    begins = [match.start() for match in re.finditer(b"PXR-USDC", data)] if data[:2] in (b"PX", b"PK") else []
    for begin in begins:
        layer = data[begin:]
        start = int.from_bytes(layer[16:24], "little")
        count = int.from_bytes(layer[start : start + 8], "little")
        rows = layer[start + 8 : start + 8 + 32 * min(count, len(layer))]
        # each row: the name of a section [16 bytes], its first byte and its length [int64 each]
        spans = [struct.unpack_from("<QQ", row, 16) for row in _pieces(rows, 32)]
        if not count or len(spans) < count or any(first + length > len(layer) for first, length in spans):
            raise ValueError(f"its table of contents names more than the {len(layer):,} bytes that are there")


def _pieces(data: bytes, size: int) -> list[bytes]:
    """Consecutive pieces of a size, without an incomplete last one."""
    return [data[k : k + size] for k in range(0, len(data) - size + 1, size)]


def warnings_of(delegate: Any) -> list[str]:
    """Messages that usd-core would have printed."""
    return [f"usd-core: {' '.join(item.commentary.split())[:300]}" for item in delegate.TakeUncoalescedDiagnostics()]


def open_stage(path: Path, delegate: Any) -> Any:
    """Open the stage of a file; errors are in the words of usd-core."""
    from pxr import Tf, Usd

    try:
        stage = Usd.Stage.Open(str(path))
        said = [str(error) for error in stage.GetCompositionErrors()]
    except Tf.ErrorException as error:
        said = re.findall(r": '(.*?)'(?=\s*(?:Error in|$))", str(error), flags=re.DOTALL) or [str(error)]
    said = said or warnings_of(delegate)
    if said:
        words = " ".join(" ".join(said).split())
        raise ValueError(f"usd-core cannot read the whole of it: {words[:300]}")
    return stage


def axes_of(stage: Any) -> tuple[Array, list[str]]:
    """Matrix from the numbers of a stage to metres with y up [3, 3], and notes on it."""
    from pxr import UsdGeom

    matrix, notes = np.eye(3), []
    if not UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        notes.append("the stage declares no metersPerUnit: its numbers count as metres, or in the unit of the call")
    elif (scale := UsdGeom.GetStageMetersPerUnit(stage)) != 1.0:
        if not 0.0 < scale < np.inf:
            raise ValueError(f"metersPerUnit must be positive, got {scale}")
        matrix *= scale
        notes.append(f"its unit is {scale:g} m, and its numbers were turned into metres")
    if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z:
        matrix = matrix @ Z_UP
        notes.append("its z axis is up, and it was turned so that y is: (x, y, z) became (x, z, -y)")
    return matrix, notes
