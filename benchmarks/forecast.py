"""Accuracy of the estimates of iterations, and of `solver="auto"` at its 1e-3: random scenes, in float64.

Estimates are for the error relative to that of the first iterate. "auto" is measured as its tolerance is: relative to
what elasticity and contacts displace, or to free fall if that is more. Beside it stands the fewest of four numbers of
iterations per octave with which the same solver reaches 1e-3.

The scenes are those of `tune.py` with other random numbers: bars, slivers, balls and octopuses of 60 to 1700 vertices,
1e3 to 1e8 Pa, time steps of 1 to 33 ms. Bodies are held, free or on the ground, some steps into a random motion,
without friction. Iterations are counted on a grid of four per octave. Measured scenes are kept: an interrupted run
resumes.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import torch
from judge import judge_scenes
from tune import random_scene, random_state

import torchpd as pd
from torchpd.accuracy.error import ExactStep, exact_steps, frictionless
from torchpd.estimate.convergence import forecast, spectrum_of
from torchpd.estimate.solver_choice import AIM

ERRORS = (1e-1, 1e-2, 1e-3)
COUNTS = sorted({round(2.0 ** (k / 4)) for k in range(49)})  # to 4096
SOLVERS = {"Chebyshev": pd.Chebyshev(), "Multilevel": pd.Multilevel()}
SURE = 1e-4  # largest uncertainty of the converged step, relative to the error
SEED = 77
Row = dict[str, Any]


def error_of(sim: pd.Simulator, state: pd.State, exact: ExactStep) -> float:
    return exact.errors_of(sim(state).velocities[0].numpy() * sim.time_step).position


def counts_to(sim: pd.Simulator, state: pd.State, exact: ExactStep) -> list[int | None]:
    """The first of `COUNTS` within each of `ERRORS`; None if they are not enough."""
    found: list[int | None] = []
    for count in COUNTS:
        sim.iterations = count
        reached = error_of(sim, state, exact)
        found += [count for error in ERRORS[len(found) :] if reached <= error]
        if len(found) == len(ERRORS):
            break
    return found + [None] * (len(ERRORS) - len(found))


def displacement_error(sim: pd.Simulator, state: pd.State, exact: ExactStep) -> tuple[float, int]:
    """Relative displacement error of a step, as `tolerance` defines it, and the iterations that ran."""
    after, info = sim(state, return_info=True)
    fall = float(sim.gravity.norm()) * sim.time_step**2 * sim.vertices**0.5
    displaced = max(float(np.linalg.norm(exact.solution - exact.problem.target)), fall)
    error = np.linalg.norm(after.velocities[0].numpy() * sim.time_step - exact.solution)
    return float(error) / displaced, sim.iterations if info.iterations is None else int(info.iterations[0])


def judge_auto(auto: pd.Simulator, state: pd.State, exact: ExactStep) -> Row:
    """Solver, error and iterations of "auto" in a step, and the fewest of `COUNTS` that reach its aim."""
    error, ran = displacement_error(auto, state, exact)
    kept, fewest = (auto.iterations, auto.tolerance), None
    auto.tolerance = 0.0
    for count in COUNTS:
        auto.iterations = count
        if displacement_error(auto, state, exact)[0] <= AIM:
            fewest = count
            break
    auto.iterations, auto.tolerance = kept
    return {"solver": type(auto.solver).__name__, "iterations": ran, "fewest": fewest, "error": error}


def judgement(rows: list[Row]) -> Row:
    """How often "auto" reached its aim, its worst error, and the iterations it ran over the fewest."""
    solved = [row for row in rows if row["fewest"] is not None]
    out: Row = {
        "steps": len(rows),
        f"error {AIM:g} reached": sum(row["error"] <= AIM for row in rows),
        "Multilevel": sum(row["solver"] == "Multilevel" for row in rows),
    }
    if not solved:
        return out
    ran, fewest = (np.array([row[name] for row in solved], dtype=float) for name in ("iterations", "fewest"))
    return {
        **out,
        "largest error": max(row["error"] for row in rows),
        "iterations over the fewest": {
            "sum": float(ran.sum() / fewest.sum()),
            "median": float(np.median(ran / fewest)),
        },
    }


@torch.no_grad()
def run_scene(number: int) -> Row:
    rng = np.random.default_rng([SEED, number])
    facts, drawn = random_scene(rng)
    sim = frictionless(drawn, torch.float64)
    state = random_state(sim, rng)
    sim.iterations = 256
    for _ in range(int(rng.integers(0, 10))):
        state = sim(state)
    exact = exact_steps(sim, state, iterations=6000)[0]
    row: Row = {"scene": number, **facts, "uncertainty": exact.uncertainty}
    if not exact.moves(torch.float32) or not exact.uncertainty <= SURE:
        return {**row, "left_out": "no motion" if exact.uncertainty <= SURE else "no converged step to compare with"}
    spectrum = spectrum_of(sim.compiled)
    assert spectrum is not None
    row.update(spectrum._asdict())
    for name, solver in SOLVERS.items():
        sim.solver = solver
        expected = forecast(sim.compiled)
        assert expected is not None
        row[name] = {"forecast": [expected.iterations(e) for e in ERRORS], "needed": counts_to(sim, state, exact)}
    sim.solver = "auto"
    return {**row, "auto": judge_auto(sim, state, exact)}


def summary(rows: list[Row]) -> Row:
    """Percentiles of iterations needed over estimate, with and without contacts; and how often auto reached its aim."""
    used = [row for row in rows if "left_out" not in row]
    out: Row = {"scenes": len(used), "left out": len(rows) - len(used)}
    for place, group in (
        ("no contacts", [row for row in used if row["support"] != "ground"]),
        ("contacts", [row for row in used if row["support"] == "ground"]),
    ):
        for name in SOLVERS if group else ():
            last = len(ERRORS) - 1
            ratios = [
                (row[name]["needed"][last] or np.inf) / row[name]["forecast"][last] for row in group
            ]  # None counts as worse than all
            out[f"{name}, {place}: needed / forecast to {ERRORS[last]:g}"] = {
                f"{p} %": float(np.percentile(ratios, p, method="lower")) for p in (5, 50, 90, 95)
            }
        out[f"auto, {place}"] = judgement([row["auto"] for row in group])
    return out


if __name__ == "__main__":
    judge_scenes(sys.argv[1:], str(__doc__), 200, run_scene, summary)
