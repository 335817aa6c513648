"""Implementation of `Simulator.tune`: solver and iterations for an error or a time, from a short study of the scene.

The study takes a few states of the motion and solves each to convergence in float64 (`accuracy.exact_steps`, with
friction `settled_steps`). It runs every candidate at doubling iteration counts from the same states. The `TuningResult`
keeps the error bound. Its `is_valid(info)` checks steps of a run by their residual, which falls with the error at a
ratio that the study measures.
"""

from __future__ import annotations

import copy
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NoReturn

import numpy as np
import torch
from torch import Tensor
from tqdm.auto import tqdm

from ..common.checks import check_has_values, check_scalar, check_whole
from ..common.warn import TuningWarning, warn_user
from ..estimate.convergence import has_friction
from ..estimate.solver_choice import runs
from ..plan.material import fingerprint
from ..scene.solvers import Multilevel, Newton, Solver
from ..scene.targets import Targets
from ..simulation.state import named_state
from .candidates import safe_candidates
from .tuning_checks import check_known, check_request, check_start
from .tuning_result import Trial, TuningResult
from .tuning_study import SAFETY, AnyState, Study, allowed_uncertainty, is_minimum, make_study, with_targets

if TYPE_CHECKING:
    from ..simulation.stepper import Stepper

__all__ = ["TuningWarning", "tune"]

MOST_ITERATIONS = 2048
_HEADROOM = 0.95  # share of a budget in milliseconds to spend, because times scatter
_NEAR = 1.1  # the first candidate within this factor of the fastest time is taken
_HOPELESS = 1.5  # a candidate beyond this factor of the fastest time is dropped


def tune(
    sim: Stepper,
    state: AnyState | None = None,
    *,
    error: float | None = None,
    milliseconds: float | None = None,
    forces: Tensor | None = None,
    targets: Targets | None = None,
    candidates: Sequence[Solver] | None = None,
    most: int = MOST_ITERATIONS,
    progress: bool = False,
) -> TuningResult:
    """Implementation of `Simulator.tune`."""
    check_has_values("tune", sim.device)
    error = None if error is None else check_scalar("tune: error", error)
    milliseconds = None if milliseconds is None else check_scalar("tune: milliseconds", milliseconds)
    most = check_whole("tune: most", most, minimum=1)
    check_request(error, milliseconds)
    if isinstance(candidates, (str, Solver)):
        raise TypeError(f"tune: candidates must be a sequence of solvers, got {candidates!r}; write [{candidates!r}]")
    for solver in candidates or ():
        if not isinstance(solver, Solver):
            raise TypeError(f"tune: candidates must be solvers, such as Chebyshev() and Multilevel(), got {solver!r}")
    start = sim.rest_state() if state is None else state
    check_start(sim, start, forces, targets)
    start = named_state(start)
    study = make_study(with_targets(sim, targets, len(start[0])), start, forces, error)
    # steps that are no minimum may not settle; their uncertainty counts as error, so that the target is not attained
    if is_minimum(sim):
        check_known(study.exact, allowed_uncertainty(error))
    named: Mapping[str, Solver] = (
        _default_candidates(sim, safe_candidates(study.sim, study.state))
        if candidates is None
        else {str(number): solver for number, solver in enumerate(dict.fromkeys(candidates))}
    )
    if not named:
        raise ValueError("tune: candidates must hold at least one solver, got none")
    with tqdm(total=len(named), desc="tuning", unit="solver", disable=not progress, leave=False) as bar:
        if error is not None:
            trials, cost = _cheapest_for_error(sim, study, start, list(named.values()), error, most, bar)
        else:
            seek = _seek_for_time(sim, study, start, milliseconds, most)
            timed = []
            for solver in named.values():
                found = seek(solver)
                timed.append((found, _milliseconds(sim, start, found[-1])))
                bar.update(1)
            trials, cost = _most_accurate(study, timed)
    result = _result(sim, study, start, trials, cost, error, milliseconds)
    if candidates is None and has_friction(sim.compiled) and runs(Multilevel(), sim.compiled):
        result = replace(result, left_out="Multilevel, not tried because of friction, might reach it: see candidates")
    sim.solver, sim.iterations, sim.tolerance, sim.tuning_result = result.solver, result.iterations, 0.0, result
    if not result.attained:
        warn_user(f"tune: {result}", TuningWarning)
    elif min(study.roundings) > result.error:
        finer = "; a simulator with dtype=torch.float64 has far less" if sim.dtype == torch.float32 else ""
        warn_user(
            f"tune: {result}: rounding exceeds the error in every studied state, so the study measures the error "
            f"poorly{finer}",
            TuningWarning,
        )
    return result


def _default_candidates(sim: Stepper, solvers: Mapping[str, Solver]) -> dict[str, Solver]:
    """Default candidates: with friction without `Multilevel` and `Newton`, which may stagnate outside of the study."""
    smooth = not has_friction(sim.compiled)
    return {name: solver for name, solver in solvers.items() if smooth or not isinstance(solver, Multilevel | Newton)}


# ---- the search


Seek = Callable[[Solver], list[Trial]]


def _cheapest_for_error(
    sim: Stepper, study: Study, start: AnyState, solvers: list[Solver], error: float, most: int, bar: tqdm[NoReturn]
) -> tuple[list[Trial], float]:
    """Trials of the cheapest solver that reaches an error, and its milliseconds; of the most accurate one if none does.

    Multilevel goes first: on stiff bodies its time bounds the iterations of the others, which would need thousands.
    """
    found: dict[Solver, list[Trial]] = {}
    costs: dict[Solver, float] = {}
    for solver in sorted(solvers, key=lambda solver: not isinstance(solver, Multilevel)):
        allowed = _affordable_iterations(sim, start, solver, _HOPELESS * min(costs.values()), most) if costs else most
        trials = _fewest_iterations(study, lambda trial: trial.error <= error / SAFETY, allowed)(solver)
        found[solver] = trials
        if trials[-1].error <= error / SAFETY:
            costs[solver] = _milliseconds(sim, start, trials[-1])
        bar.update(1)
    if not costs:
        best = min(found.values(), key=lambda trials: trials[-1].error)
        return best, _milliseconds(sim, start, best[-1])
    # the first of those close to the fastest
    solver = next(s for s in solvers if s in costs and costs[s] <= _NEAR * min(costs.values()))
    return found[solver], costs[solver]


def _affordable_iterations(sim: Stepper, start: AnyState, solver: Solver, budget: float, most: int) -> int:
    """Largest number of iterations within a time [ms], approximately."""
    few, many = 4, 20
    times = [_milliseconds(sim, start, Trial(solver, count, 0.0, ())) for count in (few, many)]
    slope = max((times[1] - times[0]) / (many - few), 1e-9)
    return int(np.clip((budget - times[0]) / slope + few, 1, most))


def _fewest_iterations(study: Study, suffices: Callable[[Trial], bool], most: int) -> Seek:
    """Find the fewest iterations that suffice, and add a few; the chosen trial is last.

    The addition is cheap if few are needed, which is when another state is most likely to need more.
    """

    def seek(solver: Solver) -> list[Trial]:
        trials = [study.trial(solver, 1)]
        while not suffices(trials[-1]) and trials[-1].iterations < most:
            trials.append(study.trial(solver, min(2 * trials[-1].iterations, most)))
        if not suffices(trials[-1]):
            return [*trials, min(trials, key=lambda trial: trial.error)]
        low, high = trials[-2].iterations if len(trials) > 1 else 0, trials[-1]
        while high.iterations - low > max(1, high.iterations // 32):
            middle = study.trial(solver, (low + high.iterations) // 2)
            trials.append(middle)
            low, high = (low, middle) if suffices(middle) else (middle.iterations, high)
        return [*trials, study.trial(solver, min(high.iterations + 2 + high.iterations // 8, most))]

    return seek


def _seek_for_time(sim: Stepper, study: Study, start: AnyState, budget: float | None, most: int) -> Seek:
    """Find the most iterations of a solver within a budget [ms], from the times of two counts.

    Takes fewer if rounding then hides every error: as many as bring all errors below it.
    """
    assert budget is not None
    spend = _HEADROOM * budget

    def seek(solver: Solver) -> list[Trial]:
        few, many = 4, 68
        times = {count: _milliseconds(sim, start, Trial(solver, count, 0.0, ())) for count in (few, many)}
        slope = max((times[many] - times[few]) / (many - few), 1e-9)
        count = int(np.clip((spend - times[few]) / slope + few, 1, most))
        for _ in range(4):  # times of long runs differ from those of short ones
            measured = _milliseconds(sim, start, Trial(solver, count, 0.0, ()))
            if count == 1 or (measured <= budget and (count == most or measured > 0.85 * budget)):
                break
            count = int(np.clip(round(count * spend / measured), 1, most))
        paid = study.trial(solver, count)
        return (
            [paid]
            if study.worst(paid) > 0.0
            else _fewest_iterations(study, lambda t: study.worst(t) == 0.0, count)(solver)
        )

    return seek


@torch.no_grad()
def _milliseconds(sim: Stepper, start: AnyState, trial: Trial) -> float:
    """Time of `sim(state)`: the lowest median of three series, so that one disturbance does not count."""
    timed = copy.copy(sim)
    timed.solver, timed.iterations, timed.tolerance = trial.solver, trial.iterations, 0.0
    timed(start)
    medians = []
    for _ in range(3):
        times: list[float] = []
        while len(times) < 5 or (sum(times) < 0.05 and len(times) < 50):
            _wait_for(sim)
            begin = time.perf_counter()
            timed(start)
            _wait_for(sim)
            times.append(time.perf_counter() - begin)
        medians.append(statistics.median(times))
    return 1e3 * min(medians)


def _wait_for(sim: Stepper) -> None:
    if sim.device.type == "cuda":
        torch.cuda.synchronize(sim.device)


# ---- the choice


def _shows_excess(study: Study, trial: Trial, bound: float) -> bool:
    """Whether a trial exceeds the bound and its residuals show it; residuals of pure rounding are 0."""
    return bound < study.worst(trial) < math.inf and max(trial.residuals) > 0.0


def _with_exceeding(study: Study, trials: list[Trial], bound: float) -> list[Trial]:
    """The trials, the chosen one last; adds trials of fewer iterations if none exceeds the bound visibly."""
    if any(_shows_excess(study, trial, bound) for trial in trials):
        return trials
    solver, low, high = trials[-1].solver, 0, min(trial.iterations for trial in trials)
    added = [study.trial(solver, low)]
    while high - low > max(1, high // 8):
        added.append(study.trial(solver, (low + high) // 2))
        exceeds = _shows_excess(study, added[-1], bound)
        low, high = (added[-1].iterations, high) if exceeds else (low, added[-1].iterations)
    return [*added, *trials]


def _most_accurate(study: Study, timed: list[tuple[list[Trial], float]]) -> tuple[list[Trial], float]:
    """The candidate with the lowest error; the fastest of those whose errors rounding hides."""
    return min(timed, key=lambda pair: (study.worst(pair[0][-1]), pair[1]))


def _residual_limit(study: Study, trials: list[Trial], bound: float) -> tuple[float, float, float]:
    """Residual at which the error is the bound, the largest error per residual, and the largest error at residual 0.

    The chosen trial determines them if its errors are near the bound. They may be far below it, or hidden by rounding,
    where few iterations do much. So the nearest trial that visibly exceeds the bound counts as well.
    """
    chosen = trials[-1]
    exceeding = sorted((trial for trial in trials if bound < study.worst(trial) < math.inf), key=study.worst)
    telling = [trial for trial in exceeding if max(trial.residuals) > 0.0]
    asked = [chosen, *exceeding[:1], *telling[:1]]
    limits = [
        max(trial.residuals) * bound / study.worst(trial)
        for trial in asked
        if study.worst(trial) > 0.0 and max(trial.residuals) > 0.0
    ]
    pairs = [pair for trial in asked for pair in zip(study.visible(trial), trial.residuals, strict=True)]
    ratio = max((error / residual for error, residual in pairs if residual > 0.0), default=0.0)
    near = len(chosen.errors) * len(asked[:2])
    unseen = max((error for error, residual in pairs[:near] if residual == 0.0), default=0.0)
    # the studied states are within the bound, and so are similar ones
    return max(min(limits, default=0.0), SAFETY * max(chosen.residuals)), ratio, unseen


def _result(
    sim: Stepper,
    study: Study,
    start: AnyState,
    trials: list[Trial],
    cost: float,
    error: float | None,
    milliseconds: float | None,
) -> TuningResult:
    chosen = trials[-1]
    attained = chosen.error <= error / SAFETY if error is not None else cost <= 1.2 * (milliseconds or 0.0)
    # no finer than the smallest rounding of a state, unless requested; if one error is visible, the error counts
    left = SAFETY * chosen.error if study.worst(chosen) > 0.0 else 0.0
    reachable = min(max(left, min(study.roundings)), 1.0)
    bound = error if attained and error is not None else reachable
    trials = _with_exceeding(study, trials, bound)
    limit, ratio, unseen = _residual_limit(study, trials, bound)
    return TuningResult(
        requested_error=error,
        requested_milliseconds=milliseconds,
        attained=attained,
        solver=chosen.solver,
        iterations=chosen.iterations,
        error=bound,
        studied_error=chosen.error,
        rounding=max(study.roundings),
        milliseconds=cost,
        residual_limit=limit,
        error_per_residual=ratio,
        error_at_zero_residual=unseen,
        time_step=sim.time_step,
        dtype=sim.dtype,
        device=str(sim.device),
        batch=len(start[0]),
        trials=tuple(trials),
        material=fingerprint([*sim.material(), *sim.load_values(None, 1).values()]),
    )
