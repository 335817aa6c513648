"""Mass, centre of mass and inertia of colliders, and what is refused of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import torchpd as pd
from torchpd.scene.rigid import rigid_mass


def surface(mesh: pd.TetMesh) -> pd.TriMesh:
    return pd.Collider(mesh).mesh


def test_a_box_has_the_moments_of_a_uniform_one() -> None:
    """m (b^2 + c^2) / 12 about its middle, wherever the mesh lies."""
    a, b, c = 0.1, 0.2, 0.3
    of = rigid_mass(surface(pd.shapes.box((a, b, c), (2, 3, 4)).translated((1.0, 2.0, 3.0))), 2.0, None)
    np.testing.assert_allclose(of.center, [1.05, 2.1, 3.15], rtol=1e-12)
    moments = np.diag([b * b + c * c, a * a + c * c, a * a + b * b]) * 2.0 / 12.0
    np.testing.assert_allclose(of.inertia, moments, rtol=0, atol=1e-12)


def test_a_sphere_has_two_fifths() -> None:
    """2 / 5 m r^2 of a fine triangulation, which lies inside."""
    of = pd.Collider(pd.shapes.sphere(0.1, 24), mass=3.0).rigid
    assert of is not None
    np.testing.assert_allclose(of.inertia, 0.4 * 3.0 * 0.01 * np.eye(3), rtol=0, atol=0.005 * 0.012)


def test_winding_does_not_matter() -> None:
    out = surface(pd.shapes.box((0.1, 0.2, 0.3), (1, 1, 1)))
    inside = pd.TriMesh(out.vertices, out.triangles[:, ::-1])
    one, other = (rigid_mass(mesh, 1.0, None) for mesh in (out, inside))
    np.testing.assert_allclose(one.inertia, other.inertia, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(one.center, other.center, rtol=1e-12)


def test_an_open_surface_has_the_centre_of_its_area_and_given_moments() -> None:
    sheet = pd.shapes.sheet((0.2, 0.4), (2, 2)).translated((1.0, 0.0, 0.0))
    of = pd.Collider(sheet, mass=1.0, inertia=(1e-3, 2e-3, 2.5e-3)).rigid
    assert of is not None
    np.testing.assert_allclose(of.center, sheet.vertices.mean(axis=0), atol=1e-12)
    np.testing.assert_array_equal(of.inertia, np.diag([1e-3, 2e-3, 2.5e-3]))


@pytest.mark.parametrize(
    ("given", "error", "match"),
    [
        ({"mass": 0.0}, ValueError, "mass must be positive"),
        ({"mass": -1.0}, ValueError, "mass must be positive"),
        ({"mass": float("nan")}, ValueError, "mass"),
        ({"mass": "heavy"}, TypeError, "mass"),
        ({"inertia": (1.0, 1.0, 1.0)}, ValueError, "inertia must come with a mass"),
        ({"mass": 1.0, "inertia": (1.0, 1.0)}, ValueError, r"inertia must be \[3\] or \[3, 3\]"),
        ({"mass": 1.0, "inertia": (1.0, 1.0, 2.1)}, ValueError, "none larger than the sum"),
        ({"mass": 1.0, "inertia": (1.0, 1.0, 0.0)}, ValueError, "positive principal moments"),
        ({"mass": 1.0, "inertia": [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]}, ValueError, "symmetric"),
    ],
)
def test_what_is_no_mass_is_refused(given: dict[str, Any], error: type[Exception], match: str) -> None:
    with pytest.raises(error, match=match):
        pd.Collider(pd.shapes.box((0.1, 0.1, 0.1), (1, 1, 1)), **given)


def test_an_open_surface_without_moments_is_refused() -> None:
    with pytest.raises(ValueError, match="inertia must be given for an open surface"):
        pd.Collider(pd.shapes.sheet((0.2, 0.4), (2, 2)), mass=1.0)


def test_friction_may_name_two_colliders_of_which_one_has_a_mass() -> None:
    box = pd.shapes.box((0.1, 0.1, 0.1), (1, 1, 1))
    cube = pd.Solid(box, youngs=1e5, density=1e3)
    still, other, free = pd.Collider(box), pd.Collider(box), pd.Collider(box, mass=1.0)
    pd.Scene(cube, still, other, free, pd.Contact(friction={(still, free): 0.2}))
    with pytest.raises(ValueError, match="colliders without a mass do not touch"):
        pd.Scene(cube, still, other, free, pd.Contact(friction={(still, other): 0.2}))


def test_a_closed_surface_wound_both_ways_has_no_moments_of_its_own() -> None:
    box = pd.shapes.box((0.1, 0.1, 0.1), (1, 1, 1))
    triangles = box.boundary().copy()
    triangles[0] = triangles[0, ::-1]
    with pytest.raises(ValueError, match="None and 3 edges that do not join two triangles in opposite directions"):
        pd.Collider(pd.TriMesh(box.vertices, triangles), mass=1.0)
