"""Benchmark of the multilevel solver: iterations to an error and their time, on boxes and on your own mesh.

Boxes have 5r x r x r cells (1 x 0.2 x 0.2 m, six tetrahedra per cell). They are held at x = 0 and thrown with
v_y = -10 x^2; time step 1/30 s, float64, start "inertial". The error is |x - x*| / |x_0 - x*|. x* is the solver's
result after 400 iterations, whose residual is printed. A mesh is held at its lowest part and thrown sideways; its
stiffness is random per tetrahedron over 1e4..1e6 Pa.

With --blocks the box has 1e4 Pa and contains stiffer pieces: five slabs across it, or a grid of cubes. Milliseconds are
processor time of one thread.

    python benchmarks/multilevel.py --cells 11 26 --youngs 1e6 1e8
    python benchmarks/multilevel.py --mesh bunny.mesh
    python benchmarks/multilevel.py --blocks 12 16

You may combine these, as results/multilevel.json does, which records its command.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from machine import describe_run, write_result
from torch import Tensor

import torchpd as pd
from torchpd.common.tables import PLAN_TABLE

ERRORS = (1e-2, 1e-3, 1e-4)
OUTERS: tuple[Literal["lbfgs", "momentum"], ...] = ("lbfgs", "momentum")
MOST = 160
CHEBYSHEV = 512

Row = dict[str, Any]


def box(cells: int, youngs: float) -> tuple[pd.Scene, pd.State]:
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (5 * cells, cells, cells))
    solid = pd.Solid(mesh, youngs=youngs, density=1000.0)
    scene = pd.Scene(solid, pd.Pin(solid, mesh.vertices[:, 0] == 0.0), pd.Gravity((0.0, -9.8, 0.0)))
    x = torch.tensor(mesh.vertices)
    v = torch.zeros_like(x)
    v[:, 1] = -10.0 * x[:, 0] ** 2
    return scene, pd.State(x[None], v[None])


def blocks(cells: int, kind: str, contrast: float) -> tuple[pd.Scene, pd.State]:
    """Slabs of 0.1 m, or cubes of a third to two thirds of that, every 0.2 or 0.1 m; 6, 8, 10 ... cells across."""
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (5 * cells, cells, cells))
    cell = np.floor(mesh.vertices[mesh.tets].mean(axis=1) * 5 * cells).astype(int)
    each = cells // 2  # cells per slab
    slabs, inner = cell // each % 2 == 1, np.abs(cell % each - (each - 1) / 2) < 0.3 * each
    stiff = slabs[:, 0] if kind == "slabs" else inner.all(axis=1)
    solid = pd.Solid(mesh, youngs=np.where(stiff, 1e4 * contrast, 1e4), density=1000.0)
    scene = pd.Scene(solid, pd.Pin(solid, mesh.vertices[:, 0] == 0.0), pd.Gravity((0.0, -9.8, 0.0)))
    x = torch.tensor(mesh.vertices)
    v = torch.zeros_like(x)
    v[:, 1] = -10.0 * x[:, 0] ** 2
    return scene, pd.State(x[None], v[None])


def loaded(path: str) -> tuple[pd.Scene, pd.State]:
    mesh = pd.TetMesh.from_file(path)
    low, size = mesh.vertices.min(axis=0), np.ptp(mesh.vertices, axis=0)
    up = int(np.argmax(size))
    height = (mesh.vertices[:, up] - low[up]) / size[up]
    stiffness = 10.0 ** np.random.default_rng(0).uniform(4.0, 6.0, len(mesh.tets))
    solid = pd.Solid(mesh, youngs=stiffness, density=1000.0)
    x = torch.tensor(mesh.vertices)
    v = torch.zeros_like(x)
    v[:, (up + 1) % 3] = torch.tensor(10.0 * size[up] * height**2)
    return pd.Scene(solid, pd.Pin(solid, height < 0.05), pd.Gravity((0.0, -9.8, 0.0))), pd.State(x[None], v[None])


def moved(sim: pd.Simulator, state: pd.State, iterations: int) -> tuple[Tensor, pd.Info]:
    """Displacement and info of a step; computed from the velocity, which keeps more digits."""
    sim.iterations = iterations
    after, info = sim(state, start="inertial", return_info=True)
    return after.velocities * sim.time_step, info


def fewest(sim: pd.Simulator, state: pd.State, solution: Tensor, goals: list[float]) -> list[int]:
    """Fewest iterations within each goal of the distance from the solution, up to MOST."""
    found: list[int] = []
    for count in range(1, MOST + 1):
        distance = float((moved(sim, state, count)[0] - solution).norm())
        found += [count for goal in goals[len(found) :] if distance <= goal]
        if len(found) == len(goals):
            break
    return found


def measure(name: str, scene: pd.Scene, state: pd.State) -> Row:
    """Iterations to each error, printed and returned."""
    sim = pd.Simulator(scene, 1 / 30, 64, dtype=torch.float64, progress=False)
    start = time.perf_counter()
    sim.solver = pd.Multilevel()
    setup = time.perf_counter() - start
    solution, info = moved(sim, state, 400)
    own = sum(array.numel() * array.element_size() for array in sim.plan.arrays[len(PLAN_TABLE) :])
    print(f"{name}: {sim.vertices} vertices, set-up {setup:.2f} s, {own / 1e6:.1f} MB, "
          f"residual of x* {float(info.residual):.0e}")  # fmt: skip
    scale = float((moved(sim, state, 0)[0] - solution).norm())
    row = {
        "kind": "steps", "scene": name, "vertices": sim.vertices, "threads": torch.get_num_threads(), "most": MOST,
        "setup_seconds": setup, "bytes": own, "residual_of_the_solution": float(info.residual), "iterations": {},
        "taken_back": {},
    }  # fmt: skip
    for outer in OUTERS:
        sim.solver = pd.Multilevel(outer)
        counts = fewest(sim, state, solution, [error * scale for error in ERRORS])
        failed = int(moved(sim, state, counts[-1] if counts else MOST)[1].restarts)
        row["iterations"][outer], row["taken_back"][outer] = counts, failed
        columns = [str(count) for count in counts] + [f"> {MOST}"] * (len(ERRORS) - len(counts))
        print(f"    {outer:<10}" + "".join(f"{column:>8}" for column in columns) + f"   trials taken back: {failed}")
    sim.solver = pd.Chebyshev()
    left = float((moved(sim, state, CHEBYSHEV)[0] - solution).norm()) / scale
    print(f"    {CHEBYSHEV} iterations of guarded Chebyshev leave {left:.1e}")
    return {**row, "chebyshev_leaves": left}


def measure_blocks(name: str, scene: pd.Scene, state: pd.State) -> Row:
    """Iterations to each error, and milliseconds of a step with so many."""
    sim = pd.Simulator(scene, 1 / 30, 64, pd.Multilevel(), torch.float64, progress=False)
    solution, info = moved(sim, state, 400)
    print(f"{name}: {sim.vertices} vertices, residual of x* {float(info.residual):.0e}")
    scale = float((moved(sim, state, 0)[0] - solution).norm())
    counts, times = fewest(sim, state, solution, [error * scale for error in ERRORS]), list[float]()
    for sim.iterations in counts:
        start = time.process_time()
        sim(state, start="inertial")
        times.append(1e3 * (time.process_time() - start))
    columns = [f"{count} it., {took:.0f} ms" for count, took in zip(counts, times, strict=True)]
    columns += [f"> {MOST} it."] * (len(ERRORS) - len(counts))
    print("    " + "".join(f"{column:>18}" for column in columns))
    return {
        "kind": "blocks", "scene": name, "vertices": sim.vertices, "threads": torch.get_num_threads(), "most": MOST,
        "residual_of_the_solution": float(info.residual), "iterations": counts, "milliseconds": times,
    }  # fmt: skip


def measured(arguments: argparse.Namespace) -> Iterator[Row]:
    """Yield all requested rows."""
    for path in arguments.mesh:
        yield measure(Path(path).name, *loaded(path))
    others = arguments.mesh or arguments.blocks
    for cells in arguments.cells or ([] if others else [11]):
        for youngs in arguments.youngs:
            yield measure(f"box {cells}, {youngs:g} Pa", *box(cells, youngs))
    for cells in arguments.blocks:
        torch.set_num_threads(1)
        for kind in ("slabs", "cubes"):
            for contrast in arguments.contrasts:
                yield measure_blocks(f"box {cells}, {kind} at {contrast:g}", *blocks(cells, kind, contrast))


def main(words: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, nargs="+", help="r of the boxes (11 if nothing else is requested)")
    parser.add_argument("--youngs", type=float, nargs="+", default=[1e6, 1e8], help="Young's moduli of the boxes [Pa]")
    parser.add_argument("--mesh", nargs="+", default=[], help="tetrahedral meshes")
    parser.add_argument("--blocks", type=int, nargs="+", default=[], help="even r >= 6 of boxes with stiff pieces")
    parser.add_argument("--contrasts", type=float, nargs="+", default=[1e2, 1e4, 1e6], help="of these pieces")
    parser.add_argument("--out", type=Path, help="output file (JSON)")
    arguments = parser.parse_args(words)
    run = describe_run(torch.device("cpu"), torch.get_num_threads())
    rows = list(measured(arguments))
    if arguments.out:
        write_result(arguments.out, {"schema": 1, **run, "errors": ERRORS, "rows": rows})


if __name__ == "__main__":
    main(sys.argv[1:])
