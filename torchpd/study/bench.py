"""The workbench of a study: a subject compiled as asked for, its converged steps, and clocks for both."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Any

import numpy as np
import torch

from ..accuracy.candidates import CANDIDATES
from ..accuracy.error import ExactStep, exact_steps
from ..api.simulator import Simulator
from ..common.warn import warn_user
from ..files.summary import workspace_bytes
from ..geometry.tet_mesh import TetMesh
from ..scene.solvers import DEFAULT_ITERATIONS, Chebyshev, Multilevel, Solver
from ..simulation.state import State
from .results_log import Row, Trajectory
from .scenes import Subject

__all__ = [
    "Bench",
    "PeakMemory",
    "Setting",
    "Timing",
    "UncertainWarning",
    "clock_of",
    "count_kernels",
    "measure_step",
    "precision_name",
    "solved_step",
    "time_calls",
    "verdicts",
]

# of steps that only the time step, the mesh or another solver's error may spoil, and the solvers that are tried
SOLVED = 1e-9
_SOLVERS: tuple[tuple[Solver, int], ...] = ((Multilevel(), 300), (Chebyshev(), 3000))
_DOUBTFUL = 0.1  # uncertainty of the converged step over the error that is measured from it
_UNSEEN = 1e-8  # errors below are in no figure and no table
_SCATTER = 1.3  # 95th over 5th percentile, of a machine that does something else too
_LOWER = 1e-6  # energy below that of the converged step, relative to the first iterate's: more than rounding
_DIVERGED = 2.0  # times as far from the converged step as the first iterate


class UncertainWarning(UserWarning):
    """A step has no converged answer that errors could be measured against."""


@dataclass(frozen=True)
class Setting:
    """What is studied at once: a body of some stiffness and resolution, and a time step."""

    youngs: float  # Pa
    time_step: float  # s
    resolution: int


@dataclass
class Bench:
    """Compiles the subject and keeps what several tasks need."""

    subject: Subject
    device: torch.device
    series: int = 6  # of times, where they scatter
    seconds: float = 0.05  # of each of them, at least
    _meshes: dict[int, TetMesh] = field(default_factory=dict)
    _steps: dict[Setting, tuple[State, ExactStep]] = field(default_factory=dict)
    motions: dict[tuple[Setting, float], Trajectory] = field(default_factory=dict)  # converged, by their seconds

    def mesh(self, resolution: int) -> TetMesh:
        """Of the subject."""
        if resolution not in self._meshes:
            self._meshes[resolution] = self.subject.mesh(resolution)
        return self._meshes[resolution]

    def simulator(
        self, setting: Setting, dtype: torch.dtype, solver: Solver | None = None, **options: Any
    ) -> Simulator:
        """A new one on the device."""
        scene = self.subject.scene(self.mesh(setting.resolution), setting.youngs)
        chosen = {"iterations": DEFAULT_ITERATIONS, "batch": 1, **options}
        sim = Simulator(scene, setting.time_step, solver=solver, dtype=dtype, progress=False, **chosen)
        return sim.to(self.device)

    def start(self, sim: Simulator) -> State:
        """The beginning of the motion in the precision of the simulator, as float32 holds it."""
        state = self.subject.start(sim)
        return State(*(part.float().to(sim.dtype) for part in state))

    def time(self, work: Callable[[], object]) -> Timing:
        """Of a call."""
        return time_calls(work, self.device, seconds=self.seconds, series=self.series)

    @torch.no_grad()
    def hard_step(self, setting: Setting) -> tuple[State, ExactStep]:
        """A state within the motion, rounded to float32 but in float64, and the converged step from there."""
        if setting not in self._steps:
            sim = self.simulator(setting, torch.float64, Chebyshev(), iterations=1000, tolerance=1e-9)
            state = self.start(sim)
            for _ in range(self.subject.steps_before):
                state = sim(state)
            state = State(*(part.float().double() for part in state))
            exact = exact_steps(sim, state)[0]
            self._steps[setting] = (state, exact)
            if exact.uncertainty > _DOUBTFUL * _UNSEEN:
                warn_user(
                    f"study: the converged step at {setting.youngs:g} Pa may itself be wrong by "
                    f"{exact.uncertainty:.1e}: rows with errors up to ten times that are marked uncertain",
                    UncertainWarning,
                )
        return self._steps[setting]

    def solver(self, name: str, setting: Setting) -> tuple[Solver, float]:
        """A contender for the hard step, and the milliseconds that choosing its parameters took."""
        sim = self.simulator(setting, torch.float64)
        state, _ = self.hard_step(setting)
        clock = clock_of(self.device)
        begin = clock()
        solver = CANDIDATES[name].make(sim, state)
        return solver, 1e3 * (clock() - begin)


@dataclass(frozen=True)
class Timing:
    """Milliseconds of repeated calls."""

    median: float
    p5: float
    p95: float

    @classmethod
    def of(cls, seconds: list[float]) -> Timing:
        """Percentiles of measured times."""
        p5, median, p95 = np.percentile(np.array(seconds) * 1e3, [5, 50, 95]).tolist()
        return cls(median, p5, p95)

    @property
    def scatter(self) -> float:
        """95th over 5th percentile."""
        return self.p95 / self.p5

    def columns(self) -> dict[str, Any]:
        """As a row has them."""
        return {"milliseconds": self.median, "milliseconds_p5": self.p5, "milliseconds_p95": self.p95}


def clock_of(device: torch.device) -> Callable[[], float]:
    """Seconds: with one thread on the CPU those of the processor, which others on the machine hardly disturb."""
    alone = device.type == "cpu" and torch.get_num_threads() == 1
    return time.process_time if alone else time.perf_counter


def time_calls(
    work: Callable[[], object], device: torch.device, *, least: int = 7, seconds: float = 0.05, series: int = 1
) -> Timing:
    """At least so many calls and so much time; the first call is not counted.

    Where times scatter, somebody else used the machine: up to `series` are measured, and the steadiest one counts.
    """
    clock = clock_of(device)
    work()
    found: list[Timing] = []
    while not found or (len(found) < series and found[-1].scatter > _SCATTER):
        times: list[float] = []
        while len(times) < least or sum(times) < seconds:
            _wait_for(device)
            begin = clock()
            work()
            _wait_for(device)
            times.append(clock() - begin)
        found.append(Timing.of(times))
    return min(found, key=lambda timing: timing.scatter)


def _wait_for(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def count_kernels(work: Callable[[], object], device: torch.device) -> int | None:
    """Kernels that a call launches on a GPU, by the profiler; None on the CPU, which has none."""
    if device.type != "cuda":
        return None
    work()
    _wait_for(device)
    kinds = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=kinds) as profile:
        work()
        _wait_for(device)
    events = profile.events() or []
    named = [e.name.lower() for e in events if e.device_type == torch.autograd.DeviceType.CUDA]  # type: ignore[attr-defined]
    return sum("memcpy" not in name and "memset" not in name for name in named)


class PeakMemory:
    """Of what runs between making and reading this: what the allocator of a GPU has seen, or what the layout says."""

    def __init__(self, device: torch.device, layout: int) -> None:
        self._device, self._layout = device, layout
        if device.type == "cuda":
            _wait_for(device)
            torch.cuda.reset_peak_memory_stats(device)

    def read(self) -> tuple[int, str]:
        """Bytes, and how they are known."""
        if self._device.type != "cuda":
            return self._layout, "layout"
        _wait_for(self._device)
        return int(torch.cuda.max_memory_allocated(self._device)), "torch.cuda"


def precision_name(dtype: torch.dtype) -> str:
    """float32 or float64."""
    return str(dtype).removeprefix("torch.")


def verdicts(errors: Sequence[float], uncertainty: float = 0.0, energies: Sequence[float | None] = ()) -> list[str]:
    """The status of each row of a method, in the order of iterations: diverged is what stays far off to the end.

    Far off may be the first iterates of a method that descends in energy. Errors that the uncertainty of the converged
    step is more than a tenth of are uncertain, and those that it may explain too. So is all where any iterate has less
    energy than the converged step: that is another minimum then, and not the lowest.
    """
    if any(energy is not None and energy < -_LOWER for energy in energies):
        return ["uncertain" if math.isfinite(error) else "diverged" for error in errors]
    # the least error from here on
    best = [*accumulate(reversed([e if math.isfinite(e) else math.inf for e in errors]), min)][::-1]
    found = []
    for error, least in zip(errors, best, strict=True):
        if not math.isfinite(error):
            found.append("diverged")
        elif uncertainty > _DOUBTFUL * max(error, _UNSEEN):
            found.append("uncertain")
        else:
            found.append("ok" if least <= _DIVERGED else "diverged")
    return found


@torch.no_grad()
def solved_step(sim: Simulator, state: State) -> tuple[State, bool]:
    """A step in float64, solved until about 1e-9 of its way is left; and whether that was reached.

    By Multilevel, and by Chebyshev, which goes on from there where that fails.
    """
    sim.tolerance = SOLVED
    guess: str | torch.Tensor = "velocity"
    for solver, iterations in _SOLVERS:
        sim.solver, sim.iterations = solver, iterations
        after, info = sim(state, start=guess, return_info=True)
        if bool(info.converged.all()):
            return after, True
        guess = after.positions
    return after, False


@torch.no_grad()
def measure_step(
    sim: Simulator,
    state: State,
    exact: ExactStep,
    iterations: int,
    *,
    series: int = 1,
    seconds: float = 0.05,
    more: dict[str, float] | None = None,
    **columns: Any,
) -> Row:
    """One solver at one iteration count on a step whose converged end is known: errors, times, memory, kernels."""
    sim.iterations = iterations
    given = State(*(part.to(sim.dtype) for part in state))
    after = sim(given)
    errors = exact.errors_of(after.velocities[0].double().cpu().numpy() * sim.time_step)
    timing = time_calls(lambda: sim(given), sim.device, seconds=seconds, series=series)
    real = torch.finfo(sim.dtype).bits // 8
    memory = PeakMemory(sim.device, sim.plan.bytes + workspace_bytes(sim.plan, real, sim.solver))
    sim(given)
    held, how = memory.read()
    return Row(
        precision=precision_name(sim.dtype),
        iterations=iterations,
        local_steps=iterations,
        status=verdicts([errors.position], exact.uncertainty, [errors.energy])[0],
        vertices=sim.vertices,
        tets=len(exact.problem.values.tets),
        time_step=sim.time_step,
        error=errors.position,
        uncertainty=exact.uncertainty,
        error_energy=errors.energy,
        error_metres=errors.metres,
        residual=errors.residual,
        **timing.columns(),
        bytes=held,
        bytes_by=how,
        kernels=count_kernels(lambda: sim(given), sim.device),
        more=more or {},
        **columns,
    )
