"""Runs a `Case` in the simulator, in any precision and batch, and in the reference from the very same numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from cases import Array, Case

import torchpd as pd
from torchpd.reference import StepProblem, step_problem
from torchpd.reference_solvers import Iterates, classic_chebyshev, guarded_chebyshev, jacobi

ULP = {torch.float32: 2.0**-24, torch.float64: 2.0**-53}  # rounding of one operation, relative


def simulator(case: Case, dtype: torch.dtype, device: torch.device | str = "cpu", **options: Any) -> pd.Simulator:
    """The scene and time step of a case, compiled."""
    return pd.Simulator(case.scene, case.time_step, dtype=dtype, progress=False, **options).to(device)


def state_of(case: Case, sim: pd.Simulator, batch: int = 1) -> pd.State:
    """The state that the case starts from, [batch, V, 3]."""
    return pd.State(*(tensor_of(array, sim, batch) for array in (case.positions, case.velocities)))


def tensor_of(array: Array, sim: pd.Simulator, batch: int | None = None) -> torch.Tensor:
    """The array in the simulator's type; with a batch [batch, ...], the same for every environment."""
    tensor = torch.tensor(array, dtype=sim.dtype, device=sim.device)
    return tensor if batch is None else tensor.expand(batch, *tensor.shape).clone()


def arguments_of(case: Case, sim: pd.Simulator, batch: int = 1) -> dict[str, Any]:
    """What the simulator takes besides the state: start, forces, targets."""
    start = case.start if isinstance(case.start, str) else tensor_of(case.start, sim, batch)
    out: dict[str, Any] = {"start": start}
    if "forces" in case.extras:
        out["forces"] = tensor_of(case.extras["forces"], sim, batch)
    targets: dict[Any, torch.Tensor] = {}
    if "pin_targets" in case.extras:
        for pin in case.scene.pins:
            targets[pin] = tensor_of(case.extras["pin_targets"][case.scene.pin_range(pin)], sim, batch)
    if "sphere_centers" in case.extras:
        centers, starts = case.extras["sphere_centers"], case.extras["sphere_starts"]
        rows = np.concatenate([centers, (centers - starts) / case.time_step], axis=1)
        for sphere, row in zip(case.scene.spheres, rows, strict=True):
            targets[sphere] = tensor_of(row, sim, batch)
    return {**out, "targets": targets} if targets else out


def displacement(sim: pd.Simulator, after: pd.State, item: int = 0) -> Array:
    """x_{t+1} - x_t from the velocity, which keeps more digits than the difference of positions [V, 3]."""
    u: Array = after.velocities[item].double().cpu().numpy() * sim.time_step
    return u


def rounded_problem(case: Case, dtype: torch.dtype) -> StepProblem:
    """The step in the reference, from the state that `dtype` can hold."""
    seen = np.float32 if dtype == torch.float32 else np.float64
    x, v = (array.astype(seen).astype(np.float64) for array in (case.positions, case.velocities))
    return step_problem(case.scene.values(), x, v, case.time_step, **case.extras)


def reference_run(problem: StepProblem, first: Array, solver: pd.Jacobi | pd.Chebyshev, iterations: int) -> Iterates:
    """The iterations of `solver` in the reference."""
    numbers = solver.numbers()
    if isinstance(solver, pd.Jacobi):
        return jacobi(problem, first, iterations=iterations, relaxation=solver.relaxation, weighted=numbers["weighted"])
    if solver.schedule == "classic":
        return classic_chebyshev(
            problem, first, iterations=iterations, rho=numbers["rho"], delay=numbers["delay"],
            relaxation=numbers["relaxation"], weighted=numbers["weighted"],
        )  # fmt: skip
    return guarded_chebyshev(problem, first, iterations=iterations, relaxation=numbers["relaxation"], rho=solver.rho)
