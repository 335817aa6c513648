"""Readers of surface formats, with the names of the formats."""

from __future__ import annotations

from ..content import Reader
from .collada import read_collada
from .gltf import read_gltf
from .obj import read_obj
from .off import read_off
from .ply import read_ply
from .stl import read_stl
from .threemf import read_3mf
from .usd import read_usd

__all__ = ["READERS"]

READERS: dict[str, tuple[str, Reader]] = {
    ".3mf": ("3MF", read_3mf),
    ".dae": ("COLLADA", read_collada),
    ".glb": ("binary glTF", read_gltf),
    ".gltf": ("glTF", read_gltf),
    ".obj": ("Wavefront OBJ", read_obj),
    ".off": ("OFF", read_off),
    ".ply": ("PLY", read_ply),
    ".stl": ("STL", read_stl),
    ".usd": ("USD", read_usd),
    ".usda": ("USD", read_usd),
    ".usdc": ("USD", read_usd),
    ".usdz": ("USD", read_usd),
}
