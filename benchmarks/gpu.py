"""`run.py --device cuda`: rows for the scenes of gpu_scenes.py, the cost of a call, and the tests of the paper."""

from __future__ import annotations

import argparse
import fcntl
import gc
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from gpu_scenes import GPU_SCENES, GpuScene
from gpu_timing import Device, describe_device, event_times, graph_times, host_seconds, kernel_seconds
from machine import PROVENANCE, aligned, cell, milliseconds, run_of
from scenes import TIME_STEP
from tqdm.auto import tqdm

import torchpd as pd
from torchpd.common.gpu import properties_of
from torchpd.plan import KERNELS
from torchpd.study.axes import PAPER_TESTS

Row = dict[str, Any]

ROLLOUT = 16  # steps per call


@contextmanager
def turn(device: torch.device) -> Iterator[None]:
    """Exclusive use of a GPU among processes: parallel runs prepare scenes together, and measure one at a time."""
    with (Path(tempfile.gettempdir()) / f"torchpd-benchmark-{device.index or 0}.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def quantities(scene: GpuScene, tets: int, step: float, twice: float) -> Row:
    """Rates derived from the seconds of a step with K and with 2 K iterations."""
    return {
        "step_microseconds": 1e6 * step,
        "iteration_microseconds": 1e6 * step / scene.iterations,
        "marginal_iteration_microseconds": 1e6 * (twice - step) / scene.iterations,
        "tet_iterations_per_second": tets * scene.batch * scene.iterations / step,
        "environment_steps_per_second": scene.batch / step,
    }


def floors(scene: GpuScene, facts: Row, device: Device, dtype: torch.dtype, step: float) -> Row:
    """Least shares of an iteration's time for instructions and, with the stream kernels, for memory."""
    iteration = step / scene.iterations
    real = torch.finfo(dtype).bits // 8
    single = dtype == torch.float32  # float64 issues other instructions
    moved = device.bandwidth_floor(facts["vertices"], scene.batch, real)
    return {
        "issue": device.issue_floor(facts["tets"], scene.batch) / iteration if single else None,
        "bandwidth": moved / iteration if facts["kernel"] == "stream" else None,
    }


def aims(scene: GpuScene, row: Row, dtype: torch.dtype) -> list[Row]:
    """The goals, and the fraction reached of the lower one; 1 or more is good."""
    if dtype != torch.float32:
        return []
    return [
        {
            "quantity": aim.quantity,
            "must": aim.must,
            "stretch": aim.stretch,
            "share_of_must": aim.share(row[aim.quantity]),
        }
        for aim in scene.aims
    ]


def kernel_on(kernel: str, device: torch.device) -> str:
    """Replace a cluster by a grid on a GPU without clusters."""
    return "grid" if kernel == "cluster" and properties_of(device).cluster == 1 else kernel


def compile_on(scene: GpuScene, dtype: torch.dtype, device: torch.device) -> tuple[pd.Simulator, Row]:
    """The simulator and its compile time; `plan_seconds` covers the CPU's plan and the device's."""
    parts = scene.build()
    gc.collect()
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats(device)
    kernel = kernel_on(scene.kernel, device)
    begin = time.perf_counter()
    sim = pd.Simulator(
        parts, TIME_STEP, scene.iterations, dtype=dtype, progress=False, kernel=kernel, batch=scene.batch
    ).to(device)
    torch.cuda.synchronize(device)
    facts = {
        "kernel": sim.plan.kernel,
        "vertices": sim.vertices,
        "tets": sum(len(body.mesh.tets) for body in parts.solids),
        "patches": sim.plan.patches,
        "plan_seconds": time.perf_counter() - begin,
        "plan_bytes": sim.plan.bytes,
    }
    return sim, facts


def measure_scene(scene: GpuScene, dtype: torch.dtype, machine: Device, options: argparse.Namespace) -> Row:
    """Measure one row of the result; rates come from the median."""
    sim, facts = compile_on(scene, dtype, torch.device(options.device))
    with turn(sim.device):
        row = measure_steps(scene, sim, facts, machine, options)
    return {**row, "run": options.run}


def measure_steps(scene: GpuScene, sim: pd.Simulator, facts: Row, machine: Device, options: argparse.Namespace) -> Row:
    """Times and bytes of the steps."""
    dtype = sim.dtype
    state = scene.start(sim)
    given = {"repetitions": options.repetitions, "seconds": options.seconds}
    eager = event_times(lambda: sim(state), repetitions=options.repetitions, seconds=0.0)
    peak = torch.cuda.max_memory_allocated(sim.device)
    begin = time.perf_counter()
    state.positions.cpu()
    read_back = time.perf_counter() - begin
    times = graph_times(lambda: sim(state), **given)
    rollout = graph_times(lambda: sim.rollout(state, ROLLOUT, ROLLOUT), repetitions=options.repetitions, seconds=0.0)
    sim.iterations = 2 * scene.iterations
    twice = statistics.median(graph_times(lambda: sim(state), **given))
    step = statistics.median(times)
    row: Row = {
        "scene": scene.name,
        "dtype": str(dtype).removeprefix("torch."),
        "mesh": scene.mesh,
        "batch": scene.batch,
        "iterations": scene.iterations,
        **facts,
        "peak_bytes": peak,
        "bytes_per_vertex": peak / (sim.vertices * scene.batch),
        "bytes_per_environment": peak / scene.batch,
        "read_back_milliseconds": 1e3 * read_back,
        "milliseconds": milliseconds(times),
        "eager_milliseconds": milliseconds(eager),
        "rollout_step_microseconds": 1e6 * statistics.median(rollout) / ROLLOUT,
        **quantities(scene, facts["tets"], step, twice),
        "share_of_floor": floors(scene, facts, machine, dtype, step),
    }
    return {**row, "aims": aims(scene, row, dtype)}


def measure_calls(options: argparse.Namespace) -> Row:
    """Microseconds of a call with one iteration on one tetrahedron: host, in a graph, kernels alone."""
    runs = 5 if options.quick else 200
    found: Row = {}
    for kernel in dict.fromkeys(kernel_on(name, torch.device(options.device)) for name in KERNELS):
        scene = pd.Scene(pd.Solid(pd.shapes.single_tet(), youngs=1e4))
        sim = pd.Simulator(scene, TIME_STEP, 1, kernel=kernel, progress=False).to(options.device)
        state = sim.rest_state()
        calls = {
            "sim(state)": (1, lambda sim=sim, state=state: sim(state)),
            "sim.step_(state)": (1, lambda sim=sim, state=state: sim.step_(state)),
            "one step of a rollout": (100, lambda sim=sim, state=state: sim.rollout(state, 100, 100)),
        }
        for name, (steps, call) in calls.items():
            alone = kernel_seconds(call, runs)
            found[f"{kernel}: {name}"] = {
                "host": 1e6 * host_seconds(call, runs) / steps,
                "graph": 1e6 * statistics.median(graph_times(call, repetitions=runs, seconds=0.0)) / steps,
                "kernels": None if alone is None else 1e6 * alone / steps,
            }
    return found


def measure_paper(options: argparse.Namespace) -> list[Row]:
    """Scenes with as many tetrahedra as the paper's have constraints, with 64 iterations."""
    return [measure_test(*test, kernel, options) for test in PAPER_TESTS for kernel in ("block", "cluster")]


def measure_test(
    constraints: int, theirs: float, cells: tuple[int, int, int], kernel: str, options: argparse.Namespace
) -> Row:
    scene = GpuScene(f"paper-{constraints}", cells, kernel=kernel)
    sim, facts = compile_on(scene, torch.float32, torch.device(options.device))
    state = scene.start(sim)
    given = {"repetitions": options.repetitions, "seconds": 0.0}
    milliseconds_here = 1e3 * statistics.median(graph_times(lambda: sim(state), **given))
    return {
        "scene": scene.name,
        "kernel": facts["kernel"],
        "tets": facts["tets"],
        "milliseconds": milliseconds_here,
        "eager_milliseconds": 1e3 * statistics.median(event_times(lambda: sim(state), **given)),
        "constraints_of_the_paper": constraints,
        "milliseconds_of_the_paper": theirs,
        "speedup": theirs / milliseconds_here,
    }


def table(rows: list[Row]) -> str:
    """Format the rows as a table."""
    lines = [
        ["scene", "dtype", "kernel", "tets", "batch", "K", "us/step", "us/it", "marginal", "eager us", "rollout us",
         "G tet-it/s", "k steps/s", "of must", "issue", "bandwidth", "plan s", "peak MB", "B/vertex"]
    ]  # fmt: skip
    for row in rows:
        shares = [aim["share_of_must"] for aim in row["aims"]]
        lines.append(
            [
                row["scene"],
                row["dtype"],
                row["kernel"],
                cell(row["tets"], 0),
                cell(row["batch"], 0),
                cell(row["iterations"], 0),
                cell(row["step_microseconds"], 1),
                cell(row["iteration_microseconds"], 3),
                cell(row["marginal_iteration_microseconds"], 3),
                cell(row["eager_milliseconds"]["median"], 1, 1e3),
                cell(row["rollout_step_microseconds"], 1),
                cell(row["tet_iterations_per_second"], 2, 1e-9),
                cell(row["environment_steps_per_second"], 2, 1e-3),
                " ".join(cell(share, 2) for share in shares) or "-",
                cell(row["share_of_floor"]["issue"], 2),
                cell(row["share_of_floor"]["bandwidth"], 2),
                cell(row["plan_seconds"], 2),
                cell(row["peak_bytes"], 1, 1e-6),
                cell(row["bytes_per_vertex"], 0),
            ]
        )
    return aligned(lines)


def put(rows: list[Row], row: Row) -> None:
    """Insert a row in the order of GPU_SCENES, replacing an earlier one of that scene and precision."""
    names = [scene.name for scene in GPU_SCENES]
    rows[:] = [other for other in rows if (other["scene"], other["dtype"]) != (row["scene"], row["dtype"])]
    rows.append(row)
    rows.sort(key=lambda r: (r["dtype"], names.index(r["scene"]) if r["scene"] in names else -1))


def with_earlier(result: Row, earlier: Row) -> Row:
    """A result, completed with the rows of an earlier one that this run has not measured."""
    whole = {**result, "results": [*earlier.get("results", [])]}
    for row in result["results"]:
        put(whole["results"], row)
    if not result["call_microseconds"]:
        whole.update({name: earlier[name] for name in ("call_microseconds", "call_run") if name in earlier})
    whole["paper"] = result["paper"] or earlier.get("paper", [])
    # each row names its run, since the file may combine several
    return {name: value for name, value in whole.items() if name not in PROVENANCE}


def run_on_gpu(options: argparse.Namespace, result: Row, keep: Callable[[], None]) -> None:
    """Measure everything; store it in the result and print it."""
    device = torch.device(options.device)
    options.run = run_of(result)
    result.update({"call_microseconds": {}, "paper": [], "results": []})
    with torch.no_grad(), torch.cuda.device(device):
        machine = describe_device(device)
        result["device"] = {
            **vars(machine),
            "lane_instructions_per_second": machine.lane_instructions,
            "cuda": torch.version.cuda,
        }
        wanted = options.only or ["calls", *(() if options.quick else ("paper",))]
        with turn(device):
            if "calls" in wanted:
                result["call_microseconds"], result["call_run"] = measure_calls(options), options.run
            if "paper" in wanted:
                result["paper"] = [{**row, "run": options.run} for row in measure_paper(options)]
        keep()
        jobs = [(scene, getattr(torch, name)) for name in options.dtype for scene in options.scenes]
        bar = tqdm(jobs, desc="measuring", unit="scene", leave=False)
        for scene, dtype in bar:
            put(result["results"], measure_scene(scene, dtype, machine, options))
            keep()
    print(table(result["results"]))
    if result["call_microseconds"]:
        print("\nmicroseconds of a call (host, in a graph, kernels alone), one iteration on one tetrahedron:")
    for name, parts in result["call_microseconds"].items():
        print(f"  {name}: " + ", ".join(cell(part, 1) for part in parts.values()))
    for row in result["paper"]:
        print(
            f"  {row['scene']} ({row['tets']} tets, {row['kernel']}): {row['milliseconds']:.3f} ms a step, "
            f"the paper {row['milliseconds_of_the_paper']:.0f} ms"
        )
