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
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NoReturn, TypeAlias

import numpy as np
import torch
from torch import Tensor
from tqdm.auto import tqdm

from ..common.checks import check_has_values, check_scalar, check_whole
from ..common.tables import PLANES
from ..common.warn import TuningWarning, warn_user
from ..estimate.convergence import has_friction
from ..estimate.solver_choice import runs
from ..ops.diagonal import named_material, step_diagonal
from ..plan.material import dims_of, fingerprint, named_arrays
from ..scene.pins import PIN_HARD
from ..scene.solvers import Chebyshev, Multilevel, Newton, Solver
from ..scene.targets import Targets
from ..simulation.parametrization import plain_copy
from ..simulation.state import HistoryState, State, chosen, joined, named_state
from .candidates import safe_candidates
from .error import ExactStep, exact_steps, settled_steps
from .tuning_checks import check_known, check_request, check_start
from .tuning_result import Trial, TuningResult

if TYPE_CHECKING:
    from ..simulation.stepper import Stepper

__all__ = ["TuningWarning", "tune"]

AnyState: TypeAlias = State | HistoryState

MOST_ITERATIONS = 2048
# Safety factor of the error bound over studied errors, because other states may be harder. Studied errors may contain
# this share of the rounding.
SAFETY = 2.0
_STUDIED_ROUNDINGS = 2.0
_STEPS = (0, 1, 4, 12, 30)  # of the motion, whose states are studied
_TURNED = (0, 4)  # of these, also studied with the axes of their velocities exchanged
_HARDEST = 2  # further states: those that are hardest to solve
_TURN_ANGLES = (37.0, -110.0)  # [degrees] further directions of motions on rough ground
_ENVIRONMENTS = 3  # of a batch, besides the worst conditioned one
_HEADROOM = 0.95  # share of a budget in milliseconds to spend, because times scatter
_NEAR = 1.1  # the first candidate within this factor of the fastest time is taken
_HOPELESS = 1.5  # a candidate beyond this factor of the fastest time is dropped
# iterations that produce the studied states: of Multilevel; of Chebyshev if that does not run, or may stagnate
_MOVING, _MOVING_PLAINLY = 64, 512
# uncertainty at which steps with friction count as settled: this share of the requested error, or of _COARSE
_SETTLED, _COARSE = 1e-2, 1e-2
_KNOWN = 0.1  # largest uncertainty of converged steps if a time is requested


@dataclass(frozen=True, eq=False)
class _Study:
    """Inputs of every trial."""

    sim: Stepper  # its batch the studied states
    state: AnyState
    forces: Tensor | None
    exact: list[ExactStep]

    @property
    def roundings(self) -> list[float]:
        """Rounding of every state, relative to the displacement of its step."""
        return [step.rounding(self.sim.dtype) / step.scale for step in self.exact]

    def visible(self, trial: Trial) -> list[float]:
        """Errors of the states, 0 if rounding hides them."""
        pairs = zip(trial.errors, self.roundings, strict=True)
        return [0.0 if error <= rounding / SAFETY else error for error, rounding in pairs]

    def worst(self, trial: Trial) -> float:
        """The largest error that rounding does not hide."""
        return max(self.visible(trial))

    @torch.no_grad()
    def trial(self, solver: Solver, iterations: int) -> Trial:
        """Run a solver for some iterations from every state."""
        self.sim.solver, self.sim.iterations = solver, iterations
        after, info = self.sim(self.state, self.forces, return_info=True)
        displacements = after.velocities.double().cpu().numpy() * self.sim.time_step
        pairs = zip(self.exact, displacements, strict=True)
        # the uncertainty of the converged steps counts as error
        errors = [
            step.error_beyond_rounding(u, self.sim.dtype, _STUDIED_ROUNDINGS) + step.uncertainty for step, u in pairs
        ]
        return Trial(solver, iterations, max(errors), tuple(info.residual.tolist()), tuple(errors))


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
    study = _make_study(_with_targets(sim, targets, len(start[0])), start, forces, error)
    # steps that are no minimum may not settle; their uncertainty counts as error, so that the target is not attained
    if _is_minimum(sim):
        check_known(study.exact, _allowed_uncertainty(error))
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


def _is_minimum(sim: Stepper) -> bool:
    """Whether a step minimises an energy, without friction and contact between bodies."""
    return not has_friction(sim.compiled) and sim.scene.contact is None


def _default_candidates(sim: Stepper, solvers: Mapping[str, Solver]) -> dict[str, Solver]:
    """Default candidates: with friction without `Multilevel` and `Newton`, which may stagnate outside of the study."""
    smooth = not has_friction(sim.compiled)
    return {name: solver for name, solver in solvers.items() if smooth or not isinstance(solver, Multilevel | Newton)}


# ---- the study


def _with_targets(sim: Stepper, targets: Targets | None, batch: int) -> Stepper:
    """The simulator with pins, spheres, fibres and loads as `targets` say."""
    if targets is None:
        return sim
    places = named_material(sim.material_at(targets, batch))
    placed = plain_copy(sim)
    moved = [name for name in ("pin_targets", "spheres", "fibre_length") if name in sim.material_names]
    changed = {name: places[name] for name in moved} | sim.load_values(targets, batch)
    placed.set_material(**{name: value.detach() for name, value in changed.items()})
    return placed


@torch.no_grad()
def _make_study(sim: Stepper, start: AnyState, forces: Tensor | None, error: float | None) -> _Study:
    """Study states of the motion from `start`, with their converged steps; free fall is left out."""
    items = _environments(sim, len(start[0]))
    some = _of_environments(sim, items, len(start[0]))
    some.tolerance = 0.0
    given = None if forces is None else forces.detach()[items]
    begun = chosen(start, items)
    states = [state for turned in (begun, *_turned_starts(some, begun)) for state in _motion(some, turned, given)]
    everyone = _of_environments(some, list(range(len(items))) * len(states), len(items))
    state = joined(states)
    repeated = None if given is None else given.repeat(len(states), 1, 1)
    if not _is_minimum(sim):
        exact = settled_steps(everyone, state, forces=repeated, enough=_SETTLED * (error or _COARSE))
    else:
        exact = exact_steps(everyone, state, forces=repeated)
    moving = [
        number
        for number, step in enumerate(exact)
        if step.moves(sim.dtype) and not _comes_to_rest(step, _allowed_uncertainty(error))
    ]
    if not moving:
        raise ValueError(
            "tune: this scene has no motion that needs solving: from the given state the bodies rest or fall freely; "
            "pass a state of the motion that matters, for example sim.tune(state, error=1e-2)"
        )
    picked = _of_environments(everyone, moving, len(exact))
    pushed = None if repeated is None else repeated[moving]
    return _Study(picked, chosen(state, moving), pushed, [exact[number] for number in moving])


def _allowed_uncertainty(error: float | None) -> float:
    """Largest relative uncertainty of a converged step."""
    return _KNOWN if error is None else error / SAFETY


def _comes_to_rest(step: ExactStep, allowed: float) -> bool:
    """Whether a body comes to rest: its displacement is so small that float64 rounding makes it uncertain."""
    return step.uncertainty > allowed and step.uncertainty * step.scale <= step.rounding(torch.float64)


def _environments(sim: Stepper, batch: int) -> list[int]:
    """Some environments of a batch, evenly spread, and the one with the worst conditioned system."""
    items = set(np.linspace(0, batch - 1, _ENVIRONMENTS).round().astype(int).tolist())
    inertia, diagonal = step_diagonal(sim.plan.arrays, sim.material(), sim.time_step)
    ratio = torch.where(inertia.isinf(), torch.ones_like(inertia), inertia / diagonal)
    if ratio.dim() == 2 and len(ratio) == batch:
        items.add(int(ratio.min(dim=1).values.argmin()))
    return sorted(items)


def _turned_starts(sim: Stepper, start: AnyState) -> list[AnyState]:
    """The start with velocities turned about the normal of rough ground, because sticking depends on the path."""
    planes = sim.planes.detach()
    if not bool((planes[..., PLANES["friction"]] > 0.0).any()):
        return []
    planes = planes.reshape(-1, *planes.shape[-2:])  # [1 or B, C, 5]
    # the rough plane of each environment that bears most of the weight
    bears = -(planes[..., PLANES["normal"]] * sim.gravity.detach().reshape(-1, 1, 3)).sum(dim=-1)
    most = bears.masked_fill(planes[..., PLANES["friction"]] <= 0.0, -math.inf).argmax(dim=1)
    chosen = planes.expand(len(most), -1, -1)[torch.arange(len(most), device=most.device), most]
    normal = chosen[:, None, PLANES["normal"]]
    across = torch.linalg.cross(normal.expand_as(start[1]), start[1])
    along = (start[1] * normal).sum(dim=-1, keepdim=True) * normal
    return [
        start._replace(velocities=along + math.cos(angle) * (start[1] - along) + math.sin(angle) * across)
        for angle in map(math.radians, _TURN_ANGLES)
        if bool(across.any())
    ]


def _motion(sim: Stepper, start: AnyState, forces: Tensor | None) -> list[AnyState]:
    """The states before the steps `_STEPS`, solved accurately enough, and a few others.

    Turned states have the same shape and speeds in other directions: an equally likely motion that excites other modes.
    The hardest states are those where a fifth of the iterations leaves the largest error. A motion may pass a few
    states in which the energy is not convex, and all solvers leave these slowly.
    """
    mover = copy.copy(sim)
    smooth = not (has_friction(mover.compiled) or mover.compiled.has_stencils)
    if smooth and runs(Multilevel(), mover.compiled):
        mover.solver, mover.iterations = Multilevel(), _MOVING
    else:
        mover.solver, mover.iterations = Chebyshev(), _MOVING_PLAINLY
    prober = copy.copy(mover)
    prober.iterations = mover.iterations // 5
    states, state, hardest = [], start, list[tuple[float, AnyState]]()
    for step in range(max(_STEPS) + 1):
        if step in _STEPS:
            states.append(state)
        if step in _TURNED:
            states.append(state._replace(velocities=state[1].roll(1, -1)))
        after = mover(state, forces)
        if not bool(after[0].isfinite().all()):
            break
        if step not in _STEPS:
            left = _relative_error(prober(state, forces), state, after, sim.time_step)
            hardest = sorted([*hardest, (left, state)], key=lambda pair: -pair[0])[:_HARDEST]
        state = after
    return [*states, *(state for _, state in hardest)]


def _relative_error(rough: AnyState, before: AnyState, after: AnyState, time_step: float) -> float:
    """Error of a roughly solved step, relative to the change from x + h v, largest of the environments."""
    size = [(v - after[1]).flatten(1).norm(dim=1) for v in (rough[1], before[1])]
    rounding = 10.0 * torch.finfo(after[0].dtype).eps / time_step * after[0].flatten(1).norm(dim=1)
    left = (size[0] - rounding).clamp(min=0.0) / size[1].clamp(min=torch.finfo(after[0].dtype).tiny)
    return float(left.max())


def _of_environments(sim: Stepper, items: list[int], batch: int) -> Stepper:
    """The simulator for some environments of a batch, with the rows of their material."""
    own = {
        name: array.detach()[items]
        for name, array in named_arrays(sim).items()
        if array.dim() > dims_of(name) and len(array) == batch
    }
    if "pin_stiffness" in own:
        own.setdefault(PIN_HARD, sim.pin_hard)
    picked = plain_copy(sim)
    picked.named_iterations = True  # the study itself measures whether they suffice
    picked.set_material(**own)
    return picked


Seek = Callable[[Solver], list[Trial]]


def _cheapest_for_error(
    sim: Stepper, study: _Study, start: AnyState, solvers: list[Solver], error: float, most: int, bar: tqdm[NoReturn]
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


def _fewest_iterations(study: _Study, suffices: Callable[[Trial], bool], most: int) -> Seek:
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


def _seek_for_time(sim: Stepper, study: _Study, start: AnyState, budget: float | None, most: int) -> Seek:
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


def _shows_excess(study: _Study, trial: Trial, bound: float) -> bool:
    """Whether a trial exceeds the bound and its residuals show it; residuals of pure rounding are 0."""
    return bound < study.worst(trial) < math.inf and max(trial.residuals) > 0.0


def _with_exceeding(study: _Study, trials: list[Trial], bound: float) -> list[Trial]:
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


def _most_accurate(study: _Study, timed: list[tuple[list[Trial], float]]) -> tuple[list[Trial], float]:
    """The candidate with the lowest error; the fastest of those whose errors rounding hides."""
    return min(timed, key=lambda pair: (study.worst(pair[0][-1]), pair[1]))


def _residual_limit(study: _Study, trials: list[Trial], bound: float) -> tuple[float, float, float]:
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
    study: _Study,
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
