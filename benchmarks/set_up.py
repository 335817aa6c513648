"""Set-up times of large boxes: what a `Simulator` does before its first step, in seconds and in processor time.

Boxes have 5r x r x r cells (1 x 0.2 x 0.2 m, six tetrahedra per cell) and are held at x = 0, in float32. The stages:

    simulator   Simulator(scene): the scene's arrays, their checks and the plan for the CPU
    levels      sim.solver = Multilevel(): the preconditioner
    gpu plan    the plan for the kernel "stream" of an H100, compiled on the CPU
    gpu levels  the plan for Multilevel on an H100, and the preconditioner with smoothing folded in

Bytes are those of the CPU plan, and of `Multilevel` beside it. Processor time of all threads together stays the same
where other programs take the cores; seconds do not.

    python benchmarks/set_up.py --cells 58 --plans 92
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import torch
from machine import describe_run, write_result

import torchpd as pd
from torchpd.common.gpu import H100
from torchpd.common.tables import PLAN_TABLE
from torchpd.plan.kernel_choice import choose_plan
from torchpd.plan.preconditioner import precondition_plan, stored_reference

Row = dict[str, Any]
Made = TypeVar("Made")


def processor_seconds() -> float:
    """Time of all threads so far, in the system too."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def timed(row: Row, stage: str, work: Callable[[], Made]) -> Made:
    """The result of the work; its times go into the row."""
    wall, processor = time.perf_counter(), processor_seconds()
    made = work()
    times = {"seconds": time.perf_counter() - wall, "processor_seconds": processor_seconds() - processor}
    row["stages"][stage] = times
    print(f"    {stage:<10}{times['seconds']:8.2f} s{times['processor_seconds']:8.2f} s of processors", flush=True)
    return made


def set_up(cells: int, levels: bool) -> Row:
    """Times of a box; `levels`: those of `Multilevel` too."""
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (5 * cells, cells, cells))
    solid = pd.Solid(mesh, youngs=1e6, density=1000.0)
    scene = pd.Scene(solid, pd.Pin(solid, mesh.vertices[:, 0] == 0.0), pd.Gravity((0.0, -9.8, 0.0)))
    print(f"{len(mesh.vertices)} vertices, {len(mesh.tets)} tetrahedra, {torch.get_num_threads()} threads")
    row: Row = {
        "cells": cells, "vertices": len(mesh.vertices), "tets": len(mesh.tets), "threads": torch.get_num_threads(),
        "stages": {},
    }  # fmt: skip
    sim = timed(row, "simulator", lambda: pd.Simulator(scene, 1 / 30, 16, progress=False))
    values = scene.values()
    timed(row, "gpu plan", lambda: choose_plan(values, torch.float32, H100, "stream", progress=False))
    if levels:
        timed(row, "levels", lambda: setattr(sim, "solver", pd.Multilevel()))
        levels_bytes = sum(array.numel() * array.element_size() for array in sim.plan.arrays[len(PLAN_TABLE) :])
        row["bytes"] = {"plan": sim.plan.bytes - levels_bytes, "levels": levels_bytes}
        print(f"    {levels_bytes / 1e6:.1f} MB of levels beside a plan of {row['bytes']['plan'] / 1e6:.1f} MB")
        reference = stored_reference(sim.plan.arrays)

        def gpu_levels() -> None:
            plan = choose_plan(values, torch.float32, H100, levels=True, progress=False)
            precondition_plan(plan, values, *reference)

        timed(row, "gpu levels", gpu_levels)
    return row


def measured(arguments: argparse.Namespace) -> Iterator[Row]:
    """Yield all requested rows."""
    for cells in arguments.cells:
        yield set_up(cells, levels=True)
    for cells in arguments.plans:
        yield set_up(cells, levels=False)


def main(words: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, nargs="+", default=[], help="r of boxes with all stages")
    parser.add_argument("--plans", type=int, nargs="+", default=[], help="r of boxes without Multilevel")
    parser.add_argument("--out", type=Path, help="output file (JSON)")
    arguments = parser.parse_args(words)
    if not arguments.cells + arguments.plans:
        parser.error("give --cells or --plans, such as --cells 58 --plans 92")
    run = describe_run(torch.device("cpu"), torch.get_num_threads())
    rows = list(measured(arguments))
    if arguments.out:
        write_result(arguments.out, {"schema": 1, **run, "rows": rows})


if __name__ == "__main__":
    main(sys.argv[1:])
