"""Shapes made by formulas: numbering, volumes, and a demonstration surface that is fit to be filled."""

from __future__ import annotations

import numpy as np
import pytest

from torchpd import TriMesh
from torchpd.geometry import shapes
from torchpd.geometry.isosurface import contour
from torchpd.geometry.tetrahedralize import tetrahedralize


def test_box_numbers_its_vertices_by_the_formula() -> None:
    nx, ny, nz = 4, 3, 2
    mesh = shapes.box((1.0, 0.6, 0.2), (nx, ny, nz))
    assert len(mesh.vertices) == (nx + 1) * (ny + 1) * (nz + 1)
    for i, j, k in np.ndindex(nx + 1, ny + 1, nz + 1):
        vertex = mesh.vertices[(i * (ny + 1) + j) * (nz + 1) + k]
        np.testing.assert_allclose(vertex, [i / nx, 0.6 * j / ny, 0.2 * k / nz], atol=1e-15)


def test_box_has_six_kuhn_tets_a_cell() -> None:
    mesh = shapes.box((2.0, 1.0, 0.5), (5, 4, 3))
    assert len(mesh.tets) == 6 * 5 * 4 * 3
    assert mesh.flipped == 0
    np.testing.assert_allclose(mesh.quality().volumes, 2.0 * 1.0 * 0.5 / (6 * 60), rtol=1e-12)
    # Every tet holds both ends of the main diagonal of its cell, and the cells agree on their faces: 1 piece whose
    # boundary is two triangles for each outer square.
    steps = np.ptp(mesh.vertices[mesh.tets], axis=1)
    np.testing.assert_allclose(steps, np.broadcast_to([0.4, 0.25, 0.5 / 3], steps.shape), rtol=1e-12)
    assert len(mesh.boundary()) == 4 * (5 * 4 + 4 * 3 + 3 * 5)


def test_box_defaults_are_the_beam_of_the_exact_cases() -> None:
    mesh = shapes.box()
    assert (len(mesh.vertices), len(mesh.tets)) == (26 * 6 * 6, 25 * 5 * 5 * 6)
    np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [1.0, 0.2, 0.2]], atol=1e-15)


def test_single_tet_is_regular_and_centred() -> None:
    mesh = shapes.single_tet(edge=3.0)
    pairs = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])
    lengths = np.linalg.norm(mesh.vertices[pairs[:, 0]] - mesh.vertices[pairs[:, 1]], axis=1)
    np.testing.assert_allclose(lengths, 3.0, rtol=1e-14)
    np.testing.assert_allclose(mesh.vertices.mean(axis=0), 0.0, atol=1e-15)
    assert mesh.flipped == 0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: shapes.box((1, 1, 0)), r"box\.size .*got \[1\.0, 1\.0, 0\.0\]"),
        (lambda: shapes.box((1, 1)), r"box\.size .*got \[2\]"),
        (lambda: shapes.box(cells=(1, 2)), r"box\.cells .*numbers"),
        (lambda: shapes.box(cells=(1, 2, 0)), r"box\.cells .*numbers"),
        (lambda: shapes.box(cells=(1, 2, 2.5)), r"box\.cells .*numbers"),
        (lambda: shapes.single_tet(0.0), r"single_tet\.edge .*got 0\.0"),
        (lambda: shapes.sheet((1.0, 0.0)), r"sheet\.size .*got 0\.0"),
        (lambda: shapes.sheet((1.0, 1.0), (2, 2.5)), r"sheet\.cells .*got 2\.5"),
        (lambda: shapes.sheet((1.0, 1.0, 1.0)), r"sheet: size and cells .*got \(1\.0, 1\.0, 1\.0\)"),
        (lambda: shapes.sphere(-1.0), r"sphere\.radius .*got -1\.0"),
        (lambda: shapes.sphere(1.0, 0), r"sphere\.cells .*got 0"),
        (lambda: shapes.capsule(1.0, 0.0), r"capsule\.length .*got 0\.0"),
        (lambda: shapes.cylinder(1.0, 1.0, 1.5), r"cylinder\.cells .*got 1\.5"),
        (lambda: shapes.octopus(arms=2), r"octopus\.arms .*got 2"),
        (lambda: shapes.octopus(cells=20.5), r"octopus\.cells .*got 20\.5"),
    ],
)
def test_bad_shapes_are_refused(call, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


CLOSED = {
    "sphere": shapes.sphere,
    "capsule": lambda radius=1.0, cells=6: shapes.capsule(radius, 3.0 * radius, cells),
    "cylinder": lambda radius=1.0, cells=4: shapes.cylinder(radius, 3.0 * radius, cells),
}


@pytest.mark.parametrize("cells", [1, 2, 5, 12])
@pytest.mark.parametrize("name", CLOSED)
def test_surfaces_of_revolution_are_closed_and_even(name: str, cells: int) -> None:
    """A sphere by topology, faces outward, no obtuse triangle, and none sharper than 35 degrees."""
    mesh = CLOSED[name](0.02, cells).to_trimesh()
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.euler_number == 2
    assert mesh.volume > 0.0
    angles = np.degrees(mesh.face_angles)
    assert angles.min() > 35.0
    assert angles.max() < 90.0 + 1e-6


@pytest.mark.parametrize("name", ["sphere", "capsule"])
def test_round_surfaces_converge(name: str) -> None:
    """Chords of edges e are short of area and volume by O(e^2): a quarter of the error with half the edges."""
    volume, area = 4.0 * np.pi / 3.0, 4.0 * np.pi
    if name == "capsule":
        volume, area = volume + 3.0 * np.pi, area + 6.0 * np.pi
    meshes = [CLOSED[name](1.0, cells) for cells in (8, 16)]
    for of, exact in ((lambda mesh: mesh.volume(), volume), (lambda mesh: mesh.to_trimesh().area, area)):
        coarse, fine = (exact - of(mesh) for mesh in meshes)
        assert 0.0 < fine < 0.01 * exact
        assert coarse / fine == pytest.approx(4.0, rel=0.05)


def test_points_of_round_surfaces_are_exact() -> None:
    ball = shapes.sphere(0.3, 7)
    np.testing.assert_allclose(np.linalg.norm(ball.vertices, axis=1), 0.3, rtol=1e-14)
    assert len(ball.triangles) == 8 * 7**2
    x, y, z = shapes.capsule(0.3, 1.0).vertices.T
    distance = np.sqrt(x**2 + np.maximum(abs(y) - 0.5, 0.0) ** 2 + z**2)
    np.testing.assert_allclose(distance, 0.3, rtol=1e-14)


def test_a_cylinder_is_a_prism() -> None:
    """Of n = 6 cells sides: area of the base n / 2 r^2 sin(2 pi / n), of the sides 2 n r sin(pi / n) l."""
    r, length, n = 0.02, 0.2, 6 * 5
    mesh = shapes.cylinder(r, length, 5)
    base = 0.5 * n * r**2 * np.sin(2.0 * np.pi / n)
    assert mesh.volume() == pytest.approx(base * length, rel=1e-12)
    assert mesh.to_trimesh().area == pytest.approx(2.0 * base + 2.0 * n * r * np.sin(np.pi / n) * length, rel=1e-12)
    np.testing.assert_allclose(mesh.bounds[:, 1], [-0.1, 0.1], rtol=1e-15)


def test_a_sheet_is_level() -> None:
    mesh = shapes.sheet((2.0, 0.9), (4, 3))
    surface = mesh.to_trimesh()
    assert surface.area == pytest.approx(1.8, rel=1e-14)
    np.testing.assert_allclose(surface.face_normals, [[0.0, 1.0, 0.0]] * 24, atol=1e-15)
    assert surface.euler_number == 1
    for i, k in np.ndindex(5, 4):
        np.testing.assert_allclose(mesh.vertices[4 * i + k], [0.5 * i - 1.0, 0.0, 0.3 * k - 0.45], atol=1e-15)


@pytest.fixture(scope="module")
def octopus() -> TriMesh:
    return shapes.octopus()


def test_the_octopus_is_one_closed_surface_without_holes(octopus: TriMesh) -> None:
    surface = octopus.to_trimesh()
    assert surface.is_watertight
    assert surface.is_winding_consistent
    assert surface.body_count == 1
    assert surface.euler_number == 2  # a sphere with arms, no handle
    assert octopus.volume() > 0  # faces outwards
    assert 2000 <= len(octopus.triangles) <= 12000


def test_the_octopus_stands_on_the_ground(octopus: TriMesh) -> None:
    low, high = octopus.bounds
    assert low[1] == 0.0
    np.testing.assert_allclose(high - low, [1.06, 0.48, 1.06], atol=0.03)


def test_the_octopus_does_not_cross_itself(octopus: TriMesh) -> None:
    # A closed surface crosses itself nowhere when its winding number is 1 just inside and 0 just outside everywhere.
    corners = octopus.vertices[octopus.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    chosen = np.random.default_rng(0).choice(len(corners), 300, replace=False)
    centres = corners[chosen].mean(axis=1)
    for distance, winding in ((-2e-3, 1.0), (2e-3, 0.0)):
        np.testing.assert_allclose(_winding(centres + distance * normals[chosen], corners), winding, atol=1e-9)


def _winding(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Solid angle of all triangles over 4 pi (van Oosterom and Strackee 1983)."""
    total = np.empty(len(points))
    for row, point in enumerate(points):
        a, b, c = np.moveaxis(corners - point, 1, 0)
        la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        dot = [np.einsum("ij,ij->i", *pair) for pair in ((a, b), (b, c), (c, a))]
        above = np.einsum("ij,ij->i", a, np.cross(b, c))
        total[row] = np.arctan2(above, la * lb * lc + dot[0] * lc + dot[1] * la + dot[2] * lb).sum() / (2 * np.pi)
    return total


def test_the_octopus_fills_with_tets_in_one_piece(octopus: TriMesh) -> None:
    mesh = tetrahedralize(octopus, cells=20)
    assert mesh.quality().pieces == 1
    # The arms do not grow together: the mesh is a ball like the octopus, without handles. V - E + F of its boundary.
    boundary = mesh.boundary()
    edges = np.unique(np.sort(boundary[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    assert len(np.unique(boundary)) - len(edges) + len(boundary) == 2


def test_contour_of_a_ball_has_its_area_and_even_triangles() -> None:
    surface = contour(lambda p: np.linalg.norm(p, axis=1) - 1.0, np.full(3, -1.1), np.full(3, 1.1), cells=20)
    # One Newton step on a distance function is exact up to the difference quotient: error about (step / radius)^2.
    np.testing.assert_allclose(np.linalg.norm(surface.vertices, axis=1), 1.0, atol=1e-5)
    mesh = surface.to_trimesh()
    assert mesh.is_watertight
    assert mesh.euler_number == 2
    # A chord surface with edges e has a volume short by O(e^2 / 4) of 4 pi / 3; e is about 0.6 x 2.2 / 20.
    assert surface.volume() == pytest.approx(4 * np.pi / 3, rel=(0.6 * 0.11) ** 2)
    assert surface.volume() < 4 * np.pi / 3
    assert np.degrees(mesh.face_angles).min() > 20.0
