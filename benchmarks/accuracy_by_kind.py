"""Error of a step against its milliseconds: solids with a Poisson ratio, cloth and rods; with the default and "auto".

Every scene of `effect_scenes.py` takes one step of its motion in float32, from "velocity". The error is
|x - x*| / |x_0 - x*|, against the scene's own converged step in float64. Iterations are a grid of two in each doubling.
The estimate is that of `print(sim)`. Times are processor time on a CPU, and calls with the device awaited on a GPU.

    python benchmarks/accuracy_by_kind.py --out benchmarks/results/accuracy-by-kind-cpu.json
    python benchmarks/accuracy_by_kind.py --device cuda --threads 16 --seconds 0.02 --out FILE
    python benchmarks/accuracy_by_kind.py --draw benchmarks/results/accuracy-by-kind-cpu.json
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from effect_scenes import EFFECT_SCENES
from machine import aligned, describe_run, wait_for, write_result
from tqdm.auto import tqdm

import torchpd as pd
from torchpd.accuracy.error import ExactStep, exact_steps
from torchpd.estimate.convergence import forecast
from torchpd.estimate.solver_choice import runs
from torchpd.scene.solvers import DEFAULT_ITERATIONS, Solver
from torchpd.study.bench import clock_of

GOALS = (1e-1, 1e-2, 1e-3)
CHEBYSHEV = sorted({*(2**k for k in range(3, 13)), *(3 * 2**k for k in range(2, 11))})  # 8 to 4096
MULTILEVEL = [count for count in (1, 2, 3, *CHEBYSHEV) if count <= 256]
Row = dict[str, Any]


def error_of(sim: pd.Simulator, state: pd.State, exact: ExactStep) -> float:
    return exact.position_error((sim(state).velocities[0].double().cpu() * sim.time_step).numpy())


def milliseconds(sim: pd.Simulator, state: pd.State, seconds: float) -> float:
    """Median time of a step."""
    clock, times = clock_of(sim.device), list[float]()
    sim(state)
    while len(times) < 3 or (sum(times) < seconds and len(times) < 50):
        wait_for(sim.device)
        begin = clock()
        sim(state)
        wait_for(sim.device)
        times.append(clock() - begin)
    return 1e3 * statistics.median(times)


def measured(sim: pd.Simulator, state: pd.State, exact: ExactStep, counts: Sequence[int], seconds: float) -> list[Row]:
    """Error and time at each count, up to the first within the smallest of `GOALS` and past the default."""
    points: list[Row] = []
    for count in counts:
        sim.iterations = count
        error = error_of(sim, state, exact)
        points.append({"iterations": count, "error": error, "milliseconds": milliseconds(sim, state, seconds)})
        if error <= GOALS[-1] and count >= DEFAULT_ITERATIONS:
            break
    return points


@torch.no_grad()
def run_scene(name: str, device: torch.device, seconds: float) -> Row:
    """A row: facts of a scene, and the points of each solver that runs on the device."""
    scene = EFFECT_SCENES[name]
    wide = scene.state()
    row: Row = {"scene": name, "title": scene.title, "time_step": scene.time_step}
    sim = scene.simulator(torch.float32, DEFAULT_ITERATIONS)
    exact = exact_steps(sim, wide.to(torch.float32))[0]
    sim = sim.to(device)
    state = wide.to(device, torch.float32)
    row.update(
        vertices=sim.vertices, kernel=sim.plan.kernel, uncertainty=exact.uncertainty,
        rounding=exact.rounding(torch.float32) / exact.scale, default_iterations=sim.iterations, solvers={},
    )  # fmt: skip
    solvers: dict[str, tuple[Solver, list[int]]] = {
        "Chebyshev": (pd.Chebyshev(), CHEBYSHEV),
        "Multilevel": (pd.Multilevel(), MULTILEVEL),
        "Newton": (pd.Newton(), MULTILEVEL),
    }
    for label, (solver, counts) in solvers.items():
        if not runs(solver, sim.compiled):
            continue
        try:
            sim.solver = solver
            points = measured(sim, state, exact, counts, seconds)
        except RuntimeError as refusal:  # no kernels for these elements on this device
            print(f"{name}, {label}: {refusal}")
            continue
        expected = forecast(sim.compiled)
        counted = None if expected is None else [expected.iterations(goal) for goal in GOALS]
        row["solvers"][label] = {"expected": counted, "points": points}
    sim.solver, sim.iterations = pd.Chebyshev(), DEFAULT_ITERATIONS
    row["default"] = {"error": error_of(sim, state, exact), "milliseconds": milliseconds(sim, state, seconds)}
    auto = scene.simulator(torch.float32, None, "auto").to(device)
    row["auto"] = {
        "solver": type(auto.solver).__name__, "iterations": auto.iterations, "error": error_of(auto, state, exact),
        "milliseconds": milliseconds(auto, state, seconds),
    }  # fmt: skip
    return row


def rows_of(name: str, device: torch.device, seconds: float) -> list[Row]:
    """The row of a scene; none, and a line that says why, where the device has no kernels for it."""
    try:
        return [run_scene(name, device, seconds)]
    except RuntimeError as refusal:
        print(f"{name}: {refusal}")
        return []


def first_at(points: list[Row], goal: float) -> Row | None:
    """The first point within an error."""
    return next((point for point in points if point["error"] <= goal), None)


def table(rows: list[Row]) -> str:
    """Table in Markdown: iterations, milliseconds and the estimate for each goal; the default and "auto"."""
    lines = [["scene, solver", *(f"{goal:.0e}" for goal in GOALS), "default: error", '"auto": error']]
    for row in rows:
        for label, own in row["solvers"].items():
            cells = []
            for number, goal in enumerate(GOALS):
                point = first_at(own["points"], goal)
                found = f"{point['iterations']} it., {point['milliseconds']:.2g} ms" if point else "-"
                cells.append(f"{found} ({own['expected'][number]})" if own["expected"] else found)
            auto, plain = row["auto"], row["default"]
            ends = ["", ""]
            if label == "Chebyshev":
                ends[0] = f"{plain['error']:.1g}, {plain['milliseconds']:.2g} ms"
            if label == auto["solver"]:
                ends[1] = f"{auto['error']:.1g}, {auto['iterations']} it., {auto['milliseconds']:.2g} ms"
            lines.append([f"{row['title']}, {label}", *cells, *ends])
    return aligned(lines)


def draw(record: Row, path: Path) -> None:
    """Curves of error over milliseconds, a panel a kind of scene; stars are the default."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullFormatter

    panels: dict[str, list[Row]] = {}
    for row in record["rows"]:
        panels.setdefault(row["scene"].split()[0], []).append(row)
    figure, axes = plt.subplots(
        1, len(panels), figsize=(4 * len(panels), 4), sharey=True, squeeze=False, layout="constrained"
    )
    for place, rows in zip(axes[0], panels.values(), strict=True):
        for number, row in enumerate(rows):
            for label, own in row["solvers"].items():
                across = [point["milliseconds"] for point in own["points"]]
                down = [point["error"] for point in own["points"]]
                style = {"Chebyshev": "-", "Multilevel": "--", "Newton": ":"}[label]
                name = row["title"] if label == "Chebyshev" else None
                place.loglog(across, down, style, color=f"C{number}", label=name)
            place.plot(row["default"]["milliseconds"], row["default"]["error"], "*", color=f"C{number}", markersize=12)
        place.set(xlabel="milliseconds of a step", ylim=(3e-5, 2.0))
        place.xaxis.set_minor_formatter(NullFormatter())
        place.grid(alpha=0.3)
        place.legend(fontsize="small")
    axes[0][0].set_ylabel("error of the step")
    where = record["machine"]["device"] if record["machine"]["device"] != "cpu" else "one CPU core"
    figure.suptitle(f"float32, {where}; dashed: Multilevel; dotted: Newton; stars: the default")
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", choices=EFFECT_SCENES, default=list(EFFECT_SCENES))
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads (%(default)s)")
    parser.add_argument("--seconds", type=float, default=0.05, help="least duration of timing a point (%(default)s)")
    parser.add_argument("--out", type=Path, help="output file (JSON)")
    parser.add_argument("--draw", type=Path, help="measure nothing, draw this file of results beside it")
    options = parser.parse_args()
    if options.draw is not None:
        record = json.loads(options.draw.read_text())
        print(table(record["rows"]))
        draw(record, options.draw.with_suffix(".png"))
        return
    torch.set_num_threads(options.threads)
    device = torch.device(options.device)
    result = describe_run(device, options.threads)
    result["rows"] = []
    for name in tqdm(options.scenes, desc="accuracy", unit="scene"):
        result["rows"] += rows_of(name, device, options.seconds)
    print(table(result["rows"]))
    if options.out is not None:
        write_result(options.out, result)


if __name__ == "__main__":
    main()
