"""Candidate solvers of studies and of `Simulator.tune`; add an entry for a new solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..estimate.solver_choice import runs
from ..scene.solvers import DEFAULT_ITERATIONS, Chebyshev, Jacobi, Multilevel, Newton, Solver
from ..simulation.state import HistoryState, State
from .spectral_radius import estimate_rho

if TYPE_CHECKING:
    from ..simulation.stepper import Stepper

__all__ = ["CANDIDATES", "DEFAULT", "DEFAULT_ITERATIONS", "Candidate", "safe_candidates"]


@dataclass(frozen=True)
class Candidate:
    """A solver by its name in figures.

    `make(sim, state)` may run trials from the state. `safe` solvers cannot diverge, on any mesh and at any stiffness.
    """

    make: Callable[[Stepper, State | HistoryState], Solver]
    safe: bool
    devices: tuple[str, ...] = ("cpu", "cuda")  # where it runs
    of_solids: bool = True  # whether `tune` tries it where there are solids alone


def _classic(sim: Stepper, state: State | HistoryState) -> Solver:
    """The schedule of the papers, with their two-stage estimate of rho."""
    own = sim.solver
    sim.solver = Jacobi(diagonal="plain")
    try:
        return Chebyshev("classic", rho=estimate_rho(sim, state))
    finally:
        sim.solver = own


CANDIDATES: dict[str, Candidate] = {
    "Jacobi": Candidate(lambda sim, state: Jacobi(diagonal="plain"), safe=False),
    "damped Jacobi": Candidate(lambda sim, state: Jacobi(relaxation=1.9), safe=True),
    "classic Chebyshev": Candidate(_classic, safe=False),
    "guarded Chebyshev": Candidate(lambda sim, state: Chebyshev(), safe=True),
    "Multilevel": Candidate(lambda sim, state: Multilevel(), safe=True),
    # not "Newton", which is a baseline; on solids it takes three times as long as Multilevel
    "inexact Newton": Candidate(lambda sim, state: Newton(), safe=True, devices=("cpu",), of_solids=False),
}
DEFAULT = "guarded Chebyshev"  # the solver of `Simulator(scene)`


def safe_candidates(sim: Stepper, state: State | HistoryState) -> dict[str, Solver]:
    """Solvers that cannot diverge, run on the simulator's device and suit its scene, the default first."""
    others = sim.compiled.has_stencils
    here = {
        name: c for name, c in CANDIDATES.items() if c.safe and sim.device.type in c.devices and (c.of_solids or others)
    }
    made = {name: here[name].make(sim, state) for name in sorted(here, key=lambda name: name != DEFAULT)}
    return {name: solver for name, solver in made.items() if runs(solver, sim.compiled)}
