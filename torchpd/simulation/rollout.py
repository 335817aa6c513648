"""Many time steps: one call of the op if nothing changes between them, else chunks."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn, Protocol

import torch
from torch import Tensor
from tqdm.auto import tqdm

from ..common.checks import STEPS_DIFFER
from ..plan.material import CORE_ROWS
from ..scene.targets import NO_INPUTS, Anchors, ColliderInputs, Targets
from .state import ContactHistory, HistoryState, HistoryTrack, State, Track, history_of, widened
from .surface_loads import SurfaceLoads

if TYPE_CHECKING:
    from typing_extensions import TypeIs

__all__ = ["PerStep", "Rollout", "run_rollout"]

PerStep = Callable[[int], Any]
_CHUNK_SECONDS = 0.1
_SPHERES = CORE_ROWS.index("spheres")


class Steps(Protocol):
    """The parts of a simulator that a rollout uses."""

    anchors: Anchors
    loads: SurfaceLoads | None

    @property
    def time_step(self) -> float: ...

    @property
    def device(self) -> torch.device: ...

    @property
    def keeps_history(self) -> bool: ...

    def check_state(
        self, state: State | HistoryState, *, forces: Tensor | None = None, fix: str = ""
    ) -> Tensor | None: ...

    def material(self) -> list[Tensor]: ...

    def material_at(self, targets: Targets | None, batch: int, *, fix: str = "") -> list[Tensor]: ...

    def forces_at(
        self, state: State | HistoryState, forces: Tensor | None, targets: Targets | None, material: list[Tensor]
    ) -> Tensor | None: ...

    def collider_inputs(self, state: State | HistoryState, targets: Targets | None) -> ColliderInputs: ...

    def track(self, *found: Tensor) -> Track | HistoryTrack: ...

    def advance(
        self,
        state: State | HistoryState,
        forces: Tensor | None,
        material: list[Tensor],
        *,
        steps: int,
        every: int,
        inertial: bool,
        report: bool,
        inputs: ColliderInputs = NO_INPUTS,
    ) -> tuple[Tensor, ...]: ...


@dataclass(frozen=True, eq=False)
class Rollout:
    """Arguments of `Simulator.rollout`."""

    state: State | HistoryState
    steps: int
    every: int
    forces: Tensor | PerStep | None
    targets: Targets | PerStep | None
    inertial: bool
    report: bool
    first: int  # number of the first step


def run_rollout(sim: Steps, call: Rollout, *, progress: bool) -> Track | HistoryTrack:
    """Run a rollout and return the recorded states."""
    forces = sim.check_state(call.state, forces=None if _is_function(call.forces) else call.forces, fix=STEPS_DIFFER)
    material = _first_material(sim, call)
    if progress:
        with tqdm(total=call.steps, desc="simulating", unit="step", leave=False) as bar:
            found = _in_chunks(sim, call, forces, material, bar)
    elif _changes(sim, call):
        # without a disabled bar, because torch.compile cannot trace one
        found = _in_chunks(sim, call, forces, material, None)
    else:
        found = sim.advance(
            call.state, forces, material, steps=call.steps, every=call.every, inertial=call.inertial, report=call.report
        )
    return sim.track(*found)


def _in_chunks(
    sim: Steps, call: Rollout, forces: Tensor | None, material: list[Tensor], bar: tqdm[NoReturn] | None
) -> tuple[Tensor, ...]:
    """Take single steps if anything changes between steps, else chunks of about 0.1 s.

    Between chunks the bar moves, and Ctrl-C is noticed on a GPU.
    """
    adaptive = not _changes(sim, call)
    targets = None if _is_function(call.targets) else call.targets
    chunks, state, done, steps, size = [], call.state, 0, 0, 1
    while done < call.steps:
        if _is_function(call.targets):
            targets = call.targets(call.first + done)
            material = _material_after(sim, material, targets, state[0].shape[0])
        elif done:
            material = _moved_on(material, steps)
        if _is_function(call.forces):
            forces = sim.check_state(state, forces=call.forces(call.first + done))
        # whole intervals between records, or a part of one
        left = call.every - done % call.every
        steps = size // call.every * call.every if left == call.every <= size else min(size, left)
        steps = min(steps, call.steps - done)
        recorded, every = steps >= left, min(steps, call.every)
        begin = time.perf_counter() if bar is not None else 0.0
        chunk = sim.advance(
            state,
            sim.forces_at(state, forces, targets, material),
            material,
            steps=steps,
            every=every,
            inertial=call.inertial,
            report=call.report and recorded,
            inputs=sim.collider_inputs(state, targets),
        )
        if recorded:
            chunks.append(chunk)
        state, done = _reached(*chunk), done + steps
        if bar is not None:
            if adaptive and _finish(sim.device) - begin < _CHUNK_SECONDS:
                size *= 2
            bar.update(steps)
    if not chunks:
        chunks.append(sim.advance(call.state, None, material, steps=0, every=1, inertial=call.inertial, report=False))
    return tuple(torch.cat(parts) for parts in zip(*_as_wide(chunks), strict=True))


def _as_wide(chunks: list[tuple[Tensor, ...]]) -> list[tuple[Tensor, ...]]:
    """Chunks whose histories have room for as many pairs; a capacity that grows makes later ones wider."""
    histories = [history_of(chunk[3:]) if len(chunk) > 3 else None for chunk in chunks]
    widths = [history.keys.shape[-1] for history in histories if isinstance(history, ContactHistory)]
    widest = max(widths) if widths else 0
    return [
        (*chunk[:3], *widened(history, widest)) if isinstance(history, ContactHistory) else chunk
        for chunk, history in zip(chunks, histories, strict=True)
    ]


def _reached(positions: Tensor, velocities: Tensor, _rows: Tensor, *history: Tensor) -> State | HistoryState:
    """The last state of a chunk."""
    if not history:
        return State(positions[-1], velocities[-1])
    return HistoryState(positions[-1], velocities[-1], history_of(array[-1] for array in history))


def _changes(sim: Steps, call: Rollout) -> bool:
    """Whether inputs change between steps: functions of the step number, loads and history, which follow the state."""
    return _is_function(call.forces) or _is_function(call.targets) or sim.loads is not None or sim.keeps_history


def _is_function(given: Any) -> TypeIs[PerStep]:
    """Whether forces or targets are a function of the step number; torch.compile cannot ask `callable` of a mapping."""
    return not isinstance(given, Tensor | Mapping) and callable(given)


def _finish(device: torch.device) -> float:
    """Wait for a GPU while noticing signals; return the time [s] when it has finished."""
    if device.type == "cuda":
        reached = torch.cuda.Event()
        reached.record(torch.cuda.current_stream(device))
        while not reached.query():
            time.sleep(1e-4)
    return time.perf_counter()


def _first_material(sim: Steps, call: Rollout) -> list[Tensor]:
    """Material of the first step or, if targets are a function, of the step before it."""
    batch = call.state[0].shape[0]
    if _is_function(call.targets):
        # for the positions of its spheres only
        return sim.material_at(call.targets(call.first - 1), batch) if call.first else sim.material()
    material = sim.material_at(call.targets, batch, fix=STEPS_DIFFER)
    return _moved_on(material, call.first) if call.first else material


def _material_after(sim: Steps, before: list[Tensor], targets: Targets | None, batch: int) -> list[Tensor]:
    """Material of a step with these targets, after one with the material `before`."""
    if isinstance(targets, Mapping):
        targets = sim.anchors.with_velocities(targets, before[_SPHERES], batch=batch, time_step=sim.time_step)
    return sim.material_at(targets, batch)


def _moved_on(material: list[Tensor], steps: int) -> list[Tensor]:
    """The material with moving spheres advanced by some steps."""
    moved = list(material)
    moved[_SPHERES] = Anchors.moved_on(material[_SPHERES], steps)
    return moved
