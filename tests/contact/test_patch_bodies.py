"""Bodies of free-form patches in contact: their triangles meet others, and a warning says what quadrics add."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from body_scenes import H

import torchpd as pd

G = 9.81
TABLE = pd.Collider(pd.shapes.box((0.4, 0.02, 0.4)).translated((-0.2, -0.02, -0.2)), friction=0.5)


def ball(
    place: tuple[float, float, float], quadrics: pd.Quadrics | None = None, apex: Any = "skeleton"
) -> pd.PatchBody:
    mesh = pd.shapes.sphere(0.05)
    return pd.PatchBody(pd.FreeFormPatches.from_mesh(mesh.translated(place), quadrics), 5e4, apex=apex)


@pytest.mark.parametrize("apex", ["skeleton", "prism"])
def test_they_pile_up(apex: str) -> None:
    """One falls on the other, which falls on a table: no crossing at any end."""
    bodies = ball((0.0, 0.06, 0.0), None, apex), ball((0.002, 0.17, 0.0), None, apex)
    with warnings.catch_warnings():
        warnings.simplefilter("error", pd.SceneWarning)
        sim = pd.Simulator(pd.Scene(*bodies, TABLE, pd.Gravity(), pd.Contact(friction=0.5)), H, 64, progress=False)
    state: Any = sim.rest_state()
    for _ in range(30):
        before = state
        state = sim(state)
        sim.check(state)
    assert float(state.positions[..., 1].min()) > 0.0
    forces = sim.contact_forces(before, state)
    assert float(forces.on_colliders[0, 0, 1]) < -1.0
    assert float(forces.between[bodies].force.norm()) > 1.0


def test_a_ball_at_rest() -> None:
    """It rests on the triangles, with the force of its weight, at the thickness."""
    body = ball((0.0, 0.051, 0.0))
    sim = pd.Simulator(
        pd.Scene(body, TABLE, pd.Gravity(), pd.Contact(friction=0.5)), H, 64, "chebyshev", torch.float64, progress=False
    )
    state: Any = sim.rest_state()
    for _ in range(60):
        before = state
        state = sim(state)
    held = float(-sim.contact_forces(before, state).on_colliders[0, 0, 1])
    assert sim.body_contact is not None
    assert held == pytest.approx(G * body.masses().sum(), rel=1e-3)
    assert float(state.positions[..., 1].min()) == pytest.approx(sim.body_contact.plan.thickness, rel=1e-2)


def bumpy(height: float = 0.004) -> pd.PatchBody:
    """A ball with a bump on its top."""
    centre = torch.tensor([[0.5, 0.11, 0.0]])
    quadric = pd.Quadrics.from_radii(torch.tensor([height]), centre, torch.tensor([0.03]))
    return ball((0.5, 0.06, 0.0), quadric)


def test_what_quadrics_add_is_said() -> None:
    """By its number, where it is more than the thickness; `rise` is the largest height of flat bases."""
    body = bumpy()
    grid = torch.tensor([[1.0, 1.0, 2.0], [2.0, 1.0, 1.0], [1.0, 2.0, 1.0]]) / 4.0
    count = len(body.patches.triangles)
    samples = body.patches.samples(torch.arange(count).repeat_interleave(3), grid.repeat(count, 1))
    heights = body.patches.heights(samples)[0].abs().max()
    assert 0.001 < float(heights) <= body.rise() + 1e-9 <= 0.005
    with pytest.warns(pd.SceneWarning, match=rf"patches lie up to {body.rise():.2g} m from their triangles"):
        pd.Simulator(pd.Scene(body, TABLE, pd.Contact()), progress=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error", pd.SceneWarning)
        pd.Simulator(pd.Scene(body, pd.Ground()), progress=False)
        pd.Simulator(pd.Scene(ball((0.0, 0.06, 0.0)), TABLE, pd.Contact()), progress=False)
        pd.Simulator(pd.Scene(bumpy(0.0005), TABLE, pd.Contact()), progress=False)


def test_their_triangles_are_those_of_the_patches() -> None:
    """Gaps between the constraints of a skeleton, of which an octopus has many, are no surface."""
    body = pd.PatchBody(pd.FreeFormPatches.from_mesh(pd.shapes.octopus(cells=16)), 1e5)
    assert len(body.mesh.boundary()) > len(body.patches.triangles)
    sim = pd.Simulator(pd.Scene(body, pd.Contact()), iterations=16, progress=False)
    assert sim.body_contact is not None
    assert np.array_equal(sim.body_contact.plan.triangles, body.patches.triangles.numpy())
    sim.check(sim.rest_state())


def test_one_that_takes_no_part() -> None:
    """It passes through others, as `Contact(solid)` says, and nothing is said of its quadrics."""
    solid, body = pd.Solid(pd.shapes.box((0.1,) * 3, (2,) * 3).translated((0.0, 0.1, 0.0)), 1e5), bumpy()
    with warnings.catch_warnings():
        warnings.simplefilter("error", pd.SceneWarning)
        sim = pd.Simulator(pd.Scene(solid, body, TABLE, pd.Contact(solid, TABLE)), iterations=16, progress=False)
    assert sim.body_contact is not None
    assert len(sim.body_contact.plan.triangles) == len(solid.mesh.boundary()) + len(TABLE.mesh.triangles)


def test_a_file_would_lose_the_patches(tmp_path: Path) -> None:
    sim = pd.Simulator(pd.Scene(ball((0.0, 0.06, 0.0)), TABLE, pd.Contact()), iterations=16, progress=False)
    with pytest.raises(ValueError, match=r"a PatchBody that takes part in Contact cannot be written.*patches.save"):
        sim.save(tmp_path / "ball.safetensors")
    solid = pd.Solid(pd.shapes.box((0.1,) * 3, (2,) * 3).translated((0.5, 0.1, 0.0)), 1e5)
    apart = pd.Simulator(pd.Scene(ball((0.0, 0.06, 0.0)), solid, pd.Contact(solid)), iterations=16, progress=False)
    apart.save(tmp_path / "ball.safetensors")
