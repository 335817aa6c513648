"""Gradients through steps in which colliders have a mass: differences, closed forms, and the bits of batches."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from adjoint_scenes import seeded
from body_scenes import THICKNESS, G, H, simulator
from rigid_scenes import RIGID_CASES, RigidStep, ball, batched, box, colliders_alone, pinned, pushed_plate, row
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_map_only

import torchpd as pd

REPORTS = ("damping", "planes", "spheres")  # at the rim of what is allowed, or absent


@pytest.mark.parametrize("name", RIGID_CASES)
def test_differences(name: str) -> None:
    """To 1e-6 of a central difference along a random direction of every input of a converged step.

    A gradient that is small beside its size has that of a hundredth of it. Rounding of a loss of size 1 counts.
    """
    step = RIGID_CASES[name]()
    for number, (key, gradient) in enumerate(step.gradients().items()):
        if key in REPORTS or (name == "smooth plate" and key == "contact_friction"):  # friction has a kink at 0
            continue
        direction = torch.ones_like(gradient) if key == "contact_friction" else seeded(gradient, 10 + number)
        along, wanted = float((gradient * direction).sum()), step.difference(key, direction)
        size = max(abs(wanted), 1e-2 * float(gradient.norm() * direction.norm()))
        assert abs(along - wanted) <= 1e-6 * size + 4e-15 / step.step_of(key), key


def test_states_of_pairs() -> None:
    """What the names of the cases say: shares of the friction bound that pairs take."""

    def shares(step: RigidStep, friction: float) -> Tensor:
        forces = step.run(step.inputs()).history.forces[0]
        forces = forces[forces[:, 0] > 0.0]
        return forces[:, 1:].norm(dim=1) / (friction * forces[:, 0])

    assert len(shares(pushed_plate(), 1.0)) > 12
    assert float(shares(ball(), 2.0).max()) < 0.9
    assert torch.allclose(shares(ball(0.05), 0.05), torch.ones((), dtype=torch.float64))
    assert len(shares(colliders_alone(), 0.5)) > 6


def test_gradcheck() -> None:
    """Every number of the Jacobian of a ball's poses and motion by its motion and its wrench, to 1e-6."""
    step = ball()
    inputs = step.inputs()

    def of(motion: Tensor, wrenches: Tensor) -> tuple[Tensor, Tensor]:
        history = step.run({**inputs, "motion": motion, "wrenches": wrenches}).history
        return history.poses, H * history.motion

    given = tuple(inputs[name].requires_grad_() for name in ("motion", "wrenches"))
    assert torch.autograd.gradcheck(of, given, eps=1e-6, atol=1e-6, rtol=1e-6)


def test_a_cube_carries_a_plate() -> None:
    """At rest d (force on a cube) / d (force on the plate) = 1, and d (force of contact) / d gravity = mass."""
    cube, pin = pinned()
    plate = pd.Collider(box((0.08, 0.01, 0.08), (1, 1, 1)), mass=0.05, pose=(0, 0.0065, 0, 1, 0, 0, 0))
    sim = simulator(pd.Scene(cube, pin, plate, pd.Contact(thickness=THICKNESS), pd.Gravity()), 256)
    sim.gravity.requires_grad_()
    push = torch.tensor([0.0, -2.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
    state: Any = sim.rest_state()
    for _ in range(60):
        state = sim(state, targets={plate: push.detach()})
    for _ in range(40):
        state = sim(state, targets={plate: push})
    # springs of 2e3 N/m on nine vertices carry all, and the cube yields beside
    (by_force,) = torch.autograd.grad(state.history.poses[0, 0, 1], push, retain_graph=True)
    with torch.no_grad():
        ends = []
        for sign in (-1.0, 1.0):
            moved = state
            for _ in range(40):
                moved = sim(moved, targets={plate: push + sign * 1e-3 * torch.eye(6, dtype=torch.float64)[1]})
            ends.append(float(moved.history.poses[0, 0, 1]))
    assert float(by_force[1]) == pytest.approx((ends[1] - ends[0]) / 2e-3, rel=1e-2)
    assert float(by_force[1]) > 1.0 / (9 * 2e3)


def test_a_wrench_over_many_steps() -> None:
    """A finger presses and drags a cube for ten steps: d (its end) / d (its wrench) to 1e-4 of a difference."""
    cube, pin = pinned()
    finger = pd.Collider(box((0.03, 0.01, 0.03), (1, 1, 1)), mass=0.05, pose=(0.002, 0.008, 0.001, 0.99, 0, 0.14, 0))
    scene = pd.Scene(cube, pin, finger, pd.Contact(friction=0.8, thickness=THICKNESS), pd.Gravity((0, -G, 0)))
    sim = simulator(scene, 256)

    def end(push: Tensor) -> Tensor:
        track = sim.rollout(sim.rest_state(), 10, targets={finger: push})
        return track.history.poses[-1, 0, 0, :3] @ torch.tensor([1.0, 0.5, -0.3], dtype=torch.float64)

    push = torch.tensor([0.3, -2.0, 0.1, 0.0, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
    (found,) = torch.autograd.grad(end(push), push)
    direction = torch.tensor([1.0, 0.7, -0.5, 0.01, 0.01, -0.01], dtype=torch.float64)
    with torch.no_grad():
        wanted = float(end(push + 1e-5 * direction) - end(push - 1e-5 * direction)) / 2e-5
    assert float(found @ direction) == pytest.approx(wanted, rel=1e-4)


@pytest.mark.parametrize("make", [ball, pushed_plate])
def test_the_same_bits_in_a_batch(make: Any, two_threads: None) -> None:
    """Gradients of an environment have the bits that it has alone, and again."""
    step = batched(make(), 3)
    together, again = step.gradients(), step.gradients()
    names = ("positions", "velocities", "poses", "motion")
    for name in names:
        assert torch.equal(together[name], again[name])
    assert not torch.equal(together["motion"][0], together["motion"][1])
    for number in range(3):
        alone = row(step, number).gradients()
        for name in names:
            assert torch.equal(together[name][number], alone[name][0]), name


class Recorded(TorchDispatchMode):
    """Keeps the arguments of the adjoint."""

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if function.name() == "torchpd::contact_step_vjp":
            self.call = args, kwargs
        return function(*args, **(kwargs or {}))


def test_opcheck() -> None:
    """The adjoint of two environments with a ball, one with another one on a plate."""
    for step in (batched(ball(), 2), colliders_alone()):
        with Recorded() as recorded:
            step.gradients()
        arguments, settings = tree_map_only(Tensor, Tensor.detach, recorded.call)
        report = torch.library.opcheck(torch.ops.torchpd.contact_step_vjp.default, arguments, settings)
        assert set(report.values()) == {"SUCCESS"}


def test_compiled() -> None:
    """A compiled step has the gradients of an eager one, to the bit."""
    step = ball()
    inputs, sim = step.inputs(), step.sim
    found = []

    def of(push: Tensor) -> Tensor:
        return sim(step.state, targets={step.colliders[0]: push}).history.motion.sum()

    for function in (of, torch.compile(of, fullgraph=True, backend="aot_eager")):
        push = inputs["wrenches"][0].clone().requires_grad_()
        found.append(torch.autograd.grad(function(push), push)[0])
    assert found[0].all()
    assert torch.equal(*found)


def test_where_no_solution_is_found() -> None:
    """A cube that 1 kN crush has the gradients of constant rotations, with a warning, and they are finite."""
    cube, _ = pinned()
    pin = pd.Pin(cube, np.flatnonzero(cube.mesh.vertices[:, 1] < -0.0999))
    plate = pd.Collider(box((0.2, 0.01, 0.2), (1, 1, 1)), mass=0.05, pose=(0.004, 0.0085, 0.003, 1, 0, 0, 0))
    sim = simulator(pd.Scene(cube, pin, plate, pd.Contact(friction=0.5, thickness=THICKNESS)), 32)
    push = torch.tensor([0.0, -1e3, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
    after = sim(sim.rest_state(), targets={plate: push})
    with pytest.warns(UserWarning, match="adjoint of a step has no solution"):
        (found,) = torch.autograd.grad(after.history.motion.sum(), push)
    assert found.isfinite().all()
    assert found.any()


def test_float32() -> None:
    """To 5e-3 of the gradient in double."""
    step = ball()
    wanted, found = step.gradients(), step.on(torch.device("cpu"), torch.float32).gradients()
    for key in ("positions", "velocities", "motion", "wrenches", "poses"):
        assert found[key].dtype == torch.float32
        assert float((found[key].double() - wanted[key]).norm()) <= 5e-3 * float(wanted[key].norm()), key


def test_a_step_that_is_taken_back() -> None:
    """An environment whose pairs exceed the capacity passes gradients of poses and motion on as they are."""
    cube, pin = pinned()
    block = pd.Collider(box((0.08,) * 3, (2, 2, 2)), mass=1.0, pose=(0, 0.043, 0, 1, 0, 0, 0))
    sim = simulator(pd.Scene(cube, pin, block, pd.Contact(capacity=1, thickness=THICKNESS)), 8)
    start: Any = sim.rest_state()
    start.history.motion[:, 0, 1] = -1.0
    poses, motion = (each.clone().requires_grad_() for each in (start.history.poses, start.history.motion))
    with pytest.warns(pd.SceneWarning):
        after = sim(start._replace(history=start.history._replace(poses=poses, motion=motion)))
    loss = (seeded(poses, 0) * after.history.poses).sum() + (seeded(motion, 1) * after.history.motion).sum()
    by_poses, by_motion = torch.autograd.grad(loss, (poses, motion))
    assert torch.equal(by_poses, seeded(poses, 0))
    assert torch.equal(by_motion, seeded(motion, 1))
