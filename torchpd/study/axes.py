"""The measurements of a study, one axis at a time: errors of the solver, the time step, the mesh and float32."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..accuracy.candidates import DEFAULT, DEFAULT_ITERATIONS
from ..accuracy.error import exact_steps
from ..api.simulator import Simulator
from ..baselines.dense_direct import DENSE, DenseDirect
from ..baselines.methods import BASELINES, Trace, run_baseline
from ..geometry import shapes
from ..scene.effects import Gravity, Pin, Solid
from ..scene.scene import Scene
from ..simulation.state import State
from .bench import (
    Bench,
    PeakMemory,
    Setting,
    Timing,
    clock_of,
    elements_of,
    measure_step,
    precision_name,
    row_statuses,
    solved_step,
    time_calls,
)
from .results_log import Row

__all__ = [
    "PAPER_TESTS",
    "baseline_rows",
    "candidate_rows",
    "dense_rows",
    "float_rows",
    "mesh_rows",
    "paper_rows",
    "stiffness_rows",
    "time_step_rows",
]

Array = NDArray[np.float64]

_REPEATS = 3  # runs of a published method
_MEMORY_ITERATIONS = 3
_NEWTON_ITERATIONS = 25

# Tests of the source paper: constraints, milliseconds of 64 iterations on a GTX 470, and cells of a bar with about as
# many tetrahedra (6 per cell; 1008 and 198 are the bars nearest to 1000 and 200).
PAPER_TESTS = ((1200, 27.0, (8, 5, 5)), (1000, 26.0, (7, 6, 4)), (200, 20.0, (11, 3, 1)))


def _is_default(name: str, dtype: torch.dtype, iterations: int) -> bool:
    return (name, dtype, iterations) == (DEFAULT, torch.float32, DEFAULT_ITERATIONS)


# ---- solver error


def candidate_rows(bench: Bench, name: str, dtype: torch.dtype, setting: Setting, counts: list[int]) -> list[Row]:
    """A compiled solver at several iteration counts, against the converged step."""
    state, exact = bench.hard_step(setting)
    solver, setup = bench.solver(name, setting)
    sim = bench.simulator(setting, dtype, solver)
    rows = [
        measure_step(
            sim, state, exact, count, series=bench.series, seconds=bench.seconds, axis="solver", method=name,
            youngs=setting.youngs, setup_milliseconds=setup, default=_is_default(name, dtype, count),
        )
        for count in counts
    ]  # fmt: skip
    return _with_status(rows)


def _with_status(rows: list[Row]) -> list[Row]:
    """Rows of one method, ordered by iterations, with their status."""
    if not rows:
        return []
    energies = [row.error_energy for row in rows]
    statuses = row_statuses([row.error for row in rows], rows[0].uncertainty or 0.0, energies)
    return [replace(row, status=status) for row, status in zip(rows, statuses, strict=True)]


def baseline_rows(bench: Bench, name: str, setting: Setting, counts: list[int]) -> list[Row]:
    """A published method at several iteration counts, against the converged step."""
    _, exact = bench.hard_step(setting)
    method = BASELINES[name]
    most = min(max(counts), _NEWTON_ITERATIONS) if method.few else max(counts)
    common: dict[str, Any] = {
        "axis": "solver", "method": name, "compiled": False, "parts": method.parts, "youngs": setting.youngs,
        "time_step": setting.time_step, "vertices": len(exact.first), "tets": elements_of(exact),
        "uncertainty": exact.uncertainty,
    }  # fmt: skip
    try:
        clock = clock_of(bench.device)
        traces = [run_baseline(method, exact.problem, exact.first, most, clock=clock) for _ in range(_REPEATS)]
        memory = run_baseline(method, exact.problem, exact.first, _MEMORY_ITERATIONS, memory=True)
    except ValueError as refusal:
        return [Row(status=f"refused: {refusal}", **common)]
    setup = Timing.of([trace.setup_seconds for trace in traces]).median
    rows = [
        _baseline_row(
            traces, iterations, exact.errors_of(traces[0].displacements[iterations]),
            {**common, "setup_milliseconds": setup, "bytes": memory.peak_bytes, "bytes_by": "tracemalloc"},
        )
        for iterations in _reported_iterations(traces[0], counts, every=method.few)
    ]  # fmt: skip
    return _with_status(rows)


def _reported_iterations(trace: Trace, counts: list[int], *, every: bool) -> list[int]:
    """Iterations that become rows: those of the other methods and the last; all of them if `every`."""
    wanted = set(trace.displacements) - {0} if every else {*counts, trace.last}
    return sorted(k for k in wanted if 0 < k <= trace.last)


def _baseline_row(traces: list[Trace], iterations: int, errors: tuple[float, ...], common: dict[str, Any]) -> Row:
    position, energy, residual, metres = errors
    timing = Timing.of([trace.seconds[iterations] for trace in traces])
    return Row(
        iterations=iterations, local_steps=traces[0].local_steps[iterations], error=position, error_energy=energy,
        residual=residual, error_metres=metres, **timing.columns(), **common,
    )  # fmt: skip


@torch.no_grad()
def dense_rows(bench: Bench, name: str, dtype: torch.dtype, setting: Setting, counts: list[int]) -> list[Row]:
    """The direct global step on the device at several iteration counts, against the converged step.

    The set-up time is that of the inverse. The estimate of rho, in NumPy, is not timed.
    """
    _, exact = bench.hard_step(setting)
    problem = exact.problem
    common: dict[str, Any] = {
        "axis": "solver", "method": name, "precision": precision_name(dtype), "youngs": setting.youngs,
        "time_step": setting.time_step, "vertices": len(exact.first), "tets": elements_of(exact),
        "uncertainty": exact.uncertainty,
    }  # fmt: skip
    sim = bench.simulator(setting, dtype)
    try:
        setup = time_calls(lambda: DenseDirect(sim, problem), bench.device, least=1)
        method = DenseDirect(sim, problem)
    except (ValueError, torch.cuda.OutOfMemoryError, torch.linalg.LinAlgError) as refusal:  # type: ignore[attr-defined]
        return [Row(status=f"refused: {refusal}", **common)]
    omegas = DENSE[name](problem, exact.first, max(counts))
    first = torch.as_tensor(exact.first, dtype=dtype, device=bench.device)
    rows = []
    for count in counts:
        watch = PeakMemory(bench.device, method.bytes)
        play = method.recorded(first, omegas[:count])
        errors = exact.errors_of(play().double().cpu().numpy())
        held, how = watch.read()
        rows.append(
            Row(
                iterations=count, local_steps=count, error=errors.position, error_energy=errors.energy,
                residual=errors.residual, error_metres=errors.metres, setup_milliseconds=setup.median, bytes=held,
                bytes_by=how, **bench.time(play).columns(), **common,
            )
        )  # fmt: skip
    return _with_status(rows)


def stiffness_rows(bench: Bench, name: str, dtype: torch.dtype, setting: Setting, counts: list[int]) -> list[Row]:
    """A compiled solver at one stiffness."""
    rows = candidate_rows(bench, name, dtype, setting, counts)
    return [Row(**{**vars(row), "axis": "stiffness"}) for row in rows]


# ---- float32


@torch.no_grad()
def float_rows(bench: Bench, setting: Setting, counts: list[int]) -> list[Row]:
    """Distance of float32 from float64 at equal iterations of the default solver, relative to |u_0 - u*|."""
    state, exact = bench.hard_step(setting)
    rows = []
    sims = [bench.simulator(setting, dtype) for dtype in (torch.float32, torch.float64)]
    given = State(*(part.float() for part in state))
    for count in counts:
        ends = []
        for sim in sims:
            sim.iterations = count
            after = sim(State(*(part.to(sim.dtype) for part in state)))
            ends.append(after.velocities[0].double().cpu().numpy() * sim.time_step)
        timing = bench.time(lambda: sims[0](given))
        off = ends[0] - ends[1]
        error = float(np.linalg.norm(off)) / exact.scale
        rows.append(
            Row(
                axis="float", method=DEFAULT, precision="float32", iterations=count, local_steps=count,
                youngs=setting.youngs, time_step=setting.time_step, vertices=sims[0].vertices,
                tets=elements_of(exact), error=error,
                error_metres=float(np.linalg.norm(off, axis=1).max()), **timing.columns(),
            )
        )  # fmt: skip
    return _with_status(rows)


# ---- time step and mesh: whole motions, solved so far that only one error remains


@dataclass(frozen=True)
class _Motion:
    setting: Setting
    vertices: int
    steps: int
    displacement: Array  # [n, 3] m of the probes, x_T - x_0
    energy: float  # at the end, J
    initial_kinetic: float  # kinetic energy at the start, J
    seconds: float  # wall time
    solved: bool  # every step was solved


@torch.no_grad()
def _motion(bench: Bench, setting: Setting, steps: int) -> _Motion:
    sim = bench.simulator(setting, torch.float64)
    state = bench.start(sim)
    clock = clock_of(bench.device)
    begin = clock()
    end, solved = state, True
    for _ in range(steps):
        end, converged = solved_step(sim, end)
        solved = solved and converged
    positions = end.positions[0].cpu().numpy()
    seconds = clock() - begin
    mesh = bench.mesh(setting.resolution)
    places = [bench.study_scene.probes(mesh, x) for x in (state.positions[0].cpu().numpy(), positions)]
    initial_kinetic = float(sim.energy(state)[0] - sim.energy(state.positions)[0])
    displacement = places[1] - places[0]
    return _Motion(
        setting, sim.vertices, steps, displacement, float(sim.energy(end)[0]), initial_kinetic, seconds, solved
    )


def _motion_rows(bench: Bench, axis: str, runs: list[tuple[Setting, int]]) -> list[Row]:
    """Errors of whole motions against the last one: of the displacement of the probes and of the final energy."""
    *motions, exact = [_motion(bench, setting, steps) for setting, steps in runs]
    rows = []
    for motion in motions:
        setting, off = motion.setting, motion.displacement - exact.displacement
        rows.append(
            Row(
                axis=axis, method="solved", status="ok" if motion.solved and exact.solved else "uncertain",
                iterations=motion.steps, youngs=setting.youngs, time_step=setting.time_step,
                vertices=motion.vertices, tets=bench.elements(setting.resolution),
                error=float(np.linalg.norm(off) / np.linalg.norm(exact.displacement)),
                error_metres=float(np.linalg.norm(off, axis=1).max()),
                error_energy=abs(motion.energy - exact.energy) / exact.initial_kinetic,
                milliseconds=1e3 * motion.seconds,
                more={"resolution": float(setting.resolution), "seconds_of_motion": motion.steps * setting.time_step},
            )
        )  # fmt: skip
    return rows


def time_step_rows(bench: Bench, setting: Setting, halvings: int, *, finer: int = 3) -> list[Row]:
    """The motion of six time steps, repeated with halved steps, against steps shorter by 2^finer."""
    lengths = [*range(halvings), halvings - 1 + finer]
    return _motion_rows(
        bench,
        "time step",
        [(Setting(setting.youngs, setting.time_step / 2**n, setting.resolution), 6 * 2**n) for n in lengths],
    )


def mesh_rows(bench: Bench, setting: Setting, resolutions: tuple[int, ...]) -> list[Row]:
    """The motion of six time steps on coarser meshes, against the finest."""
    if len(resolutions) < 2:
        return [Row(axis="mesh", method=DEFAULT, status="refused: a tetrahedral mesh has one resolution")]
    runs = [(Setting(setting.youngs, setting.time_step, resolution), 6) for resolution in resolutions]
    return _motion_rows(bench, "mesh", runs)


# ---- the table of the source paper


def paper_rows(bench: Bench) -> list[Row]:
    """A float32 step of as many tetrahedra as the paper's tests have constraints, with its 64 iterations."""
    rows = []
    for constraints, theirs, cells in PAPER_TESTS:
        mesh = shapes.box((1.0, 0.2, 0.2), cells)
        body = Solid(mesh, youngs=1e5, density=1000.0)
        scene = Scene(body, Pin(body, mesh.vertices[:, 0] == 0.0), Gravity((0.0, -9.81, 0.0)))
        sim = Simulator(scene, 1 / 60, DEFAULT_ITERATIONS, batch=1, progress=False).to(bench.device)
        state = sim.rest_state()
        state.velocities[..., 1] = -3.0 * state.positions[..., 0] ** 2
        more = {"constraints": float(constraints), "paper_milliseconds": theirs}
        rows.append(
            measure_step(
                sim, state, exact_steps(sim, state)[0], DEFAULT_ITERATIONS, series=bench.series, seconds=bench.seconds,
                axis="paper", method=DEFAULT, youngs=1e5, default=True, more=more,
            )
        )  # fmt: skip
    return rows
