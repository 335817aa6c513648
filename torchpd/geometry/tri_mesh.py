"""Triangle surfaces: immutable and checked, for embedding, rendering or filling."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.checks import as_array, check_finite, check_shape
from ..common.synonyms import check_arguments
from ..common.units import Unit, metres
from ..formats.bodies import read_surface
from ..formats.guard import name_file_in_errors
from .mesh_checks import (
    Numbers,
    affine,
    check_elements,
    check_points,
    compact,
    has_repeated_corner,
    raise_for_first,
    scaling,
    set_frozen,
    translation,
    warn,
)

__all__ = ["PathLike", "TriMesh"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
PathLike = str | os.PathLike[str]


@dataclass(frozen=True, eq=False, repr=False)
class TriMesh:
    """A triangle surface, open or closed, of one or more components. Triangles without area are accepted.

    Args:
        vertices: positions [V, 3] in m.
        triangles: vertex numbers [T, 3], counter-clockwise seen from outside.
        uvs: texture coordinates [V, 2], or None.
        drop_unreferenced: drop vertices that no triangle uses (otherwise an error).
        drop_degenerate: drop triangles with a repeated vertex (otherwise an error).
    """

    vertices: Array
    triangles: Index
    uvs: Array | None

    @check_arguments("TriMesh")
    def __init__(
        self,
        vertices: Numbers,
        triangles: Numbers,
        *,
        uvs: Numbers | None = None,
        drop_unreferenced: bool = False,
        drop_degenerate: bool = False,
    ) -> None:
        points = check_points("TriMesh.vertices", vertices)
        elements = check_elements("TriMesh.triangles", triangles, 3, len(points))
        bad = has_repeated_corner(elements)
        if drop_degenerate and bad.any():
            warn(f"TriMesh: {int(bad.sum())} of {len(bad)} triangles name a vertex twice and were left out")
            elements, bad = elements[~bad], bad[~bad]
            if not len(elements):
                raise ValueError("TriMesh.triangles: no triangle has three different corners")
        raise_for_first(
            "TriMesh.triangles", bad, elements, "corners must differ", "pass drop_degenerate=True to leave them out"
        )
        coordinates = None
        if uvs is not None:
            coordinates = as_array("TriMesh.uvs", uvs, np.float64)
            check_shape("TriMesh.uvs", coordinates, (len(points), 2), "texture coordinates of every vertex")
            check_finite("TriMesh.uvs", coordinates)
        kept, elements = compact("TriMesh", elements, len(points), drop=drop_unreferenced)
        set_frozen(
            self,
            vertices=points[kept],
            triangles=elements,
            uvs=None if coordinates is None else coordinates[kept],
        )

    @classmethod
    def from_trimesh(cls, surface: Any, *, unit: Unit | None = None) -> TriMesh:
        """Convert a trimesh.Trimesh, or a trimesh.Scene with its geometry in place.

        `unit` is the unit of its numbers, as in `from_file`; `surface.units` is ignored.
        """
        import trimesh

        if isinstance(surface, trimesh.Scene):
            others = [
                type(part).__name__ for part in surface.geometry.values() if not isinstance(part, trimesh.Trimesh)
            ]
            if others:
                warn(f"TriMesh.from_trimesh: geometry without triangles left out: {', '.join(sorted(others))}")
            surface = surface.to_mesh()
        if not isinstance(surface, trimesh.Trimesh):
            raise TypeError(f"TriMesh.from_trimesh: surface must be a Trimesh or a Scene, got {type(surface).__name__}")
        return cls(
            metres("TriMesh.from_trimesh", unit) * surface.vertices,
            surface.faces,
            uvs=getattr(surface.visual, "uv", None),
            drop_unreferenced=True,
            drop_degenerate=True,
        )

    @classmethod
    def from_file(cls, path: PathLike, *, unit: Unit | None = None) -> TriMesh:
        """Read the triangles of a mesh file; quads and polygons become triangles.

        Surfaces: .obj, .ply, .stl, .off, .gltf, .glb, .dae, .3mf, and through usd-core .usd, .usda, .usdc, .usdz. For a
        volume mesh, the triangles that the file lists are read. A `MeshWarning` lists every omission and assumption.

        All objects of a file are read, each at the place that the scene's transforms give. Declared units become
        metres, and a declared up axis becomes y (.usd, .dae). For .3mf the unit is converted only; its default is the
        millimetre. Vertices keep the order of the file. A vertex with several texture coordinates is duplicated, and
        equal corners of an .stl are merged.

        Args:
            path: the file; its suffix selects the format.
            unit: "m", "cm", "mm", "in" or "ft", the unit of the numbers in the file, which are converted to metres.
                None: the unit that the file declares, or metres.

        Raises:
            FileNotFoundError: there is no such file.
            ModuleNotFoundError: the format needs a package that is not installed; the error names it.
            ValueError: the file cannot be read, or holds no triangles; the error gives its name, its format and the
                cause.
        """
        surface = read_surface("TriMesh.from_file", path, unit)
        if surface.notes:
            warn(f"TriMesh.from_file: {Path(path).name}: {'; '.join(surface.notes)}")
        with name_file_in_errors("TriMesh.from_file", path):
            return cls(surface.points, surface.triangles, uvs=surface.uvs, drop_unreferenced=True, drop_degenerate=True)

    def to_trimesh(self) -> Any:
        """Convert to a trimesh.Trimesh with the same vertices, faces and texture coordinates."""
        import trimesh

        surface: Any = trimesh.Trimesh(self.vertices, self.triangles, process=False)
        if self.uvs is not None:
            visual: Any = trimesh.visual.TextureVisuals
            surface.visual = visual(uv=self.uvs)
        return surface

    def to_file(self, path: PathLike) -> None:
        """Write the surface in the format of the file's suffix, through trimesh."""
        self.to_trimesh().export(Path(path))

    @property
    def bounds(self) -> Array:
        """Lower and upper corner of the bounding box [2, 3]."""
        return np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    def volume(self) -> float:
        """Enclosed volume by the divergence theorem; meaningful when the surface is closed."""
        corners = self.vertices[self.triangles]
        return float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0)

    def transformed(self, matrix: Numbers) -> TriMesh:
        """Transform the surface by x -> A x + b, from a 3x3 or 4x4 matrix; a reflection reverses the triangles."""
        linear, offset = affine("TriMesh.transformed: matrix", matrix)
        triangles = self.triangles[:, ::-1] if np.linalg.det(linear) < 0 else self.triangles
        return TriMesh(self.vertices @ linear.T + offset, triangles, uvs=self.uvs)

    def translated(self, offset: Numbers) -> TriMesh:
        """Translate the surface by a vector [m]."""
        return self.transformed(translation("TriMesh.translated: offset", offset))

    def scaled(self, factor: float | Numbers) -> TriMesh:
        """Scale the surface about the origin, by one positive factor or one per axis."""
        return self.transformed(scaling("TriMesh.scaled: factor", factor))

    def __repr__(self) -> str:
        uvs = "" if self.uvs is None else ", uvs"
        return f"TriMesh({len(self.vertices)} vertices, {len(self.triangles)} triangles{uvs})"
