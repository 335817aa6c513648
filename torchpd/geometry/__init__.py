"""Meshes, their quality, shapes, tetrahedralization, embedding."""

__all__: list[str] = []
