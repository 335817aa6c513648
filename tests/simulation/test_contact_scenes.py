"""Bodies in contact, in the simulator: no crossings by exact signs after any step, statics, friction and grip."""

from __future__ import annotations

import math

import pytest
import torch
from body_scenes import (
    THICKNESS,
    Course,
    G,
    H,
    ball_on_sheet,
    block,
    crossed,
    each,
    folded_sheet,
    gravity,
    gripper,
    plane,
    plates,
    simulator,
    slope,
    two_cubes,
)
from rod_scenes import rod_on_cloth
from torch import Tensor

import torchpd as pd

_COURSES = {
    "two cubes": (two_cubes, 12),
    "ball on a sheet": (ball_on_sheet, 8),
    "plates": (lambda: plates(-0.002)[0], 24),
    "gripper": (lambda: gripper(0.8), 24),
    "folded sheet": (lambda: folded_sheet(self_contact=True), 12),
    "rod on a sheet": (rod_on_cloth, 10),
}


@pytest.mark.parametrize("iterations", [4, 16, 64])
@pytest.mark.parametrize("name", _COURSES)
def test_surfaces_do_not_cross(name: str, iterations: int, dtype: torch.dtype) -> None:
    """After every step, however few iterations it has; and the floor, a tenth of the thickness, holds."""
    make, count = _COURSES[name]
    course = make()
    sim = simulator(course.scene, iterations, dtype=dtype)
    least = math.inf
    for state, info in course.steps(sim, count):
        assert crossed(sim, state) == 0
        assert state.positions.isfinite().all()
        assert int(info.contact_overflow) == 0
        least = min(least, float(info.contact_gap))
    assert 0.099 <= least < 20.0  # they come near each other


def mean(sim: pd.Simulator, each_vertex: Tensor) -> Tensor:
    """Mean [3] over the mass of a quantity [1, V, 3]."""
    return (sim.masses[:, None] * each_vertex[0]).sum(0) / sim.masses.sum()


def test_without_contact_the_ball_passes() -> None:
    """The control: after four steps of 33 cm the whole ball is a metre below the sheet."""
    course = ball_on_sheet(contact=False)
    sim = pd.Simulator(course.scene, H, 16, dtype=torch.float64, progress=False)
    state = sim.rest_state()
    state.velocities[:] = torch.tensor(course.velocities)
    state = sim.rollout(state, 4).state()
    assert float(state.positions[0, -64:, 1].max()) < -1.0
    assert float(state.positions[0, :-64, 1].min()) > -0.1


@pytest.mark.parametrize("self_contact", [True, False])
def test_a_sheet_that_folds_on_itself(self_contact: bool) -> None:
    """It passes through itself where self_contact is off: the control."""
    course = folded_sheet(self_contact=self_contact)
    sim = simulator(course.scene, 16)
    found = [crossed(sim, state, whole=True) for state, _ in course.steps(sim, 12)]
    assert (max(found) > 0) == (not self_contact)


@pytest.mark.parametrize("iterations", [32, 64])
def test_a_cube_at_rest(iterations: int, dtype: torch.dtype) -> None:
    """1 kg: forces of 9.81 N to 1e-4, at the thickness to 1e-6 m."""
    course = slope(0.0, 0.0)
    sim = simulator(course.scene, iterations, dtype=dtype)
    state, info = course.last(sim, 40)
    assert float(state.history.forces[..., 0].sum()) == pytest.approx(G, rel=1e-4)
    assert float(state.positions[..., 1].min()) == pytest.approx(THICKNESS, abs=1e-6)
    assert float(info.contact_gap) == pytest.approx(1.0, abs=1e-3)
    assert float(info.held_back) == 0.0


@pytest.mark.parametrize("lift", [1e-5, 3e-4])
def test_a_start_below_the_thickness(lift: float) -> None:
    """The first step pushes it out to the thickness."""
    course = slope(0.0, 0.0, lift=lift)
    sim = simulator(course.scene)
    state, info = course.last(sim, 1)
    assert crossed(sim, state) == 0
    assert float(info.contact_gap) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("iterations", [16, 64, 256])
def test_a_block_sticks_on_a_slope(iterations: int) -> None:
    """tan 20 degrees < .5: forces of the last step carry it; without them it would creep at 2e-3 m/s."""
    course = slope(20.0, 0.5)
    state, _ = course.last(simulator(course.scene, iterations), 30)
    assert float(state.velocities.norm(dim=-1).max()) < 1e-5


@pytest.mark.parametrize("iterations", [16, 64])
@pytest.mark.parametrize(("degrees", "friction"), [(30.0, 0.5), (20.0, 0.3)])
def test_a_block_slides_down_a_slope(degrees: float, friction: float, iterations: int) -> None:
    """k h g (sin a - mu cos a) after k steps, and at most 3 % more: parts stick at first.

    Without coarse corrections it has half of that with 16 iterations.
    """
    course = slope(degrees, friction)
    sim = simulator(course.scene, iterations)
    state, _ = course.last(sim, 30)
    angle = math.radians(degrees)
    rigid = 30 * H * G * (math.sin(angle) - friction * math.cos(angle))
    assert rigid < float(mean(sim, state.velocities).norm()) < 1.03 * rigid


@pytest.mark.parametrize("iterations", [64, 128])
def test_a_block_slides_to_a_stop(iterations: int) -> None:
    """2 m/s, friction .4: 2 - 30 h mu g = .038 m/s after 30 steps, on a way of sum h (2 - k h mu g)."""
    course = slope(0.0, 0.4, speed=2.0)
    sim = simulator(course.scene, iterations)
    start = mean(sim, sim.rest_state().positions)
    state, _ = course.last(sim, 30)
    rigid = [2.0 - k * H * 0.4 * G for k in range(1, 31)]
    assert float(mean(sim, state.velocities)[0]) == pytest.approx(rigid[-1], abs=2e-3)
    assert float((mean(sim, state.positions) - start)[0]) == pytest.approx(H * sum(rigid), abs=1e-3)


@pytest.mark.parametrize(("friction", "lifted"), [(0.8, 0.1), (0.0, 0.0)])
def test_a_gripper(friction: float, lifted: float, dtype: torch.dtype) -> None:
    """It lifts the cube by .1 m to 1 mm with friction; without it the cube stays down: the control."""
    course = gripper(friction)
    sim = simulator(course.scene, 16, dtype=dtype)
    state, info = course.last(sim, 60)
    assert float(mean(sim, state.positions)[1]) - 0.025 == pytest.approx(lifted, abs=1e-3)
    assert float(info.held_back) == 0.0
    poses = state.history.poses[0, :, :3]
    assert torch.allclose(poses, torch.tensor([[0.015, 0.1, 0], [-0.015, 0.1, 0]]).to(dtype), atol=1e-6)


def test_plates_that_would_pass_each_other() -> None:
    """They end short of each other, as held_back says, and the cube springs back when they open."""
    course, upper, lower = plates(-0.002)
    assert course.targets is not None
    sim = simulator(course.scene, 16)
    (cube,) = course.scene.bodies
    found = list(course.steps(sim, 24))
    squeezed, info = found[11]
    heights = squeezed.history.poses[0, :, 1]
    assert float(heights[0]) > float(heights[1])
    wanted = course.targets(11)
    behind = [float(heights[0] - wanted[upper][1]), float(wanted[lower][1] - heights[1])]
    assert float(info.held_back) == pytest.approx(max(behind), abs=1e-9)
    assert 0.9e-3 <= float(info.held_back) <= 3.5e-3
    assert float(sim.volume(squeezed)[cube]) < 0.2e-3
    state, info = found[-1]
    assert float(sim.volume(state)[cube]) > 0.5e-3
    assert float(info.held_back) == 0.0


def test_pins_are_held_back() -> None:
    """A cube's pinned top is pressed through a collider: what is left of the way is told."""
    cube = block(0.1, 2, (0.0, 0.053, 0.0))
    pin = pd.Pin(cube, cube.mesh.vertices[:, 1] > 0.1)
    scene = pd.Scene(cube, pin, pd.Collider(plane(0.4, 0.4, 4)), pd.Contact(thickness=THICKNESS))
    down = torch.tensor(cube.mesh.vertices[pin.vertices])[None] - torch.tensor([0.0, 0.2, 0.0])
    sim = simulator(scene, 16)
    state = sim.rest_state()
    for _ in range(4):
        state, info = sim(state, targets={pin: down}, return_info=True)
        assert crossed(sim, state) == 0
    tops = state.positions[0, pin.vertices.copy()]
    assert float(tops[:, 1].min()) > 0.0
    assert float(info.held_back) == pytest.approx(float((tops - down[0]).norm(dim=-1).max()), abs=1e-9)


def _with(*parts: pd.scene.Part, body: pd.Solid | pd.Cloth | None = None) -> Course:
    """A body falls on a table, and others on it."""
    lower = block(0.1, 2, (0.0, 0.06, 0.0)) if body is None else body
    upper = block(0.1, 2, (0.01, 0.2, 0.02))
    table = pd.Collider(plane(0.6, 0.6, 4))
    scene = pd.Scene(lower, upper, table, gravity(), pd.Contact(friction=0.4, thickness=THICKNESS), *parts)
    return Course(scene, each(scene, (0.0, 0.0, 0.0), (0.0, -2.0, 0.0)))


def _solid(**material: object) -> pd.Solid:
    mesh = pd.shapes.box((0.1,) * 3, (2,) * 3)
    return pd.Solid(mesh.translated((-0.05, 0.01, -0.05)), **{"youngs": 1e5, "density": 1e3, **material})  # type: ignore[arg-type]


def _fibres() -> Course:
    body = _solid()
    return _with(pd.Fibres(body, (0.0, 1.0, 0.0), 1e4), body=body)


def _blown() -> Course:
    body = _solid()
    return _with(pd.Pressure(body, 500.0, triangles=body.mesh.boundary()), pd.Wind((3.0, 0.0, 0.0)), body=body)


def _sheet() -> Course:
    mesh = plane(0.3, 0.3, 6)
    sheet = pd.Cloth(mesh.translated((0.0, 0.02, 0.0)), youngs=1e5, thickness=1e-3, area_density=0.3, bending=1e-4)
    return _with(body=sheet)


_PARTS = {
    "fibres": _fibres,
    "pressure and wind": _blown,
    "cloth": _sheet,
    "plastic": lambda: _with(body=_solid(plastic=pd.Plastic(yield_strain=0.02))),
    "Poisson's ratio": lambda: _with(body=_solid(poisson=0.3)),
    "ground, sphere and damping": lambda: _with(pd.Ground(-1.0), pd.Sphere((0.3, 0.1, 0.0), 0.05), pd.Damping(1.0)),
}


@pytest.mark.parametrize("name", _PARTS)
def test_other_parts_take_part(name: str) -> None:
    """Bodies with all that a scene may have rest on each other: no crossings, and forces that carry something."""
    course = _PARTS[name]()
    sim = simulator(course.scene, 32)
    carried = 0.0
    for state, info in course.steps(sim, 16):
        assert crossed(sim, state) == 0
        assert state.positions.isfinite().all()
        assert int(info.contact_overflow) == 0
        carried = max(carried, float(state.history.forces[..., 0].sum()))
    assert carried > 1.0
    assert state.history.flow.shape[1] == (48 if name == "plastic" else 0)
    if name == "plastic":
        assert float(state.history.flow[..., 9].max()) > 0.0


def test_bodies_far_apart_step_as_without_contact() -> None:
    """Two that fall side by side: contact that nothing meets leaves positions as they are, to rounding."""
    parts = (block(0.1, 2, (0.0, 0.0, 0.0)), block(0.1, 2, (1.0, 0.0, 0.0)), gravity())
    alone, met = (pd.Scene(*parts, *more) for more in ((), (pd.Contact(),)))
    velocities = torch.tensor(each(alone, (3.0, -30.0, 0.0), (3.0, -30.0, 0.0)))
    ends = []
    for scene in (alone, met):
        sim = simulator(scene, 16)
        state = sim.rest_state()
        state.velocities[:] = velocities
        ends.append(sim.rollout(state, 5).state())
    assert torch.allclose(ends[0].positions, ends[1].positions, rtol=0.0, atol=1e-12)
    assert (ends[1].history.keys == -1).all()  # type: ignore[attr-defined]
