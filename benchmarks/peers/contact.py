"""Motions with contact here and in Newton's VBD: error against time, and crossings at the ends of steps.

    cubes hit    two free cubes of 10 cm, 27 cells each, 1e5 Pa, meet at 2 m/s: 0.25 s, without gravity and friction
    cloth falls  a sheet of 40 cm, 100 N/m, falls over a fixed ball of 10 cm: 0.25 s, friction 0.3
    cube rests   a cube of 10 cm on another, whose lower side is held, both of 1e5 Pa: 1 s, friction 0.5

Meshes, lumped masses, Young's modulus, Poisson ratio 0, gravity, time step 1/60 s and start are the same. Each method
takes all steps with n iterations, in float32. Its error is the largest distance of a vertex from the method's *own*
converged motion, over the largest displacement there. That motion has 1024 or 2048 iterations a step, here in float64.
How far it is from the one with half as many stands beside it. Crossings are pairs of an edge and a triangle after each
step, by exact signs.

Contact is not the same model. Here, surfaces rest exactly a thickness apart. In VBD, a penalty (N/m for each pair) acts
below that distance, and a log barrier below half of it. Divide-and-Truncate is on, with pairs detected before every
fifth iteration. Between two detections a vertex moves by 0.425 times the detection's reach at most.

    python -m benchmarks.peers.contact --out benchmarks/results/peers-contact-cpu.json
    python -m benchmarks.peers.contact --device cuda --out benchmarks/results/peers-contact-cuda.json

Measured cases are kept: an interrupted run resumes.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from tqdm.auto import tqdm

import torchpd as pd
from torchpd.common.provenance import describe_run
from torchpd.reference.contact import crossings
from torchpd.reference.contact.surfaces import Surfaces
from torchpd.study.scenes import DENSITY

from . import newton_physics
from .problem import AREA_DENSITY, GRAVITY, THICKNESS, Array, MissingPackageError, Sheet
from .report import cell

TIME_STEP = 1 / 60  # s
GOALS = (0.3, 0.1, 0.03, 0.01)
COUNTS = [2**k for k in range(9)]
PENALTIES = (1e3, 1e4)  # N/m of a pair in VBD
DETECTION = 5  # iterations between detections in VBD, as here
PAIRS = 256  # that VBD keeps for a vertex and for an edge, at most
Row = dict[str, Any]


@dataclass(frozen=True)
class Motion:
    """Bodies, a fixed ball or none, and how they start."""

    bodies: tuple[pd.Solid | pd.Cloth, ...]
    steps: int
    longest: int  # iterations of a converged motion
    thickness: float  # m
    reach: float  # m beyond the thickness, of VBD's detection
    friction: float = 0.0
    ball: pd.TriMesh | None = None
    gravity: float = GRAVITY  # m/s^2 along y
    speeds: tuple[float, ...] = (0.0, 0.0)  # m/s along x, of the bodies
    held: tuple[int, ...] = ()  # vertices of the first body
    sheet: Sheet | None = None  # the first body, for VBD

    @property
    def start(self) -> Array:
        """Positions [V, 3] m of the bodies."""
        return np.concatenate([body.mesh.vertices for body in self.bodies])

    @property
    def velocities(self) -> Array:
        """Velocities [V, 3] m/s of the bodies."""
        counts = [len(body.mesh.vertices) for body in self.bodies]
        along = np.repeat(self.speeds[: len(counts)], counts)
        return np.stack([along, 0.0 * along, 0.0 * along], axis=1)

    def scene(self) -> pd.Scene:
        parts = [*self.bodies, pd.Gravity((0.0, self.gravity, 0.0))]
        parts += [] if self.ball is None else [pd.Collider(self.ball)]
        parts += [pd.Pin(self.bodies[0], np.array(self.held))] if self.held else []
        return pd.Scene(*parts, pd.Contact(friction=self.friction, thickness=self.thickness))


def _cube(place: tuple[float, float, float]) -> pd.Solid:
    return pd.Solid(pd.shapes.box((0.1,) * 3, (3,) * 3).translated(place), youngs=1e5, density=DENSITY)


def cubes_hit() -> Motion:
    bodies = _cube((-0.105, 0.0, 0.0)), _cube((0.005, 0.02, 0.01))
    return Motion(bodies, 15, 2048, 1e-3, 0.02, gravity=0.0, speeds=(1.0, -1.0))


def cloth_falls() -> Motion:
    mesh = pd.shapes.sheet((0.4, 0.4), (16, 16)).translated((0.0, 0.11, 0.0))
    still, nobody = np.zeros_like(mesh.vertices), np.zeros(0, np.int64)
    sheet = Sheet("cloth", mesh, 1e5 * THICKNESS, still, nobody, TIME_STEP, bending=1e-3)
    return Motion((sheet.body(),), 15, 2048, 2e-3, 0.01, 0.3, pd.shapes.sphere(0.1), sheet=sheet)


def cube_rests() -> Motion:
    bodies = _cube((0.0, 0.0, 0.0)), _cube((0.01, 0.101, 0.005))
    held = np.flatnonzero(bodies[0].mesh.vertices[:, 1] == 0.0)
    return Motion(bodies, 60, 1024, 1e-3, 0.003, 0.5, held=tuple(held.tolist()))


MOTIONS: dict[str, Callable[[], Motion]] = {
    "cubes hit": cubes_hit, "cloth falls": cloth_falls, "cube rests": cube_rests
}  # fmt: skip


class Run(NamedTuple):
    """Positions [steps + 1, V, 3] m of the bodies, and the time of a step: of the processor, or the wait for a GPU."""

    path: Array
    milliseconds: float


def follow(advance: Callable[[], None], places: Callable[[], Array], steps: int, device: str) -> Run:
    """The path of a motion of which `advance` takes the next step."""
    clock, wait = (time.perf_counter, torch.cuda.synchronize) if device == "cuda" else (time.process_time, lambda: None)
    path, spent = [places()], 0.0
    for _ in range(steps):
        wait()
        begin = clock()
        advance()
        wait()
        spent += clock() - begin
        path.append(places())
    return Run(np.stack(path), 1e3 * spent / steps)


@torch.no_grad()
def ours(motion: Motion, iterations: int, device: str, dtype: torch.dtype = torch.float32) -> Run:
    """A motion in this library, with its default solver; on a GPU a CUDA graph of a step."""
    sim = pd.Simulator(motion.scene(), TIME_STEP, iterations, dtype=dtype, batch=1, device=device, progress=False)
    state = sim.rest_state()
    state.velocities[0] = torch.tensor(motion.velocities).to(state.velocities)
    sim(state)

    def advance() -> None:
        nonlocal state
        state = sim(state)

    def places() -> Array:
        return state.positions[0].double().cpu().numpy()

    return follow(sim.capture(state).replay if device == "cuda" else advance, places, motion.steps, device)


def _model(motion: Motion, device: str) -> Any:
    """Newton's model: all surfaces are of particles, those of the ball are held."""
    newton, warp = newton_physics.packages()
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=(0.0, motion.gravity, 0.0))

    def common(mesh: pd.TetMesh | pd.TriMesh, elements: Any) -> dict[str, Any]:
        return {
            "pos": warp.vec3(0.0, 0.0, 0.0), "rot": warp.quat_identity(), "scale": 1.0,
            "vel": warp.vec3(0.0, 0.0, 0.0), "particle_radius": 1e-6,
            "vertices": [warp.vec3(*map(float, vertex)) for vertex in mesh.vertices],
            "indices": elements.reshape(-1).tolist(),
        }  # fmt: skip

    held = list(motion.held)
    for body in motion.bodies:
        if motion.sheet is not None:
            newton_physics.neo_hookean_cloth(builder, motion.sheet, common(body.mesh, body.elements))
        else:
            builder.add_soft_mesh(
                **common(body.mesh, body.elements), density=DENSITY, k_mu=body.youngs / 2.0, k_lambda=0.0, k_damp=0.0
            )  # fmt: skip
    if motion.ball is not None:
        held += range(len(motion.start), len(motion.start) + len(motion.ball.vertices))
        nothing = dict.fromkeys(("tri_ke", "tri_ka", "tri_kd", "edge_ke", "edge_kd"), 0.0)
        builder.add_cloth_mesh(**common(motion.ball, motion.ball.triangles), density=AREA_DENSITY, **nothing)
    for vertex in held:
        builder.particle_mass[vertex] = 0.0
        builder.particle_flags[vertex] &= ~int(newton.ParticleFlags.ACTIVE)
    builder.color(include_bending=True)
    return builder.finalize(device=device)


def vbd(motion: Motion, iterations: int, device: str, penalty: float) -> Run:
    """A motion in Newton's VBD with contact of all surfaces and Divide-and-Truncate; on a GPU CUDA graphs of steps."""
    newton, warp = newton_physics.packages()
    model = _model(motion, device)
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = penalty, 0.0, motion.friction
    slot, often = newton.solvers.SolverBase.CollisionSlot, newton.solvers.SolverBase.CollisionFrequencyType
    solver = newton.solvers.SolverVBD(
        model, iterations=iterations, particle_enable_self_contact=True,
        particle_self_contact_margin=motion.thickness, particle_self_contact_gap=motion.reach,
        particle_vertex_contact_buffer_size=PAIRS, particle_edge_contact_buffer_size=PAIRS,
        collision_frequency_type={slot.SOFT_SELF_CONTACT: often.ITERATIONS},
        collision_frequency={slot.SOFT_SELF_CONTACT: DETECTION},
    )  # fmt: skip
    states, control = (model.state(), model.state()), model.control()
    ways = [partial(solver.step, *pair, control, None, TIME_STEP) for pair in (states, states[::-1])]
    count, taken = len(motion.start), 0

    def reset() -> None:
        states[0].particle_q.assign(model.particle_q)
        moving = np.zeros((model.particle_count, 3), np.float32)
        moving[:count] = motion.velocities
        states[0].particle_qd.assign(moving)

    def captured(way: Callable[[], None]) -> Callable[[], None]:
        with warp.ScopedCapture(device=device) as capture:
            way()
        return partial(warp.capture_launch, capture.graph)

    def advance() -> None:
        nonlocal taken
        ways[taken % 2]()
        taken += 1

    def places() -> Array:
        return states[taken % 2].particle_q.numpy()[:count].astype(np.float64)

    reset()
    for way in ways:  # compiles
        way()
    if device == "cuda":
        ways = [captured(way) for way in ways]
    reset()
    return follow(advance, places, motion.steps, device)


def surfaces_of(motion: Motion) -> tuple[Surfaces, Array]:
    """Surfaces of the bodies and the ball, and the places of the ball's vertices."""
    meshes = [body.mesh for body in motion.bodies] + ([] if motion.ball is None else [motion.ball])
    counts = np.array([len(mesh.vertices) for mesh in meshes])
    triangles = [mesh.boundary() if isinstance(mesh, pd.TetMesh) else mesh.triangles for mesh in meshes]
    number = np.repeat(np.arange(len(meshes)), counts)
    moves = number < len(motion.bodies)
    rest = np.concatenate([mesh.vertices for mesh in meshes])
    corners = [own + first for own, first in zip(triangles, counts.cumsum() - counts, strict=True)]
    found = Surfaces(
        torch.tensor(rest), torch.tensor(np.concatenate(corners)),
        torch.tensor(number), torch.tensor(~moves), torch.ones(len(meshes), dtype=torch.bool), motion.thickness,
        torch.zeros(len(meshes), len(meshes)),
    )  # fmt: skip
    return found, rest[~moves]


def count_crossings(motion: Motion, path: Array) -> int:
    """Pairs of an edge and a triangle that cross, over all ends of steps."""
    surfaces, fixed = surfaces_of(motion)
    return sum(len(crossings(surfaces, torch.tensor(np.concatenate([x, fixed])))) for x in path[1:])


def distance(path: Array, exact: Array) -> float:
    """The largest distance of a vertex between two motions, over its largest displacement in the second."""
    away = np.linalg.norm(path - exact, axis=2).max() / np.linalg.norm(exact - exact[0], axis=2).max()
    return float(away) if np.isfinite(away) else np.inf


def at_rest(motion: Motion, path: Array) -> Row:
    """Where a cube on another ends [m]: its mean gap, and how far it slid in the second half."""
    if not motion.held:
        return {}
    lower, upper = np.split(path, 2, axis=1)
    start = lower[0][:, 1], upper[0][:, 1]
    gap = upper[-1, start[1] == start[1].min(), 1].mean() - lower[-1, start[0] == start[0].max(), 1].mean()
    slid = (upper[-1] - upper[len(path) // 2]).mean(axis=0)
    return {"gap": float(gap), "drift": float(np.hypot(slid[0], slid[2])), "fall": float(-slid[1])}


def measure(motion: Motion, run: Callable[[int], Run], converged: Callable[[int], Run], ours_end: Array | None) -> Row:
    """Errors, times and crossings at growing counts, until the last goal."""
    half, end = converged(motion.longest // 2).path, converged(motion.longest).path
    row: Row = {"settled": distance(half, end), "crossings_converged": count_crossings(motion, end)}
    row |= {"own_answer_from_ours": 0.0 if ours_end is None else distance(end, ours_end), **at_rest(motion, end)}
    row["points"] = []
    for count in COUNTS:
        found = run(count)
        reached = distance(found.path, end)
        point = {"count": count, "milliseconds": found.milliseconds, "error": reached}
        row["points"].append(point | {"crossings": count_crossings(motion, found.path), **at_rest(motion, found.path)})
        if reached <= 0.5 * GOALS[-1]:
            break
    return row


def table(rows: list[Row]) -> str:
    """Milliseconds of a step here and in VBD by motion, penalty and error, and crossings, in Markdown."""
    head = ["motion", "penalty of VBD", "its answer from ours", *(f"error {goal:g}" for goal in GOALS), "crossings"]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for row in rows:
        if row["method"] == "torchpd":
            continue
        methods = [other for other in rows if other["motion"] == row["motion"]]
        own = next(other for other in methods if other["method"] == "torchpd")
        counted = " / ".join(str(sum(point["crossings"] for point in of["points"])) for of in (own, row))
        cells = [row["motion"], f"{row['penalty']:g} N/m", f"{row['own_answer_from_ours']:.1g}"]
        lines.append("| " + " | ".join([*cells, *(cell(methods, row, goal) for goal in GOALS), counted]) + " |")
    return "\n".join(lines)


def main(words: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers.contact", description=__doc__.splitlines()[0])
    parser.add_argument("--motions", nargs="+", choices=MOTIONS, default=list(MOTIONS))
    parser.add_argument("--penalties", type=float, nargs="*", default=PENALTIES, help="of VBD [N/m] (%(default)s)")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--out", type=Path, help="output file (JSON)")
    options = parser.parse_args(words)
    torch.set_num_threads(1)
    stored = json.loads(options.out.read_text()) if options.out and options.out.exists() else {"rows": []}
    rows = {(row["motion"], row["method"], row["penalty"]): row for row in stored["rows"]}
    device = options.device
    run = describe_run(shlex.join(["python", "-m", "benchmarks.peers.contact", *words]), torch.device(device), 1)
    try:
        run["versions"].update(newton_physics.versions())
        penalties = list(options.penalties)
    except MissingPackageError as reason:
        print(reason)
        penalties = []
    cases = [(name, penalty) for name in options.motions for penalty in (None, *penalties)]
    for name, penalty in tqdm(cases, desc="motions", unit="case"):
        key = name, "torchpd" if penalty is None else "Newton VBD", penalty
        if key in rows:
            continue
        motion = MOTIONS[name]()
        exact = partial(ours, motion, device=device, dtype=torch.float64)
        if penalty is None:
            row = measure(motion, partial(ours, motion, device=device), exact, None)
        else:
            other = partial(vbd, motion, device=device, penalty=penalty)
            row = measure(motion, other, other, exact(motion.longest).path)
        rows[key] = dict(zip(("motion", "method", "penalty"), key, strict=True)) | row
        if options.out:
            options.out.parent.mkdir(parents=True, exist_ok=True)
            options.out.write_text(json.dumps({"schema": 1, **run, "rows": list(rows.values())}, indent=1) + "\n")
    print(table(list(rows.values())))


if __name__ == "__main__":
    main(sys.argv[1:])
