"""The flat arrays of cloth: membranes, hinges and threads by closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from sheets import bending_energy, cloth, deformation, group_of, surface

import torchpd as pd

EXACT = 1e-12  # roundings of a few products of numbers near 1


def test_triangles_are_at_rest_in_any_plane() -> None:
    """F has orthonormal columns on the rest shape, so that F^T F = 1, and the rest areas are those of the sheet."""
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    mesh = surface(size=(1.0, 0.6), cells=(5, 3)).transformed(turn)
    group = group_of("triangle", cloth(mesh))
    F = deformation(group, mesh.vertices)
    np.testing.assert_allclose(F.swapaxes(1, 2) @ F, np.tile(np.eye(2), (30, 1, 1)), atol=EXACT)
    assert group.measure.sum() == pytest.approx(0.6, rel=EXACT)
    assert np.abs(group.gradients.sum(axis=1)).max() < EXACT * np.abs(group.gradients).max()
    assert list(group.material) == ["membrane_youngs", "membrane_poisson", "thickness"]
    assert {name: row[0] for name, row in group.material.items()} == {
        "membrane_youngs": 1e5, "membrane_poisson": 0.3, "thickness": 1e-3,
    }  # fmt: skip


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_uvs_are_the_rest_shape(mirror: float) -> None:
    """A sheet worn at 1.25 and 0.8 of its pattern has these stretches along u and v, also from a mirrored pattern."""
    mesh = surface(size=(1.25, 0.8), cells=(3, 2))
    pattern = mesh.vertices[:, [0, 2]] / [1.25, 0.8] * [mirror, 1.0]
    body = cloth(mesh, rest_uv=pattern[mesh.triangles])
    F = deformation(group_of("triangle", body), mesh.vertices)
    np.testing.assert_allclose(F, np.tile([[1.25 * mirror, 0.0], [0.0, 0.0], [0.0, 0.8]], (12, 1, 1)), atol=EXACT)
    assert body.areas.sum() == pytest.approx(1.0, rel=EXACT)
    assert body.masses().sum() == pytest.approx(0.2, rel=EXACT)  # that of the pattern


def test_hinge_of_the_unit_square() -> None:
    """c = (2, 2, -2, -2), A = 1; folded by theta it costs 4 kb sin^2(theta / 2): 2 kb at 90 degrees, kb at 60."""
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    group = group_of("hinge", cloth(pd.TriMesh(corners, [[0, 1, 2], [1, 0, 3]]), bending=3.0))
    assert group.corners.tolist() == [[0, 1, 2, 3]]
    np.testing.assert_allclose(group.gradients[0, :, 0], [2.0, 2.0, -2.0, -2.0], atol=EXACT)
    np.testing.assert_allclose(group.measure, [1.0], atol=EXACT)
    assert np.abs(deformation(group, corners)).max() < EXACT
    middle, across = np.array([0.5, 0.0, 0.5]), np.array([1.0, 0.0, -1.0]) / np.sqrt(2.0)
    for angle, energy in ((np.pi / 2, 2.0), (np.pi / 3, 1.0)):
        folded = corners.copy()
        for vertex, side in ((2, 1.0), (3, -1.0)):
            arm = side * across * np.cos(angle / 2) + np.array([0.0, 1.0, 0.0]) * np.sin(angle / 2)
            folded[vertex] = middle + np.sqrt(0.5) * arm
        assert bending_energy(group, folded) == pytest.approx(3.0 * energy, rel=EXACT)


def test_hinges_of_uneven_triangles_are_flat_in_any_plane() -> None:
    """c holds for linear functions, so that sum c_a x_a = 0 in a plane, by UVs as well."""
    mesh = surface(size=(1.0, 1.0), cells=(4, 4))
    moved = mesh.vertices + 0.08 * np.random.default_rng(5).uniform(-1.0, 1.0, mesh.vertices.shape) * [1.0, 0.0, 1.0]
    uneven = pd.TriMesh(moved, mesh.triangles)
    for body in (cloth(uneven), cloth(mesh, rest_uv=moved[:, [0, 2]][mesh.triangles])):
        group = group_of("hinge", body)
        assert len(group) == 40
        assert np.abs(deformation(group, moved @ np.linalg.qr(np.ones((3, 3)) + np.eye(3))[0])).max() < 1e-10


def test_a_cylinder_costs_its_curvature_squared() -> None:
    """Equal diagonals, bent along the rows: kb / 2 kappa^2 an area, to the order of the angle of a cell squared.

    Interior columns have hinges on both sides; the end columns have half of a hinge less, one cell in all.
    """
    cells, radius = (60, 2), 1.0
    mesh = surface(size=(1.0, 0.1), cells=cells, alternating=False)
    group = group_of("hinge", cloth(mesh, bending=2.0))
    x = mesh.vertices
    rolled = np.stack([radius * np.sin(x[:, 0] / radius), radius * (1.0 - np.cos(x[:, 0] / radius)), x[:, 2]], axis=1)
    energy = bending_energy(group, rolled)
    assert energy == pytest.approx(2.0 / 2.0 / radius**2 * 0.1 * (cells[0] - 1) / cells[0], rel=0.01)
    worn = group_of("hinge", cloth(pd.TriMesh(rolled, mesh.triangles), bending=2.0, rest_curvature="surface"))
    assert bending_energy(worn, rolled) < EXACT * energy
    assert bending_energy(worn, x) == pytest.approx(energy, rel=0.01)


def test_bending_follows_youngs_and_thickness_unless_given() -> None:
    """youngs thickness^3 / 12, of two triangles the mean by area; 0 leaves no hinges."""
    mesh = surface(cells=(1, 1))
    for youngs, thickness, rigidity in ((1.2e6, 1e-3, 1e-4), ([1.2e6, 2.4e6], 1e-3, 1.5e-4), (1.2e6, 2e-3, 8e-4)):
        body = cloth(mesh, youngs=youngs, thickness=thickness)
        np.testing.assert_allclose(group_of("hinge", body).material["bending"], [rigidity], rtol=EXACT)
    assert cloth(mesh, bending=1e-5).flexural_rigidity().tolist() == [1e-5]
    assert [group.kind for group in pd.Scene(cloth(mesh, bending=0.0)).values().stencils] == ["triangle"]
    single = pd.TriMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    assert [group.kind for group in pd.Scene(cloth(single)).values().stencils] == ["triangle"]


def test_threads_run_along_warp_and_weft() -> None:
    """Stretched by 1.5 along the warp and 1.1 along the weft, threads have these lengths; both ways to say where."""
    mesh = surface(cells=(3, 2))
    stretched = mesh.vertices * [1.5, 1.0, 1.1]
    flat = mesh.vertices[:, [2, 0]][mesh.triangles]  # v along x, so the default warp is along x
    for where in ({"grain": (2.0, 5.0, 0.0)}, {"rest_uv": flat}, {"rest_uv": flat[..., ::-1], "grain": (3.0, 0.0)}):
        body = cloth(mesh, warp=40.0, weft=7.0, **where)
        group = group_of("thread", body)
        lengths = np.linalg.norm(deformation(group, stretched)[:, :, 0], axis=1)
        np.testing.assert_allclose(lengths, np.repeat([1.5, 1.1], 12), rtol=EXACT)
        np.testing.assert_allclose(np.linalg.norm(deformation(group, mesh.vertices)[:, :, 0], axis=1), 1.0, rtol=EXACT)
        assert group.material["thread_stiffness"].tolist() == [40.0] * 12 + [7.0] * 12
        np.testing.assert_array_equal(group.measure, np.tile(body.areas, 2))
    assert len(group_of("thread", cloth(mesh, weft=7.0, grain=(1, 0, 0))).corners) == 12


def test_masses_are_a_third_of_each_triangle() -> None:
    mesh = surface(cells=(1, 1))
    masses = pd.Scene(cloth(mesh, area_density=[0.3, 0.6])).values().masses
    shares = np.zeros(4)
    for triangle, density in zip(mesh.triangles, (0.3, 0.6), strict=True):
        shares[triangle] += density * 0.5 / 3.0
    np.testing.assert_allclose(masses, shares, rtol=EXACT)


def fan(blades: int) -> pd.TriMesh:
    """Triangles around one edge."""
    angles = np.arange(blades)
    tips = np.stack([np.cos(angles), np.sin(angles), np.full(blades, 0.5)], axis=1)
    vertices = np.concatenate([[[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], tips])
    return pd.TriMesh(vertices, [[0, 1, 2 + k] for k in range(blades)])


def test_cloth_is_checked() -> None:
    mesh, flat = surface(cells=(1, 1)), surface(cells=(1, 1)).vertices[:, [0, 2]][surface(cells=(1, 1)).triangles]
    thin = pd.TriMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 1e-6, 0]], [[0, 1, 2], [1, 0, 3]])
    line = flat.copy()
    line[1, :, 1] = 0.0
    for changed, kind, message in (
        ({"mesh": "shirt"}, TypeError, "Cloth: surface .*got str"),
        ({"mesh": fan(3)}, ValueError, r"Cloth\.surface: an edge .*got 3 at the edge \[0, 1\]"),
        ({"mesh": thin}, ValueError, r"Cloth\.surface: triangles .*got 5e-07 m\^2 of \[1, 0, 3\] at 1 \(1 in all\)"),
        ({"rest_uv": line}, ValueError, r"Cloth\.rest_uv: triangles .*got 0 m\^2 of \[0, 1, 3\] at 1 \(1 in all\)"),
        (
            {"mesh": pd.TriMesh(mesh.vertices[:3], [[0, 1, 2], [2, 1, 0]])},
            ValueError,
            r"Cloth\.surface: triangles must differ, got the same corners at 0 and 1",
        ),
        ({"youngs": 0.0}, ValueError, r"Cloth\.youngs .*got 0\.0 at 0"),
        ({"thickness": [1e-3]}, ValueError, r"Cloth\.thickness .*got \[1\]"),
        ({"area_density": -1.0}, ValueError, r"Cloth\.area_density .*got -1\.0"),
        ({"poisson": -1.0}, ValueError, r"Cloth\.poisson .*got -1\.0"),
        ({"poisson": [0.3, 0.51]}, ValueError, r"Cloth\.poisson .*got 0\.51 at 1"),
        ({"bending": -1e-9}, ValueError, r"Cloth\.bending .*got -1e-09"),
        ({"bending": [1.0, 1.0]}, ValueError, r"Cloth\.bending .*got \[2\]"),
        ({"rest_uv": np.zeros((2, 2))}, ValueError, r"Cloth\.rest_uv must be \[2, 3, 2\] .*got \[2, 2\]"),
        ({"rest_uv": flat * np.nan}, ValueError, r"Cloth\.rest_uv must be finite, got nan"),
        ({"rest_curvature": "flat"}, ValueError, r"Cloth\.rest_curvature .*got 'flat'"),
        ({"rest_curvature": -1.0}, ValueError, r"Cloth\.rest_curvature .*got -1\.0"),
        ({"warp": 0.0, "grain": (1, 0, 0)}, ValueError, r"Cloth\.warp .*got 0\.0"),
        ({"weft": [1.0], "grain": (1, 0, 0)}, ValueError, r"Cloth\.weft .*got \[1\]"),
        ({"warp": 1.0}, ValueError, r"Cloth\.grain must be given .*got None"),
        ({"grain": (1, 0, 0)}, ValueError, r"Cloth\.grain .*without either"),
        ({"warp": 1.0, "grain": (0, 1, 0)}, ValueError, r"Cloth\.grain .*got the normal of that at 0 \(2 in all\)"),
        ({"warp": 1.0, "grain": (0, 0, 0)}, ValueError, r"Cloth\.grain must not be zero, got \[0\.0, 0\.0, 0\.0\]"),
        ({"warp": 1.0, "grain": (0, 1, 0), "rest_uv": flat}, ValueError, r"Cloth\.grain must be \[2\] .*got \[3\]"),
    ):
        with pytest.raises(kind, match=message):
            cloth(**{"mesh": mesh, **changed})
    with pytest.raises(TypeError, match=r"Cloth has no argument 'density'; .*`area_density`"):
        cloth(mesh, density=1000.0)
    with pytest.warns(
        pd.MeshWarning, match=r"rest_uv spans 100 m\^2, and the surface 1 m\^2.*multiply rest_uv by 0\.1"
    ):
        cloth(mesh, rest_uv=10.0 * flat)
    with pytest.warns(pd.MeshWarning, match=r"Cloth: the surface is 200 m long, .*pass surface\.scaled\(0\.001\)"):
        cloth(mesh.scaled(200.0))
    with pytest.raises(ValueError, match="every vertex must belong to an element, got 1 of 4"):
        pd.TriMesh(mesh.vertices, [[0, 1, 2]])
