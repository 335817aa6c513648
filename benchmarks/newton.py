"""Iterations and milliseconds of `Newton` and `Multilevel` on a CPU: cloth that folds, a stiff beam, a beam of slabs.

Cloth is that of `effect_scenes.py`; beams are those of `multilevel.py`, with 26 x 6 x 6 and 31 x 7 x 7 vertices. The
step is in float64 from its "inertial" first iterate. The error is |x - x*| / |x_0 - x*|. A step of cloth may have
several minima, so that x* is the result of the solver itself after many iterations, whose residual is printed.
Iterations are a grid of ten in each doubling. Milliseconds are processor time of one thread, the median of three steps.

    python benchmarks/newton.py --out benchmarks/results/newton.json
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from effect_scenes import EFFECT_SCENES
from machine import describe_run, write_result
from multilevel import blocks, box, moved
from torch import Tensor

import torchpd as pd

ERRORS = (1e-1, 1e-2, 1e-3, 1e-6)
COUNTS = sorted({round(2.0 ** (k / 10)) for k in range(112)})  # to 2195
MANY = {"Newton": 500, "Multilevel": 8000}  # iterations of x*
Row = dict[str, Any]
Step = tuple[pd.Scene, pd.State, float]


def cloth(name: str) -> Step:
    scene = EFFECT_SCENES[name]
    return scene.scene(), scene.state(), scene.time_step


SCENES: dict[str, Callable[[], Step]] = {
    "cloth of 31 x 31 vertices, 1e3 N/m": lambda: cloth("cloth 1e3"),
    "cloth of 31 x 31 vertices, 1e4 N/m": lambda: cloth("cloth 1e4"),
    "cloth that buckles over a cube": lambda: cloth("draped"),
    "beam, 1e6 Pa": lambda: (*box(5, 1e6), 1 / 30),
    "beam, 1e8 Pa": lambda: (*box(5, 1e8), 1 / 30),
    "beam of slabs, 1e4 and 1e8 Pa": lambda: (*blocks(6, "slabs", 1e4), 1 / 30),
}


def first_within(sim: pd.Simulator, state: pd.State, solution: Tensor, goals: list[float]) -> list[Row]:
    """Iterations of `COUNTS` that come within each goal [m] of the solution, and their times; those that do."""
    found: list[Row] = []
    for count in COUNTS:
        distance = float((moved(sim, state, count)[0] - solution).norm())
        reached = [goal for goal in goals[len(found) :] if distance <= goal]
        found += [{"iterations": count, "milliseconds": milliseconds(sim, state)} for _ in reached]
        if len(found) == len(goals):
            break
    return found


def milliseconds(sim: pd.Simulator, state: pd.State) -> float:
    times: list[float] = []
    for _ in range(3):
        begin = time.process_time()
        sim(state, start="inertial")
        times.append(1e3 * (time.process_time() - begin))
    return statistics.median(times)


@torch.no_grad()
def run_scene(name: str) -> Row:
    scene, state, time_step = SCENES[name]()
    row: Row = {"scene": name, "solvers": {}}
    for solver in (pd.Newton(), pd.Multilevel()):
        label = type(solver).__name__
        sim = pd.Simulator(scene, time_step, 64, solver, torch.float64, progress=False)
        solution, info = moved(sim, state, MANY[label])
        scale = float((moved(sim, state, 0)[0] - solution).norm())
        found = first_within(sim, state, solution, [error * scale for error in ERRORS])
        row["vertices"] = sim.vertices
        row["solvers"][label] = {"residual of x*": float(info.residual), "reached": found}
        cells = [f"{point['iterations']} it., {point['milliseconds']:.3g} ms" for point in found]
        cells += ["-"] * (len(ERRORS) - len(found))
        print(f"{name}, {label}, residual of x* {float(info.residual):.0e}: " + " | ".join(cells), flush=True)
    return row


def main(words: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--out", type=Path, help="output file (JSON)")
    arguments = parser.parse_args(words)
    torch.set_num_threads(1)
    run = describe_run(torch.device("cpu"), 1)
    rows = [run_scene(name) for name in arguments.scenes]
    if arguments.out:
        write_result(arguments.out, {"schema": 1, **run, "errors": ERRORS, "rows": rows})


if __name__ == "__main__":
    main(sys.argv[1:])
