"""Steps of scenes whose colliders have a mass, and a loss of all that they move."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import torch
from adjoint_scenes import seeded
from body_scenes import THICKNESS, H, gravity
from torch import Tensor

import torchpd as pd
from torchpd.ops.fake_kernels import CONTACT_FRICTION, CONTACT_THICKNESS

Point = tuple[float, float, float]
# m, m/s, N: where neither truncation of a central difference nor rounding counts; of others a share of their size
STEPS = {
    "positions": 1e-7, "velocities": 1e-5, "forces": 1e-4, "poses": 1e-7, "motion": 1e-5, "wrenches": 1e-5,
    "contact_friction": 1e-6, "contact_thickness": 1e-7, "gravity": 1e-4, "pin_targets": 1e-7,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class RigidStep:
    """One step from a state, with wrenches [C, 6] on some colliders."""

    sim: pd.Simulator
    state: Any
    wrenches: Tensor
    colliders: tuple[pd.Collider, ...]

    def inputs(self) -> dict[str, Tensor]:
        """What the step depends on, by name."""
        contact, sim, history = self.sim.body_contact, self.sim, self.state.history
        assert contact is not None
        given = {
            "positions": self.state.positions,
            "velocities": self.state.velocities,
            "forces": torch.zeros_like(self.state.positions),
            "poses": history.poses,
            "motion": history.motion,
            "wrenches": self.wrenches,
            "contact_friction": contact.arrays[CONTACT_FRICTION],
            "contact_thickness": contact.arrays[CONTACT_THICKNESS],
            **{name: getattr(sim, name) for name in sim.material_names},
        }
        return {name: value.detach().clone() for name, value in given.items() if value.numel() > 0}

    def run(self, inputs: dict[str, Tensor]) -> Any:
        """The state after the step."""
        contact, sim = self.sim.body_contact, self.sim
        assert contact is not None
        arrays = list(contact.arrays)
        arrays[CONTACT_FRICTION], arrays[CONTACT_THICKNESS] = inputs["contact_friction"], inputs["contact_thickness"]
        origin, turn = inputs["poses"].split([3, 4], dim=-1)
        poses = torch.cat([origin, turn / turn.norm(dim=-1, keepdim=True)], dim=-1)
        history = self.state.history._replace(poses=poses, motion=inputs["motion"])
        state = pd.HistoryState(inputs["positions"], inputs["velocities"], history)
        targets = {part: inputs["wrenches"][number] for number, part in enumerate(self.colliders)}
        material = {name: inputs[name] for name in sim.material_names if name in inputs}
        kept = sim.body_contact
        try:
            sim.body_contact = replace(contact, arrays=arrays)
            return torch.func.functional_call(sim, material, (state,), {"forces": inputs["forces"], "targets": targets})
        finally:
            sim.body_contact = kept

    def loss(self, inputs: dict[str, Tensor]) -> Tensor:
        """A fixed random function of places, velocities, poses and motions, one number an environment."""
        after = self.run(inputs)
        moved = (after.positions, H * after.velocities, after.history.poses, H * after.history.motion)
        return torch.stack([(seeded(each[:1], n) * each).sum((1, 2)) for n, each in enumerate(moved)]).sum(0)

    def gradients(self) -> dict[str, Tensor]:
        inputs = {name: value.requires_grad_() for name, value in self.inputs().items()}
        found = torch.autograd.grad(self.loss(inputs).sum(), list(inputs.values()), allow_unused=True)
        return {
            name: torch.zeros_like(value) if grad is None else grad
            for (name, value), grad in zip(inputs.items(), found, strict=True)
        }

    def difference(self, name: str, direction: Tensor) -> float:
        """Of second order, of the loss along a direction of an input."""
        inputs, step = self.inputs(), self.step_of(name)
        with torch.no_grad():
            ends = [self.loss({**inputs, name: inputs[name] + sign * step * direction}) for sign in (-1.0, 1.0)]
        return float((ends[1] - ends[0]).sum()) / (2.0 * step)

    def step_of(self, name: str) -> float:
        return STEPS.get(name) or 1e-4 * float(self.inputs()[name].abs().max())

    def on(self, device: torch.device, dtype: torch.dtype = torch.float64) -> RigidStep:
        """The same step elsewhere."""
        sim = pd.Simulator(self.sim.scene, H, self.sim.iterations, dtype=dtype, device=device, progress=False)
        state = self.state.to(dtype).to(device)
        return RigidStep(sim, state, self.wrenches.to(device, dtype), self.colliders)


def batched(step: RigidStep, count: int) -> RigidStep:
    """Environments that differ: the plate, or ball, of each has another velocity."""
    parts = [each.expand(count, *each.shape[1:]).clone() for each in (*step.state[:2], *step.state.history)]
    x, v, *history = parts
    history = pd.ContactHistory(*history)
    history.motion[:, 0, 0] += 0.01 * torch.arange(count, dtype=x.dtype)
    return RigidStep(step.sim, pd.HistoryState(x, v, history), step.wrenches, step.colliders)


def row(step: RigidStep, number: int) -> RigidStep:
    x, v, *history = (each[[number]] for each in (*step.state[:2], *step.state.history))
    return RigidStep(step.sim, pd.HistoryState(x, v, pd.ContactHistory(*history)), step.wrenches, step.colliders)


def quaternion(axis: Point, degrees: float) -> tuple[float, float, float, float]:
    half = math.radians(degrees) / 2
    x, y, z = math.sin(half) * np.array(axis) / np.linalg.norm(axis)
    return (math.cos(half), float(x), float(y), float(z))


def box(size: Point, cells: tuple[int, int, int], center: Point = (0.0, 0.0, 0.0)) -> pd.TetMesh:
    corner = tuple(c - 0.5 * length for c, length in zip(center, size, strict=True))
    return pd.shapes.box(size, cells).translated(corner)  # type: ignore[arg-type]


def soft(center: Point, edge: float = 0.1) -> pd.Solid:
    return pd.Solid(box((edge,) * 3, (2, 2, 2), center), youngs=1e5, density=1000.0)


def pinned(stiffness: float = 2e3) -> tuple[pd.Solid, pd.Pin]:
    """A cube whose top is at 0, and springs that hold its bottom."""
    cube = soft((0.003, -0.05, 0.002))
    return cube, pd.Pin(cube, np.flatnonzero(cube.mesh.vertices[:, 1] < -0.0999), stiffness=stiffness)


def prepared(
    parts: list[Any], wrenches: list[list[float]], steps: int, iterations: int, friction: float, motion: Any = None
) -> RigidStep:
    """A step after some others. `motion`: velocities of some colliders at the start, by their numbers."""
    scene = pd.Scene(*parts, pd.Contact(friction=friction, thickness=THICKNESS), gravity())
    sim = pd.Simulator(scene, H, iterations, dtype=torch.float64, progress=False)
    state: Any = sim.rest_state()
    for number, one in (motion or {}).items():
        state.history.motion[:, number] = torch.tensor(one)
    colliders = tuple(part for part in parts if isinstance(part, pd.Collider) and part.mass is not None)
    given = torch.tensor(wrenches, dtype=torch.float64)
    for _ in range(steps):
        state = sim(state, targets=dict(zip(colliders, given, strict=True)))
    return RigidStep(sim, state, given, colliders)


@cache
def pushed_plate(friction: float = 0.0) -> RigidStep:
    """A wrench presses a light plate on a soft cube."""
    pose = (0.004, 0.0085, 0.003, *quaternion((0.02, 1, 0.03), 12.0))
    plate = pd.Collider(box((0.07, 0.01, 0.06), (1, 1, 1)), mass=0.05, pose=pose)
    return prepared([*pinned(1e4), plate], [[0.3, -2.0, 0.1, 0.002, 0.001, -0.003]], 4, 800, friction)


@cache
def ball(friction: float = 2.0) -> RigidStep:
    """A ball that spins falls on a soft cube: with friction it rolls, with little it slides."""
    pose = (0.01, 0.0318, 0.005, *quaternion((0.3, 1, 0.2), 25.0))
    body = pd.Collider(pd.shapes.sphere(0.03, 1), mass=0.1, pose=pose)
    motion = {0: (0.2, -0.1, 0.1, 2.0, 1.0, -5.0)}
    return prepared([*pinned(), body], [[0.1, -0.5, 0.05, 0.002, 0.001, -0.003]], 3, 800, friction, motion)


@cache
def between_cubes() -> RigidStep:
    """A plate between two soft cubes."""
    pose = (0.004, 0.0072, 0.003, *quaternion((0.02, 1, 0.03), 17.0))
    plate = pd.Collider(box((0.07, 0.01, 0.06), (1, 1, 1)), mass=0.2, pose=pose)
    upper = soft((0.007, 0.056, 0.004), 0.08)
    return prepared([*pinned(), upper, plate], [[0.1, -0.5, 0.1, 0.002, 0.001, -0.003]], 3, 400, 0.5)


@cache
def colliders_alone() -> RigidStep:
    """A ball on a plate on a table, all rigid: the plate sticks, the ball rolls."""
    table = pd.Collider(box((0.6, 0.02, 0.6), (1, 1, 1)), pose=(0.01, -0.01 - THICKNESS, 0.02, 1, 0, 0, 0))
    pose = (0.004, 0.0105, 0.003, *quaternion((0, 1, 0), 17.0))
    plate = pd.Collider(box((0.08, 0.02, 0.07), (1, 1, 1)), mass=0.3, pose=pose)
    pose = (0.006, 0.0425, 0.005, *quaternion((0.3, 1, 0.2), 25.0))
    body = pd.Collider(pd.shapes.sphere(0.02, 1), mass=0.1, pose=pose)
    wrenches = [[0.1, -0.5, 0.1, 0.002, 0.001, -0.003], [0.1, -0.2, 0.1, 0.001, 0.001, -0.003]]
    motion = {1: (0.3, 0.0, 0.1, 0.0, 0.5, 0.0)}
    return prepared([soft((0.5, 0.0, 0.0)), table, plate, body], wrenches, 4, 300, 0.5, motion)


@cache
def flying() -> RigidStep:
    """A collider that spins fast and meets nothing."""
    pose = (0.004, 0.006, 0.003, *quaternion((0.02, 1, 0.03), 17.0))
    body = pd.Collider(box((0.07, 0.01, 0.06), (1, 1, 1)), mass=0.2, pose=pose)
    motion = {0: (0.2, -0.1, 0.1, 20.0, 10.0, -5.0)}
    return prepared([soft((0.5, 0.0, 0.0)), body], [[0.1, -0.5, 0.1, 0.02, 0.01, -0.03]], 1, 400, 0.5, motion)


RIGID_CASES: dict[str, Callable[[], RigidStep]] = {
    "smooth plate": pushed_plate,
    "sticking plate": lambda: pushed_plate(0.5),
    "rolling ball": ball,
    "sliding ball": lambda: ball(0.05),
    "plate between cubes": between_cubes,
    "colliders alone": colliders_alone,
    "flying collider": flying,
}
