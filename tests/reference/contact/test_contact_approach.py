"""Whole bodies at the start of a step, colliders that turn, and planes of the scene."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from contact_scenes import (
    THICKNESS,
    ContactCase,
    H,
    block,
    box_collider,
    each,
    falling,
    poses_of,
    sheet_body,
    two_cubes,
    watched,
)

import torchpd as pd
from torchpd.reference.contact import contact_scene
from torchpd.reference.contact.approach import rigid_ways


def first_places(case: ContactCase) -> torch.Tensor:
    """x_0."""
    seen = []
    next(case.steps(1, 0, observe=lambda _, x: seen.append(x)))
    return seen[0]


def test_rigid_ways_are_those_of_the_momenta() -> None:
    """A rigid motion is found as it is, and what is left of any other has no momentum."""
    random = torch.Generator().manual_seed(0)
    x, masses = torch.randn((30, 3), dtype=torch.float64, generator=random), torch.rand(30, dtype=torch.float64)
    body = torch.arange(30) // 10
    turns = torch.randn((3, 3), dtype=torch.float64, generator=random)
    shifts = torch.randn((3, 3), dtype=torch.float64, generator=random)
    ways = shifts[body] + torch.linalg.cross(turns[body], x)
    assert (rigid_ways(x, ways, masses, body, 3) - ways).abs().max() < 1e-12
    other = torch.randn((30, 3), dtype=torch.float64, generator=random)
    rest = masses[:, None] * (other - rigid_ways(x, other, masses, body, 3))
    for own in (body == number for number in range(3)):
        assert rest[own].sum(dim=0).abs().max() < 1e-12
        assert torch.linalg.cross(x[own], rest[own]).sum(dim=0).abs().max() < 1e-12


@pytest.mark.parametrize("speed", [1.0, 10.0, 100.0])
def test_a_body_stops_at_a_wall_as_a_whole(speed: float) -> None:
    """.05 m before a fixed box: it goes down to the floor and keeps its shape; a coarse correction may turn it."""
    scene = falling(block(0.1, 2), g=0.0)
    wall = box_collider((0.1, -0.2, -0.2), (0.2, 0.2, 0.2), 2)
    case = ContactCase(contact_scene(scene, wall, thickness=THICKNESS), each(scene, (speed, 0.0, 0.0)))
    way = first_places(case)[:27] - case.scene.surfaces.rest[:27]
    expected = min(speed * H, 0.05 - 0.1 * THICKNESS)
    assert float(way[:, 0].min()) == pytest.approx(expected, rel=0.06)
    assert float(way[:, 0].max()) <= expected + 1e-9
    rest = case.scene.surfaces.rest[:27]
    before, after = ((x[:, None] - x).norm(dim=2) for x in (rest, rest + way))
    assert (after - before).abs().max() < 1e-14


def test_a_crumpled_body_takes_its_rigid_motion() -> None:
    """Both ends of a sheet fly through each other: their own ways would cross, their mean is what it takes."""
    curled = sheet_body((0.1, 0.02), (10, 2), lambda p: np.stack(
        [0.03 * np.sin(50.0 * p[:, 0]), 0.03 * np.cos(50.0 * p[:, 0]), p[:, 2]], axis=1))  # fmt: skip
    scene = falling(curled, g=0.0)
    velocities = each(scene, (0.0, -5.0, 0.0))
    velocities[:, 0] = -10.0 * np.sign(curled.mesh.vertices[:, 0])
    case = ContactCase(contact_scene(scene, thickness=THICKNESS), velocities)
    assert watched(case, 1, 4).crossed == 0
    masses = torch.tensor(case.scene.values.masses)
    moved = (masses[:, None] * (first_places(case) - case.scene.surfaces.rest)).sum(dim=0) / masses.sum()
    assert float(moved[1]) == pytest.approx(-5.0 * H, rel=1e-2)


def test_a_paddle_that_turns() -> None:
    """Ten radians a second against a cube: its points keep their distances, and it strikes the cube away."""
    paddle = box_collider((0.02, -0.1, -0.005), (0.22, 0.1, 0.005), 4)

    def poses(t: float) -> np.ndarray:
        half = 5.0 * t
        return poses_of((0.0, 0.0, 0.0), turns=[[math.cos(half), 0.0, -math.sin(half), 0.0]])

    scene = falling(block(0.1, 2, center=(0.15, 0.0, 0.08)), g=0.0)
    made = contact_scene(scene, paddle, thickness=THICKNESS)
    case = ContactCase(made, each(scene, (0.0, 0.0, 0.0)), poses=poses)
    run = watched(case, 10, 16)
    assert run.crossed == 0
    points = torch.tensor(paddle.points)
    for step in run.steps:
        placed = step.history.positions[made.count :]
        apart = (placed[:, None] - placed[None]).norm(dim=2) - (points[:, None] - points[None]).norm(dim=2)
        assert float(apart.abs().max()) < 1e-15
    assert float(run.steps[-1].velocities[:, 2].mean()) > 0.5


def test_a_collider_that_cannot_go_on_is_held_back_as_a_whole() -> None:
    """A plate pushes a pinned slab against its pins: what is left of its way is said, and goes on in the next step."""
    slab = block((0.1, 0.02, 0.1), (2, 1, 2))
    scene = pd.Scene(slab, pd.Pin(slab, slab.mesh.vertices[:, 1] < 0.0), pd.Gravity((0.0, 0.0, 0.0)))
    plate = box_collider((-0.1, 0.012, -0.1), (0.1, 0.03, 0.1), 2)

    def poses(t: float) -> np.ndarray:
        return poses_of((0.0, -0.03 if t < 5.5 * H else 0.0, 0.0))

    made = contact_scene(scene, plate, thickness=THICKNESS)
    case = ContactCase(made, each(scene, (0.0, 0.0, 0.0)), poses=poses)
    run = watched(case, 8, 16)
    assert run.crossed == 0
    deepest = float(run.steps[4].history.poses[0, 1])
    assert -0.022 < deepest < -0.018  # the pins are at -.01 m, .022 m below
    assert float(run.steps[4].held_back) == pytest.approx(0.03 + deepest, abs=1e-12)
    assert float(run.steps[-1].held_back) == 0.0


def test_contact_pushes_nothing_below_the_ground() -> None:
    lowest = []
    for _ in two_cubes(2, speed=5.0).steps(8, 8, observe=lambda _, x: lowest.append(float(x[:, 1].min()))):
        pass
    assert min(lowest) >= -1e-15
