"""Forces of contacts and pins against what statics says of them, and against the momentum of a step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from readout_cases import MESH, SIDE, G, cube, settled, weight
from runs import noise, small
from scipy.optimize import nnls
from torch import Tensor

import torchpd as pd
from torchpd.simulation.readouts import _Contacts, _split


def tilted(degrees: float) -> pd.Gravity:
    """The gravity that a body feels on an incline, with the ground along x and z."""
    angle = np.deg2rad(degrees)
    return pd.Gravity((G * np.sin(angle), -G * np.cos(angle), 0.0))


# ---- contacts


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_cube_at_rest_presses_by_its_weight(dtype: torch.dtype) -> None:
    ground = pd.Ground(friction=0.5)
    sim, solid = cube(pd.Gravity(), ground, pd.Damping(5.0), dtype=dtype)
    state, after = settled(sim)
    contacts = sim.contact_forces(state, after)
    mg, bottom = weight(sim), sim.rest_positions[:, 1] == 0.0
    # what the step leaves of the momentum, and float32 of the elastic forces
    error = 1e-9 * mg if dtype == torch.float64 else 1e-3 * mg
    one = contacts.colliders[ground]
    assert torch.equal(one.touches[0], bottom)
    assert float(contacts.residual.norm()) <= error
    for wrench in (contacts.bodies[solid], one.bodies[solid]):
        assert wrench.force[0].tolist() == pytest.approx([0.0, mg, 0.0], abs=error)
        assert wrench.torque[0].tolist() == pytest.approx([0.0] * 3, abs=error * SIDE)
    assert torch.equal(contacts.force, one.force)
    assert float(one.push.sum()) == pytest.approx(mg, abs=error)
    assert not bool(one.force[0, ~bottom].any())


def test_torque_is_about_a_named_point() -> None:
    sim, solid = cube(pd.Gravity(), pd.Ground(), pd.Damping(5.0))
    state, after = settled(sim, batch=2)
    points = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    wrench = sim.contact_forces(state, after, about=points).bodies[solid]
    center = after.positions.mul(sim.masses[:, None]).sum(1) / sim.masses.sum()
    expected = torch.linalg.cross(center - points, wrench.force)
    torch.testing.assert_close(wrench.torque, expected, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(sim.contact_forces(state, after).bodies[solid].about, center, rtol=1e-12, atol=0.0)
    assert torch.equal(sim.contact_forces(state, after, about=points[0]).bodies[solid].torque[0], wrench.torque[0])


def test_an_incline_that_holds() -> None:
    """tan 20 degrees < friction: normal m g cos, tangential m g sin uphill."""
    ground = pd.Ground(friction=0.8)
    sim, _ = cube(tilted(20.0), ground, pd.Damping(5.0))
    state, after = settled(sim)
    one = sim.contact_forces(state, after).colliders[ground]
    mg, angle = weight(sim), np.deg2rad(20.0)
    assert float(one.push.sum()) == pytest.approx(mg * np.cos(angle), rel=1e-6)
    assert one.friction.sum(1)[0].tolist() == pytest.approx([-mg * np.sin(angle), 0.0, 0.0], abs=1e-6 * mg)
    assert bool((one.friction.norm(dim=-1) <= 0.8 * one.push * (1 + 1e-12)).all())


def test_sliding_friction_is_friction_times_push() -> None:
    """On 30 degrees with friction 0.2: at every vertex against the slip, and at its bound."""
    ground = pd.Ground(friction=0.2)
    sim, _ = cube(tilted(30.0), ground)
    state, after = settled(sim, 120)
    contacts = sim.contact_forces(state, after)
    one = contacts.colliders[ground]
    slip = after.positions - state.positions
    assert int(one.touches.sum()) == 9
    push, friction, slip = one.push[one.touches], one.friction[one.touches], slip[one.touches]
    assert bool((slip[:, 0] > 0.0).all())
    expected = -0.2 * push[:, None] * slip / slip.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(friction, expected, rtol=0.0, atol=1e-6 * weight(sim))
    assert float(contacts.residual.norm()) <= 1e-6 * weight(sim)


def test_a_sphere_pushes_along_its_normals() -> None:
    """It carries the weight; smooth, every force points away from its centre."""
    ball = pd.Sphere((SIDE / 2, -0.5, SIDE / 2), 0.5)
    sim, solid = cube(pd.Gravity(), ball, youngs=2e4)
    state = sim.rest_state()
    for _ in range(40):  # symmetric, so that it stays on top; velocities are taken away
        state = pd.State(sim(state).positions, torch.zeros_like(state.velocities))
    after = sim(state)
    contacts = sim.contact_forces(state, after)
    one = contacts.colliders[ball]
    touched = one.touches[0]
    assert 1 <= int(touched.sum()) < 9
    away = after.positions[0, touched] - sim.spheres[0, :3]
    forces = one.force[0, touched]
    assert float(torch.linalg.cross(away, forces).abs().max()) <= 1e-12
    assert bool(((away * forces).sum(-1) > 0.0).all())
    balance(sim, solid, state, after)


def balance(sim: pd.Simulator, solid: pd.Solid, state: pd.State, after: pd.State, forces: Tensor | None = None) -> None:
    """All forces together are the change of momentum, at any iterate, but for rounding."""
    contacts, pins = sim.contact_forces(state, after, forces), sim.reactions(state, after, forces)
    moved = sim.masses[:, None] * (after.positions - state.positions) / sim.time_step
    change = (moved - sim.masses[:, None] * state.velocities) / sim.time_step
    given = sim.masses[:, None] * sim.gravity - sim.damping * moved + (0.0 if forces is None else forces)
    total = (contacts.residual + pins.on_vertices + given).sum(1) + contacts.bodies[solid].force
    scale = float(change.abs().sum() + given.abs().sum() + sim.gradient(after).abs().sum())
    torch.testing.assert_close(total, change.sum(1), rtol=0.0, atol=30 * 2.0**-53 * scale)


@pytest.mark.parametrize("iterations", [1, 30])
def test_all_forces_are_the_change_of_momentum(iterations: int) -> None:
    """Of landings on ground and ball with pins and forces, solved or not."""
    sim, state = small(torch.float64, iterations=iterations)
    forces = noise(state.positions, 5)
    after = sim(state, forces)
    contacts = sim.contact_forces(state, after, forces)
    assert any(bool(one.touches.any()) for one in contacts.colliders.values())
    balance(sim, sim.scene.solids[0], state, after, forces)


def test_a_corner_is_split_by_its_normals() -> None:
    """Smooth floor and wall carry what gravity has along each; the edge has both."""
    floor, wall = pd.Ground(), pd.Ground(normal=(1.0, 0.0, 0.0))
    sim, solid = cube(pd.Gravity((-3.0, -9.0, 0.0)), floor, wall, pd.Damping(5.0))
    state, after = settled(sim)
    contacts = sim.contact_forces(state, after)
    mass = float(sim.masses.sum())
    for ground, expected, axis in ((floor, [0.0, 9.0 * mass, 0.0], 1), (wall, [3.0 * mass, 0.0, 0.0], 0)):
        one = contacts.colliders[ground]
        assert one.bodies[solid].force[0].tolist() == pytest.approx(expected, abs=1e-6 * mass)
        assert torch.equal(one.touches[0], sim.rest_positions[:, axis] == 0.0)
    assert int((contacts.colliders[floor].touches & contacts.colliders[wall].touches).sum()) == 3


@pytest.mark.parametrize(("degrees", "error"), [(20.0, 0.07), (30.0, 0.07), (60.0, 1e-2), (75.0, 1e-2)])
def test_a_groove_holds_the_edge(degrees: float, error: float) -> None:
    """Of planes whose normals lean by so much: in a steep one the cube rocks.

    In a flat one the edge hovers, a step that no iterations solve (docs/limits.md): its residual says so.
    """
    lean, turn = np.deg2rad(degrees), np.deg2rad(45.0)
    x, y, z = MESH.vertices.T
    turned = np.stack([np.cos(turn) * (x - y), np.sin(turn) * (x + y) + 0.05, z], axis=1)
    solid = pd.Solid(pd.TetMesh(turned, MESH.tets), youngs=1e5, density=1000.0)
    planes = [pd.Ground(normal=(side * np.sin(lean), np.cos(lean), 0.0)) for side in (1.0, -1.0)]
    scene = pd.Scene(solid, *planes, pd.Gravity(), pd.Damping(5.0))
    sim = pd.Simulator(scene, 1 / 60, 400, dtype=torch.float64, progress=False)
    state, after = settled(sim)
    contacts = sim.contact_forces(state, after)
    assert float(contacts.residual.sum(1).norm()) <= error * weight(sim)
    assert degrees > 45.0 or float(sim(state, return_info=True)[1].residual) > 0.05
    for one in contacts.colliders.values():
        assert bool(one.touches.any())
        assert not bool(one.friction.any())
    balance(sim, solid, state, after)


def test_colliders_that_nothing_touches_do_not_matter() -> None:
    """Beside four of them, and a copy of the floor: only three contacts of a vertex are looked at."""
    floor, wall = pd.Ground(), pd.Ground(normal=(1.0, 0.0, 0.0))
    gravity = pd.Gravity((-3.0, -9.0, 0.0))
    far = [pd.Ground(normal=(-1.0, 0.0, 0.0), height=-9.0), pd.Sphere((5.0, 5.0, 5.0), 1.0), pd.Ground(height=-1.0)]
    sim, _ = cube(gravity, floor, wall)
    more, _ = cube(gravity, far[0], floor, far[1], wall, far[2])
    state, after = settled(sim, 20)
    few, many = sim.contact_forces(state, after), more.contact_forces(state, after)
    for ground in (floor, wall):
        assert torch.equal(few.colliders[ground].force, many.colliders[ground].force)
        assert torch.equal(few.colliders[ground].touches, many.colliders[ground].touches)
    assert not any(bool(many.colliders[part].force.any()) for part in far)  # type: ignore[index]
    assert torch.equal(few.residual, many.residual)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_split_is_the_least_squares_one(count: int) -> None:
    """Nonnegative least squares by scipy, of forces within the cone of the normals and outside of it."""
    rng = np.random.default_rng(count)
    normals = rng.standard_normal((40, count, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    force = rng.standard_normal((40, 3))
    force[:20] = np.einsum("vk,vkx->vx", rng.uniform(0.1, 1.0, (20, count)), normals[:20])
    expected = np.array([nnls(n.T, f)[0] for n, f in zip(normals, force, strict=True)])
    contacts = _Contacts(
        torch.from_numpy(normals).movedim(0, 1)[None], -torch.ones(1, count, 40).double(), torch.zeros(1, count, 40)
    )
    pushes, friction, active = _split(contacts, torch.from_numpy(force)[None], torch.ones(40).double())
    assert pushes[0].T.numpy() == pytest.approx(expected, abs=1e-10)
    assert torch.equal(active, pushes > 0.0)
    assert not bool(friction.any())


def test_friction_is_shared_at_a_corner() -> None:
    """Along the edge of two planes, in proportion to friction times push, and no more than both together."""
    normals = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]).double()
    force = torch.tensor([[3.0, 2.0, 0.5], [3.0, 2.0, 5.0]]).double()[None]
    friction = torch.tensor([0.3, 0.2]).double()[None, :, None].expand(1, 2, 2)
    contacts = _Contacts(normals[None, :, None].expand(1, 2, 2, 3), -torch.ones(1, 2, 2).double(), friction)
    pushes, along, _ = _split(contacts, force, torch.ones(2).double())
    assert pushes[0, :, 0].tolist() == pytest.approx([2.0, 3.0])
    assert along[0, :, 0].tolist() == pytest.approx(np.array([[0.0, 0.0, 0.25], [0.0, 0.0, 0.25]]))
    assert along[0, :, 1].tolist() == pytest.approx(np.array([[0.0, 0.0, 0.6], [0.0, 0.0, 0.6]]))


def test_without_colliders_everything_is_residual() -> None:
    sim, solid = cube(pd.Gravity(), iterations=2)
    state = sim.rest_state(2)
    state.velocities[..., 0] = state.positions[..., 1]
    after = sim(state)
    contacts = sim.contact_forces(state, after)
    assert contacts.colliders == {}
    assert torch.equal(contacts.residual, sim.step_gradient(state, after))
    assert not bool(contacts.force.any())
    assert contacts.bodies[solid].force.shape == (2, 3)
    reactions = sim.reactions(state, after)
    assert reactions.pins == {}
    assert reactions.force.shape == (2, 0, 3)


# ---- of all


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_batches_do_not_matter(dtype: torch.dtype) -> None:
    sim, state = small(dtype, batch=3)
    after = sim(state)
    together = leaves(sim, state, after)
    for item in range(3):
        one, next_one = (pd.State(*(array[item : item + 1].clone() for array in of)) for of in (state, after))
        for name, (alone, all_) in enumerate(zip(leaves(sim, one, next_one), together, strict=True)):
            assert torch.equal(alone, all_[item : item + 1]), name


def leaves(sim: pd.Simulator, state: pd.State, after: pd.State) -> list[Tensor]:
    tree = sim.contact_forces(state, after), sim.reactions(state, after), sim.stress(after)
    return [leaf.nan_to_num(7.0) for leaf in torch.utils._pytree.tree_leaves(tree)]


def test_gradients_by_finite_differences() -> None:
    """Of all forces by everything that they depend on, at a step that slides and sticks on ground and ball."""
    sim, state = small(torch.float64, batch=2, iterations=60)
    sim.set_material(friction=torch.tensor([0.5, 0.2]))
    after = sim(state)
    names = ["stiffness", "masses", "gravity", "damping", "pin_targets", "planes", "spheres"]
    touched = [one.touches for one in sim.contact_forces(state, after).colliders.values()]
    assert all(bool(mask.any()) for mask in touched)

    def read(x: Tensor, v: Tensor, end: Tensor, *material: Tensor) -> tuple[Tensor, ...]:
        arrays = dict(zip(names, material, strict=True))
        contacts = called(sim, arrays, "contact_forces", pd.State(x, v), end)
        pins = called(sim, arrays, "reactions", pd.State(x, v), end)
        wrenches = [wrench for one in contacts.colliders.values() for wrench in one.bodies.values()]
        pulls = [one.wrench.torque for one in pins.pins.values()]
        pushes = [one.push for one in contacts.colliders.values()]
        return contacts.force, contacts.residual, pins.force, *pulls, *pushes, *(w.torque for w in wrenches)

    inputs = [*state, after.positions, *(getattr(sim, name) for name in names)]
    inputs = [value.detach().clone().requires_grad_() for value in inputs]
    outputs = read(*inputs)
    gen = torch.Generator().manual_seed(0)
    weights = [torch.randn(out.shape, generator=gen, dtype=torch.float64) for out in outputs]
    loss = lambda values: sum((w * out).sum() for w, out in zip(weights, read(*values), strict=True))  # noqa: E731
    gradients = torch.autograd.grad(loss(inputs), inputs)
    for number, gradient in enumerate(gradients):
        direction = torch.randn(gradient.shape, generator=gen, dtype=torch.float64)
        value = inputs[number].detach()
        step = 1e-7 * float(value.abs().max() + 1e-3)  # slips are small: they turn quickly
        ends = [[*inputs[:number], value + sign * step * direction, *inputs[number + 1 :]] for sign in (1.0, -1.0)]
        with torch.no_grad():
            difference = float(loss(ends[0]) - loss(ends[1])) / (2 * step)
        expected = float((gradient * direction).sum())
        assert difference == pytest.approx(expected, rel=1e-5, abs=1e-7), number


class Caller(torch.nn.Module):
    """Calls a method of a simulator, for `functional_call`."""

    def __init__(self, sim: pd.Simulator) -> None:
        super().__init__()
        self.sim = sim

    def forward(self, name: str, *arguments: Any) -> Any:
        return getattr(self.sim, name)(*arguments)


def called(sim: pd.Simulator, arrays: dict[str, Tensor], name: str, *arguments: Any) -> Any:
    """A method with other material."""
    material = {f"sim.{key}": value for key, value in arrays.items()}
    return torch.func.functional_call(Caller(sim), material, (name, *arguments))


REFUSED: dict[str, tuple[Callable[[pd.Simulator, pd.State], Any], type[Exception], str]] = {
    "no tensor": (lambda sim, s: sim.contact_forces(s, s, about=(0.0, 0.0, 0.0)), TypeError, "about .* tuple"),
    "precision": (lambda sim, s: sim.reactions(s, s, about=torch.zeros(3)), TypeError, "about .* torch.float32"),
    "shape": (lambda sim, s: sim.reactions(s, s, about=torch.zeros(2, 3).double()), ValueError, r"about .* \[2, 3\]"),
    "after": (lambda sim, s: sim.contact_forces(s, sim.rest_state(2)), ValueError, r"after .* \[2, "),
    "forces": (lambda sim, s: sim.contact_forces(s, s, forces=s.positions[:, :1]), ValueError, "forces"),
    "stress": (lambda sim, s: sim.stress(s.positions[:, :1]), ValueError, r"state .*got \[1, 1, 3\]"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_refused(case: str) -> None:
    sim, state = small(torch.float64, batch=1)
    call, kind, words = REFUSED[case]
    with pytest.raises(kind, match=words):
        call(sim, state)


@pytest.mark.parametrize("name", ["stiffness", "planes", "gravity", "pin_targets"])
@pytest.mark.parametrize("read", ["contact_forces", "reactions", "stress"])
def test_material_of_other_environments_is_refused(name: str, read: str) -> None:
    """As a step refuses it; nothing is stretched to as many as there are of the other."""
    sim, state = small(torch.float64, batch=1)
    array = getattr(sim, name).detach()
    sim.set_material(**{name: array.expand(3, *array.shape)})
    if read == "stress" and name != "stiffness":
        assert len(sim.stress(state).cauchy) == 1
        return
    states = (state,) if read == "stress" else (state, state)
    with pytest.raises(ValueError, match=rf"environments as the simulator's {name}, 3, got 1|{name} must be .* \[3, "):
        getattr(sim, read)(*states)


def test_targets_and_forces_are_those_of_the_step() -> None:
    """A ball that a target moves up lifts the cube: with its place the step balances, without it the ball is far."""
    ball = pd.Sphere((SIDE / 2, -1.2, SIDE / 2), 1.0, friction=0.8)
    sim, solid = cube(pd.Gravity(), ball)
    state, targets = sim.rest_state(), {ball: torch.tensor([SIDE / 2, -1.0, SIDE / 2]).double()}
    pull = torch.zeros_like(state.positions)
    pull[..., 1] = -1.0
    after = sim(state, pull, targets)
    there, elsewhere = sim.contact_forces(state, after, pull, targets), sim.contact_forces(state, after, pull)
    assert float(there.residual.norm()) <= 1e-6 * float(there.force.norm())
    assert float(there.bodies[solid].force[0, 1]) > 0.0
    assert not bool(elsewhere.force.any())


def test_compiled_and_within_autocast_they_are_the_same() -> None:
    sim, state = small(torch.float64, batch=2)
    after = sim(state)

    def read(state: pd.State, after: pd.State) -> list[Tensor]:
        contacts, pins = sim.contact_forces(state, after), sim.reactions(state, after)
        wrenches = [wrench.torque for wrench in contacts.bodies.values()]
        averages = sim.vertex_average(sim.stress(after).strain)
        return [contacts.force, *wrenches, pins.on_vertices, averages]

    expected = read(state, after)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert all(map(torch.equal, read(state, after), expected))
    compiled = torch.compile(read, backend="eager", fullgraph=True)(state, after)
    assert all(map(torch.equal, compiled, expected))


def test_gradients_through_the_step() -> None:
    """Of contact forces by stiffness and friction, the step that leads there included: a cube that slides."""
    ground = pd.Ground(friction=0.3)
    sim, _ = cube(pd.Gravity((4.0, -9.0, 0.0)), ground, iterations=2000)
    state = sim.rollout(sim.rest_state(), 7).state()
    weights = noise(state.positions, 2)

    def read(stiffness: Tensor, friction: Tensor) -> Tensor:
        planes = torch.cat([sim.planes[:, :4], friction.reshape(1, 1)], dim=1)
        arrays = {"stiffness": stiffness, "planes": planes}
        after = torch.func.functional_call(sim, arrays, (state,))
        return (weights * called(sim, arrays, "contact_forces", state, after).colliders[ground].force).sum()

    inputs = [sim.stiffness.detach().clone().requires_grad_(), torch.tensor(0.3).double().requires_grad_()]
    gradients = torch.autograd.grad(read(*inputs), inputs)
    directions = [inputs[0].detach() * noise(inputs[0], 3), torch.tensor(1.0).double()]
    for number, (gradient, direction) in enumerate(zip(gradients, directions, strict=True)):
        step = 1e-5 * direction
        ends = [[*inputs[:number], inputs[number] + move, *inputs[number + 1 :]] for move in (step, -step)]
        with torch.no_grad():
            difference = float(read(*ends[0]) - read(*ends[1])) / 2e-5
        assert difference == pytest.approx(float((gradient * direction).sum()), rel=1e-5)


def test_no_environment() -> None:
    sim, _ = small(torch.float64)
    none = sim.rest_state(0)
    assert sim.contact_forces(none, none).force.shape == (0, sim.vertices, 3)
    assert sim.reactions(none, none).on_vertices.shape == (0, sim.vertices, 3)
    assert sim.vertex_average(sim.stress(none).cauchy).shape == (0, sim.vertices, 3, 3)
