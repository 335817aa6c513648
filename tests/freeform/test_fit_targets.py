"""What patches can be fitted to, distances from it, and what is refused by name."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from patch_cases import ball, sheet

import torchpd as pd
from torchpd.freeform.targets import CloudTarget, FieldTarget, MeshTarget, intersect_lines, project, target_of

BOX = [[-1.5] * 3, [1.5] * 3]


def cube() -> pd.TriMesh:
    return pd.TriMesh.from_trimesh(trimesh.creation.box((2.0, 2.0, 2.0)))


def test_distances_from_a_cube() -> None:
    """Over a face, an edge and a corner, inside and on it."""
    points = np.array([[0.3, 0.2, 1.5], [2.0, 2.0, 0.1], [2.0, 2.0, 2.0], [0.9, 0.0, 0.1], [1.0, 0.25, 0.5]])
    distance, gradient, _ = MeshTarget(cube()).near(points)
    np.testing.assert_allclose(distance, [0.5, np.sqrt(2.0), np.sqrt(3.0), -0.1, 0.0], atol=1e-12)
    half, third = np.sqrt(0.5), np.sqrt(1 / 3)
    ways = [[0, 0, 1], [half, half, 0], [third] * 3, [1, 0, 0], [1, 0, 0]]
    np.testing.assert_allclose(gradient, ways, atol=1e-9)


def test_a_function_is_measured_by_its_gradient() -> None:
    """|x|^2 - 1 is no distance, but to first order: (r^2 - 1) / 2 r."""
    target = FieldTarget(lambda x: x.square().sum(1) - 1.0, BOX)
    distance, gradient, _ = target.near(np.array([[1.1, 0.0, 0.0], [0.0, 0.0, -0.9]]))
    np.testing.assert_allclose(distance, [0.21 / 2.2, -0.19 / 1.8], rtol=1e-12)
    np.testing.assert_allclose(gradient, [[1, 0, 0], [0, 0, -1]], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(project(target, np.array([[1.3, 0.2, 0.1]])), axis=1), 1.0, atol=1e-12)


def test_rays_meet_a_sphere_where_they_should() -> None:
    rng = np.random.default_rng(0)
    start = 0.9 * rng.standard_normal((50, 3))
    start /= 1.2 * np.linalg.norm(start, axis=1, keepdims=True)
    ways = start + 0.2 * rng.standard_normal((50, 3))
    t, normals, found = intersect_lines(FieldTarget(lambda x: x.norm(dim=1) - 1.0, BOX), start, ways, np.full(50, 2.0))
    b, c = (start * ways).sum(1), (start**2).sum(1) - 1.0
    a = (ways**2).sum(1)
    assert found.mean() > 0.9
    np.testing.assert_allclose(t[found], ((np.sqrt(b**2 - a * c) - b) / a)[found], atol=1e-9)
    hit = start + t[:, None] * ways
    np.testing.assert_allclose(normals[found], hit[found], atol=1e-9)


def test_rays_that_leave_out_of_reach_or_the_wrong_way() -> None:
    target = MeshTarget(cube())
    start = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 1.1]])
    ways = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    t, _, found = intersect_lines(target, start, ways, np.array([1.0, 0.4, 1.0]))
    np.testing.assert_array_equal(found, [True, False, False])
    assert t[0] == pytest.approx(0.5)


def test_a_cloud_finds_its_normals() -> None:
    """Points on a sphere: planes through sixteen of them, turned outwards together."""
    points = ball(3).vertices
    cloud = CloudTarget(points)
    assert float((cloud.normals * points).sum(axis=1).min()) > 0.99
    given = CloudTarget(points, 3.0 * points)
    distance, _, normal = given.near(1.05 * points)
    np.testing.assert_allclose(distance, 0.05, atol=2e-3)  # times cos^2 of half the angle to a neighbour, 0.3 at most
    np.testing.assert_allclose(given.near(points)[0], 0.0, atol=1e-3)
    assert float((normal * points).sum(axis=1).min()) > 0.99


def test_corners_in_one_place_count_as_one() -> None:
    """A mesh that repeats its vertices along seams, as files with texture coordinates do."""
    fine = ball(2)
    soup = pd.TriMesh(fine.vertices[fine.triangles].reshape(-1, 3), np.arange(3 * len(fine.triangles)).reshape(-1, 3))
    assert len(MeshTarget(soup).surface.vertices) == len(fine.vertices)


def inside_out() -> pd.TriMesh:
    return pd.TriMesh(ball(2).vertices, ball(2).triangles[:, ::-1])


def half_turned() -> pd.TriMesh:
    triangles = ball(1).triangles.copy()
    triangles[:10] = triangles[:10, ::-1]
    return pd.TriMesh(ball(1).vertices, triangles)


def folded() -> pd.TriMesh:
    """A ball with a mushroom on it, over a base of four triangles."""
    fine = ball(4)
    up = np.clip(fine.vertices[:, 2:] - 0.3, 0.0, None)
    neck = np.where(fine.vertices[:, 2:] > 0.3, 0.25 + 4.0 * up**2, 1.0)
    return pd.TriMesh(
        fine.vertices * [1.0, 1.0, 1.0] * np.concatenate([neck, neck, 1.0 + 3.0 * up], axis=1), fine.triangles
    )


@pytest.mark.parametrize(
    ("target", "options", "message"),
    [
        (inside_out(), {}, "counter-clockwise seen from outside, got a closed surface of volume -"),
        (half_turned(), {}, r"target .*got edge \[2, 6\]"),
        (folded(), {"patches": 4}, r"must be a height over the base, .* it folds there; use more patches"),
        (np.zeros((100, 3)), {}, "a cloud must have at least 64 points"),
        (np.zeros((100, 2)), {}, r"target .*got \[100, 2\]"),
        (np.full((100, 3), np.nan), {}, "target .*got nan"),
        (ball(3).vertices, {"normals": np.ones((3, 3))}, r"normals .*got \[3, 3\]"),
        (ball(3).vertices, {"normals": np.zeros((642, 3))}, "normals .*got 0 at 0"),
        (ball(3), {"normals": np.ones((642, 3))}, "normals belong to a cloud of points"),
        (ball(3), {"bounds": BOX}, "bounds belong to a function"),
        (lambda x: x.norm(dim=1) - 1.0, {}, "bounds must say where the surface of a function lies"),
        (
            lambda x: x.norm(dim=1) - 1.0,
            {"bounds": BOX[::-1]},
            r"bounds .*got \[\[1\.5, 1\.5, 1\.5\], \[-1\.5, -1\.5, -1\.5\]\]",
        ),
        (lambda x: x.norm(dim=1) + 1.0, {"bounds": BOX}, "must enclose a body within its bounds, .* got no closed"),
        (lambda x: x, {"bounds": BOX}, r"must turn points \[N, 3\] into a tensor \[N\], got \[2, 3\] for N=2"),
        (lambda x: x.detach().norm(dim=1), {"bounds": BOX}, "must be differentiable by torch"),
        (lambda x: x.norm(dim=1) * np.nan, {"bounds": BOX}, "must have finite values and gradients, got"),
        (ball(3), {"patches": 3}, "patches .*got 3"),
        (ball(3), {"quadrics": 0}, "quadrics .*got 0"),
        (ball(3), {"optimizer": "sgd"}, "optimizer .*got 'sgd'"),
        (ball(3), {"iterations": 0}, "iterations .*got 0"),
        (ball(3), {"radius_cap": 0.01}, "radius_cap must be >= 0.1"),
        (ball(3), {"base": "round"}, "base .*got 'round'"),
    ],
)
def test_what_cannot_be_fitted(target: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        pd.FreeFormPatches.fit(target, **{"quadrics": 4, "patches": 20, "iterations": 2, **options})


def test_a_target_of_another_kind() -> None:
    with pytest.raises(TypeError, match=r"target .*got str"):
        target_of("bunny.obj")


def test_an_open_surface() -> None:
    """A wavy sheet keeps its boundary, and patches their distance."""
    fit = pd.FreeFormPatches.fit(sheet(24), 12, patches=24, iterations=20)
    # chords of waves of 0.2 with 24 triangles are 0.02 off; the sheet itself bends within its cells by 1e-3
    assert fit.report.rms <= 4e-3
    assert fit.report.missed < 0.05
    assert torch.linalg.vector_norm(fit.patches.directors, dim=1).sub(1.0).abs().max() < 1e-6
