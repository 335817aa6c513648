"""Surfaces that trimesh reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .content import Cells, MeshContent

__all__ = ["NAMES", "read"]

NAMES = {
    ".glb": "binary glTF",
    ".gltf": "glTF",
    ".obj": "Wavefront OBJ",
    ".off": "OFF",
    ".ply": "PLY",
    ".stl": "STL",
}


def read(path: Path) -> MeshContent:
    """Read a file with trimesh, all geometry of a scene in place."""
    import trimesh

    # process=False: vertices keep the order of the file.
    surface = trimesh.load(path, process=False)
    if isinstance(surface, trimesh.Scene):
        if not surface.geometry:
            raise ValueError("it holds no triangles")
        surface = surface.to_mesh()
    if not isinstance(surface, trimesh.Trimesh):
        raise ValueError(f"it holds a {type(surface).__name__}, no triangles")
    uvs = getattr(surface.visual, "uv", None)
    points = np.asarray(surface.vertices, dtype=np.float64)
    cells = [Cells("triangle", np.asarray(surface.faces, dtype=np.int64))]
    return MeshContent(points, cells, uvs=None if uvs is None else np.asarray(uvs, dtype=np.float64))
