"""A time step recorded as a CUDA graph."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..plan.material import named_arrays
from ..scene.targets import Targets
from .state import HistoryState, Info, State, history_of

if TYPE_CHECKING:
    from .stepper import Stepper

__all__ = ["CapturedStep"]


def _copied(state: State | HistoryState) -> State | HistoryState:
    positions, velocities = state[0].clone(), state[1].clone()
    if len(state) == 2:
        return State(positions, velocities)
    return HistoryState(positions, velocities, history_of(array.clone() for array in state[2]))


class CapturedStep:
    """A time step of a simulator on a GPU, recorded by `Simulator.capture`, that `replay` repeats.

    A replay reads and writes the given tensors. Put new values into them with `copy_`. Change the material with
    `sim.pin_targets.copy_(...)` or, in the same shape, `sim.set_material(...)`.

    Capture again after a change of settings (time step, iterations, tolerance) or batch: replays keep those of the
    recording. So they do with parameters that `set_material` of another batch or `load_state_dict(assign=True)`
    replaces. A replay is refused after `set_material` has prepared the solver again, or has released a body that pins
    clamped.

        step = sim.capture(state, forces)
        for _ in range(100):
            forces.copy_(policy(state.positions))
            step.replay()               # advances state
    """

    def __init__(
        self,
        sim: Stepper,
        state: State | HistoryState,
        forces: Tensor | None,
        targets: Targets | None,
        start: str | Tensor,
        *,
        report: bool,
    ) -> None:
        if sim.device.type != "cuda":
            raise RuntimeError(
                f"capture: the simulator must be on a GPU for a CUDA graph, got {sim.device}: move it with "
                '.to("cuda"), or call step_ or rollout, which run on every device'
            )
        self.state = state
        self._sim = sim
        rows = (len(state[0]), sim.info_width)
        self._rows = torch.empty(rows, dtype=torch.float64, device=sim.device) if report else None
        # the graph holds addresses only, so the tensors must live as long as the graph
        own = dict(targets) if isinstance(targets, Mapping) else targets
        self._alive = ([array.detach() for array in named_arrays(sim).values()], sim.loads, forces, own, start)

        def run(moved: State | HistoryState) -> None:
            sim.step_(moved, forces, targets, start, info=self._rows)

        # a first call allocates and loads, which cannot be recorded: run it on a copy of the state
        with torch.cuda.device(sim.device):
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                run(_copied(state))
            self._plan = sim.plan  # a first step may have replaced it
            torch.cuda.current_stream().wait_stream(stream)
            self._graph = torch.cuda.CUDAGraph()
            # torch's own recording stream stays on its first device
            with torch.cuda.graph(self._graph, stream=stream):
                run(state)

    def replay(self) -> None:
        """Repeat the step on the current stream, without waiting for it."""
        if self._sim.plan is not self._plan:
            raise RuntimeError(
                "replay: the plan of the simulator has changed since the step was captured (another solver, kernel or "
                "device, a preconditioner made anew, or a body that pins no longer clamp): capture the step again"
            )
        self._graph.replay()

    @property
    def info(self) -> Info:
        """Report of the last replay, see `Info`."""
        if self._rows is None:
            raise RuntimeError("capture: info was not recorded; capture(..., return_info=True) records it")
        return Info.from_rows(self._rows)
