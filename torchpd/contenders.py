"""The compiled solvers that studies compare and that `Simulator.tune` chooses from: a further one is one more entry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from .automatic import runs
from .solvers import DEFAULT_ITERATIONS, Chebyshev, Jacobi, Multilevel, Solver
from .spectrum import estimate_rho
from .state import State

if TYPE_CHECKING:
    from .stepper import Stepper

__all__ = ["CANDIDATES", "DEFAULT", "DEFAULT_ITERATIONS", "Candidate", "safe_candidates"]


@dataclass(frozen=True)
class Candidate:
    """A solver by the name that figures give it.

    `make(sim, state)` may run trials from the state; `safe` ones cannot diverge, on any mesh and at any stiffness.
    """

    make: Callable[[Stepper, State], Solver]
    safe: bool
    devices: tuple[str, ...] = ("cpu", "cuda")  # where it runs


def _classic(sim: Stepper, state: State) -> Solver:
    """The schedule of the papers, with the two-stage estimate of rho that goes with it."""
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
}
DEFAULT = "guarded Chebyshev"  # what `Simulator(scene)` does


def safe_candidates(sim: Stepper, state: State) -> dict[str, Solver]:
    """Those that cannot diverge and run where the simulator is, the default first."""
    here = {name: c for name, c in CANDIDATES.items() if c.safe and sim.device.type in c.devices}
    made = {name: here[name].make(sim, state) for name in sorted(here, key=lambda name: name != DEFAULT)}
    return {name: solver for name, solver in made.items() if runs(solver, sim.compiled)}
