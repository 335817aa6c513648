"""Random scenes of bodies in contact: whether anything crosses, ends as NaN, or comes nearer than the promise.

Boxes, rods, a sheet of cloth and a collider of random sizes and stiffness fly at each other with up to 40 m/s, in
steps of 1/1000 to 1/30 s. Surfaces rest 0.1 to 10 mm apart; friction is 0, 0.3 or 1. A scene takes 4, 16 or 64
iterations in float32 or float64, and enough steps to meet. Every end of a step is checked by exact signs. Rods that
pass through rods cross nothing: the least distance is all that is checked of them. Measured scenes are kept: an
interrupted run resumes.

    python benchmarks/contact_soak.py --scenes 2000

Very many run in parts, on several machines too, and are joined:

    python benchmarks/contact_soak.py --summary --seconds 300 --scenes 50000 --out a.json
    python benchmarks/contact_soak.py --summary --seconds 300 --first 50000 --scenes 50000 --out b.json
    python benchmarks/contact_soak.py --join a.json b.json --out soak.json
"""

from __future__ import annotations

import math
import sys
import time
import warnings
from typing import Any

import numpy as np
import torch
from judge import judge_scenes
from scipy.spatial.transform import Rotation

import torchpd as pd

STEPS, MOST = 3, 20  # after bodies can have met; before
GAP = 0.25  # m between bodies at the start, about
FLOOR = 0.09  # least distance over the thickness; the promise is 0.1, less its rounding in float32
SEED = 59
Row = dict[str, Any]


def random_box(rng: np.random.Generator, place: np.ndarray) -> pd.TetMesh:
    size, cells = rng.uniform(0.04, 0.1, 3), rng.integers(1, 4, 3)
    mesh = pd.shapes.box(tuple(size.tolist()), tuple(cells.tolist()))
    centred = mesh.vertices - mesh.vertices.mean(axis=0)
    return pd.TetMesh(Rotation.random(rng=rng).apply(centred) + place, mesh.tets)


def random_sheet(rng: np.random.Generator, place: np.ndarray) -> pd.TriMesh:
    count, size = int(rng.integers(3, 9)), float(rng.uniform(0.08, 0.2))
    line = np.linspace(-0.5 * size, 0.5 * size, count + 1)
    points = np.stack([*np.meshgrid(line, line, indexing="ij"), np.zeros((count + 1, count + 1))], axis=-1)
    corner = np.arange((count + 1) ** 2).reshape(count + 1, count + 1)
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]))
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return pd.TriMesh(Rotation.random(rng=rng).apply(points.reshape(-1, 3)) + place, triangles)


def random_rod(rng: np.random.Generator, place: np.ndarray, youngs: float) -> pd.Rod:
    """A rod of 1 to 12 segments, straight or an arc."""
    segments, length, arc = int(rng.integers(1, 13)), float(rng.uniform(0.08, 0.2)), float(rng.choice([0.0, 1.0, 3.0]))
    angle = arc * np.linspace(-0.5, 0.5, segments + 1)
    along = np.linspace(-0.5, 0.5, segments + 1) if arc == 0.0 else np.sin(angle) / arc
    line = length * np.stack([along, (1.0 - np.cos(angle)) / max(arc, 1.0), 0.0 * angle], axis=1)
    return pd.Rod(Rotation.random(rng=rng).apply(line) + place, youngs, radius=float(rng.uniform(1e-3, 4e-3)))


def random_scene(rng: np.random.Generator) -> tuple[Row, pd.Simulator, Any, dict[Any, torch.Tensor]]:
    """The random parameters, the simulator, the first state, and where the collider goes in a step."""
    places = 0.28 * np.array([(i, j, k) for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (-0.5, 0.5)])
    places = places[rng.permutation(len(places))]
    youngs, friction = 10.0 ** rng.uniform(4.0, 7.0), float(rng.choice([0.0, 0.3, 1.0]))
    parts: list[Any] = [pd.Solid(random_box(rng, place), youngs) for place in places[: rng.integers(0, 4)]]
    if rng.random() < 0.5 or not parts:
        sheet = random_sheet(rng, places[4])
        parts.append(pd.Cloth(sheet, youngs, thickness=1e-3, area_density=0.3))
    lines = int(rng.integers(0, 3))
    parts += [random_rod(rng, place, youngs) for place in places[len(places) - lines :]]
    speed = float(10.0 ** rng.uniform(-0.5, 1.6))
    collider = None
    if rng.random() < 0.5 or len(parts) == 1:
        mesh = random_box(rng, np.zeros(3))
        pose = np.concatenate([places[5], Rotation.random(rng=rng).as_quat()[[3, 0, 1, 2]]])
        collider = pd.Collider(mesh, pose=pose)
    thickness = float(10.0 ** rng.uniform(-4.0, -2.0))
    settings = {
        "time_step": float(rng.choice([1e-3, 1 / 240, 1 / 60, 1 / 30])),
        "iterations": int(rng.choice([4, 16, 64])),
        "dtype": torch.float64 if rng.random() < 1 / 3 else torch.float32,
    }
    contact = pd.Contact(friction=friction, thickness=thickness, capacity=20_000)
    extra = [] if collider is None else [collider]
    sim = pd.Simulator(pd.Scene(*parts, *extra, contact, pd.Gravity()), progress=False, **settings)
    state = sim.rest_state()
    for part in parts:
        own = sim.scene.vertex_range(part)
        own = slice(own.start, own.stop)
        middle = state.positions[0, own].mean(0)
        toward = -middle / middle.norm() + torch.tensor(rng.normal(0.0, 0.2, 3), dtype=sim.dtype)
        spin = torch.tensor(rng.normal(0.0, 5.0, 3), dtype=sim.dtype)
        arms = state.positions[0, own] - middle
        state.velocities[0, own] = speed * toward + torch.linalg.cross(spin.expand_as(arms), arms)
    targets = {}
    if collider is not None:
        place = np.concatenate([rng.normal(0.0, 0.03, 3), Rotation.random(rng=rng).as_quat()[[3, 0, 1, 2]]])
        targets = {collider: torch.tensor(place, dtype=sim.dtype)}
    facts = {"bodies": len(parts), "rods": lines, "collider": collider is not None, "youngs": youngs, "speed": speed}
    facts |= {"thickness": thickness, "friction": friction, "time_step": sim.time_step}
    return facts | {"iterations": sim.iterations, "dtype": str(sim.dtype)}, sim, state, targets


@torch.no_grad()
def run_scene(number: int) -> Row:
    rng = np.random.default_rng([SEED, number])
    try:
        facts, sim, state, targets = random_scene(rng)
    except ValueError as error:
        return {"scene": number, "left_out": str(error)[:160]}
    row: Row = {
        "scene": number,
        **facts,
        "gap": np.inf,
        "fault": None,
        "overflow": 0,
        "frozen": 0,
        "steps": 0,
        "seconds": 0.0,
    }
    steps = STEPS + min(MOST, math.ceil(GAP / (facts["speed"] * facts["time_step"])))
    for _ in range(steps):
        start = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            state, info = sim(state, targets=targets, return_info=True)
        row["steps"] += 1
        row["seconds"] += time.perf_counter() - start
        row["gap"] = min(row["gap"], float(info.contact_gap))
        row["overflow"] = max(row["overflow"], int(info.contact_overflow))
        row["frozen"] += int(info.contact_frozen)
        if not bool(state.positions.isfinite().all() & state.velocities.isfinite().all()):
            row["fault"] = "not finite"
            break
        try:
            sim.check(state)
        except ValueError as error:
            row["fault"] = str(error)[:160]
            break
    return row


def summary(rows: list[Row]) -> Row:
    """How many scenes had faults, and the least distance over the thickness."""
    used = [row for row in rows if "left_out" not in row]
    return {
        "scenes": len(used),
        "left out": len(rows) - len(used),
        "steps": sum(row["steps"] for row in used),
        "faults": [{name: row[name] for name in ("scene", "fault")} for row in used if row["fault"]],
        "nearer than the promise": sum(row["gap"] < FLOOR for row in used),
        "least gap": min((row["gap"] for row in used), default=math.inf),
        "scenes with pairs": sum(row["gap"] < np.inf for row in used),
        "overflows": sum(row["overflow"] > 0 for row in used),
        "scenes with frozen vertices": sum(row["frozen"] > 0 for row in used),
        "seconds": sum(row["seconds"] for row in used),
    }


def join(a: Row, b: Row) -> Row:
    """The summary of the scenes of two summaries: numbers and faults add up, but for the least gap.

    What one of them did not count is left out.
    """
    both = {name: a[name] + b[name] for name in a if name in b}
    return {**both, "least gap": min(a["least gap"], b["least gap"])}


if __name__ == "__main__":
    judge_scenes(sys.argv[1:], str(__doc__), 2000, run_scene, summary, join)
