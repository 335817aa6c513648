"""Measure the speed of a step: `python benchmarks/run.py --help`. benchmarks/README.md explains the result."""

from __future__ import annotations

import argparse
import copy
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gpu import run_on_gpu, with_earlier
from gpu_scenes import GPU_SCENES, QUICK_GPU_SCENES
from machine import aligned, cell, describe_run, measure, milliseconds, multiply_adds_per_second, write_result
from scenes import GOAL_MULTIPLY_ADDS_PER_SECOND, GOAL_THREADS, QUICK_SCENES, SCENES, TIME_STEP, BenchScene
from tqdm.auto import tqdm
from vectorised import VectorisedStep

import torchpd as pd

SCHEMA = 1
TORCH_WORK = 2_000_000  # tet-iterations that suffice to time a step in plain torch

Row = dict[str, Any]


def workspace_bytes(sim: pd.Simulator, batch: int) -> int:
    """CPU memory of one environment during a step, as csrc/cpu/step/workspace.h lays it out (without forces)."""
    plan = sim.plan
    slots = len(plan.slot_vertex)
    # five vectors and two weights per vertex, two vectors per slot; a single environment stores vectors as four numbers
    numbers = 22 * plan.vertices + 8 * slots if batch < 8 else 17 * plan.vertices + 6 * slots
    return (numbers + plan.tet_volume.numel()) * torch.finfo(sim.dtype).bits // 8


def compile_scene(scene: BenchScene, dtype: torch.dtype, device: str) -> tuple[pd.Simulator, Row]:
    """The simulator and its compile time."""
    parts = scene.build()
    values = parts.values()
    begin = time.perf_counter()
    pd.compile_plan(values, dtype=dtype, progress=False)
    plan_seconds = time.perf_counter() - begin
    sim = pd.Simulator(parts, TIME_STEP, scene.iterations, dtype=dtype, progress=False).to(device)
    workspace = workspace_bytes(sim, scene.batch)
    facts = {
        "vertices": sim.vertices,
        "tets": len(values.tets),
        "patches": sim.plan.patches,
        "plan_seconds": plan_seconds,
        "plan_bytes": sim.plan.bytes,
        "workspace_bytes": workspace,
        "bytes_per_vertex": (sim.plan.bytes + workspace) / sim.vertices,
    }
    return sim, facts


def compare_with_goal(scene: BenchScene, dtype: str, rate: float, multiply_adds: float, threads: int) -> Row | None:
    """The goals for this processor, and the fraction reached of the lower one."""
    if dtype not in scene.goals:
        return None
    goal = scene.goals[dtype]
    scale = multiply_adds * threads / (GOAL_MULTIPLY_ADDS_PER_SECOND * GOAL_THREADS)
    return {"least": goal.least * scale, "aim": goal.aim * scale, "share_of_least": rate / (goal.least * scale)}


def measure_torch(sim: pd.Simulator, scene: BenchScene, tets: int, options: argparse.Namespace) -> Row:
    """The same step in plain vectorised torch, with one thread or with all, whichever is faster."""
    iterations = int(np.clip(TORCH_WORK // (tets * scene.batch) // 4 * 4, 4, scene.iterations))
    plain = VectorisedStep(sim.scene, TIME_STEP, iterations, sim.dtype)
    ours = copy.copy(sim)
    ours.iterations = iterations
    state = scene.start(sim)
    row: Row = {
        "iterations": iterations,
        "largest_difference": float((plain(state).positions - ours(state).positions).abs().max()),
    }
    by_threads = {}
    for threads in sorted({1, options.threads}):
        torch.set_num_threads(threads)
        by_threads[threads] = measure(lambda: plain(state), sim.device, repetitions=2, seconds=options.seconds / 2)
    row["threads"], times = min(by_threads.items(), key=lambda item: min(item[1]))
    row["milliseconds"] = milliseconds(times)
    row["tet_iterations_per_second"] = tets * scene.batch * iterations / min(times)
    return row


def measure_scene(scene: BenchScene, dtype: torch.dtype, options: argparse.Namespace) -> Row:
    """Measure one row of the result. Rates come from the fastest run, which was disturbed least."""
    sim, facts = compile_scene(scene, dtype, options.device)
    state = scene.start(sim)
    before = multiply_adds_per_second()
    times = measure(lambda: sim(state), sim.device, repetitions=options.repetitions, seconds=options.seconds)
    after = multiply_adds_per_second()
    work = facts["tets"] * scene.batch * scene.iterations
    rate, multiply_adds = work / min(times), max(before, after)
    precision = str(dtype).removeprefix("torch.")
    row: Row = {
        "scene": scene.name,
        "dtype": precision,
        "batch": scene.batch,
        "iterations": scene.iterations,
        **facts,
        "milliseconds": milliseconds(times),
        "tet_iterations_per_second": rate,
        "tet_iterations_per_second_median": work / statistics.median(times),
        "multiply_adds_per_second": {"before": before, "after": after},
        "multiply_adds_per_tet_iteration": None,
        "goal": None,
        "vectorised_torch": None,
        "speedup": None,
    }
    if sim.device.type == "cpu":
        row["multiply_adds_per_tet_iteration"] = multiply_adds * options.threads / rate
        row["goal"] = compare_with_goal(scene, precision, rate, multiply_adds, options.threads)
        if options.torch:
            row["vectorised_torch"] = measure_torch(sim, scene, facts["tets"], options)
            torch.set_num_threads(options.threads)
            row["speedup"] = rate / row["vectorised_torch"]["tet_iterations_per_second"]
    return row


def measure_calls(options: argparse.Namespace) -> Row:
    """Microseconds of a call with one iteration on one tetrahedron: the overhead beside the work."""
    scene = pd.Scene(pd.Solid(pd.shapes.single_tet(), youngs=1e4))
    sim = pd.Simulator(scene, TIME_STEP, iterations=1).to(options.device)
    state = sim.rest_state()
    calls = {
        "sim(state)": (1, lambda: sim(state)),
        "sim(state, return_info=True)": (1, lambda: sim(state, return_info=True)),
        "sim.step_(state)": (1, lambda: sim.step_(state)),
        "one step of a rollout": (100, lambda: sim.rollout(state, 100, every=100)),
    }
    runs = 10 if options.quick else 500
    return {
        name: 1e6 * statistics.median(measure(call, sim.device, repetitions=runs, seconds=0.0)) / steps
        for name, (steps, call) in calls.items()
    }


def table(rows: list[Row]) -> str:
    """Format the rows as a table."""
    head = ["scene", "dtype", "tets", "batch", "K", "ms median", "ms min", "M tet-it/s", "goal here", "of goal"]
    lines = [[*head, "FMA/tet-it", "x torch", "plan s", "B/vertex"]]
    for row in rows:
        goal = row["goal"] or {"least": None, "share_of_least": None}
        lines.append(
            [
                row["scene"],
                row["dtype"],
                cell(row["tets"], 0),
                cell(row["batch"], 0),
                cell(row["iterations"], 0),
                cell(row["milliseconds"]["median"], 3),
                cell(row["milliseconds"]["min"], 3),
                cell(row["tet_iterations_per_second"], 1, 1e-6),
                cell(goal["least"], 0, 1e-6),
                cell(goal["share_of_least"], 2),
                cell(row["multiply_adds_per_tet_iteration"], 0),
                cell(row["speedup"], 0),
                cell(row["plan_seconds"], 2),
                cell(row["bytes_per_vertex"], 0),
            ]
        )
    return aligned(lines)


def parse(words: list[str]) -> argparse.Namespace:
    """Command-line options, and values derived from them."""
    parser = argparse.ArgumentParser(description="Measure the speed of a step.")
    parser.add_argument("--device", default="cpu", help="cpu, or cuda where the extension has it")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), help="of the CPU")
    parser.add_argument(
        "--only",
        nargs="+",
        metavar="NAME",
        help=f"scenes among {', '.join(scene.name for scene in SCENES)}; an unknown one lists those of a GPU",
    )
    parser.add_argument("--dtype", nargs="+", choices=["float32", "float64"], help="default: both; on a GPU float32")
    parser.add_argument("--no-torch", dest="torch", action="store_false", help="skip the step in plain torch")
    parser.add_argument("--quick", action="store_true", help="tiny scenes, only to check that everything runs")
    parser.add_argument("--heavy", action="store_true", help="on a GPU also the scenes that take minutes to prepare")
    parser.add_argument("--out", type=Path, help="output file (JSON)")
    parser.add_argument("--keep", action="store_true", help="GPU: keep the rows of --out not measured by this run")
    options = parser.parse_args(words)
    options.repetitions, options.seconds = (2, 0.0) if options.quick else (7, 1.0)
    options.on_gpu = torch.device(options.device).type == "cuda"
    options.dtype = options.dtype or (["float32"] if options.on_gpu else ["float32", "float64"])
    scenes: Any = QUICK_SCENES if options.quick else SCENES
    if options.on_gpu:
        scenes = QUICK_GPU_SCENES if options.quick else GPU_SCENES
    if options.on_gpu and not torch.cuda.is_available():
        parser.error("--device: torch finds no CUDA device")
    names = [scene.name for scene in scenes] + ["calls", "paper"] * options.on_gpu
    unknown = set(options.only or ()) - set(names)
    if unknown:
        parser.error(f"--only: must be among {', '.join(names)}, got {', '.join(sorted(unknown))}")
    if options.keep and not (options.on_gpu and options.out):
        parser.error("--keep: needs a GPU and the file of --out")
    wanted = options.only or [s.name for s in scenes if options.heavy or not getattr(s, "heavy", False)]
    options.scenes = [scene for scene in scenes if scene.name in wanted]
    return options


def run_on_cpu(options: argparse.Namespace, result: Row, keep: Callable[[], None]) -> None:
    """Measure everything; store it in the result and print it."""
    result["goals_hold_at"] = {
        "multiply_adds_per_second_per_thread": GOAL_MULTIPLY_ADDS_PER_SECOND,
        "threads": GOAL_THREADS,
    }
    result["call_microseconds"] = measure_calls(options)
    jobs = [(scene, getattr(torch, name)) for name in options.dtype for scene in options.scenes]
    bar = tqdm(jobs, desc="measuring", unit="scene", leave=False)
    result["results"] = []
    for scene, dtype in bar:
        result["results"].append(measure_scene(scene, dtype, options))
        keep()
    print(table(result["results"]))
    print("\nmicroseconds of a call, one iteration on one tetrahedron:")
    print("\n".join(f"  {name}: {value:.1f}" for name, value in result["call_microseconds"].items()))


def main(words: list[str]) -> None:
    options = parse(words)
    torch.set_num_threads(options.threads)
    result = {"schema": SCHEMA, **describe_run(torch.device(options.device), options.threads)}

    def keep() -> None:
        """Write the results so far, so that an interrupted run keeps them."""
        if options.out:
            write_result(options.out, result, with_earlier if options.keep else None)

    (run_on_gpu if options.on_gpu else run_on_cpu)(options, result, keep)
    keep()
    if options.out:
        print(f"written: {options.out}")


if __name__ == "__main__":
    main(sys.argv[1:])
