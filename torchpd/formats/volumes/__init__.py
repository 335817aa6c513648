"""Readers of volume meshes, a module per format with `read(path)`."""

from __future__ import annotations

__all__: list[str] = []
