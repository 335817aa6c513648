"""Iterations of one step of a beam to an error, at three stiffnesses: the tables of docs/accuracy.md.

The beam of the tests: 1 x 0.2 x 0.2 m, 3750 tetrahedra, held at x = 0, thrown downwards with v_y = -10 x^2, time step
1/30 s, float64. The error is |x - x*| / |x_0 - x*|, with x* from Newton's method and start "inertial".
Jacobi is the source paper's (plain diagonal); the classic schedule uses the paper's two-stage rho.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from machine import describe_run, write_result
from torch import Tensor

import torchpd as pd
from torchpd.accuracy.candidates import CANDIDATES
from torchpd.reference import step_problem
from torchpd.reference.solvers import newton

STIFFNESSES = (1e4, 1e5, 1e6)
ERRORS = (1e-2, 1e-3, 1e-6)
SOLVERS = ("Multilevel", "guarded Chebyshev", "classic Chebyshev", "Jacobi")


def beam(youngs: float) -> tuple[pd.Simulator, pd.State]:
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (25, 5, 5))
    solid = pd.Solid(mesh, youngs=youngs, density=1000.0)
    scene = pd.Scene(solid, pd.Pin(solid, mesh.vertices[:, 0] == 0.0), pd.Gravity((0.0, -9.8, 0.0)))
    sim = pd.Simulator(scene, 1 / 30, 64, dtype=torch.float64)
    state = sim.rest_state()
    state.velocities[..., 1] = -10.0 * state.positions[..., 0] ** 2
    return sim, state


def solution(sim: pd.Simulator, state: pd.State) -> Tensor:
    x, v = (part[0].numpy() for part in state)
    problem = step_problem(sim.scene.values(), x, v, sim.time_step)
    return torch.from_numpy(x + newton(problem, problem.first_iterate("inertial")))


def iterations_to(sim: pd.Simulator, state: pd.State, solved: Tensor, error: float, most: int) -> int | None:
    """Fewest iterations to an error, by bisection; None if `most` are not enough."""

    def error_after(iterations: int) -> float:
        sim.iterations = iterations
        return float((sim(state, start="inertial").positions[0] - solved).norm())

    goal = error * error_after(0)
    low, high = 0, most
    if error_after(most) > goal:
        return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if error_after(middle) <= goal else (middle, high)
    return high


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--most", type=int, default=5000, help="iterations at most")
    parser.add_argument("--errors", type=float, nargs="+", default=ERRORS, help="to reach (%(default)s)")
    parser.add_argument("--out", type=Path, help="output file (JSON)")
    options = parser.parse_args()
    rows = []
    print(f"{'youngs':>8}  {'solver':<20}" + "".join(f"{error:>10.0e}" for error in options.errors))
    for youngs in STIFFNESSES:
        sim, state = beam(youngs)
        solved = solution(sim, state)
        for name in SOLVERS:
            sim.solver = CANDIDATES[name].make(sim, state)
            counts = [iterations_to(sim, state, solved, error, options.most) for error in options.errors]
            rows.append({"youngs": youngs, "solver": name, "iterations": counts})
            cells = (f"> {options.most}" if count is None else str(count) for count in counts)
            print(f"{youngs:>8.0e}  {name:<20}" + "".join(f"{cell:>10}" for cell in cells))
    if options.out:
        run = describe_run(torch.device("cpu"), torch.get_num_threads())
        record = {"schema": 1, **run, "errors": options.errors, "most": options.most, "rows": rows}
        write_result(options.out, record)


if __name__ == "__main__":
    main()
