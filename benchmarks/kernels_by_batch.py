"""The fastest GPU kernel for each number of environments, and whether "auto" chooses it.

Bars held at one end swing, with 64 guarded iterations. Times are medians of a CUDA graph of one step, including the
start of the graph. Every kernel that fits is built for the batch, as "auto" builds it. Its times stand beside the
estimates of `torchpd.plan.kernel_costs`.
"""

from __future__ import annotations

import argparse
import math
import re
import statistics
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import torch
from gpu_scenes import GpuScene
from gpu_timing import event_times, recorded
from machine import describe_run, run_of, write_result
from scenes import TIME_STEP
from tqdm.auto import tqdm

import torchpd as pd
from torchpd.common.gpu import properties_of
from torchpd.plan import KERNELS
from torchpd.plan.kernel_costs import iteration_microseconds

Row = dict[str, Any]

# cells
MESHES = ((3, 3, 3), (15, 3, 3), (8, 5, 5), (15, 4, 4), (25, 5, 5), (19, 8, 8), (40, 8, 8), (39, 15, 15), (60, 24, 24))
BATCHES = (1, 2, 4, 8, 16, 32, 64, 132, 264, 1024, 8192)
IRREGULAR = ((3, 3, 3), (15, 4, 4), (9, 9, 9), (40, 8, 8), (39, 15, 15))  # in float32
MOST_TETS = 8_000_000  # over all environments
REPETITIONS = 5


@cache
def built(mesh: str, cells: tuple[int, int, int]) -> pd.Scene:
    """The scene of one environment."""
    return GpuScene("bars", cells, mesh=mesh).build()


def measured(scene: GpuScene, dtype: torch.dtype) -> Row | None:
    """Measured and estimated time of one kernel, and its patches; None if it does not fit."""
    try:
        sim = pd.Simulator(
            built(scene.mesh, scene.cells), TIME_STEP, scene.iterations,
            dtype=dtype, progress=False, kernel=scene.kernel, batch=scene.batch,
        ).to("cuda")  # fmt: skip
    except ValueError as error:
        if re.search("does not fit this GPU|needs thread blocks that reach", str(error)) is None:
            raise
        return None
    state = scene.start(sim)
    graph = recorded(lambda: sim(state), 1)
    seconds = statistics.median(event_times(graph.replay, repetitions=REPETITIONS, seconds=0.0))
    gpu, tets = properties_of(sim.device), sim.stiffness.shape[-1]
    return {
        "patches": sim.plan.patches,
        "microseconds": 1e6 * seconds / scene.iterations,
        "expected": iteration_microseconds(sim.plan, tets, scene.batch, gpu),
    }


def measure_batch(mesh: str, cells: tuple[int, int, int], batch: int, dtype: torch.dtype) -> Row:
    """One row of the result: microseconds per iteration by kernel, and the kernel chosen by "auto"."""
    scene = GpuScene("bars", cells, batch, mesh=mesh)
    sim = pd.Simulator(built(mesh, cells), TIME_STEP, 1, dtype=dtype, progress=False, batch=batch).to("cuda")
    made = {kernel: measured(replace(scene, kernel=kernel), dtype) for kernel in KERNELS}
    fits = {kernel: row for kernel, row in made.items() if row is not None}
    best = min(fits, key=lambda kernel: fits[kernel]["microseconds"])
    return {
        "dtype": str(dtype).removeprefix("torch."),
        "mesh": mesh,
        "vertices": sim.vertices,
        "tets": sim.stiffness.shape[-1],
        "batch": batch,
        "kernels": fits,
        "auto": sim.plan.kernel,
        "quickest": best,
        "auto_takes_longer": fits[str(sim.plan.kernel)]["microseconds"] / fits[best]["microseconds"],
    }


def line_of(row: Row) -> str:
    """Format a row."""
    times = ", ".join(
        f"{kernel} ({own['patches']}) {own['microseconds']:.3g} ({own['expected']:.3g})"
        for kernel, own in row["kernels"].items()
    )
    wrong = f": {row['auto_takes_longer']:.2f} times as long" if row["auto"] != row["quickest"] else ""
    scene = f"{row['dtype']}, {row['mesh']}, {row['batch']} of {row['vertices']:,} vertices"
    return f"{scene}: {times}; auto took {row['auto']}{wrong}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dtype", nargs="*", choices=("float32", "float64"), default=["float32"])
    parser.add_argument("--batches", nargs="*", type=int, default=BATCHES, help="environments")
    parser.add_argument("--most-vertices", type=int, help="skip larger meshes")
    parser.add_argument("--out", type=Path, help="output file (JSON)")
    parser.add_argument("--keep", action="store_true", help="keep the rows of --out that this run does not measure")
    options = parser.parse_args()
    if options.keep and not options.out:
        parser.error("--keep: needs the file of --out")
    if not torch.cuda.is_available():
        parser.error("torch finds no CUDA device")
    meshes = [(name, "regular", cells) for name in options.dtype for cells in MESHES]
    meshes += [("float32", "irregular", cells) for cells in IRREGULAR if "float32" in options.dtype]
    jobs = [
        (mesh, cells, batch, getattr(torch, dtype))
        for dtype, mesh, cells in meshes
        for batch in options.batches
        if batch * len(built(mesh, cells).solids[0].mesh.tets) <= MOST_TETS
        and math.prod(count + 1 for count in cells) <= (options.most_vertices or math.inf)
    ]
    with torch.no_grad():
        rows = [measure_batch(*job) for job in tqdm(jobs, desc="measuring", unit="batch", leave=False)]
    print("microseconds of an iteration by kernel (patches), and the estimate")
    for row in rows:
        print(line_of(row))
    if options.out:
        result = describe_run(torch.device("cuda"), torch.get_num_threads())
        result["rows"] = [{**row, "run": run_of(result)} for row in rows]
        write_result(options.out, result, with_earlier if options.keep else None)


def with_earlier(new: Row, earlier: Row) -> Row:
    """Add the rows of an earlier run that a new one lacks, in the earlier order."""

    def of(row: Row) -> tuple[Any, ...]:
        return row["dtype"], row["mesh"], row["vertices"], row["batch"]

    known = earlier.get("rows", [])
    rows = {of(row): {"run": run_of(earlier), **row} for row in known}
    return {**new, "rows": [*(rows | {of(row): row for row in new["rows"]}).values()]}


if __name__ == "__main__":
    main()
