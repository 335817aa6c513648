"""Rendering and films."""

__all__: list[str] = []
