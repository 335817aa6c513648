"""Colliders with a mass: free motion, statics, momentum, stability, no crossings, and the bits of batches."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from body_scenes import THICKNESS, G, H, crossed, gravity, simulator
from torch import Tensor

import torchpd as pd
from torchpd.ops.fake_kernels import CONTACT_RIGID
from torchpd.scene.contact import placed
from torchpd.simulation.state import chosen

Point = tuple[float, float, float]
EDGE = 0.08  # m, of a rigid cube


def shape(size: float | Point, cells: int | tuple[int, int, int]) -> pd.TetMesh:
    """A box about the origin."""
    size = (size,) * 3 if isinstance(size, float) else size
    return pd.shapes.box(size, (cells,) * 3 if isinstance(cells, int) else cells).translated(
        tuple(-0.5 * length for length in size)  # type: ignore[arg-type]
    )


def soft(*center: float, cells: int = 3, youngs: float = 1e5, edge: float = 0.1) -> pd.Solid:
    return pd.Solid(shape(edge, cells).translated(center), youngs=youngs, density=1000.0)  # type: ignore[arg-type]


def rigid(mass: float, *place: float, turn: tuple[float, float, float, float] = (1, 0, 0, 0)) -> pd.Collider:
    return pd.Collider(shape(EDGE, 2), mass=mass, pose=(*place, *turn))


def table() -> pd.Collider:
    """Its surface, with the thickness above it, is at 0."""
    return pd.Collider(shape((0.6, 0.02, 0.6), (2, 1, 2)), pose=(0, -0.01 - THICKNESS, 0, 1, 0, 0, 0))


def contact(friction: float = 0.5, **options: Any) -> pd.Contact:
    return pd.Contact(friction=friction, thickness=THICKNESS, **options)


def with_motion(state: pd.HistoryState, collider: int, *motion: float) -> pd.HistoryState:
    """The same with a velocity [m/s] and an angular velocity [rad/s] of a collider."""
    moves = state.history.motion.clone()  # type: ignore[union-attr]
    moves[:, collider] = torch.tensor(motion, dtype=moves.dtype)
    return state._replace(history=state.history._replace(motion=moves))


def angular_momentum(collider: pd.Collider, state: pd.HistoryState, number: int) -> Tensor:
    """About its centre of mass [3]."""
    pose = state.history.poses[0, number].clone()  # type: ignore[union-attr]
    pose[:3] = 0.0
    turn = torch.tensor(placed(pose[None].numpy(), np.eye(3))).T
    inertia = turn @ torch.tensor(collider.inertia) @ turn.T
    return inertia @ state.history.motion[0, number, 3:]  # type: ignore[union-attr]


def test_free_fall_is_that_of_the_step() -> None:
    """v = -h g k and y = -h^2 g k (k + 1) / 2, to rounding."""
    ball = rigid(0.3, 0.5, 0.0, 0.0)
    sim = simulator(pd.Scene(soft(0.0, 0.0, 0.0), ball, contact(), gravity()), 8)
    state = sim.rollout(sim.rest_state(), 20).state()
    assert float(state.history.motion[0, 0, 1]) == pytest.approx(-20 * H * G, abs=1e-13)
    assert float(state.history.poses[0, 0, 1]) == pytest.approx(-210 * H * H * G, abs=1e-13)
    assert torch.equal(state.history.poses[0, 0, 3:], torch.tensor([1.0, 0, 0, 0]).double())


def test_free_rotation_keeps_the_angular_momentum_and_about_the_energy() -> None:
    """The midpoint rule: momentum to rounding, energy of a box that tumbles at 15 rad/s within 1 %, for 10 seconds."""
    box = pd.Collider(shape((0.04, 0.06, 0.1), 2), mass=0.5, pose=(0.5, 0, 0, 0.9, 0.1, 0.2, 0.3))
    sim = simulator(pd.Scene(soft(0.0, 0.0, 0.0), box, contact(), pd.Gravity((0, 0, 0))), 4)
    state = with_motion(sim.rest_state(), 0, 0, 0, 0, 2, 15, 1)
    first = angular_momentum(box, state, 0)
    energy = float(first @ state.history.motion[0, 0, 3:])
    least, most, turned = energy, energy, 0.0
    for _ in range(600):
        state = sim(state)
        assert (angular_momentum(box, state, 0) - first).abs().max() <= 1e-13 * first.norm()
        now = float(angular_momentum(box, state, 0) @ state.history.motion[0, 0, 3:])
        least, most = min(least, now), max(most, now)
        turned = max(turned, float((state.history.motion[0, 0, 3:] - torch.tensor([2.0, 15, 1])).norm()))
    assert 0.99 * energy < least
    assert most < 1.01 * energy
    assert turned > 5.0  # it does tumble


def test_a_wrench_acts_at_the_origin_of_the_pose() -> None:
    """One step from rest: m v' = h F, and L' = h (T - r x F) about the centre of mass, r from the origin to it."""
    box = pd.Collider(shape(EDGE, 1).translated((0.1, 0.02, 0.0)), mass=0.5, pose=(0.5, 0, 0, 1, 0, 0, 0))
    sim = simulator(pd.Scene(soft(0.0, 0.0, 0.0), box, contact(), pd.Gravity((0, 0, 0))), 4)
    wrench = torch.tensor([[0.2, -0.1, 0.3, 0.01, 0.02, -0.01]]).double()
    state = sim(sim.rest_state(), targets={box: wrench})
    torch.testing.assert_close(state.history.motion[0, 0, :3], wrench[0, :3] * H / 0.5, rtol=1e-13, atol=0)
    arm = torch.tensor([0.1, 0.02, 0.0], dtype=torch.float64)
    torque = wrench[0, 3:] - torch.linalg.cross(arm, wrench[0, :3])
    torch.testing.assert_close(angular_momentum(box, state, 0), H * torque, rtol=1e-12, atol=0)


@pytest.mark.parametrize("mass", [0.05, 1.0])
def test_a_rigid_cube_on_a_soft_one_weighs_what_it_should(mass: float) -> None:
    cube, block, ground = soft(0.0, 0.05, 0.0), rigid(mass, 0.0, 0.1 + 0.5 * EDGE + THICKNESS, 0.0), table()
    sim = simulator(pd.Scene(cube, ground, block, contact(), gravity()))
    state: Any = sim.rest_state()
    for _ in range(40):
        before, state = state, sim(state)
    forces = sim.contact_forces(before, state)
    assert float(forces.between[block, cube].force[0, 1]) == pytest.approx(mass * G, rel=1e-4)
    assert float(forces.between[ground, cube].force[0, 1]) == pytest.approx(-(mass + 1.0) * G, rel=1e-4)
    assert float(state.history.motion[0, 1].abs().max()) < 1e-3


def test_a_soft_cube_between_rigid_ones_on_a_table() -> None:
    """Colliders with a mass meet others too."""
    below, above, ground = rigid(1.0, 0.0, 0.5 * EDGE, 0.0), rigid(1.0, 0.0, 0.22 + 2e-3, 0.0), table()
    cube = soft(0.0, 0.13 + THICKNESS, 0.0)
    sim = simulator(pd.Scene(cube, ground, below, above, contact(), gravity()))
    state: Any = sim.rest_state()
    for _ in range(40):
        before, state = state, sim(state)
    forces = sim.contact_forces(before, state)
    assert float(forces.between[ground, below].force[0, 1]) == pytest.approx(-3.0 * G, rel=1e-3)
    assert float(forces.between[below, cube].force[0, 1]) == pytest.approx(-2.0 * G, rel=1e-3)
    assert float(forces.between[above, cube].force[0, 1]) == pytest.approx(1.0 * G, rel=1e-3)


def test_a_rigid_block_stops_by_coulombs_law() -> None:
    """2 m/s on a table of one cell with mu .4: v = 2 - k h mu g. Aligned edges of two rigid surfaces jolt: limits."""
    block = pd.Collider(shape((0.1, 0.02, 0.1), (2, 1, 2)), mass=0.7, pose=(-0.2, 0.01, 0, 1, 0, 0, 0))
    plain = pd.Collider(shape((2.0, 0.02, 2.0), 1), pose=(0.5, -0.01 - THICKNESS, 0.3, 1, 0, 0, 0))
    sim = simulator(pd.Scene(soft(0.0, 1.0, 0.0), plain, block, contact(0.4), gravity()), 64)
    state = with_motion(sim.rest_state(), 1, 2.0, 0, 0, 0, 0, 0)
    state = sim.rollout(state, 10).state()
    assert float(state.history.motion[0, 1, 0]) == pytest.approx(2.0 - 10 * H * 0.4 * G, abs=1e-3)


def sliding(
    cells: int, z: float, iterations: int, time_step: float = H, tolerance: float | None = None
) -> tuple[pd.Simulator, Any, Any]:
    """A plate of 2 m/s, mu .4, on a table of square cells whose seams its edges pass; 10 m/s^2."""
    plate = pd.Collider(shape((0.1, 0.02, 0.1), (2, 1, 2)), mass=0.7, pose=(-0.2037, 0.01, z, 1, 0, 0, 0))
    ground = pd.Collider(shape((2.0, 0.02, 2.0), (cells, 1, cells)), pose=(0, -0.01 - THICKNESS, 0, 1, 0, 0, 0))
    scene = pd.Scene(soft(0.0, 1.0, 0.0), ground, plate, contact(0.4), pd.Gravity((0, -10, 0)))
    options: dict[str, Any] = {} if tolerance is None else {"tolerance": tolerance}
    sim = pd.Simulator(scene, time_step, iterations, dtype=torch.float64, progress=False, **options)
    start: Any = sim.rest_state()
    return sim, plate, with_motion(start, 1, 2.0, 0, 0, 0, 0, 0)


@pytest.mark.parametrize("cells", [2, 6])
@pytest.mark.parametrize("z", [0.0, 0.013])
@pytest.mark.parametrize("iterations", [16, 64])
def test_a_rigid_plate_slides_over_seams_by_coulombs_law(cells: int, z: float, iterations: int) -> None:
    """No step ends with edges exactly over seams: there rounding decides whether the plate jolts, docs/limits.md."""
    sim, _, state = sliding(cells, z, iterations)
    state = sim.rollout(state, 10).state()
    assert float(state.history.motion[0, 1, 0]) == pytest.approx(2.0 - 40 * H, abs=1e-3)


@pytest.mark.parametrize("iterations", [1, 4, 16])
@pytest.mark.parametrize("time_step", [1 / 60, 1 / 240])
@pytest.mark.parametrize("z", [0.0, 0.013])
@pytest.mark.parametrize("spin", [0.0, 5.0])
def test_held_back_says_what_forces_do_not_account_for(
    iterations: int, time_step: float, z: float, spin: float
) -> None:
    """m (v' - v) / h - m g - F and (L' - L) / h - T, as ways: by m / h^2, and by J / h^2 times the size."""
    sim, plate, state = sliding(6, z, iterations, time_step)
    state = with_motion(state, 1, 2.0, 0, 0, 0, spin, 0)
    least, *_, most = np.linalg.eigvalsh(plate.inertia)
    size = math.sqrt(0.5 * float(np.trace(plate.inertia)) / plate.mass)
    for _ in range(10):
        before, (state, info) = state, sim(state, return_info=True)
        wrench = sim.contact_forces(before, state).on_colliders[0, 1]
        change = (state.history.motion - before.history.motion)[0, 1, :3]
        force = plate.mass * (change / time_step + torch.tensor([0.0, 10.0, 0.0])) - wrench[:3]
        spins = angular_momentum(plate, state, 1) - angular_momentum(plate, before, 1)
        torque = spins / time_step - wrench[3:]
        shift, turn = float(force.norm()) * time_step**2 / plate.mass, float(torque.norm()) * time_step**2 * size
        held = float(info.held_back)
        assert math.hypot(shift, turn / most) <= 1.0001 * held + 1e-14
        assert held <= 1.0001 * math.hypot(shift, turn / least) + 1e-14


@pytest.mark.parametrize("iterations", [1, 4, 16])
@pytest.mark.parametrize("spin", [0.0, 5.0])
def test_the_residual_is_that_of_colliders_where_it_is_larger(iterations: int, spin: float) -> None:
    """The body falls freely, so that its own is rounding. |r| / max(|r|, |forces|), with torques by the size."""
    sim, plate, state = sliding(6, 0.013, iterations)
    state = with_motion(state, 1, 2.0, 0, 0, 0, spin, 0)
    size = math.sqrt(0.5 * float(np.trace(plate.inertia)) / plate.mass)
    most = 0.0
    for _ in range(6):
        before, (state, info) = state, sim(state, return_info=True)
        wrench = sim.contact_forces(before, state).on_colliders[0, 1]
        change = (state.history.motion - before.history.motion)[0, 1, :3]
        spins = angular_momentum(plate, state, 1) - angular_momentum(plate, before, 1)
        inertia = torch.cat([plate.mass * (change / H + torch.tensor([0.0, 10.0, 0.0])), spins / H / size])
        forces = torch.cat([wrench[:3], wrench[3:] / size])
        left = float((inertia - forces).norm())
        share = left / max(left, math.hypot(float(inertia.norm()), float(forces.norm())))
        assert float(info.residual) == pytest.approx(share, rel=1e-6, abs=1e-11)
        most = max(most, share)
    assert (most > 1e-3) == (iterations < 16)


def test_the_residual_of_free_colliders_is_zero(dtype: torch.dtype) -> None:
    """Also while others meet: rounding is no force. So a body in contact has its own."""
    cube, block, table_ = soft(0.0, 0.05, 0.0), rigid(1.0, 0.4, 0.5, 0.0, turn=(0.6, 0.0, 0.8, 0.0)), table()
    still, pushed = (
        simulator(pd.Scene(cube, table_, *more, contact(), gravity()), 16, dtype=dtype) for more in ((), (block,))
    )
    state, other = still.rest_state(), with_motion(pushed.rest_state(), 1, 0, 0, 0, 3, 2, 1)
    for _ in range(5):
        state, info = still(state, return_info=True)
        other, same = pushed(other, return_info=True)
        assert 0.0 < float(info.residual) < 1.0
        assert float(same.residual) == float(info.residual)


def test_a_tolerance_waits_for_colliders() -> None:
    """The body falls freely, so that its own iterations are done at once."""
    sim, _, state = sliding(6, 0.013, 256, tolerance=1e-9)
    stopped = False
    for _ in range(10):
        state, info = sim(state, return_info=True)
        assert float(info.held_back) < 1e-6
        stopped = stopped or int(info.iterations) < 256
    assert stopped
    assert float(state.history.motion[0, 1, 0]) == pytest.approx(2.0 - 40 * H, abs=1e-3)


def meeting(mass: float, iterations: int, friction: float = 0.0, **options: Any) -> tuple[pd.Simulator, Any, Any]:
    """A turned rigid cube flies into a free soft one."""
    cube, block = soft(0.0, 0.0, 0.0), rigid(mass, 0.02, 0.12, 0.013, turn=(0.97, 0.1, 0.15, 0.05))
    scene = pd.Scene(cube, block, contact(friction), pd.Gravity((0, 0, 0)))
    sim = simulator(scene, iterations, **options)
    return sim, block, with_motion(sim.rest_state(2), 0, 0.3, -1.0, 0.1, 3.0, 1.0, -2.0)


@pytest.mark.parametrize("mass", [0.02, 0.5, 50.0])
@pytest.mark.parametrize("iterations", [4, 1000])
def test_a_collider_and_a_body_that_meet_keep_their_momentum(mass: float, iterations: int) -> None:
    """Linear momentum to rounding at any count of iterations; angular momentum, as the step defines it, once converged:

    sum m x' x (v' - v) + c' x M (V' - V) + L' - L = 0.
    """
    sim, block, state = meeting(mass, iterations)
    masses, met, scale = sim.masses[:, None], False, 1.0 + mass  # kg m/s: 1 kg of the cube, 1 m/s
    for _ in range(6):
        before, state = state, sim(state)
        change = masses * (state.velocities - before.velocities)[0]
        own = mass * (state.history.motion - before.history.motion)[0, 0, :3]
        assert (change.sum(0) + own).abs().max() <= 1e-13 * scale
        met = met or float(own.norm()) > 1e-2 * min(mass, 1.0)
        if iterations < 1000:
            continue
        pose = state.history.poses[0, 0]
        spin = angular_momentum(block, state, 0) - angular_momentum(block, before, 0)
        turning = torch.linalg.cross(state.positions[0], change).sum(0) + torch.linalg.cross(pose[:3], own) + spin
        assert turning.abs().max() <= 1e-12 * scale * 0.1
    assert met


@pytest.mark.parametrize("mass", [0.02, 0.5, 50.0])
@pytest.mark.parametrize("iterations", [8, 64])
def test_two_colliders_that_meet_keep_their_momentum(mass: float, iterations: int) -> None:
    """To rounding, since they are solved jointly. With 4 iterations one step is cut short, with a residual of .8."""
    still, block = rigid(0.5, 0.0, 0.0, 0.0), rigid(mass, 0.02, 0.1, 0.013, turn=(0.97, 0.1, 0.15, 0.05))
    scene = pd.Scene(soft(1.0, 0.0, 0.0), still, block, contact(0.3), pd.Gravity((0, 0, 0)))
    sim = simulator(scene, iterations)
    state, met = with_motion(sim.rest_state(), 1, 0.3, -1.0, 0.1, 3.0, 1.0, -2.0), False
    masses = torch.tensor([[0.5], [mass]], dtype=torch.float64)
    for _ in range(6):
        before, state = state, sim(state)
        change = masses * (state.history.motion - before.history.motion)[0, :, :3]
        met = met or float(change.norm()) > 1e-2 * min(mass, 0.5)
        assert change.sum(0).abs().max() <= 1e-13 * (1.0 + mass)
    assert met


@pytest.mark.parametrize("mass", [0.01, 20.0])
@pytest.mark.parametrize("iterations", [4, 16, 64])
def test_colliders_with_a_mass_do_not_cross(mass: float, iterations: int, dtype: torch.dtype) -> None:
    """A light and a heavy one are thrown at a cube that lies on a table."""
    thrown = rigid(mass, 0.05, 0.25, 0.02, turn=(0.9, 0.2, 0.3, 0.1))
    pebble = pd.Collider(pd.shapes.sphere(0.02, 1), mass=0.005, pose=(-0.2, 0.06, 0.0, 1, 0, 0, 0))
    scene = pd.Scene(soft(0.0, 0.051, 0.0), table(), thrown, pebble, contact(0.3), gravity())
    sim = simulator(scene, iterations, dtype=dtype)
    state = with_motion(with_motion(sim.rest_state(), 1, -1, -6, 0, 20, 10, 5), 2, 10, 0, 0, 0, 0, 0)
    least = math.inf
    for _ in range(10):
        state, info = sim(state, return_info=True)
        assert crossed(sim, state) == 0
        assert state.positions.isfinite().all()
        assert state.history.motion.isfinite().all()
        assert int(info.contact_overflow) == 0
        least = min(least, float(info.contact_gap))
    assert 0.099 <= least < 2.0


@pytest.mark.parametrize("mass", [5e-4, 0.05])
def test_a_light_finger_is_stable_under_a_wrench(mass: float) -> None:
    """2 N press a block of 5 cm and 1e5 Pa, for which pose in and wrench out ask .35 kg: docs/contact.md."""
    cube = soft(0.0, 0.0, 0.0, edge=0.05)
    pin = pd.Pin(cube, np.flatnonzero(cube.mesh.vertices[:, 0] > 0.0249))
    finger = pd.Collider(shape(0.02, 1), mass=mass, pose=(-0.0365, 0, 0, 1, 0, 0, 0))
    sim = simulator(pd.Scene(cube, pin, finger, contact(), pd.Gravity((0, 0, 0))))
    push = {finger: torch.tensor([2.0, 0, 0, 0, 0, 0]).double()}
    state: Any = sim.rest_state()
    for _ in range(40):
        before, state = state, sim(state, targets=push)
    assert float(sim.contact_forces(before, state).bodies[finger].force[0, 0]) == pytest.approx(-2.0, rel=5e-3)
    assert float(state.history.motion[0, 0, :3].abs().max()) < 1e-4


def test_environments_have_the_bits_that_they_have_alone(dtype: torch.dtype) -> None:
    sim, _, start = meeting(0.5, 16, 0.3, dtype=dtype)
    moves = start.history.motion.clone()
    moves[1, 0, :3] = torch.tensor([0.0, -2.0, 0.2], dtype=dtype)
    start = start._replace(history=start.history._replace(motion=moves))
    both = start
    each = [chosen(start, [number]) for number in (0, 1)]
    for _ in range(5):
        both, each = sim(both), [sim(one) for one in each]
    for number, one in enumerate(each):
        for mine, its in zip((*one[:2], *one[2]), (*both[:2], *both[2]), strict=True):
            assert torch.equal(mine, its[[number]])
    assert not torch.equal(both.positions[0], both.positions[1])


def test_an_overflow_takes_the_step_back() -> None:
    cube, block, ground = soft(0.0, 0.05, 0.0), rigid(1.0, 0.0, 0.1 + 0.5 * EDGE + 3e-3, 0.0), table()
    sim = simulator(pd.Scene(cube, ground, block, contact(capacity=1), gravity()), 8)
    start = with_motion(sim.rest_state(), 1, 0, -1, 0, 0.5, 0, 0)
    with pytest.warns(pd.SceneWarning):
        state, info = sim(start, return_info=True)
    assert int(info.contact_overflow) > 0
    for before, after in zip((*start[:2], *start[2]), (*state[:2], *state[2]), strict=True):
        assert torch.equal(before, after)


def test_a_scene_without_masses_has_nothing_of_them() -> None:
    sim = simulator(pd.Scene(soft(0.0, 0.06, 0.0), table(), contact()), 4)
    assert sim.body_contact is not None
    assert sim.body_contact.rigid is None
    assert sim.body_contact.arrays[CONTACT_RIGID].numel() == 0
    assert sim.rest_state(3).history.motion.shape == (3, 0, 6)


@pytest.mark.parametrize("wall", [pd.Ground(), pd.Sphere((0.0, -1.0, 0.0), 0.5)], ids=["Ground", "Sphere"])
def test_planes_and_spheres_pass_through_them_with_a_warning(wall: pd.Ground | pd.Sphere) -> None:
    ball = rigid(0.3, 0.5, 0.0, 0.0)
    name = f"{type(wall).__name__} and 1 Collider with a mass"
    with pytest.warns(pd.SceneWarning, match=name):
        simulator(pd.Scene(soft(0.0, 0.5, 0.0), ball, wall, contact()), 4)


def test_a_compiled_step_has_the_same_bits() -> None:
    sim, block, state = meeting(0.5, 4)
    push = torch.tensor([0.0, -1.0, 0, 0, 0, 0.01]).double()

    def run(state: pd.HistoryState, push: Tensor) -> pd.HistoryState:
        return sim(state, targets={block: push})

    found = torch.compile(run, fullgraph=True, backend="aot_eager")(state, push)
    right = run(state, push)
    for mine, its in zip((*found[:2], *found[2]), (*right[:2], *right[2]), strict=True):
        assert torch.equal(mine, its)


def test_a_saved_simulator_moves_alike(tmp_path: Path) -> None:
    sim, _, state = meeting(0.5, 8)
    sim.save(tmp_path / "sim.safetensors")
    again = pd.Simulator.load(tmp_path / "sim.safetensors")
    one, other = sim.rollout(state, 4).state(), again.rollout(state, 4).state()
    for mine, its in zip((*one[:2], *one[2]), (*other[:2], *other[2]), strict=True):
        assert torch.equal(mine, its)


def test_in_place_steps_and_rollouts_move_alike() -> None:
    sim, block, state = meeting(0.5, 8)
    push = {block: torch.tensor([0.0, -1.0, 0, 0, 0, 0.01]).double()}
    track = sim.rollout(state, 4, targets=push)
    own = state.clone()
    for _ in range(4):
        sim.step_(own, targets=push)
    assert torch.equal(own.history.motion, track.state().history.motion)
    assert torch.equal(own.history.poses, track.history.poses[-1])
