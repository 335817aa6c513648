"""Tetrahedral meshes: immutable, and checked once on creation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..common.checks import check_scalar
from ..common.synonyms import check_arguments
from ..common.units import Unit
from ..formats.bodies import read_body
from ..formats.guard import name_file_in_errors
from .embedding import Embedding, embed_in_sheet, embed_surface, embed_triangles
from .mesh_checks import (
    MeshWarning,
    Numbers,
    affine,
    clean_tets,
    determinants,
    has_repeated_corner,
    scaling,
    set_frozen,
    translation,
    warn,
)
from .mesh_faces import ROUNDING, TET_FACES, match_faces, merge_near, report_faces
from .mesh_files import write_tets
from .mesh_quality import MeshQuality, measure_quality
from .tri_mesh import PathLike, TriMesh

__all__ = ["MeshWarning", "TetMesh", "embed", "without_face_checks"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False, repr=False)
class TetMesh:
    """A tetrahedral mesh. Every tet has positive volume: det(x1 - x0, x2 - x0, x3 - x0) > 0.

    Tets with the opposite winding are turned: their last two corners change places. A `MeshWarning` reports them, and
    `flipped` counts them. Other warnings report unusual contacts of tets:

    - Inner faces have both tets on one side (a folded mesh).
    - A face belongs to three or more tets.
    - Faces coincide without common vertices, see `merged`.
    - Faces coincide with faces of other corners.

    Separate components are no fault; `quality()` counts them. Arrays are NumPy's and read-only.
    `torch.tensor(mesh.vertices)` copies one without a warning, where `torch.from_numpy` warns.

    Args:
        vertices: positions [V, 3] in m.
        tets: vertex numbers [E, 4].
        fill: material fraction of each tet in (0, 1] [E], or None for full tets. The lattice of `tetrahedralize`
            reaches beyond its surface. `Solid` multiplies density and Young's modulus by it.
        regions: whole number of the region of each tet [E], or None. A stiffness per region is `Solid(mesh,
            youngs=np.where(mesh.regions == 2, 1e6, 1e5))`.
        drop_unreferenced: drop vertices that no tet uses (otherwise an error).
        drop_degenerate: drop tets of zero volume within rounding, with a repeated vertex, or that come twice (otherwise
            an error).
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
        set_frozen(self, **fields, embedding=None)
        report_faces(self.vertices, self.tets)

    @classmethod
    def from_file(cls, path: PathLike, *, unit: Unit | None = None, drop_degenerate: bool = False) -> TetMesh:
        """Read a volume mesh (.mesh, .msh, .vtk, .vtu, .inp, ...).

        Hexahedra, wedges and pyramids are split into tets that fill them and match across faces. Cells of higher order
        keep their corners. Triangles of the file, on the outer surface or inside, become the `embedding`; quads and
        polygons are split. Physical groups, references, element sets and attributes become `regions`. A `MeshWarning`
        lists every omission, split and assumption.

        Args:
            path: the file; its suffix selects the format.
            unit: "m", "cm", "mm", "in" or "ft", the unit of the numbers in the file, which are converted to metres.
                None: the unit that the file declares, or metres.
            drop_degenerate: as for a new mesh.

        Raises:
            ValueError: the file cannot be read, or holds no such cells; the error gives its name, its format and the
                cause.
        """
        body = read_body("TetMesh.from_file", path, unit)
        if body.notes:
            warn(f"TetMesh.from_file: {Path(path).name}: {'; '.join(body.notes)}")
        with name_file_in_errors("TetMesh.from_file", path):
            mesh = cls(
                body.points, body.tets, regions=body.regions, drop_unreferenced=True, drop_degenerate=drop_degenerate
            )
        triangles = body.triangles[~has_repeated_corner(body.triangles)]
        if not len(triangles):
            return mesh
        used = np.unique(body.tets)
        if len(mesh.vertices) == len(used):
            return mesh.with_embedding(embed_triangles(mesh.vertices, mesh.tets, np.searchsorted(used, triangles)))
        # dropping flat tets also dropped vertices, so some triangles need another tet
        return mesh.with_embedding(embed(TriMesh(body.points, triangles, drop_unreferenced=True), mesh))

    def to_file(self, path: PathLike) -> None:
        """Write the mesh in the format of the file's suffix (.mesh, .msh, .vtk, .vtu, ...) through meshio.

        The file holds vertices and tets, and regions in formats that store them, such as those four. A `MeshWarning`
        lists the omissions: regions elsewhere, an embedded surface and the fill.
        """
        file, with_regions = write_tets(path, self.vertices, self.tets, self.regions)
        parts = {"the embedded surface": self.embedding, "the fill": self.fill}
        lost = [name for name, part in parts.items() if part is not None]
        if lost:
            warn(
                f"TetMesh.to_file: {file.name} omits {' and '.join(lost)}, which mesh files cannot hold; "
                "Simulator.save keeps them, and mesh.embedding.surface.to_file(...) writes a surface"
            )
        if self.regions is not None and not with_regions:
            warn(f"TetMesh.to_file: {file.name} omits the regions; .mesh, .msh, .vtk and .vtu hold them")

    @property
    def bounds(self) -> Array:
        """Lower and upper corner of the bounding box [2, 3]."""
        return np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    def boundary(self) -> Index:
        """Boundary faces, int64 [T, 3] into `vertices`, counter-clockwise seen from outside: those of one tet only."""
        order, begins = match_faces(self.tets)
        ends = np.append(begins[1:], True)
        return np.asarray(self.tets[:, TET_FACES].reshape(-1, 3)[np.sort(order[begins & ends])])

    def quality(self) -> MeshQuality:
        """Volumes, dihedral angles and element bounds l_e of every tet; print it for a summary."""
        return measure_quality(self.vertices, self.tets, self.fill)

    def with_embedding(self, embedding: Embedding | None) -> TetMesh:
        """Copy of the mesh with another embedded surface, or without one."""
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
        set_frozen(mesh, **(vars(self) | {"embedding": embedding}))
        return mesh

    def merged(self, tolerance: float | None = None, *, drop_degenerate: bool = False) -> TetMesh:
        """Copy of the mesh in which coincident vertices are one, so that adjacent tets share them.

        The first vertex of each group stays.

        Args:
            tolerance: vertices connected by distances up to this [m] become one. None: 4.8e-7 of the bounding box
                diagonal, a few roundings of float32.
            drop_degenerate: as for a new mesh: drop tets that lose their volume, or that come twice.

        Raises:
            ValueError: tets lose their volume, or come twice.
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
        return mesh.with_embedding(embed(self.embedding.surface, mesh))

    def transformed(self, matrix: Numbers) -> TetMesh:
        """Transform the mesh and its embedded surface by x -> A x + b, from a 3x3 or 4x4 matrix; it may reflect."""
        linear, offset = affine("TetMesh.transformed: matrix", matrix)
        # A reflection inverts every tet: two corners and their weights change places.
        corners = [0, 1, 3, 2] if np.linalg.det(linear) < 0 else [0, 1, 2, 3]
        mesh = without_face_checks(self.vertices @ linear.T + offset, self.tets[:, corners], self.fill, self.regions)
        if self.embedding is None:
            return mesh
        return mesh.with_embedding(self.embedding.transformed(matrix, corners))

    def translated(self, offset: Numbers) -> TetMesh:
        """Translate the mesh and its embedded surface by a vector [m]."""
        return self.transformed(translation("TetMesh.translated: offset", offset))

    def scaled(self, factor: float | Numbers) -> TetMesh:
        """Scale the mesh and its embedded surface about the origin, by one positive factor or one per axis."""
        return self.transformed(scaling("TetMesh.scaled: factor", factor))

    def __repr__(self) -> str:
        carried = "" if self.embedding is None else f", carrying {self.embedding.surface}"
        filled = ""
        if self.fill is not None:
            volumes = determinants(self.vertices, self.tets)
            filled = f", {float((self.fill * volumes).sum() / volumes.sum()):.0%} filled"
        return f"TetMesh({len(self.vertices)} vertices, {len(self.tets)} tets{filled}{carried})"


def without_face_checks(
    vertices: Numbers, tets: Numbers, fill: Numbers | None = None, regions: Numbers | None = None
) -> TetMesh:
    """Mesh without the check of its faces, for tets that were checked before or may overlap."""
    mesh: TetMesh = object.__new__(TetMesh)
    set_frozen(mesh, **clean_tets(vertices, tets, fill, regions), embedding=None)
    return mesh


def embed(surface: TriMesh, mesh: TetMesh | TriMesh) -> Embedding:
    """Embed a surface in a tetrahedral mesh or a sheet, for a finer surface than the simulated one.

    In a tetrahedral mesh each vertex lies in the tet that contains it, or else in the nearest one. A vertex outside of
    the mesh is extrapolated, with negative weights. A strain of the tet moves a distant vertex by more than the strain.
    A `MeshWarning` reports vertices farther outside than their tet is long.

    On a sheet each vertex moves with the closest point of the triangles, and loses its distance to it. A `MeshWarning`
    reports vertices that lie farther off than a tenth of an edge.
    """
    if not isinstance(surface, TriMesh):
        raise TypeError(f"embed: surface must be a TriMesh, got {type(surface).__name__}")
    if isinstance(mesh, TriMesh):
        return embed_in_sheet(surface, mesh.vertices, mesh.triangles)
    if not isinstance(mesh, TetMesh):
        raise TypeError(f"embed: mesh must be a TetMesh, or a TriMesh such as cloth.surface, got {type(mesh).__name__}")
    return embed_surface(surface, mesh.vertices, mesh.tets)
