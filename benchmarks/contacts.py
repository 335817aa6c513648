"""Cost of a step with contacts: iterations and milliseconds to three errors, with and without friction.

Scenes: a cube that lands, one that slides, a slab that slides, and a cube that falls on a sphere. Young's moduli are
1e5 to 1e7 Pa, the time step is 1/60 s, some steps into the motion. Contacts are frictionless or have a coefficient of
0.5, where some vertices stick and others slide. Iterations are the fewest of a grid of four per octave, in float64.

Errors are |x - x*| / |x + h v - x*|. `Multilevel` solves x* to a residual of 1e-9 in at most 10,800 iterations; rows
above that residual are marked by ?. Milliseconds are medians of the found numbers of iterations in float32.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
from pathlib import Path
from typing import Any, NamedTuple

import torch
from machine import describe_run, measure, write_result
from tqdm.auto import tqdm

import torchpd as pd
from torchpd.scene.solvers import Solver

ERRORS = (1e-1, 1e-2, 1e-3)
COUNTS = sorted({round(2.0 ** (k / 4)) for k in range(45)})  # to 2048
SOLVED = 1e-9  # residual of a converged step
STIFFNESSES = (1e5, 1e6, 1e7)
FRICTIONS = (0.0, 0.5)
SOLVERS: dict[str, Solver] = {"Chebyshev": pd.Chebyshev(), "Multilevel": pd.Multilevel()}
H = 1 / 60


class ContactScene(NamedTuple):
    """A body of `shape` times as many cells, its contact, its initial motion and number of steps."""

    shape: tuple[int, int, int]
    size: tuple[float, float, float]
    on_sphere: bool
    velocity: tuple[float, float, float]
    steps: int


CONTACT_SCENES = {
    "cube lands": ContactScene((3, 3, 3), (0.4, 0.4, 0.4), False, (0.0, -1.0, 0.0), 0),
    "cube slides": ContactScene((3, 3, 3), (0.4, 0.4, 0.4), False, (1.0, -1.0, 0.3), 6),
    "slab slides": ContactScene((6, 1, 6), (0.8, 0.13, 0.8), False, (1.0, -1.0, 0.3), 6),
    "cube on ball": ContactScene((3, 3, 3), (0.4, 0.4, 0.4), True, (0.5, -1.0, 0.0), 3),
}


def simulator_of(
    contact_scene: ContactScene, cells: int, youngs: float, friction: float, dtype: torch.dtype, device: str
) -> pd.Simulator:
    mesh = pd.shapes.box(contact_scene.size, tuple(cells * n for n in contact_scene.shape))
    contact = (
        pd.Sphere((0.2, -0.5, 0.2), 0.5, friction) if contact_scene.on_sphere else pd.Ground(0.0, friction=friction)
    )
    scene = pd.Scene(pd.Solid(mesh, youngs, 1000.0), pd.Gravity(), contact)
    sim = pd.Simulator(scene, H, 400, pd.Multilevel(), dtype=dtype, progress=False)
    return sim.to(device)


@torch.no_grad()
def compare(name: str, cells: int, youngs: float, friction: float, device: str, seconds: float) -> dict[str, Any]:
    """A row: iterations and milliseconds of each solver to each error, None if `COUNTS` are not enough."""
    contact_scene = CONTACT_SCENES[name]
    sim = simulator_of(contact_scene, cells, youngs, friction, torch.float64, device)
    state = sim.rest_state()
    state.velocities[:] = torch.tensor(contact_scene.velocity)
    for _ in range(contact_scene.steps):
        state = sim(state)
    residual = 1.0
    while residual > SOLVED and sim.iterations < 10_000:
        sim.iterations *= 3
        solution, info = sim(state, return_info=True)
        residual = float(info.residual)
    goal = float((state.positions + H * state.velocities - solution.positions).norm())
    row: dict[str, Any] = {"scene": name, "vertices": sim.vertices, "youngs": youngs, "friction": friction}
    row.update(residual=residual, solvers={})
    timed = simulator_of(contact_scene, cells, youngs, friction, torch.float32, device)
    start = pd.State(*(part.float() for part in state))
    for solver, value in SOLVERS.items():
        sim.solver = timed.solver = value
        counts: list[int | None] = []
        for sim.iterations in COUNTS:
            error = float((sim(state).positions - solution.positions).norm())
            counts += [sim.iterations for wanted in ERRORS[len(counts) :] if error <= wanted * goal]
            if len(counts) == len(ERRORS):
                break
        counts += [None] * (len(ERRORS) - len(counts))
        times: list[float | None] = []
        for count in counts:
            timed.iterations = count or 1
            runs = measure(lambda: timed(start), sim.device, repetitions=5, seconds=seconds) if count else None
            times.append(1e3 * statistics.median(runs) if runs else None)
        row["solvers"][solver] = {"iterations": counts, "ms": times}
    return row


def table(rows: list[dict[str, Any]]) -> str:
    """Table of iterations and milliseconds, one row per line."""
    goals = ", ".join(f"{error:g}" for error in ERRORS)
    head = f"{'scene':<13}{'vertices':>9}{'Pa':>7}{'friction':>9}"
    lines = [head + "".join(f"   {name + ': it. and ms to ' + goals:<42}" for name in SOLVERS)]
    for row in rows:
        doubt = "?" if row["residual"] > SOLVED else ""
        text = f"{row['scene'] + doubt:<13}{row['vertices']:>9}{row['youngs']:>7.0e}{row['friction']:>9}"
        for found in row["solvers"].values():
            cells = [
                f"> {COUNTS[-1]}" if count is None else f"{count} {ms:.2f}"
                for count, ms in zip(found["iterations"], found["ms"], strict=True)
            ]
            text += "   " + "".join(f"{cell:>14}" for cell in cells)
        lines.append(text)
    if any(row["residual"] > SOLVED for row in rows):
        lines.append(f"? converged only to a residual above {SOLVED:g}: ignore errors near that")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, nargs="+", default=[2, 4], help="cells per edge, times those of the body")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads (%(default)s)")
    parser.add_argument("--seconds", type=float, default=0.05, help="duration of timing a step (%(default)s)")
    parser.add_argument("--out", type=Path, help="output file (JSON)")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    cases = list(itertools.product(CONTACT_SCENES, options.cells, STIFFNESSES, FRICTIONS))
    rows = [compare(*case, options.device, options.seconds) for case in tqdm(cases, desc="contacts", unit="step")]
    print(table(rows))
    if options.out:
        run = describe_run(torch.device(options.device), options.threads)
        write_result(options.out, {"schema": 1, **run, "errors": ERRORS, "rows": rows})


if __name__ == "__main__":
    main()
