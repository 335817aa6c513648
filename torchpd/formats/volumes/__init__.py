"""Formats of volume meshes: a module each, with `read(path)`."""

from __future__ import annotations

__all__: list[str] = []
