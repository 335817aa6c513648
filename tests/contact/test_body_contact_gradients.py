"""Gradients of rollouts with contact between bodies: closed forms, and differences of whole rollouts."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from body_scenes import G, H, gripper, simulator, slope
from torch import Tensor

import torchpd as pd

ONE = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)


def at(x: Any, y: Any) -> Tensor:
    """A pose at (x, y, 0)."""
    place = [torch.as_tensor(value, dtype=torch.float64) for value in (x, y, 0.0)]
    return torch.cat([torch.stack(place), ONE])


def mean(sim: pd.Simulator, state: Any) -> Tensor:
    return (sim.masses[:, None] * state.positions[0]).sum(0) / sim.masses.sum()


def test_a_cube_follows_its_table() -> None:
    """d (height of the top) / d (height of the table) = 1 once it rests: to 1e-6 after 20 steps."""
    course = slope(0.0, 0.0)
    (table,) = course.scene.colliders
    sim = simulator(course.scene, 128)
    height = torch.zeros((), dtype=torch.float64, requires_grad=True)
    track = sim.rollout(sim.rest_state(), 20, targets={table: at(0.0, height)})
    (found,) = torch.autograd.grad(track.positions[-1, 0, :, 1].max(), height)
    assert float(found) == pytest.approx(1.0, abs=1e-6)


def test_a_cube_rests_at_the_thickness() -> None:
    """d (height of the top) / d thickness = 1, once it rests: to 1e-6 after 20 steps."""
    course = slope(0.0, 0.0)
    sim = simulator(course.scene, 128)
    thickness = torch.tensor(1.2e-3, dtype=torch.float64, requires_grad=True)
    sim.contact_thickness = thickness
    assert sim.contact_thickness is thickness
    state: Any = sim.rest_state()
    for _ in range(20):
        state = sim(state)
    (found,) = torch.autograd.grad(state.positions[0, :, 1].max(), thickness)
    assert float(found) == pytest.approx(1.0, abs=1e-6)
    assert float(state.positions.detach()[0, :, 1].min()) == pytest.approx(1.2e-3, abs=1e-6)


def test_a_sliding_block() -> None:
    """d x / d friction = -h^2 g k (k + 1) / 2 after k steps: to 1e-3, once it has stopped shaking."""
    course = slope(0.0, 0.4, speed=2.0)
    sim = simulator(course.scene, 256)
    state: Any = course.start(sim)
    for _ in range(15):
        state = sim(state)
    friction = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
    sim.contact_friction = friction
    for k in range(1, 11):
        state = sim(state)
        (found,) = torch.autograd.grad(mean(sim, state)[0], friction, retain_graph=True)
        assert float(found) == pytest.approx(-H * H * G * k * (k + 1) / 2, rel=1e-3)


@pytest.mark.parametrize("iterations", [32, 128])
def test_fingers_lift_a_cube(iterations: int) -> None:
    """The lifted height by the way of one finger, which has half of it, against a difference of rollouts: to 1e-3."""
    course = gripper(0.8)
    sim = simulator(course.scene, iterations)
    left, right = course.scene.colliders

    def lifted(way: Tensor) -> Tensor:
        def targets(number: int) -> dict[Any, Tensor]:
            time = (number + 1) * H
            closed, up = 0.015 * min(time / 0.3, 1.0), 0.1 * min(max((time - 0.3) / 0.5, 0.0), 1.0)
            return {left: at(closed, way * up), right: at(-closed, up)}

        return mean(sim, sim.rollout(sim.rest_state(), 60, targets=targets).state())[1]

    way = torch.ones((), dtype=torch.float64, requires_grad=True)
    (found,) = torch.autograd.grad(lifted(way), way)
    with torch.no_grad():
        wanted = float(lifted(way + 1e-4) - lifted(way - 1e-4)) / 2e-4
    assert float(found) == pytest.approx(wanted, rel=1e-3)
    assert wanted == pytest.approx(0.05, rel=1e-2)


@pytest.mark.parametrize(("friction", "share"), [(0.1, 0.0), (2.0, 1.0)])
def test_a_belt(friction: float, share: float) -> None:
    """A belt pulls a block that slides by friction alone, whatever its speed; one that sticks follows it, to 1 %."""
    course = slope(0.0, friction)
    (table,) = course.scene.colliders
    sim = simulator(course.scene, 256)
    state: Any = sim.rollout(sim.rest_state(), 5).state()
    speed = torch.tensor(0.1 if share else 1.0, dtype=torch.float64, requires_grad=True)
    track = sim.rollout(state, 20, targets=lambda number: {table: at(speed * H * (number + 1), 0.0)})
    (found,) = torch.autograd.grad(mean(sim, track.state())[0], speed)
    assert float(found) == pytest.approx(share * 20 * H, abs=1e-2 * 20 * H)
