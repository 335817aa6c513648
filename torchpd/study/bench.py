"""The test bench of a study: a study scene compiled on request, its converged steps, and timers."""

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
from ..geometry.tri_mesh import TriMesh
from ..scene.scene import Scene
from ..scene.solvers import DEFAULT_ITERATIONS, Chebyshev, Multilevel, Solver
from ..simulation.state import State
from .results_log import Row, Trajectory
from .scenes import StudyScene

__all__ = [
    "Bench",
    "PeakMemory",
    "Setting",
    "Timing",
    "UncertainWarning",
    "clock_of",
    "count_kernels",
    "elements_of",
    "measure_step",
    "precision_name",
    "row_statuses",
    "solved_step",
    "time_calls",
]

# steps of which only one error is measured are solved by these, in turn
SOLVED = 1e-9
_SOLVERS: tuple[tuple[Solver, int], ...] = ((Multilevel(), 300), (Chebyshev(), 3000))
_OF_STENCILS: tuple[tuple[Solver, int], ...] = ((Chebyshev(), 20000),)  # other parts: the minimum of the default
_UNCERTAINTY_LIMIT = 0.1  # limit of the uncertainty of the converged step, over the error measured against it
_SMALLEST_SHOWN = 1e-8  # smaller errors appear in no figure or table
_SCATTER = 1.3  # 95th over 5th percentile of times on a machine that is busy with other work
_LOWER_ENERGY = 1e-6  # energy below that of the converged step, over the first iterate's, that exceeds rounding
_DIVERGED = 2.0  # distance from the converged step, over that of the first iterate


class UncertainWarning(UserWarning):
    """Warning: a step has no converged solution to measure errors against."""


@dataclass(frozen=True)
class Setting:
    """Parameters of one task: the stiffness and resolution of a body, and a time step."""

    youngs: float  # Pa
    time_step: float  # s
    resolution: int


@dataclass
class Bench:
    """Compiles the study scene and keeps results that several tasks share."""

    study_scene: StudyScene
    device: torch.device
    series: int = 6  # series of times, if they scatter
    seconds: float = 0.05  # least duration of a series
    _meshes: dict[int, TetMesh | TriMesh] = field(default_factory=dict)
    _steps: dict[Setting, tuple[State, ExactStep]] = field(default_factory=dict)
    motions: dict[tuple[Setting, float], Trajectory] = field(default_factory=dict)  # converged motions, by duration

    def mesh(self, resolution: int) -> TetMesh | TriMesh:
        """The mesh of the study scene at a resolution."""
        if resolution not in self._meshes:
            self._meshes[resolution] = self.study_scene.mesh(resolution)
        return self._meshes[resolution]

    def elements(self, resolution: int) -> int:
        """Number of tetrahedra, or of triangles of cloth."""
        mesh = self.mesh(resolution)
        return len(mesh.tets if isinstance(mesh, TetMesh) else mesh.triangles)

    def scene(self, setting: Setting) -> Scene:
        """The study scene at a setting."""
        return self.study_scene.scene(self.mesh(setting.resolution), setting.youngs)

    def simulator(
        self, setting: Setting, dtype: torch.dtype, solver: Solver | None = None, **options: Any
    ) -> Simulator:
        """A new simulator on the device."""
        chosen = {"iterations": DEFAULT_ITERATIONS, "batch": 1, **options}
        sim = Simulator(self.scene(setting), setting.time_step, solver=solver, dtype=dtype, progress=False, **chosen)
        return sim.to(self.device)

    def start(self, sim: Simulator) -> State:
        """The initial state in the precision of the simulator, rounded to float32."""
        state = self.study_scene.start(sim)
        return State(*(part.float().to(sim.dtype) for part in state))

    def time(self, work: Callable[[], object]) -> Timing:
        """Time a call."""
        return time_calls(work, self.device, seconds=self.seconds, series=self.series)

    @torch.no_grad()
    def hard_step(self, setting: Setting) -> tuple[State, ExactStep]:
        """A float64 state within the motion, rounded to float32, and the converged step from it."""
        if setting not in self._steps:
            sim = self.simulator(setting, torch.float64, Chebyshev(), iterations=1000, tolerance=1e-9)
            state = self.start(sim)
            for _ in range(self.study_scene.steps_before):
                state = sim(state)
            state = State(*(part.float().double() for part in state))
            exact = exact_steps(sim, state)[0]
            self._steps[setting] = (state, exact)
            if exact.uncertainty > _UNCERTAINTY_LIMIT * _SMALLEST_SHOWN:
                warn_user(
                    f"study: the converged step at {setting.youngs:g} Pa has an uncertainty of "
                    f"{exact.uncertainty:.1e}: rows with errors up to ten times that are marked uncertain",
                    UncertainWarning,
                )
        return self._steps[setting]

    def solver(self, name: str, setting: Setting) -> tuple[Solver, float]:
        """A candidate solver for the hard step, and the milliseconds taken to choose its parameters."""
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
        """Percentiles of measured times [s]."""
        p5, median, p95 = np.percentile(np.array(seconds) * 1e3, [5, 50, 95]).tolist()
        return cls(median, p5, p95)

    @property
    def scatter(self) -> float:
        """95th over 5th percentile."""
        return self.p95 / self.p5

    def columns(self) -> dict[str, Any]:
        """The timing columns of a row."""
        return {"milliseconds": self.median, "milliseconds_p5": self.p5, "milliseconds_p95": self.p95}


def clock_of(device: torch.device) -> Callable[[], float]:
    """A clock in seconds; with one CPU thread it counts processor time, which other load hardly affects."""
    alone = device.type == "cpu" and torch.get_num_threads() == 1
    return time.process_time if alone else time.perf_counter


def time_calls(
    work: Callable[[], object], device: torch.device, *, least: int = 7, seconds: float = 0.05, series: int = 1
) -> Timing:
    """Time at least `least` calls and `seconds`; the first call is not counted.

    Scattered times mean other load on the machine: up to `series` series are measured, and the steadiest one is used.
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
    """Number of kernels that a call launches on a GPU, from the profiler; None on the CPU."""
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
    """Peak memory between construction and `read`: from the GPU allocator, or computed from the layout on the CPU."""

    def __init__(self, device: torch.device, layout: int) -> None:
        self._device, self._layout = device, layout
        if device.type == "cuda":
            _wait_for(device)
            torch.cuda.reset_peak_memory_stats(device)

    def read(self) -> tuple[int, str]:
        """Bytes, and how they were found."""
        if self._device.type != "cuda":
            return self._layout, "layout"
        _wait_for(self._device)
        return int(torch.cuda.max_memory_allocated(self._device)), "torch.cuda"


def precision_name(dtype: torch.dtype) -> str:
    """Return "float32" or "float64"."""
    return str(dtype).removeprefix("torch.")


def row_statuses(errors: Sequence[float], uncertainty: float = 0.0, energies: Sequence[float | None] = ()) -> list[str]:
    """The status of each row of a method, ordered by iterations.

    "diverged": the error stays large to the end; early iterates of a method that descends in energy may be far off.
    "uncertain": the uncertainty of the converged step exceeds a tenth of the error, or could explain it. All rows are
    uncertain if an iterate has less energy than the converged step, which then is not the lowest minimum.
    """
    if any(energy is not None and energy < -_LOWER_ENERGY for energy in energies):
        return ["uncertain" if math.isfinite(error) else "diverged" for error in errors]
    # the smallest error from here on
    best = [*accumulate(reversed([e if math.isfinite(e) else math.inf for e in errors]), min)][::-1]
    found = []
    for error, least in zip(errors, best, strict=True):
        if not math.isfinite(error):
            found.append("diverged")
        elif uncertainty > _UNCERTAINTY_LIMIT * max(error, _SMALLEST_SHOWN):
            found.append("uncertain")
        else:
            found.append("ok" if least <= _DIVERGED else "diverged")
    return found


def elements_of(exact: ExactStep) -> int:
    """Number of tetrahedra of a step, or of triangles without any."""
    values = exact.problem.values
    triangles = sum(len(group.corners) for group in values.stencils if group.kind == "triangle")
    return len(values.tets) or triangles


@torch.no_grad()
def solved_step(sim: Simulator, state: State) -> tuple[State, bool]:
    """A step in float64, solved to a relative error of about 1e-9, and whether that was reached.

    Multilevel solves it; where it fails, and with cloth, Chebyshev does.
    """
    sim.tolerance = SOLVED
    guess: str | torch.Tensor = "velocity"
    for solver, iterations in _OF_STENCILS if sim.compiled.has_stencils else _SOLVERS:
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
    """A row for one solver at one iteration count: errors against the known solution, times, memory, kernels."""
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
        status=row_statuses([errors.position], exact.uncertainty, [errors.energy])[0],
        vertices=sim.vertices,
        tets=elements_of(exact),
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
