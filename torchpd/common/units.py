"""Units of length of meshes. After `from_file` and `tetrahedralize` everything is in metres."""

from __future__ import annotations

from typing import Literal, get_args

__all__ = ["Unit", "metres"]

Unit = Literal["m", "cm", "mm", "in", "ft"]

_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}


def metres(owner: str, unit: Unit | None) -> float:
    """Length of a unit [m]; None is metres."""
    if unit is None:
        return 1.0
    if unit not in get_args(Unit):
        raise ValueError(f"{owner}: unit must be one of {', '.join(map(repr, _METRES))} or None, got {unit!r}")
    return _METRES[unit]
