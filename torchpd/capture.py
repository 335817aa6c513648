"""A time step as a CUDA graph: the host says once what to do, and then only "again"."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from .material import named_arrays
from .ops import INFO_WIDTH
from .state import Info, State
from .targets import Targets

if TYPE_CHECKING:
    from .stepper import Stepper

__all__ = ["CapturedStep"]


class CapturedStep:
    """A time step of a simulator on a GPU that `replay` repeats, made by `Simulator.capture`.

    A replay reads and writes the very tensors that were given: put new values into them with `copy_`, and into the
    material with `sim.pin_targets.copy_(...)` or, in the same shape, `sim.set_material(...)`. Settings (time step,
    iterations, tolerance), the batch, and the material that was there, where `set_material` with another batch or
    `load_state_dict(assign=True)` makes new parameters, stay those of the recording; capture again to change them, and
    where `set_material` prepares the solver anew, or first lets a body go that pins clamped: a replay refuses then.

        step = sim.capture(state, forces)
        for _ in range(100):
            forces.copy_(policy(state.positions))
            step.replay()               # moves state on
    """

    def __init__(
        self,
        sim: Stepper,
        state: State,
        forces: Tensor | None,
        targets: Targets | None,
        start: str | Tensor,
        *,
        report: bool,
    ) -> None:
        if sim.device.type != "cuda":
            raise RuntimeError(
                f"capture: a CUDA graph needs a simulator on a GPU, and this one is on {sim.device}: move it with "
                '.to("cuda"), or call step_ or rollout, which do the same on every device'
            )
        self.state = state
        self._sim = sim
        rows = (len(state[0]), INFO_WIDTH)
        self._rows = torch.empty(rows, dtype=torch.float64, device=sim.device) if report else None
        # the graph knows addresses only: what lies there has to live as long as it does
        own = dict(targets) if isinstance(targets, Mapping) else targets
        self._alive = ([array.detach() for array in named_arrays(sim).values()], forces, own, start)

        def run(moved: State) -> None:
            sim.step_(moved, forces, targets, start, info=self._rows)

        # what is allocated or loaded at a first call cannot be recorded; a copy of the state takes it
        with torch.cuda.device(sim.device):
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                run(State(state[0].clone(), state[1].clone()))
            self._plan = sim.plan  # which a first step may have replaced
            torch.cuda.current_stream().wait_stream(stream)
            self._graph = torch.cuda.CUDAGraph()
            # torch's own stream for recording is of one device for good
            with torch.cuda.graph(self._graph, stream=stream):
                run(state)

    def replay(self) -> None:
        """The step once more, on the current stream, without waiting for it."""
        if self._sim.plan is not self._plan:
            raise RuntimeError(
                "replay: the simulator has another plan than when the step was captured (another solver, kernel or "
                "device, a preconditioner made anew, or a body that pins no longer clamp): capture it again"
            )
        self._graph.replay()

    @property
    def info(self) -> Info:
        """How the step of the last replay was solved."""
        if self._rows is None:
            raise RuntimeError("capture: info was not asked for; capture(..., return_info=True) records it")
        return Info.from_rows(self._rows)
