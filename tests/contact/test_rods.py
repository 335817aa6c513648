"""Rods in contact: none passes through another, a ring, a sheet or itself; statics, friction, and the same bits."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from body_scenes import THICKNESS, Course, G, H, crossed, each, gravity, simulator
from rod_scenes import (
    RADIUS,
    closed_far,
    coil,
    crossed_rods,
    knot_determinant,
    overhand_knot,
    passages,
    rod,
    rod_in_a_ring,
    rod_on_a_block,
    rod_on_a_slope,
    rod_on_cloth,
)

import torchpd as pd
from torchpd.geometry.closest_points import segment_distances
from torchpd.reference.contact import linking_number

FLOOR = 0.099  # least distance over the thickness, in float32

ITERATIONS = pytest.mark.parametrize("iterations", [4, 16, 64])


@ITERATIONS
@pytest.mark.parametrize("speed", [1.0, 10.0, 40.0])
def test_a_rod_that_falls_on_a_rod(speed: float, iterations: int, dtype: torch.dtype) -> None:
    """A rod of 4 mm at up to 67 cm a step: the linking number of both, closed far away, knows a passage."""
    course = crossed_rods(speed)
    sim = simulator(course.scene, iterations, dtype=dtype)
    gaps = []
    for state, info in course.steps(sim, 12):
        assert state.positions.isfinite().all()
        assert passages(state.positions[0].double().numpy()) == 0
        gaps.append(float(info.contact_gap))
    assert FLOOR <= min(gaps) < 1.1


def test_without_contact_it_passes() -> None:
    """The control: the other rod is a metre below after six steps."""
    course = crossed_rods(10.0, contact=False)
    sim: Any = pd.Simulator(course.scene, H, 16, dtype=torch.float64, progress=False)
    state = sim.rest_state()
    state.velocities[:] = torch.tensor(course.velocities)
    assert passages(sim.rollout(state, 6).state().positions[0].numpy()) == 1


@ITERATIONS
def test_a_rod_stays_in_a_ring(iterations: int) -> None:
    """It is torn aside by 15 cm in four steps, and the ring with it."""
    course, line = rod_in_a_ring()
    sim = simulator(course.scene, iterations)
    ring = sim.scene.vertex_range(course.scene.bodies[0]).stop
    for state, info in course.steps(sim, 12):
        places = state.positions[0].numpy()
        assert linking_number(places[line], closed_far(places[ring:], 1)) == -1
        assert crossed(sim, state) == 0
        assert float(info.contact_gap) >= FLOOR
    if iterations == 64:
        assert float(state.positions[0, :ring, 0].mean()) > 0.02


@ITERATIONS
def test_a_rod_on_a_sheet(iterations: int, dtype: torch.dtype) -> None:
    """20 m/s, end ahead, on cells of 33 mm: its vertices stay above, its segments cross no triangle."""
    course = rod_on_cloth()
    sim = simulator(course.scene, iterations, dtype=dtype)
    gaps = []
    for state, info in course.steps(sim, 10):
        assert crossed(sim, state) == 0
        gaps.append(float(info.contact_gap))
    assert FLOOR <= min(gaps) < 1.1
    own = sim.scene.vertex_range(course.scene.bodies[1])
    assert float(state.positions[0, own.start : own.stop, 1].min()) > -0.4


@ITERATIONS
def test_a_coil_between_plates(iterations: int) -> None:
    """Four turns of 1 cm are pressed to 12 mm: they lie on each other, 2 mm apart."""
    course = coil()
    sim = simulator(course.scene, iterations)
    steps = list(course.steps(sim, 14))
    assert min(float(info.contact_gap) for _, info in steps) >= FLOOR
    assert not any(int(info.contact_overflow) for _, info in steps)
    state, info = steps[-1]
    assert float(info.held_back) == 0.0
    assert np.ptp(state.positions[0, :, 1].numpy()) <= 0.008 + 1e-5
    line = state.positions[0].numpy()
    first, second = np.triu_indices(len(line) - 1, 2)
    pairs = np.stack([line[:-1], line[1:]], axis=1)
    assert segment_distances(pairs[first], pairs[second]).min() >= FLOOR * 2e-3


@ITERATIONS
def test_a_knot_is_pulled_tight(iterations: int, dtype: torch.dtype) -> None:
    """An overhand knot stays one: the determinant of the line, closed far away, is 3; it would be 1 without a knot."""
    course = overhand_knot()
    sim = simulator(course.scene, iterations, dtype=dtype)
    for number, (state, info) in enumerate(course.steps(sim, 45)):
        assert float(info.contact_gap) >= FLOOR
        assert int(info.contact_overflow) == 0
        if number % 11 == 0:
            assert knot_determinant(closed_far(state.positions[0].double().numpy(), 0)) == 3
    assert float(info.contact_gap) < 1.1  # strands lie on each other


def test_a_rope_that_does_not_meet_itself_comes_undone() -> None:
    """The control of the knot's determinant."""
    course = overhand_knot(self_contact=False)
    state, _ = course.last(simulator(course.scene, 64), 45)
    assert knot_determinant(closed_far(state.positions[0].numpy(), 0)) == 1


def test_a_rod_rests_on_a_block() -> None:
    """What the block pushes is its weight, to 1e-4; nothing along the surface, and nothing twice."""
    course = rod_on_a_block()
    sim = simulator(course.scene, 64)
    last: Any = course.start(sim)
    for _ in range(59):
        last = sim(last)
    state, info = sim(last, return_info=True)
    base, lies = course.scene.bodies
    weight = G * float(lies.masses().sum())
    force = sim.contact_forces(last, state).between[lies, base].force[0]
    assert float(force[1]) == pytest.approx(weight, rel=1e-4)
    assert float(force[[0, 2]].norm()) < 1e-4 * weight
    assert float(info.contact_gap) == pytest.approx(1.0, abs=1e-6)


@ITERATIONS
@pytest.mark.parametrize("bend", [0.0, 1e-6, 1e-4, 1e-2])
def test_free_rods_keep_their_momentum(bend: float, iterations: int) -> None:
    """Linear momentum to rounding, however straight they are: turns about themselves cost no other correction."""
    low, high = (
        np.linspace((-0.1, 0.0, 0.0), (0.1, 0.0, 0.0), 11),
        np.linspace((0.013, 0.03, -0.12), (0.013, 0.03, 0.1), 11),
    )
    bow = bend * np.sin(np.linspace(0.0, np.pi, 11))[:, None]
    bodies = [pd.Rod(line, 1e7, RADIUS) for line in (low + bow * [0.0, 0.0, 1.0], high + bow * [1.0, 0.0, 0.0])]
    scene = pd.Scene(*bodies, pd.Contact(friction=0.3, thickness=2.0 * RADIUS))
    course = Course(scene, each(scene, (0.0, 0.5, 0.0), (0.2, -1.0, 0.0)))
    sim = simulator(scene, iterations)
    masses, first = sim.masses[:, None], course.start(sim).velocities[0]
    touched = False
    for state, _ in course.steps(sim, 8):
        change = (masses * (state.velocities[0] - first)).sum(dim=0)
        assert float(change.norm()) <= 1e-14 * float((masses * first.abs()).sum())
        touched = touched or bool(state.history.forces.any())
    assert touched


@pytest.mark.parametrize("iterations", [16, 64])
def test_a_rod_on_a_slope(iterations: int) -> None:
    """At 20 degrees it sticks with a friction of .5, and slides with .3: k h g (sin a - mu cos a), to 1e-5."""
    steps, angle = 30, math.radians(20.0)
    sticks, _ = rod_on_a_slope(20.0, 0.5).last(simulator(rod_on_a_slope(20.0, 0.5).scene, iterations), steps)
    assert float(sticks.velocities.norm(dim=-1).max()) < 1e-6
    course = rod_on_a_slope(20.0, 0.3)
    slides, _ = course.last(simulator(course.scene, iterations), steps)
    wanted = steps * H * G * (math.sin(angle) - 0.3 * math.cos(angle))
    assert float(slides.velocities[0].mean(0).norm()) == pytest.approx(wanted, rel=1e-5)


@pytest.mark.parametrize("along", [0.0, 0.005, 0.02])
def test_an_end_on_a_segment(along: float) -> None:
    """A point and a segment are two segments whose closest points end: over a vertex, inside and at the next vertex.

    The end of a rod that stands is kept a thickness above the other rod, by a force along the way between them.
    """
    low = rod((-0.1, 0.0, 0.0), (0.1, 0.0, 0.0), 10)
    stands = rod((along, 0.01, 0.0), (along, 0.11, 0.0), 5)
    held = pd.Pin(low, np.arange(11))
    scene = pd.Scene(low, stands, held, pd.Contact(thickness=THICKNESS))
    course = Course(scene, each(scene, (0.0, 0.0, 0.0), (0.0, -0.5, 0.0)))
    sim = simulator(scene, 256)
    last: Any = course.start(sim)
    last = sim(last)
    state, info = sim(last, return_info=True)
    pairs = sim.contact_forces(last, state).pairs
    assert float(info.contact_gap) == pytest.approx(1.0, abs=1e-3)
    assert int(pairs.counts) in (1, 2)
    assert float(pairs.on_vertices[0, 11, 1]) == pytest.approx(float(pairs.force[0, :, 1].sum().abs()), rel=1e-12)
    assert not pairs.on_vertices[0, 12:].any()  # of the standing rod the end alone is touched
    assert (pairs.weights[0, :, 2:] == torch.tensor([-1.0, 0.0])).all()


def test_segments_share_bits_with_their_batch(two_threads: None) -> None:
    """Environments of different speeds have the bits that they have alone."""
    course = crossed_rods(10.0)
    sim = simulator(course.scene, 16, dtype=torch.float32)
    speeds = torch.tensor([1.0, 0.1, 4.0])[:, None, None]
    state: Any = sim.rest_state(3)
    state.velocities[:] = torch.tensor(course.velocities).float() * speeds
    for _ in range(6):
        state = sim(state)
    for number in range(3):
        alone: Any = sim.rest_state()
        alone.velocities[:] = torch.tensor(course.velocities).float() * speeds[number]
        for _ in range(6):
            alone = sim(alone)
        assert torch.equal(alone.positions[0], state.positions[number])
        assert torch.equal(alone.history.forces[0], state.history.forces[number])


@pytest.mark.parametrize("iterations", [4, 16, 64])
def test_rods_apart_take_the_step_without_contact(iterations: int) -> None:
    low, high = rod((-0.2, 0.0, 0.0), (0.2, 0.0, 0.0), 20), rod((0.0, 0.1, -0.2), (0.0, 0.1, 0.2), 20)
    ends = []
    for parts in ((), (pd.Contact(thickness=2.0 * RADIUS),)):
        sim = simulator(pd.Scene(low, high, gravity(), *parts), iterations)
        state: Any = sim.rest_state()
        state.velocities[:, :21, 2] = 0.3
        ends.append(sim.rollout(state, 5).state().positions)
    assert torch.equal(*ends)


def test_starts_are_checked() -> None:
    """A rod through a triangle, and rods that touch."""
    sheet = pd.Cloth(pd.shapes.sheet((0.2, 0.2), (2, 2)), youngs=1e5, thickness=1e-3, area_density=0.2)
    middle = sheet.mesh.vertices.mean(axis=0) + [0.013, 0.0, 0.004]
    through = rod(middle - [0.0, 0.05, 0.0], middle + [0.0, 0.055, 0.0], 1)
    with pytest.raises(ValueError, match=r"free of crossings, got 1: the edge of vertices \[0, 1\] of body 1"):
        simulator(pd.Scene(sheet, through, pd.Contact(thickness=1e-3)))
    with pytest.raises(ValueError, match=r"must leave .* between surfaces, got 0.0e\+00 m between vertices"):
        simulator(pd.Scene(rod((-1, 0, 0), (1, 0, 0), 2), rod((0.3, 0, -1), (0.3, 0, 1), 3), pd.Contact()))


def test_a_thick_rod_may_bend() -> None:
    """Twice its radius is more than a segment: what rests nearer keeps half of its distance at rest."""
    straight = rod((0.0, 0.0, 0.0), (0.2, 0.0, 0.0), 40)
    sim = simulator(pd.Scene(straight, pd.Pin(straight, [0, 1]), gravity(), pd.Contact(thickness=12e-3)), 64)
    plan = sim.body_contact.plan  # type: ignore[union-attr]
    # segments i and i + 2, + 3, + 4, + 5 are 5, 10, 15, 20 mm apart
    assert sorted(set(plan.near.thickness.round(9).tolist())) == [0.0025, 0.005, 0.0075, 0.01]
    free = simulator(pd.Scene(straight, pd.Pin(straight, [0, 1]), gravity()), 64)
    ends = [one.rollout(one.rest_state(), 10).state().positions for one in (sim, free)]
    assert float((ends[0] - ends[1]).abs().max()) < 1e-6
