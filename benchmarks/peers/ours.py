"""This library: one step with n iterations, or n smaller steps, each with the iterations of "auto"."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

import torchpd as pd
from torchpd.scene.solvers import Solver

from .problem import Method, Problem
from .timing import fastest

Array = NDArray[np.float64]


def _start(problem: Problem, sim: pd.Simulator) -> pd.State:
    state = sim.rest_state()
    state.positions[:] = torch.tensor(problem.start).to(state.positions)
    state.velocities[:] = torch.tensor(problem.velocities).to(state.velocities)
    return state


def _compiled(
    problem: Problem, device: str, time_step: float, solver: Solver | str, dtype: torch.dtype = torch.float32
) -> tuple[pd.Simulator, pd.State]:
    iterations = None if solver == "auto" else 64
    sim = pd.Simulator(problem.scene(), time_step, iterations, solver, dtype, batch=1, progress=False).to(device)
    return sim, _start(problem, sim)


def step(problem: Problem, device: str, solver: Solver, name: str, dtype: torch.dtype = torch.float32) -> Method:
    """One step with n iterations."""
    sim, state = _compiled(problem, device, problem.time_step, solver, dtype)

    @torch.no_grad()
    def run(iterations: int) -> Array:
        sim.iterations = iterations
        return np.asarray(sim(state).velocities[0].double().cpu() * sim.time_step)

    def milliseconds(iterations: int) -> float:
        sim.iterations = iterations
        with torch.no_grad():
            return fastest(lambda: sim(state), device)

    return Method(name, run, milliseconds)


def converged(problem: Problem, solver: Solver | None = None) -> tuple[Array, float]:
    """The converged step in float64, and |grad E| there over that at the start."""
    exact, iterations = problem.exact
    sim = pd.Simulator(
        problem.scene(), problem.time_step, iterations, solver or exact, torch.float64, progress=False
    )  # fmt: skip
    with torch.no_grad():
        after, info = sim(_start(problem, sim), return_info=True)
    return np.asarray(after.velocities[0] * sim.time_step), float(info.residual)


def substeps(problem: Problem, device: str) -> Method:
    """The same time in n steps."""

    def compiled(count: int) -> tuple[pd.Simulator, pd.State]:
        return _compiled(problem, device, problem.time_step / count, "auto")

    def run(count: int) -> Array:
        sim, state = compiled(count)
        end = sim.rollout(state, count, every=count).state().positions[0]
        return np.asarray(end.double().cpu() - state.positions[0].double().cpu())

    def milliseconds(count: int) -> float:
        sim, state = compiled(count)
        return fastest(lambda: sim.rollout(state, count, every=count), device)

    return Method('torchpd, solver="auto"', run, milliseconds)
