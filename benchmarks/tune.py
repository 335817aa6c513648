"""Check the error bounds of `Simulator.tune` on random scenes and on other motions of each.

A scene has a random mesh (bar, slivers, ball, octopus), stiffness (1e3 to 1e8 Pa) and time step (1e-3 to 1/30 s). It is
held at one end, free, or falling on the ground. With `--contact` it is one of `contact_soak.py` at up to 3 m/s: boxes,
a sheet and a resting collider, just before they meet. It is tuned from one random motion and judged on steps of
another, against the converged step in float64. Results that attain the target and refusals ("the best is ...") are
counted separately. Scenes in contact have no budgets. Judged scenes stay in the results file: an interrupted run
resumes.
"""

from __future__ import annotations

import argparse
import copy
import itertools
import json
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import contact_soak
import numpy as np
import torch
from machine import describe_run, earlier_rows, measure, run_of, write_result
from scipy.spatial import Delaunay
from tqdm.auto import tqdm

import torchpd as pd
from torchpd.accuracy.error import exact_steps, settled_steps
from torchpd.accuracy.tuning import TuningWarning
from torchpd.estimate.convergence import has_friction

JUDGED_STEPS = (1, 5, 20, 45)  # of the other motion
MEETING_STEPS = (0, 1, 5, 20)  # the same, of bodies that come near each other in the first
MEET = 300  # steps before which they must have
SLACK = 1.2  # allowed time over a budget in milliseconds
STEADY = 0.1  # allowed change of the machine's speed during the tuning for a budget
ATTEMPTS = 6
Row = dict[str, Any]


def random_mesh(rng: np.random.Generator) -> tuple[str, pd.TetMesh]:
    """A random mesh of 60 to 900 vertices, about a metre long."""
    kind = str(rng.choice(["bar", "slivers", "ball", "octopus"]))
    cells = rng.integers(2, 5, 2)
    if kind == "bar":
        return kind, pd.shapes.box((1.0, *rng.uniform(0.1, 0.4, 2)), (int(rng.integers(5, 21)), *cells.tolist()))
    if kind == "slivers":
        counts = (int(rng.integers(4, 10)), *cells.tolist())
        points = pd.shapes.box((1.0, 0.3, 0.3), counts).vertices
        points = points + rng.uniform(-0.01, 0.01, points.shape)
        tets = Delaunay(points).simplices
        volumes = np.linalg.det(points[tets][:, 1:] - points[tets][:, :1])
        turned = np.where(volumes[:, None] < 0.0, tets[:, [0, 2, 1, 3]], tets)
        # down to a thousandth of the volume of a regular tetrahedron
        return kind, pd.TetMesh(points, turned[np.abs(volumes) > 1e-3 * np.median(np.abs(volumes))])
    import trimesh

    surface = pd.shapes.octopus(cells=16)
    if kind == "ball":
        ball = trimesh.creation.icosphere(3, radius=0.5)
        surface = pd.TriMesh(ball.vertices, ball.faces)
    return kind, pd.tetrahedralize(surface, cells=int(rng.integers(6, 11)))


def random_scene(rng: np.random.Generator) -> tuple[Row, pd.Simulator]:
    """The random parameters and the simulator."""
    kind, mesh = random_mesh(rng)
    youngs = 10.0 ** rng.uniform(3.0, 8.0)
    time_step = 10.0 ** rng.uniform(-3.0, np.log10(1.0 / 30.0))
    held = str(rng.choice(["held", "free", "ground"], p=[0.5, 0.2, 0.3]))
    body = pd.Solid(mesh, youngs=youngs, density=1000.0)
    parts: list[Any] = [body, pd.Gravity()]
    low, high = mesh.bounds
    if held == "held":
        parts.append(pd.Pin(body, mesh.vertices[:, 0] <= low[0] + 0.05 * (high[0] - low[0])))
    elif held == "ground":
        parts.append(pd.Ground(float(low[1]) - 0.001, friction=0.5))
    sim = pd.Simulator(pd.Scene(*parts), time_step, 64, progress=False)
    facts = {"mesh": kind, "vertices": sim.vertices, "tets": len(mesh.tets), "support": held}
    return {**facts, "youngs": youngs, "time_step": time_step}, sim


def random_state(sim: pd.Simulator, rng: np.random.Generator) -> pd.State:
    """The rest shape with velocities that are a random quadratic of the position, up to about 3 m/s."""
    state = sim.rest_state()
    x = state.positions[0].double()
    x = (x - x.mean(0)) / (x.max() - x.min())
    terms = torch.cat([torch.ones(len(x), 1), x, x**2, x * x.roll(1, 1)], dim=1)
    field = terms @ torch.from_numpy(rng.standard_normal((terms.shape[1], 3)))
    speed = rng.uniform(0.3, 3.0) / float(field.norm(dim=1).max())
    velocities = (speed * field).to(sim.dtype)[None]
    for pin in sim.scene.pins:
        velocities[:, pin.vertices] = 0.0
    return pd.State(state.positions, velocities)


@torch.no_grad()
def judge(sim: pd.Simulator, state: pd.State) -> Row:
    """Errors of steps along the motion of the tuned simulator, beside the bounds of its tuning result."""
    solved = settled_steps if sim.scene.contact or has_friction(sim.compiled) else exact_steps
    errors, raw, trusted, audits, residuals, uncertainties = [], [], [], [], [], []
    judged, gaps = MEETING_STEPS if sim.scene.contact else JUDGED_STEPS, []
    for step in range(max(judged) + 1):
        after, info = sim(state, return_info=True)
        if step in judged:
            exact = solved(sim, state)[0]
            if exact.moves(sim.dtype):
                displacement = after.velocities[0].double().numpy() * sim.time_step
                errors.append(exact.error_beyond_rounding(displacement, sim.dtype))
                uncertainties.append(exact.uncertainty)
                raw.append(exact.position_error(displacement))
                gaps.append(float(info.contact_gap[0]) if sim.scene.contact else None)
                trusted.append(bool(sim.tuning_result.is_valid(info)[0]))
                residuals.append(float(info.residual[0]))
                audits.append(float(sim.tuning_result.verify(sim, state, after)[0]))
        state = after
    return {
        "errors": errors, "errors_with_rounding": raw, "trusted": trusted, "audits": audits, "residuals": residuals,
        "uncertainties": uncertainties, "gaps": gaps,
    }  # fmt: skip


def contact_scene(number: int, dtype: torch.dtype) -> tuple[Row, pd.Simulator, pd.State, pd.State]:
    """Bodies that are about to meet, and the same with three quarters of the speed."""
    for draw in itertools.count():
        try:
            facts, sim, state, _ = contact_soak.random_scene(np.random.default_rng([59, number, draw]))
        except ValueError:  # places that are too near, or a thickness beyond float32
            continue
        if facts["speed"] <= 3.0 and facts["time_step"] >= 1 / 240:
            sim, state = sim.to(dtype), state.to(sim.device, dtype)
            slower = pd.HistoryState(state.positions, 0.75 * state.velocities, state.history)
            pair = before_meeting(sim, state), before_meeting(sim, slower)
            if pair[0] is not None and pair[1] is not None:
                break
    facts = {name: facts[name] for name in ("bodies", "collider", "youngs", "time_step", "thickness", "friction")}
    return {"mesh": "contact", "vertices": sim.vertices, **facts}, sim, *pair


@torch.no_grad()
def before_meeting(sim: pd.Simulator, state: pd.HistoryState) -> pd.HistoryState | None:
    """The start of the first step in which surfaces come near each other; None if none does."""
    for _ in range(MEET):
        after, info = sim(state, return_info=True)
        if bool(info.contact_gap < torch.inf):
            return state
        state = after
    return None


def draw_scene(number: int, dtype: torch.dtype, contact: bool) -> tuple[Row, pd.Simulator, pd.State, pd.State]:
    """The scene of a number, the motion to tune from, and the motion to judge."""
    if contact:
        return contact_scene(number, dtype)
    rng = np.random.default_rng([2024, number])
    facts, drawn = random_scene(rng)
    sim = drawn.to(dtype)
    return facts, sim, random_state(sim, rng), random_state(sim, rng)


def run_scene(number: int, error: float, dtype: torch.dtype, contact: bool) -> Row:
    """Tune a scene and judge it."""
    facts, sim, start, other = draw_scene(number, dtype, contact)
    row: Row = {"scene": number, **facts}
    begin = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TuningWarning)
        result = sim.tune(start, error=error)
    row["tuning_seconds"] = time.perf_counter() - begin
    row.update(solver=str(result.solver), iterations=result.iterations, attained=result.attained)
    row.update(promised=result.error, studied=result.studied_error, milliseconds=result.milliseconds)
    row.update(studied_errors=result.trials[-1].errors, studied_residuals=result.trials[-1].residuals)
    row.update(error_per_residual=result.error_per_residual, unseen_error=result.error_at_zero_residual)
    row.update(judge(sim, other))
    row["held"] = not row["errors"] or max(row["errors"]) <= result.error
    row["budget"] = None if contact else judge_budget(sim, start, other)
    return row


def judge_budget(sim: pd.Simulator, start: pd.State, other: pd.State) -> Row:
    """Tune for a budget of 1.5 times the time of 40 default iterations; measures the fraction that the choice needs."""
    ruler = copy.copy(sim)
    ruler.solver, ruler.iterations, ruler.tolerance = pd.Chebyshev(), 40, 0.0

    def median(stepper: pd.Simulator) -> float:
        return 1e3 * float(np.median(measure(lambda: stepper(other), sim.device, repetitions=7, seconds=0.0)))

    attempts, steady = 0, False
    while attempts < ATTEMPTS and not steady:
        attempts += 1
        speed = min(median(ruler) for _ in range(5))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TuningWarning)
            result = sim.tune(start, milliseconds=1.5 * speed)
        # the speed of a shared machine may change meanwhile: such rows are counted apart
        steady = abs(min(median(ruler) for _ in range(5)) / speed - 1.0) < STEADY
    ratio = float(np.median([median(sim) / (1.5 * median(ruler)) for _ in range(7)]))
    return {
        "budget": 1.5 * speed, "share": ratio, "iterations": result.iterations, "kept": ratio <= SLACK,
        "attempts": attempts, "steady": steady,
    }  # fmt: skip


def suspects(row: Row) -> list[bool]:
    """Return for every step whether `TuningResult.estimate` exceeds the bound."""
    # rows without an estimate: its lower bound
    studied = zip(row["studied_errors"], row["studied_residuals"], strict=True)
    least = max((error / residual for error, residual in studied if residual > 0.0), default=0.0)
    ratio, unseen = row.get("error_per_residual", least), row.get("unseen_error", 0.0)
    return [not max(ratio * residual, unseen) <= row["promised"] for residual in row["residuals"]]


def summary(rows: list[Row]) -> Row:
    """Counts, separately for attained targets and refusals."""
    judged = [row for row in rows if row["errors"]]
    timed = [row for row in rows if row["budget"]]
    visible = [row for row in judged if max(row["errors"]) > 0.0]
    kinds = {
        "attained": [r for r in judged if r["attained"]],
        "best reachable": [r for r in judged if not r["attained"]],
    }
    steps = [
        (e > row["promised"], not t, suspect, a > row["promised"])
        for row in judged
        for e, t, suspect, a in zip(row["errors"], row["trusted"], suspects(row), row["audits"], strict=True)
    ]
    return {
        "scenes": len(judged),
        "without motion": len(rows) - len(judged),
        # errors against these may be their own
        "steps whose converged one is uncertain by half the promise": sum(
            uncertainty > 0.5 * row["promised"] for row in judged for uncertainty in row.get("uncertainties", ())
        ),
        **{name: {"scenes": len(group), "held": sum(r["held"] for r in group)} for name, group in kinds.items()},
        "held": sum(row["held"] for row in judged) / max(len(judged), 1),
        "held of attained": sum(r["held"] for r in kinds["attained"]) / max(len(kinds["attained"]), 1),
        # in float32 rounding exceeds the errors of many scenes
        "with an error beyond rounding": {"scenes": len(visible), "held": sum(row["held"] for row in visible)},
        "held with rounding counted as error": sum(max(r["errors_with_rounding"]) <= r["promised"] for r in judged),
        "budgets": {
            name: {"scenes": len(group), "kept": sum(row["budget"]["kept"] for row in group)}
            for name, group in (
                ("at steady speed", [row for row in timed if row["budget"]["steady"]]),
                ("speed of the machine changed", [row for row in timed if not row["budget"]["steady"]]),
            )
        },
        "median share of budget used": float(np.median([row["budget"]["share"] for row in timed])) if timed else None,
        **{
            name: {
                "steps": sum(broken == wanted for broken, *_ in steps),
                "doubted by holds(info)": sum(broken == wanted and doubted for broken, doubted, *_ in steps),
                "doubted by estimate(info)": sum(broken == wanted and doubted for broken, _, doubted, _ in steps),
                "doubted by audit": sum(broken == wanted and doubted for broken, *_, doubted in steps),
            }
            for name, wanted in (("broken steps", True), ("kept steps", False))
        },
        "median error / promise": float(
            np.median([max(row["errors_with_rounding"]) / row["promised"] for row in judged])
        )
        if judged
        else None,
        "median tuning seconds": float(np.median([row["tuning_seconds"] for row in rows])),
    }


def main(words: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=200, help="how many (%(default)s)")
    parser.add_argument("--error", type=float, default=1e-2, help="target error (%(default)g)")
    parser.add_argument("--dtype", choices=("float32", "float64"), default="float32", help="(%(default)s)")
    parser.add_argument("--contact", action="store_true", help="scenes of bodies that meet")
    parser.add_argument("--first", type=int, default=0, help="number of the first scene (%(default)s)")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads (%(default)s)")
    parser.add_argument("--budgets", action="store_true", help="measure the budgets of all kept scenes again")
    parser.add_argument("--out", type=Path, help="output file (JSON)")
    options = parser.parse_args(words)
    torch.set_num_threads(options.threads)
    kept = json.loads(options.out.read_text()) if options.out and options.out.exists() else {"rows": []}
    asked = {"asked": options.error, "dtype": options.dtype}
    dtype = getattr(torch, options.dtype)
    rows = {
        row["scene"]: row for row in earlier_rows(options.out) if {"dtype": "float32", **row}.items() >= asked.items()
    }
    now = describe_run(torch.device("cpu"), options.threads)
    # the bounds stay those of the earlier run
    header = {name: kept[name] for name in now} if options.budgets and rows else now
    wanted = range(options.first, options.first + options.scenes)
    for number in tqdm(wanted, desc="scenes", unit="scene"):
        if number not in rows:
            rows[number] = {**asked, **run_scene(number, options.error, dtype, options.contact), "run": run_of(now)}
        elif options.budgets and not options.contact:
            _, sim, start, other = draw_scene(number, dtype, options.contact)
            rows[number]["budget"] = {**judge_budget(sim, start, other), "commit": now["commit"]}
        else:
            continue
        if options.out:
            every = list(rows.values())
            write_result(options.out, {"schema": 1, **header, "summary": summary(every), "rows": every})
    chosen = [rows[number] for number in wanted]
    print(json.dumps(summary(chosen), indent=1))


if __name__ == "__main__":
    main(sys.argv[1:])
