"""Settings of a simulator and their consequences: the plan, a preconditioner, the choice of "auto".

A change computes a new `Configuration` from the present one. The simulator takes over only a complete one, so a refused
change alters nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch

from ..common.checks import check_has_values
from ..estimate.solver_choice import TOLERANCE, Choice, choose_solver, warn_of_few_iterations
from ..plan.compiled import CompiledScene
from ..plan.kernel_choice import check_kernel
from ..plan.placement import is_suitable, move_plan, plan_for_device, plan_for_solver, recompile_plan
from ..scene.scene import Scene
from ..scene.solvers import Chebyshev, Jacobi, Solver, check_solver
from .state_checks import check_adjoint, check_batch

__all__ = [
    "EVERY_STEP",
    "NO_STEP",
    "SETTINGS",
    "Configuration",
    "check_contact",
    "check_iterations",
    "choose",
    "choose_again",
    "is_auto",
    "moved",
    "prepare",
    "reconfigure",
]

# Shortest and longest time step for which the iterations were checked, and suffice between them. Both ends count: long
# steps converge slowly, and short ones overshoot with a relaxation for long ones.
EVERY_STEP, NO_STEP = (0.0, math.inf), (math.inf, 0.0)
# fields of a `Configuration` that a simulator keeps besides plan, choice and material
SETTINGS = (
    "time_step", "iterations", "tolerance", "solver", "adjoint", "kernel", "batch", "named_iterations",
    "checked_time_steps",
)  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class Configuration(CompiledScene):
    """A compiled scene, with the origin of its iterations."""

    choice: Choice | None  # of "auto"
    named_iterations: bool  # whether the user gave the number of iterations: then no warning about it
    checked_time_steps: tuple[float, float]  # range of time steps [s] that needs no further check


def check_contact(
    scene: Scene, *, solver: Solver | None = None, adjoint: str = "solver", device: torch.device | None = None
) -> None:
    """Refuse settings that a scene with `Contact` cannot have."""
    if scene.contact is None:
        return
    if not isinstance(solver, Chebyshev | Jacobi | None):
        raise TypeError(
            f"Simulator: solver must be Chebyshev or Jacobi in a scene with Contact, got {type(solver).__name__}; "
            "leave it out, or remove Contact"
        )
    if adjoint != "solver":
        raise ValueError(
            f'Simulator: adjoint must be "solver" in a scene with Contact, whose gradients have a solver of their own, '
            f"got {adjoint!r}; leave it out"
        )
    if device is not None and device.type not in ("cpu", "cuda"):
        raise RuntimeError(
            f"Simulator: device must be a CPU or a GPU in a scene with Contact, got {device}; contact between bodies "
            "has no kernels there: leave device out, or remove Contact"
        )


def is_auto(solver: object) -> bool:
    """Whether a solver is "auto"."""
    return isinstance(solver, str) and solver == "auto"


def reconfigure(now: Configuration, **changes: Any) -> Configuration:
    """The configuration with another `batch`, `kernel`, `solver` or `adjoint`, and all consequences."""
    for name, value in changes.items():
        now = _CHANGES[name](now, value)
    return now


def _with_batch(now: Configuration, batch: int | None) -> Configuration:
    return _planned_anew(replace(now, batch=check_batch(batch)))


def _with_kernel(now: Configuration, kernel: str) -> Configuration:
    now = replace(now, kernel=check_kernel(kernel))
    return now if now.plan.kernel is None else _planned_anew(now)


def _with_solver(now: Configuration, solver: Any) -> Configuration:
    if is_auto(solver):
        return choose(now, None)
    checked = check_solver(solver, now.device)
    check_contact(now.scene, solver=checked)
    return _solved_by(now, checked)


def _with_adjoint(now: Configuration, adjoint: str) -> Configuration:
    check_contact(now.scene, adjoint=check_adjoint(adjoint))
    now = replace(now, adjoint=adjoint)
    if is_suitable(now):
        return now
    check_has_values("adjoint", now.device)
    return replace(now, plan=plan_for_solver(now))


_CHANGES: dict[str, Callable[[Configuration, Any], Configuration]] = {
    "batch": _with_batch,
    "kernel": _with_kernel,
    "solver": _with_solver,
    "adjoint": _with_adjoint,
}


def prepare(now: Configuration) -> Configuration:
    """The configuration with everything that depends on the material made again, see `Simulator.prepare_solver`."""
    check_has_values("prepare_solver", now.device)
    new = choose_again(now)
    return new if new.plan is not now.plan else replace(new, plan=plan_for_solver(new))


def moved(now: Configuration, dtype: torch.dtype, device: torch.device) -> Configuration:
    """The configuration with the plan of another precision or device, where the material will be."""
    if device.type == "cuda":
        check_solver(now.solver, device)
    return replace(now, plan=plan_for_device(now, dtype, device))


def check_iterations(now: Configuration, changed: str | None) -> Configuration:
    """Warn once if default iterations are too few after a change of `changed`; waits for a GPU until then."""
    if now.checked_time_steps == EVERY_STEP:
        return now
    if warn_of_few_iterations(now, now.choice, changed):
        return replace(now, checked_time_steps=EVERY_STEP)
    shortest, longest = NO_STEP if changed != "time_step" else now.checked_time_steps
    return replace(now, checked_time_steps=(min(shortest, now.time_step), max(longest, now.time_step)))


def _planned_anew(now: Configuration) -> Configuration:
    """Make a GPU's plan and the choice of "auto" again, after a change of their inputs."""
    # "auto" starts from a plan for Chebyshev
    if now.plan.kernel is not None and not (now.choice is not None and now.plan.for_multilevel):
        now = replace(now, plan=move_plan(now, recompile_plan(now, now.dtype, now.device), now.device))
    return choose_again(now)


def _solved_by(now: Configuration, solver: Solver) -> Configuration:
    # the same number of iterations means another error for another solver
    checked = EVERY_STEP if now.named_iterations else NO_STEP
    now = replace(now, solver=solver, choice=None, checked_time_steps=checked)
    return now if is_suitable(now) else replace(now, plan=plan_for_solver(now))


def choose(now: Configuration, iterations: int | None) -> Configuration:
    """Choose as "auto" does, see `choose_solver`."""
    if now.plan.for_multilevel:
        now = _solved_by(now, Chebyshev())  # the costs are compared with the kernel of Chebyshev
    solver, choice = choose_solver(now, iterations)
    named = not choice.sets_iterations
    tolerance = now.tolerance if named or now.tolerance > 0.0 else TOLERANCE
    now = replace(_solved_by(now, solver), choice=choice, iterations=choice.iterations, tolerance=tolerance)
    return check_iterations(
        replace(now, named_iterations=named, checked_time_steps=EVERY_STEP if named else NO_STEP), None
    )


def choose_again(now: Configuration) -> Configuration:
    """Repeat the choice of "auto", if there is one; iterations and tolerance that were set since stay."""
    if now.choice is None:
        return now
    own = now.choice.sets_iterations and now.iterations == now.choice.iterations
    return replace(choose(now, None if own else now.iterations), tolerance=now.tolerance)
