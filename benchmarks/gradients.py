"""Cost of a gradient beside its step: milliseconds forward and backward.

A held bar swings, float32, time step 1/60 s. The loss is the sum of squares of the new positions, with gradients by the
velocities before. Chebyshev takes 64 guarded iterations, 256 from 1e6 Pa on, and 16 times as many on the two large
meshes of --large; Multilevel takes 16. Times are medians of Python calls with the device awaited; on a GPU forward plus
backward are also timed in a CUDA graph. --adjoint multilevel adds rows of Chebyshev whose gradients use the
preconditioner of Multilevel, on a GPU with kernel "stream". --cells and --youngs choose other bars.

    python benchmarks/gradients.py --threads 1
    python benchmarks/gradients.py --device cuda --threads 16 --large
    python benchmarks/gradients.py --cells 40 15 15 --cells 74 25 25 --youngs 1e5 --adjoint solver multilevel
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from gpu_scenes import GpuScene
from gpu_timing import graph_times
from machine import describe_run, measure, write_result
from tqdm.auto import tqdm

import torchpd as pd

Row = dict[str, Any]

# cells, batch
SCENES = (((3, 3, 3), 1), ((3, 3, 3), 64), ((15, 3, 3), 1), ((15, 3, 3), 64), ((15, 3, 3), 1024), ((9, 9, 9), 64))
LARGE = (((38, 15, 15), 1), ((94, 32, 32), 1))
YOUNGS = (1e4, 1e5, 1e6)
SOLVERS = {"Chebyshev": pd.Chebyshev, "Multilevel": pd.Multilevel}
TIMES = {"forward": "forward ms", "backward": "backward ms", "recorded": "both in a CUDA graph"}


def iterations_of(solver: str, cells: tuple[int, int, int], youngs: float) -> int:
    """Iterations that solve a step to a small error."""
    if solver == "Multilevel":
        return 16
    return (64 if youngs < 1e6 else 256) * (16 if (cells, 1) in LARGE else 1)


def measure_scene(
    cells: tuple[int, int, int],
    batch: int,
    youngs: float,
    solver: str,
    device: torch.device,
    seconds: float,
    adjoint: str = "solver",
) -> Row:
    """Measure one row of the result."""
    scene = GpuScene("bar", cells, batch)
    sim = pd.Simulator(
        scene.build(), 1 / 60, iterations_of(solver, cells, youngs), solver=SOLVERS[solver](), progress=False,
        batch=batch, kernel="stream" if adjoint == "multilevel" and device.type == "cuda" else "auto",
    ).to(device)  # fmt: skip
    sim.set_material(stiffness=sim.stiffness * (youngs / float(sim.stiffness.max())))
    sim.prepare_solver()
    begin = time.perf_counter()
    sim.adjoint = adjoint
    making = time.perf_counter() - begin
    state = scene.start(sim)
    state.velocities.requires_grad_()

    def forward() -> torch.Tensor:
        return sim(state).positions.square().sum()

    def both() -> None:
        torch.autograd.grad(forward(), state.velocities)

    def median(work: Callable[[], object]) -> float:
        return 1e3 * statistics.median(measure(work, device, repetitions=3, seconds=seconds))

    once, all_of_it = median(forward), median(both)
    row = {
        "vertices": sim.vertices, "batch": batch, "youngs": youngs, "solver": solver, "iterations": sim.iterations,
        "kernel": sim.plan.kernel, "forward": once, "backward": all_of_it - once, "recorded": None,
        "adjoint": adjoint, "making": making,
    }  # fmt: skip
    if device.type == "cuda":
        row["recorded"] = 1e3 * statistics.median(graph_times(both, repetitions=3, seconds=seconds))
    return row


def line_of(row: Row) -> str:
    """Format a row."""
    times = " | ".join(f"{row[name]:.3g}" for name in TIMES if row[name] is not None)
    share = row["backward"] / row["forward"]
    solver = row["solver"]
    if row["adjoint"] == "multilevel":
        solver += f", multilevel adjoint made in {row['making']:.2g} s"
    return f"| {row['batch']} x {row['vertices']} | {row['youngs']:.0e} Pa | {solver} | {times} | {share:.2g} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads (%(default)s)")
    parser.add_argument("--seconds", type=float, default=0.5, help="duration of timing a scene (%(default)g)")
    parser.add_argument("--large", action="store_true", help="also 10 and 103 thousand vertices")
    parser.add_argument("--cells", type=int, nargs=3, action="append", help="cells of one bar, instead of the default")
    parser.add_argument("--youngs", type=float, nargs="+", default=YOUNGS, help="Pa (%(default)s)")
    parser.add_argument("--solver", choices=SOLVERS, nargs="+", default=list(SOLVERS), help="(%(default)s)")
    parser.add_argument(
        "--adjoint", choices=("solver", "multilevel"), nargs="+", default=["solver"], help="(%(default)s)"
    )
    parser.add_argument("--out", type=Path, help="output file (JSON)")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    device = torch.device(options.device)
    scenes = SCENES + LARGE if options.large else SCENES
    if options.cells:
        scenes = tuple((tuple(cells), 1) for cells in options.cells)
    jobs = [
        (scene, (youngs, solver), adjoint)
        for scene in scenes
        for youngs in options.youngs
        for solver in options.solver
        for adjoint in options.adjoint
        if solver != "Multilevel" or adjoint == "solver"
    ]
    rows = [
        measure_scene(*scene, *kind, device, options.seconds, adjoint)
        for scene, kind, adjoint in tqdm(jobs, desc="measuring", unit="row", leave=False)
    ]
    heads = [head for name, head in TIMES.items() if rows[0][name] is not None]
    print("| " + " | ".join(["batch x vertices", "Young's modulus", "solver", *heads, "backward / forward"]) + " |")
    print("|---|---|---|" + "---|" * (len(heads) + 1))
    for row in rows:
        print(line_of(row))
    if options.out:
        write_result(options.out, {"schema": 1, **describe_run(device, options.threads), "rows": rows})


if __name__ == "__main__":
    main()
