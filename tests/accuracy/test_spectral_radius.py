"""The spectral radius of the Jacobi iteration, estimated in three ways."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from cases import beam
from runs import same_bits, simulator, state_of

import torchpd as pd

pytestmark = pytest.mark.usefixtures("poisoned")


@pytest.fixture(scope="module")
def stiff_beam() -> tuple[pd.Simulator, pd.State]:
    case = beam(1e6)
    sim = simulator(case, torch.float64, solver=pd.Jacobi(diagonal="plain"))
    return sim, state_of(case, sim)


@pytest.mark.parametrize(
    ("method", "low", "high"), [("power", 0.995, 0.99915), ("bound", 0.9991, 1.0), ("two-stage", 0.98, 0.99915)]
)
def test_estimates_of_the_spectral_radius(
    method: Any, low: float, high: float, stiff_beam: tuple[pd.Simulator, pd.State]
) -> None:
    """The smallest eigenvalue of D^-1 A is 8.98e-4: power iterations rise to 0.99910, the bound lies above it."""
    sim, state = stiff_beam
    rho = pd.estimate_rho(sim, state, method)
    assert low <= rho <= high


def test_estimated_radius_accelerates(stiff_beam: tuple[pd.Simulator, pd.State]) -> None:
    sim, state = stiff_beam
    rho = pd.estimate_rho(sim, state)
    settings = sim.solver, sim.iterations
    residuals = []
    for solver in (sim.solver, pd.Chebyshev("classic", rho=rho)):
        sim.solver, sim.iterations = solver, 200
        residuals.append(float(sim(state, return_info=True)[1].residual))
    sim.solver, sim.iterations = settings
    # 200 iterations at 0.9991 and at the accelerated 0.96 of it, of which the delay of 10 costs little
    assert residuals[1] < 0.2 * residuals[0]


def test_estimate_leaves_the_simulator_alone(stiff_beam: tuple[pd.Simulator, pd.State]) -> None:
    sim, state = stiff_beam
    before = sim(state)
    for method in ("two-stage", "power", "bound"):
        pd.estimate_rho(sim, state, method, iterations=20)  # type: ignore[arg-type]
    assert same_bits(sim(state), before)
    assert sim.solver == pd.Jacobi(diagonal="plain")
    with pytest.raises(ValueError, match=r"method .*got 'exact'"):
        pd.estimate_rho(sim, state, "exact")  # type: ignore[arg-type]
    for part, wrong in ((0, pd.State(state[0] * torch.nan, state[1])), (1, pd.State(state[0], state[1] / 0.0))):
        with pytest.raises(ValueError, match=f"estimate_rho: state.{state._fields[part]} must be finite"):
            pd.estimate_rho(sim, wrong)
    with pytest.raises(ValueError, match=r"estimate_rho: state .*got \[0, \d+, 3\]"):
        pd.estimate_rho(sim, sim.rest_state(0))
    with pytest.raises(TypeError, match=r"state .*got NoneType"):
        pd.estimate_rho(sim, None, "power")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"iterations .*got 1"):
        pd.estimate_rho(sim, state, iterations=1)
