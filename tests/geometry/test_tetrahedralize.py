"""A lattice around any surface: what it keeps, how well it is shaped, and how it carries the surface along."""

from __future__ import annotations

import sys
import types
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from mesh_cases import jittered_box
from scipy.optimize import linprog

from torchpd import Embedding, MeshWarning, TetMesh, TriMesh, embed
from torchpd.geometry import shapes
from torchpd.geometry.bcc_lattice import Lattice, _overlaps
from torchpd.geometry.embedding import _outside
from torchpd.geometry.tetrahedralize import _split_hinges, tetrahedralize


def ball(subdivisions: int = 3) -> TriMesh:
    return TriMesh.from_trimesh(trimesh.creation.icosphere(subdivisions))


def soup(surface: TriMesh, seed: int = 0) -> TriMesh:
    """The same triangles, each by itself and turned either way."""
    corners = surface.vertices[surface.triangles]
    flip = np.random.default_rng(seed).random(len(corners)) < 0.5
    corners[flip] = corners[flip][:, ::-1]
    return TriMesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def without(surface: TriMesh, keep: np.ndarray) -> TriMesh:
    used, numbers = np.unique(surface.triangles[keep], return_inverse=True)
    return TriMesh(surface.vertices[used], numbers.reshape(-1, 3))


def carried(mesh: TetMesh) -> Embedding:
    assert mesh.embedding is not None
    return mesh.embedding


def contains(mesh: TetMesh, points: np.ndarray) -> np.ndarray:
    """Which points lie in the mesh, by its embedding weights."""
    triangles = np.arange(3 * len(points)).reshape(-1, 3)
    corners = np.repeat(points, 3, axis=0)
    return embed(TriMesh(corners, triangles), mesh).weights.min(axis=1)[::3] >= -1e-9


# The lattice:


def test_every_tet_is_the_same_well_shaped_one() -> None:
    mesh = tetrahedralize(ball(), cells=8)
    quality = mesh.quality()
    spacing = 2.0 / 8  # the ball is 2 across
    np.testing.assert_allclose(quality.volumes, spacing**3 / 12, rtol=1e-12)
    np.testing.assert_allclose(quality.min_dihedral, np.pi / 3, atol=1e-12)
    np.testing.assert_allclose(quality.max_dihedral, np.pi / 2, atol=1e-12)
    # Gradients at 90 degrees twice and 120 otherwise: normalised K = I - C/2, C a 4-cycle: largest eigenvalue 2.
    np.testing.assert_allclose(quality.element_bounds, 2.0, atol=1e-12)
    assert mesh.flipped == 0


@pytest.mark.parametrize("cells", [1, 2, 7, 20])
def test_the_mesh_encloses_a_closed_surface_by_less_than_a_cell(cells: int) -> None:
    surface = ball()
    mesh = tetrahedralize(surface, cells=cells)
    spacing = 2.0 / cells
    inner = np.random.default_rng(1).normal(size=(400, 3))
    inner *= (0.99 * np.random.default_rng(2).random(400) ** (1 / 3) / np.linalg.norm(inner, axis=1))[:, None]
    assert contains(mesh, inner).all()
    # A kept tet touches the ball (inside radius 1) and is one cell across.
    assert np.linalg.norm(mesh.vertices, axis=1).max() <= 1.0 + spacing + 1e-9
    assert mesh.quality().pieces == 1


def test_volume_converges_to_the_enclosed_one() -> None:
    surface = ball(4)
    excess = [tetrahedralize(surface, cells=c).quality().volumes.sum() - surface.volume() for c in (8, 16, 32)]
    # The layer outside is a fixed part of a cell thick: first order.
    assert excess[0] > excess[1] > excess[2] > 0
    assert 1.5 < excess[0] / excess[1] < 3.0
    assert 1.5 < excess[1] / excess[2] < 3.0


def test_triangles_and_tets_meet_exactly_when_a_common_point_exists() -> None:
    # Oracle: a linear program asks for a point that is a convex combination of both.
    rng = np.random.default_rng(5)
    tet = np.array([[0.5, 0.5, 0.5], [1.5, 0.5, 0.5], [1.0, 1.0, 0.0], [1.0, 1.0, 1.0]])
    triangles = tet.mean(axis=0) + rng.uniform(-1.2, 1.2, (400, 3, 3))
    triangles[::4] = triangles[::4, :1] + 0.05 * (triangles[::4] - triangles[::4, :1])
    found = _overlaps(triangles, tet)
    assert 60 < found.sum() < 340
    for triangle, meets in zip(triangles, found, strict=True):
        equal = np.vstack([np.hstack([triangle.T, -tet.T]), [1, 1, 1, 0, 0, 0, 0], [0, 0, 0, 1, 1, 1, 1]])
        exists = linprog(np.zeros(7), A_eq=equal, b_eq=[0, 0, 0, 1, 1], bounds=(0, 1)).status == 0
        assert exists == meets


def test_touching_counts_as_meeting() -> None:
    tet = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    point = np.array([[1.0, 0, 0], [2, 0, 0], [2, 1, 0]])
    edge = np.array([[0.0, -1, 0], [0, 2, 0], [-1, 0, 0]])
    face = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0.5, 0]]) - [0, 0, 1e-12]
    apart = point + [1e-6, 0, 0]
    np.testing.assert_array_equal(_overlaps(np.stack([point, edge, face, apart]), tet), [True, True, True, False])


def test_points_are_located_in_the_tet_around_them() -> None:
    lattice = Lattice(origin=np.array([-1.0, 2.0, 0.5]), spacing=0.25, shape=(6, 7, 5))
    rng = np.random.default_rng(0)
    points = lattice.origin + lattice.spacing * rng.uniform(1.0, np.array(lattice.shape) - 1.0, (500, 3))
    points[:100] = lattice.origin + 0.5 * lattice.spacing * rng.integers(2, 8, (100, 3))  # on vertices, edges, faces
    numbers, weights = lattice.locate(points)
    vertices, tets = lattice.mesh(numbers)
    assert weights.min() >= 0.0
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(np.einsum("na,nak->nk", weights, vertices[tets]), points, atol=1e-14)


def test_all_tets_fill_the_lattice_up_to_its_outer_half_pyramids() -> None:
    lattice = Lattice(origin=np.zeros(3), spacing=1.0, shape=(4, 3, 2))
    vertices, tets = lattice.mesh(lattice.all_tets())
    inner_squares = 3 * 3 * 2 + 4 * 2 * 2 + 4 * 3 * 1
    assert len(tets) == 4 * inner_squares
    quality = TetMesh(vertices, tets).quality()
    assert quality.volumes.sum() == pytest.approx(inner_squares / 3, rel=1e-13)  # two pyramids of 1/6 a square


# Any soup:


def test_a_soup_gives_the_same_mesh_as_the_surface_it_came_from() -> None:
    surface = TriMesh.from_trimesh(trimesh.creation.torus(1.0, 0.4))
    one, other = tetrahedralize(surface, cells=12), tetrahedralize(soup(surface), cells=12)
    np.testing.assert_array_equal(one.tets, other.tets)
    np.testing.assert_array_equal(one.vertices, other.vertices)
    # And a torus stays a torus: V - E + F of the boundary is 0.
    boundary = one.boundary()
    edges = np.unique(np.sort(boundary[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    assert len(np.unique(boundary)) - len(edges) + len(boundary) == 0


@pytest.mark.filterwarnings("ignore:(tetrahedralize|embed)")
def test_holes_are_filled_unless_asked_not_to() -> None:
    surface = ball()
    centres = surface.vertices[surface.triangles].mean(axis=1)
    opened = without(surface, centres[:, 1] > -0.6)
    whole = tetrahedralize(opened, cells=16)
    shell = tetrahedralize(opened, cells=16, fill_holes=False)
    probes = np.array([[0.0, 0, 0], [0, 0.4, 0], [0.3, -0.3, 0], [0, -0.5, 0]])
    assert contains(whole, probes).all()
    assert not contains(shell, probes).any()
    # The cap is the flat disc over the hole: nothing reaches further down than the surface does, by more than a cell.
    assert whole.vertices[:, 1].min() > opened.vertices[:, 1].min() - 2.0 / 16
    # The shell still carries the whole surface.
    np.testing.assert_allclose(carried(shell).apply(shell.vertices), opened.vertices, atol=1e-13)


def test_gaps_below_a_cell_do_not_leak() -> None:
    # Six sides of a cube that do not quite meet: 2 % of a side apart, at cells of 10 %.
    faces = trimesh.creation.box((1, 1, 1))
    pieces = [without(TriMesh.from_trimesh(faces), np.abs(faces.face_normals @ axis - 1) < 0.1)
              for axis in np.vstack([np.eye(3), -np.eye(3)])]  # fmt: skip
    spread = [piece.translated(0.02 * piece.vertices.mean(axis=0) / 0.5) for piece in pieces]
    corners = np.concatenate([piece.vertices[piece.triangles] for piece in spread]).reshape(-1, 3)
    mesh = tetrahedralize(TriMesh(corners, np.arange(len(corners)).reshape(-1, 3)), cells=10, fill_holes=False)
    assert contains(mesh, np.random.default_rng(0).uniform(-0.4, 0.4, (50, 3))).all()


def test_cavities_are_filled() -> None:
    outer, inner = ball(), ball().scaled(0.4)
    count = len(outer.vertices)
    both = TriMesh(np.vstack([outer.vertices, inner.vertices]), np.vstack([outer.triangles, inner.triangles + count]))
    assert contains(tetrahedralize(both, cells=20), np.zeros((1, 3))).all()


@pytest.mark.filterwarnings("ignore:(tetrahedralize|embed)")
@pytest.mark.parametrize(
    "corners",
    [
        [[0.0, 0, 0], [1, 0, 0], [0, 1, 0]],
        [[0.0, 0, 0], [1, 1, 1], [0.5, 0.5, 0.5]],  # no area
        [[1e4, 1e4, 1e4], [1e4 + 1e-3, 1e4, 1e4], [1e4, 1e4 + 1e-3, 1e4]],  # small and far away
    ],
)
def test_a_single_triangle_gets_a_hull(corners: list[list[float]]) -> None:
    mesh = tetrahedralize(TriMesh(corners, [[0, 1, 2]]), cells=5)
    np.testing.assert_allclose(carried(mesh).apply(mesh.vertices), corners, rtol=1e-14, atol=1e-14)
    assert mesh.quality().pieces == 1


def test_parts_that_touch_in_a_point_or_an_edge_come_apart() -> None:
    # Two cubes of a grid that share an edge, and two that share a vertex; and two that share a face, which stay.
    grid = shapes.box((3.0, 3.0, 3.0), (3, 3, 3))
    cell = np.arange(27).reshape(3, 3, 3)

    def cubes(*places: tuple[int, int, int]) -> np.ndarray:
        return np.concatenate([grid.tets[6 * cell[place] : 6 * cell[place] + 6] for place in places])

    for second, shared in (((1, 1, 0), 2), ((1, 1, 1), 1), ((1, 0, 0), 0)):
        tets = cubes((0, 0, 0), second)
        source, split = _split_hinges(tets)
        before, after = len(np.unique(tets)), len(np.unique(split))
        assert after - before == shared
        np.testing.assert_array_equal(source[split], tets)
    # A ring of cubes around an edge is one piece: nothing comes apart, and vertices keep their order.
    tets = cubes((0, 0, 0), (0, 1, 0), (1, 1, 0), (1, 0, 0))
    source, split = _split_hinges(tets)
    np.testing.assert_array_equal(source, np.unique(tets))


@pytest.mark.filterwarnings("ignore:(tetrahedralize|embed)")
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 12))
def test_every_random_soup_is_carried_to_rounding(seed: int, cells: int) -> None:
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-3, 3)
    corners = scale * (rng.uniform(-1, 1, (rng.integers(1, 30), 3, 3)) + rng.uniform(-5, 5, 3))
    surface = TriMesh(corners.reshape(-1, 3), np.arange(corners.size // 3).reshape(-1, 3))
    mesh = tetrahedralize(surface, cells=cells)
    # The weights solve for the place in cells: a rounding of the coordinates (up to 6 scales, in 1/cells) each way.
    np.testing.assert_allclose(carried(mesh).apply(mesh.vertices), surface.vertices, atol=1e-12 * scale)
    assert carried(mesh).weights.min() >= 0.0


# The carried surface:


def test_embedding_reproduces_the_surface_and_affine_motion() -> None:
    surface = TriMesh.from_trimesh(trimesh.creation.torus(1.0, 0.4))
    mesh = tetrahedralize(surface, cells=10)
    embedding = carried(mesh)
    assert embedding.surface is surface
    np.testing.assert_array_equal(embedding.corners, mesh.tets[embedding.tets])
    np.testing.assert_allclose(embedding.apply(mesh.vertices), surface.vertices, atol=1e-12)
    linear, offset = np.random.default_rng(0).normal(size=(3, 3)), np.array([1.0, -2.0, 3.0])
    moved = embedding.apply(mesh.vertices @ linear.T + offset)
    np.testing.assert_allclose(moved, surface.vertices @ linear.T + offset, atol=1e-12)


def test_equal_points_move_alike_so_that_seams_stay_closed() -> None:
    surface = soup(ball(2))
    mesh = tetrahedralize(surface, cells=6)
    positions = mesh.vertices + np.random.default_rng(0).normal(size=mesh.vertices.shape)
    moved = carried(mesh).apply(positions)
    _, first, same = np.unique(surface.vertices, axis=0, return_index=True, return_inverse=True)
    np.testing.assert_array_equal(moved, moved[first][same.reshape(-1)])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_tensors_keep_their_type_batch_and_gradient(dtype: torch.dtype) -> None:
    mesh = tetrahedralize(ball(1), cells=4)
    embedding = carried(mesh)
    positions = torch.tensor(mesh.vertices, dtype=dtype).expand(2, 3, -1, -1).clone().requires_grad_()
    moved = embedding.apply(positions)
    assert moved.shape == (2, 3, len(embedding.tets), 3)
    assert moved.dtype == dtype
    (gradient,) = torch.autograd.grad(moved.sum(), positions)
    # d(sum of surface vertices)/d(vertex) is the sum of its weights.
    expected = np.bincount(embedding.corners.reshape(-1), embedding.weights.reshape(-1), len(mesh.vertices))
    tolerance = 100 * torch.finfo(dtype).eps
    np.testing.assert_allclose(gradient[1, 2].numpy(), np.tile(expected[:, None], 3), atol=tolerance)
    array = embedding.apply(positions.detach().numpy())
    assert array.dtype == positions.detach().numpy().dtype
    np.testing.assert_allclose(array, moved.detach().numpy(), atol=tolerance)


@pytest.mark.filterwarnings("ignore:(tetrahedralize|embed)")
def test_gradients_agree_with_differences() -> None:
    mesh = tetrahedralize(TriMesh([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]), cells=1)
    positions = torch.tensor(mesh.vertices, requires_grad=True)
    assert torch.autograd.gradcheck(carried(mesh).apply, positions)


def test_bad_positions_are_refused() -> None:
    embedding = carried(tetrahedralize(ball(1), cells=3))
    count = embedding.vertex_count
    with pytest.raises(ValueError, match=rf"positions must be \[\.\.\., {count}, 3\].*got \[{count + 1}, 3\]"):
        embedding.apply(np.zeros((count + 1, 3)))
    with pytest.raises(ValueError, match=r"positions .*got \[113\]"):
        embedding.apply(torch.zeros(count))
    with pytest.raises(TypeError, match=r"positions .*got torch\.int64"):
        embedding.apply(torch.zeros(count, 3, dtype=torch.int64))


def test_any_surface_embeds_in_any_mesh() -> None:
    mesh = shapes.box((2.0, 2.0, 2.0), (3, 4, 5))
    inside = ball(2).scaled(0.9).translated((1.0, 1.0, 1.0))
    embedding = embed(inside, mesh)
    np.testing.assert_allclose(embedding.apply(mesh.vertices), inside.vertices, atol=1e-12)
    assert embedding.weights.min() >= -1e-12
    assert mesh.with_embedding(embedding).embedding is embedding
    # Outside vertices are extrapolated, with the rest position still exact.
    outside = inside.translated((0.3, 0.0, 0.0))
    embedding = embed(outside, mesh)
    np.testing.assert_allclose(embedding.apply(mesh.vertices), outside.vertices, atol=1e-12)
    assert embedding.weights.min() < 0


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_surfaces_far_outside_are_said_in_cells(scale: float) -> None:
    """The edges of a box of cubes are at most the diagonals, sqrt(3) / 4 long."""
    mesh = shapes.box((1.0, 1.0, 1.0), (4, 4, 4)).scaled(scale)
    triangle = TriMesh(scale * np.array([[0.5, 0.5, 0.9], [0.4, 0.5, 1.4], [0.6, 0.5, 1.4]]), [[0, 1, 2]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        embed(triangle, mesh)  # 0.92 cells
    with pytest.warns(MeshWarning, match=r"embed: 2 of 3 surface vertices .* up to 2\.08 cells \(0\.\d+ m\)") as said:
        embed(triangle.translated((0.0, 0.0, 0.5 * scale)), mesh)
    assert f"({0.9 * scale:.3g} m)" in str(said[0].message)
    assert said[0].filename == __file__
    # in millimetres, where the mesh is in metres
    with pytest.warns(MeshWarning, match=r"3 of 3 surface vertices"):
        embed(triangle.scaled(1000.0), mesh)


def test_points_outside_go_to_the_nearest_tet() -> None:
    """The distances are those to the surface of the mesh, by another program."""
    mesh = jittered_box()
    rng = np.random.default_rng(2)
    points = mesh.bounds.mean(axis=0) + rng.normal(size=(300, 3)) * [1.0, 0.8, 0.6]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        embedding = embed(TriMesh(points, np.arange(300).reshape(-1, 3)), mesh)
    out = embedding.weights.min(axis=1) < 0.0
    assert 200 < out.sum() < 300
    faces = mesh.vertices[mesh.boundary()]
    everyone = np.repeat(points[out], len(faces), axis=0)
    closest = trimesh.triangles.closest_point(np.tile(faces, (out.sum(), 1, 1)), everyone)
    exact = np.linalg.norm(closest - everyone, axis=1).reshape(out.sum(), -1).min(axis=1)
    own = mesh.vertices[embedding.corners[out]]
    np.testing.assert_allclose(_outside(points[out], own), exact, rtol=1e-12)


def test_an_embedding_of_the_wrong_size_is_refused() -> None:
    one = carried(tetrahedralize(ball(1), cells=2))
    with pytest.raises(ValueError, match=r"Embedding\.weights .*got \[41, 4\]"):
        Embedding(one.surface, one.tets, one.weights[1:], one.corners, one.vertex_count)
    mine = one.weights.copy()
    kept = Embedding(one.surface, one.tets, mine, one.corners, one.vertex_count)
    mine += 1.0  # the caller's own
    assert np.array_equal(kept.weights, one.weights)


# How it is called:


def test_paths_and_trimesh_objects_are_surfaces(tmp_path: Path) -> None:
    source = trimesh.creation.icosphere(2)
    source.export(tmp_path / "ball.ply")
    expected = tetrahedralize(TriMesh.from_trimesh(source), cells=5)
    for surface in (source, trimesh.Scene([source]), tmp_path / "ball.ply", str(tmp_path / "ball.ply")):
        np.testing.assert_array_equal(tetrahedralize(surface, cells=5).tets, expected.tets)


def test_progress_is_shown_on_demand(capfd: pytest.CaptureFixture[str]) -> None:
    tetrahedralize(ball(1), cells=3)
    assert capfd.readouterr().err == ""
    tetrahedralize(ball(1), cells=3, progress=True)
    assert "tetrahedralize" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"cells": 0}, ValueError, "cells .*got 0"),
        ({"cells": 2.5}, ValueError, "cells .*got 2.5"),
        ({"cells": 5000}, ValueError, "cells=5000 asks for a lattice of .* use fewer cells"),
        ({"method": "delaunay"}, ValueError, "method .*got 'delaunay'"),
        ({"surface": 3}, TypeError, "surface .*got int"),
        ({"surface": shapes.single_tet()}, TypeError, "surface .*got a TetMesh"),
        ({"surface": "nothing.obj"}, FileNotFoundError, "no such mesh file"),
        ({"surface": TriMesh(np.ones((3, 3)), [[0, 1, 2]])}, ValueError, "must have an extent"),
    ],
)
def test_bad_arguments_are_refused(arguments, error, message: str) -> None:
    with pytest.raises(error, match=message):
        tetrahedralize(**{"surface": ball(1), **arguments})


def test_tetwild_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pytetwild", None)
    with pytest.raises(ImportError, match=r'needs .*install "pytetwild\[all\]"'):
        tetrahedralize(ball(1), cells=4, method="tetwild")


def test_tetwild_meshes_are_checked_and_carry_the_surface(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    # In place of the package: a box around the surface, with the other winding that fTetWild also gives.
    around = shapes.box((2.4, 2.4, 2.4), (3, 3, 3)).translated((-1.2, -1.2, -1.2))
    asked: dict[str, float] = {}

    def fake(vertices: np.ndarray, faces: np.ndarray, edge_length_fac: float) -> tuple[np.ndarray, np.ndarray]:
        asked["edge_length"] = edge_length_fac * float(np.linalg.norm(np.ptp(vertices, axis=0)))
        Path("__tracked_surface.stl").touch()  # as the package does
        return around.vertices.copy(), around.tets[:, [0, 1, 3, 2]].astype(np.int32)

    monkeypatch.setitem(sys.modules, "pytetwild", types.SimpleNamespace(tetrahedralize=fake))
    surface = ball(2)
    mesh = tetrahedralize(surface, cells=10, method="tetwild")
    assert asked["edge_length"] == pytest.approx(0.2)  # a tenth of the diameter
    assert mesh.flipped == 0
    assert not list(tmp_path.iterdir())
    np.testing.assert_allclose(carried(mesh).apply(mesh.vertices), surface.vertices, atol=1e-12)


def test_embedding_takes_a_surface_and_a_mesh() -> None:
    box = shapes.box((1.0, 1.0, 1.0), (1, 1, 1))
    surface = TriMesh(box.vertices[:3], [[0, 1, 2]])
    with pytest.raises(TypeError, match=r"embed: surface .*got TetMesh"):
        embed(box, surface)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"embed: mesh .*got ndarray"):
        embed(surface, box.vertices)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"apply: positions .*got NoneType"):
        embed(surface, box).apply(None)  # type: ignore[call-overload]
