"""Environments in which no surfaces come near each other: their steps are those of the scene without `Contact`."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from body_scenes import THICKNESS, H, block, crossed, each, gravity, pose

import torchpd as pd
from torchpd.geometry.closest_points import segment_distances, triangle_distances
from torchpd.plan.contact_plan import contact_plan

BODIES = block(0.1, 2, (0.0, 0.0, 0.0)), block(0.1, 2, (0.3, 0.0, 0.0))


def simulators(dtype: torch.dtype = torch.float32) -> tuple[pd.Simulator, pd.Simulator]:
    """With and without contact."""
    scenes = pd.Scene(*BODIES, gravity(), pd.Contact(thickness=THICKNESS)), pd.Scene(*BODIES, gravity())
    with_contact, without = (pd.Simulator(scene, H, 8, dtype=dtype, progress=False) for scene in scenes)
    return with_contact, without


def spinning(sim: pd.Simulator) -> torch.Tensor:
    """Velocities [V, 3] m/s of two cubes that fall and turn."""
    x = sim.rest_positions
    velocities: torch.Tensor = torch.linalg.cross(torch.tensor([3.0, -5.0, 4.0], dtype=x.dtype).expand_as(x), x)
    return velocities


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [1, 9])  # one by one, and side by side
def test_bits_without_contact(dtype: torch.dtype, batch: int) -> None:
    met, alone = simulators(dtype)
    state: Any = met.rest_state(batch)
    state.velocities[:] = spinning(met) + torch.arange(batch, dtype=dtype)[:, None, None]
    plain = pd.State(state.positions.clone(), state.velocities.clone())
    for _ in range(3):
        state, info = met(state, return_info=True)
        plain, expected = alone(plain, return_info=True)
        assert torch.equal(state.positions, plain.positions)
        assert torch.equal(state.velocities, plain.velocities)
        assert torch.equal(info.residual, expected.residual)
        assert torch.isinf(info.contact_gap).all()
        assert not info.contact_pairs.any()
        assert not info.contact_searches.any()
        assert (state.history.keys == -1).all()


@pytest.mark.parametrize("ground", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bits_of_the_steps_with_contact(dtype: torch.dtype, ground: bool) -> None:
    """A history with a force asks for a step with contact: where it finds no pair it has the bits of the plain step.

    The force is that of a pair within a body, which is not near: it is dropped, and takes no body's guess back.
    """
    parts = (*BODIES, gravity(), *([pd.Ground(-0.06)] * ground))
    met = pd.Simulator(pd.Scene(*parts, pd.Contact(thickness=THICKNESS)), H, 24, dtype=dtype, progress=False)
    alone = pd.Simulator(pd.Scene(*parts), H, 24, dtype=dtype, progress=False)
    plan = contact_plan(met.scene.values())
    vertex = int(plan.triangles[0, 0])
    other = next(n for n, of in enumerate(plan.triangles) if plan.body[of[0]] == plan.body[vertex] and vertex not in of)
    state: Any = met.rest_state()
    state.velocities[:] = spinning(met)
    plain = pd.State(state.positions.clone(), state.velocities.clone())
    for _ in range(4):
        state.history.keys[:, 0] = vertex * len(plan.triangles) + other
        state.history.forces[:, 0, 0] = 1.0
        state, info = met(state, return_info=True)
        plain = alone(plain)
        assert torch.isinf(info.contact_gap).all()
        assert torch.equal(state.positions, plain.positions)
        assert torch.equal(state.velocities, plain.velocities)


def test_neighbours_in_contact_change_no_bits() -> None:
    """Of 12 environments every third has cubes that meet within the steps; each has the bits that it has alone."""
    met, alone = simulators()
    state: Any = met.rest_state(12)
    meeting = torch.arange(12) % 3 == 1
    state.velocities[meeting] = torch.tensor(each(met.scene, (1.4, 0.0, 0.0), (-1.4, 0.0, 0.0))).float()
    start = state.clone()
    for _ in range(5):
        state = met(state)
    touched = (state.history.keys >= 0).any(dim=1)
    assert torch.equal(touched, meeting)
    for environment in (0, 1, 11):
        own: Any = met.rest_state()
        own.velocities[:] = start.velocities[environment]
        for _ in range(5):
            own = met(own)
        assert torch.equal(own.positions[0], state.positions[environment])
    plain = alone.rollout(pd.State(start.positions, start.velocities), 5).state()
    assert torch.equal(plain.positions[~meeting], state.positions[~meeting])
    assert not torch.equal(plain.positions[meeting], state.positions[meeting])


@pytest.mark.parametrize("speed", [3.0, 15.0, 60.0])
def test_what_a_step_would_pass_is_met(speed: float) -> None:
    """Both ends of the way of a step may be free: at 60 m/s a cube would come out on the far side."""
    sim, _ = simulators(torch.float64)
    state: Any = sim.rest_state()
    state.velocities[:] = torch.tensor(each(sim.scene, (speed, 0.0, 0.0), (0.0, 0.0, 0.0)))
    for _ in range(6):
        state, info = sim(state, return_info=True)
        assert crossed(sim, state) == 0
        if float(info.contact_gap) < 1.1:
            break
    assert float(info.contact_gap) < 1.1
    first = sim.scene.vertex_range(BODIES[0])
    own = slice(first.start, first.stop)
    assert float(state.positions[0, own, 0].mean()) < float(state.positions[0, own.stop :, 0].mean())


def test_colliders_arrive() -> None:
    """One that meets nothing ends at its target; one that would pass through a cube does not."""
    finger = pd.Collider(pd.shapes.box((0.02, 0.02, 0.02), (1, 1, 1)).translated((-0.01, -0.01, 0.99)))
    sim = pd.Simulator(pd.Scene(BODIES[0], finger, pd.Contact(thickness=THICKNESS)), H, 8, progress=False)
    rest: Any = sim.rest_state()
    target = pose(0.0, 0.0, 0.5).float()
    free: Any = sim(rest, targets={finger: target})
    assert torch.equal(free.history.poses[0, 0], target)
    stopped, info = sim(rest, targets={finger: pose(0.0, 0.0, -2.0).float()}, return_info=True)
    assert float(info.held_back) > 0.5
    assert crossed(sim, stopped) == 0


def test_a_body_that_folds_is_searched() -> None:
    """Squeezed beyond its shape a body's own parts are looked for: a thin plate folded onto itself does not cross."""
    mesh = pd.shapes.box((0.3, 0.02, 0.05), (12, 1, 2))
    solid = pd.Solid(mesh, youngs=1e3, density=300.0)
    sim = pd.Simulator(pd.Scene(solid, pd.Contact(thickness=THICKNESS)), H, 16, dtype=torch.float64, progress=False)
    state: Any = sim.rest_state()
    x = sim.rest_positions
    arms = x - x.mean(dim=0)
    # both halves turn upwards about the middle
    turn = torch.stack([0.0 * arms[:, 0], 0.0 * arms[:, 0], 40.0 * torch.sign(arms[:, 0])], dim=1)
    state.velocities[0] = torch.linalg.cross(turn, arms)
    nearest = np.inf
    for _ in range(12):
        state, info = sim(state, return_info=True)
        nearest = min(nearest, float(info.contact_gap))
        assert crossed(sim, state) == 0
    assert nearest < np.inf


def test_least_distances_at_rest() -> None:
    """`ContactPlan.apart` of a solid by brute force; 0 of cloth, colliders and bodies without self-contact."""
    points = BODIES[0].mesh.vertices + [2.0, 0.0, 0.0]
    cloth = pd.Cloth(pd.TriMesh(points[[0, 1, 3, 4]], np.array([[0, 1, 2], [1, 3, 2]])), 1e5, 1e-3, 0.2)
    table = pd.Collider(pd.TriMesh(points[[0, 1, 3, 4]] + [0.0, -1.0, 0.0], np.array([[0, 1, 2], [1, 3, 2]])))
    scene = pd.Scene(*BODIES, cloth, table, pd.Contact(thickness=THICKNESS, self_contact=[BODIES[0], cloth]))
    plan = contact_plan(scene.values())
    assert plan.apart[1:].tolist() == [0.0, 0.0, 0.0]
    own = plan.triangles[(plan.body[plan.triangles] == 0).all(axis=1)]
    edges = plan.edges[(plan.body[plan.edges] == 0).all(axis=1)]
    least = np.inf
    for vertex in np.unique(own):
        beside = own[(own != vertex).all(axis=1)]
        least = min(least, triangle_distances(np.repeat(plan.rest[[vertex]], len(beside), 0), plan.rest[beside]).min())
    for edge in edges:
        beside = edges[~np.isin(edges, edge).any(axis=1)]
        least = min(least, segment_distances(np.repeat(plan.rest[edge][None], len(beside), 0), plan.rest[beside]).min())
    assert plan.apart[0] == pytest.approx(least)
    middle = plan.shape[:27] - (plan.rest[:27] - plan.rest[np.unique(own)].mean(axis=0))
    np.testing.assert_allclose(middle, 0.0, atol=1e-12)
