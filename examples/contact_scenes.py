"""Scenes of contact between bodies, by name; each ends without crossings by exact signs, and draws its course.

rings: two linked rings are pulled apart.  knot: a rope is pulled into a knot.  cord: the same of a rod, pulled tight.
pile: bodies fall into a box.  drape: a cloth falls over a ball.  fold: a cloth is folded on itself.
plates: a ball is squeezed between plates.  batch: environments with other materials and places, side by side.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torchpd as tpd
from torchpd.scene.contact import placed
from torchpd.viewing.bodies import SceneSurface
from torchpd.viewing.render import Studio, contact_sheet, frame_camera

TIME_STEP = 1 / 60  # s
COLLIDER = (0.30, 0.31, 0.33)
Targets = Callable[[int], dict[Any, torch.Tensor]]


@dataclass
class Course:
    """A scene that moves for some steps, and how it is seen."""

    sim: tpd.Simulator
    steps: int
    targets: Targets | None = None
    state: Any = None  # start; None: at rest
    azimuth: float = 25.0  # of the camera, degrees
    elevation: float = 20.0
    size: tuple[int, int] = (360, 300)  # of a picture, pixels
    columns: int = 4


def simulator(*parts: Any, iterations: int = 32) -> tpd.Simulator:
    return tpd.Simulator(tpd.Scene(*parts), TIME_STEP, iterations)


def bent(box: tpd.TetMesh, line: np.ndarray, *, closed: bool = False) -> tpd.TetMesh:
    """A box along x, [0, 1] long, whose axis becomes a line [n, 3] without twist; `closed` joins its ends."""
    middle = box.vertices - [0.0, *box.vertices[:, 1:].mean(axis=0)]
    ahead = np.gradient(line, axis=0) if not closed else np.roll(line, -1, axis=0) - np.roll(line, 1, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    side = np.empty_like(line)
    side[0] = np.cross(ahead[0], np.eye(3)[np.abs(ahead[0]).argmin()])
    for number in range(1, len(line)):
        side[number] = side[number - 1] - ahead[number] * (side[number - 1] @ ahead[number])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    row = np.rint(middle[:, 0] * (len(line) if closed else len(line) - 1)).astype(int) % len(line)
    points = line[row] + middle[:, 1:2] * side[row] + middle[:, 2:] * np.cross(ahead[row], side[row])
    kept, number = np.unique(np.round(points, 9), axis=0, return_inverse=True)
    return tpd.TetMesh(kept, number.reshape(-1)[box.tets])


def ball(radius: float, cells: int, place: tuple[float, float, float]) -> tpd.TetMesh:
    """A cube whose shells become spheres."""
    box = tpd.shapes.box((2.0,) * 3, (cells,) * 3)
    points = box.vertices - 1.0
    shell, size = np.abs(points).max(axis=1, keepdims=True), np.linalg.norm(points, axis=1, keepdims=True)
    return tpd.TetMesh(radius * points * shell / np.maximum(size, 1e-300) + place, box.tets)


def ramp(step: int, begin: int, end: int) -> float:
    """0 before a step, 1 after another, and between them in proportion."""
    return min(max((step + 1 - begin) / (end - begin), 0.0), 1.0)


def pinned(sim: tpd.Simulator, pin: tpd.Pin) -> torch.Tensor:
    """Places [p, 3] of the vertices of a pin at rest."""
    return sim.pin_targets[..., sim.scene.pin_range(pin), :].reshape(-1, 3)


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> torch.Tensor:
    return torch.tensor([x, y, z, 1.0, 0.0, 0.0, 0.0])


# ---- scenes


def rings(steps: int) -> Course:
    """Two rings of 12 cm, linked; their far sides are pulled apart by 10 cm."""
    angle = 2.0 * np.pi * np.arange(24) / 24
    circle = 0.06 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    box = tpd.shapes.box((1.0, 0.02, 0.02), (24, 2, 2))
    bodies, pins = [], []
    for side, line in ((-1.0, circle), (1.0, circle[:, [0, 2, 1]])):
        body = tpd.Solid(bent(box, line + [0.03 * side, 0.1, 0.0], closed=True), youngs=1e5, density=1000.0)
        pins.append(tpd.Pin(body, side * body.mesh.vertices[:, 0] > 0.08))
        bodies.append(body)
    sim = simulator(*bodies, *pins, tpd.Contact(friction=0.3, thickness=1e-3))
    starts = [pinned(sim, pin) for pin in pins]

    def targets(step: int) -> dict[Any, torch.Tensor]:
        way = 0.05 * ramp(step, 0, max(steps * 3 // 4, 1))
        return {
            pin: start + torch.tensor([side * way, 0.0, 0.0])
            for pin, start, side in zip(pins, starts, (-1.0, 1.0), strict=True)
        }

    return Course(sim, steps, targets, elevation=35.0)


def overhand(cells: int) -> np.ndarray:
    """Vertices [cells + 1, 3] m of a line of even segments in an overhand knot."""
    t = np.linspace(-2.1, 2.1, 400)
    curve = np.stack([t**3 - 3.0 * t, 0.8 * (t**4 - 4.0 * t**2), 0.2 * (t**5 - 10.0 * t)], axis=1) * 0.1
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    places = np.linspace(0.0, length[-1], cells + 1)
    return np.stack([np.interp(places, length, curve[:, axis]) for axis in range(3)], axis=1) + [0.0, 0.4, 0.0]


def knot(steps: int) -> Course:
    """A rope of 1.7 cm lies in an overhand knot; its ends are pulled apart."""
    cells = 140
    line = overhand(cells)
    mesh = bent(tpd.shapes.box((1.0, 0.017, 0.017), (cells, 1, 1)), line)
    rope = tpd.Solid(mesh, youngs=3e5, density=1000.0)
    ends = [tpd.Pin(rope, np.linalg.norm(mesh.vertices - end, axis=1) < 0.015) for end in (line[0], line[-1])]
    contact = tpd.Contact(friction=0.1, thickness=5e-4)
    sim = simulator(rope, *ends, contact, tpd.Damping(2.0))
    starts = [pinned(sim, pin) for pin in ends]

    def targets(step: int) -> dict[Any, torch.Tensor]:
        share = ramp(step, 0, max(steps * 9 // 10, 1))
        ways = torch.tensor([[-0.9, 0.0, -line[0, 2]], [0.9, 0.0, -line[-1, 2]]]) * share
        return {pin: start + way.to(start) for pin, start, way in zip(ends, starts, ways, strict=True)}

    return Course(sim, steps, targets, azimuth=0.0, size=(740, 240), columns=2)


def cord(steps: int) -> Course:
    """A rod of 2.4 cm lies in an overhand knot, which is pulled tight."""
    line, radius = overhand(140), 0.012
    rope = tpd.Rod(line, youngs=2e5, radius=radius, rest_curvature=0.0)
    ends = [tpd.Pin(rope, vertices) for vertices in ([0, 1], [139, 140])]
    sim = simulator(rope, *ends, tpd.Contact(friction=0.2, thickness=2.0 * radius), tpd.Damping(2.0), iterations=64)
    starts = [pinned(sim, pin) for pin in ends]

    def targets(step: int) -> dict[Any, torch.Tensor]:
        share = ramp(step, 0, max(steps * 9 // 10, 1))
        ways = torch.tensor([[-0.85, 0.0, -line[0, 2]], [0.85, 0.0, -line[-1, 2]]]) * share
        return {pin: start + way.to(start) for pin, start, way in zip(ends, starts, ways, strict=True)}

    return Course(sim, steps, targets, azimuth=0.0, size=(740, 240), columns=2)


def pile(steps: int) -> Course:
    """Cubes, balls and rings fall into an open box."""
    angle = 2.0 * np.pi * np.arange(12) / 12
    circle = 0.035 * np.stack([np.cos(angle), 0.0 * angle, np.sin(angle)], axis=1)
    hoop = bent(tpd.shapes.box((1.0, 0.025, 0.025), (12, 1, 1)), circle, closed=True)
    cube = tpd.shapes.box((0.07,) * 3, (2,) * 3).translated((-0.035,) * 3)
    rng, bodies = np.random.default_rng(1), []
    for number in range(9):
        shape = (cube, ball(0.042, 3, (0.0, 0.0, 0.0)), hoop)[number % 3]
        turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        turn *= np.sign(np.linalg.det(turn))
        place = [0.055 * (number % 2 * 2 - 1), 0.09 + 0.115 * (number // 2), 0.05 * (number // 2 % 2 * 2 - 1)]
        bodies.append(tpd.Solid(tpd.TetMesh(shape.vertices @ turn.T + place, shape.tets), youngs=5e4, density=500.0))
    floor, wall = tpd.shapes.sheet((0.24, 0.24), (6, 6)), tpd.shapes.sheet((0.12, 0.24), (3, 6))
    x, y, z = wall.vertices.T
    walls = [np.stack([y + side * 0.12, x + 0.06, z], axis=1) for side in (-1.0, 1.0)]
    walls += [vertices[:, [2, 1, 0]] for vertices in walls]
    sides = [floor, *(tpd.TriMesh(vertices, wall.triangles) for vertices in walls)]
    offsets = np.cumsum([0, *(len(part.vertices) for part in sides)])
    box = tpd.Collider(
        tpd.TriMesh(
            np.concatenate([part.vertices for part in sides]),
            np.concatenate([part.triangles + offset for part, offset in zip(sides, offsets, strict=False)]),
        )
    )
    contact = tpd.Contact(friction=0.4, thickness=1e-3, self_contact=False)
    return Course(simulator(*bodies, box, contact, tpd.Gravity()), steps, elevation=45.0)


def drape(steps: int) -> Course:
    """A cloth falls over a ball onto the ground, and folds touch each other."""
    mesh = tpd.shapes.sheet((0.5, 0.5), (28, 28)).translated((0.01, 0.3, 0.02))
    cloth = tpd.Cloth(mesh, youngs=2e5, thickness=5e-4, area_density=0.2, bending=2e-5)
    support = tpd.Collider(tpd.shapes.sphere(0.1, 9).translated((0.0, 0.18, 0.0)), friction=0.3)
    contact = tpd.Contact(friction=0.3, thickness=2e-3)
    parts = (cloth, support, contact, tpd.Ground(friction=0.4), tpd.Gravity(), tpd.Damping(1.0))
    return Course(simulator(*parts), steps)


def fold(steps: int) -> Course:
    """One side of a cloth on the ground is lifted, laid on the other one, and let lie there."""
    mesh = tpd.shapes.sheet((0.4, 0.3), (24, 18)).translated((0.0, 0.002, 0.0))
    cloth = tpd.Cloth(mesh, youngs=2e5, thickness=5e-4, area_density=0.2, bending=1e-4)
    hand = tpd.Pin(cloth, mesh.vertices[:, 0] > 0.199)
    far = tpd.Pin(cloth, mesh.vertices[:, 0] < -0.199)
    contact = tpd.Contact(friction=0.4, thickness=2e-3)
    sim = simulator(cloth, hand, far, contact, tpd.Ground(friction=0.6), tpd.Gravity(), tpd.Damping(2.0))
    start = pinned(sim, hand)

    def targets(step: int) -> dict[Any, torch.Tensor]:
        angle = np.pi * ramp(step, 0, max(steps * 4 // 5, 1))
        over = torch.tensor([0.18 * (np.cos(angle) - 1.0), 0.16 * np.sin(angle) + 0.006 * angle / np.pi, 0.0])
        return {hand: start + over.to(start)}

    return Course(sim, steps, targets)


def plates(steps: int) -> Course:
    """A ball of 12 cm is squeezed to a third between two plates, and springs back."""
    body = tpd.Solid(ball(0.06, 6, (0.0, 0.1, 0.0)), youngs=1e5, poisson=0.4, density=1000.0)
    plate = tpd.shapes.box((0.26, 0.01, 0.2), (6, 1, 5)).translated((-0.13, -0.005, -0.1))
    lower, upper = (tpd.Collider(plate, pose=(0.0, 0.1 + side * 0.067, 0.0, 1, 0, 0, 0)) for side in (-1.0, 1.0))
    sim = simulator(body, lower, upper, tpd.Contact(friction=0.5, thickness=1e-3))

    def targets(step: int) -> dict[Any, torch.Tensor]:
        closed = ramp(step, 0, max(steps // 2, 1)) - ramp(step, steps * 2 // 3, steps)
        height = 0.067 - 0.041 * closed
        return {lower: pose(y=0.1 - height), upper: pose(y=0.1 + height)}

    return Course(sim, steps, targets, elevation=14.0)


def batch(steps: int, environments: int = 256) -> Course:
    """A cube falls on another one: each environment has its own stiffness, place and speed."""
    lower, upper = (tpd.shapes.box((0.1,) * 3, (2,) * 3).translated((-0.05, y, -0.05)) for y in (0.002, 0.13))
    bodies = [tpd.Solid(mesh, youngs=1e5, density=1000.0) for mesh in (lower, upper)]
    sim = simulator(*bodies, tpd.Contact(friction=0.5, thickness=2e-3), tpd.Ground(friction=0.5), tpd.Gravity())
    random = torch.Generator().manual_seed(0)
    uniform = torch.rand(5, environments, 1, generator=random)
    sim.set_material(stiffness=sim.stiffness.detach() * 10 ** (1.5 * uniform[0] - 1.0))
    state: Any = sim.rest_state(environments)
    own = slice(len(lower.vertices), None)
    shift = torch.stack([0.05 * (uniform[1] - 0.5), 0.1 * uniform[2], 0.05 * (uniform[3] - 0.5)], dim=-1)
    state.positions[:, own] += shift
    state.velocities[:, own, 1] = -2.0 * uniform[4]
    return Course(sim, steps, state=state, elevation=28.0, size=(600, 390), columns=2)


SCENES: dict[str, tuple[Callable[[int], Course], int]] = {
    "rings": (rings, 60),
    "knot": (knot, 110),
    "cord": (cord, 90),
    "pile": (pile, 60),
    "drape": (drape, 60),
    "fold": (fold, 60),
    "plates": (plates, 45),
    "batch": (batch, 30),
}


# ---- pictures


def frame(course: Course, skin: SceneSurface, state: Any) -> np.ndarray:
    """Vertices of all environments and their colliders [n, 3], environments side by side."""
    count = len(state.positions)
    across = int(np.ceil(np.sqrt(count)))
    points = []
    for number, drawn in enumerate(np.asarray(skin.apply(state.positions))):
        points.append(drawn + [0.24 * (number % across), 0.0, 0.24 * (number // across)])
        for part, at in zip(course.sim.scene.colliders, state.history.poses[number].double().numpy(), strict=True):
            points.append(placed(np.repeat(at[None], len(part.mesh.vertices), axis=0), part.mesh.vertices))
    return np.concatenate(points)


def picture(course: Course, states: list[Any], out: Path, samples: int) -> None:
    skin = SceneSurface(course.sim.scene)
    triangles, colors, offset = [], [], 0
    for _ in range(len(states[0].positions)):
        drawn = [(np.asarray(skin.triangles), skin.colors)]
        shown = [part.mesh for part in course.sim.scene.colliders]
        drawn += [(mesh.triangles, np.tile(COLLIDER, (len(mesh.vertices), 1))) for mesh in shown]
        for faces, color in drawn:
            triangles.append(faces + offset)
            colors.append(color)
            offset += len(color)
    frames = np.stack([frame(course, skin, state) for state in states])
    camera = frame_camera(
        frames, azimuth=course.azimuth, elevation=course.elevation, aspect=course.size[0] / course.size[1]
    )
    # a floor that surfaces rest on would flicker with them
    ground = -0.003 if course.sim.scene.grounds else None
    studio = Studio(
        frames,
        np.concatenate(triangles),
        color=np.concatenate(colors),
        camera=camera,
        ground=ground,
        samples=samples,
        size=course.size,
    )
    contact_sheet([studio.render(points) for points in frames], columns=course.columns, path=out)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", choices=SCENES, default="rings")
    parser.add_argument("--steps", type=int, help="of 1/60 s; by default those of the scene")
    parser.add_argument("--out", type=Path, help="picture of the start and of later times; none if left out")
    parser.add_argument("--frames", type=int, default=4, help="times in the picture")
    parser.add_argument("--samples", type=int, default=16, help="light paths per pixel")
    options = parser.parse_args()

    make, usual = SCENES[options.scene]
    course = make(options.steps or usual)
    sim = course.sim
    state: Any = sim.rest_state() if course.state is None else course.state
    begin, shown, times, most = time.perf_counter(), [state], [], [0.0] * 3
    at = np.linspace(0, course.steps, options.frames).round().astype(int)[1:]
    for step in range(course.steps):
        given = None if course.targets is None else course.targets(step)
        start = time.perf_counter()
        state, info = sim(state, targets=given, return_info=True)
        times.append(1e3 * (time.perf_counter() - start))
        found = (info.contact_pairs, info.contact_searches, 1e3 * info.held_back)
        most = [max(value, float(new.max())) for value, new in zip(most, found, strict=True)]
        if step + 1 in at:
            shown.append(state)
    seconds = time.perf_counter() - begin
    sim.check(state)  # raises where an edge passes through a triangle, by exact signs
    plan = sim.body_contact.plan
    print(
        f"{options.scene}: {len(state.positions)} environments of {len(plan.triangles)} triangles and "
        f"{len(plan.edges)} edges, no crossing"
    )
    print(f"{course.steps} steps in {seconds:.1f} s; pairs with a force: {int((state.history.keys >= 0).sum())}")
    print(
        f"most of a step: {most[0]:,.0f} pairs near each other of a capacity of {plan.capacity:,}, {most[1]:.0f} "
        f"searches, {most[2]:.2f} mm held back; {np.median(times):.1f} ms, most {max(times[1:], default=0.0):.1f} ms"
    )
    print(
        f"least distance {float(info.contact_gap.min()):.2f} of the thickness; pairs that the capacity lacks: "
        f"{int(info.contact_overflow.max())}; held back by {1e3 * float(info.held_back.max()):.2f} mm"
    )
    if options.out:
        picture(course, shown, options.out, options.samples)


if __name__ == "__main__":
    main()
