"""Measure the speed of a step: python benchmarks/run.py --help; README.md in this folder says how to read the result."""

from __future__ import annotations

import argparse
import copy
import datetime
import json
import os
import platform
import shlex
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scenes import GOAL_MULTIPLY_ADDS_PER_SECOND, GOAL_THREADS, QUICK_SCENES, SCENES, TIME_STEP, BenchScene
from tqdm import tqdm
from vectorised import VectorisedStep

import torchpd as pd
from torchpd import _C

SCHEMA = 1
TORCH_WORK = 2_000_000  # tet-iterations after which a step in plain torch has been measured well enough

Row = dict[str, Any]


def multiply_adds_per_second() -> float:
    """Of one thread: the calibration of the goals."""
    return max(_C.multiply_adds_per_second() for _ in range(3))


def measure(work: Callable[[], object], device: torch.device, *, repetitions: int, seconds: float) -> list[float]:
    """Seconds of at least so many runs, and until so much time has passed; the first run is not counted."""
    times: list[float] = []
    for run in range(100_000):
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        begin = time.perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        if run:
            times.append(time.perf_counter() - begin)
        if len(times) >= repetitions and sum(times) >= seconds:
            break
    return times


def summary(times: list[float]) -> dict[str, float]:
    """Times in milliseconds."""
    return {"median": 1e3 * statistics.median(times), "min": 1e3 * min(times), "repetitions": len(times)}


def workspace_bytes(sim: pd.Simulator, batch: int) -> int:
    """Memory of one environment while it steps on the CPU (csrc/cpu/workspace.h), without forces."""
    plan = sim.plan
    slots = len(plan.slot_vertex)
    # five vectors and two weights a vertex, two vectors a slot; alone, a vector takes four numbers
    numbers = 22 * plan.vertices + 8 * slots if batch < 8 else 17 * plan.vertices + 6 * slots
    return (numbers + plan.tet_volume.numel()) * torch.finfo(sim.dtype).bits // 8


def compile_scene(scene: BenchScene, dtype: torch.dtype, device: str) -> tuple[pd.Simulator, Row]:
    """The simulator, and what it took to compile it."""
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
    """Goals scaled to this processor, and the share of the lower one that was reached."""
    goal = scene.goals.get(dtype)
    if goal is None:
        return None
    scale = multiply_adds * threads / (GOAL_MULTIPLY_ADDS_PER_SECOND * GOAL_THREADS)
    return {"least": goal.least, "aim": goal.aim, "scale": scale, "share_of_least": rate / (goal.least * scale)}


def measure_torch(sim: pd.Simulator, scene: BenchScene, options: argparse.Namespace) -> Row:
    """The same step in plain vectorised torch, with one thread and with all, whichever is faster."""
    tets = sim.plan.tet_order.numel() * scene.batch
    iterations = int(np.clip(TORCH_WORK // tets // 4 * 4, 4, scene.iterations))
    plain = VectorisedStep(sim.scene, TIME_STEP, iterations, sim.dtype)
    state = scene.start(sim)
    same = copy.copy(sim)
    same.iterations = iterations
    difference = float((plain(state).positions - same(state).positions).abs().max())
    best: Row = {}
    for threads in sorted({1, options.threads}):
        torch.set_num_threads(threads)
        times = measure(lambda: plain(state), sim.device, repetitions=2, seconds=options.seconds)
        if not best or min(times) < best["milliseconds"]["min"] / 1e3:
            best = {"threads": threads, "iterations": iterations, "milliseconds": summary(times)}
    torch.set_num_threads(options.threads)
    count = int((sim.plan.tet_volume > 0).sum()) * scene.batch * iterations
    best["tet_iterations_per_second"] = count / best["milliseconds"]["min"] * 1e3
    best["largest_difference"] = difference
    return best


def measure_scene(scene: BenchScene, dtype: torch.dtype, options: argparse.Namespace) -> Row:
    """One row of the result."""
    sim, facts = compile_scene(scene, dtype, options.device)
    state = scene.start(sim)
    before = multiply_adds_per_second()
    times = measure(lambda: sim(state), sim.device, repetitions=options.repetitions, seconds=options.seconds)
    after = multiply_adds_per_second()
    work = facts["tets"] * scene.batch * scene.iterations
    rate = work / min(times)
    precision = str(dtype).removeprefix("torch.")
    row: Row = {
        "scene": scene.name,
        "dtype": precision,
        "batch": scene.batch,
        "iterations": scene.iterations,
        **facts,
        "milliseconds": summary(times),
        "tet_iterations_per_second": rate,
        "tet_iterations_per_second_median": work / statistics.median(times),
        "multiply_adds_per_second": {"before": before, "after": after},
        "multiply_adds_per_tet_iteration": max(before, after) * options.threads / rate,
        "goal": None,
        "vectorised_torch": None,
    }
    if sim.device.type == "cpu":
        row["goal"] = compare_with_goal(scene, precision, rate, max(before, after), options.threads)
        if options.torch:
            row["vectorised_torch"] = measure_torch(sim, scene, options)
            row["speedup"] = rate / row["vectorised_torch"]["tet_iterations_per_second"]
    return row


def measure_calls(options: argparse.Namespace) -> Row:
    """What a call costs apart from the work: one iteration on one tetrahedron, in microseconds."""
    sim = pd.Simulator(pd.Scene(pd.Solid(pd.shapes.single_tet(), youngs=1e4)), TIME_STEP, 1).to(options.device)
    state = sim.rest_state()
    calls = {
        "sim(state)": (1, lambda: sim(state)),
        "sim(state, return_info=True)": (1, lambda: sim(state, return_info=True)),
        "sim.step_(state)": (1, lambda: sim.step_(state)),
        "step of sim.rollout": (100, lambda: sim.rollout(state, 100, every=100)),
    }
    runs = max(options.repetitions, int(400 * options.seconds))
    return {
        name: 1e6 * statistics.median(measure(call, sim.device, repetitions=runs, seconds=0.0)) / steps
        for name, (steps, call) in calls.items()
    }


def cpu_name() -> str:
    """The name that the processor gives itself."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def git_commit() -> str:
    """Of the working tree; "+" when it has changes, "unknown" outside of a repository."""

    def ask(*words: str) -> str:
        answer = subprocess.run(["git", *words], cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
        return answer.stdout.strip()

    try:
        return ask("rev-parse", "HEAD") + ("+" if ask("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def describe_run(options: argparse.Namespace) -> Row:
    """Where the numbers come from."""
    build = _C.build_info()
    device = torch.device(options.device)
    return {
        "schema": SCHEMA,
        "command": shlex.join(["python", "benchmarks/run.py", *sys.argv[1:]]),
        "created": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        "commit": git_commit(),
        "machine": {
            "cpu": cpu_name(),
            "logical_cores": os.cpu_count(),
            "threads": options.threads,
            "simd": build["simd"],
            "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
            "platform": platform.platform(),
        },
        "versions": {
            "torchpd": pd.__version__,
            "torch": torch.__version__,
            "python": platform.python_version(),
            "numpy": np.__version__,
            "compiler": build["compiler"],
        },
        "goal_machine": {
            "multiply_adds_per_second_per_thread": GOAL_MULTIPLY_ADDS_PER_SECOND,
            "threads": GOAL_THREADS,
            "meaning": "goals hold where a thread does so many float32 multiply-adds; others are scaled by their own rate",
        },
        "vectorised_torch": "benchmarks/vectorised.py: CSR gather and scatter, FOAM rotations on planes [tets, batch]",
    }


def table(rows: list[Row]) -> str:
    """The rows for a reader."""
    head = ("scene", "dtype", "tets", "batch", "K", "ms (median)", "ms (min)", "M tet-it/s", "goal here", "of goal")
    head += ("FMA/tet-it", "x torch", "plan s", "B/vertex")
    lines = [head]
    for row in rows:
        goal, plain = row["goal"], row["vectorised_torch"]
        lines.append(
            (
                row["scene"],
                row["dtype"],
                f"{row['tets']:,}",
                str(row["batch"]),
                str(row["iterations"]),
                f"{row['milliseconds']['median']:.3f}",
                f"{row['milliseconds']['min']:.3f}",
                f"{row['tet_iterations_per_second'] / 1e6:.1f}",
                f"{goal['least'] * goal['scale'] / 1e6:.0f}" if goal else "-",
                f"{goal['share_of_least']:.2f}" if goal else "-",
                f"{row['multiply_adds_per_tet_iteration']:.0f}",
                f"{row['speedup']:.0f}" if plain else "-",
                f"{row['plan_seconds']:.2f}",
                f"{row['bytes_per_vertex']:.0f}",
            )
        )
    widths = [max(len(line[column]) for line in lines) for column in range(len(head))]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in lines)


def parse(words: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Measure the speed of a step.")
    parser.add_argument("--device", default="cpu", help="cpu, or cuda where the extension has it")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), help="of the CPU")
    parser.add_argument("--only", nargs="+", metavar="NAME", help=f"of {', '.join(scene.name for scene in SCENES)}")
    parser.add_argument("--dtype", nargs="+", default=["float32", "float64"], choices=["float32", "float64"])
    parser.add_argument("--no-torch", dest="torch", action="store_false", help="leave out the step in plain torch")
    parser.add_argument("--quick", action="store_true", help="tiny scenes, to see that everything runs")
    parser.add_argument("--out", type=Path, help="file for the result, JSON")
    options = parser.parse_args(words)
    options.repetitions, options.seconds = (2, 0.0) if options.quick else (7, 1.0)
    scenes = QUICK_SCENES if options.quick else SCENES
    unknown = set(options.only or ()) - {scene.name for scene in scenes}
    if unknown:
        parser.error(f"--only: no scene {', '.join(sorted(unknown))}; there are {', '.join(s.name for s in scenes)}")
    options.scenes = [scene for scene in scenes if not options.only or scene.name in options.only]
    return options


def main(words: list[str]) -> None:
    options = parse(words)
    torch.set_num_threads(options.threads)
    jobs = [(scene, getattr(torch, name)) for name in options.dtype for scene in options.scenes]
    result = describe_run(options)
    result["call_microseconds"] = measure_calls(options)
    result["results"] = [measure_scene(*job, options) for job in tqdm(jobs, desc="measuring", unit="scene")]
    print(table(result["results"]))
    print("\nmicroseconds a call on one tetrahedron, one iteration:")
    print("\n".join(f"  {name}: {value:.1f}" for name, value in result["call_microseconds"].items()))
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(result, indent=1) + "\n")
        print(f"written: {options.out}")


if __name__ == "__main__":
    main(sys.argv[1:])
