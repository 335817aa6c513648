"""Forces between surfaces that a step with `Contact` left: statics, closed forms, balances and what is refused."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from body_scenes import THICKNESS, Course, G, block, each, gravity, gripper, plane, pose, simulator, slope
from programs import ROOT
from torch import Tensor

import torchpd as pd
from torchpd.reference.contact.distance import closest
from torchpd.simulation.pair_forces import closest_points, sums_by


def read(sim: pd.Simulator, course: Course, steps: int, **options: Any) -> tuple[Any, Any, pd.ContactForces]:
    """The last step of a course, and its forces."""
    state: Any = course.start(sim)
    for _ in range(steps):
        before, state = state, sim(state)
    return before, state, sim.contact_forces(before, state, **options)


# ---- closest points and sums


@pytest.mark.parametrize(
    ("edges", "corners", "distance", "weights"),
    [
        (False, [(0.2, 0.3, 0.5), (0, 0, 0), (1, 0, 0), (0, 1, 0)], 0.5, [1, -0.5, -0.2, -0.3]),
        (False, [(2, 2, 0), (0, 0, 0), (1, 0, 0), (0, 1, 0)], 3 / math.sqrt(2), [1, 0, -0.5, -0.5]),
        (True, [(0, 0, 0), (1, 0, 0), (0.5, -1, 0.1), (0.5, 1, 0.1)], 0.1, [0.5, 0.5, -0.5, -0.5]),
        (True, [(0, 0, 0), (1, 0, 0), (0.25, 0, 0.2), (0.75, 0, 0.2)], 0.2, None),
        (True, [(0, 0, 0), (1, 0, 0), (0.25, 0, 0.2), (0.75, 5e-10, 0.2)], 0.2, None),
        (True, [(0, 0, 0), (1, 0, 0), (2, 1, 0), (2, 3, 0)], math.sqrt(2), [0, 1, -1, 0]),
    ],
)
def test_closest_points_in_exact_cases(edges: bool, corners: Any, distance: float, weights: list[float] | None) -> None:
    found, diff = closest_points(torch.tensor([edges]), torch.tensor([corners], dtype=torch.float64))
    assert float(diff.norm()) == pytest.approx(distance, abs=1e-8)
    if weights is not None:
        assert found[0].tolist() == pytest.approx(weights, abs=1e-12)
    assert float(found[0, : 2 if edges else 1].sum()) == pytest.approx(1.0, abs=1e-15)
    assert float(found.sum()) == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("edges", [True, False])
def test_closest_points_of_random_pairs(edges: bool) -> None:
    corners = torch.from_numpy(np.random.default_rng(0).standard_normal((2000, 4, 3)))
    expected = closest(corners, 0 if edges else len(corners))
    weights, diff = closest_points(torch.full((2000,), edges), corners)
    torch.testing.assert_close(weights, expected.weights, rtol=0.0, atol=1e-10)
    torch.testing.assert_close(diff, expected.diff, rtol=0.0, atol=1e-12)


def test_sums_by_label() -> None:
    """In a fixed order: with other entries, and more that are left out, a sum has the same bits."""
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(150, 2, generator=generator)
    labels = torch.randint(0, 8, (150,), generator=generator)
    labels[labels == 3] = 2
    found = sums_by(values, labels, 7, 150)  # 7 is left out
    expected = torch.zeros(8, 2).double().index_add_(0, labels, values.double())
    torch.testing.assert_close(found.double(), expected[:7], rtol=0.0, atol=1e-5)
    assert not bool(found[3].any())
    chosen = labels >= 4
    more = torch.nn.functional.pad(values[chosen], (0, 0, 0, 900), value=9.0)
    assert torch.equal(sums_by(more, torch.nn.functional.pad(labels[chosen], (0, 900), value=7), 7, 150)[4:], found[4:])
    assert not bool(sums_by(values[:0], labels[:0], 7, 0).any())


# ---- statics and closed forms


@pytest.mark.parametrize(
    ("name", "iterations", "total"), [("hit_28_contacts", 1500, 31.2749565), ("hit_6_contacts", 5000, 13.0299102)]
)
def test_the_forces_of_another_method(name: str, iterations: int, total: float) -> None:
    """Two bodies that meet, solved in the metric of A: places to 1e-9 m, forces on vertices to 1e-6 of the largest.

    Momentum stays, and angular momentum as implicit Euler has it: sum m x' x (v' - v) = 0.
    """
    with np.load(ROOT / "tests" / "fixtures" / f"{name}.npz") as data:
        given = dict(data)
    body, tets, bodies = given["body"], given["tets"], []
    for number in (0, 1):
        own = body[tets[:, 0]] == number
        mesh = pd.TetMesh(given["rest"][body == number], tets[own] - np.flatnonzero(body == number)[0])
        bodies.append(pd.Solid(mesh, youngs=given["youngs"][own], density=1000.0))
    scene = pd.Scene(*bodies, pd.Contact(thickness=float(given["thickness"])))
    sim = pd.Simulator(scene, float(given["time_step"]), iterations, dtype=torch.float64, progress=False)
    rest: Any = sim.rest_state()
    state = pd.HistoryState(
        torch.tensor(given["positions"])[None], torch.tensor(given["velocities"])[None], rest.history
    )
    after: Any = sim(state)
    assert float((after.positions[0] - torch.tensor(given["solution"])).abs().max()) <= 1e-9
    gain = sim.masses.reshape(-1, 1) * (after.velocities[0] - state.velocities[0])
    speed = float(gain.norm(dim=1).sum())
    assert float(gain.sum(0).norm()) <= 1e-12 * speed
    assert float(torch.linalg.cross(after.positions[0], gain).sum(0).norm()) <= 1e-7 * speed
    contacts = sim.contact_forces(state, after)
    expected, pairs = torch.tensor(given["contact_forces"]), contacts.pairs
    scale = float(expected.abs().max())
    torch.testing.assert_close(contacts.force[0], expected, rtol=0.0, atol=1e-6 * scale)
    assert torch.equal(contacts.force, pairs.on_vertices)
    assert float(contacts.residual.abs().max()) <= 1e-6 * scale
    normal = (pairs.normals * pairs.force).sum(-1)
    assert float(normal.sum()) == pytest.approx(total, abs=5e-6)
    first, second = bodies
    torch.testing.assert_close(
        contacts.between[first, second].force[0], expected[body == 0].sum(0), rtol=0.0, atol=1e-6 * total
    )
    assert torch.equal(contacts.between[first, second].force, -contacts.between[second, first].force)


def on_a_plate(dtype: torch.dtype) -> tuple[pd.Simulator, pd.Solid, pd.Collider, Course]:
    """A cube of 1 kg rests off the centre of a plate, whose origin is elsewhere and whose axes are turned."""
    angle = math.radians(30.0)
    turned = (0.2, 0.1, -0.3, math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0)
    cube = block(0.1, 3, (0.31, 0.1 + THICKNESS + 0.05, -0.22))
    table = pd.Collider(plane(0.8, 0.8, 5), friction=0.5, pose=turned)
    scene = pd.Scene(cube, table, gravity(), pd.Contact(thickness=THICKNESS))
    return simulator(scene, 64, dtype=dtype), cube, table, Course(scene)


def test_a_cube_on_a_plate(dtype: torch.dtype) -> None:
    """The plate feels the weight, and its torque m g x arm about the plate's actual origin, in world axes."""
    sim, cube, table, course = on_a_plate(dtype)
    _, after, contacts = read(sim, course, 40)
    weight = G * float(sim.masses.sum())
    error = 1e-4 * weight
    center = (sim.masses[:, None] * after.positions[0]).sum(0) / sim.masses.sum()
    arm = center.double() - torch.tensor([0.2, 0.1, -0.3]).double()
    length = float(arm.norm())
    down = torch.tensor([0.0, -weight, 0.0]).double()
    on_table = contacts.bodies[table]
    assert on_table.force[0].tolist() == pytest.approx(down.tolist(), abs=error)
    assert on_table.torque[0].tolist() == pytest.approx(torch.linalg.cross(arm, down).tolist(), abs=error * length)
    assert on_table.about[0].tolist() == pytest.approx([0.2, 0.1, -0.3])
    assert torch.equal(contacts.on_colliders[:, 0], torch.cat([on_table.force, on_table.torque], dim=1))
    mutual = contacts.between[table, cube]
    torch.testing.assert_close(mutual.force, on_table.force, rtol=0.0, atol=error)
    torch.testing.assert_close(mutual.torque, on_table.torque, rtol=0.0, atol=error * 0.1)
    on_cube = contacts.bodies[cube]
    assert on_cube.force[0].tolist() == pytest.approx((-down).tolist(), abs=error)
    assert on_cube.torque[0].tolist() == pytest.approx([0.0] * 3, abs=error * 0.1)
    # about the cube's centre no torque is left of the pair, either
    assert contacts.between[cube, table].torque[0].tolist() == pytest.approx([0.0] * 3, abs=error * 0.1)
    named = sim.contact_forces(*read(sim, course, 2)[:2], about=center.to(dtype))
    assert torch.equal(named.bodies[table].about[0], center.to(dtype))


def test_a_block_at_rest_on_a_slope() -> None:
    """tan 20 degrees < .5: normal m g cos, friction m g sin, uphill; within the cone at every pair."""
    course = slope(20.0, 0.5)
    sim = simulator(course.scene, 64)
    _, _, contacts = read(sim, course, 40)
    (body,), (table,) = course.scene.bodies, course.scene.colliders
    angle, weight, pairs = math.radians(20.0), G * float(sim.masses.sum()), contacts.pairs
    assert contacts.between[body, table].force[0].tolist() == pytest.approx([0.0, weight, 0.0], abs=1e-4 * weight)
    normal = (pairs.normals * pairs.force).sum(-1, keepdim=True)
    friction = pairs.force - normal * pairs.normals
    assert float(normal.sum()) == pytest.approx(weight * math.cos(angle), rel=1e-4)
    # side A may be of either body
    on_block = torch.where((pairs.vertices[..., :1] < sim.vertices), friction, -friction).sum(1)[0]
    uphill = torch.tensor([-math.cos(angle), math.sin(angle), 0.0]).double()
    assert float(on_block @ uphill) == pytest.approx(weight * math.sin(angle), rel=1e-4)
    assert bool((friction.norm(dim=-1) <= 0.5 * normal[..., 0] + 1e-9).all())


def stack() -> tuple[list[pd.Solid], pd.Ground, pd.Scene]:
    """Two cubes of 1 kg on each other on ground, r apart."""
    cubes = [block(0.1, 2, (0.003 * n, 0.05 + n * (0.1 + THICKNESS), 0.002 * n)) for n in range(2)]
    ground = pd.Ground(0.0, friction=0.5)
    contact = pd.Contact(friction=0.5, thickness=THICKNESS)
    return cubes, ground, pd.Scene(*cubes, ground, gravity(), pd.Damping(5.0), contact)


def test_cubes_on_each_other_on_ground() -> None:
    """Each pair carries what is above it, and the ground the sum."""
    (lower, upper), ground, scene = stack()
    sim = simulator(scene, 64)
    before, after, contacts = read(sim, Course(scene), 80)
    weight = G * float(sim.masses.sum())
    up = torch.tensor([0.0, 1.0, 0.0]).double()
    for wrench, share in (
        (contacts.colliders[ground].bodies[lower], 1.0),
        (contacts.between[upper, lower], 0.5),
        (contacts.between[lower, upper], -0.5),
        (contacts.bodies[lower], 0.5),
        (contacts.bodies[upper], 0.5),
    ):
        assert wrench.force[0].tolist() == pytest.approx((share * weight * up).tolist(), abs=1e-4 * weight)
    assert not bool(contacts.colliders[ground].bodies[upper].force.any())
    assert float(contacts.residual.norm()) <= 1e-4 * weight
    assert contacts.on_colliders.shape == (1, 0, 6)
    assert set(contacts.between) == {(upper, lower), (lower, upper)}
    balance(sim, before, after)


def balance(sim: pd.Simulator, state: Any, after: Any, targets: Any = None) -> None:
    """All forces together are the change of momentum, at any iterate, but for rounding."""
    contacts, pins = (of(state, after, targets=targets) for of in (sim.contact_forces, sim.reactions))
    moved = sim.masses[:, None] * (after.positions - state.positions) / sim.time_step
    change = (moved - sim.masses[:, None] * state.velocities) / sim.time_step
    given = sim.masses[:, None] * sim.gravity - sim.damping * moved
    total = (contacts.residual + pins.on_vertices + given + contacts.force).sum(1)
    scale = float(change.abs().sum() + given.abs().sum() + sim.gradient(after).abs().sum())
    scale += float(contacts.force.abs().sum())
    torch.testing.assert_close(total, change.sum(1), rtol=0.0, atol=30 * 2.0**-53 * scale)
    # bodies and colliders: what surfaces do to each other adds up to nothing
    mutual = sum((wrench.force for wrench in contacts.between.values()), torch.zeros(1, 3).double())
    assert float(mutual.abs().max()) <= 1e-15 * scale


@pytest.mark.parametrize("iterations", [2, 16])
def test_forces_of_unsolved_steps_are_the_change_of_momentum(iterations: int) -> None:
    """A pinned block, one that falls on it, ground and a plate that pushes from the side."""
    held, free = block(0.1, 2, (0.0, 0.05, 0.0)), block(0.1, 2, (0.02, 0.16, 0.01))
    plate = pd.Collider(plane(0.3, 0.3, 3), pose=(0.075, 0.12, 0.0, math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)))
    pin = pd.Pin(held, held.mesh.vertices[:, 1] > 0.09)
    soft = pd.Pin(free, [0], stiffness=1e3)
    contact = pd.Contact(friction=0.6, thickness=THICKNESS)
    scene = pd.Scene(held, free, plate, pin, soft, pd.Ground(friction=0.3), gravity(), pd.Damping(1.0), contact)
    course = Course(scene, each(scene, (0.0, 0.0, 0.0), (0.0, -3.0, 0.0)))
    sim, state = simulator(scene, iterations), None
    state = course.start(sim)
    carried = 0.0
    for number in range(4):
        x = 0.075 - 0.005 * (number + 1)
        half = math.sqrt(0.5)
        targets = {plate: torch.tensor([x, 0.12, 0.0, half, 0.0, 0.0, half]).double()}
        after: Any = sim(state, targets=targets)
        balance(sim, state, after, targets)
        carried += float(sim.contact_forces(state, after, targets=targets).pairs.on_vertices.abs().sum())
        state = after
    assert carried > 1.0


def test_pins_carry_what_surfaces_put_on_them() -> None:
    """A block rests on another one that is held all over: the pin carries both weights."""
    held, free = block(0.1, 2, (0.0, 0.05, 0.0)), block(0.1, 2, (0.0, 0.15 + THICKNESS, 0.0))
    pin = pd.Pin(held, range(27))
    scene = pd.Scene(held, free, pin, gravity(), pd.Contact(friction=0.5, thickness=THICKNESS))
    sim = simulator(scene, 128)
    before, after, contacts = read(sim, Course(scene), 40)
    weight = 0.5 * G * float(sim.masses.sum())
    assert contacts.between[held, free].force[0, 1] == pytest.approx(-weight, rel=1e-4)
    carried = sim.reactions(before, after).pins[pin].wrench.force[0]
    assert carried.tolist() == pytest.approx([0.0, 2.0 * weight, 0.0], abs=1e-4 * weight)


def test_a_body_that_touches_itself() -> None:
    """Its own forces add up to nothing on it."""
    from body_scenes import folded_sheet

    course = folded_sheet(self_contact=True)
    sim = simulator(course.scene, 32)
    before, after, contacts = read(sim, course, 12)
    assert int(contacts.pairs.counts) > 0
    (sheet,) = course.scene.bodies
    size = float(contacts.pairs.force.abs().sum())
    assert size > 0.1
    assert float(contacts.pairs.on_vertices.sum(1).abs().max()) <= 1e-14 * size
    assert contacts.between == {}
    ground = next(iter(contacts.colliders.values()))
    torch.testing.assert_close(contacts.bodies[sheet].force, ground.bodies[sheet].force, rtol=0.0, atol=1e-14 * size)
    balance(sim, before, after)


# ---- shapes, bits and transformations


def gripped(dtype: torch.dtype, batch: int) -> tuple[pd.Simulator, Any, Any, Any]:
    """Environments of the gripper with fingers at different depths, the last one open."""
    course = gripper(0.8)
    sim = simulator(course.scene, 16, dtype=dtype)
    left, right = course.scene.colliders
    depth = torch.linspace(0.013, 0.013 if batch == 1 else 0.0, batch, dtype=torch.float64)[:, None]
    poses = pose().repeat(batch, 1)
    targets = {}
    for part, side in ((left, 1.0), (right, -1.0)):
        poses[:, :1] = side * depth
        targets[part] = poses.clone().to(dtype)
    state: Any = sim.rest_state(batch)
    for _ in range(4):
        before, state = state, sim(state, targets=targets)
    return sim, before, state, targets


def test_an_environment_has_the_same_bits_in_every_batch(dtype: torch.dtype) -> None:
    sim, before, after, targets = gripped(dtype, 4)
    together = sim.contact_forces(before, after, targets=targets)
    for item in range(4):
        one, next_one = (
            pd.HistoryState(*(of[n][item : item + 1].clone() for n in (0, 1)),
                            pd.ContactHistory(*(part[item : item + 1].clone() for part in of[2])))
            for of in (before, after)
        )  # fmt: skip
        own = {part: value[item : item + 1] for part, value in targets.items()}
        alone = sim.contact_forces(one, next_one, targets=own)
        most = int(alone.pairs.counts)
        assert alone.pairs.force.shape == (1, most, 3)
        names, others = (torch.utils._pytree.tree_leaves(tuple(of)[:-1]) for of in (alone, together))
        for mine, all_ in zip(names, others, strict=True):
            assert torch.equal(mine, all_[item : item + 1])
        for mine, all_ in zip(alone.pairs[:4], together.pairs[:4], strict=True):
            assert torch.equal(mine, all_[item : item + 1, :most])
        assert bool((together.pairs.vertices[item, most:] == -1).all())
        assert not bool(together.pairs.force[item, most:].any())
    assert together.pairs.counts.tolist()[0] > 0
    assert together.pairs.counts.tolist()[-1] == 0
    left, _ = sim.scene.colliders
    assert together.between[left, sim.scene.bodies[0]].force[0, 0] < -1.0  # pushed back


def test_gradients_by_finite_differences() -> None:
    """Of pair forces by the positions, at fixed history: weights and normals turn with the closest points."""
    sim, before, after, targets = gripped(torch.float64, 1)

    def read_forces(x: Tensor) -> tuple[Tensor, ...]:
        moved = pd.HistoryState(x, after.velocities, after.history)
        contacts = sim.contact_forces(before, moved, targets=targets)
        return contacts.pairs.force, contacts.on_colliders, contacts.force

    generator = torch.Generator().manual_seed(0)
    # off the ties of faces that lie on faces, whose closest points jump
    x = after.positions + 1e-5 * torch.randn(after.positions.shape, generator=generator, dtype=torch.float64)
    x.requires_grad_()
    outputs = read_forces(x)
    weights = [torch.randn(out.shape, generator=generator, dtype=torch.float64) for out in outputs]
    (gradient,) = torch.autograd.grad(sum((w * out).sum() for w, out in zip(weights, outputs, strict=True)), x)
    way = torch.randn(x.shape, generator=generator, dtype=torch.float64)
    step = 1e-8
    with torch.no_grad():
        ends = [
            sum(
                float((w * out).sum())
                for w, out in zip(weights, read_forces(x.detach() + sign * step * way), strict=True)
            )
            for sign in (1.0, -1.0)
        ]
    assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(float((gradient * way).sum()), rel=1e-4)


def test_compiled_they_are_the_same() -> None:
    """Without values to read, pairs are padded to the capacity."""
    sim, before, after, _ = gripped(torch.float64, 2)

    def read_forces(before: Any, after: Any) -> list[Tensor]:
        contacts = sim.contact_forces(before, after)
        return [contacts.force, contacts.on_colliders, *(wrench.torque for wrench in contacts.between.values())]

    compiled = torch.compile(read_forces, backend="eager", fullgraph=True)(before, after)
    assert all(map(torch.equal, compiled, read_forces(before, after)))
    pairs = torch.compile(lambda *of: sim.contact_forces(*of).pairs, backend="eager", fullgraph=True)(before, after)
    assert pairs.force.shape[1] == after.history.keys.shape[1]


def test_without_contact_there_are_no_pairs() -> None:
    solid = block(0.1, 1, (0.0, 0.05, 0.0))
    sim = simulator(pd.Scene(solid, gravity()), 4)
    state = sim.rest_state(2)
    contacts = sim.contact_forces(state, sim(state))
    assert contacts.pairs.vertices.shape == (2, 0, 4)
    assert contacts.pairs.vertices.dtype == torch.int64
    assert contacts.pairs.on_vertices.shape == (2, 8, 3)
    assert contacts.on_colliders.shape == (2, 0, 6)
    assert contacts.between == {}
    assert list(contacts.bodies) == [solid]


def test_no_environment() -> None:
    sim, *_ = gripped(torch.float64, 1)
    none = sim.rest_state(0)
    contacts = sim.contact_forces(none, none)
    assert contacts.pairs.vertices.shape == (0, 0, 4)
    assert contacts.on_colliders.shape == (0, 2, 6)


# ---- refusals


SIM, BEFORE, AFTER, TARGETS = gripped(torch.float64, 1)
KEYS = AFTER.history.keys


def changed(**parts: Any) -> pd.HistoryState:
    return pd.HistoryState(AFTER.positions, AFTER.velocities, AFTER.history._replace(**parts))


REFUSED = {
    "after must be a HistoryState in a scene with Contact.*positions alone": lambda: AFTER.positions,
    "after must be a HistoryState, in a scene with Contact, .*State": lambda: pd.State(*AFTER[:2]),
    r"after\.history\.keys must be of this scene, below \d+, got": lambda: changed(
        keys=torch.where(KEYS >= 0, KEYS + 10**12, KEYS)
    ),
    r"after\.history\.keys must increase": lambda: changed(keys=KEYS.flip(1)),
    r"after\.history must be the one that its step left.*vertices \[.* apart": lambda: changed(
        poses=AFTER.history.poses + torch.tensor([0.0, 0.5, 0, 0, 0, 0, 0]).double()
    ),
    r"history\.forces must be": lambda: changed(forces=AFTER.history.forces[:, :5]),
}


@pytest.mark.parametrize("words", REFUSED)
@pytest.mark.parametrize("name", ["contact_forces", "reactions"])
def test_what_is_refused(words: str, name: str) -> None:
    after: Any = REFUSED[words]()
    with pytest.raises((TypeError, ValueError), match=words):
        getattr(SIM, name)(BEFORE, after, targets=TARGETS)


def test_keys_of_another_simulator(tmp_path: Path) -> None:
    """A loaded one has parts of its own, as the error says."""
    sim = gripped(torch.float64, 1)[0]
    sim.save(tmp_path / "sim.safetensors")
    loaded = pd.Simulator.load(tmp_path / "sim.safetensors")
    state = loaded.rest_state()
    contacts = loaded.contact_forces(state, loaded(state))
    cube, left = loaded.scene.bodies[0], loaded.scene.colliders[0]
    assert not contacts.between[cube, left].force.any()
    for found, key, kinds in (
        (contacts.between, (cube, sim.scene.colliders[0]), r"here 4: \(Solid, Collider\), \(Collider, Solid\); "),
        (contacts.bodies, sim.scene.bodies[0], "here 3: Solid, Collider; got another Solid"),
    ):
        with pytest.raises(KeyError, match=rf"{kinds}.*load makes new bodies and colliders, sim\.scene\.bodies"):
            found[key]  # type: ignore[index]
    assert type(copy.deepcopy(contacts.bodies)) is type(contacts.bodies)
