"""Scenes with `Contact` made of public parts, and their crossings by exact signs: r = 1 mm, h = 1 / 60 s."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from cases import rotation
from numpy.typing import NDArray
from torch import Tensor

import torchpd as pd
from torchpd.reference.contact import crossings
from torchpd.reference.contact.surfaces import Surfaces
from torchpd.scene.contact import placed

Array = NDArray[np.float64]
Targets = Callable[[int], dict[Any, Tensor]]

THICKNESS = 1e-3
H = 1.0 / 60.0
G = 9.81


def simulator(scene: pd.Scene, iterations: int = 64, **options: Any) -> pd.Simulator:
    options = {"dtype": torch.float64, **options}
    return pd.Simulator(scene, H, iterations, progress=False, **options)


def surfaces_of(sim: pd.Simulator, *, whole: bool = False) -> Surfaces:
    """The surfaces of a simulator for the reference; `whole`: as if all bodies touched themselves."""
    assert sim.body_contact is not None
    plan = sim.body_contact.plan
    count = len(plan.self_contact)
    own = torch.tensor(plan.self_contact) | whole
    return Surfaces(
        torch.tensor(plan.rest), torch.tensor(plan.triangles).long(), torch.tensor(plan.body).long(),
        torch.tensor(plan.kinematic), own, plan.thickness, torch.zeros(count, count, dtype=torch.float64),
        torch.tensor(plan.edges).long(),
    )  # fmt: skip


def places_of(sim: pd.Simulator, state: pd.HistoryState, environment: int = 0) -> Tensor:
    """Places of all vertices [N, 3] of an environment, those of colliders last."""
    assert sim.body_contact is not None
    plan = sim.body_contact.plan
    state = state.to("cpu")
    poses = state.history.poses[environment].double().numpy()
    world = placed(poses[plan.collider[plan.collider >= 0]], plan.points)
    return torch.cat([state.positions[environment].double(), torch.tensor(world)])


def crossed(sim: pd.Simulator, state: pd.HistoryState, environment: int = 0, *, whole: bool = False) -> int:
    """Edges that pass through triangles in an environment."""
    return len(crossings(surfaces_of(sim, whole=whole), places_of(sim, state, environment)))


@dataclass(frozen=True)
class Course:
    """A scene, the velocities of its vertices at the start, and the targets of steps."""

    scene: pd.Scene
    velocities: Array | None = None  # [V, 3] m/s
    targets: Targets | None = None

    def start(self, sim: pd.Simulator) -> pd.HistoryState:
        state: Any = sim.rest_state()
        if self.velocities is not None:
            state.velocities[:] = torch.tensor(self.velocities)
        return state  # type: ignore[no-any-return]

    def steps(self, sim: pd.Simulator, count: int) -> Iterator[tuple[pd.HistoryState, pd.Info]]:
        state: Any = self.start(sim)
        for number in range(count):
            given = None if self.targets is None else self.targets(number)
            if given is not None:
                given = {part: value.to(sim.rest_positions) for part, value in given.items()}
            state, info = sim(state, targets=given, return_info=True)
            yield state, info

    def last(self, sim: pd.Simulator, count: int) -> tuple[pd.HistoryState, pd.Info]:
        *_, end = self.steps(sim, count)
        return end


def block(size: float, cells: int, center: tuple[float, float, float], turn: Array | None = None) -> pd.Solid:
    mesh = pd.shapes.box((size,) * 3, (cells,) * 3)
    vertices = mesh.vertices - mesh.vertices.mean(axis=0)
    vertices = vertices if turn is None else vertices @ turn.T
    return pd.Solid(pd.TetMesh(vertices + center, mesh.tets), youngs=1e5, density=1000.0)


def each(scene: pd.Scene, *velocities: tuple[float, float, float]) -> Array:
    """Velocities [V, 3] of bodies that move as one."""
    return np.repeat(np.asarray(velocities, np.float64), [len(body.mesh.vertices) for body in scene.bodies], axis=0)


def gravity() -> pd.Gravity:
    return pd.Gravity((0.0, -G, 0.0))


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Tensor:
    return torch.tensor([x, y, z, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64)


def plane(length: float, width: float, cells: int, turn: Array | None = None) -> pd.TriMesh:
    """A level sheet of triangles through the origin, turned."""
    x, z = np.meshgrid(np.linspace(-0.5, 0.5, cells + 1), np.linspace(-0.5, 0.5, cells + 1), indexing="ij")
    vertices = np.stack([length * x, 0.0 * x, width * z], axis=-1).reshape(-1, 3)
    number = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    corners = np.concatenate([np.stack(of, axis=-1).reshape(-1, 3) for of in ((a, c, b), (a, d, c))])
    return pd.TriMesh(vertices if turn is None else vertices @ turn.T, corners)


def cloth(mesh: pd.TriMesh, youngs: float = 1e5) -> pd.Cloth:
    return pd.Cloth(mesh, youngs=youngs, thickness=1e-3, area_density=0.2)


def two_cubes(speed: float = 2.0, cells: int = 3) -> Course:
    """A cube falls, turned, onto one that stands on rough ground."""
    lower = block(0.1, cells, (0.0, 0.05, 0.0))
    upper = block(0.1, cells, (0.015, 0.19, 0.01), rotation(0.0, 17.0, 12.0))
    contact = pd.Contact(friction=0.5, thickness=THICKNESS)
    scene = pd.Scene(lower, upper, pd.Ground(0.0, friction=0.5), gravity(), contact)
    return Course(scene, each(scene, (0.0, 0.0, 0.0), (0.0, -speed, 0.0)))


def ball_on_sheet(speed: float = 20.0, *, contact: bool = True) -> Course:
    """A ball of 3 cm falls on a sheet of .4 m that is pinned at its rim."""
    sheet = cloth(plane(0.4, 0.4, 12))
    rim = (np.abs(sheet.mesh.vertices) > 0.2 - 1e-9).any(axis=1)
    mesh = pd.shapes.box((1.0,) * 3, (3,) * 3)
    p = mesh.vertices - mesh.vertices.mean(axis=0)
    size = np.abs(p).max(axis=1, keepdims=True)
    p = 0.03 * p * size / np.maximum(0.5 * np.linalg.norm(p, axis=1, keepdims=True), 1e-300)
    ball = pd.Solid(pd.TetMesh(p + [0.01, 0.1, 0.013], mesh.tets), youngs=1e6, density=1000.0)
    parts = (pd.Contact(thickness=THICKNESS),) if contact else ()
    scene = pd.Scene(sheet, ball, pd.Pin(sheet, rim), gravity(), *parts)
    return Course(scene, each(scene, (0.0, 0.0, 0.0), (0.0, -speed, 0.0)))


def gripper(friction: float, turn: Array | None = None) -> Course:
    """Two fingers close on a cube of .05 m within .3 s, 5 mm deep each, then lift by .1 m within .5 s."""
    cube = block(0.05, 2, (0.0, 0.025, 0.0), turn)
    finger = pd.shapes.box((0.02, 0.055, 0.04), (1, 2, 2))
    at = finger.vertices.mean(axis=0)
    left = pd.Collider(finger.translated(np.array([-0.045, 0.0325, 0.0]) - at))
    right = pd.Collider(finger.translated(np.array([0.045, 0.0325, 0.0]) - at), friction=friction)
    contact = pd.Contact(friction=friction, thickness=THICKNESS)
    scene = pd.Scene(cube, left, right, pd.Ground(0.0, friction=0.5), gravity(), contact)

    def targets(number: int) -> dict[Any, Tensor]:
        t = (number + 1) * H
        closed, up = 0.015 * min(t / 0.3, 1.0), 0.1 * min(max((t - 0.3) / 0.5, 0.0), 1.0)
        return {left: pose(closed, up), right: pose(-closed, up)}

    return Course(scene, targets=targets)


def slope(degrees: float, friction: float, *, speed: float = 0.0, lift: float = THICKNESS) -> Course:
    """A block of .1 m and 1 kg on a rigid mesh of 2 m by .6 m, downhill is x."""
    turn = rotation(0.0, 0.0, -degrees)
    body = block(0.1, 3, tuple(turn @ np.array([-0.5, lift + 0.05, 0.013])), turn)
    table = pd.Collider(plane(2.0, 0.6, 6, turn))
    scene = pd.Scene(body, table, gravity(), pd.Contact(friction=friction, thickness=THICKNESS))
    return Course(scene, each(scene, tuple(turn @ np.array([speed, 0.0, 0.0]))))


def plates(to: float, seconds: float = 0.2, turn: Array | None = None) -> tuple[Course, pd.Collider, pd.Collider]:
    """A cube of .1 m between two plates that close to a distance `to`, negative: past each other; then they open."""
    cube = block(0.1, 2, (0.0, 0.0, 0.0), turn)
    upper, lower = (pd.Collider(plane(0.4, 0.4, 4), pose=(0.0, side * 0.053, 0.0, 1, 0, 0, 0)) for side in (1, -1))
    scene = pd.Scene(cube, upper, lower, pd.Contact(thickness=THICKNESS))
    speed = (0.053 - 0.5 * to) / seconds

    def targets(number: int) -> dict[Any, Tensor]:
        t = (number + 1) * H
        height = 0.053 - speed * (t if t < seconds else max(2.0 * seconds - t, 0.0))
        return {upper: pose(0.0, height), lower: pose(0.0, -height)}

    return Course(scene, targets=targets), upper, lower


def pressed_cubes(speed: float = 0.3) -> Course:
    """A cube, pinned at its upper part, is pressed on another one, turned, which is pinned at its lower side."""
    lower = block(0.1, 3, (0.0, 0.05, 0.0))
    upper = block(0.1, 3, (0.015, 0.18, 0.01), rotation(0.0, 17.0, 12.0))
    pins = [pd.Pin(lower, lower.mesh.vertices[:, 1] < 1e-6), pd.Pin(upper, upper.mesh.vertices[:, 1] > 0.2)]
    scene = pd.Scene(lower, upper, *pins, gravity(), pd.Contact(friction=0.5, thickness=THICKNESS))
    held = torch.tensor(upper.mesh.vertices[upper.mesh.vertices[:, 1] > 0.2])

    def targets(number: int) -> dict[Any, Tensor]:
        return {pins[1]: held - torch.tensor([0.0, speed * H * (number + 1), 0.0], dtype=torch.float64)}

    return Course(scene, targets=targets)


def two_sheets(cells: int) -> Course:
    """A level cloth of .4 m falls on another one, which is pinned, by a tenth of a millimetre."""
    lower, upper = (cloth(plane(0.4, 0.4, cells).translated((0.0, height, 0.0))) for height in (0.0, 0.0011))
    pin = pd.Pin(lower, np.ones(len(lower.mesh.vertices), dtype=bool))
    scene = pd.Scene(lower, upper, pin, gravity(), pd.Contact(thickness=THICKNESS))
    return Course(scene, each(scene, (0.0, 0.0, 0.0), (0.0, -0.01, 0.0)))


def folded_sheet(*, self_contact: bool, cells: int = 12) -> Course:
    """A cloth of .4 m on the ground, curled over so that its upper part falls on the lower at 2 m/s."""
    radius, flat = 0.03, 0.15
    level = plane(0.4, 0.4, cells)
    along, across = level.vertices[:, 0] + 0.2, level.vertices[:, 2]
    angle = np.clip((along - flat) / radius, 0.0, np.pi)
    x = np.minimum(along, flat) + radius * np.sin(angle) - np.maximum(along - flat - np.pi * radius, 0.0)
    height = 0.004 + radius * (1.0 - np.cos(angle))
    mesh = pd.TriMesh(np.stack([x, height, across], axis=1), level.triangles)
    sheet = pd.Cloth(mesh, youngs=1e5, thickness=1e-3, area_density=0.2, bending=1e-3)
    contact = pd.Contact(self_contact=self_contact, thickness=THICKNESS)
    scene = pd.Scene(sheet, pd.Ground(0.0, friction=0.5), gravity(), contact)
    return Course(scene, np.where(height[:, None] > 0.004 + radius, [0.0, -2.0, 0.0], 0.0))
