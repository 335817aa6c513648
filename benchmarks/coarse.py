"""Check the coarse correction of the reference: it leaves solved steps alone, and few iterations come near them.

The scenes are those of tumbles.py, eight steps each, solved by the library. A step counts as solved at a residual of
1e-8. The correction is applied to the solved step, at its end and before, between and after nine more iterations. From
the step's start, 16 iterations are compared with the solved step: alone, and with corrections at both ends. The error
is that of the middle's velocity or of the spin times half the size, over the greater of both, at least g h / 2.
"""

from __future__ import annotations

import sys

import numpy as np
import torch
from coarse_scenes import middle_and_spin
from judge import judge_scenes
from numpy.typing import NDArray
from tumbles import SEED, SOLVED, STEPS, Row, Still, random_tumble, still_problem

from torchpd.reference import step_problem
from torchpd.reference.coarse_step import coarse_chebyshev
from torchpd.reference.problem import StepProblem
from torchpd.reference.rigid import corrected
from torchpd.reference.solvers import guarded_chebyshev

ITERATIONS = 16
MOVED = 1e-8  # m: what a correction may move a step of residual 1e-8

Array = NDArray[np.float64]


@torch.no_grad()
def run_scene(number: int) -> Row:
    facts, sim, state = random_tumble(np.random.default_rng([SEED, number]))
    row: Row = {"scene": number, **facts, "solved": []}
    for step in range(STEPS):
        before = state.positions[0].numpy(), state.velocities[0].numpy()
        problem = step_problem(sim.scene.values(), *before, sim.time_step)
        state = sim(state)
        u = sim.time_step * state.velocities[0].numpy()
        residual = problem.relative_residual(u)
        if residual <= SOLVED:
            row["solved"].append({"step": step, "residual": residual, **judge(still_problem(problem), u)})
    return row


def judge(problem: Still, solved: Array) -> Row:
    """Largest displacements [m] by corrections of a solved step, and errors of few iterations."""
    ended = corrected(problem, solved)
    between = coarse_chebyshev(problem, ended, iterations=9, every=4)
    alone = guarded_chebyshev(problem, problem.unsolved(), iterations=ITERATIONS).displacement
    return {
        "moved": float(np.abs(ended - solved).max()),
        "moved between": float(np.abs(between - solved).max()),
        "error alone": error(problem, alone, solved),
        "error": error(problem, coarse_chebyshev(problem, iterations=ITERATIONS), solved),
    }


def error(problem: StepProblem, displacement: Array, solved: Array) -> float:
    masses, half = problem.values.masses, 0.5 * float(np.ptp(problem.positions, axis=0).max())
    (v, w), (exact, spin) = (
        middle_and_spin(masses, problem.positions + u, u / problem.time_step) for u in (displacement, solved)
    )
    least = 0.5 * problem.time_step * float(np.linalg.norm(problem.values.gravity))
    scale = max(float(np.linalg.norm(exact)), half * float(np.linalg.norm(spin)), least)
    return max(float(np.linalg.norm(v - exact)), half * float(np.linalg.norm(w - spin))) / scale


def summary(rows: list[Row]) -> Row:
    """Solved steps that a correction moves, and geometric mean, 95 % and worst of the errors."""
    solved = [step for row in rows for step in row["solved"]]
    out: Row = {"solved steps": len(solved)}
    for name in ("moved", "moved between"):
        ways = np.array([step[name] for step in solved])
        out[name] = {"furthest": float(ways.max()), f"by more than {MOVED:g} m": int((ways > MOVED).sum())}
    for name in ("error alone", "error"):
        errors = np.array([step[name] for step in solved])
        out[name] = {
            "geometric mean": float(np.exp(np.log(np.maximum(errors, 1e-16)).mean())),
            "95 %": float(np.quantile(errors, 0.95)),
            "worst": float(errors.max()),
        }
    return out


if __name__ == "__main__":
    judge_scenes(sys.argv[1:], str(__doc__), 1000, run_scene, summary)
