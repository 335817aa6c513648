"""Many steps: in one call of the op where nothing changes on the way, else one by one."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NoReturn

import torch
from torch import Tensor
from tqdm import tqdm

from .checks import STEPS_DIFFER
from .material import MATERIAL_ROWS
from .ops import refuse_tangents
from .state import Info, State, Track
from .targets import Anchors, Targets

if TYPE_CHECKING:
    from .simulator import Simulator

__all__ = ["PerStep", "Rollout", "roll"]

PerStep = Callable[[int], Any]
_SECONDS_OF_PIECE = 0.1
_SPHERES = list(MATERIAL_ROWS).index("spheres")


@dataclass(frozen=True, eq=False)
class Rollout:
    """What `Simulator.rollout` was asked for."""

    state: State
    steps: int
    every: int
    forces: Tensor | PerStep | None
    targets: Targets | PerStep | None
    start: str
    report: bool
    first: int  # number of the first step

    @property
    def records(self) -> int:
        """How many states are kept."""
        return self.steps // self.every

    def tracks_gradient(self, material: list[Tensor]) -> bool:
        """Whether anything that goes in wants a gradient."""
        if not torch.is_grad_enabled():
            return False
        given = self.targets.values() if isinstance(self.targets, Mapping) else [self.targets]
        tensors = [*self.state, self.forces, *given, *material]
        return any(isinstance(tensor, Tensor) and tensor.requires_grad for tensor in tensors)


def roll(sim: Simulator, call: Rollout, *, progress: bool) -> Track:
    """The recorded states."""
    if callable(call.forces):
        sim.check_state(call.state)
    else:
        call = replace(call, forces=sim.check_state(call.state, forces=call.forces, fix=STEPS_DIFFER))
    one_by_one = callable(call.forces) or callable(call.targets)
    if not (one_by_one or progress):
        return _piece(sim, call, _constant_material(sim, call))
    if not progress:
        # no bar that is switched off: torch.compile cannot make one
        return _one_by_one(sim, call, None)
    with tqdm(total=call.steps, desc="simulating", unit="step", leave=False) as bar:
        return _one_by_one(sim, call, bar) if one_by_one else _in_pieces(sim, call, bar)


def _constant_material(sim: Simulator, call: Rollout) -> list[Tensor]:
    if callable(call.targets):
        return sim.material()
    material = sim.material_at(call.targets, call.state[0].shape[0], fix=STEPS_DIFFER)
    return _moved_on(material, call.first) if call.first else material


def _piece(sim: Simulator, call: Rollout, material: list[Tensor]) -> Track:
    refuse_tangents(*call.state, call.forces if isinstance(call.forces, Tensor) else None, *material)
    sim._notices.before(sim, call.state, material, sim.time_step, report=call.report)
    # the op has a derivative where it records every state, as its adjoint needs them
    thinned = call.every > 1 and call.tracks_gradient(material)
    found = torch.ops.torchpd.rollout(
        call.state[0],
        call.state[1],
        call.forces,
        material,
        list(sim.plan.arrays),
        steps=call.records * call.every if thinned else call.steps,
        every=1 if thinned else call.every,
        **sim.numbers(inertial=call.start == "inertial", report=call.report),
    )
    if thinned:
        # copies, since all states are kept for the adjoint: not by these, and not to change with them
        found = [out[call.every - 1 :: call.every].clone(memory_format=torch.contiguous_format) for out in found]
    positions, velocities, rows = found
    if call.report and not torch.compiler.is_compiling():
        for reached, row in zip(positions, rows, strict=True):
            sim._notices.after(sim, reached, row)
    return Track(positions, velocities, Info.from_rows(rows))


def _in_pieces(sim: Simulator, call: Rollout, bar: tqdm[NoReturn]) -> Track:
    """In pieces of a tenth of a second or so: the bar moves, and on a GPU, too, Ctrl-C ends it between them."""
    material = _constant_material(sim, call)
    tracks = [_piece(sim, replace(call, steps=0, report=False), material)]
    state, done, size = call.state, 0, 1
    while done < call.steps:
        whole, left = size // call.every * call.every, call.every - done % call.every
        steps = min(whole if whole and left == call.every else min(size, left), call.steps - done)
        recorded = (done + steps) // call.every > done // call.every
        every = call.every if recorded and steps >= call.every else steps
        part = replace(call, state=state, steps=steps, every=every, report=call.report and recorded)
        begin = time.perf_counter()
        track = _piece(sim, part, material)
        if sim.device.type == "cuda":
            _finish(sim.device)
        if time.perf_counter() - begin < _SECONDS_OF_PIECE:
            size *= 2
        if recorded:
            tracks.append(track)
        done += steps
        if done < call.steps:
            state, material = track.state(), _moved_on(material, steps)
        bar.update(steps)
    info = Info(*(torch.cat(column) for column in zip(*(track.info for track in tracks), strict=True)))
    return Track(torch.cat([t.positions for t in tracks]), torch.cat([t.velocities for t in tracks]), info)


def _finish(device: torch.device) -> None:
    """Wait for a GPU, but hear signals."""
    reached = torch.cuda.Event()
    reached.record(torch.cuda.current_stream(device))
    while not reached.query():
        time.sleep(1e-4)


def _one_by_one(sim: Simulator, call: Rollout, bar: tqdm[NoReturn] | None) -> Track:
    states, rows = [], []
    state, batch = call.state, call.state[0].shape[0]
    material = _constant_material(sim, call)
    if callable(call.targets) and call.first:
        # only for where its spheres were
        material = sim.material_at(call.targets(call.first - 1), batch)
    for step in range(call.first, call.first + call.steps):
        if callable(call.targets):
            material = _material_after(sim, material, call.targets(step), batch)
        elif step > call.first:
            material = _moved_on(material, 1)
        recorded = (step + 1 - call.first) % call.every == 0
        forces = call.forces
        if callable(forces):
            forces = sim.check_state(state, forces=forces(step))
        state, row = sim.advance(state, forces, material, call.start, report=call.report and recorded)
        if recorded:
            states.append(state)
            rows.append(row)
        if bar is not None:
            bar.update(1)
    if not states:
        return _piece(sim, replace(call, steps=0, forces=None), sim.material())
    info = Info.from_rows(torch.stack(rows))
    return Track(torch.stack([s[0] for s in states]), torch.stack([s[1] for s in states]), info)


def _material_after(sim: Simulator, before: list[Tensor], targets: Targets | None, batch: int) -> list[Tensor]:
    """The material of a step with these targets, after one with the material `before`."""
    if isinstance(targets, Mapping):
        targets = sim.anchors.with_velocities(targets, before[_SPHERES], batch=batch, time_step=sim.time_step)
    return sim.material_at(targets, batch)


def _moved_on(material: list[Tensor], steps: int) -> list[Tensor]:
    """The material with moving spheres where they are some steps later."""
    return [
        Anchors.moved_on(array, steps) if name == "spheres" else array
        for name, array in zip(MATERIAL_ROWS, material, strict=True)
    ]
