"""What `Simulator.tune` promises, and how a run is watched by it."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from .accuracy import ROUNDINGS
from .course import course_of
from .material import fingerprint
from .plan import Plan
from .solvers import Solver
from .state import Info, State
from .targets import Targets

__all__ = ["Promise", "Trial"]


class Tuned(Protocol):
    """What a promise reads of a simulator."""

    plan: Plan
    iterations: int
    tolerance: float

    @property
    def time_step(self) -> float: ...

    @property
    def solver(self) -> Solver: ...

    @property
    def dtype(self) -> torch.dtype: ...

    @property
    def device(self) -> torch.device: ...

    @property
    def promise(self) -> Any: ...

    def material(self) -> list[Tensor]: ...

    def material_at(self, targets: Targets | None, batch: int) -> list[Tensor]: ...

    def __call__(self, *args: Any, **kwargs: Any) -> Any: ...


class Trial(NamedTuple):
    """One candidate at one iteration count."""

    solver: Solver
    iterations: int
    error: float  # worst over the states, beyond rounding
    residuals: tuple[float, ...]  # of the states
    errors: tuple[float, ...] = ()  # of the states


@dataclass(frozen=True)
class Promise:
    """What `Simulator.tune` chose and what may be expected of it, for motions like the studied one of that material.

    |x - x*| <= error |x_0 - x*| + 10 eps |x|: x* the converged step, with its friction, x_0 = x + h v, eps of the
    precision. The last term matters to steps that hardly change anything, as of a body that comes to rest.
    """

    asked_error: float | None
    asked_milliseconds: float | None
    attained: bool  # whether what was asked for can be had; if not, error and milliseconds say what can
    solver: Solver
    iterations: int
    error: float  # promised, of a step; no finer than the rounding of any, unless that was asked for
    studied_error: float  # worst of the study
    rounding: float  # 10 eps |x| / |x_0 - x*|, largest of the study: what may come on top of `error`
    milliseconds: float  # median of sim(state), of the batch that tune saw, on the machine where it ran
    residual_limit: float  # `info.residual` above which the promise is not to be relied on
    error_per_residual: float  # largest ratio in the study
    unseen_error: float  # largest in the study of a step whose residual is 0, with as many iterations or hardly fewer
    time_step: float  # s
    dtype: torch.dtype
    device: str
    batch: int
    trials: tuple[Trial, ...]
    material: str  # fingerprint of the arrays
    left_out: str = ""  # solver that was not tried though it might do better, and why
    # said by `Simulator.set_material`, and by `covers` of its own simulator
    other_material: bool = field(default=False, compare=False)

    def holds(self, info: Info) -> Tensor:
        """Whether the error may still be relied on [B] (bool), from the residual that `return_info=True` reports.

        An estimate, calibrated on the studied states: the promise is doubted when the residual is larger than they had
        where their error was the promised one, and when it is not a number. Residuals weigh short waves and errors
        long ones, so most steps that break a promise have a residual like any other: see `estimate` and `audit`.
        Nowhere once `set_material` has brought other numbers; what an optimiser writes in place only `covers` finds.
        """
        return (_info(info, "holds").residual <= self.residual_limit) & (not self.other_material)

    @torch.no_grad()
    def audit(
        self,
        sim: Tuned,
        state: State,
        after: State,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        *,
        info: Info | None = None,
    ) -> Tensor:
        """Error of a step [B] beyond rounding, as `error` is, by solving on: x' three times as many iterations later.

        The least e >= 0 with |x - x'| <= e |x_0 - x'| + 10 eps |x|. Costs three steps and calibrates nothing: for now
        and then. Low where even those iterations change little.

        Args:
            sim: the tuned simulator.
            state: where the step started.
            after: where it ended.
            forces: that the step was given.
            targets: that it was given.
            info: of the step. Environments that `estimate` does not doubt get their estimate, and where it doubts none
                of the batch, as in two of three steps that keep the promise, nothing is solved; that awaits a GPU.
        """
        if info is not None:
            estimate = self.estimate(info)
            trusted = (estimate <= self.error) & (not self.other_material)  # not a number is doubtful
            if bool(trusted.all()):
                return estimate
            return torch.where(trusted, estimate, self.audit(sim, state, after, forces, targets))
        further = copy.copy(sim)
        further.iterations, further.tolerance = 3 * self.iterations, 0.0
        solved: Tensor = further(state, forces, targets, start=after[0])[1]
        material = sim.material_at(targets, len(state[0]))
        # displacements over the time step are velocities
        first = course_of(sim.plan, material, sim.time_step, state) / self.time_step
        error = (solved - after[1]).flatten(1).norm(dim=1)
        rounding = ROUNDINGS * torch.finfo(self.dtype).eps * state[0].flatten(1).norm(dim=1) / self.time_step
        # a body at rest has no error
        scale = (solved - first).flatten(1).norm(dim=1).clamp(min=torch.finfo(self.dtype).tiny)
        beyond: Tensor = (error - rounding).clamp(min=0.0) / scale
        return beyond

    def estimate(self, info: Info) -> Tensor:
        """Error of the step [B] that its residual may hide; NaN without a report.

        At the largest ratio of the study, and no less than its steps had whose residual was 0, where rounding hides
        forces: of stiff bodies in float32 that may be an error that matters. High rather than low: in float32 it
        exceeds `error` on one in three steps that keep the promise; an `audit` tells which.
        """
        return (_info(info, "estimate").residual * self.error_per_residual).clamp(min=self.unseen_error)

    def covers(self, sim: Tuned) -> bool:
        """Whether the simulator still has the settings and the material that were promised for; awaits a GPU."""
        now = (sim.solver, sim.iterations, sim.time_step, sim.dtype, str(sim.device), sim.tolerance)
        other = self.other_material
        if now[3:5] == (self.dtype, self.device):
            other = fingerprint(sim.material()) != self.material
            if sim.promise is self:
                self.doubt(other)
        return now == (self.solver, self.iterations, self.time_step, self.dtype, self.device, 0.0) and not other

    def doubt(self, other: bool) -> None:
        """Note whether its simulator has another material now."""
        object.__setattr__(self, "other_material", other)

    def __str__(self) -> str:
        wanted = f"error {self.asked_error:g}" if self.asked_error is not None else f"{self.asked_milliseconds:g} ms"
        why = f"{wanted} not reached; {self.left_out}" if self.left_out else f"{wanted} cannot be had"
        verdict = "" if self.attained else f" ({why})"
        rounding = f" and up to {self.rounding:.1e} of rounding" if self.rounding > 0.1 * self.error else ""
        other = ", for another material than now" if self.other_material else ""
        return f"error {self.error:.1e}{rounding}, {self.milliseconds:.2g} ms a step of {self.batch}{verdict}{other}"


def _info(info: object, name: str) -> Info:
    if not isinstance(info, Info):
        given = type(info).__name__
        raise TypeError(f"{name}: info must be what `state, info = sim(state, return_info=True)` gives, got {given}")
    return info
