"""The promise of `Contact`, scene by scene: crossings by exact signs at the end of every step, and the least distance.

Each of 18 scenes runs with 4, 16, 64 and 256 iterations in float32 and float64. From every fourth state one step is
taken with 1, 2, 3, 5, 9 and 33 iterations too: the promise is for any number. Steps of 1/60 s, thickness 1 mm, 1e5 Pa
unless a scene says otherwise. Rods that pass through rods cross nothing: the least distance tells of them.

cubes      a turned cube falls on one on the ground, 2 m/s    needle   a cube falls on the tip of a cone, 2 m/s
edge       a cube falls on the ridge of a roof, 2 m/s         slide    a block slides on a mesh, friction 0.4, 2 m/s
gripper    two fingers lift a cube                            ball 20  a ball hits a pinned sheet at 20 m/s
ball 40    the same at 40 m/s                                 through  plates that would pass each other by 2 mm
bar        a bar wrung by 10 turns                            strip    a strip of cloth twisted by 10 turns
cover      a cloth of 40 x 40 falls over a cube
rings, knot, cord, pile, drape, fold, plates: of examples/contact_scenes.py

    python benchmarks/contact_promise.py --out contact-promise.json

The number of a scene is 8 times its place in this list, plus 2 times that of its iterations, plus 1 in float64.
Measured ones are kept: an interrupted run resumes.
"""

from __future__ import annotations

import runpy
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from judge import judge_scenes
from scipy.spatial.transform import Rotation

import torchpd as pd

_EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "contact_scenes.py"
shown = SimpleNamespace(**runpy.run_path(str(_EXAMPLE)))

Array = np.ndarray
Course = Any  # of examples/contact_scenes.py
Row = dict[str, Any]
H = 1 / 60  # s
THICKNESS = 1e-3  # m
ITERATIONS = (4, 16, 64, 256)
OTHERS = (1, 2, 3, 5, 9, 33)  # iterations of steps that are taken beside
MOST = 60  # steps of a course
FLOOR = 0.099  # least distance over the thickness; the promise is 0.1, less its rounding in float32


def turn(x: float, y: float, z: float) -> Array:
    return Rotation.from_euler("xyz", [x, y, z], degrees=True).as_matrix()


def cube(cells: int, center: tuple[float, float, float], by: Array | None = None, size: float = 0.1) -> pd.Solid:
    box = pd.shapes.box((size,) * 3, (cells,) * 3)
    points = box.vertices - 0.5 * size
    return pd.Solid(pd.TetMesh((points if by is None else points @ by.T) + center, box.tets), youngs=1e5)


def course(
    *parts: Any, friction: float | None = None, targets: Any = None, capacity: int | None = None,
    **velocities: tuple[pd.Body, float],
) -> Course:  # fmt: skip
    """A scene with gravity whose bodies start at speeds along an axis, x= or y=."""
    weight = [] if any(isinstance(part, pd.Gravity) for part in parts) else [pd.Gravity()]
    sim = shown.simulator(*parts, *weight, pd.Contact(friction=friction, thickness=THICKNESS, capacity=capacity))
    state: Any = sim.rest_state()
    for axis, (body, speed) in velocities.items():
        state.velocities[:, sim.scene.vertex_range(body), "xyz".index(axis)] = speed
    return shown.Course(sim, MOST, targets, state)


def cubes() -> Course:
    lower, upper = cube(3, (0.0, 0.051, 0.0)), cube(3, (0.015, 0.19, 0.01), turn(0.0, 17.0, 12.0))
    return course(lower, upper, pd.Ground(friction=0.5), friction=0.5, y=(upper, -2.0))


def needle() -> Course:
    angle = 2.0 * np.pi * np.arange(8) / 8
    rim = np.stack([0.05 * np.cos(angle), np.full(8, -0.2), 0.05 * np.sin(angle)], axis=1)
    points = np.concatenate([[[0.0, 0.0, 0.0]], rim, [[0.0, -0.2, 0.0]]])
    faces = [[0, 1 + (i + 1) % 8, 1 + i] for i in range(8)] + [[9, 1 + i, 1 + (i + 1) % 8] for i in range(8)]
    body = cube(4, (0.004, 0.07, 0.003))
    return course(body, pd.Collider(pd.TriMesh(points, np.array(faces))), y=(body, -2.0))


def edge() -> Course:
    ends = [[x, y, z] for y, z in ((0.0, 0.0), (-0.2, -0.1), (-0.2, 0.1)) for x in (-0.2, 0.2)]
    faces = [[0, 1, 3], [0, 3, 2], [0, 5, 1], [0, 4, 5], [2, 3, 5], [2, 5, 4], [0, 2, 4], [1, 5, 3]]
    body = cube(4, (0.003, 0.1, 0.002), turn(0.0, 0.0, 45.0) @ turn(0.0, 51.6, 0.0))
    return course(body, pd.Collider(pd.TriMesh(np.array(ends), np.array(faces))), y=(body, -2.0))


def slide() -> Course:
    body = cube(3, (-0.5, 0.05 + THICKNESS, 0.013))
    table = pd.Collider(pd.shapes.sheet((2.0, 0.6), (6, 6)))
    return course(body, table, friction=0.4, x=(body, 2.0))


def gripper() -> Course:
    body, finger = cube(2, (0.0, 0.025, 0.0), size=0.05), pd.shapes.box((0.02, 0.055, 0.04), (1, 2, 2))
    left, right = (pd.Collider(finger.translated((x - 0.01, 0.005, -0.02))) for x in (-0.045, 0.045))

    def targets(step: int) -> dict[Any, torch.Tensor]:
        closed, up = 0.015 * shown.ramp(step, 0, 18), 0.1 * shown.ramp(step, 18, 48)
        return {left: shown.pose(closed, up), right: shown.pose(-closed, up)}

    return course(body, left, right, pd.Ground(friction=0.5), friction=0.8, targets=targets)


def ball(speed: float) -> Course:
    sheet = pd.Cloth(pd.shapes.sheet((0.4, 0.4), (12, 12)), 1e5, thickness=THICKNESS, area_density=0.3)
    rim = (np.abs(sheet.mesh.vertices) > 0.2 - 1e-9).any(axis=1)
    body = pd.Solid(shown.ball(0.03, 3, (0.01, 0.1, 0.013)), youngs=1e6)
    return course(sheet, body, pd.Pin(sheet, rim), y=(body, -speed))


def through() -> Course:
    body, plate = cube(2, (0.0, 0.0, 0.0)), pd.shapes.sheet((0.4, 0.4), (4, 4))
    upper, lower = (pd.Collider(plate, pose=(0.0, side * 0.053, 0.0, 1, 0, 0, 0)) for side in (1, -1))

    def targets(step: int) -> dict[Any, torch.Tensor]:
        height = 0.053 - 0.054 * (shown.ramp(step, 0, 12) - shown.ramp(step, 12, 24))
        return {upper: shown.pose(y=height), lower: shown.pose(y=-height)}

    return course(body, upper, lower, pd.Gravity((0.0, 0.0, 0.0)), targets=targets)


def twisted(body: Any) -> Course:
    """The ends of a body of .4 m along x turn against each other, by 10 turns together in a second."""
    pin = pd.Pin(body, np.abs(body.mesh.vertices[:, 0]) > 0.2 - 1e-9)
    made = course(body, pin, pd.Gravity((0.0, 0.0, 0.0)), friction=0.3, capacity=20_000)
    start = shown.pinned(made.sim, pin)

    def targets(step: int) -> dict[Any, torch.Tensor]:
        angle = np.pi * 10.0 * shown.ramp(step, 0, MOST)
        side = torch.sign(start[:, 0])
        y, z = start[:, 1], start[:, 2]
        return {pin: torch.stack([start[:, 0], y * np.cos(angle) - side * z * np.sin(angle),
                                  side * y * np.sin(angle) + z * np.cos(angle)], dim=1)}  # fmt: skip

    return shown.Course(made.sim, MOST, targets, made.state)


def bar() -> Course:
    box = pd.shapes.box((0.4, 0.04, 0.04), (20, 2, 2))
    return twisted(pd.Solid(pd.TetMesh(box.vertices - [0.2, 0.02, 0.02], box.tets), youngs=1e5))


def strip() -> Course:
    return twisted(pd.Cloth(pd.shapes.sheet((0.4, 0.06), (24, 5)), 1e5, thickness=THICKNESS, area_density=0.3))


def cover() -> Course:
    sheet = pd.Cloth(
        pd.shapes.sheet((0.4, 0.4), (40, 40)).translated((0.01, 0.13, 0.02)), 1e5,
        thickness=THICKNESS, area_density=0.3, bending=1e-5,
    )  # fmt: skip
    return course(sheet, cube(3, (0.0, 0.051, 0.0)), pd.Ground(friction=0.5), friction=0.3)


SCENES: dict[str, Callable[[], Course]] = {
    "cubes": cubes, "needle": needle, "edge": edge, "slide": slide, "gripper": gripper,
    "ball 20": lambda: ball(20.0), "ball 40": lambda: ball(40.0), "through": through, "bar": bar, "strip": strip,
    "cover": cover,
}  # fmt: skip
for _name in ("rings", "knot", "cord", "pile", "drape", "fold", "plates"):
    SCENES[_name] = lambda name=_name: shown.SCENES[name][0](min(MOST, shown.SCENES[name][1]))  # type: ignore[misc]


@torch.no_grad()
def run_scene(number: int) -> Row:
    name, iterations = list(SCENES)[number // 8], ITERATIONS[number // 2 % 4]
    of = SCENES[name]()
    sim = of.sim.double() if number % 2 else of.sim
    sim.iterations = iterations
    state: Any = sim.rest_state() if of.state is None else of.state.to(sim.dtype)
    row: Row = {"scene": number, "name": name, "iterations": iterations, "dtype": str(sim.dtype), "fault": None}
    row |= {
        "steps": 0,
        "beside": 0,
        "gap": np.inf,
        "pairs": 0,
        "searches": 0,
        "held_back": 0.0,
        "overflow": 0,
        "frozen": 0,
    }
    begin = time.perf_counter()

    def take(count: int) -> Any:
        sim.iterations = count
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            after, info = sim(state, targets=targets, return_info=True)
        row["gap"] = min(row["gap"], float(info.contact_gap))
        row["overflow"] = max(row["overflow"], int(info.contact_overflow))
        row["pairs"] = max(row["pairs"], int(info.contact_pairs))
        row["frozen"] += int(info.contact_frozen)
        try:
            sim.check(after)
        except ValueError as error:
            row["fault"] = row["fault"] or f"step {row['steps']}, {count} iterations: {str(error)[:120]}"
        return after, info

    for step in range(min(MOST, of.steps)):
        given = {} if of.targets is None else of.targets(step)
        targets = {part: value.to(sim.rest_positions) for part, value in given.items()}
        if step % 4 == 0:
            for count in OTHERS:
                take(count)
            row["beside"] += len(OTHERS)
        state, info = take(iterations)
        row["steps"] += 1
        row["searches"] += int(info.contact_searches)
        row["held_back"] = max(row["held_back"], float(info.held_back))
    return row | {"seconds": time.perf_counter() - begin}


def summary(rows: list[Row]) -> Row:
    """Faults and the least distance over the thickness of all, and of each scene."""
    scenes = {}
    for name in dict.fromkeys(row["name"] for row in rows):
        own = [row for row in rows if row["name"] == name]
        scenes[name] = {
            "steps": sum(row["steps"] + row["beside"] for row in own), "gap": min(row["gap"] for row in own),
            "pairs": max(row["pairs"] for row in own), "faults": sum(row["fault"] is not None for row in own),
        }  # fmt: skip
    return {
        "runs": len(rows),
        "steps": sum(row["steps"] + row["beside"] for row in rows),
        "faults": [{name: row[name] for name in ("scene", "fault")} for row in rows if row["fault"]],
        "nearer than the promise": sum(row["gap"] < FLOOR for row in rows),
        "least gap": min((row["gap"] for row in rows), default=np.inf),
        "overflows": sum(row["overflow"] > 0 for row in rows),
        "scenes": scenes,
    }


if __name__ == "__main__":
    judge_scenes(sys.argv[1:], str(__doc__), 8 * len(SCENES), run_scene, summary, most=8 * len(SCENES))
