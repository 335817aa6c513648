"""Meshes: frozen vertices and indices that have been checked, so that nothing behind them has to check again.

`TetMesh` is what bodies are made of; `TriMesh` is a surface to be carried along, drawn, or filled with tetrahedra.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .checks import as_array, check_finite, check_scalar, check_shape
from .formats.bodies import read_body, read_surface
from .formats.guard import naming
from .mesh_checks import (
    MeshWarning,
    Numbers,
    affine,
    check_elements,
    check_points,
    clean_tets,
    compact,
    determinants,
    has_repeated_corner,
    refuse,
    scaling,
    store,
    translation,
    warn,
)
from .mesh_faces import ROUNDING, TET_FACES, match_faces, merge_near, report_faces
from .mesh_files import write_tets
from .quality import MeshQuality, measure_quality
from .synonyms import check_arguments
from .units import Unit, metres

if TYPE_CHECKING:
    from .embedding import Embedding

__all__ = ["MeshWarning", "TetMesh", "TriMesh"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
PathLike = str | os.PathLike[str]


@dataclass(frozen=True, eq=False, repr=False)
class TriMesh:
    """A triangle surface, open or closed, of one or many pieces. Triangles without area are accepted.

    Args:
        vertices: positions [V, 3] in m.
        triangles: vertex numbers [T, 3], counter-clockwise seen from outside.
        uvs: texture coordinates [V, 2], or None.
        drop_unreferenced: leave out vertices that no triangle uses (otherwise an error).
        drop_degenerate: leave out triangles that name a vertex twice (otherwise an error).
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
        refuse("TriMesh.triangles", bad, elements, "corners must differ", "pass drop_degenerate=True to leave them out")
        coordinates = None
        if uvs is not None:
            coordinates = as_array("TriMesh.uvs", uvs, np.float64)
            check_shape("TriMesh.uvs", coordinates, (len(points), 2), "texture coordinates of every vertex")
            check_finite("TriMesh.uvs", coordinates)
        kept, elements = compact("TriMesh", elements, len(points), drop=drop_unreferenced)
        store(
            self,
            vertices=points[kept],
            triangles=elements,
            uvs=None if coordinates is None else coordinates[kept],
        )

    @classmethod
    def from_trimesh(cls, surface: Any, *, unit: Unit | None = None) -> TriMesh:
        """From a trimesh.Trimesh, or from a trimesh.Scene with all its geometry in place.

        `unit`, as in `from_file`, is that of its numbers; what `surface.units` says is not looked at.
        """
        import trimesh

        if isinstance(surface, trimesh.Scene):
            others = [
                type(part).__name__ for part in surface.geometry.values() if not isinstance(part, trimesh.Trimesh)
            ]
            if others:
                warn(f"TriMesh.from_trimesh: left out, for they have no triangles: {', '.join(sorted(others))}")
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

        Surfaces: .obj, .ply, .stl, .off, .gltf, .glb, .dae, .3mf, and through usd-core .usd, .usda, .usdc, .usdz. Of a
        volume mesh the triangles that it lists are read. What is left out, or assumed, a `MeshWarning` says.

        All objects of a file are read, and parts of a scene where its transforms put them. Declared units become
        metres, and a declared axis that is up becomes y (.usd, .dae; of .3mf the unit only, where it is a millimetre
        unless it says otherwise). Vertices keep the order of the file; one with several texture coordinates is doubled,
        and equal corners of an .stl become one vertex.

        Args:
            path: the file; the suffix of its name says in which format it is.
            unit: "m", "cm", "mm", "in" or "ft", of the numbers in the file; they become metres. None: what the file
                declares, or metres.

        Raises:
            FileNotFoundError: there is no such file.
            ModuleNotFoundError: the format needs a package that is not installed, which is named.
            ValueError: the file cannot be read, or holds no triangles; with its name, its format and what was met.
        """
        surface = read_surface("TriMesh.from_file", path, unit)
        if surface.notes:
            warn(f"TriMesh.from_file: {Path(path).name}: {'; '.join(surface.notes)}")
        with naming("TriMesh.from_file", path):
            return cls(surface.points, surface.triangles, uvs=surface.uvs, drop_unreferenced=True, drop_degenerate=True)

    def to_trimesh(self) -> Any:
        """A trimesh.Trimesh with the same vertices, faces and texture coordinates."""
        import trimesh

        surface: Any = trimesh.Trimesh(self.vertices, self.triangles, process=False)
        if self.uvs is not None:
            visual: Any = trimesh.visual.TextureVisuals
            surface.visual = visual(uv=self.uvs)
        return surface

    def to_file(self, path: PathLike) -> None:
        """Write in the format of the file's suffix, through trimesh."""
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
        """The surface under x -> A x + b, from a 3x3 or 4x4 matrix; a reflection turns the triangles round."""
        linear, offset = affine("TriMesh.transformed: matrix", matrix)
        triangles = self.triangles[:, ::-1] if np.linalg.det(linear) < 0 else self.triangles
        return TriMesh(self.vertices @ linear.T + offset, triangles, uvs=self.uvs)

    def translated(self, offset: Numbers) -> TriMesh:
        """The surface moved by a vector [m]."""
        return self.transformed(translation("TriMesh.translated: offset", offset))

    def scaled(self, factor: float | Numbers) -> TriMesh:
        """The surface scaled about the origin, by one positive factor or one per axis."""
        return self.transformed(scaling("TriMesh.scaled: factor", factor))

    def __repr__(self) -> str:
        uvs = "" if self.uvs is None else ", uvs"
        return f"TriMesh({len(self.vertices)} vertices, {len(self.triangles)} triangles{uvs})"


@dataclass(frozen=True, eq=False, repr=False)
class TetMesh:
    """A tetrahedral mesh. Every tet has positive volume: det(x1 - x0, x2 - x0, x3 - x0) > 0.

    Tets that come with the opposite winding are turned (their last two corners change places), which is reported by a
    `MeshWarning` and counted in `flipped`. Others tell of tets that meet as hardly any body does: inner faces with both
    tets on one side (a folded mesh), faces of three tets, faces that lie on one another without common vertices, see
    `merged`, and faces that lie on faces with other corners. Pieces that lie apart are no fault: `quality()` counts
    them.

    Arrays are NumPy's and read-only: `torch.tensor(mesh.vertices)` copies them without a warning, where
    `torch.from_numpy` gives one.

    Args:
        vertices: positions [V, 3] in m.
        tets: vertex numbers [E, 4].
        fill: how much of each tet is material, in (0, 1] [E], or None for all of it: the lattice of `tetrahedralize`
            reaches beyond its surface. `Solid` multiplies density and Young's modulus by it.
        regions: a whole number for each tet [E], what it belongs to, or None. A material of each is
            `Solid(mesh, youngs=np.where(mesh.regions == 2, 1e6, 1e5))`.
        drop_unreferenced: leave out vertices that no tet uses (otherwise an error).
        drop_degenerate: leave out tets whose volume is zero within rounding, that name a vertex twice, or that came
            before (otherwise an error).
    """

    vertices: Array
    tets: Index
    fill: Array | None
    regions: Index | None
    embedding: Embedding | None
    flipped: int

    @check_arguments("TetMesh")
    def __init__(
        self,
        vertices: Numbers,
        tets: Numbers,
        *,
        fill: Numbers | None = None,
        regions: Numbers | None = None,
        drop_unreferenced: bool = False,
        drop_degenerate: bool = False,
    ) -> None:
        fields = clean_tets(
            vertices, tets, fill, regions, drop_unreferenced=drop_unreferenced, drop_degenerate=drop_degenerate
        )
        store(self, **fields, embedding=None)
        report_faces(self.vertices, self.tets)

    @classmethod
    def from_file(cls, path: PathLike, *, unit: Unit | None = None, drop_degenerate: bool = False) -> TetMesh:
        """Read a volume mesh (.mesh, .msh, .vtk, .vtu, .inp, ...).

        Hexahedra, wedges and pyramids are split into tets that fill them and match across faces; of cells of higher
        order the corners are kept. Triangles of the file, the outer surface or another one inside, are carried along as
        `embedding`; quads and polygons are split. Physical groups, references, element sets and attributes become
        `regions`. What is left out, split or assumed a `MeshWarning` says.

        Args:
            path: the file; the suffix of its name says in which format it is.
            unit: "m", "cm", "mm", "in" or "ft", of the numbers in the file; they become metres. None: what the file
                declares, or metres.
            drop_degenerate: as for a new mesh.

        Raises:
            ValueError: the file cannot be read, or holds no such cells; with its name, its format and what was met.
        """
        from .embedding import embed, embed_triangles

        body = read_body("TetMesh.from_file", path, unit)
        if body.notes:
            warn(f"TetMesh.from_file: {Path(path).name}: {'; '.join(body.notes)}")
        with naming("TetMesh.from_file", path):
            mesh = cls(
                body.points, body.tets, regions=body.regions, drop_unreferenced=True, drop_degenerate=drop_degenerate
            )
        triangles = body.triangles[~has_repeated_corner(body.triangles)]
        if not len(triangles):
            return mesh
        used = np.unique(body.tets)
        if len(mesh.vertices) == len(used):
            return mesh.with_embedding(embed_triangles(mesh, np.searchsorted(used, triangles)))
        # tets without volume went, and vertices with them, so that some triangles hang on others
        return mesh.with_embedding(embed(TriMesh(body.points, triangles, drop_unreferenced=True), mesh))

    def to_file(self, path: PathLike) -> None:
        """Write in the format of the file's suffix (.mesh, .msh, .vtk, .vtu, ...) through meshio.

        Vertices and tets, and regions where the format has room for them, as those four do. What is left out a
        `MeshWarning` says: regions elsewhere, an embedded surface and the fill.
        """
        file, with_regions = write_tets(path, self.vertices, self.tets, self.regions)
        parts = {"the embedded surface": self.embedding, "the fill": self.fill}
        lost = [name for name, part in parts.items() if part is not None]
        if lost:
            warn(
                f"TetMesh.to_file: {file.name} is without {' and '.join(lost)}, for which mesh files have no place; "
                "Simulator.save keeps them, and mesh.embedding.surface.to_file(...) writes a surface"
            )
        if self.regions is not None and not with_regions:
            warn(f"TetMesh.to_file: {file.name} is without the regions; .mesh, .msh, .vtk and .vtu keep them")

    @property
    def bounds(self) -> Array:
        """Lower and upper corner of the bounding box [2, 3]."""
        return np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    def boundary(self) -> Index:
        """The faces that belong to one tet only, int64 [T, 3] into `vertices`, counter-clockwise seen from outside."""
        order, begins = match_faces(self.tets)
        ends = np.append(begins[1:], True)
        return np.asarray(self.tets[:, TET_FACES].reshape(-1, 3)[np.sort(order[begins & ends])])

    def quality(self) -> MeshQuality:
        """Volumes, dihedral angles and element bounds l_e of every tet; print it for a summary."""
        return measure_quality(self.vertices, self.tets, self.fill)

    def with_embedding(self, embedding: Embedding | None) -> TetMesh:
        """The same mesh carrying another surface along (or none)."""
        if embedding is not None and not (
            embedding.vertex_count == len(self.vertices)
            and embedding.tets.max(initial=-1) < len(self.tets)
            and np.array_equal(embedding.corners, self.tets[embedding.tets])
        ):
            raise ValueError(
                "TetMesh.with_embedding: the embedding must belong to this mesh (its corners are the rows of tets that "
                "it names); make one with torchpd.embed(surface, mesh)"
            )
        mesh: TetMesh = object.__new__(TetMesh)
        store(mesh, **(vars(self) | {"embedding": embedding}))
        return mesh

    def merged(self, tolerance: float | None = None, *, drop_degenerate: bool = False) -> TetMesh:
        """The mesh with vertices at the same place made one, the first of them, so that tets that meet there share it.

        Args:
            tolerance: vertices that hang together by distances up to this [m] become one; None is 4.8e-7 of the
                diagonal of the bounding box, a few roundings of float32.
            drop_degenerate: as for a new mesh: leave out tets that lose their volume, or that come twice.

        Raises:
            ValueError: tets that lose their volume, or that come twice.
        """
        reach = ROUNDING * float(np.linalg.norm(np.ptp(self.vertices, axis=0)))
        if tolerance is not None:
            reach = check_scalar("TetMesh.merged: tolerance", tolerance, minimum=0.0)
        kept, numbers = np.unique(merge_near(self.vertices, reach), return_inverse=True)
        mesh = TetMesh(
            self.vertices[kept],
            numbers[self.tets],
            fill=self.fill,
            regions=self.regions,
            drop_unreferenced=True,
            drop_degenerate=drop_degenerate,
        )
        if self.embedding is None:
            return mesh
        if len(mesh.tets) == len(self.tets) and not mesh.flipped:
            return mesh.with_embedding(self.embedding.renumbered(mesh.tets, len(mesh.vertices)))
        from .embedding import embed

        return mesh.with_embedding(embed(self.embedding.surface, mesh))

    def transformed(self, matrix: Numbers) -> TetMesh:
        """The mesh and its embedded surface under x -> A x + b, from a 3x3 or 4x4 matrix; it may reflect."""
        linear, offset = affine("TetMesh.transformed: matrix", matrix)
        # A reflection inverts every tet: two corners change places, and with them their weights.
        corners = [0, 1, 3, 2] if np.linalg.det(linear) < 0 else [0, 1, 2, 3]
        mesh = trusted(self.vertices @ linear.T + offset, self.tets[:, corners], self.fill, self.regions)
        if self.embedding is None:
            return mesh
        return mesh.with_embedding(self.embedding.transformed(matrix, corners))

    def translated(self, offset: Numbers) -> TetMesh:
        """The mesh and its embedded surface moved by a vector [m]."""
        return self.transformed(translation("TetMesh.translated: offset", offset))

    def scaled(self, factor: float | Numbers) -> TetMesh:
        """The mesh and its embedded surface scaled about the origin, by one positive factor or one per axis."""
        return self.transformed(scaling("TetMesh.scaled: factor", factor))

    def __repr__(self) -> str:
        carried = "" if self.embedding is None else f", carrying {self.embedding.surface}"
        filled = ""
        if self.fill is not None:
            volumes = determinants(self.vertices, self.tets)
            filled = f", {float((self.fill * volumes).sum() / volumes.sum()):.0%} filled"
        return f"TetMesh({len(self.vertices)} vertices, {len(self.tets)} tets{filled}{carried})"


def trusted(vertices: Numbers, tets: Numbers, fill: Numbers | None = None, regions: Numbers | None = None) -> TetMesh:
    """A mesh whose tets may meet as they do: of those that were looked at before, or that torchpd lets overlap."""
    mesh: TetMesh = object.__new__(TetMesh)
    store(mesh, **clean_tets(vertices, tets, fill, regions), embedding=None)
    return mesh
