"""Spectral radius of the Jacobi iteration, which the classic Chebyshev schedule needs."""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from ..common.checks import check_has_values
from ..ops.diagonal import has_damping, step_diagonal
from ..scene.solvers import Chebyshev, Jacobi
from ..simulation.state import HistoryState, State

if TYPE_CHECKING:
    from ..simulation.stepper import Stepper

__all__ = ["estimate_rho"]

_LARGEST = 0.99999
_ops = torch.ops.torchpd


def _diagonal(sim: Stepper) -> tuple[Tensor, Tensor]:
    weighted = sim.solver.settings()["weighted"]
    return step_diagonal(sim.plan.arrays, sim.material(), sim.time_step, weighted=weighted)


def _bound(sim: Stepper) -> float:
    settings = sim.solver.settings()
    inertia, diagonal = _diagonal(sim)
    ratio = torch.where(torch.isinf(inertia), torch.ones_like(inertia), inertia / diagonal)
    relaxation: float = settings["relaxation"]
    return 1.0 - relaxation * float(ratio.min())


def _power(sim: Stepper, state: State | HistoryState, iterations: int) -> float:
    """Largest |eigenvalue| of I - theta D^-1 H at the state; H is the Hessian of the step's objective."""
    settings = sim.solver.settings()
    inertia, diagonal = (t.unsqueeze(-1) for t in _diagonal(sim))
    free = torch.isfinite(inertia)
    inertia = torch.where(free, inertia, torch.zeros_like(inertia))
    generator = torch.Generator().manual_seed(0)
    vector = torch.randn(state[0].shape, generator=generator, dtype=torch.float64, device="cpu").to(state[0])
    scale, material, plan = torch.zeros((), dtype=sim.dtype), sim.material(), list(sim.plan.arrays)
    for _ in range(iterations):
        vector = torch.where(free, vector, torch.zeros_like(vector))
        vector = vector / vector.norm()
        product = inertia * vector + _ops.hessian_product(state[0], vector, material, plan)
        if has_damping(material):
            damping, *_ = _ops.damping_vjp(state[0], state[0], vector, material, plan, time_step=sim.time_step)
            product = product + damping
        vector = vector - settings["relaxation"] * product / diagonal
        scale = vector.norm()
    return float(scale)


def _trial(sim: Stepper, solver: Jacobi | Chebyshev, iterations: int) -> Stepper:
    """A copy of the simulation with another solver, sharing plan and material."""
    trial = copy.copy(sim)
    trial.solver, trial.iterations, trial.tolerance = solver, iterations, 0.0
    return trial


def _residual(sim: Stepper, state: State | HistoryState, solver: Jacobi | Chebyshev, iterations: int) -> float:
    _, info = _trial(sim, solver, iterations)(state, return_info=True)
    worst = float(info.residual.max())
    return worst if math.isfinite(worst) else math.inf


def _two_stage(sim: Stepper, state: State | HistoryState, iterations: int) -> float:
    """The pre-simulation of the source paper: a ratio of residuals, then trial runs around it."""
    settings = sim.solver.settings()
    diagonal: Literal["weighted", "plain"] = "weighted" if settings["weighted"] else "plain"
    jacobi = Jacobi(relaxation=settings["relaxation"], diagonal=diagonal)
    before, after = (_residual(sim, state, jacobi, k) for k in (iterations - 1, iterations))
    first = min(after / before, _LARGEST) if 0.0 < before < math.inf else 0.9
    best = (math.inf, first)
    for halvings in range(-1, 8):
        rho = min(max(1.0 - (1.0 - first) * 0.5**halvings, 0.05), _LARGEST)
        solver = Chebyshev("classic", rho=rho, relaxation=settings["relaxation"], diagonal=diagonal)
        best = min(best, (_residual(sim, state, solver, iterations), rho))
    return best[1]


def _check_state(sim: Stepper, state: State | HistoryState) -> None:
    check_has_values("estimate_rho", sim.device)
    positions = sim.positions_of(state)
    if not len(positions):
        raise ValueError(f"estimate_rho: state must hold at least one environment, got {list(positions.shape)}")
    for name, part in zip(State._fields, state[:2], strict=True):
        if not bool(part.isfinite().all()):
            raise ValueError(f"estimate_rho: state.{name} must be finite, got NaN or infinity")


@torch.no_grad()
def estimate_rho(
    sim: Stepper,
    state: State | HistoryState,
    method: Literal["two-stage", "power", "bound"] = "two-stage",
    *,
    iterations: int = 64,
) -> float:
    """Spectral radius of the Jacobi iteration of `sim`, with the relaxation and diagonal of its solver.

    "two-stage" is the pre-simulation of the source paper: |e^K| / |e^{K-1}| with e = grad E, then trial runs. It comes
    out low where convergence is slow: 0.997 instead of 0.9997. "power" iterates the linearisation at the state. "bound"
    is 1 - theta min(a / D), from the weights alone. It needs no run, and is never too low for a solver that converges.

    Args:
        sim: the simulator.
        state: a representative state; the worst environment counts.
        method: "two-stage", "power" or "bound".
        iterations: K of the first stage and length of a trial, or steps of the power iteration.

    Returns:
        rho in (0, 1).

    Source: Vyatkin and Dolgovesov 2023; Wang 2015, section 4.
    """
    _check_state(sim, state)
    if iterations < 20:
        raise ValueError(f"estimate_rho: iterations must be >= 20, so that trials can accelerate; got {iterations}")
    if method == "bound":
        rho = _bound(sim)
    elif method == "power":
        rho = _power(sim, state, iterations)
    elif method == "two-stage":
        rho = _two_stage(sim, state, iterations)
    else:
        raise ValueError(f'estimate_rho: method must be "two-stage", "power" or "bound", got {method!r}')
    return min(max(rho, 1e-3), _LARGEST)
