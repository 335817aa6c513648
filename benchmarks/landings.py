"""Iterations of `Multilevel` for bodies that land on frictionless ground, and the error of `solver="auto"` (aim 1e-3).

Random meshes have 45 to 700 vertices, lengths of 2 cm to 1 m and 3e4 to 3e7 Pa; in a third of them the stiffness varies
a hundredfold between tetrahedra. They are bars, balls and octopuses; boxes with perturbed vertices, down to tetrahedra
of half a degree; and Delaunay meshes of random points, with slivers. Slivers or varying stiffness count as uneven.

Bodies hit the ground with a face, tilted, or in any position. Six steps from there are judged in float64, if the
converged step is known to 1e-4 and differs from the first iterate by more than float32 resolves. Soft bodies, for which
Chebyshev takes less than 60 iterations, are left out.

Iterations are counted on a grid of four per octave. The first number counts that reaches 1e-3 and still does so at the
next number of the grid and at the last. If none does, residual and energy tell whether they converge or end in another
minimum. "auto" is measured as in `forecast.py`. Measured scenes are kept.
"""

from __future__ import annotations

import sys
from collections import Counter
from typing import Any

import numpy as np
import torch
from forecast import judge_auto, judgement
from judge import judge_scenes
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation
from tune import random_mesh

import torchpd as pd
from torchpd.accuracy.error import Errors, ExactStep, exact_steps
from torchpd.estimate.convergence import forecast, is_uneven
from torchpd.estimate.solver_choice import AIM, MARGIN
from torchpd.geometry.mesh_quality import smallest_dihedral

STEPS = 6
SOFT = 60  # iterations of Chebyshev
MOST = 700  # vertices
COUNTS = sorted({round(2.0 ** (k / 4)) for k in range(45)})  # to 2048
SURE = 1e-4  # largest uncertainty of the converged step, relative to the error
SOLVED = 1e-9  # residual at which further iterations change nothing
SEED = 99
Row = dict[str, Any]


def shaken_mesh(rng: np.random.Generator) -> tuple[str, pd.TetMesh]:
    """A box with vertices moved by up to a third of a cell; with its own tets, or new ones between the points."""
    cells = (int(rng.integers(4, 10)), *rng.integers(2, 5, 2).tolist())
    box = pd.shapes.box((1.0, 0.4, 0.4), cells)
    kept = bool(rng.random() < 0.5)
    share = rng.uniform(0.1, 0.3) if kept else rng.uniform(0.05, 0.3)
    points = box.vertices + rng.uniform(-share, share, box.vertices.shape) * np.array([1.0, 0.4, 0.4]) / cells
    tets = box.tets if kept else Delaunay(points).simplices
    volumes = np.linalg.det(points[tets][:, 1:] - points[tets][:, :1])
    if kept:
        tets = tets[volumes > 0.0]
    else:
        flat = np.abs(volumes) <= 10.0 ** rng.uniform(-2.3, -0.7) * np.median(np.abs(volumes))
        tets = np.where(volumes[:, None] < 0.0, tets[:, [0, 2, 1, 3]], tets)[~flat]
    used, renumbered = np.unique(tets, return_inverse=True)
    return "shaken" if kept else "Delaunay", pd.TetMesh(points[used], renumbered.reshape(tets.shape))


def random_landing(rng: np.random.Generator) -> tuple[Row, pd.Simulator, pd.State]:
    """The random parameters, the simulator, and the state before the impact."""
    kind, mesh = random_mesh(rng) if rng.random() < 0.5 else shaken_mesh(rng)
    size, youngs = 10.0 ** rng.uniform(-1.7, 0.0), 10.0 ** rng.uniform(4.5, 7.5)
    time_step = float(rng.choice([1 / 240, 1 / 60, 1 / 30], p=[0.2, 0.6, 0.2]))
    contrast = bool(rng.random() < 1 / 3)
    position = str(rng.choice(["face", "tilted", "any"]))
    turn = {"face": Rotation.identity(), "tilted": Rotation.from_euler("z", rng.uniform(0.02, 0.5))}
    turn["any"] = Rotation.from_quat(rng.standard_normal(4))
    mesh = pd.TetMesh(turn[position].apply(size * mesh.vertices), mesh.tets)
    velocity = np.array([rng.uniform(-0.5, 0.5), -(10.0 ** rng.uniform(-1.0, 0.3)), rng.uniform(-0.5, 0.5)])
    ground = float(mesh.bounds[0, 1] + velocity[1] * time_step * rng.uniform(0.1, 1.2))
    each = youngs * 10.0 ** rng.uniform(-1.0, 1.0, len(mesh.tets)) if contrast else youngs
    scene = pd.Scene(pd.Solid(mesh, each, density=1000.0), pd.Gravity(), pd.Ground(ground))
    sim = pd.Simulator(scene, time_step, 10, pd.Multilevel(), torch.float64, progress=False)
    velocities = torch.from_numpy(velocity).expand(1, sim.vertices, 3).clone()
    facts = {"mesh": kind, "vertices": sim.vertices, "size": size, "youngs": youngs, "contrast": contrast}
    facts |= {"time_step": time_step, "position": position}
    return facts, sim, pd.State(sim.rest_state().positions, velocities)


def errors_of(sim: pd.Simulator, state: pd.State, exact: ExactStep) -> Errors:
    return exact.errors_of(sim(state).velocities[0].numpy() * sim.time_step)


@torch.no_grad()
def run_scene(number: int) -> Row:
    rng = np.random.default_rng([SEED, number])
    facts, sim, state = random_landing(rng)
    plain, levels = forecast(sim.compiled, pd.Chebyshev()), forecast(sim.compiled)
    assert plain is not None
    assert levels is not None
    mesh = sim.scene.solids[0].mesh
    row: Row = {
        "scene": number,
        **facts,
        "smallest_angle": float(np.degrees(smallest_dihedral(mesh.vertices, mesh.tets))),
    }
    row |= {"uneven": is_uneven(sim.compiled), "Chebyshev": plain.iterations(AIM), "forecast": levels.iterations(AIM)}
    if sim.vertices > MOST or row["Chebyshev"] < SOFT:
        return {**row, "left_out": "too large" if sim.vertices > MOST else "soft"}
    auto = pd.Simulator(sim.scene, sim.time_step, solver="auto", dtype=sim.dtype, progress=False)
    row |= {"steps": []}
    ahead = pd.Simulator(sim.scene, sim.time_step, 3000, pd.Multilevel(), sim.dtype, tolerance=1e-8, progress=False)
    for _ in range(STEPS):
        exact = exact_steps(sim, state, iterations=4000)[0]
        if exact.uncertainty <= SURE and exact.moves(torch.float32):
            row["steps"].append({**needed(sim, state, exact), "auto": judge_auto(auto, state, exact)})
        state = ahead(state)
    return row if row["steps"] else {**row, "left_out": "no step to compare with"}


def needed(sim: pd.Simulator, state: pd.State, exact: ExactStep) -> Row:
    """The iterations that reach `AIM`, None if `COUNTS` are not enough, and the errors after the last."""

    def errors(count: int) -> Errors:
        sim.iterations = count
        return errors_of(sim, state, exact)

    last, before = errors(COUNTS[-1]), False
    if last.position > AIM:
        return {"needed": None, "last": last.position, "energy": last.energy, "residual": last.residual}
    for place, count in enumerate(COUNTS):
        reached = errors(count).position <= AIM
        if reached and before:
            return {"needed": COUNTS[place - 1], "last": last.position}
        before = reached
    return {"needed": COUNTS[-1], "last": last.position}


def place_of(step: Row) -> str:
    """Classify the result of iterations that do not reach `AIM`."""
    if step["residual"] > SOLVED:
        return "on their way"
    return "in a minimum of less energy" if step["energy"] < 0.0 else "in one of more energy"


def summary(rows: list[Row]) -> Row:
    """Iterations of the hardest steps over the estimate, and errors of "auto", for even and uneven bodies."""
    used = [row for row in rows if "left_out" not in row]
    out: Row = {"scenes": len(used), "left out": len(rows) - len(used)}
    for name in ("even", "uneven"):
        group = [row for row in used if row["uneven"] == (name == "uneven")]
        steps = [(row, step) for row in group for step in row["steps"]]
        solved = [(row, step) for row, step in steps if step["needed"] is not None]
        out[name] = {
            "scenes": len(group),
            "steps": len(steps),
            f"steps that {COUNTS[-1]} iterations leave unsolved": len(steps) - len(solved),
            "of those": dict(Counter(place_of(step) for _, step in steps if step["needed"] is None)),
            f"of the others: within {MARGIN:g} of the forecast": sum(
                step["needed"] <= MARGIN * row["forecast"] for row, step in solved
            ),
            "auto": judgement([step["auto"] for _, step in solved]),
        }
    return out


if __name__ == "__main__":
    judge_scenes(sys.argv[1:], str(__doc__), 300, run_scene, summary)
