"""Cells of a file as tets and triangles: they fill the cells exactly, and faces between cells match."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from torchpd import TetMesh
from torchpd.formats.content import Cells, MeshContent
from torchpd.formats.split import tets_of, triangles_of

Array = NDArray[np.float64]
Index = NDArray[np.int64]

CUBE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])


def hexahedra(count: int, seed: int) -> tuple[Array, Index]:
    """count^3 cubes of edge 1 whose vertices are numbered at random."""
    rng = np.random.default_rng(seed)
    side = count + 1
    order = rng.permutation(side**3)
    grid = np.array(list(product(range(side), repeat=3)))
    points = np.empty((side**3, 3))
    points[order] = grid
    corners = np.array(list(product(range(count), repeat=3)))[:, None] + CUBE
    return points, order[corners @ [side**2, side, 1]]


def wedges(count: int, seed: int) -> tuple[Array, dict[str, Index]]:
    points, cubes = hexahedra(count, seed)
    return points, {"wedge": np.concatenate([cubes[:, [0, 1, 2, 4, 5, 6]], cubes[:, [0, 2, 3, 4, 6, 7]]])}


def pyramids(count: int, seed: int) -> tuple[Array, dict[str, Index]]:
    """Six pyramids a cube, their tips in its centre."""
    points, cubes = hexahedra(count, seed)
    faces = [[0, 1, 2, 3], [4, 7, 6, 5], [0, 4, 5, 1], [1, 5, 6, 2], [2, 6, 7, 3], [3, 7, 4, 0]]
    tips = np.broadcast_to((len(points) + np.arange(len(cubes)))[:, None, None], (len(cubes), 6, 1))
    cells = np.concatenate([cubes[:, faces], tips], axis=2).reshape(-1, 5)
    return np.concatenate([points, points[cubes].mean(axis=1)]), {"pyramid": cells}


def cubes_only(count: int, seed: int) -> tuple[Array, dict[str, Index]]:
    points, cubes = hexahedra(count, seed)
    return points, {"hexahedron": cubes}


def half_wedges(count: int, seed: int) -> tuple[Array, dict[str, Index]]:
    """A layer of cubes in two is cut into wedges."""
    points, cubes = hexahedra(count, seed)
    cut = cubes[::2]
    return points, {
        "hexahedron": cubes[1::2],
        "wedge": np.concatenate([cut[:, [0, 1, 2, 4, 5, 6]], cut[:, [0, 2, 3, 4, 6, 7]]]),
    }


def content(points: Array, cells: dict[str, Index]) -> MeshContent:
    return MeshContent(points, [Cells(kind, corners) for kind, corners in cells.items()])


def mesh_of(made: MeshContent) -> TetMesh:
    solid = tets_of(made)
    return TetMesh(solid.points, solid.elements, regions=solid.regions)


def volume(mesh: TetMesh) -> float:
    a, b, c, d = (mesh.vertices[mesh.tets[:, k]] for k in range(4))
    return float(np.einsum("ij,ij->", b - a, np.cross(c - a, d - a)) / 6)


@pytest.mark.parametrize(("make", "each"), [(cubes_only, 6), (wedges, 6), (pyramids, 12), (half_wedges, 6)])
@pytest.mark.parametrize("warp", [0.0, 0.1])
def test_cells_are_filled_and_match(
    make: Callable[[int, int], tuple[Array, dict[str, Index]]], each: int, warp: float
) -> None:
    for seed in range(4):
        points, cells = make(3, seed)
        points = points + warp * np.random.default_rng(seed).uniform(-1, 1, points.shape)
        mesh = mesh_of(content(points, cells))
        assert mesh.flipped == 0
        # a cell with its centre has twelve tets instead of six
        assert len(mesh.tets) == each * 27 + 6 * (len(mesh.vertices) - len(points))
        # faces match where only the 54 squares outside are left over, two triangles each
        boundary = mesh.boundary()
        assert len(boundary) == 108
        outside = np.unique(boundary)
        if not warp:
            assert volume(mesh) == pytest.approx(27.0, rel=1e-14)
            assert len(outside) == 56  # 64 grid points but the 8 inside
        corners = mesh.vertices[boundary]
        enclosed = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
        assert volume(mesh) == pytest.approx(enclosed, rel=1e-13)


def test_cells_of_either_orientation_give_upright_tets() -> None:
    points, cubes = hexahedra(2, 0)
    mirrored = cubes[:, [4, 5, 6, 7, 0, 1, 2, 3]]
    mesh = mesh_of(content(points, {"hexahedron": np.concatenate([cubes[:4], mirrored[4:]])}))
    assert mesh.flipped == 0
    assert volume(mesh) == pytest.approx(8.0, rel=1e-14)


@pytest.mark.parametrize("kind", ["hexahedron", "wedge", "pyramid"])
def test_diagonals_of_tets_beside_are_kept(kind: str) -> None:
    # Two tets lie on the face x = 1 of a cell and cut it along either diagonal; corners are numbered in all ways.
    shapes = {
        "hexahedron": (CUBE, [1, 2, 6, 5], 1.0),
        "wedge": (CUBE[[0, 1, 2, 4, 5, 6]], [1, 2, 5, 4], 0.5),
        "pyramid": (np.array([[1, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1], [0, 0, 0]]), [0, 1, 2, 3], 1 / 3),
    }
    places, face, filled = shapes[kind]
    rng = np.random.default_rng(0)
    for turn in (0, 1):
        a, b, c, d = np.roll(face, turn)
        for _ in range(50):
            order = rng.permutation(len(places) + 1)
            points = np.empty((len(order), 3))
            points[order] = np.concatenate([places, [[2.0, 0.4, 0.6]]])
            tip = len(places)
            tets = order[[[a, b, c, tip], [a, c, d, tip]]]
            made = content(points, {"tetra": tets, kind: order[None, : len(places)]})
            solid = tets_of(made)
            mesh = TetMesh(solid.points, solid.elements)
            assert mesh.tets[2:].shape[0] >= 2
            inner = solid.elements[2:]
            parts = solid.points[inner]
            assert np.linalg.det(parts[:, 1:] - parts[:, :1]).sum() / 6 == pytest.approx(filled, rel=1e-14)
            # every face of the two tets on x = 1 is a face of a tet of the cell
            keys = {tuple(sorted(row[list(k)])) for row in inner for k in ([0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3])}
            assert all(tuple(sorted(order[list(side)])) in keys for side in ([a, b, c], [a, c, d]))


def test_a_cell_that_no_corner_can_fill_gets_a_point_in_its_centre() -> None:
    # Tets beside prescribe three diagonals of a wedge that go round it: Schönhardt's prism.
    wedge = CUBE[[0, 1, 3, 4, 5, 7]].astype(float)
    quads, tets = [[0, 1, 4, 3], [1, 2, 5, 4], [2, 0, 3, 5]], []
    points = [*wedge]
    for a, b, c, d in quads:
        centre = wedge[[a, b, c, d]].mean(axis=0)
        points.append(centre + (centre - wedge.mean(axis=0)))
        tip = len(points) - 1
        tets += [[a, b, c, tip], [a, c, d, tip]]
    solid = tets_of(content(np.array(points), {"wedge": np.arange(6)[None], "tetra": np.array(tets)}))
    assert len(solid.points) == len(points) + 1
    inner = solid.points[solid.elements[: len(solid.elements) - 6]]
    determinants = np.linalg.det(inner[:, 1:] - inner[:, :1])
    assert (determinants > 0).all()
    assert determinants.sum() / 6 == pytest.approx(0.5, rel=1e-14)


def test_collapsed_cells_lose_only_what_has_no_volume() -> None:
    # a cube one edge of which has shrunk to a vertex, as many meshers write a wedge
    points, cubes = hexahedra(1, 0)
    corners = cubes[:, [0, 1, 2, 2, 4, 5, 6, 6]]
    assert volume(
        mesh_of(
            content(
                points[np.unique(corners)], {"hexahedron": np.unique(corners, return_inverse=True)[1].reshape(1, 8)}
            )
        )
    ) == pytest.approx(0.5)


def test_a_folded_cell_is_said() -> None:
    points = CUBE.astype(float)
    points[6] = [-1.0, -1.0, -1.0]
    assert "1 of the cells that became tets are folded" in " ".join(
        tets_of(content(points, {"hexahedron": np.arange(8)[None]})).notes
    )


def test_regions_follow_their_cells() -> None:
    points, cubes = hexahedra(2, 1)
    cells = [Cells("hexahedron", cubes[:3], None, np.array([7, 8, 9])), Cells("hexahedron", cubes[3:])]
    solid = tets_of(MeshContent(points, cells))
    assert solid.regions is not None
    assert solid.regions.tolist() == [*[7] * 6, *[8] * 6, *[9] * 6, *[0] * 30]


def test_what_is_left_out_is_named_and_edges_of_cells_are_not() -> None:
    points, cubes = hexahedra(1, 0)
    points = np.concatenate([points, [[5.0, 5, 5], [6, 6, 6]]])
    cells = [
        Cells("hexahedron", cubes),
        Cells("line", cubes[:, :2]),
        Cells("vertex", cubes[:, :1]),
        Cells("line", np.array([[8, 9]])),
        Cells("polyhedron", cubes.reshape(-1), np.array([8])),
    ]
    notes = " ".join(tets_of(MeshContent(points, cells)).notes)
    assert "1 line left out" in notes
    assert "1 polyhedron left out, 1 m^3" in notes
    assert "vert" not in notes


# Polygons:


def area(points: Array, triangles: Index) -> Array:
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a) / 2


@pytest.mark.parametrize(
    ("outline", "size"),
    [
        ([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], 3.0),  # an L
        ([[0, 0], [4, 0], [4, 4], [3, 4], [3, 1], [1, 1], [1, 4], [0, 4]], 10.0),  # a U
        ([[0, 0], [2, 1], [0, 2], [0.5, 1]], 1.5),  # a quad with a corner that turns in
        ([[0, 0], [1, 0], [2, 0], [2, 2], [0, 2]], 4.0),  # a corner on an edge
    ],
)
def test_polygons_are_covered_once(outline: list[list[float]], size: float) -> None:
    for start in range(len(outline)):
        flat = np.roll(np.array(outline, dtype=float), start, axis=0)
        turned = np.column_stack([flat, flat @ [0.3, -0.2]])  # any plane
        kind = "quad" if len(flat) == 4 else "polygon"
        corners = np.arange(len(flat))
        block = Cells(kind, corners[None]) if kind == "quad" else Cells(kind, corners, np.array([len(flat)]))
        made = triangles_of(MeshContent(turned, [block]))
        across = area(turned, made.elements)
        assert len(made.elements) == len(flat) - 2
        assert np.abs(across[:, 2]).sum() == pytest.approx(size, rel=1e-12)
        assert across[:, 2].sum() == pytest.approx(size, rel=1e-12)
        assert not made.notes


def test_polygons_that_cross_themselves_are_said() -> None:
    points = np.array([[0.0, 0, 0], [3, 2, 0], [3, 0, 0], [0, 1, 0]])
    made = triangles_of(MeshContent(points, [Cells("polygon", np.array([0, 1, 2, 3, 0, 1]), np.array([4, 2]))]))
    assert "1 polygons of fewer than three corners" in made.notes[0]
    assert "1 polygons cross themselves" in made.notes[1]


def test_quads_around_hexahedra_are_cut_as_these_are() -> None:
    points, cubes = hexahedra(2, 3)
    quads = cubes[:, [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]].reshape(
        -1, 4
    )
    outside = quads[[(np.sort(quads, axis=1) == np.sort(q)).all(axis=1).sum() == 1 for q in quads]]
    made = content(points, {"hexahedron": cubes, "quad": outside})
    mine = {tuple(sorted(row)) for row in triangles_of(made).elements.tolist()}
    assert mine == {tuple(sorted(row)) for row in mesh_of(made).boundary().tolist()}
