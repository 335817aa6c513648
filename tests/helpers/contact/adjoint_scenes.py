"""Steps with contact whose gradients are known: by differences, by automatic ones, and by the dense reference."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import torch
from body_scenes import THICKNESS, H, block, cloth, gravity, plane, rotation, simulator
from torch import Tensor

import torchpd as pd
from torchpd.reference import step_problem
from torchpd.reference.contact.adjoint import ContactGradients, SolvedContact, contact_adjoint
from torchpd.reference.contact.surfaces import Pairs

CONVERGED = 3000  # iterations


@dataclass(frozen=True, eq=False)
class Step:
    """One step of a scene from a state, and the loss that it is differentiated by."""

    sim: pd.Simulator
    state: Any
    colliders: tuple[pd.Collider, ...] = ()
    poses: Tensor | None = None  # [C, 7] at the end; None: where they are

    def inputs(self) -> dict[str, Tensor]:
        """What the step depends on, by name."""
        sim, start = self.sim, self.state.history.poses
        given = {
            "positions": self.state.positions,
            "velocities": self.state.velocities,
            "forces": torch.zeros_like(self.state.positions),
            "start": start,
            "end": start.clone() if self.poses is None else self.poses.expand_as(start).clone(),
            "contact_friction": sim.contact_friction,
            "contact_thickness": sim.contact_thickness,
            **{name: getattr(sim, name) for name in sim.material_names},
        }
        return {name: value.detach().clone() for name, value in given.items() if value.numel() > 0}

    def run(self, inputs: dict[str, Tensor], **options: Any) -> Any:
        """The state after the step."""
        sim, history = self.sim, self.state.history
        if "start" in inputs:
            history = history._replace(poses=inputs["start"])
        state = pd.HistoryState(inputs["positions"], inputs["velocities"], history)
        targets = {part: inputs["end"][:, number] for number, part in enumerate(self.colliders)}
        names = (*sim.material_names, "contact_friction", "contact_thickness")
        given = {name: inputs[name] for name in names if name in inputs}
        return torch.func.functional_call(
            sim, given, (state,), {"forces": inputs["forces"], "targets": targets or None, **options}
        )

    def loss(self, inputs: dict[str, Tensor]) -> Tensor:
        """A fixed random function of all that the step moves."""
        after = self.run(inputs)
        sums = [
            (seeded(after.positions, 0) * after.positions).sum(),
            H * (seeded(after.velocities, 1) * after.velocities).sum(),
        ]
        if len(self.colliders):
            sums.append((seeded(after.history.poses, 2) * after.history.poses).sum())
        return torch.stack(sums).sum()

    def gradients(self) -> dict[str, Tensor]:
        """By the compiled adjoint."""
        inputs = {name: value.requires_grad_() for name, value in self.inputs().items()}
        found = torch.autograd.grad(self.loss(inputs), list(inputs.values()), allow_unused=True)
        return {
            name: torch.zeros_like(value) if grad is None else grad
            for (name, value), grad in zip(inputs.items(), found, strict=True)
        }

    def difference(self, name: str, direction: Tensor, step: float) -> float:
        """Of fourth order, of the loss along a direction of an input."""
        inputs = self.inputs()
        with torch.no_grad():
            at = [float(self.loss({**inputs, name: inputs[name] + k * step * direction})) for k in (-2, -1, 1, 2)]
        return (8.0 * (at[2] - at[1]) - (at[3] - at[0])) / (12.0 * step)

    def reference(self) -> ContactGradients:
        """By the dense adjoint of the reference, for the first environment."""
        return self._reference

    @cached_property
    def _reference(self) -> ContactGradients:
        return contact_adjoint(self.solved(), *self.losses())

    def reference_gradients(self) -> dict[str, Tensor]:
        """Those of the reference by the names of the inputs; without those of hard pins."""
        found, inputs = self.reference(), self.inputs()
        named = {
            "positions": found.positions, "velocities": found.velocities, "forces": found.forces, "start": found.poses,
            "contact_thickness": found.thickness.sum(),
            **{name: torch.tensor(value) for name, value in found.material.items() if name in self.sim.material_names},
        }  # fmt: skip
        if len(self.colliders):
            # targets are normalised
            end = found.poses_after + seeded(inputs["end"], 2)[0]
            origin, turn = end.split([3, 4], dim=1)
            given = inputs["end"][0, :, 3:]
            length = given.norm(dim=1, keepdim=True)
            unit = given / length
            named["end"] = torch.cat([origin, (turn - (turn * unit).sum(dim=1, keepdim=True) * unit) / length], dim=1)
        return {name: value.reshape(inputs[name].shape) for name, value in named.items() if name in inputs}

    def losses(self) -> tuple[Tensor, Tensor]:
        positions = self.state.positions
        return seeded(positions, 0)[0], H * seeded(positions, 1)[0]

    def solved(self) -> SolvedContact:
        """The step for the reference."""
        contact, after = self.sim.body_contact, self.run(self.inputs())
        assert contact is not None
        plan, keys = contact.plan, after.history.keys[0]
        keys = keys[keys >= 0]
        forces = after.history.forces[0, : len(keys)]
        x, v = (array[0].numpy() for array in (self.state.positions, self.state.velocities))
        return SolvedContact(
            step_problem(self.sim.scene.values(), x, v, H),
            after.positions[0],
            torch.tensor(plan.collider).long(),
            torch.tensor(plan.points),
            self.state.history.poses[0],
            after.history.poses[0],
            pairs_of(plan, keys),
            forces[:, 0],
            forces[:, 1:],
        )


def seeded(like: Tensor, seed: int) -> Tensor:
    return torch.randn(like.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(like)


def pairs_of(plan: Any, keys: Tensor) -> Pairs:
    """The pairs of keys [m], increasing."""
    first_edge = len(plan.rest) * len(plan.triangles)
    triangles, edges = (torch.tensor(array).long() for array in (plan.triangles, plan.edges))
    points, others = keys[keys < first_edge], keys[keys >= first_edge] - first_edge
    vertices = torch.cat([
        torch.cat([(points // max(len(triangles), 1))[:, None], triangles[points % max(len(triangles), 1)]], dim=1),
        torch.cat([edges[others // len(edges)], edges[others % len(edges)]], dim=1),
    ])  # fmt: skip
    body = torch.tensor(plan.body).long()[vertices[:, [0, 3]]]
    near = dict(zip(plan.near.keys.tolist(), plan.near.thickness.tolist(), strict=True))
    same = (body[:, 0] == body[:, 1]).tolist()
    thickness = [
        near.get(key, plan.thickness) if own else plan.thickness for key, own in zip(keys.tolist(), same, strict=True)
    ]
    friction = torch.tensor(plan.friction)[body[:, 0], body[:, 1]]
    return Pairs(vertices, len(points), keys, torch.tensor(thickness, dtype=torch.float64), friction)


def prepared(
    scene: pd.Scene, velocities: Any, steps: int, *colliders: pd.Collider, motion: Any = None, **options: Any
) -> Step:
    """A step after some others. `motion(number)`: poses [C, 7] at the end of a step."""
    sim = simulator(scene, CONVERGED, **options)
    state: Any = sim.rest_state()
    state.velocities[:] = torch.tensor(velocities)
    for number in range(steps):
        targets = None
        if motion is not None:
            targets = {part: motion(number)[own] for own, part in enumerate(colliders)}
        state = sim(state, targets=targets)
    return Step(sim, state, colliders, None if motion is None else motion(steps))


def tetrahedron(points: Any, youngs: float = 1e5) -> pd.Solid:
    return pd.Solid(pd.TetMesh(np.array(points, np.float64), np.array([[0, 1, 2, 3]])), youngs=youngs, density=1000.0)


@cache
def vertex_on_triangle() -> Step:
    """A corner of a tetrahedron hits a triangle of cloth that springs hold."""
    tip = tetrahedron([[0.01, 0.0015, 0.02], [0.06, 0.1, 0.0], [-0.05, 0.1, 0.05], [0.0, 0.1, -0.06]])
    corners = np.array([[-0.1, 0.0, -0.1], [0.12, 0.01, -0.05], [0.0, -0.01, 0.15]])
    sheet = pd.Cloth(pd.TriMesh(corners, np.array([[0, 2, 1]])), youngs=1e4, thickness=1e-3, area_density=0.5)
    scene = pd.Scene(tip, sheet, pd.Pin(sheet, [0, 1, 2], stiffness=300.0), gravity(), pd.Contact(thickness=THICKNESS))
    return prepared(scene, [[0.05, -0.5, 0.02]] * 4 + [[0.0, 0.0, 0.0]] * 3, 1)


@cache
def edge_on_edge() -> Step:
    """Two tetrahedra whose edges cross hit each other."""
    upper = tetrahedron([[-0.06, 0.0015, 0.01], [0.07, 0.002, -0.01], [0.0, 0.09, 0.05], [0.01, 0.1, -0.06]])
    lower = tetrahedron([[0.01, 0.0, -0.07], [-0.01, 0.001, 0.06], [0.05, -0.09, 0.0], [-0.06, -0.1, 0.01]])
    scene = pd.Scene(upper, lower, pd.Contact(thickness=THICKNESS))
    return prepared(scene, [[0.1, -0.5, 0.05]] * 4 + [[0.0, 0.2, 0.0]] * 4, 1)


@cache
def cube_on_cube(friction: float = 0.0) -> Step:
    """Two cubes, flat on flat: more pairs than they have directions."""
    lower, upper = block(0.1, 2, (0.0, 0.05, 0.0)), block(0.08, 2, (0.013, 0.0 + 0.1412, 0.009))
    table = pd.Collider(big_triangle())
    scene = pd.Scene(lower, upper, table, gravity(), pd.Contact(friction=friction, thickness=THICKNESS))
    return prepared(scene, [[0.0, 0.0, 0.0]] * 27 + [[0.1, -0.2, 0.05]] * 27, 3, table)


def big_triangle() -> pd.TriMesh:
    return pd.TriMesh(np.array([[-1.0, -0.001, -1.0], [1.3, -0.001, -1.0], [0.1, -0.001, 1.7]]), np.array([[0, 2, 1]]))


def cube_on_table(
    friction: float, speed: tuple[float, float, float], motion: Callable[[int], Tensor] | None = None
) -> Step:
    """A cube on a rigid mesh, which may move."""
    body, table = block(0.1, 2, (0.013, 0.0511, 0.017), rotation(0.0, 20.0, 0.0)), pd.Collider(plane(1.0, 1.0, 3))
    scene = pd.Scene(body, table, gravity(), pd.Contact(friction=friction, thickness=THICKNESS))
    return prepared(scene, [speed] * 27, 3, table, motion=motion)


@cache
def smooth_cube() -> Step:
    return cube_on_table(0.0, (0.4, -0.1, 0.2))


@cache
def sliding_cube() -> Step:
    return cube_on_table(0.3, (0.8, -0.1, 0.3))


@cache
def sticking_cube() -> Step:
    """A table that turns and rises carries the cube along."""

    def motion(number: int) -> Tensor:
        angle = 0.01 * (number + 1)
        return torch.tensor(
            [[0.001 * (number + 1), 0.0005 * (number + 1), 0.0, np.cos(angle), 0.0, np.sin(angle), 0.0]],
            dtype=torch.float64,
        )

    return cube_on_table(0.8, (0.0, 0.0, 0.0), motion)


@cache
def cloth_over_cube() -> Step:
    """A sheet falls on a rigid cube, turned against it."""
    sheet = cloth(plane(0.3, 0.3, 5, rotation(0.0, 10.0, 0.0)), youngs=1e4)
    sheet = pd.Cloth(sheet.mesh.translated((0.004, 0.0515, 0.003)), youngs=1e4, thickness=1e-3, area_density=0.2)
    cube = pd.Collider(pd.shapes.box((0.1,) * 3, (1,) * 3).translated((-0.05,) * 3))
    scene = pd.Scene(sheet, cube, gravity(), pd.Contact(friction=0.3, thickness=THICKNESS))
    return prepared(scene, np.zeros((len(sheet.mesh.vertices), 3)), 6, cube)


@cache
def clamp() -> Step:
    """A solid of the shape of a C whose arms hit each other, a little askew."""
    mesh = pd.shapes.box((0.08, 0.06, 0.04), (4, 3, 2))
    corners = mesh.vertices[mesh.tets].mean(axis=1)
    solid = (corners[:, 0] < 0.02) | (np.abs(corners[:, 1] - 0.03) > 0.01)
    used, tets = np.unique(mesh.tets[solid], return_inverse=True)
    x, y, z = mesh.vertices[used].T
    y = np.interp(y, [0.0, 0.02, 0.04, 0.06], [0.0, 0.02, 0.024, 0.044])
    upper = y > 0.022
    x, z = x + 0.003 * upper, z * (1.0 + 0.1 * upper)
    body = pd.Solid(
        pd.TetMesh(np.stack([x, y + 0.02 * x * upper, z], axis=1), tets.reshape(-1, 4)), youngs=1e5, density=1000.0
    )
    scene = pd.Scene(body, gravity(), pd.Contact(friction=0.2, thickness=THICKNESS))
    return prepared(scene, np.where(upper[:, None] & (x[:, None] > 0.03), [0.0, -1.0, 0.1], 0.0), 1)


@cache
def rod_on_a_rod(ends: bool = False) -> Step:
    """A rod slides over another one that springs hold at its ends; `ends`: it stands on the other one."""
    lower = pd.Rod(np.linspace((-0.2, 0.0, 0.0), (0.21, 0.0, 0.01), 5), 1e6, 4e-3)
    top = ((0.013, 0.002, 0.0), (0.02, 0.2, 0.01)) if ends else ((0.013, 0.003, -0.18), (0.02, 0.002, 0.2))
    upper = pd.Rod(np.linspace(*top, 5), 1e6, 4e-3)
    pin = pd.Pin(lower, [0, 1, 3, 4], stiffness=1e4)
    scene = pd.Scene(lower, upper, pin, gravity(), pd.Contact(friction=0.2, thickness=2e-3))
    return prepared(scene, [[0.0, 0.0, 0.0]] * 5 + [[0.0 if ends else 0.4, -0.3, 0.1]] * 5, 1)


CASES = {
    "vertex on a triangle": vertex_on_triangle,
    "edge on an edge": edge_on_edge,
    "cube on a cube": cube_on_cube,
    "smooth cube": smooth_cube,
    "sliding cube": sliding_cube,
    "sticking cube": sticking_cube,
    "cloth over a cube": cloth_over_cube,
    "clamp": clamp,
    "rod on a rod": rod_on_a_rod,
    "end of a rod": lambda: rod_on_a_rod(ends=True),
}


def on_rough_ground() -> Step:
    """Two cubes on ground that is rough, the upper one with stiffness-proportional damping; the lower one slides."""
    lower, upper = block(0.1, 1, (0.0, 0.05, 0.0)), block(0.08, 1, (0.013, 0.1412, 0.009), rotation(0.0, 15.0, 0.0))
    upper = pd.Solid(upper.mesh, youngs=1e5, density=1000.0, stiffness_damping=0.01)
    ground = pd.Ground(0.0, friction=0.2)
    scene = pd.Scene(lower, upper, ground, gravity(), pd.Contact(friction=0.3, thickness=THICKNESS))
    return prepared(scene, [[0.5, 0.0, 0.2]] * 8 + [[1.5, -0.2, 0.05]] * 8, 2)


def on_pins() -> Step:
    """A cube whose bottom is pinned, between a smooth sphere of the scene and a tetrahedron that falls on it."""
    cube = block(0.1, 2, (0.0, -0.05, 0.0))
    bottom = cube.mesh.vertices[:, 1] < -0.1 + 1e-9
    body = tetrahedron([[0.012, 0.0015, 0.02], [0.06, 0.1, 0.0], [-0.05, 0.1, 0.05], [0.0, 0.1, -0.06]])
    ball = pd.Sphere((0.0995, -0.002, 0.003), 0.05)
    scene = pd.Scene(cube, body, ball, pd.Pin(cube, bottom), gravity(), pd.Contact(friction=0.2, thickness=THICKNESS))
    return prepared(scene, [[0.0, 0.0, 0.0]] * 27 + [[0.4, -0.5, 0.1]] * 4, 2)


# with planes, spheres, pins and damping, which the reference lacks
WITH_SCENE = {"rough ground": on_rough_ground, "sphere and pins": on_pins}
