"""Mesh files: a reader for each format, one guard around all of them, and tets and triangles of any cells."""
