"""Scenes of bodies in contact, with their courses: r = 1 mm, h = 1 / 60 s, 1e5 Pa unless said."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import ipctk
import numpy as np
import torch
from cases import box, rotation
from numpy.typing import NDArray
from sheets import sheet

import torchpd as pd
from torchpd.reference.contact import Collider, ContactScene, ContactStep, contact_scene, contact_step, crossings
from torchpd.scene import Part, SceneValues
from torchpd.scene.springs import spring_group

Array = NDArray[np.float64]
Index = NDArray[np.int64]

THICKNESS = 1e-3
H = 1.0 / 60.0
G = 9.81

# by default it takes for a meeting what comes to a fifth of the distance at the start
MEETS = ipctk.TightInclusionCCD(conservative_rescaling=0.999)


@dataclass(frozen=True)
class ContactCase:
    """A scene, its state at the start, and where what moves by hand should be at a time."""

    scene: ContactScene
    velocities: Array  # [V, 3]
    time_step: float = H
    poses: Callable[[float], Array] | None = None  # [C, 7]
    pins: Callable[[float], Array] | None = None  # [P, 3] m

    def steps(self, count: int, iterations: int, **options: Any) -> Iterator[ContactStep]:
        """The steps of a course."""
        x = torch.tensor(self.scene.values.rest_positions).to(self.scene.dtype)
        v, history = torch.tensor(self.velocities).to(x.dtype), None
        for k in range(count):
            t = (k + 1) * self.time_step
            poses = None if self.poses is None else torch.tensor(self.poses(t)).to(x.dtype)
            pins = None if self.pins is None else self.pins(t)
            step = contact_step(
                self.scene, x, v, self.time_step, history=history, poses=poses, pin_targets=pins,
                iterations=iterations, **options,
            )  # fmt: skip
            x, v, history = step.positions, step.velocities, step.history
            yield step

    def last(self, count: int, iterations: int, **options: Any) -> ContactStep:
        *_, step = self.steps(count, iterations, **options)
        return step


class Witness:
    """ipctk judges places [N, 3] m of the vertices of a scene.

    Its continuous collision detection (tight inclusion, Wang et al. 2021) shares no code and no formula with
    `torchpd.reference.contact.crossings`. Intersections alone would miss a ball that is wholly past a sheet.
    """

    def __init__(self, case: ContactCase) -> None:
        surfaces = case.scene.surfaces
        self.used = surfaces.vertices.numpy()
        number = np.full(len(surfaces.rest), -1)
        number[self.used] = np.arange(len(self.used))
        edges, faces = (number[array.numpy()].astype(np.int32) for array in (surfaces.edges, surfaces.triangles))
        self.mesh = ipctk.CollisionMesh(self._own(surfaces.rest), edges, faces)

    def _own(self, places: torch.Tensor) -> Array:
        return np.asfortranarray(places.double().numpy()[self.used])

    def intersects(self, places: torch.Tensor) -> bool:
        return bool(ipctk.has_intersections(self.mesh, self._own(places)))

    def collides(self, before: torch.Tensor, after: torch.Tensor) -> bool:
        """Whether anything meets on the straight ways."""
        ways = self._own(before), self._own(after)
        return not ipctk.is_step_collision_free(self.mesh, *ways, narrow_phase_ccd=MEETS)


@dataclass(frozen=True)
class Watched:
    """A course, and how often its iterates crossed."""

    steps: list[ContactStep]
    crossed: int  # iterates with crossings, by exact signs
    met: int  # iterates that intersect or are met on the straight way from the one before, by the witness
    iterates: int

    @property
    def gap(self) -> float:
        """Least d / r of the pairs at the end of a step."""
        return min(step.gap for step in self.steps)

    @property
    def finite(self) -> bool:
        return all(bool(step.positions.isfinite().all() & step.velocities.isfinite().all()) for step in self.steps)


def watched(case: ContactCase, count: int, iterations: int) -> Watched:
    """Run a course, and look for crossings at every iterate and between two of them."""
    witness, last, crossed, met = Witness(case), torch.empty(0), [], []

    def observe(k: int, places: torch.Tensor) -> None:
        nonlocal last
        crossed.append(len(crossings(case.scene.surfaces, places)) > 0)
        # x_0 is reached along screws
        met.append(witness.intersects(places) or (k > 0 and witness.collides(last, places)))
        last = places.clone()

    steps = list(case.steps(count, iterations, observe=observe))
    return Watched(steps, sum(crossed), sum(met), len(crossed))


def promised(case: ContactCase, count: int, iterations: int) -> list[ContactStep]:
    """The steps of a course that keeps the promise: no crossing, no meeting, and the floor holds."""
    run = watched(case, count, iterations)
    assert run.iterates >= count * (iterations + 1)  # coarse corrections count, too
    assert run.crossed == run.met == 0
    assert run.finite
    assert run.gap >= 0.099
    return run.steps


def mean_of(case: ContactCase, each_vertex: torch.Tensor) -> Array:
    """Mean [3] of a quantity of the deformable vertices [V, 3], weighted by mass."""
    masses = case.scene.values.masses
    return np.asarray(masses @ each_vertex.double().numpy() / masses.sum())


def poses_of(*places: tuple[float, float, float], turns: Any = None) -> Array:
    """Poses [C, 7] at places, unturned or with quaternions."""
    turned = np.tile([1.0, 0.0, 0.0, 0.0], (len(places), 1)) if turns is None else np.asarray(turns)
    return np.concatenate([np.asarray(places, np.float64).reshape(-1, 3), turned], axis=1)


def block(
    size: float | tuple[float, float, float],
    cells: int | tuple[int, int, int],
    *,
    center: tuple[float, float, float] = (0.0, 0.0, 0.0),
    turn: Array | None = None,
    warp: Callable[[Array], Array] | None = None,
    **material: Any,
) -> pd.Solid:
    """A box around `center`, turned, or warped from [-1/2, 1/2]^3 times its size."""
    size = (size, size, size) if isinstance(size, float) else size
    cells = (cells, cells, cells) if isinstance(cells, int) else cells
    vertices, tets = box(size, cells)
    vertices = vertices - 0.5 * np.asarray(size)
    if warp is not None:
        vertices = warp(vertices)
    if turn is not None:
        vertices = vertices @ turn.T
    return pd.Solid(pd.TetMesh(vertices + center, tets), **{"youngs": 1e5, "density": 1000.0, **material})


def falling(*bodies: Part, g: float = G) -> pd.Scene:
    return pd.Scene(*bodies, pd.Gravity((0.0, -g, 0.0)))


def each(scene: pd.Scene, *velocities: tuple[float, float, float]) -> Array:
    """Velocities [V, 3] of bodies that move as one."""
    sizes = [len(body.mesh.vertices) for body in scene.bodies]
    return np.repeat(np.asarray(velocities, np.float64), sizes, axis=0)


def box_collider(low: tuple[float, float, float], high: tuple[float, float, float], cells: int = 1) -> Collider:
    """The closed surface of a box about the world's origin, cells by cells squares a face."""
    grid, faces = {}, []
    span = np.subtract(high, low) / cells

    def number(place: tuple[int, ...]) -> int:
        return grid.setdefault(place, len(grid))

    for axis in range(3):
        for side in (0, cells):
            for i in range(cells):
                for j in range(cells):
                    corner = []
                    for a, b in ((0, 0), (1, 0), (1, 1), (0, 1)):
                        place = [0, 0, 0]
                        place[axis], place[(axis + 1) % 3], place[(axis + 2) % 3] = side, i + a, j + b
                        corner.append(number(tuple(place)))
                    a, b, c, d = corner if side else corner[::-1]
                    faces += [[a, b, c], [a, c, d]]
    return Collider(np.asarray(low) + span * np.array(list(grid)), np.array(faces))


def plane_collider(length: float, width: float, cells: int, *, turn: Array | None = None) -> Collider:
    """A sheet of length in x by width in z through the origin, turned."""
    vertices, triangles = sheet((length, width), (cells, cells))
    vertices = vertices - [0.5 * length, 0.0, 0.5 * width]
    return Collider(vertices if turn is None else vertices @ turn.T, triangles)


def springs(vertices: Array, cells: tuple[int, int], stiffness: float, bending: float) -> Any:
    """Springs of a sheet: along its edges and, half as stiff, the diagonals of its cells; bending over two cells."""
    number = np.arange((cells[0] + 1) * (cells[1] + 1)).reshape(cells[0] + 1, cells[1] + 1)
    kinds = [
        (number[1:], number[:-1], stiffness),
        (number[:, 1:], number[:, :-1], stiffness),
        (number[1:, 1:], number[:-1, :-1], 0.5 * stiffness),
        (number[1:, :-1], number[:-1, 1:], 0.5 * stiffness),
        (number[2:], number[:-2], bending),
        (number[:, 2:], number[:, :-2], bending),
    ]
    pairs = np.concatenate([np.stack([a.reshape(-1), b.reshape(-1)], axis=1) for a, b, _ in kinds])
    k = np.concatenate([np.full(a.size, stiff) for a, _, stiff in kinds])
    return spring_group(pairs, k, np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1))


def sprung(scene: pd.Scene, cells: tuple[int, int], stiffness: float, bending: float) -> SceneValues:
    """The arrays of a scene whose first body is a sheet, with springs in place of its membrane."""
    values = scene.values()
    vertices = values.rest_positions[: (cells[0] + 1) * (cells[1] + 1)]
    return replace(values, stencils=(springs(vertices, cells, stiffness, bending),))


def sheet_body(size: tuple[float, float], cells: tuple[int, int], place: Callable[[Array], Array]) -> pd.Cloth:
    """A sheet of .2 kg/m^2 whose vertices, over [0, size], are moved to their places."""
    vertices, triangles = sheet(size, cells)
    return pd.Cloth(pd.TriMesh(place(vertices), triangles), youngs=1e5, thickness=1e-3, area_density=0.2)


def two_cubes(
    cells: int = 3, speed: float = 1.0, tilt: float = 0.3, *, youngs: float = 1e5, **options: Any
) -> ContactCase:
    """A cube falls onto one that stands on rough ground."""
    turn = rotation(0.0, math.degrees(tilt), math.degrees(0.7 * tilt))
    lower = block(0.1, cells, center=(0.0, 0.05, 0.0), youngs=youngs)
    upper = block(0.1, cells, center=(0.015, 0.19, 0.01), turn=turn, youngs=youngs)
    scene = falling(lower, upper, pd.Ground(0.0, friction=0.5))
    velocities = each(scene, (0.0, 0.0, 0.0), (0.0, -speed, 0.0))
    return ContactCase(contact_scene(scene, thickness=THICKNESS, **options), velocities)


def free_hit(cells: int = 3, speed: float = 1.0, **options: Any) -> ContactCase:
    """Two cubes meet in free space, off centre."""
    turn = rotation(0.0, math.degrees(0.3), math.degrees(0.21))
    scene = falling(block(0.1, cells), block(0.1, cells, center=(0.13, 0.02, 0.013), turn=turn), g=0.0)
    velocities = each(scene, (speed, 0.0, 0.0), (-speed, 0.0, 0.0))
    return ContactCase(contact_scene(scene, thickness=THICKNESS, **options), velocities)


def needle(cells: int = 4, speed: float = 2.0, **options: Any) -> ContactCase:
    """A soft cube falls on the tip of a cone."""
    angle = 2.0 * np.pi * np.arange(8) / 8
    rim = np.stack([0.05 * np.cos(angle), np.full(8, -0.2), 0.05 * np.sin(angle)], axis=1)
    points = np.concatenate([[[0.0, 0.0, 0.0]], rim, [[0.0, -0.2, 0.0]]])
    faces = [[0, 1 + (i + 1) % 8, 1 + i] for i in range(8)] + [[9, 1 + i, 1 + (i + 1) % 8] for i in range(8)]
    scene = falling(block(0.1, cells, center=(0.004, 0.07, 0.003)))
    made = contact_scene(scene, Collider(points, np.array(faces)), thickness=THICKNESS, **options)
    return ContactCase(made, each(scene, (0.0, -speed, 0.0)))


def fixed_edge(cells: int = 4, speed: float = 2.0, **options: Any) -> ContactCase:
    """A cube falls with its edge on the ridge of a roof."""
    ends = [[x, y, z] for y, z in ((0.0, 0.0), (-0.2, -0.1), (-0.2, 0.1)) for x in (-0.2, 0.2)]
    faces = [[0, 1, 3], [0, 3, 2], [0, 5, 1], [0, 4, 5], [2, 3, 5], [2, 5, 4], [0, 2, 4], [1, 5, 3]]
    turn = rotation(0.0, math.degrees(0.9), 0.0) @ rotation(0.0, 0.0, math.degrees(0.785))
    scene = falling(block(0.1, cells, center=(0.003, 0.1, 0.002), turn=turn))
    made = contact_scene(scene, Collider(np.array(ends), np.array(faces)), thickness=THICKNESS, **options)
    return ContactCase(made, each(scene, (0.0, -speed, 0.0)))


def slope(
    degrees: float, friction: float, *, speed: float = 0.0, cells: int = 3, lift: float = THICKNESS, **options: Any
) -> ContactCase:
    """A block of .1 m on a mesh plane of 2 m by .6 m, downhill is x."""
    turn = rotation(0.0, 0.0, -degrees)
    center = turn @ np.array([-0.5, lift + 0.05, 0.013])
    scene = falling(block(0.1, cells, center=tuple(center), turn=turn))
    plane = plane_collider(2.0, 0.6, 6, turn=turn)
    made = contact_scene(scene, plane, thickness=THICKNESS, friction=friction, **options)
    return ContactCase(made, each(scene, tuple(turn @ np.array([speed, 0.0, 0.0]))))


def dragged(friction: float, cells: int = 2, **options: Any) -> ContactCase:
    """A block of .1 m, its top held, on a mesh plane that rises by 2 mm in a step and then moves along x at 1 m/s."""
    body = block(0.1, cells, center=(0.0, THICKNESS + 0.05, 0.0))
    pin = pd.Pin(body, body.mesh.vertices[:, 1] > 0.1)
    made = contact_scene(
        falling(body, pin, g=0.0), plane_collider(0.6, 0.6, 4), thickness=THICKNESS, friction=friction, **options
    )  # fmt: skip

    def poses(t: float) -> Array:
        return poses_of((max(t - H, 0.0), 2.0 * THICKNESS, 0.0))

    return ContactCase(made, np.zeros_like(body.mesh.vertices), poses=poses)


def stack(cells: int = 3, **options: Any) -> ContactCase:
    """A cube of 1 kg at rest, r above another one on the ground."""
    lower = block(0.1, cells, center=(0.0, 0.05, 0.0))
    upper = block(0.1, cells, center=(0.0, 0.15 + THICKNESS, 0.0))
    scene = falling(lower, upper, pd.Ground(0.0, friction=0.5))
    made = contact_scene(scene, thickness=THICKNESS, **options)
    return ContactCase(made, each(scene, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))


def gripper(friction: float, cells: int = 3, **options: Any) -> ContactCase:
    """Two fingers close on a cube of .05 m within .3 s, 5 mm deep each, then lift by .1 m within .5 s."""
    scene = falling(block(0.05, cells, center=(0.0, 0.025, 0.0)), pd.Ground(0.0, friction=0.5))
    left = box_collider((-0.055, 0.005, -0.02), (-0.035, 0.06, 0.02), 2)
    right = box_collider((0.035, 0.005, -0.02), (0.055, 0.06, 0.02), 2)

    def poses(t: float) -> Array:
        closed, up = 0.015 * min(t / 0.3, 1.0), 0.1 * min(max((t - 0.3) / 0.5, 0.0), 1.0)
        return poses_of((closed, up, 0.0), (-closed, up, 0.0))

    made = contact_scene(scene, left, right, thickness=THICKNESS, friction=friction, **options)
    return ContactCase(made, each(scene, (0.0, 0.0, 0.0)), poses=poses)


def ring_line(number: int, cells: int = 16) -> Index:
    """Vertices of the centre line of a ring, in order."""
    return number * 9 * cells + 9 * np.arange(cells) + 4


def rings(cells: int = 16, speed: float = 0.5, way: float = 0.05, **options: Any) -> ContactCase:
    """Two interlocked rings whose outer ends are pulled apart, each by `way`."""
    bodies = []
    vertices, tets = box((1.0, 1.0, 1.0), (cells, 2, 2))
    for side in (-1.0, 1.0):
        radius, angle = 0.05 + 0.02 * (vertices[:, 1] - 0.5), 2.0 * np.pi * vertices[:, 0]
        flat = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.02 * (vertices[:, 2] - 0.5)], axis=1)
        placed = (flat if side < 0.0 else flat[:, [0, 2, 1]]) + [0.025 * side, 0.0, 0.0]
        # the last section is the first
        corners = tets % (9 * cells)
        mesh = pd.TetMesh(placed[: 9 * cells], _wound(placed[: 9 * cells], corners))
        bodies.append(pd.Solid(mesh, youngs=options.get("youngs", 1e5), density=1000.0))
    options = {name: value for name, value in options.items() if name != "youngs"}
    held = [pd.Pin(body, side * body.mesh.vertices[:, 0] > 0.0605) for side, body in zip((-1, 1), bodies, strict=True)]
    scene = pd.Scene(*bodies, *held, pd.Gravity((0.0, 0.0, 0.0)))
    rest = scene.values().pin_targets

    def pins(t: float) -> Array:
        return rest + np.sign(rest[:, :1]) * [min(speed * t, way), 0.0, 0.0]

    return ContactCase(
        contact_scene(scene, thickness=THICKNESS, **options), each(scene, *[(0.0, 0.0, 0.0)] * 2), pins=pins
    )


def _wound(vertices: Array, tets: Index) -> Index:
    turned = np.linalg.det(vertices[tets][:, 1:] - vertices[tets][:, :1]) < 0.0
    return np.where(turned[:, None], tets[:, [0, 2, 1, 3]], tets)


def ball_on_sheet(cells: int = 12, speed: float = 20.0, ball_cells: int = 3, **options: Any) -> ContactCase:
    """A ball of 3 cm falls on a sheet of .4 m that is pinned at its rim."""
    cloth = sheet_body((0.4, 0.4), (cells, cells), lambda p: p - [0.2, 0.0, 0.2])
    rim = (np.abs(cloth.mesh.vertices) > 0.2 - 1e-9).any(axis=1)

    def rounded(p: Array) -> Array:
        size = np.abs(p).max(axis=1, keepdims=True)
        return 0.03 * p * size / np.maximum(0.5 * np.linalg.norm(p, axis=1, keepdims=True), 1e-300)

    ball = block(1.0, ball_cells, center=(0.01, 0.1, 0.013), warp=rounded, youngs=1e6)
    scene = falling(cloth, ball, pd.Pin(cloth, rim))
    values = sprung(scene, (cells, cells), 200.0, 0.05)
    made = contact_scene(scene, thickness=THICKNESS, self_contact=[True, False], values=values, **options)
    return ContactCase(made, each(scene, (0.0, 0.0, 0.0), (0.0, -speed, 0.0)))


def plates(to: float, seconds: float = 0.5, cells: int = 3, *, opens: bool = False, **options: Any) -> ContactCase:
    """A cube of .1 m between two plates that close to a distance `to`, negative: past each other."""
    scene = falling(block(0.1, cells), g=0.0)
    upper = box_collider((-0.2, 0.053, -0.2), (0.2, 0.07, 0.2), 4)
    lower = box_collider((-0.2, -0.07, -0.2), (0.2, -0.053, 0.2), 4)
    speed = (0.053 - 0.5 * to) / seconds

    def poses(t: float) -> Array:
        way = speed * (min(t, seconds) if not opens or t < seconds else max(2.0 * seconds - t, 0.0))
        return poses_of((0.0, -way, 0.0), (0.0, way, 0.0))

    made = contact_scene(scene, upper, lower, thickness=THICKNESS, **options)
    return ContactCase(made, each(scene, (0.0, 0.0, 0.0)), poses=poses)


def twisted_strip(
    cells: tuple[int, int] = (24, 5), turns: float = 10.0, seconds: float = 2.0, **options: Any
) -> ContactCase:
    """A strip of .4 m by .06 m whose ends turn against each other, by `turns` together."""
    strip = sheet_body((0.4, 0.06), cells, lambda p: p - [0.2, 0.0, 0.03])
    scene = pd.Scene(strip, pd.Pin(strip, np.abs(strip.mesh.vertices[:, 0]) > 0.2 - 1e-9), pd.Gravity((0.0, 0.0, 0.0)))
    values = sprung(scene, cells, 100.0, 0.1)
    rest = values.pin_targets

    def pins(t: float) -> Array:
        angle = math.degrees(math.pi * turns * min(t / seconds, 1.0))
        ends = [rest @ rotation(side * angle, 0.0, 0.0).T for side in (1.0, -1.0)]
        return np.where(rest[:, :1] < 0.0, *ends)

    made = contact_scene(scene, thickness=THICKNESS, values=values, **options)
    return ContactCase(made, each(scene, (0.0, 0.0, 0.0)), pins=pins)


def folded_cloth(cells: int = 16, *, speed: float = 0.0, self_contact: bool = True, **options: Any) -> ContactCase:
    """A cloth of .4 m on the ground, curled over so that it falls on itself, its upper part at a speed."""
    radius, flat = 0.03, 0.15

    def curled(p: Array) -> Array:
        along, angle = p[:, 0], np.clip((p[:, 0] - flat) / radius, 0.0, np.pi)
        x = np.minimum(along, flat) + radius * np.sin(angle) - np.maximum(along - flat - np.pi * radius, 0.0)
        return np.stack([x, 0.004 + radius * (1.0 - np.cos(angle)), p[:, 2] - 0.2], axis=1)

    cloth = sheet_body((0.4, 0.4), (cells, cells), curled)
    scene = falling(cloth, pd.Ground(0.0, friction=0.5))
    values = sprung(scene, (cells, cells), 50.0, 0.05)
    made = contact_scene(scene, thickness=THICKNESS, self_contact=self_contact, values=values, **options)
    upper = cloth.mesh.vertices[:, 1:2] > 0.004 + radius
    return ContactCase(made, np.where(upper, [0.0, -speed, 0.0], 0.0))
