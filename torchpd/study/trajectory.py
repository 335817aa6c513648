"""Effect of unconverged steps on a motion: false softness, damping and energy growth, against the converged motion."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from ..accuracy.candidates import DEFAULT, DEFAULT_ITERATIONS
from ..api.simulator import Simulator
from ..simulation.state import State
from .bench import Bench, Setting, clock_of, precision_name, solved_step
from .results_log import Array, Row, Trajectory

__all__ = ["compare_trajectories", "first_turn", "record_trajectory", "tolerance_rows", "trajectory_rows"]


@torch.no_grad()
def record_trajectory(
    bench: Bench, sim: Simulator, resolution: int, seconds: float, *, solve: bool = False
) -> Trajectory:
    """Record the motion of the study scene from its start, for `seconds` of simulated time.

    With `solve` every step is solved to 1e-9 by the solvers of `solved_step`.
    """
    state, steps = bench.start(sim), max(1, round(seconds / sim.time_step))
    clock = clock_of(bench.device)
    begin = clock()
    solved, iterations = True, math.nan
    if solve:
        states = [state]
        for _ in range(steps):
            after, converged = solved_step(sim, states[-1])
            states.append(after)
            solved = solved and converged
        positions, velocities = (torch.cat(parts) for parts in zip(*states, strict=True))
    else:
        track = sim.rollout(state, steps)
        positions = torch.cat([state.positions, track.positions[:, 0]])
        velocities = torch.cat([state.velocities, track.velocities[:, 0]])
        iterations = float(track.info.iterations.double().mean())
    positions = positions.cpu()
    elapsed = clock() - begin
    energies = sim.energy(State(positions.to(sim.device), velocities)).double().cpu().numpy()
    mesh = bench.mesh(resolution)
    probes = np.stack([bench.study_scene.probes(mesh, x) for x in positions.double().numpy()])
    initial_kinetic = float(sim.energy(state)[0] - sim.energy(state.positions)[0])
    return Trajectory(sim.time_step, probes, energies, initial_kinetic, 1e3 * elapsed / steps, solved, iterations)


def first_turn(signal: Array, time_step: float) -> float:
    """Time [s] of the first turning point of a signal (half a period of a swing from rest), by a parabola.

    NaN without a turning point, or for one within rounding.
    """
    change = np.diff(signal)
    # two equal samples at the top also form a turning point
    turned = np.flatnonzero((change[:-1] * change[1:] <= 0.0) & (change[:-1] != 0.0))
    if not len(turned):
        return math.nan
    k = int(turned[0]) + 1
    left, middle, right = signal[k - 1 : k + 2]
    return float(time_step * (k + 0.5 * (left - right) / (left - 2.0 * middle + right)))


def compare_trajectories(motion: Trajectory, exact: Trajectory) -> dict[str, float]:
    """Differences of a motion from the converged one.

    path: largest distance of a probe from its converged position, over the largest displacement of any probe.
    turn: time of the first turning point of the swing, over the converged one, less one.
    softness: amplitude of the swing over that of the converged motion, less one; positive is too soft.
    energy: final energy less that of the converged motion, over the kinetic energy of the start. Negative is false
        damping, positive is energy growth.
    growth: largest rise above the initial energy, over the kinetic energy of the start; implicit Euler has none.
    """
    ways = exact.probes - exact.probes[0]
    far = int(np.linalg.norm(ways, axis=2).max(axis=0).argmax())
    # along the direction of the largest swing of the farthest probe
    direction = np.linalg.svd(ways[:, far] - ways[:, far].mean(axis=0))[2][0]
    swings = [(t.probes[:, far] - t.probes[0, far]) @ direction for t in (motion, exact)]
    turns = [first_turn(swing, t.time_step) for swing, t in zip(swings, (motion, exact), strict=True)]
    reach = [float(np.abs(swing).max()) for swing in swings]
    return {
        "path": float(np.linalg.norm(motion.probes - exact.probes, axis=2).max() / np.linalg.norm(ways, axis=2).max()),
        "turn": turns[0] / turns[1] - 1.0,
        "softness": reach[0] / reach[1] - 1.0,
        "energy": float(motion.energies[-1] - exact.energies[-1]) / exact.initial_kinetic,
        "growth": float((motion.energies - motion.energies[0]).max()) / exact.initial_kinetic,
    }


def _converged(bench: Bench, setting: Setting, seconds: float) -> Trajectory:
    """The converged motion, recorded once for all solvers."""
    key = (setting, seconds)
    if key not in bench.motions:
        sim = bench.simulator(setting, torch.float64)
        bench.motions[key] = record_trajectory(bench, sim, setting.resolution, seconds, solve=True)
    return bench.motions[key]


def trajectory_rows(
    bench: Bench, setting: Setting, counts: list[int], *, seconds: float = 1.0, name: str = DEFAULT
) -> list[Row]:
    """A motion at several iteration counts of a float32 solver, against the converged one in float64."""
    solver = bench.solver(name, setting)[0]
    rows = []
    for count in counts:
        sim = bench.simulator(setting, torch.float32, solver, iterations=count)
        default = name == DEFAULT and count == DEFAULT_ITERATIONS
        rows.append(replace(_motion_row(bench, sim, setting, seconds), method=name, default=default))
    return rows


def tolerance_rows(
    bench: Bench, setting: Setting, tolerances: list[float], most: int, *, seconds: float = 1.0, name: str
) -> list[Row]:
    """A motion solved to several tolerances with at most `most` iterations; `iterations` is the mean."""
    solver = bench.solver(name, setting)[0]
    rows = []
    for tolerance in tolerances:
        sim = bench.simulator(setting, torch.float32, solver, iterations=most, tolerance=tolerance)
        row = _motion_row(bench, sim, setting, seconds)
        rows.append(replace(row, method=f"{name}, tolerance", more={**row.more, "tolerance": tolerance}))
    return rows


def _motion_row(bench: Bench, sim: Simulator, setting: Setting, seconds: float) -> Row:
    exact = _converged(bench, setting, seconds)
    motion = record_trajectory(bench, sim, setting.resolution, seconds)
    found = compare_trajectories(motion, exact)
    finite = math.isfinite(found["path"])
    status = "diverged" if not finite else "ok" if exact.solved else "uncertain"
    iterations = round(motion.iterations)
    return Row(
        axis="trajectory", method="", precision=precision_name(sim.dtype), iterations=iterations,
        local_steps=iterations, status=status, youngs=setting.youngs, time_step=setting.time_step,
        vertices=sim.vertices, tets=bench.elements(setting.resolution),
        error=found["path"] if finite else math.inf, milliseconds=motion.milliseconds,
        more={**found, "seconds_of_motion": seconds},
    )  # fmt: skip
