"""How full the tets of a lattice are: bodies weigh what their surface encloses, and bend about as they should."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from mesh_cases import block, surface_of
from numpy.typing import NDArray
from scipy.sparse.linalg import spsolve
from small_strains import elastic_matrix

import torchpd as pd
from torchpd.geometry.occupancy import MIN_FILL, parts_of

Array = NDArray[np.float64]


def ball(subdivisions: int = 3) -> pd.TriMesh:
    return surface_of(trimesh.creation.icosphere(subdivisions))


def joined(*surfaces: pd.TriMesh) -> pd.TriMesh:
    starts = np.cumsum([0, *(len(s.vertices) for s in surfaces)])
    triangles = [s.triangles + start for s, start in zip(surfaces, starts, strict=False)]
    return pd.TriMesh(np.concatenate([s.vertices for s in surfaces]), np.concatenate(triangles))


def soup(surface: pd.TriMesh, noise: float = 0.0) -> pd.TriMesh:
    """Each triangle by itself, turned either way, its corners moved by up to `noise`."""
    rng = np.random.default_rng(0)
    corners = surface.vertices[surface.triangles]
    flip = rng.random(len(corners)) < 0.5
    corners[flip] = corners[flip][:, ::-1]
    corners += noise * rng.uniform(-1.0, 1.0, corners.shape)
    return pd.TriMesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def fill_of(mesh: pd.TetMesh) -> Array:
    assert mesh.fill is not None
    return mesh.fill


def filled(mesh: pd.TetMesh) -> float:
    return float((fill_of(mesh) * mesh.quality().volumes).sum())


# Mass:


@pytest.mark.parametrize(
    ("surface", "cells", "tolerance"),
    [
        # Tets that are hardly touched count MIN_FILL: a layer of some tenths of a cell, times 0.05, is too much.
        (ball(), 5, 0.02),
        (ball(), 12, 0.01),
        (ball(4), 20, 0.005),
        (block(1.0, 0.13, 0.087), 10, 0.04),  # less than a cell thick: faces pass close to edges of the lattice
        (block(1.0, 0.13, 0.087), 20, 0.01),
        # faces in planes of samples
        (block(1.0, 0.25, 0.25), 6, 0.02),
        (block(1.0, 0.25, 0.25), 10, 0.01),
        (block(1.0, 0.35, 0.35), 10, 0.01),
        (block(1.0, 1.0, 0.05), 10, 0.02),
        (pd.shapes.octopus(), 14, 0.03),  # arms of about a cell
        (ball().translated((1e4, -1e4, 3e3)), 9, 0.02),
        (ball().scaled(1e-3), 9, 0.02),
    ],
)
def test_a_body_weighs_what_its_surface_encloses(surface: pd.TriMesh, cells: int, tolerance: float) -> None:
    mesh = pd.tetrahedralize(surface, cells=cells)
    values = pd.Scene(pd.Solid(mesh, youngs=1e5, density=700.0)).values()
    assert values.masses.sum() == pytest.approx(700.0 * surface.volume(), rel=tolerance)
    assert mesh.quality().volumes.sum() > 1.1 * surface.volume()  # what it weighed before


@pytest.mark.parametrize("cells", [10, 20, 40])
def test_faces_in_lattice_planes_get_no_layer_more(cells: int) -> None:
    size = np.array([1.0, 0.1, 0.1])
    surface = block(*size)
    mesh = pd.tetrahedralize(surface, cells=cells)
    # Tets across a face of the box end in the middle of the next cube, half of them inside.
    np.testing.assert_allclose(mesh.bounds, np.outer([-0.5, 0.5], size + 1.0 / cells), atol=1e-12)
    assert filled(mesh) == pytest.approx(surface.volume(), rel=1e-6)
    shares = fill_of(mesh)
    assert np.isclose(shares, 1.0, atol=1e-6).sum() + np.isclose(shares, 0.5, atol=1e-6).sum() == len(shares)
    assert mesh.embedding is not None
    np.testing.assert_allclose(mesh.embedding.apply(mesh.vertices), surface.vertices, atol=1e-12)
    assert mesh.embedding.weights.min() > -1e-9


def test_each_tet_has_the_share_that_samples_say() -> None:
    mesh = pd.tetrahedralize(ball(4).scaled((1.0, 0.7, 0.8)), cells=7)
    weights = np.random.default_rng(0).dirichlet(np.ones(4), 4000)
    points = np.einsum("sa,eak->esk", weights, mesh.vertices[mesh.tets]) / [1.0, 0.7, 0.8]
    inside = (np.linalg.norm(points, axis=2) < 1.0).mean(axis=1)
    # 4000 samples are right to 0.03 (four deviations); 18 little cubes with a face right in each, to a tenth or so.
    assert np.abs(fill_of(mesh) - np.maximum(inside, MIN_FILL)).max() < 0.13
    assert np.abs(fill_of(mesh) - np.maximum(inside, MIN_FILL)).mean() < 0.02


# What is inside:


def test_winding_and_shared_vertices_do_not_matter() -> None:
    surface = surface_of(trimesh.creation.torus(1.0, 0.4))
    one, other = (pd.tetrahedralize(s, cells=12) for s in (surface, soup(surface)))
    np.testing.assert_allclose(fill_of(one), fill_of(other), atol=1e-5)


@pytest.mark.filterwarnings("ignore:tetrahedralize")
@pytest.mark.parametrize(("noise", "cells"), [(1e-3, 20), (8e-3, 20), (8e-3, 40), (1e-5, 10)])
def test_cracks_do_not_empty_a_body(noise: float, cells: int) -> None:
    surface = ball()
    cracked = soup(surface, noise)  # a fortieth of a cell for each 1e-3 at 20 cells; edges are 0.15 long
    assert filled(pd.tetrahedralize(cracked, cells=cells)) == pytest.approx(surface.volume(), rel=0.01)


def test_seams_are_closed_by_distance_not_by_rounding() -> None:
    # Two halves, 1e-6 cells apart where a grid of the tolerance has its boundary.
    whole = block(1.0, 1.0, 1.0)
    right, left = whole.translated((0.5, 0.0, 0.0)), whole.translated((-0.5, 0.0, 0.0))
    for gap in (1e-6, 0.1):
        tolerance = 0.25
        open_right = right.triangles[(right.vertices[right.triangles][:, :, 0] > 0.1).any(axis=1)]
        open_left = left.triangles[(left.vertices[left.triangles][:, :, 0] < -0.1).any(axis=1)]
        vertices = np.concatenate([right.vertices + [gap / 2, 0, 0], left.vertices - [gap / 2, 0, 0]])
        shift = [0.5 * tolerance, 0.0, 0.0]
        both = pd.TriMesh(vertices + shift, np.concatenate([open_right, open_left + len(right.vertices)]))
        parts = parts_of(both, tolerance, fill_holes=True)
        assert len(parts.caps) == 0
        assert len(np.unique(parts.part)) == 1
        closed = parts.triangles - shift
        # The strips between the halves are wound anyhow: count volumes by where faces look from the middle.
        volumes = np.linalg.det(closed)
        assert np.abs(volumes).sum() / 6.0 == pytest.approx(2.0 + gap, rel=1e-9)


def test_the_corners_of_a_fine_rim_stay_apart() -> None:
    whole = ball(4)
    upper = whole.vertices[whole.triangles].mean(axis=1)[:, 2] > 0.0
    used, numbers = np.unique(whole.triangles[upper], return_inverse=True)
    bowl = pd.TriMesh(whole.vertices[used], numbers.reshape(-1, 3))
    parts = parts_of(bowl, 0.5, fill_holes=True)  # edges are 0.07
    rim = np.unique(parts.caps[:, :2].reshape(-1, 3), axis=0)
    assert len(parts.caps) == len(rim) == 96
    assert not len(parts.sheets)


@pytest.mark.parametrize("cells", [10, 20])
@pytest.mark.parametrize("noise", [0.0, 5e-3])
def test_a_surface_of_two_sides_is_filled_as_one_of_one(cells: int, noise: float) -> None:
    surface = ball()
    if noise:
        surface = soup(surface, noise)
    both = joined(surface, pd.TriMesh(surface.vertices, surface.triangles[:, ::-1]))
    one, other = (pd.tetrahedralize(s, cells=cells) for s in (surface, both))
    np.testing.assert_allclose(fill_of(one), fill_of(other), atol=1e-5)
    assert filled(other) == pytest.approx(ball().volume(), rel=0.01)


def test_walls_between_cells_that_come_twice_are_kept() -> None:
    cube = block(1.0, 1.0, 1.0)
    right = cube.translated((0.5, 0.0, 0.0))
    two = joined(right, right.transformed(np.diag([-1.0, 1.0, 1.0])))
    parts = parts_of(two, 1e-3, fill_holes=True)
    assert len(parts.triangles) == 24
    assert not len(parts.caps)
    assert filled(pd.tetrahedralize(two, cells=8)) == pytest.approx(2.0, rel=1e-3)


def test_what_is_torn_to_pieces_is_a_sheet_and_reported() -> None:
    whole = ball()
    corners = whole.vertices[whole.triangles]
    middle = corners.mean(axis=1, keepdims=True)
    shreds = soup(pd.TriMesh((middle + 0.7 * (corners - middle)).reshape(-1, 3), np.arange(3840).reshape(-1, 3)))
    with pytest.warns(pd.MeshWarning, match=r"1280 of 1280 triangles .*0\.02\d+ m"):
        mesh = pd.tetrahedralize(shreds, cells=20)
    assert np.all(fill_of(mesh) == 1.0)
    assert whole.volume() < filled(mesh) < 1.2 * whole.volume()  # a layer of half a cell, 1/20 of the radius


def sheet(bend: float) -> pd.TriMesh:
    """A square of 8 by 8 squares, bent to a part of a cylinder: 32 of its 208 edges are open."""
    x, y = np.meshgrid(*2 * [np.linspace(-0.5, 0.5, 9)], indexing="ij")
    corner = (9 * np.arange(8)[:, None] + np.arange(8)).reshape(-1, 1)
    triangles = np.concatenate([corner + [0, 9, 1], corner + [1, 9, 10]])
    return pd.TriMesh(np.stack([x, bend * (0.25 - x**2), y], axis=-1).reshape(-1, 3), triangles)


def test_sheets_are_named_however_few_their_triangles_are() -> None:
    two = pd.TriMesh(sheet(0.0).vertices[[0, 8, 72, 80]], [[0, 2, 1], [1, 2, 3]])
    flat = sheet(0.0)
    both = pd.TriMesh(flat.vertices, np.concatenate([flat.triangles, flat.triangles[:, ::-1]]))
    for surface, count, edges in (
        (two, "2 of 2 triangles", r"4 of 5 edges \(80 %\)"),
        (flat, "128 of 128 triangles", r"32 of 208 edges \(15\.4 %\)"),
        (both, "128 of 128 triangles", r"32 of 208 edges \(15\.4 %\)"),
        (joined(ball(2).translated((0.0, 2.0, 0.0)), flat), "128 of 448 triangles", r"32 of 688 edges \(4\.65 %\)"),
    ):
        with pytest.warns(pd.MeshWarning) as said:
            pd.tetrahedralize(surface, cells=6)
        (message,) = [str(warning.message) for warning in said]
        assert re.search(rf"{count} are a sheet, open or flat, which encloses nothing; {edges} belong to one", message)


def test_holes_that_were_closed_are_counted() -> None:
    """A cube without one face lacks a sixth of its area, and a diagonal of its 18 edges."""
    cube = block(1.0, 1.0, 1.0)
    tub = pd.TriMesh(cube.vertices, cube.triangles[(cube.vertices[cube.triangles][:, :, 1] < 0.4).any(axis=1)])
    with pytest.warns(
        pd.MeshWarning, match=r"4 of 17 edges \(23\.5 %\) .* its holes \(1\) close it, 16\.7 % of the area"
    ):
        pd.tetrahedralize(tub, cells=8)
    surfaces = ball(2), pd.shapes.octopus(cells=16), block(1.0, 1.0, 0.02), soup(ball(2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for closed in surfaces:
            pd.tetrahedralize(closed, cells=8)
        pd.tetrahedralize(sheet(0.4), cells=8, fill_holes=False)  # a shell, as asked for


def test_parts_that_overlap_count_once_and_cavities_are_filled() -> None:
    cube = block(1.0, 1.0, 1.0)
    both = joined(cube, cube.translated((0.5, 0.21, 0.13)))
    union = 2.0 - 0.5 * 0.79 * 0.87
    assert filled(pd.tetrahedralize(both, cells=15)) == pytest.approx(union, rel=0.02)
    hollow = joined(cube, pd.TriMesh(0.5 * cube.vertices, cube.triangles[:, ::-1]))
    assert filled(pd.tetrahedralize(hollow, cells=12)) == pytest.approx(1.0, rel=1e-3)


@pytest.mark.filterwarnings("ignore:tetrahedralize")
def test_a_hole_is_closed_by_its_cap_or_leaves_a_shell() -> None:
    whole = ball(4)
    upper = whole.vertices[whole.triangles].mean(axis=1)[:, 2] > 0.0
    used, numbers = np.unique(whole.triangles[upper], return_inverse=True)
    bowl = pd.TriMesh(whole.vertices[used], numbers.reshape(-1, 3))
    assert filled(pd.tetrahedralize(bowl, cells=16)) == pytest.approx(0.5 * whole.volume(), rel=0.03)
    assert np.all(fill_of(pd.tetrahedralize(bowl, cells=16, fill_holes=False)) == 1.0)


@pytest.mark.filterwarnings("ignore:tetrahedralize")
@pytest.mark.parametrize("both_sides", [False, True])
def test_what_encloses_nothing_is_a_body_of_full_tets(both_sides: bool) -> None:
    sheet = [[0, 1, 2], [1, 3, 2]]
    corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.1], [1.0, 1.0, 0.1]]
    triangles = sheet + [corners[::-1] for corners in sheet] if both_sides else sheet
    assert np.all(fill_of(pd.tetrahedralize(pd.TriMesh(corners, triangles), cells=8)) == 1.0)
    # In a plane of lattice faces it reaches into no tet, and still has some.
    flat = pd.TriMesh([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]], [[0, 1, 2]])
    mesh = pd.tetrahedralize(flat, cells=4)
    assert np.all(fill_of(mesh) == 1.0)
    # Beside a body it is as heavy as alone.
    beside = pd.tetrahedralize(joined(ball(2).translated((0.0, 0.0, -1.5)), flat), cells=8)
    assert fill_of(beside).max() == pytest.approx(1.0)


def test_a_plate_thinner_than_the_grid_keeps_the_least_share() -> None:
    mesh = pd.tetrahedralize(block(1.0, 1.0, 0.002), cells=10)  # 0.02 cells
    assert MIN_FILL <= fill_of(mesh).min() <= fill_of(mesh).max() < 0.1


# What becomes of it:


def test_the_share_survives_motions_and_files(tmp_path: Path) -> None:
    mesh = pd.tetrahedralize(ball(2), cells=5)
    for other in (
        mesh.translated((1.0, 2.0, 3.0)),
        mesh.scaled((1.0, 2.0, 0.5)),
        mesh.transformed(np.diag([1.0, -1.0, 1.0])),
        mesh.with_embedding(None),
    ):
        np.testing.assert_array_equal(fill_of(other), fill_of(mesh))
    sim = pd.Simulator(pd.Scene(pd.Solid(mesh, youngs=1e4)))
    sim.save(tmp_path / "sim")
    loaded = pd.Simulator.load(tmp_path / "sim")
    np.testing.assert_array_equal(fill_of(loaded.scene.solids[0].mesh), fill_of(mesh))
    one, two = sim.scene.values(), loaded.scene.values()
    np.testing.assert_array_equal(one.masses, two.masses)
    np.testing.assert_array_equal(one.stiffness, two.stiffness)


def test_a_solid_weighs_and_resists_by_the_share_and_meshes_without_one_keep_their_bits() -> None:
    box = pd.shapes.box((1.0, 1.0, 1.0), (2, 2, 2))
    share = np.linspace(0.05, 1.0, len(box.tets))
    partly = pd.TetMesh(box.vertices, box.tets, fill=torch.tensor(share))
    youngs, density = np.linspace(1e4, 2e4, len(share)), np.linspace(500.0, 900.0, len(share))
    body = pd.Solid(partly, youngs, density)
    values = pd.Scene(body, pd.Solid(box, youngs, density)).values()
    np.testing.assert_array_equal(values.stiffness, np.concatenate([youngs * np.maximum(share, 0.1), youngs]))
    np.testing.assert_array_equal(values.density, np.concatenate([density * share, density]))
    np.testing.assert_array_equal(body.youngs, youngs)  # of the material
    full = pd.TetMesh(box.vertices, box.tets, fill=np.ones(len(share)))
    one, two = (pd.Scene(pd.Solid(mesh, youngs, density)).values() for mesh in (full, box))
    np.testing.assert_array_equal(one.masses, two.masses)
    assert box.fill is None


@pytest.mark.parametrize(
    ("fill", "message"),
    [
        ([0.5, 0.5], r"TetMesh\.fill .*got \[2\]"),
        ([0.0], r"TetMesh\.fill .*got 0\.0 at 0 \(1 in all\)"),
        ([1.5], r"got 1\.5 at 0"),
        ([float("nan")], "got nan at 0"),
    ],
)
def test_bad_shares_are_refused(fill: list[float], message: str) -> None:
    tet = pd.shapes.single_tet()
    with pytest.raises(ValueError, match=message):
        pd.TetMesh(tet.vertices, tet.tets, fill=fill)


def test_tets_that_are_left_out_take_their_share_along() -> None:
    corners = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    with pytest.warns(pd.MeshWarning):
        mesh = pd.TetMesh(corners, [[0, 1, 1, 3], [0, 1, 2, 3]], fill=[0.3, 0.6], drop_degenerate=True)
    assert fill_of(mesh).tolist() == [0.6]


def test_meshes_say_how_full_they_are() -> None:
    mesh = pd.tetrahedralize(block(1.0, 0.1, 0.1), cells=20)
    assert "74% filled, carrying" in repr(mesh)  # of 1.35 times the volume
    assert "of which 0.01 m^3 are filled" in str(mesh.quality())
    assert "fill: stiffness and masses are multiplied by" in str(pd.Simulator(pd.Scene(pd.Solid(mesh, youngs=1e4))))


# Stiffness:


def sag(mesh: pd.TetMesh) -> float:
    """How far the end of a beam along x comes down by its weight: small strains, held where x is least."""
    solid = pd.Solid(mesh, youngs=1e7, density=1000.0)
    matrix, masses = elastic_matrix(solid), pd.Scene(solid).values().masses
    x = mesh.vertices[:, 0]
    free = np.repeat(x > -0.5 + 1e-9, 3)
    load = np.zeros((len(x), 3))
    load[:, 1] = -9.81 * masses
    moved = np.zeros(load.size)
    moved[free] = spsolve(matrix[free][:, free].tocsc(), load.reshape(-1)[free])
    ends = np.abs(x - 0.5) < 1e-9
    return float(-moved.reshape(-1, 3)[ends, 1].mean())


def test_a_beam_of_a_lattice_sags_about_as_far_as_it_should() -> None:
    length, height = 1.0, 0.1
    exact = 1000.0 * 9.81 * length**4 / (8.0 * 1e7 * height**2 / 12.0)  # Euler and Bernoulli, of its weight
    lattice = pd.tetrahedralize(block(length, height, height), cells=20)
    # Linear tets are too stiff where few of them make up a height: as a box of four cells across it is, no more.
    box = pd.shapes.box((length, height, height), (40, 4, 4)).translated((-0.5, -0.05, -0.05))
    assert 0.8 < sag(lattice) / exact < 1.0
    assert sag(lattice) == pytest.approx(sag(box), rel=0.05)
    finer = pd.tetrahedralize(block(length, height, height), cells=40)
    assert 0.94 < sag(finer) / exact < 1.0


@pytest.mark.parametrize(
    ("cells", "part"),
    [((20, 1, 4), 0.09), ((20, 2, 4), 0.11), ((20, 4, 4), 0.11), ((40, 2, 8), 0.28), ((80, 2, 16), 0.49)],
)
def test_flat_cells_sag_as_little_as_the_limits_say(cells: tuple[int, int, int], part: float) -> None:
    length, height = 1.0, 0.02
    exact = 1000.0 * 9.81 * length**4 / (8.0 * 1e7 * height**2 / 12.0)
    plate = pd.shapes.box((length, height, 0.2), cells).translated((-0.5, 0.0, 0.0))
    assert sag(plate) / exact == pytest.approx(part, abs=0.005)
