"""The surface of a scene: solids by their boundary or embedded surface, sheets, and rods as tubes."""

from __future__ import annotations

import numpy as np
import pytest
from sheets import cloth

import torchpd as pd
from torchpd.viewing.bodies import SceneSurface

SIDES, RADIUS = 6, 0.02


def volume(vertices: np.ndarray, triangles: np.ndarray) -> float:
    return pd.TriMesh(vertices, triangles).volume()


def rod(points: np.ndarray) -> pd.Rod:
    return pd.Rod(points, 1e6, RADIUS)


def test_a_straight_tube_is_a_closed_prism() -> None:
    """Area of a regular polygon times the length; every ring vertex lies at the radius."""
    skin = SceneSurface(pd.Scene(rod(np.linspace((0, 0, 0), (0.3, 0.4, 1.2), 5))), sides=SIDES)
    points = np.linspace((1.0, 0, 0.5), (1, 0, 1.8), 5)
    drawn = skin.apply(points)
    assert drawn.shape == (5 * SIDES, 3)
    area = 0.5 * SIDES * np.sin(2.0 * np.pi / SIDES) * RADIUS**2
    assert volume(drawn, skin.triangles) == pytest.approx(1.3 * area, rel=1e-12)
    rings = drawn.reshape(5, SIDES, 3) - points[:, None]
    np.testing.assert_allclose(np.linalg.norm(rings, axis=2), RADIUS, rtol=1e-12)
    edges = np.sort(skin.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()


def test_a_tube_neither_twists_nor_breaks() -> None:
    """Rings of a helix are normal to it and turn little; segments that coincide or turn back give finite rings."""
    angle = np.linspace(0.0, 9.0, 60)
    helix = np.stack([np.cos(angle), 0.2 * angle, np.sin(angle)], axis=1)
    skin = SceneSurface(pd.Scene(rod(helix)), sides=SIDES)
    rings = skin.apply(helix).reshape(60, SIDES, 3) - helix[:, None]
    tangent = np.gradient(helix, axis=0)[1:-1]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    assert np.abs(np.einsum("nsk,nk->ns", rings[1:-1], tangent)).max() < 1e-12
    turned = np.arccos(np.clip((rings[1:] * rings[:-1]).sum(axis=2) / RADIUS**2, -1.0, 1.0))
    assert turned.max() < 9.0 / 59 + 1e-12  # no more than the tangent
    folded = helix.copy()
    folded[10], folded[20] = folded[11], folded[18]
    assert np.isfinite(skin.apply(np.stack([folded, 0.0 * helix]))).all()


def test_all_bodies_of_a_scene() -> None:
    mesh = pd.shapes.box((0.4, 0.2, 0.2), (2, 1, 1))
    outer = pd.TriMesh(mesh.vertices[:3], [[0, 1, 2]])
    carried = pd.Solid(mesh.with_embedding(pd.embed(outer, mesh)), 1e5)
    sheet, line, solid = cloth(), rod(np.linspace((0, 2, 0), (1, 2, 0), 3)), pd.Solid(mesh, 1e5)
    scene = pd.Scene(sheet, carried, line, solid)
    skin = SceneSurface(scene, sides=SIDES)
    moved = scene.rest_positions + [[[0.0, 0, 0]], [[1.0, 2.0, 3.0]]]
    drawn = skin.apply(moved[:, None])
    counts = [25, 3, 3 * SIDES, len(mesh.vertices)]
    assert drawn.shape == (2, 1, sum(counts), 3)
    np.testing.assert_allclose(drawn[1] - drawn[0], np.broadcast_to([1.0, 2, 3], drawn[0].shape), atol=1e-12)
    own = np.split(drawn[0, 0], np.cumsum(counts)[:-1])
    assert np.array_equal(own[0], sheet.surface.vertices)
    np.testing.assert_allclose(own[1], outer.vertices, atol=1e-12)
    assert np.array_equal(own[3], mesh.vertices)
    colors = [np.unique(part, axis=0) for part in np.split(skin.colors, np.cumsum(counts)[:-1])]
    assert np.unique(np.concatenate(colors), axis=0).shape == (4, 3)  # one for each body
    sizes = [len(sheet.surface.triangles), 1, 2 * SIDES * 2 + 2 * (SIDES - 2), len(mesh.boundary())]
    assert len(skin.triangles) == sum(sizes)
    assert skin.triangles.max() == sum(counts) - 1
    with pytest.raises(ValueError, match=r"positions must be \[\.\.\., 52, 3\]"):
        skin.apply(moved[:, 1:])
    with pytest.raises(ValueError, match="sides"):
        SceneSurface(scene, sides=2)
