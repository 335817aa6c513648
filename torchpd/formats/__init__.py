"""Mesh files: a reader per format, one guard around all readers, and the split of all cells into tets and triangles."""

from __future__ import annotations

from .bodies import read_body, read_surface
from .registry import FORMATS

__all__ = ["FORMATS", "read_body", "read_surface"]
