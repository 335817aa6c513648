"""Time of a step to an error of 1e-3: Multilevel against guarded Chebyshev on one device, and the choice of "auto".

The beam of `python -m torchpd study beam`: 1 x 0.2 x 0.2 m, held at x = 0, thrown downwards with v_y = -10 x^2, time
step 1/30 s, float32, start "velocity". The error is |x - x*| / |x_0 - x*|. x* is the converged step in float64 by
Multilevel on the CPU, run until its residual stops falling; rows contain the error bound from that residual. Iterations
are found by doubling and bisection to a sixteenth, up to a limit named in each row. Failures stay in the table.

Times are the lowest and the median of steps in turns. With one CPU thread they are processor time; on a GPU they are
Python calls with the device awaited. With --batch that many equal environments take the step together. Measured cases
are kept, with their run: an interrupted run resumes.

    python benchmarks/time_to_error.py --device cpu
    python benchmarks/time_to_error.py --device cuda --threads 16
    python benchmarks/time_to_error.py --device cuda --threads 16 --batch 1024 --sizes 256 1k
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from machine import describe_run, earlier_rows, run_of, wait_for, write_result
from tqdm.auto import tqdm

import torchpd as pd
from torchpd.accuracy.error import problem_of
from torchpd.estimate.convergence import forecast
from torchpd.estimate.solver_choice import CPU_CHEBYSHEV, Cost, multilevel_cost
from torchpd.scene.solvers import Solver
from torchpd.study.bench import clock_of
from torchpd.study.scenes import STUDY_SCENES

SIZES = {"256": 3, "1k": 5, "3k": 8, "10k": 12, "30k": 18, "100k": 26}  # cells across
ALONE = [size for size in SIZES if size != "256"]  # default; the smallest is measured in batches
YOUNGS = (1e4, 1e5, 1e6, 1e7, 1e8)  # Pa
MOST = {**dict.fromkeys(SIZES, 8192), "100k": 4096}  # iterations; up to thirty seconds per step
ERROR = 1e-3
SOLVERS: dict[str, Solver] = {"Chebyshev": pd.Chebyshev(), "Multilevel": pd.Multilevel()}
REFERENCE_ITERATIONS = 100  # between two checks of the residual
Row = dict[str, Any]
Rows = dict[tuple[str, float, int], Row]  # by size, Young's modulus and batch


class Case:
    """One beam on one device, its converged step, and the error of any result."""

    def __init__(
        self, cells: int, youngs: float, device: torch.device, dtype: torch.dtype = torch.float32, batch: int = 1
    ) -> None:
        studied = STUDY_SCENES["beam"]()
        self.scene = studied.scene(studied.mesh(cells), youngs)
        self.time_step = studied.time_step
        self.batch = batch
        wide = self.simulator(torch.float64, torch.device("cpu"), pd.Multilevel())
        start = pd.State(*(part.float() for part in studied.start(wide)))
        self.solution, self.uncertainty = converged(wide, pd.State(*(part.double() for part in start)))
        self.sim = self.simulator(dtype, device, pd.Chebyshev())
        self.state = pd.State(*(part.to(device, dtype).repeat(batch, 1, 1) for part in start))
        self.first = start.velocities[0].double() * self.time_step

    def simulator(self, dtype: torch.dtype, device: torch.device, solver: Solver) -> pd.Simulator:
        sim = pd.Simulator(self.scene, self.time_step, 64, solver, dtype, batch=self.batch, progress=False)
        return sim.to(device)

    def error(self, solver: Solver, iterations: int) -> float:
        self.sim.solver, self.sim.iterations = solver, iterations
        reached = self.sim(self.state).velocities[0].double().cpu() * self.time_step
        found = float((reached - self.solution).norm() / (self.first - self.solution).norm())
        return found if np.isfinite(found) else float("inf")


@torch.no_grad()
def converged(sim: pd.Simulator, state: pd.State) -> tuple[torch.Tensor, float]:
    """u* [V, 3] m in float64, and |grad E| / min m/h^2 / |u_0 - u*|, which bounds its error for stable elements."""
    sim.iterations, guess = REFERENCE_ITERATIONS, "velocity"
    best, lowest = state.velocities, np.inf
    for _ in range(20):
        after, info = sim(state, start=guess, return_info=True)
        residual = float(info.residual)
        if not residual < 0.5 * lowest:
            break
        best, lowest, guess = after.velocities, residual, after.positions
    problem = problem_of(sim, state)
    solution = best[0] * sim.time_step
    left = float(np.linalg.norm(problem.residual(solution.numpy())))
    scale = float((state.velocities[0] * sim.time_step - solution).norm())
    return solution, left / float(problem.weight[problem.free].min()) / scale


def fewest(case: Case, solver: Solver, most: int) -> tuple[int | None, float]:
    """Iterations to `ERROR` and the error there; None and the error after `most` if they are not enough."""
    high, reached = 8, case.error(solver, 8)
    while reached > ERROR:
        if high >= most:
            return None, reached
        high = min(2 * high, most)
        reached = case.error(solver, high)
    low = high // 2 if high > 8 else 0
    while high - low > max(1, high // 16):
        middle = (low + high) // 2
        left = case.error(solver, middle)
        low, high, reached = (low, middle, left) if left <= ERROR else (middle, high, reached)
    return high, reached


@torch.no_grad()
def milliseconds(case: Case, solvers: dict[str, tuple[Solver, int]], seconds: float) -> Row:
    """Time a step of each solver in turns, under equal load of the machine."""
    clock, device = clock_of(case.sim.device), case.sim.device
    times: dict[str, list[float]] = {name: [] for name in solvers}
    sims = {}
    for name, (solver, iterations) in solvers.items():
        sims[name] = case.simulator(case.sim.dtype, device, solver)
        sims[name].iterations = iterations
        sims[name](case.state)
    while len(min(times.values(), key=len)) < 3 or sum(map(sum, times.values())) < seconds:
        for name, sim in sims.items():
            wait_for(device)
            begin = clock()
            sim(case.state)
            wait_for(device)
            times[name].append(clock() - begin)
        if len(min(times.values(), key=len)) >= 50:
            break
    return {name: {"min": 1e3 * min(t), "median": 1e3 * statistics.median(t)} for name, t in times.items()}


@torch.no_grad()
def run_case(
    size: str, youngs: float, device: torch.device, seconds: float, dtype: torch.dtype = torch.float32, batch: int = 1
) -> Row:
    """Iterations, errors and times of both solvers and of the choice of "auto"."""
    case, most = Case(SIZES[size], youngs, device, dtype, batch), MOST[size]
    sim = case.sim
    row: Row = {
        "size": size, "youngs": youngs, "batch": batch, "vertices": sim.vertices,
        "tets": len(case.scene.values().tets), "most": most, "kernel": sim.plan.kernel,
        "uncertainty": case.uncertainty, "solvers": {},
    }  # fmt: skip
    timed: dict[str, tuple[Solver, int]] = {}
    for name, solver in SOLVERS.items():
        begin = time.perf_counter()
        sim.solver, expected = solver, forecast(sim.compiled, solver)
        row["solvers"][name] = own = {"setup_ms": 1e3 * (time.perf_counter() - begin)}
        own["iterations"], own["error"] = fewest(case, solver, most)
        own["forecast"] = None if expected is None else expected.iterations(ERROR)
        timed[name] = (solver, own["iterations"] or most)
        timed[f"{name}, 4 iterations"] = (solver, 4)
    found = milliseconds(case, timed, seconds)
    for name, (_, iterations) in list(timed.items()):
        if name in SOLVERS:
            few = found[f"{name}, 4 iterations"]["min"]
            slope = (found[name]["min"] - few) / max(iterations - 4, 1)
            row["solvers"][name].update(milliseconds=found[name], microseconds_an_iteration=1e3 * slope)
    row["auto"] = run_auto(case, seconds)
    return {**row, **judged(row)}


@torch.no_grad()
def run_auto(case: Case, seconds: float) -> Row:
    """The choice of "auto" for this batch, its error and time."""
    sim = case.sim
    sim.solver = "auto"
    assert sim.choice is not None
    solver, count, why = sim.solver, sim.iterations, sim.choice.why
    return {
        "solver": type(solver).__name__, "iterations": count, "why": why, "error": case.error(solver, count),
        "milliseconds": milliseconds(case, {"auto": (solver, count)}, seconds)["auto"],
    }  # fmt: skip


def judged(row: Row) -> Row:
    """Add the speed-up of Multilevel (a bound if Chebyshev failed), and whether auto chose the faster one."""
    plain, levels = (row["solvers"][name] for name in SOLVERS)
    ratio = plain["milliseconds"]["min"] / levels["milliseconds"]["min"]
    reached = [own["iterations"] is not None for own in (plain, levels)]
    faster = "Multilevel" if reached[1] and (ratio > 1.0 or not reached[0]) else "Chebyshev" if reached[0] else None
    return {
        "times_faster": ratio if reached[1] else None,
        "at_least": not reached[0],
        "faster": faster,
        "auto_took_the_faster": row["auto"]["solver"] == faster,
        # cost of a wrong choice; near 1 both are as good
        "auto_loses": max(ratio, 1.0 / ratio) if all(reached) and row["auto"]["solver"] != faster else 1.0,
    }


def table(rows: list[Row]) -> str:
    """Table of all numbers, one row per body."""
    lines = [
        '| vertices | Young\'s modulus | guarded Chebyshev | `Multilevel` | times faster | `solver="auto"` |',
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        cells = []
        for own in row["solvers"].values():
            count = own["iterations"]
            cells.append(
                f"{count} it., {own['milliseconds']['min']:.3g} ms" if count is not None
                else f"not in {row['most']} it., {own['milliseconds']['min']:.3g} ms: error {own['error']:.1g}"
            )  # fmt: skip
        if row["times_faster"] is not None:
            times = row["times_faster"]
            cells.append(f"more than {_plain(times, down=True)}" if row["at_least"] else f"{times:.2g}")
        else:
            cells.append("Multilevel failed")
        auto = row["auto"]
        loses = f", the slower by {row['auto_loses']:.2g}" if row["auto_loses"] > 1.0 else ""
        cells.append(
            f"{auto['solver']}{loses}: {auto['iterations']} it., {auto['milliseconds']['min']:.3g} ms, "
            f"error {auto['error']:.1g}"
        )
        lines.append(f"| {row['vertices']:,} | {row['youngs']:.0e} Pa | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def matrix(rows: list[Row]) -> str:
    """Table of docs/accuracy.md: milliseconds of Chebyshev / Multilevel and their ratio, by size and stiffness."""
    stiffnesses = sorted({row["youngs"] for row in rows})
    lines = [
        "| vertices | " + " | ".join(f"{youngs:.0e} Pa" for youngs in stiffnesses) + " |",
        "|---" * (1 + len(stiffnesses)) + "|",
    ]
    for count in sorted({row["vertices"] for row in rows}):
        cells = {row["youngs"]: _short(row) for row in rows if row["vertices"] == count}
        lines.append(f"| {count:,} | " + " | ".join(cells.get(youngs, "") for youngs in stiffnesses) + " |")
    return "\n".join(lines)


def _short(row: Row) -> str:
    plain, levels = (own["milliseconds"]["min"] for own in row["solvers"].values())
    failed = [own["iterations"] is None for own in row["solvers"].values()]
    if failed[1]:
        return f"{_plain(plain)}: `Multilevel` failed"
    if not failed[0]:
        return f"{_plain(plain)} / {_plain(levels)}: {_plain(row['times_faster'])} x"
    return f"> {_plain(plain, down=True)} / {_plain(levels)}: > {_plain(row['times_faster'], down=True)} x"


def _plain(number: float, *, down: bool = False) -> str:
    """Format two digits without an exponent; a lower bound is rounded down."""
    unit = 0.1 if number < 10.0 else 10.0 ** (math.floor(math.log10(number)) - 1)
    digits = math.floor(number / unit + 1e-9) if down else round(number / unit)
    return f"{digits * unit:,.1f}" if number < 10.0 else f"{digits * unit:,.0f}"


def cost_in_use(name: str, row: Row) -> Cost | None:
    """The cost of a solver in `estimate.solver_choice`; None for Chebyshev on a GPU: see `kernels_by_batch.py`."""
    if name == "Multilevel":
        return multilevel_cost(row["vertices"], on_gpu=row["kernel"] is not None)
    return CPU_CHEBYSHEV if row["kernel"] is None else None


def costs_of_batches(rows: list[Row]) -> str:
    """Costs in `torchpd.estimate.solver_choice` of the environments after the first, which has its own cost."""
    lines = []
    for row in rows:
        vertices, batch = row["vertices"], row["batch"]
        for name, own in row["solvers"].items():
            cost, took = cost_in_use(name, row), own["microseconds_an_iteration"]
            line = f"{row['kernel'] or 'cpu'}: {name}, {batch} of {vertices:,} vertices: {took:.3g} us an iteration"
            if cost is not None:
                line += (
                    f", {cost.iteration(vertices, batch):.3g} by the table; every environment but the first adds "
                    f"{(took - cost.first(vertices)) / (batch - 1):.2g} us, {cost.other(vertices):.2g} by the table"
                )
            lines.append(line)
    return "\n".join(lines)


def costs(rows: list[Row]) -> str:
    """Microseconds per iteration by kernel and size: the cost model in `torchpd.estimate.solver_choice`."""
    lines = []
    for kernel in sorted({row["kernel"] or "cpu" for row in rows}):
        for name in SOLVERS:
            own = [row for row in rows if (row["kernel"] or "cpu") == kernel]
            sizes = np.array([row["vertices"] / 1e3 for row in own])
            times = np.array([row["solvers"][name]["microseconds_an_iteration"] for row in own])
            if len(set(sizes)) < 2:
                continue
            # minimises relative errors, since the table serves every size
            design = np.stack([1.0 / times, sizes / times], axis=1)
            latency, each = np.linalg.lstsq(design, np.ones(len(own)), rcond=None)[0]
            cost = cost_in_use(name, own[0])
            in_use = "" if cost is None else f", {cost} in use"
            lines.append(f"{kernel}: {name}: Cost({latency:.2g}, {each:.3g}) measured{in_use}")
    return "\n".join(lines)


def _positive(word: str) -> int:
    if not word.isdecimal() or int(word) < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number >= 1, got {word!r}")
    return int(word)


def main(words: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--sizes", nargs="*", choices=SIZES, default=ALONE, help="of the beam")
    parser.add_argument("--youngs", nargs="*", type=float, default=list(YOUNGS), help="Young's moduli [Pa]")
    parser.add_argument("--seconds", type=float, default=2.0, help="duration of timing a case (%(default)g)")
    parser.add_argument("--batch", type=_positive, default=1, help="environments per step (%(default)s)")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads (%(default)s)")
    parser.add_argument(
        "--dtype", choices=("float32", "float64"), default="float32", help="precision of the timed steps"
    )
    parser.add_argument("--auto", action="store_true", help='measure the choice of "auto" again in kept cases')
    parser.add_argument("--out", type=Path, help="output file (JSON); default: that of the device")
    options = parser.parse_args(words)
    float64, batch = ["float64"] * (options.dtype == "float64"), [f"batch-{options.batch}"] * (options.batch > 1)
    name = "-".join(["time-to-error", options.device, *float64, *batch])
    out = options.out or Path(__file__).parent / "results" / f"{name}.json"
    dtype = getattr(torch, options.dtype)
    torch.set_num_threads(options.threads)
    device = torch.device(options.device)
    rows: Rows = {(row["size"], row["youngs"], row.get("batch", 1)): row for row in earlier_rows(out)}
    now = describe_run(device, options.threads)
    cases = [(size, youngs) for size in options.sizes for youngs in options.youngs]
    with tqdm(cases, desc="cases", unit="case") as bar:
        for size, youngs in bar:
            bar.set_postfix_str(f"{size}, {youngs:g} Pa")
            key = size, youngs, options.batch
            if key not in rows:
                rows[key] = run_case(size, youngs, device, options.seconds, dtype, options.batch) | {"run": run_of(now)}
            elif options.auto:
                row = rows[key]
                row["auto"] = run_auto(Case(SIZES[size], youngs, device, dtype, options.batch), options.seconds)
                row["auto"]["run"] = run_of(now)
                row.update(judged(row))
            else:
                continue
            write_result(out, {"schema": 1, **now, "error": ERROR, "rows": in_order(rows)})
    found = [row for row in in_order(rows) if row.get("batch", 1) == options.batch]
    print(table(found))
    print(matrix(found))
    print(costs(found) if options.batch == 1 else costs_of_batches(found))


def in_order(rows: Rows) -> list[Row]:
    """Sort the rows by batch, size and stiffness."""
    return [rows[key] for key in sorted(rows, key=lambda key: (key[2], SIZES[key[0]], key[1]))]


if __name__ == "__main__":
    main(sys.argv[1:])
