"""Check that the rigid motions after the iterations do not move a solved step.

Boxes of 5 to 40 cm and 3e4 to 1e7 Pa fall, slide and tumble on ground with friction of 0 to 2 (float64). They start on
a face, an edge or in any position. Eight steps of each are solved by 3000 iterations: `Multilevel()` up to friction
0.3, else `Chebyshev(rho=0.99)`. If one keeps more than 1e-5 of its residual, the reference iterates on without rigid
motions, and rigid motions follow. The benchmark counts the solved steps that a rigid motion moves, and the unsolved
ones.
"""

from __future__ import annotations

import sys
from dataclasses import fields
from typing import Any

import numpy as np
import torch
from judge import judge_scenes
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import torchpd as pd
from torchpd.reference import StepProblem, step_problem
from torchpd.reference.solvers import guarded_chebyshev

STEPS = 8
LEFT = 1e-5  # remaining fraction of the residual above which a step is examined
SOLVED = 1e-8  # fraction at which iterations alone have solved it
MOVED = 1e-9  # m: more than rounding
SEED = 11
Row = dict[str, Any]


class Still(StepProblem):
    """A step without rigid motions."""

    def align(self, displacement: NDArray[np.float64], *, first: bool = False) -> NDArray[np.float64]:
        return displacement


def random_tumble(rng: np.random.Generator) -> tuple[Row, pd.Simulator, pd.State]:
    """The random parameters, the simulator, and the state before the impact."""
    size = rng.uniform(0.05, 0.4, 3)
    mesh = pd.shapes.box(tuple(size), tuple(rng.integers(1, 4, 3).tolist()))
    position = ("any", "edge", "face")[rng.integers(3)]
    turn = {"any": Rotation.random(rng=rng), "edge": Rotation.from_euler("z", rng.uniform(0.0, 1.5))}
    vertices = turn.get(position, Rotation.identity()).apply(mesh.vertices.copy())
    time_step = float(rng.choice([1 / 120, 1 / 60, 1 / 30]))
    velocity = np.array([rng.uniform(-2.0, 2.0), -(10.0 ** rng.uniform(-1.0, 0.6)), rng.uniform(-1.0, 1.0)])
    spin = rng.uniform(-5.0, 5.0, 3) * (rng.random() < 0.5)
    velocities = velocity + np.cross(spin, vertices - vertices.mean(axis=0))
    friction = float(rng.choice([0.0, 0.1, 0.3, 1.0, 2.0]))
    ground = float(vertices[:, 1].min() + velocity[1] * time_step * rng.uniform())
    youngs = 10.0 ** rng.uniform(4.5, 7.0)
    scene = pd.Scene(
        pd.Solid(pd.TetMesh(vertices, mesh.tets), youngs), pd.Gravity(), pd.Ground(ground, friction=friction)
    )
    solver = pd.Multilevel() if friction <= 0.3 else pd.Chebyshev(rho=0.99)
    sim = pd.Simulator(scene, time_step, 3000, solver, torch.float64, tolerance=1e-10, progress=False)
    facts = {"vertices": sim.vertices, "position": position, "friction": friction, "youngs": youngs}
    return facts, sim, pd.State(sim.rest_state().positions, torch.from_numpy(velocities)[None].clone())


@torch.no_grad()
def run_scene(number: int) -> Row:
    facts, sim, state = random_tumble(np.random.default_rng([SEED, number]))
    row: Row = {"scene": number, **facts, "time_step": sim.time_step, "steps": STEPS, "left": []}
    for step in range(STEPS):
        before = state.positions[0].numpy(), state.velocities[0].numpy()
        problem = step_problem(sim.scene.values(), *before, sim.time_step)
        state = sim(state)
        residual = residual_of(problem, u := sim.time_step * state.velocities[0].numpy())
        if residual > LEFT:
            row["left"].append({"step": step, "residual": residual, **judge(problem, u)})
    return row


def residual_of(problem: StepProblem, u: NDArray[np.float64]) -> float:
    return problem.relative_residual(u)


def still_problem(problem: StepProblem) -> Still:
    return Still(**{field.name: getattr(problem, field.name) for field in fields(problem)})


def judge(problem: StepProblem, u: NDArray[np.float64]) -> Row:
    """Remaining fraction of the residual after iterations alone, and displacement by the rigid motion after it [m]."""
    still = still_problem(problem)
    solved = guarded_chebyshev(still, u, iterations=1500).displacement
    return {
        "residual of iterations": residual_of(problem, solved),
        "moved": float(np.abs(problem.align(solved) - solved).max()),
    }


def summary(rows: list[Row]) -> Row:
    """Count the unsolved steps, and the solved ones that rigid motions move, by friction."""
    left = [(row["friction"], step) for row in rows for step in row["left"]]
    solved = [(friction, step["moved"]) for friction, step in left if step["residual of iterations"] <= SOLVED]
    moved = [(friction, way) for friction, way in solved if way > MOVED]
    return {
        "steps": sum(row["steps"] for row in rows),
        f"steps that keep more than {LEFT:g} of their residual": len(left),
        "of those: that further iterations do not solve": len(left) - len(solved),
        "of the others: that rigid motions take elsewhere": [{"friction": mu, "moved": way} for mu, way in moved],
    }


if __name__ == "__main__":
    judge_scenes(sys.argv[1:], str(__doc__), 400, run_scene, summary)
