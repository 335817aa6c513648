"""Solvers of a step, as values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch

from ..common.checks import check_scalar, check_whole
from ..common.extension import load_extension

__all__ = [
    "DEFAULT_ITERATIONS",
    "LARGEST_COUNT",
    "Chebyshev",
    "Jacobi",
    "Multilevel",
    "Newton",
    "Solver",
    "SolverName",
    "check_solver",
]

LARGEST_COUNT = 1_000_000_000  # of iterations; the ops have the same limit
Diagonal = Literal["weighted", "plain"]
# settings of a step that do not depend on the solver
_OTHERS = ("iterations", "time_step", "tolerance", "inertial", "report")
_DEFAULTS: dict[str, Any] = {}  # of the others, as csrc/views/settings.def declares them
if load_extension()[0] is not None:  # a solver can be described without it
    from ..common.tables import SETTINGS_TABLE

    _DEFAULTS = {row.name: row.usual for row in SETTINGS_TABLE if row.name not in _OTHERS}
_DESCENDS = ": a step of theta / D descends only there;"


def _keep(solver: Solver, name: str, value: float) -> None:
    """Store a number as a plain float or int, for comparisons and files."""
    object.__setattr__(solver, name, value)


def _keep_within(solver: Solver, name: str, most: int, why: str = ",") -> None:
    """Check that an option lies in (0, most), and store it as a plain number."""
    value, full_name = getattr(solver, name), f"{type(solver).__name__}.{name}"
    number = check_scalar(full_name, value)
    if not 0.0 < number < most:
        raise ValueError(f"{full_name} must lie in (0, {most}){why} got {value}")
    _keep(solver, name, number)


def _check_choice(name: str, value: object, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, choices))}, got {value!r}")


@dataclass(frozen=True)
class Jacobi:
    """Plain Jacobi iterations, without acceleration.

    Args:
        relaxation: theta of x - theta D^-1 grad E, in (0, 2).
        diagonal: "weighted" never raises the energy, on any mesh. "plain" is the diagonal D of projective dynamics'
            matrix A, as in the literature. It diverges if D^-1 A has a spectral radius above 2 / theta.
    """

    relaxation: float = 1.0
    diagonal: Diagonal = "weighted"

    def __post_init__(self) -> None:
        _keep_within(self, "relaxation", 2, _DESCENDS)
        _check_choice("Jacobi.diagonal", self.diagonal, ("weighted", "plain"))

    def settings(self) -> dict[str, Any]:
        """Keyword arguments of the ops."""
        return {
            **_DEFAULTS,
            "schedule": 0,
            "relaxation": float(self.relaxation),
            "weighted": self.diagonal == "weighted",
        }


@dataclass(frozen=True)
class Chebyshev:
    """Jacobi iterations accelerated by the Chebyshev semi-iterative method (Wang 2015; Vyatkin and Dolgovesov 2023).

    "guarded" needs no tuning: rho comes from the weights of the step. Every four iterations it compares energies, and
    restarts the momentum on a rise. "classic" is the recurrence of the papers. It needs `rho` (`torchpd.estimate_rho`)
    and may diverge.

    Args:
        schedule: "guarded" or "classic".
        rho: spectral radius of the Jacobi iteration, in (0, 1). Guarded: None derives it from the step.
        delay: S of the classic schedule, iterations without acceleration; None: 10. Guarded has none.
        relaxation: theta, in (0, 2). None: 1.9 guarded, 1 classic.
        diagonal: "weighted" or "plain", see `Jacobi`. None: weighted when guarded, plain when classic.
    """

    schedule: Literal["guarded", "classic"] = "guarded"
    rho: float | None = None
    delay: int | None = None
    relaxation: float | None = None
    diagonal: Diagonal | None = None

    def __post_init__(self) -> None:
        _check_choice("Chebyshev.schedule", self.schedule, ("guarded", "classic"))
        if self.rho is not None:
            _keep_within(self, "rho", 1)
        if self.relaxation is not None:
            _keep_within(self, "relaxation", 2, _DESCENDS)
        if self.diagonal is not None:
            _check_choice("Chebyshev.diagonal", self.diagonal, ("weighted", "plain"))
        if self.schedule == "classic":
            if self.rho is None:
                raise ValueError(
                    'Chebyshev(schedule="classic") needs rho; torchpd.estimate_rho(sim, state) measures it, '
                    'or take schedule="guarded", which needs none'
                )
            if self.delay is not None:
                _keep(self, "delay", check_whole("Chebyshev.delay", self.delay, minimum=0, maximum=LARGEST_COUNT))
        else:
            if self.delay is not None:
                raise ValueError(f'Chebyshev.delay must be None unless schedule="classic", got {self.delay}')
            if self.diagonal == "plain":
                raise ValueError(
                    'Chebyshev.diagonal must be "weighted" when guarded, since descent needs it, got "plain"'
                )

    def settings(self) -> dict[str, Any]:
        """Keyword arguments of the ops."""
        guarded = self.schedule == "guarded"
        return {
            **_DEFAULTS,
            "schedule": 2 if guarded else 1,
            "relaxation": float(self.relaxation if self.relaxation is not None else (1.9 if guarded else 1.0)),
            "rho": float(self.rho or 0.0),
            "delay": 10 if self.delay is None else int(self.delay),
            "weighted": (self.diagonal or ("weighted" if guarded else "plain")) == "weighted",
        }


_SCHEDULES = {"lbfgs": 3, "momentum": 4}  # numbers of Multilevel.outer in the ops


@dataclass(frozen=True)
class Multilevel:
    """L-BFGS or momentum iterations preconditioned by a multilevel approximation M of A^-1.

    A is the constant matrix of projective dynamics. Use it for stiff bodies, fine meshes and accurate steps: it needs
    one or two dozen iterations at any stiffness and size. An iteration costs 4 to 6 times as much as a Jacobi iteration
    on a CPU, and 11 to 29 times on a GPU. The scene takes longer to compile.

    A line search checks the energy of each iterate, and shortens rejected trials. After twelve of a step, or with
    friction after the first two, accelerated Jacobi iterations follow. "momentum" does not model contacts.

    M is prepared once, for the material of that time (`Simulator.prepare_solver`). An environment with another material
    gets M / s, where s is its largest ratio of inertia or stiffness to that material; `Info.rho` reports the mismatch.
    M holds the pins that are hard in every environment. Further hard pins cost iterations, not accuracy.

    See docs/solvers.md and docs/theory.md.

    Args:
        outer: "lbfgs" corrects M by the last eight steps, and by a coarse space at the current positions: rigid
            motions of up to 64 pieces, for parts that rotate, stiff parts and contacts. "momentum" extrapolates,
            without inner products.
        relaxation: theta of x - theta M grad E, in (0, 2). None: 1.9 for "momentum", else 1.8. "lbfgs" halves it
            while contacts without friction hold vertices, because M is too soft there.
    """

    outer: Literal["lbfgs", "momentum"] = "lbfgs"
    relaxation: float | None = None

    def __post_init__(self) -> None:
        _check_choice("Multilevel.outer", self.outer, tuple(_SCHEDULES))
        if self.relaxation is not None:
            _keep_within(self, "relaxation", 2)

    def settings(self) -> dict[str, Any]:
        """Keyword arguments of the ops."""
        usual = 1.9 if self.outer == "momentum" else 1.8
        return {
            **_DEFAULTS,
            "schedule": _SCHEDULES[self.outer],
            "relaxation": float(self.relaxation if self.relaxation is not None else usual),
        }


@dataclass(frozen=True)
class Newton:
    """Newton's method, each direction by preconditioned conjugate gradients. It runs on a CPU.

    It is meant for stiff cloth and rods, and for accurate answers there. The Hessian is the exact one of every element,
    without its negative eigenvalues. Conjugate gradients leave three tenths of the residual. Their preconditioner is
    that of `Multilevel` with a coarse space made at every iterate, between smoothing steps with the Hessian.

    `iterations` and `Info.iterations` count iterations of conjugate gradients; `Info.restarts` counts steps that were
    shortened. An iteration costs four to seven times as much as one of `Multilevel`. Contacts and the preparation of M
    are those of `Multilevel`.
    """

    def settings(self) -> dict[str, Any]:
        """Keyword arguments of the ops."""
        return {**_DEFAULTS, "schedule": 5, "relaxation": 1.8}


Solver = Jacobi | Chebyshev | Multilevel | Newton
SolverName = Literal["auto", "chebyshev", "jacobi", "multilevel", "newton"]
_NAMED: dict[object, Solver] = {
    "chebyshev": Chebyshev(),
    "jacobi": Jacobi(),
    "multilevel": Multilevel(),
    "newton": Newton(),
}
DEFAULT_ITERATIONS = 64  # without iterations=


def check_solver(solver: object, device: torch.device) -> Solver:
    """Return the solver, also for a name, or refuse what a simulator on this device cannot use."""
    solver = _NAMED.get(solver, solver) if isinstance(solver, str) else solver
    if not isinstance(solver, Solver):
        given = repr(solver) if isinstance(solver, str) else type(solver).__name__
        if isinstance(solver, type):
            given = f"the class {solver.__name__}: write {solver.__name__}()"
        raise TypeError(
            f"Simulator: solver must be Jacobi, Chebyshev, Multilevel, Newton or one of {get_args(SolverName)}, "
            f"got {given}"
        )
    if isinstance(solver, Multilevel) and device.type not in ("cpu", "cuda"):
        raise RuntimeError(f"Simulator: device must be the CPU or a GPU for Multilevel, got {device}")
    if isinstance(solver, Newton) and device.type != "cpu":
        raise RuntimeError(
            f"Simulator: device must be the CPU for Newton, which has no kernels for {device}; keep it there, or take "
            "Multilevel() or Chebyshev()"
        )
    return solver
