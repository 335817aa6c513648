"""Rest, friction and grip: statics and the motion of rigid bodies, step by step as implicit Euler has them."""

from __future__ import annotations

import math

import pytest
import torch
from contact_scenes import THICKNESS, G, H, dragged, gripper, mean_of, slope, stack


def test_a_cube_at_rest_on_a_mesh_plane() -> None:
    """Its weight, 9.81 N, to 1e-4, at the thickness to 1e-6 m; 40 steps."""
    step = slope(0.0, 0.0, cells=2).last(40, 24)
    assert float(step.contacts.held.normal.sum()) == pytest.approx(G, rel=1e-4)
    assert float(step.positions[:, 1].min()) == pytest.approx(THICKNESS, abs=1e-6)
    assert step.gap == pytest.approx(1.0, abs=1e-3)


def test_a_cube_at_rest_on_another_one() -> None:
    """The upper one is carried by forces of 9.81 N, the lower one by the ground."""
    case = stack(2, friction=0.5)
    step = case.last(20, 32)
    upper = case.scene.surfaces.body == 1
    assert float(step.forces[upper, 1].sum()) == pytest.approx(G, rel=1e-3)
    assert float(step.velocities.norm(dim=1).max()) < 1e-2


def test_a_block_sticks_on_a_slope() -> None:
    """tan 20 degrees < .5: forces of the last step carry it; without them it would creep."""
    step = slope(20.0, 0.5, cells=2).last(30, 16)
    assert float(step.velocities.norm(dim=1).max()) < 1e-5


@pytest.mark.parametrize(("degrees", "friction"), [(30.0, 0.5), (20.0, 0.3)])
def test_a_block_slides_down_a_slope(degrees: float, friction: float) -> None:
    """k h g (sin a - mu cos a) after k steps, and what parts that stick at first lend it."""
    case = slope(degrees, friction, cells=2)
    step = case.last(20, 32)
    angle = math.radians(degrees)
    rigid = 20 * H * G * (math.sin(angle) - friction * math.cos(angle))
    speed = float(torch.tensor(mean_of(case, step.velocities)).norm())
    assert rigid < speed < 1.03 * rigid


def test_a_plane_drags_a_held_block() -> None:
    """By friction times what it carries, in iterations alone: coarse corrections do not move what pins hold."""
    case = dragged(0.5)
    _, *dragging = case.steps(4, 16)
    for step in dragging:
        normal, along = float(step.contacts.held.normal.sum()), float(step.forces[: case.scene.count, 0].sum())
        assert normal > 10.0
        assert along == pytest.approx(0.5 * normal, rel=1e-3)


def test_a_block_stops() -> None:
    """2 m/s, mu = .4: it loses h mu g a step, 2 - 30 h mu g after 30, by pairs that are new in every step."""
    case = slope(0.0, 0.4, speed=2.0, cells=2)
    start = mean_of(case, case.scene.surfaces.rest[: case.scene.count])[0]
    way = 0.0
    for number, step in enumerate(case.steps(32, 64)):
        speed = 2.0 - (number + 1) * H * 0.4 * G
        if number < 30:
            way += H * speed
            assert mean_of(case, step.velocities)[0] == pytest.approx(speed, abs=0.01)
            assert float(step.forces[: case.scene.count, 0].sum()) == pytest.approx(
                -0.4 * float(step.contacts.held.normal.sum()), rel=2e-2
            )
        if number == 29:
            assert mean_of(case, step.velocities)[0] == pytest.approx(0.038, abs=2e-3)
            assert mean_of(case, step.positions)[0] - start == pytest.approx(way, abs=1.5e-3)
    # its lower face is at rest; the block swings back by what it was sheared
    assert abs(mean_of(case, step.velocities)[0]) < 0.02


@pytest.mark.parametrize(("friction", "steps", "lifted"), [(0.8, 50, 0.1), (0.0, 60, 0.0)])
def test_a_gripper(friction: float, steps: int, lifted: float) -> None:
    """By .1 m to 1 mm with friction; without it the cube stays down: the control."""
    case = gripper(friction, 2)
    step = case.last(steps, 16)
    assert mean_of(case, step.positions)[1] - 0.025 == pytest.approx(lifted, abs=1e-3)
    assert float(step.held_back.max()) == 0.0
