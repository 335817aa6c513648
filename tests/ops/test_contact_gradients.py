"""Gradients for planes and spheres: finite differences of solved steps, and a closed form of what slides."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

import torchpd as pd

pytestmark = pytest.mark.usefixtures("poisoned")

MESH = pd.shapes.box((0.2, 0.2, 0.2), (2, 2, 2))
SMOOTH, ROUGH, STICKY = 0.0, 0.3, 3.0
TOLERANCE = 1e-6  # see tests/ops/test_adjoint.py


def noise(shape: torch.Size, seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def cube(*contacts: pd.scene.Part, velocity: tuple[float, float, float]) -> tuple[pd.Simulator, pd.State]:
    """Two environments of a soft cube that stands on y = 0, the second one faster."""
    scene = pd.Scene(pd.Solid(MESH, 2e4), pd.Gravity(), *contacts)
    sim = pd.Simulator(scene, 1 / 60, 4000, dtype=torch.float64)
    state = sim.rest_state(2)
    above = torch.as_tensor(MESH.vertices[:, 1:] > 1e-9).any(-1, keepdim=True)
    speed = torch.tensor(velocity, dtype=torch.float64) * torch.tensor([[[1.0]], [[1.2]]], dtype=torch.float64)
    return sim, pd.State(
        state.positions + 1e-3 * above * noise(state.positions.shape, 0),
        state.velocities + speed + 0.05 * noise(state.velocities.shape, 1),
    )


def loss_of(after: pd.State) -> Tensor:
    weights = [noise(after.positions.shape, seed) for seed in (2, 3)]
    return (weights[0] * after.positions).sum() + 0.02 * (weights[1] * after.velocities).sum()


def held(sim: pd.Simulator, state: pd.State) -> tuple[int, int, int]:
    """Vertices that contacts hold, of them those that friction holds, and those that slide against friction."""
    material = [array.detach() for array in sim.material()]
    after = sim(state).positions.detach()
    _, _, _, projector, stuck, sliding = torch.ops.torchpd.adjoint_system(
        after, after, after, *state, None, material, list(sim.plan.arrays), time_step=sim.time_step
    )
    touching = projector.diagonal(dim1=-2, dim2=-1).sum(-1) < 2.5
    return int(touching.sum()), int(stuck.sum()), int((sliding[..., 0, :] != 0.0).any(-1).sum())


def compare(array: Tensor, loss: Callable[[], Tensor], columns: dict[str, Tensor], *, error: float = TOLERANCE) -> None:
    """`columns`: directions of `array` by name, each of its shape."""
    array.requires_grad_()
    (gradient,) = torch.autograd.grad(loss(), array)
    array.requires_grad_(False)
    scale = float(gradient.abs().max())
    assert scale > 0.0
    size = 1e-6
    for name, direction in columns.items():
        ends = []
        for sign in (1.0, -1.0):
            array += sign * size * direction
            ends.append(float(loss()))
            array -= sign * size * direction
        expected = (ends[0] - ends[1]) / (2.0 * size)
        assert float((gradient * direction).sum()) == pytest.approx(expected, rel=error, abs=error * scale), name


def unit(array: Tensor, *place: int) -> Tensor:
    direction = torch.zeros_like(array)
    direction[place] = 1.0
    return direction


def plane_columns(planes: Tensor, number: int = 0) -> dict[str, Tensor]:
    normal = planes[number, :3]
    columns = {}
    for axis, name in enumerate("xyz"):
        direction = torch.zeros_like(planes)
        direction[number, :3] = torch.eye(3, dtype=planes.dtype)[axis] - normal[axis] * normal
        columns[f"normal to {name}"] = direction
    return columns | {"height": unit(planes, number, 3), "friction": unit(planes, number, 4)}


def sphere_columns(spheres: Tensor, number: int = 0) -> dict[str, Tensor]:
    names = ("x", "y", "z", "radius", "friction", "motion x", "motion y", "motion z")
    return {name: unit(spheres, number, column) for column, name in enumerate(names)}


SPEED = {SMOOTH: (0.3, -0.2, 0.1), ROUGH: (1.0, -0.2, 0.4), STICKY: (0.1, -0.2, 0.05)}


def without_friction(columns: dict[str, Tensor]) -> dict[str, Tensor]:
    """A coefficient below 0 is none, so differences on both sides of 0 are half the slope."""
    return {name: direction for name, direction in columns.items() if name != "friction"}


@pytest.mark.parametrize("normal", [(0.0, 1.0, 0.0), (0.2, 1.0, -0.1)], ids=["ground", "slope"])
@pytest.mark.parametrize("friction", SPEED)
def test_a_plane(friction: float, normal: tuple[float, float, float]) -> None:
    sim, state = cube(pd.Ground(0.005 * normal[0] / 0.2, normal, friction), velocity=SPEED[friction])
    touching, stuck, sliding = held(sim, state)
    assert touching >= 6
    assert (stuck > 0, sliding > 0) == (friction == STICKY, friction == ROUGH)
    columns = plane_columns(sim.planes)
    compare(sim.planes, lambda: loss_of(sim(state)), columns if friction else without_friction(columns))


@pytest.mark.parametrize("friction", SPEED)
def test_a_ball(friction: float) -> None:
    ball = pd.Sphere((0.1, -0.3, 0.1), 0.302, friction)
    sim, state = cube(ball, velocity=SPEED[friction])
    sim.spheres[0, 5:] = torch.tensor([0.001, 0.002, -0.003])
    touching, stuck, sliding = held(sim, state)
    assert touching >= 2
    assert (stuck > 0, sliding > 0) == (friction == STICKY, friction == ROUGH)
    columns = sphere_columns(sim.spheres)
    compare(sim.spheres, lambda: loss_of(sim(state)), columns if friction else without_friction(columns))


def test_friction_from_none_on() -> None:
    """The slope on the right of 0."""
    sim, state = cube(pd.Ground(), velocity=(1.0, -0.2, 0.4))
    sim.planes.requires_grad_()
    (gradient,) = torch.autograd.grad(loss_of(sim(state)), sim.planes)
    sim.planes.requires_grad_(False)
    size = 1e-6
    before = float(loss_of(sim(state)))
    sim.planes[0, 4] = size
    assert float(gradient[0, 4]) == pytest.approx((float(loss_of(sim(state))) - before) / size, rel=1e-4)


def test_planes_that_meet() -> None:
    """Heights of a corner of three; for what changes right angles see docs/limits.md."""
    walls = pd.Ground(), pd.Ground(0.0, (1.0, 0.0, 0.0)), pd.Ground(0.0, (0.0, 0.0, 1.0))
    sim, state = cube(*walls, velocity=(-0.3, -0.2, -0.3))
    columns = {f"height {number}": unit(sim.planes, number, 3) for number in range(3)}
    compare(sim.planes, lambda: loss_of(sim(state)), columns)


def test_along_the_edge_of_two_planes() -> None:
    """The ground tips along the edge with a smooth wall, and the wall turns about the vertical."""
    sim, state = cube(pd.Ground(), pd.Ground(0.0, (1.0, 0.0, 0.0)), velocity=(-0.3, -0.2, 0.3))
    columns = {name: plane_columns(sim.planes, n)["normal to z"] for n, name in enumerate(("ground", "wall"))}
    columns |= {f"height {number}": unit(sim.planes, number, 3) for number in range(2)}
    compare(sim.planes, lambda: loss_of(sim(state)), columns)


STICKY_EDGE = (pd.Ground(friction=STICKY), pd.Ground(0.0, (1.0, 0.0, 0.0)))
ROUGH_EDGE = (pd.Ground(friction=ROUGH), pd.Ground(0.0, (1.0, 0.0, 0.0)))


@pytest.mark.parametrize(
    ("walls", "velocity", "names", "error"),
    [
        (STICKY_EDGE, (-0.3, -0.2, 0.03), ("normal to z", "height"), TOLERANCE),
        # the steps themselves differ from exact contacts where one is rough, see csrc/solver/adjoint/friction.h
        (ROUGH_EDGE, (-0.3, -0.2, 0.8), ("normal to z", "height", "friction"), 0.03),
    ],
    ids=["sticks", "slides"],
)
def test_a_rough_ground_beside_a_wall(
    walls: tuple[pd.Ground, ...], velocity: tuple[float, float, float], names: tuple[str, ...], error: float
) -> None:
    sim, state = cube(*walls, velocity=velocity)
    columns = {name: plane_columns(sim.planes)[name] for name in names}
    compare(sim.planes, lambda: loss_of(sim(state)), columns, error=error)


def test_the_same_contact_twice_counts_once() -> None:
    """What the first has put a vertex out of, the second does nothing to."""
    found = []
    for count in (1, 2):
        sim, state = cube(*(pd.Ground(friction=ROUGH) for _ in range(count)), velocity=SPEED[ROUGH])
        sim.planes.requires_grad_()
        x = state.positions.clone().requires_grad_()
        found.append(torch.autograd.grad(loss_of(sim(pd.State(x, state.velocities))), (x, sim.planes)))
    torch.testing.assert_close(found[0][0], found[1][0], rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(found[0][1], found[1][1][:1], rtol=1e-9, atol=1e-12)
    assert torch.equal(found[1][1][1], torch.zeros_like(found[1][1][1]))


def test_what_rests_on_smooth_ground_slips_nowhere() -> None:
    """Which way rounding moves it must not tell what friction would do."""
    sim, _ = cube(pd.Ground(), velocity=(0.0, 0.0, 0.0))
    with torch.no_grad():
        state = sim.rollout(sim.rest_state(2), 400).state()
    sim.planes.requires_grad_()
    (gradient,) = torch.autograd.grad(loss_of(sim(state)), sim.planes)
    with torch.no_grad():
        smooth = loss_of(sim(state))
        sim.planes[0, 4] = 1e-3
        slope = float(loss_of(sim(state)) - smooth) / 1e-3
    assert abs(float(gradient[0, 4]) - slope) <= 1e-5


def test_a_lost_environment_leaves_no_number() -> None:
    """Its own gradients are NaN as those of all else, and those of others as they were."""
    sim, state = cube(pd.Ground(friction=ROUGH), pd.Sphere((0.1, -0.3, 0.1), 0.302), velocity=SPEED[ROUGH])
    sim.set_material(planes=sim.planes.repeat(2, 1, 1), spheres=sim.spheres.repeat(2, 1, 1))
    state.velocities[1, 0, 0] = torch.nan
    sim.planes.requires_grad_()
    sim.spheres.requires_grad_()
    for gradient in torch.autograd.grad(loss_of(sim(state)), (sim.planes, sim.spheres)):
        assert gradient[0].isfinite().all()
        assert gradient[1].isnan().all()


def test_every_environment_has_its_own() -> None:
    sim, state = cube(pd.Ground(friction=ROUGH), velocity=SPEED[ROUGH])
    sim.set_material(planes=torch.stack([sim.planes, sim.planes + torch.tensor([0.0, 0.0, 0.0, 1e-3, 0.1])]))
    columns = {
        f"{name} of {e}": unit(sim.planes, e, 0, column)
        for e in range(2)
        for name, column in {"height": 3, "friction": 4}.items()
    }
    compare(sim.planes, lambda: loss_of(sim(state)), columns)


@pytest.mark.parametrize("friction", [ROUGH, STICKY])
def test_where_a_ball_goes(friction: float) -> None:
    """For centre and velocity as targets, in a step and along a rollout."""
    ball = pd.Sphere((0.1, -0.3, 0.1), 0.302, friction)
    sim, state = cube(ball, velocity=SPEED[friction])
    target = torch.tensor([0.1, -0.3, 0.1, 0.06, 0.12, -0.18], dtype=torch.float64)
    columns = {f"{n}": unit(target, n) for n in range(6)}
    compare(target, lambda: loss_of(sim(state, targets={ball: target})), columns)
    compare(target, lambda: loss_of(sim.rollout(state, 3, targets={ball: target}).state()), columns, error=1e-5)


def test_how_far_it_slides() -> None:
    """By implicit Euler v' = v - mu g h, so N steps on x changes by -g h^2 N (N + 1) / 2 for a unit of mu."""
    mu, steps, h = 0.3, 10, 1 / 60
    scene = pd.Scene(pd.Solid(MESH, 2e5), pd.Gravity(), pd.Ground(friction=mu))
    sim = pd.Simulator(scene, h, 600, dtype=torch.float64)
    state = sim.rest_state()
    with torch.no_grad():
        state = sim.rollout(state, 30).state()  # it settles under its weight
    state.velocities[..., 0] += 1.5
    sim.planes.requires_grad_()
    end = sim.rollout(state, steps).positions[-1]
    mass = sim.masses / sim.masses.sum()
    (gradient,) = torch.autograd.grad((mass * end[0, :, 0]).sum(), sim.planes)
    assert float(gradient[0, 4]) == pytest.approx(-9.81 * h**2 * steps * (steps + 1) / 2, rel=0.02)


def test_what_is_lifted_with_its_ground() -> None:
    """Ground and body 1 m higher end 1 m higher: slopes for the height and all starts add up to the vertices."""
    sim, state = cube(pd.Ground(friction=ROUGH), velocity=SPEED[ROUGH])
    sim.planes.requires_grad_()
    x = state.positions.clone().requires_grad_()
    total = sim(pd.State(x, state.velocities)).positions[..., 1].sum()
    of_start, of_planes = torch.autograd.grad(total, (x, sim.planes))
    assert float(of_start[..., 1].sum() + of_planes[0, 3]) == pytest.approx(x.shape[0] * x.shape[1], rel=1e-8)


def test_nothing_where_nothing_touches() -> None:
    sim, state = cube(pd.Ground(-1.0, friction=0.5), pd.Sphere((0.0, -3.0, 0.0), 1.0), velocity=(0.0, 0.0, 0.0))
    sim.planes.requires_grad_()
    sim.spheres.requires_grad_()
    for gradient in torch.autograd.grad(loss_of(sim(state)), (sim.planes, sim.spheres)):
        assert torch.equal(gradient, torch.zeros_like(gradient))


def test_vertices_on_springs_touch_too() -> None:
    """A soft pin's force counts, though on a CPU they are looked at without their pins first."""
    solid = pd.Solid(MESH, 2e4)
    low = np.flatnonzero(MESH.vertices[:, 1] < 1e-9)
    scene = pd.Scene(solid, pd.Pin(solid, low[:4], stiffness=200.0), pd.Gravity(), pd.Ground(friction=ROUGH))
    sim = pd.Simulator(scene, 1 / 60, 4000, dtype=torch.float64)
    state = sim.rest_state(2)
    state = pd.State(state.positions, state.velocities + torch.tensor([1.0, -0.2, 0.4], dtype=torch.float64))
    # two of them are held up by their pins, the others pulled down
    sim.pin_targets += torch.tensor([[0.0, 0.1, 0.0]] * 2 + [[0.0, -0.1, 0.0]] * 2, dtype=torch.float64)
    compare(sim.planes, lambda: loss_of(sim(state)), plane_columns(sim.planes))


def test_in_float32(device: torch.device) -> None:
    sim, state = cube(pd.Ground(friction=ROUGH), pd.Sphere((0.1, 0.5, 0.1), 0.31, ROUGH), velocity=SPEED[ROUGH])

    def gradients(sim: pd.Simulator, state: pd.State) -> tuple[Tensor, ...]:
        sim.planes.requires_grad_()
        sim.spheres.requires_grad_()
        after = sim(state)
        weight = noise(after.positions.shape, 2).to(after.positions)
        return torch.autograd.grad((weight * after.positions).sum(), (sim.planes, sim.spheres))

    wanted = gradients(sim, state)
    with torch.no_grad():
        single = sim.to(torch.float32).to(device)
    found = gradients(single, pd.State(*(t.to(device, torch.float32) for t in state)))
    for one, other in zip(wanted, found, strict=True):
        assert float((one - other.cpu()).norm() / one.norm()) < 1e-3


def test_many_at_once() -> None:
    sim, state = cube(pd.Ground(friction=ROUGH), velocity=SPEED[ROUGH])
    sim.planes.requires_grad_()
    height = sim(state).positions[:, :3, 1].flatten()
    wants = torch.eye(len(height), dtype=torch.float64)
    (together,) = torch.autograd.grad(height, sim.planes, wants, retain_graph=True, is_grads_batched=True)
    for row, want in zip(together, wants, strict=True):
        (one,) = torch.autograd.grad(height, sim.planes, want, retain_graph=True)
        torch.testing.assert_close(row, one, rtol=1e-7, atol=1e-12)
