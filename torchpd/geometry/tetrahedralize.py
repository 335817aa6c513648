"""Fill a surface with tetrahedra: a lattice around any triangle soup, or fTetWild through the package pytetwild."""

from __future__ import annotations

import os
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from tqdm.auto import tqdm

from ..common.checks import check_scalar
from ..common.synonyms import check_arguments
from ..common.units import Unit
from .bcc_lattice import Lattice
from .embedding import Embedding
from .mesh_checks import warn
from .mesh_faces import TET_FACES, match_faces
from .occupancy import MIN_FILL, Parts, inside_share, parts_of
from .tet_mesh import TetMesh, embed
from .tri_mesh import TriMesh

__all__ = ["tetrahedralize"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Vertices at open edges closer than this many cells count as one.
_SEAM = 0.25
# A material fraction within the rounding of zero.
_HOLLOW = 1e-4


@check_arguments("tetrahedralize")
def tetrahedralize(
    surface: Any,
    cells: int = 20,
    method: Literal["lattice", "tetwild"] = "lattice",
    progress: bool = False,
    *,
    fill_holes: bool = True,
    unit: Unit | None = None,
) -> TetMesh:
    """Fill a surface with tetrahedra; the result carries the surface as `mesh.embedding`.

    "lattice" takes any triangles: open, in pieces, self-intersecting, with either winding. It keeps the tets of a
    body-centred cubic lattice that the surface intersects or encloses. All tets are congruent and well shaped. The mesh
    reaches beyond the surface by up to one cell, and parts less than about a cell apart are joined. Cavities are
    filled.

    Repairs of "lattice": corners at open edges count as one within a quarter of a cell and half of their edges.
    Triangles that come from both sides count once. Cones close holes, with a `MeshWarning`. A sheet, or a surface that
    stays open, encloses nothing; another warning reports it. Parts of the mesh that share only an edge or a vertex are
    separated there.

    `mesh.fill` is the fraction of each tet inside the surface. `Solid` multiplies density and Young's modulus by it. So
    a body has the mass of the enclosed volume (to 2 % and less; 3 % if it is about one cell thick) and about its
    stiffness. Fractions are at least 0.05, for the solvers, and the stiffness of a tet is at least a tenth of full.
    The tets that a sheet passes are full. For full tets everywhere, leave the fractions out: `TetMesh(mesh.vertices,
    mesh.tets).with_embedding(mesh.embedding)`.

    "tetwild" follows the surface closely with tets of varying shape; it needs the package pytetwild.

    Args:
        surface: a TriMesh, a trimesh.Trimesh or trimesh.Scene, or the path of a file (see `TriMesh.from_file`).
        cells: cells along the longest side of the bounding box; for "tetwild" the target edge length is a cell.
        method: "lattice" or "tetwild".
        progress: show a progress bar.
        fill_holes: "lattice" counts the space behind a hole as inside, up to a cone over the open edges. False leaves
            all space reachable from outside empty: an open surface becomes a shell.
        unit: "m", "cm", "mm", "in" or "ft", the unit of a file or a trimesh, see `TriMesh.from_file`. A TriMesh is in
            metres.
    """
    triangles = _as_surface(surface, unit)
    if check_scalar("tetrahedralize: cells", cells, minimum=1) != int(cells):
        raise ValueError(f"tetrahedralize: cells must be a whole number, got {cells}")
    low, high = triangles.bounds
    if not (high - low).max() > 0:
        raise ValueError("tetrahedralize: surface must have an extent, got all vertices in one point")
    if method == "lattice":
        return _fill_lattice(triangles, Lattice.around(low, high, int(cells)), progress=progress, fill_holes=fill_holes)
    if method == "tetwild":
        return _fill_tetwild(triangles, float((high - low).max()) / int(cells))
    raise ValueError(f'tetrahedralize: method must be "lattice" or "tetwild", got {method!r}')


def _as_surface(surface: Any, unit: Unit | None) -> TriMesh:
    if isinstance(surface, TriMesh):
        if unit is not None:
            raise ValueError(f"tetrahedralize: unit must be None for a TriMesh, which is in metres, got {unit!r}")
        return surface
    if isinstance(surface, (str, os.PathLike)):
        return TriMesh.from_file(Path(surface), unit=unit)
    if isinstance(surface, TetMesh):
        raise TypeError("tetrahedralize: surface must be a surface, got a TetMesh, which is already filled")
    import trimesh

    if isinstance(surface, (trimesh.Trimesh, trimesh.Scene)):
        return TriMesh.from_trimesh(surface, unit=unit)
    raise TypeError(
        "tetrahedralize: surface must be a TriMesh, a trimesh.Trimesh or Scene, or a path, "
        f"got {type(surface).__name__}"
    )


def _fill_lattice(surface: TriMesh, lattice: Lattice, *, progress: bool, fill_holes: bool) -> TetMesh:
    def report(kinds: Iterable[int]) -> Iterable[int]:
        return tqdm(kinds, desc="tetrahedralize", disable=not progress, leave=False)

    corners = surface.vertices[surface.triangles]
    walls = lattice.touched(corners, report)
    parts = parts_of(surface, _SEAM * lattice.spacing, fill_holes=fill_holes)
    if len(parts.caps):
        walls |= lattice.touched(parts.caps)
    inner = lattice.enclosed(walls)
    share, solid = inside_share(lattice, parts, walls)
    if fill_holes:
        _report_open(parts, solid, _SEAM * lattice.spacing)
    sheets = np.concatenate([parts.sheets, parts.triangles[~solid[parts.part]]])
    # A sheet has no inside: the tets that it passes are the body.
    whole = inner | lattice.touched(sheets) if len(sheets) else inner
    share[whole] = 1.0
    # Surface tets that the surface only touches from within would add a layer outside.
    hollow = walls & (share < _HOLLOW)
    kept = (walls | inner) & (~hollow | lattice.entered(np.concatenate([corners, parts.caps]), hollow))
    numbers, weights = lattice.locate_among(surface.vertices, kept)
    kept.reshape(-1)[numbers] = True
    chosen = np.flatnonzero(kept)
    vertices, tets = lattice.mesh(chosen)
    source, tets = _split_hinges(tets)
    mesh = TetMesh(vertices[source], tets, fill=np.clip(share.reshape(-1)[chosen], MIN_FILL, 1.0))
    carriers = np.searchsorted(chosen, numbers)
    return mesh.with_embedding(Embedding(surface, carriers, weights, mesh.tets[carriers], len(mesh.vertices)))


def _report_open(parts: Parts, solid: NDArray[np.bool_], tolerance: float) -> None:
    """Warn of sheets, which enclose nothing, and of holes that were closed.

    Args:
        parts: of a surface whose holes are closed.
        solid: mask of parts that enclose a volume [P].
        tolerance: of `parts_of` [m].
    """
    total = parts.own + len(parts.sheets)
    sheets = len(parts.sheets) + int((~solid[parts.part[: parts.own]]).sum())
    count, edges = parts.open_edges
    of_edges = f"{count} of {edges} edges ({100.0 * count / max(edges, 1):.3g} %) belong to one triangle only"
    if sheets:
        warn(
            f"tetrahedralize: {sheets} of {total} triangles are a sheet, open or flat, which encloses nothing; "
            f"{of_edges}. The mesh is full where they pass, about a cell thick, and heavier than a thin sheet. To fill "
            f"an inside, close the surface: corners less than {tolerance:.3g} m and half an edge apart count as one. "
            "Repair wider gaps, or use fewer cells"
        )
    sides = parts.triangles[:, 1:] - parts.triangles[:, :1]
    area = np.where(solid[parts.part], np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1), 0.0)
    cones = area[len(area) - len(parts.caps) :]
    if cones.any():
        holes = len(np.unique(parts.caps[cones > 0, 2], axis=0))
        warn(
            f"tetrahedralize: the surface is open; {of_edges}. Cones over its holes ({holes}) close it, "
            f"{100.0 * cones.sum() / area.sum():.3g} % of the area around the inside. Close the surface, or pass "
            "fill_holes=False for a shell"
        )


def _split_hinges(tets: Index) -> tuple[Index, Index]:
    """Duplicate vertices so that the tets around each vertex are connected by faces.

    Returns the old vertex of each new one, and the tets with new corners. Parts that shared only an edge or a vertex, a
    joint without stiffness, are separated. All other vertices keep their order. Only vertices of boundary faces can be
    such joints.
    """
    order, begins = match_faces(tets)
    shared = np.flatnonzero(~begins)
    lone = begins & np.append(begins[1:], True)
    corners = tets[:, TET_FACES].reshape(-1, 3)
    outer = np.zeros(int(tets.max()) + 1, dtype=bool)
    outer[corners[order[lone]]] = True
    # Nodes are (tet, corner); a shared face joins the nodes of its three vertices across it.
    nodes = (4 * np.arange(len(tets))[:, None, None] + TET_FACES).reshape(-1, 3)
    sides = []
    for face in (order[shared - 1], order[shared]):
        by_vertex = np.argsort(corners[face], axis=1)
        sides.append(np.take_along_axis(nodes[face], by_vertex, axis=1).reshape(-1))
    vertex = tets.reshape(-1)
    at_boundary = outer[vertex[sides[0]]]
    rows, columns = sides[0][at_boundary], sides[1][at_boundary]
    graph = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(tets.size, tets.size))
    fan = connected_components(graph, directed=False)[1].astype(np.int64)
    # An inner vertex has one fan. Keys sort by vertex first, which keeps the order.
    fan[~outer[vertex]] = 0
    keys = vertex * tets.size + fan
    _, first, renumbered = np.unique(keys, return_index=True, return_inverse=True)
    return vertex[first], renumbered.reshape(tets.shape)


def _fill_tetwild(surface: TriMesh, edge_length: float) -> TetMesh:
    try:
        pytetwild = import_module("pytetwild")
    except ImportError as error:
        raise ImportError(
            'tetrahedralize(method="tetwild") needs the optional package pytetwild: pip install "pytetwild[all]" '
            f'(import failed: {error}); method="lattice" needs nothing'
        ) from error
    low, high = surface.bounds
    # fTetWild leaves a file of this name in the working directory: delete it, unless it existed before.
    leftover = Path("__tracked_surface.stl")
    is_ours = not leftover.exists()
    try:
        vertices, tets = pytetwild.tetrahedralize(
            surface.vertices.copy(),
            surface.triangles.astype(np.int32),
            edge_length_fac=edge_length / float(np.linalg.norm(high - low)),
        )
    finally:
        if is_ours:
            leftover.unlink(missing_ok=True)
    # fTetWild lists corners in either order; turning them is no repair to report.
    edges = vertices[tets[:, 1:]] - vertices[tets[:, :1]]
    inverted = np.linalg.det(edges) < 0
    tets = tets.astype(np.int64)
    tets[inverted] = tets[inverted][:, [0, 1, 3, 2]]
    mesh = TetMesh(vertices, tets, drop_unreferenced=True, drop_degenerate=True)
    return mesh.with_embedding(embed(surface, mesh))
