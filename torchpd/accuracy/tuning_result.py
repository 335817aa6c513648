"""The result of `Simulator.tune`, and estimates of a step's error from it."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from ..common.synonyms import Renamed
from ..plan.cpu_plan import Plan
from ..plan.material import fingerprint
from ..scene.solvers import Solver
from ..scene.targets import Targets
from ..simulation.state import Info, State
from .unsolved_step import ROUNDINGS, unsolved_step

__all__ = ["Trial", "TuningResult"]


class Tuned(Protocol):
    """The parts of a simulator that a tuning result reads."""

    plan: Plan
    iterations: int
    tolerance: float
    body_contact: Any

    @property
    def time_step(self) -> float: ...

    @property
    def solver(self) -> Solver: ...

    @property
    def dtype(self) -> torch.dtype: ...

    @property
    def device(self) -> torch.device: ...

    @property
    def tuning_result(self) -> Any: ...

    def material(self) -> list[Tensor]: ...

    def material_at(self, targets: Targets | None, batch: int) -> list[Tensor]: ...

    def load_values(self, targets: Targets | None, batch: int) -> dict[str, Tensor]: ...

    def __call__(self, *args: Any, **kwargs: Any) -> Any: ...


class Trial(NamedTuple):
    """One candidate at one iteration count."""

    solver: Solver
    iterations: int
    error: float  # worst over the states, beyond rounding
    residuals: tuple[float, ...]  # of the states
    errors: tuple[float, ...] = ()  # of the states


@dataclass(frozen=True)
class TuningResult:
    """Solver and iterations chosen by `Simulator.tune`, with the error to expect for similar motions of this material.

    The error bound of a step is |x - x*| <= error |x_0 - x*| + 10 eps |x|. Here x* is the converged step with
    friction, x_0 = x + h v, and eps the machine epsilon. The last term matters when a step changes little, for example
    when a body comes to rest.

    See docs/accuracy.md for how to use it.
    """

    requested_error: float | None
    requested_milliseconds: float | None
    attained: bool  # whether the request was met; if not, error and milliseconds are the best found
    solver: Solver
    iterations: int
    error: float  # expected bound of a step; no finer than rounding, unless that was requested
    studied_error: float  # worst of the study
    rounding: float  # largest 10 eps |x| / |x_0 - x*| of the study, which may come on top of `error`
    milliseconds: float  # median of sim(state) for the batch of the study, on the machine where it ran
    residual_limit: float  # `info.residual` above which `is_valid` is False
    error_per_residual: float  # largest ratio in the study
    # largest error in the study of a step with residual 0, at as many iterations or slightly fewer
    error_at_zero_residual: float
    time_step: float  # s
    dtype: torch.dtype
    device: str
    batch: int
    trials: tuple[Trial, ...]
    material: str  # fingerprint of the arrays
    left_out: str = ""  # a solver that was not tried though it might do better, and why
    # set by `Simulator.set_material`, and by `matches` for its own simulator
    other_material: bool = field(default=False, compare=False)

    holds = Renamed("is_valid")
    audit = Renamed("verify")
    covers = Renamed("matches")
    doubt = Renamed("invalidate")
    asked_error = Renamed("requested_error")
    asked_milliseconds = Renamed("requested_milliseconds")
    unseen_error = Renamed("error_at_zero_residual")

    def is_valid(self, info: Info) -> Tensor:
        """Whether the error bound can be relied on [B] (bool), judged by the residual of the step.

        The test is `info.residual <= residual_limit`, with a limit calibrated on the studied states; a NaN residual
        fails it. Residuals weigh short waves and errors long ones, so most steps that exceed the bound have an ordinary
        residual: use `estimate` and `verify` for those. False everywhere after `set_material` has changed the material;
        changes that an optimiser writes in place are found by `matches` alone.

        Args:
            info: from `state, info = sim(state, return_info=True)`.
        """
        return (_info(info, "is_valid").residual <= self.residual_limit) & (not self.other_material)

    @torch.no_grad()
    def verify(
        self,
        sim: Tuned,
        state: State,
        after: State,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        *,
        info: Info | None = None,
    ) -> Tensor:
        """Relative error of a step beyond rounding [B], measured by solving the step further.

        It is the least e >= 0 with |x - x'| <= e |x_0 - x'| + 10 eps |x|. x' is the solution after three times as many
        further iterations. Costs three steps, with `Contact` four. Too low where those iterations change little.

        Args:
            sim: the tuned simulator.
            state: the start of the step.
            after: the end of the step.
            forces: the forces of the step.
            targets: the targets of the step.
            info: the report of the step. Environments whose `estimate` is within `error` get that estimate. If all
                are, as in two of three steps within the bound, nothing is solved. Reading it waits for a GPU.
        """
        if info is not None:
            estimate = self.estimate(info)
            trusted = (estimate <= self.error) & (not self.other_material)  # NaN is not trusted
            if bool(trusted.all()):
                return estimate
            return torch.where(trusted, estimate, self.verify(sim, state, after, forces, targets))
        further = copy.copy(sim)
        # a scene with `Contact` takes no positions to go on from
        anew = sim.body_contact is not None
        further.iterations, further.tolerance = (4 if anew else 3) * self.iterations, 0.0
        solved: Tensor = further(state, forces, targets, start="velocity" if anew else after[0])[1]
        material = sim.material_at(targets, len(state[0]))
        # displacements over the time step are velocities
        first = unsolved_step(sim.plan, material, sim.time_step, state) / self.time_step
        error = (solved - after[1]).flatten(1).norm(dim=1)
        rounding = ROUNDINGS * torch.finfo(self.dtype).eps * state[0].flatten(1).norm(dim=1) / self.time_step
        # a body at rest has no error
        scale = (solved - first).flatten(1).norm(dim=1).clamp(min=torch.finfo(self.dtype).tiny)
        beyond: Tensor = (error - rounding).clamp(min=0.0) / scale
        return beyond

    def estimate(self, info: Info) -> Tensor:
        """Estimate of a step's relative error [B] from its residual; NaN without a report.

        max(error_per_residual * residual, error_at_zero_residual). Rounding can hide forces, so steps with residual 0
        may have a large error for stiff bodies in float32. The estimate is pessimistic: in float32 it exceeds `error`
        on one of three steps within the bound; `verify` measures these.

        Args:
            info: from `state, info = sim(state, return_info=True)`.
        """
        return (_info(info, "estimate").residual * self.error_per_residual).clamp(min=self.error_at_zero_residual)

    def matches(self, sim: Tuned) -> bool:
        """Whether the simulator still has the settings and the material of the study; waits for a GPU."""
        now = (sim.solver, sim.iterations, sim.time_step, sim.dtype, str(sim.device), sim.tolerance)
        other = self.other_material
        if now[3:5] == (self.dtype, self.device):
            other = fingerprint([*sim.material(), *sim.load_values(None, 1).values()]) != self.material
            if sim.tuning_result is self:
                self.invalidate(other)
        return now == (self.solver, self.iterations, self.time_step, self.dtype, self.device, 0.0) and not other

    def invalidate(self, other: bool) -> None:
        """Record whether the simulator's material differs from that of the study."""
        object.__setattr__(self, "other_material", other)

    def __str__(self) -> str:
        error = self.requested_error
        wanted = f"{self.requested_milliseconds:g} ms" if error is None else f"error {error:g}"
        why = f"{wanted} not reached; {self.left_out}" if self.left_out else f"{wanted} cannot be reached"
        verdict = "" if self.attained else f" ({why})"
        rounding = f" plus rounding of up to {self.rounding:.1e}" if self.rounding > 0.1 * self.error else ""
        other = ", for another material than the present one" if self.other_material else ""
        return f"error {self.error:.1e}{rounding}, {self.milliseconds:.2g} ms per step of {self.batch}{verdict}{other}"


def _info(info: object, name: str) -> Info:
    if not isinstance(info, Info):
        given = type(info).__name__
        raise TypeError(f"{name}: info must be an Info, from `state, info = sim(state, return_info=True)`, got {given}")
    return info
