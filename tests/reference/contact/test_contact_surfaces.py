"""Surfaces: triangles, edges and vertices, which pairs count, and their thickness."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cases import box
from contact_scenes import block, box_collider, each, falling, sheet_body

import torchpd as pd
from torchpd.reference.contact import contact_scene
from torchpd.reference.contact.search import near_pairs
from torchpd.reference.contact.surfaces import Surfaces, surface_triangles


def made(*, self_contact: bool = True, thickness: float = 1e-3, dtype: torch.dtype = torch.float64) -> Surfaces:
    """A cube with four pins, and a fixed box beside another one."""
    cube = block(0.1, 2)
    scene = pd.Scene(cube, pd.Pin(cube, np.flatnonzero(cube.mesh.vertices[:, 0] < -0.049)))
    boxes = [box_collider((low, -0.1, -0.1), (low + 0.1, 0.1, 0.1)) for low in (0.06, 0.165)]
    return contact_scene(scene, *boxes, thickness=thickness, self_contact=self_contact, dtype=dtype).surfaces


def test_the_surface_of_a_box() -> None:
    """2 n^2 triangles a face, wound outward; Euler: V - E + F = 2."""
    vertices, tets = box((1.0, 1.0, 1.0), (3, 3, 3))
    faces = surface_triangles(torch.tensor(tets))
    assert len(faces) == 6 * 18
    x = torch.tensor(vertices)[faces]
    volume = (torch.linalg.cross(x[:, 0], x[:, 1]) * x[:, 2]).sum() / 6.0
    assert float(volume) == pytest.approx(1.0)
    surfaces = made()
    assert len(surfaces.vertices) - len(surfaces.edges) + len(surfaces.triangles) == 3 * 2
    assert 13 not in surfaces.vertices.tolist()  # the middle of the cube


def all_pairs(surfaces: Surfaces) -> list[tuple[int, ...]]:
    """1 for edges, then the four vertices."""
    far = torch.full((len(surfaces.rest),), 10.0, dtype=surfaces.rest.dtype)
    pairs = near_pairs(surfaces, surfaces.rest, far)
    return [(int(k >= pairs.points), *four) for k, four in enumerate(pairs.vertices.tolist())]


def test_which_pairs_count() -> None:
    """Each once; none with a common vertex, none of what moves by hand alone; of one body if it touches itself."""
    surfaces = made()
    pairs = all_pairs(surfaces)
    assert len(set(pairs)) == len(pairs)
    for _, *four in pairs:
        assert len(set(four)) == 4
        assert not surfaces.kinematic[four].all()
    own = {pair for pair in pairs if len(set(surfaces.body[list(pair[1:])].tolist())) == 1}
    assert {int(surfaces.body[pair[1]]) for pair in own} == {0}
    assert set(pairs) - own == set(all_pairs(made(self_contact=False)))


def test_parts_that_rest_near_each_other_are_thinner() -> None:
    """r_p is half of the rest distance where that is below 2 r: a cube whose cells have .05 m, r = .04 m."""
    surfaces = made(thickness=0.04)
    pairs = near_pairs(surfaces, surfaces.rest, torch.zeros(len(surfaces.rest), dtype=torch.float64))
    body = surfaces.body[pairs.vertices]
    own = (body == body[:, :1]).all(dim=1)
    assert own.any()
    assert (pairs.thickness[~own] == 0.04).all()
    assert (pairs.thickness[own] <= 0.025).all()
    assert torch.allclose(pairs.floor, 0.1 * pairs.thickness)


def test_rest_distance_zero_is_refused() -> None:
    """Two vertices of a sheet at one place."""
    slit = sheet_body((0.1, 0.1), (4, 4), lambda p: np.minimum(p, 0.1 - p) * [1, 0, 0] + p * [0, 0, 1])
    with pytest.raises(ValueError, match=r"distance 0 between vertices \["):
        contact_scene(falling(slit), thickness=1e-3)


@pytest.mark.parametrize("thickness", [0.0, -1.0, float("nan")])
def test_a_thickness_must_be_positive(thickness: float) -> None:
    with pytest.raises(ValueError, match="thickness must be positive"):
        made(thickness=thickness)


def test_a_thickness_below_rounding_is_refused() -> None:
    with pytest.raises(ValueError, match=r"thickness must be at least .* torch.float32, got 1e-05"):
        made(thickness=1e-5, dtype=torch.float32)
    assert made(thickness=1e-5).thickness == 1e-5


def test_starts_that_cross_or_touch() -> None:
    """The error names the edge, the triangle and their bodies; a distance below the certificate is refused, too."""
    scene = falling(block(0.1, 1), block(0.1, 1, center=(0.0, 0.2, 0.0)))
    contact = contact_scene(scene, thickness=1e-3)
    x = contact.surfaces.rest.clone()
    contact.check_start(x)
    x[8:, 1] -= 0.11
    x[8:, 0] += 0.013
    x[8:, 2] += 0.017
    with pytest.raises(
        ValueError, match=r"positions .* crossings.* edge \(\d+, \d+\) of body \d, triangle \d+ of body"
    ):
        contact.check_start(x)
    x[8:, 1] += 0.01
    with pytest.raises(ValueError, match=r"positions must leave .* m between surfaces"):
        contact.check_start(x)
    assert each(scene, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)).shape == (16, 3)
