"""Spectral radius of the Jacobi iteration, which the classic Chebyshev schedule needs."""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING, Literal, cast

import torch
from torch import Tensor

from .solvers import Chebyshev, Jacobi
from .state import State

if TYPE_CHECKING:
    from .simulator import Simulator

__all__ = ["estimate_rho", "jacobi_diagonal"]

_LARGEST = 0.99999
_ops = torch.ops.torchpd


def jacobi_diagonal(sim: Simulator, *, weighted: bool = True) -> tuple[Tensor, Tensor]:
    """Inertia a and diagonal D of every vertex, [V] or [B, V], in N/m; D is infinite on hard pins.

    D_i = a_i + sum_e l_e w_e V_e |grad N_i|^2, a_i = m_i / h^2 (1 + damping h) + k_i; l_e = 1 when not weighted.
    """
    plan = sim.plan
    lanes = plan.tet_rest.unflatten(1, (3, 3, 16)).permute(0, 3, 1, 2).reshape(-1, 3, 3)
    gradients = torch.cat([-lanes.sum(1, keepdim=True), lanes], dim=1).square().sum(-1)
    volume = plan.tet_volume.reshape(-1) * (plan.tet_bound.reshape(-1) if weighted else 1.0)
    stiffness = sim.stiffness[..., plan.tet_order.reshape(-1).long()]
    share = (stiffness * volume).unsqueeze(-1) * gradients
    blocks_of = plan.patch_block.diff().long()
    first_slot = plan.patch_slot[:-1].repeat_interleave(blocks_of)
    slots = plan.tet_corner.unflatten(1, (4, 16)).transpose(1, 2).int() + first_slot[:, None, None]
    vertex = plan.vertex_order[plan.slot_vertex[slots.reshape(-1).long()].long()].long()

    springs = torch.zeros(*sim.pin_stiffness.shape[:-1], sim.vertices, dtype=sim.dtype, device=sim.device)
    pinned = plan.vertex_order[plan.pin_vertex.long()].long()
    springs = springs.index_copy(-1, pinned, sim.pin_stiffness)
    h = sim.time_step
    inertia = sim.masses / h**2 * (1 + sim.damping.unsqueeze(-1) * h) + springs
    elastic = torch.zeros(*share.shape[:-2], sim.vertices, dtype=sim.dtype, device=sim.device)
    elastic = elastic.index_add(-1, vertex, share.flatten(-2))
    return inertia, inertia + elastic


def _bound(sim: Simulator) -> float:
    numbers = sim.solver.numbers()
    inertia, diagonal = jacobi_diagonal(sim, weighted=numbers["weighted"])
    ratio = torch.where(torch.isinf(inertia), torch.ones_like(inertia), inertia / diagonal)
    return 1.0 - numbers["relaxation"] * float(ratio.min())


def _power(sim: Simulator, state: State, iterations: int) -> float:
    """Largest |eigenvalue| of I - theta D^-1 H at the state, H the Hessian of the step's objective."""
    numbers = sim.solver.numbers()
    inertia, diagonal = (t.unsqueeze(-1) for t in jacobi_diagonal(sim, weighted=numbers["weighted"]))
    free = torch.isfinite(inertia)
    inertia = torch.where(free, inertia, torch.zeros_like(inertia))
    generator = torch.Generator().manual_seed(0)
    vector = torch.randn(state[0].shape, generator=generator, dtype=torch.float64).to(state[0])
    scale = torch.zeros((), dtype=sim.dtype)
    for _ in range(iterations):
        vector = torch.where(free, vector, torch.zeros_like(vector))
        vector = vector / vector.norm()
        product = inertia * vector + _ops.hessian_product(state[0], vector, sim.stiffness, list(sim.plan.arrays))
        vector = vector - numbers["relaxation"] * product / diagonal
        scale = vector.norm()
    return float(scale)


def _trial(sim: Simulator, solver: Jacobi | Chebyshev, iterations: int) -> Simulator:
    """The same simulation, sharing plan and material, with another solver."""
    trial = copy.copy(sim)
    trial.solver, trial.iterations, trial.tolerance = solver, iterations, 0.0
    return trial


def _residual(sim: Simulator, state: State, solver: Jacobi | Chebyshev, iterations: int) -> float:
    _, info = _trial(sim, solver, iterations)(state, return_info=True)
    worst = float(cast(Tensor, info.residual).max())
    return worst if math.isfinite(worst) else math.inf


def _two_stage(sim: Simulator, state: State, iterations: int) -> float:
    """The pre-simulation of the source paper: a ratio of residuals, then trial runs around it."""
    numbers = sim.solver.numbers()
    diagonal: Literal["weighted", "plain"] = "weighted" if numbers["weighted"] else "plain"
    jacobi = Jacobi(relaxation=numbers["relaxation"], diagonal=diagonal)
    before, after = (_residual(sim, state, jacobi, k) for k in (iterations - 1, iterations))
    first = min(after / before, _LARGEST) if 0.0 < before < math.inf else 0.9
    best = (math.inf, first)
    for halvings in range(-1, 8):
        rho = min(max(1.0 - (1.0 - first) * 0.5**halvings, 0.05), _LARGEST)
        solver = Chebyshev("classic", rho=rho, relaxation=numbers["relaxation"], diagonal=diagonal)
        best = min(best, (_residual(sim, state, solver, iterations), rho))
    return best[1]


@torch.no_grad()
def estimate_rho(
    sim: Simulator,
    state: State,
    method: Literal["two-stage", "power", "bound"] = "two-stage",
    *,
    iterations: int = 64,
) -> float:
    """Spectral radius of the Jacobi iteration of `sim`, with the relaxation and diagonal of its solver.

    Args:
        sim: the simulator.
        state: a representative state; the worst environment counts.
        method: "two-stage" is the source paper's pre-simulation: |e^K| / |e^{K-1}| with e = grad E, then trial runs
            (it comes out low where convergence is slow: 0.997 where the truth is 0.9997). "power" iterates the
            linearisation at the state. "bound" is 1 - theta min(a / D), from the weights alone; it needs no run and is
            never too low for a solver that converges.
        iterations: K of the first stage and length of a trial, or steps of the power iteration.

    Returns:
        rho in (0, 1).

    Source: Vyatkin and Dolgovesov 2023; Wang 2015, section 4.
    """
    if iterations < 2:
        raise ValueError(f"estimate_rho: iterations must be >= 2, got {iterations}")
    if method == "bound":
        rho = _bound(sim)
    elif method == "power":
        rho = _power(sim, state, iterations)
    elif method == "two-stage":
        rho = _two_stage(sim, state, iterations)
    else:
        raise ValueError(f'estimate_rho: method must be "two-stage", "power" or "bound", got {method!r}')
    return min(max(rho, 1e-3), _LARGEST)
