"""What a step starts from, and float32."""

from __future__ import annotations

import pytest
import torch
from contact_scenes import (
    ContactCase,
    H,
    block,
    each,
    falling,
    plane_collider,
    promised,
    rings,
    slope,
    watched,
)

from torchpd.reference.contact import contact_scene, contact_step


def test_a_start_that_crosses_is_refused() -> None:
    """By name, unless the state is what a step has left."""
    case = slope(0.0, 0.0, lift=1e-3)
    x = torch.tensor(case.scene.values.rest_positions)
    velocities = torch.tensor(case.velocities)
    crossing = x - torch.tensor([0.0, 0.01, 0.0])
    with pytest.raises(
        ValueError, match=r"positions .*crossings.* edge \(\d+, \d+\) of body \d, triangle \d+ of body \d"
    ):
        contact_step(case.scene, crossing, velocities, H)
    step = contact_step(case.scene, x, velocities, H, iterations=4)
    with pytest.raises(ValueError, match="crossings"):
        contact_step(case.scene, crossing, velocities, H, history=step.history)


@pytest.mark.parametrize("lift", [1e-5, 3e-4])
def test_a_start_below_the_thickness(lift: float) -> None:
    """The first step pushes it out to r, without a crossing."""
    run = watched(slope(0.0, 0.0, lift=lift), 2, 64)
    assert run.crossed == 0
    assert run.steps[0].gap == pytest.approx(1.0, abs=1e-3)


def test_bodies_that_touch_are_refused() -> None:
    scene = falling(block(0.1, 2, center=(0.0, 0.05, 0.0)))
    made = contact_scene(scene, plane_collider(1.0, 1.0, 3), thickness=1e-3)
    case = ContactCase(made, each(scene, (0.0, 0.0, 0.0)))
    with pytest.raises(ValueError, match="positions must leave"):
        case.last(1, 4)


def test_rings_pulled_apart_in_float32() -> None:
    """At 40 m/s to 4 m from the origin, K = 32: no crossing, the floor holds, no vertex is stuck."""
    ends = promised(rings(8, 40.0, 4.0, dtype=torch.float32, youngs=1e6), 7, 32)
    assert ends[-1].positions.dtype == torch.float32
    assert float(ends[-1].positions.abs().max()) > 3.9


def test_far_places_in_float32_are_refused() -> None:
    """100 m from the origin an ulp is 8e-6 m, 64 of them are more than the floor of 1e-4 m."""
    scene = falling(block(0.1, 1, center=(100.0, 0.0, 0.0)))
    with pytest.raises(ValueError, match="thickness must be at least"):
        contact_scene(scene, thickness=1e-3, dtype=torch.float32)
