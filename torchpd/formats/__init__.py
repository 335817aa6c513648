"""Mesh files: a reader for each format, one guard around all of them, and tets and triangles of any cells."""

from __future__ import annotations

from .bodies import read_body, read_surface
from .registry import FORMATS

__all__ = ["FORMATS", "read_body", "read_surface"]
