"""Tets that cannot meet as they do are said, with their number; sound meshes stay silent."""

from __future__ import annotations

import re
import warnings
from collections import defaultdict
from collections.abc import Callable
from itertools import permutations
from pathlib import Path

import meshio
import numpy as np
import pytest
import trimesh
from mesh_cases import jittered_box, signed_volumes
from numpy.typing import NDArray

import torchpd as pd
from torchpd import MeshWarning, TetMesh, TriMesh
from torchpd.geometry import shapes
from torchpd.geometry.embedding import embed_triangles
from torchpd.geometry.mesh_faces import TET_FACES, count_components, merge_near, sort_faces

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Cells = tuple[Array, Index]

CUBE = shapes.box((1.0, 1.0, 1.0), (1, 1, 1))
BOX = shapes.box((1.0, 1.0, 1.0), (2, 2, 2))
FINE = shapes.box((1.0, 1.0, 1.0), (3, 3, 3))


def said(make: Callable[[], object]) -> list[str]:
    """What is warned of, for a whole run of calls each time."""
    with warnings.catch_warnings(record=True) as messages:
        warnings.simplefilter("always")
        make()
    assert all(message.category is MeshWarning and message.filename == __file__ for message in messages)
    return [str(message.message) for message in messages]


def told(vertices: Array, tets: Index) -> str:
    (message,) = said(lambda: TetMesh(vertices, tets))
    return message


def loose(mesh: TetMesh) -> Cells:
    """Every tet with corners of its own."""
    return mesh.vertices[mesh.tets].reshape(-1, 3), np.arange(4 * len(mesh.tets)).reshape(-1, 4)


def beside(one: TetMesh, other: TetMesh) -> Cells:
    return np.vstack([one.vertices, other.vertices]), np.vstack([one.tets, other.tets + len(one.vertices)])


def glued(vertices: Array, tets: Index) -> Cells:
    """The same with equal vertices made one."""
    places, numbers = np.unique(np.round(vertices, 9), axis=0, return_inverse=True)
    return places, numbers.reshape(-1)[tets]


def used(mesh: TetMesh, chosen: Index | NDArray[np.bool_]) -> Cells:
    numbers, tets = np.unique(mesh.tets[chosen], return_inverse=True)
    return mesh.vertices[numbers], tets.reshape(-1, 4)


def moved(mesh: TetMesh, place: tuple[float, float, float], to: tuple[float, float, float]) -> Cells:
    """With the vertex next to a place moved."""
    vertices = mesh.vertices.copy()
    vertices[np.linalg.norm(vertices - place, axis=1).argmin()] = to
    return vertices, mesh.tets


def turned(mesh: TetMesh) -> TetMesh:
    """By a quarter about x, and back to where it was: squares are split along their other diagonals."""
    return mesh.transformed(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])).translated((0.0, 1.0, 0.0))


def ring(count: int = 31, turns: int = 10) -> Cells:
    """A ring of tets, each with the next three of its points, whose three strands go into one another."""
    k = np.arange(count)
    around, along = 2.0 * np.pi * turns / count * k, 2.0 * np.pi / count * k
    radius = 3.0 + np.cos(around)
    points = np.stack([radius * np.cos(along), radius * np.sin(along), np.sin(around)], axis=1)
    tets = (k[:, None] + np.arange(4)) % count
    edges = points[tets[:, 1:]] - points[tets[:, :1]]
    tets[np.linalg.det(edges) < 0] = tets[np.linalg.det(edges) < 0][:, [0, 1, 3, 2]]
    return points, tets


# Matching:


@pytest.mark.parametrize("damage", ["none", "folded", "crowded", "loose"])
def test_faces_are_matched_as_a_dictionary_does_it(damage: str) -> None:
    mesh = jittered_box()
    vertices, tets = mesh.vertices, mesh.tets.copy()
    if damage == "folded":
        vertices, tets = moved(mesh, (0.5, 0.4, 0.3), (0.9, 0.7, 0.5))
        tets = tets.copy()
        flip = np.linalg.det(vertices[tets[:, 1:]] - vertices[tets[:, :1]]) < 0
        tets[flip] = tets[flip][:, [0, 1, 3, 2]]
    elif damage == "crowded":
        vertices = np.vstack([vertices, [[9.0, 9.0, 9.0]]])
        tets = np.vstack([tets, [[*tets[40, :3], len(mesh.vertices)], [*tets[0, 1:], len(mesh.vertices)]]])
    elif damage == "loose":
        vertices, tets = loose(mesh)
    # corners in any order that keeps the orientation
    even = np.array([order for order in permutations(range(4)) if np.linalg.det(np.eye(4)[list(order)]) > 0])
    tets = np.take_along_axis(tets, even[np.random.default_rng(3).integers(12, size=len(tets))], axis=1)
    users: dict[frozenset[int], list[tuple[int, bool]]] = defaultdict(list)
    for number, corners in enumerate(tets[:, TET_FACES].reshape(-1, 3).tolist()):
        first = corners.index(min(corners))
        users[frozenset(corners)].append((number, corners[first - 2] < corners[first - 1]))
    faces = sort_faces(tets)
    assert faces.lone.tolist() == sorted(uses[0][0] for uses in users.values() if len(uses) == 1)
    assert faces.crowded == sum(len(uses) > 2 for uses in users.values())
    assert faces.folded == sum(len(uses) == 2 and uses[0][1] == uses[1][1] for uses in users.values())
    assert (faces.folded > 0, faces.crowded > 0) == (damage == "folded", damage == "crowded")


def test_words_that_collide_are_told_apart_by_corners(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = jittered_box()
    right = sort_faces(mesh.tets)
    monkeypatch.setattr(
        "torchpd.geometry.mesh_faces.corner_words", lambda elements: np.zeros(elements.shape, dtype=np.uint64)
    )
    np.testing.assert_array_equal(sort_faces(mesh.tets).lone, right.lone)


def test_near_points_have_the_lowest_number_among_them() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1e-3, 0, 0], [1, 0, 0], [2.0e-3, 0, 0], [0.5, 0, 0]])
    assert merge_near(points, 1.5e-3).tolist() == [0, 1, 0, 1, 0, 5]  # through the one between them
    assert merge_near(points, 0.0).tolist() == [0, 1, 2, 1, 4, 5]


# Sound meshes:

ALONE = CUBE.tets[:1]
SOUND: dict[str, Cells] = {
    "one tet": (CUBE.vertices[ALONE[0]], np.array([[0, 1, 2, 3]])),
    "a thin tet": (np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1e-9]]), np.array([[0, 1, 2, 3]])),
    "a sliver": (np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 1e-9]]), np.array([[0, 1, 2, 3]])),
    "no grid": (jittered_box().vertices, jittered_box().tets),
    "large": (1e30 * BOX.vertices, BOX.tets),
    "small": (1e-30 * BOX.vertices, BOX.tets),
    "pieces apart": beside(CUBE, CUBE.translated((1.001, 0.0, 0.0))),
    "cubes at a vertex": beside(CUBE, CUBE.translated((1.0, 1.0, 1.0))),
    "cubes at an edge": beside(CUBE, CUBE.translated((1.0, 1.0, 0.0))),
    "cubes with a common vertex": glued(*beside(CUBE, CUBE.translated((1.0, 1.0, 1.0)))),
    "cubes with a common edge": glued(*beside(CUBE, CUBE.translated((1.0, 1.0, 0.0)))),
    "a cavity": used(FINE, (np.abs(FINE.vertices[FINE.tets].mean(axis=1) - 0.5) > 1 / 6).any(axis=1)),
    "a tet left out inside": used(FINE, np.arange(len(FINE.tets)) != len(FINE.tets) // 2),
    "a twisted ring": ring(),
    "one inside the other": beside(CUBE.scaled(0.3).translated((3.0, 3.0, 3.0)), CUBE.scaled(0.3)),
}


@pytest.mark.parametrize("name", SOUND)
def test_sound_meshes_are_silent(name: str) -> None:
    assert said(lambda: TetMesh(*SOUND[name])) == []


@pytest.mark.parametrize(
    "surface",
    [shapes.octopus(), TriMesh.from_trimesh(trimesh.creation.torus(1.0, 0.4)), TriMesh(CUBE.vertices, CUBE.boundary())],
)
def test_lattices_are_silent(surface: TriMesh) -> None:
    assert said(lambda: pd.Solid(pd.tetrahedralize(surface, cells=12), youngs=1e5)) == []


# Tets that share no vertices:


@pytest.mark.parametrize("scale", [1.0, 1e30, 1e-30])
@pytest.mark.parametrize("noise", [0.0, 1e-7])
def test_loose_tets_are_counted_and_merged(scale: float, noise: float) -> None:
    """The 48 tets of 8 cubes have 192 faces, 48 of which are the surface."""
    vertices, tets = loose(BOX)
    vertices = scale * (vertices + noise * np.random.default_rng(0).uniform(-1.0, 1.0, vertices.shape))
    message = told(vertices, tets)
    assert "144 of 192 outer faces coincide" in message
    assert "in 48 pieces" in message
    assert message.endswith("which leaves 1")
    assert "mesh.merged()" in message
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mesh = TetMesh(vertices, tets)
    whole = mesh.merged()
    assert said(mesh.merged) == []
    assert (len(whole.vertices), whole.quality().pieces) == (27, 1)
    assert signed_volumes(whole).sum() == pytest.approx(scale**3, rel=10.0 * noise + 1e-13)


def test_merging_keeps_fill_regions_and_the_surface() -> None:
    vertices, tets = loose(BOX)
    share = np.linspace(0.1, 1.0, len(tets))
    with pytest.warns(MeshWarning):
        mesh = TetMesh(vertices, tets, fill=share, regions=np.arange(len(tets)))
    mesh = mesh.with_embedding(pd.embed(TriMesh.from_trimesh(trimesh.creation.icosphere(1, 0.4)).translated(
        (0.5, 0.5, 0.5)), mesh))  # fmt: skip
    whole = mesh.merged()
    np.testing.assert_array_equal(whole.fill, share)
    np.testing.assert_array_equal(whole.regions, np.arange(len(tets)))
    assert whole.embedding is not None
    np.testing.assert_allclose(whole.embedding.apply(whole.vertices), whole.embedding.surface.vertices, atol=1e-15)


def test_the_tolerance_of_merging() -> None:
    """Cubes 1e-3 m apart are two, until vertices that far apart are one."""
    mesh = TetMesh(*beside(CUBE, CUBE.translated((1.001, 0.0, 0.0))))
    assert len(mesh.merged().vertices) == 16
    assert len(mesh.merged(0.99e-3).vertices) == 16
    joined = mesh.merged(1.01e-3)
    assert (len(joined.vertices), joined.quality().pieces) == (12, 1)
    with pytest.raises(ValueError, match=r"TetMesh\.tets: corners .*got \[0, 0, 0, 0\]"):
        mesh.merged(1.2)
    with pytest.raises(ValueError, match=r"TetMesh\.merged: tolerance .*got -1"):
        mesh.merged(-1.0)


def test_a_mesh_that_is_there_twice() -> None:
    message = told(*beside(BOX, BOX))
    assert "96 of 96 outer faces" in message
    assert "in 2 pieces" in message
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        twice = TetMesh(*beside(BOX, BOX))
    twice = twice.with_embedding(embed_triangles(twice.vertices, twice.tets, twice.boundary()[:48]))
    with pytest.raises(
        ValueError, match=r"TetMesh.tets: tets .*got \[0, 9, 12, 13\] .*\(48 in all\).*drop_degenerate=True"
    ):
        twice.merged()
    with pytest.warns(MeshWarning, match="48 of 96 tets come twice"):
        once = twice.merged(drop_degenerate=True)
    np.testing.assert_array_equal(once.tets, BOX.tets)
    assert once.embedding is not None
    np.testing.assert_allclose(once.embedding.apply(once.vertices), once.embedding.surface.vertices, atol=1e-15)


def test_a_cut_in_one_piece_is_said() -> None:
    """Half of a middle plane has its vertices twice: the other half holds the mesh together."""
    tets = BOX.tets.copy()
    plane = np.flatnonzero((BOX.vertices[:, 0] == 0.5) & (BOX.vertices[:, 1] > 0.5))
    right = (BOX.vertices[BOX.tets].mean(axis=1)[:, 0] > 0.5)[:, None] & np.isin(tets, plane)
    tets[right] = 27 + np.searchsorted(plane, tets[right])
    message = told(np.vstack([BOX.vertices, BOX.vertices[plane]]), tets)
    assert re.search(r"\d+ of \d+ outer faces .* in 1 pieces\. .* which leaves 1", message)


# Faces that do not match:

HIGH = CUBE.translated((1.0, 0.0, 0.0))
SHIFTED = CUBE.translated((1.0, 0.5, 0.0))


@pytest.mark.parametrize("joined", [False, True])
@pytest.mark.parametrize(
    ("other", "count", "outer"),
    [
        (turned(HIGH), 4, 24),  # two triangles of a square against its other diagonal
        (BOX.translated((1.0, 0.0, 0.0)), 10, 60),  # two large ones against eight small ones
        (SHIFTED, 2, 24),  # the middles of two lie on others
    ],
)
def test_faces_with_other_corners_are_counted(other: TetMesh, count: int, outer: int, joined: bool) -> None:
    cells = beside(CUBE, other)
    message = told(*(glued(*cells) if joined else cells))
    assert f"{count} of {outer} outer faces lie on faces with other corners" in message
    # rounded as files in float32 are, far from the origin and turned
    turn = trimesh.transformations.rotation_matrix(0.7, [1.0, 2.0, -0.5])[:3, :3]
    vertices, tets = glued(*cells)
    assert f"{count} of {outer}" in told(np.float32(vertices @ turn.T + 1.0).astype(float), tets)


@pytest.mark.parametrize("joined", [False, True])
def test_other_diagonals_of_bent_squares_are_counted_where_tets_overlap(joined: bool) -> None:
    cells = beside(CUBE, turned(HIGH))
    corner = np.flatnonzero((cells[0] == 1.0).all(axis=1))
    for shift, count in ((0.3, 4), (-0.3, 0)):  # the other way there is a gap, as a cavity may be meant
        vertices = cells[0].copy()
        vertices[corner, 0] += shift
        bent = vertices, cells[1]
        messages = said(lambda: TetMesh(*(glued(*bent) if joined else bent)))  # noqa: B023
        assert [f"{count} of 24" in message for message in messages] == [True] * (count > 0)


def test_a_vertex_on_an_edge_is_said() -> None:
    """Of two tets on one side of a face and one on the other."""
    vertices = np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [1, 1, 0], [0, 0, 1], [0, 0, -1]])
    tets = np.array([[0, 1, 2, 4], [0, 3, 1, 5], [0, 2, 3, 5]])
    assert "3 of 10 outer faces lie on faces with other corners" in told(vertices, tets)


def test_a_face_of_three_tets_is_said() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [0.2, 0.2, 2.0]])
    tets = np.array([[0, 1, 2, 3], [0, 2, 1, 4], [0, 1, 2, 5]])
    assert "1 of the faces belong to three tets or more" in told(vertices, tets)


# Folded meshes:


@pytest.mark.parametrize("place", [(0.5, 0.5, 1.2), (0.9, 1.3, 0.5)])
def test_a_folded_mesh_is_said_with_its_volumes(place: tuple[float, float, float]) -> None:
    """The middle vertex is moved outside: what was inside still encloses the cube."""
    vertices, tets = moved(BOX, (0.5, 0.5, 0.5), place)
    volumes = np.linalg.det(vertices[tets[:, 1:]] - vertices[tets[:, :1]]) / 6.0
    assert volumes.sum() == pytest.approx(1.0)
    first, second = said(lambda: TetMesh(vertices, tets))
    assert f"{(volumes < 0).sum()} of 48 tets had inverted winding" in first
    folds = re.search(r"(\d+) of 72 inner faces have both of their tets on one side", second)
    assert folds is not None
    assert f"add up to {np.abs(volumes).sum():.4g} m^3, but enclose 1 m^3" in second
    # between a tet that was turned over and one that was not, by the matching of faces
    faces = np.sort(tets[:, TET_FACES].reshape(-1, 3), axis=1)
    _, number = np.unique(faces, axis=0, return_inverse=True)
    signs = np.bincount(number.reshape(-1), np.repeat(np.sign(volumes), 4))
    assert int(folds[1]) == ((np.bincount(number.reshape(-1)) == 2) & (signs == 0)).sum()


def test_a_mesh_without_a_surface_is_folded() -> None:
    """The five tets of five points: every face has two."""
    vertices = np.vstack([np.eye(3), np.zeros((1, 3)), [[0.2, 0.3, 0.1]]])
    tets = np.array([np.delete(np.arange(5), k) for k in range(5)])
    turned_over, folded = said(lambda: TetMesh(vertices, tets))
    assert "had inverted winding" in turned_over
    assert "of 10 inner faces have both of their tets on one side" in folded
    assert "add up to 0.3333 m^3, but enclose" in folded


def test_tets_that_are_all_wound_the_other_way_are_only_turned() -> None:
    for cells in ((BOX.vertices, BOX.tets), ring()):
        messages = said(lambda: TetMesh(cells[0], cells[1][:, [1, 0, 2, 3]]))  # noqa: B023
        assert len(messages) == 1
        assert f"{len(cells[1])} of {len(cells[1])} tets had inverted winding and were turned" in messages[0]


def test_moving_a_mesh_says_nothing_again() -> None:
    with pytest.warns(MeshWarning, match="48 pieces"):
        mesh = TetMesh(*loose(BOX))
    assert said(lambda: mesh.scaled(2.0).translated((1.0, 0.0, 0.0)).transformed(np.diag([1.0, -1.0, 1.0]))) == []


def test_pieces_hang_together_by_vertices() -> None:
    assert count_components(np.array([[0, 1, 2, 3], [3, 4, 5, 6], [9, 10, 11, 12]])) == 2


# Files:


def test_a_stray_node_of_a_file_leaves_the_surface_in_place(tmp_path: Path) -> None:
    points = np.vstack([CUBE.vertices[:3], [[9.0, 9, 9]], CUBE.vertices[3:]])
    numbers = np.array([0, 1, 2, 4, 5, 6, 7, 8])
    triangles = np.vstack([numbers[CUBE.boundary()], [[0, 1, 3]]])
    meshio.Mesh(points, [("tetra", numbers[CUBE.tets]), ("triangle", triangles)]).write(tmp_path / "stray.vtu")
    with pytest.warns(MeshWarning, match=r"1 of 13 triangles .*no tet.*left out"):
        mesh = TetMesh.from_file(tmp_path / "stray.vtu")
    assert mesh.embedding is not None
    assert mesh.embedding.surface.volume() == pytest.approx(1.0, rel=1e-14)
