"""Rest, friction and momentum of bodies that touch, beside what mechanics says: steps of 1/60 s in float64.

    stack      five cubes of 10 cm stand on a rigid table for 10 s: drift, sway, distance from solved steps
    angle      a cube on a slope: the steepest at which it rests, and the flattest at which it slides
    stop       a cube slides to a stop: the way beside Coulomb's law in the same steps
    momentum   two free cubes meet off-centre: what is left of their linear and angular momentum
    corner     a cube flies against the corner of a rigid box: how late and soft the contact is after few iterations
    gap        a cube rests on a table: the default thickness, and the least that float32 takes

The slope is a level surface under gravity that is tilted. It is a mesh (`Collider`), or a soft slab of the same
material as the cube, whose underside is pinned.

    OMP_NUM_THREADS=1 python benchmarks/contact_statics.py --out contact-statics.json
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from machine import describe_run, write_result
from numpy.typing import NDArray
from torch import Tensor

import torchpd as pd

Row = dict[str, Any]
State = pd.HistoryState

H = 1.0 / 60.0  # s
G = 9.81  # m/s^2
SIZE = 0.1  # m, edge of a cube
CELLS = 2  # of a cube along an edge
THICKNESS = 1e-3  # m
ITERATIONS = 64
SOLVED = 1024  # iterations of the motions that others are compared with
OFFSETS = (-1.0, -0.5, -0.2, -0.1, -0.05, -0.02, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # degrees from atan mu


# ---- scenes


def cube(youngs: float, low: tuple[float, float, float], cells: int = CELLS) -> pd.Solid:
    """A cube of 1 kg; `low` [m] is the middle of its underside."""
    corner = np.array(low) - [SIZE / 2, 0.0, SIZE / 2]
    return pd.Solid(pd.shapes.box((SIZE,) * 3, (cells,) * 3).translated(corner), youngs=youngs, density=1000.0)


def table(length: float, width: float) -> pd.Collider:
    """A rigid level mesh, whose upper side is at height 0."""
    return pd.Collider(pd.shapes.box((length, 0.05, width), (3, 1, 1)).translated((-length / 2, -0.05, -width / 2)))


def slab(youngs: float, length: float, width: float) -> list[Any]:
    """A soft slab of 5 cm, whose upper side is at height 0, and the pin of its underside."""
    cells = (round(length / 0.06), 1, round(width / 0.06))
    mesh = pd.shapes.box((length, 0.05, width), cells).translated((-length / 2, -0.05, -width / 2))
    body = pd.Solid(mesh, youngs=youngs, density=1000.0)
    return [body, pd.Pin(body, mesh.vertices[:, 1] < -0.05 + 1e-9)]


def support(kind: str, youngs: float, length: float) -> list[Any]:
    return [table(length, 0.24)] if kind == "mesh" else slab(youngs, length, 0.24)


def simulator(*parts: Any, iterations: int = ITERATIONS) -> pd.Simulator:
    return pd.Simulator(pd.Scene(*parts), H, iterations, dtype=torch.float64, progress=False)


def walk(sim: pd.Simulator, steps: int, velocities: NDArray[np.float64] | None = None) -> Iterator[tuple[State, Any]]:
    """States and reports of steps, from rest positions."""
    state: Any = sim.rest_state()
    if velocities is not None:
        state.velocities[:] = torch.tensor(velocities)
    for _ in range(steps):
        state, info = sim(state, return_info=True)
        if int(info.contact_overflow) > 0:
            raise RuntimeError(f"the capacity lacks {int(info.contact_overflow)} pairs")
        yield state, info


def center(sim: pd.Simulator, positions: Tensor, vertices: slice) -> Tensor:
    """Centre of mass [3] of the vertices of a body."""
    m = sim.masses[vertices, None]
    return (m * positions[0, vertices]).sum(0) / m.sum()


def largest(vectors: Tensor) -> float:
    """Largest norm of the last dimension."""
    return float(vectors.norm(dim=-1).max())


# ---- cases


def stack(steps: int | None) -> Iterator[Row]:
    """Cubes stand a few millimetres off the axis, so that corners do not lie on corners."""
    count, second = steps or 600, min(60, (steps or 600) - 1)
    for youngs in (1e6, 1e7):
        places = [(2e-3 * (-1) ** n, THICKNESS + n * (SIZE + THICKNESS), 1e-3 * (n % 3)) for n in range(5)]
        parts = [*(cube(youngs, place) for place in places), table(0.6, 0.6), pd.Gravity((0.0, -G, 0.0))]
        parts.append(pd.Contact(friction=0.5, thickness=THICKNESS))
        sim = simulator(*parts)
        top = slice(sim.vertices - sim.vertices // 5, None)
        begin = time.perf_counter()
        states = [state for state, _ in walk(sim, count)]
        spent = time.perf_counter() - begin
        start = center(sim, sim.rest_state().positions, top)
        sway = max(largest((center(sim, state.positions, top) - start)[[0, 2]]) for state in states)
        end = states[-1].positions
        *_, (solved, _) = walk(simulator(*parts, iterations=SOLVED), count)
        yield {
            "youngs [Pa]": youngs,
            "drift in the last second [m]": max(largest(end - state.positions) for state in states[-1 - second :]),
            "speed at the end [m/s]": largest(states[-1].velocities),
            "sway [m]": sway,
            f"distance from {SOLVED} iterations [m]": largest(end - solved.positions),
            f"speed with {SOLVED} iterations [m/s]": largest(solved.velocities),
            "ms a step": spent / count * 1e3,
        }


def speed_on_slope(kind: str, youngs: float, degrees: float, count: int) -> tuple[float, float]:
    """Largest speed of a vertex [m/s] after steps from rest, or after .3 m, and the seconds; friction .5."""
    angle = math.radians(degrees)
    gravity = pd.Gravity((G * math.sin(angle), -G * math.cos(angle), 0.0))
    contact = pd.Contact(friction=0.5, thickness=THICKNESS)
    sim = simulator(cube(youngs, (-0.2, THICKNESS, 0.013)), *support(kind, youngs, 0.9), gravity, contact)
    speed, taken = 0.0, 0
    for state, _ in walk(sim, count):
        speed, taken = largest(state.velocities), taken + 1
        if largest(state.positions - sim.rest_state().positions) > 0.3:
            break
    return speed, taken * H


def angle(steps: int | None) -> Iterator[Row]:
    """It rests below 1e-5 m/s, and slides above half of the speed of a rigid block."""
    ideal = math.degrees(math.atan(0.5))
    for kind, youngs in (("mesh", 1e6), ("mesh", 1e5), ("slab", 1e6), ("slab", 1e5)):
        rests, slides, speeds = math.nan, math.nan, {}
        for offset in OFFSETS:
            speed, seconds = speed_on_slope(kind, youngs, ideal + offset, steps or 240)
            speeds[str(offset)] = speed
            rigid = seconds * G * math.sin(math.radians(offset)) / math.cos(math.radians(ideal))
            if all(earlier < 1e-5 for earlier in speeds.values()):
                rests = ideal + offset
            if speed > 0.5 * rigid > 0.0 and math.isnan(slides):
                slides = ideal + offset
        yield {
            "on": kind,
            "youngs [Pa]": youngs,
            "rests up to [degrees]": rests,
            "slides from [degrees]": slides,
            "atan .5 [degrees]": ideal,
            "speeds [m/s]": speeds,
        }


def stop(steps: int | None) -> Iterator[Row]:
    """In steps of h a block moves by the sum of h max(0, v - k h mu g), a little less than v^2 / (2 mu g)."""
    mu = 0.4
    for kind in ("mesh", "slab"):
        for youngs in (1e5, 1e6):
            for speed in (1.0, 2.0):
                parts = [cube(youngs, (-0.3, THICKNESS, 0.013)), *support(kind, youngs, 0.9)]
                sim = simulator(*parts, pd.Gravity((0.0, -G, 0.0)), pd.Contact(friction=mu, thickness=THICKNESS))
                own = slice(0, (CELLS + 1) ** 3)
                velocities = np.zeros((sim.vertices, 3))
                velocities[own, 0] = speed
                count = steps or int(speed / (mu * G * H)) + 30
                *_, (state, _) = walk(sim, count, velocities)
                way = float((center(sim, state.positions, own) - center(sim, sim.rest_state().positions, own))[0])
                exact = H * sum(max(0.0, speed - k * H * mu * G) for k in range(1, count + 1))
                yield {
                    "on": kind,
                    "youngs [Pa]": youngs,
                    "speed [m/s]": speed,
                    "way [m]": way,
                    "way of Coulomb's law in these steps [m]": exact,
                    "relative error": way / exact - 1.0,
                    "over v^2 / (2 mu g)": way / (speed**2 / (2.0 * mu * G)),
                }


def momenta(sim: pd.Simulator, state: State) -> tuple[Tensor, Tensor]:
    """Linear [3] and angular [3] momentum about the origin."""
    m = sim.masses[:, None]
    return (m * state.velocities[0]).sum(0), (m * torch.linalg.cross(state.positions[0], state.velocities[0])).sum(0)


def momentum(steps: int | None) -> Iterator[Row]:
    """Beside the change of angular momentum stands what a step balances: the sum of m x' x (v' - v).

    The change has more: h times the sum of m v' x v, by which implicit Euler slows rotation. Linear momentum is over
    that of one cube, angular momentum over that at the start, about the origin.
    """
    usual = [(friction, THICKNESS, iterations) for friction in (0.0, 0.5) for iterations in (ITERATIONS, 512)]
    for friction, thickness, iterations in [*usual, (0.5, 0.5 * THICKNESS, 512)]:
        bodies = [cube(1e5, (-0.056, -0.05, 0.0)), cube(1e5, (0.056, -0.02, 0.013))]
        sim = simulator(*bodies, pd.Contact(friction=friction, thickness=thickness), iterations=iterations)
        velocities = np.repeat([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], sim.vertices // 2, axis=0)
        state: Any = sim.rest_state()
        state.velocities[:] = torch.tensor(velocities)
        p, turn = momenta(sim, state)
        balance, m, residual, force = torch.zeros(3, dtype=torch.float64), sim.masses[:, None], 0.0, 0.0
        before, after = state.velocities[0], state
        for after, info in walk(sim, steps or 30, velocities):
            change = after.velocities[0] - before
            balance = balance + (m * torch.linalg.cross(after.positions[0], change)).sum(0)
            before, residual = after.velocities[0], max(residual, float(info.residual))
            force = max(force, float(after.history.forces[..., 0].sum()))
        p_end, turn_end = momenta(sim, after)
        yield {
            "friction": friction,
            "thickness [mm]": 1e3 * thickness,
            "iterations": iterations,
            "linear, change": float((p_end - p).norm()) / float(m.sum() / 2),
            "angular, balance of steps": float(balance.norm() / turn.norm()),
            "angular, change": float((turn_end - turn).norm() / turn.norm()),
            "largest residual": residual,
            "largest force [N]": force,
        }


def corner(steps: int | None) -> Iterator[Row]:
    """A cube of 4 cells at 2 m/s, without gravity. Errors are over the largest displacement."""
    count = steps or 15
    c, s = math.cos(math.pi / 4), math.sin(math.pi / 4)
    lean, tilt = math.cos(math.atan(math.sqrt(2.0))), math.sin(math.atan(math.sqrt(2.0)))
    spin = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    turn = np.array([[1.0, 0.0, 0.0], [0.0, tilt, lean], [0.0, -lean, tilt]])
    box = pd.shapes.box((SIZE,) * 3, (1,) * 3)
    points = (box.vertices - SIZE / 2) @ (turn @ spin).T
    points = points - points[points[:, 1].argmax()] + [0.013, 0.0, 0.007]
    rigid = pd.Collider(pd.TriMesh(points, box.boundary()))
    for youngs in (1e5, 1e7):
        body = cube(youngs, (0.0, 0.01, 0.0), 4)
        velocities = np.tile([0.0, -2.0, 0.0], (len(body.mesh.vertices), 1))
        ends: dict[int, Tensor] = {}
        for iterations in (SOLVED, 16, 32, 64, 128, 256):
            sim = simulator(body, rigid, pd.Contact(friction=0.3, thickness=THICKNESS), iterations=iterations)
            found = list(walk(sim, count, velocities))
            end = ends[iterations] = found[-1][0].positions
            yield {
                "youngs [Pa]": youngs,
                "iterations": iterations,
                "least contact_gap": min(float(info.contact_gap) for _, info in found),
                "error": largest(end - ends[SOLVED]) / largest(ends[SOLVED] - sim.rest_state().positions),
                "largest residual": max(float(info.residual) for _, info in found),
                "force of the second step [N]": float(found[1][0].history.forces[..., 0].sum()),
                "velocity of the centre [m/s]": float(center(sim, found[-1][0].velocities, slice(None))[1]),
            }


def with_gap(parts: list[Any], thickness: float | None, dtype: torch.dtype = torch.float32) -> pd.Simulator | None:
    """A simulator, or None where it refuses the thickness."""
    scene = pd.Scene(*parts, pd.Contact(thickness=thickness))
    try:
        return pd.Simulator(scene, H, ITERATIONS, dtype=dtype, progress=False)
    except ValueError:
        return None


def sheet(cells: int) -> pd.Cloth:
    """The cloth that `examples/contact_scenes.py --scene drape` lets fall over a ball, if of 28 cells."""
    mesh = pd.shapes.sheet((0.5, 0.5), (cells, cells)).translated((0.0, 0.01, 0.0))
    return pd.Cloth(mesh, youngs=2e5, thickness=5e-4, area_density=0.2, bending=2e-5)


def gap(steps: int | None) -> Iterator[Row]:
    """The least thickness is to 1 % of itself."""
    bodies: list[tuple[str, int, Any]] = [("cube of 10 cm", n, cube(1e6, (0.0, 0.01, 0.0), n)) for n in (2, 4, 8)]
    for name, cells, body in [*bodies, ("cloth of 50 cm", 28, sheet(28))]:
        parts = [body, table(0.6, 0.6), pd.Gravity((0.0, -G, 0.0))]
        usual = with_gap(parts, None, torch.float64)
        assert usual is not None
        assert usual.body_contact is not None
        *_, (state, _) = walk(usual, steps or 60)
        plan = usual.body_contact.plan
        edges = plan.rest[plan.edges]
        low, high = 1e-6, float(plan.thickness)
        while high > 1.01 * low:
            middle = math.sqrt(low * high)
            low, high = (middle, high) if with_gap(parts, middle) is None else (low, middle)
        least = with_gap(parts, high)
        assert least is not None
        *_, (_, info) = walk(least, steps or 60)
        yield {
            "body": name,
            "cells": cells,
            "default thickness [mm]": 1e3 * plan.thickness,
            "gap at rest [mm]": 1e3 * float(state.positions[0, :, 1].min()),
            "longest edge of the scene [mm]": 1e3 * largest(torch.tensor(edges[:, 1] - edges[:, 0])),
            "least thickness in float32 [mm]": 1e3 * high,
            "contact_gap there": float(info.contact_gap),
        }


CASES: dict[str, Callable[[int | None], Iterator[Row]]] = {
    case.__name__: case for case in (stack, angle, stop, momentum, corner, gap)
}


# ---- tables


def cell(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def measure(name: str, steps: int | None) -> list[Row]:
    """Print the rows of a case as a table, each as soon as it is measured."""
    rows: list[Row] = []
    for row in CASES[name](steps):
        shown = {key: value for key, value in row.items() if not isinstance(value, dict)}
        if not rows:
            print(f"\n{name}\n\n| {' | '.join(shown)} |\n|{'---|' * len(shown)}")
        print(f"| {' | '.join(map(cell, shown.values()))} |", flush=True)
        rows.append(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--steps", type=int, help="of every case, at least 2; by default as many as it needs")
    parser.add_argument("--out", type=Path, help="JSON file")
    options = parser.parse_args()
    if options.steps is not None and options.steps < 2:
        parser.error(f"--steps must be at least 2, got {options.steps}")
    rows = {name: measure(name, options.steps) for name in options.cases}
    if options.out:
        write_result(options.out, {**describe_run(torch.device("cpu"), torch.get_num_threads()), "rows": rows})


if __name__ == "__main__":
    main()
