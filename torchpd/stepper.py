"""Steps of a compiled scene: an `nn.Module` that moves states."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor

from .adjoint import step_gradient
from .checks import check_like, check_whole
from .material import MATERIAL_ROWS, environments_of_material, named_arrays
from .ops import INFO_WIDTH, refuse_tangents
from .readable import Readable
from .rollout import PerStep, Rollout, roll
from .state import Info, State, StepCall, Track
from .synonyms import check_arguments
from .targets import Targets

__all__ = ["Stepper"]

_ops = torch.ops.torchpd


class Stepper(Readable):
    """What a `Simulator` does to states: steps, rollouts, energies and their gradients."""

    __call__: StepCall

    # ---- states

    @check_arguments("Simulator.rest_state")
    def rest_state(self, batch: int | None = None) -> State:
        """Everything at rest [batch, V, 3], by default once for each environment of the material."""
        count = (
            environments_of_material(named_arrays(self)) if batch is None else check_whole("batch", batch, minimum=0)
        )
        shape = (count, -1, -1)
        positions = self.rest_positions.expand(shape).clone()
        return State(positions, torch.zeros_like(positions))

    def forward(
        self,
        state: State,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        start: str | Tensor = "velocity",
        return_info: bool = False,
    ) -> State | tuple[State, Info]:
        """One time step.

        Within `torch.autocast`, which changes no number of it, forces may be of half precision.

        Args:
            state: positions and velocities [B, V, 3] [m, m/s].
            forces: on the vertices [B, V, 3] [N], or [V, 3] or [1, V, 3] for all environments; constant during the
                step.
            targets: where pins and spheres are at the end of the step [m]: by part, or one tensor [P, 3] or [B, P, 3]
                for all pins together. A sphere takes its centre [3] or [B, 3], and with its velocity [6] or [B, 6],
                which friction then drags vertices along with.
            start: first iterate: "velocity" (x + h v), "inertial" (with gravity and forces), or positions [B, V, 3].
                The first two are moved out of contacts and along rigid motions; bodies that planes would squeeze there
                by more than is gained start from x instead.
            return_info: also how the solve went; costs some ten iterations more, no synchronisation.

        Returns:
            The next state, or (state, info). Gradients: `torch.autograd` (implicit adjoint at the end of the step; its
            error follows that of the step), friction included, see `torchpd.adjoint`, and for planes and spheres
            themselves; none for `start`. Forward mode and `torch.func.grad` are not provided.
        """
        forces = self.check_state(state, forces=forces)
        material = self.material_at(targets, state[0].shape[0])
        given, inertial = _first_iterate(start, state[0])
        refuse_tangents(*state, forces, *material)
        self._notices.before(self, state, material, self.time_step, report=return_info)
        positions, velocities, rows = _ops.step(
            state[0],
            state[1],
            forces,
            given,
            material,
            list(self.plan.arrays),
            **self.numbers(inertial=inertial, report=return_info),
        )
        after = State(positions, velocities)
        if not return_info:
            return after
        self._notices.after(self, positions, rows)
        return after, Info.from_rows(rows)

    @torch.no_grad()
    def step_(
        self,
        state: State,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        start: str | Tensor = "velocity",
        *,
        info: Tensor | None = None,
    ) -> None:
        """One time step that overwrites the state, without gradients. Arguments as in `forward`.

        If an exception ends it, as Ctrl-C does, each environment is either before the step or after it.

        Args:
            info: rows [B, 7] float64 to fill in, see `Info.from_rows`; None leaves out residual, energy and inverted.
        """
        forces = self.check_state(state, forces=forces)
        if state[0].requires_grad or state[1].requires_grad:
            raise ValueError(
                "step_ overwrites the state, so it must not require gradients; detach it or call the simulator"
            )
        if not (info is None or isinstance(info, Tensor)):
            raise TypeError(
                f"step_: info must be None or a float64 tensor {[len(state[0]), INFO_WIDTH]} to fill in, got "
                f"{type(info).__name__}"
            )
        given, inertial = _first_iterate(start, state[0])
        material = self.material_at(targets, state[0].shape[0])
        self._notices.before(self, state, material, self.time_step, report=info is not None)
        rows = state[0].new_empty((state[0].shape[0], INFO_WIDTH), dtype=torch.float64) if info is None else info
        _ops.step_(
            state[0],
            state[1],
            rows,
            forces,
            given,
            material,
            list(self.plan.arrays),
            **self.numbers(inertial=inertial, report=info is not None),
        )
        if info is not None:
            self._notices.after(self, state[0], info)

    @check_arguments("Simulator.rollout")
    def rollout(
        self,
        state: State,
        steps: int,
        every: int = 1,
        *,
        forces: Tensor | PerStep | None = None,
        targets: Targets | PerStep | None = None,
        first: int = 0,
        start: str = "velocity",
        return_info: bool = False,
        progress: bool = False,
    ) -> Track:
        """Many time steps.

        Ctrl-C ends it within a second on a CPU, as any long step, and on a GPU with `progress`.

        Args:
            state: where to start.
            steps: how many.
            every: steps from one record to the next; the track has steps // every records.
            forces: as in `forward`, constant, or a function of the step number.
            targets: as in `forward`, constant (a sphere with a velocity goes on with it), or a function of the step
                number. A sphere's centre that comes from a function without a velocity has that of its way from where
                the sphere was at the end of the step before: where the scene has it before step 0 and after steps that
                leave it out.
            first: number of the first step, where this rollout goes on from another: `rollout(state, 9)` ends as
                `rollout(rollout(state, 5).state(), 4, first=5)` does. For where spheres were, a function of targets is
                asked for the step before, too; others are moved on by an addition for each step before.
            start: first iterate of every step, "velocity" or "inertial".
            return_info: fill in residual, energy and inverted of the recorded steps, see `Info`.
            progress: show a bar, for which a GPU finishes a piece of about 0.1 s before the next one begins.

        Returns:
            Track of the recorded states.
        """
        steps, every = check_whole("steps", steps, minimum=0), check_whole("every", every, minimum=1)
        first = check_whole("first", first, minimum=0)
        if not _is_start(start):
            raise ValueError(f'rollout: start must be "velocity" or "inertial", got {_in_short(start)}')
        call = Rollout(state, steps, every, forces, targets, start == "inertial", return_info, first)
        return roll(self, call, progress=progress)

    def advance(
        self,
        state: State,
        forces: Tensor | None,
        material: list[Tensor],
        *,
        steps: int,
        every: int,
        inertial: bool,
        report: bool,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Steps of a checked state and forces in one call of the op, spheres moving on from where `material` has them.

        Returns:
            Positions and velocities [steps // every, B, V, 3], and rows for `Info.from_rows`.
        """
        refuse_tangents(*state, forces, *material)
        self._notices.before(self, state, material, self.time_step, report=report)
        # the op has a derivative where it records every state, as its adjoint needs them
        thinned = every > 1 and torch.is_grad_enabled() and _requires_grad(*state, forces, *material)
        found = _ops.rollout(
            state[0],
            state[1],
            forces,
            material,
            list(self.plan.arrays),
            steps=steps // every * every if thinned else steps,
            every=1 if thinned else every,
            **self.numbers(inertial=inertial, report=report),
        )
        if thinned:
            # copies, since all states are kept for the adjoint: not by these, and not to change with them
            found = [out[every - 1 :: every].clone(memory_format=torch.contiguous_format) for out in found]
        positions, velocities, rows = found
        if report and not torch.compiler.is_compiling():
            for reached, row in zip(positions, rows, strict=True):
                self._notices.after(self, reached, row)
        return positions, velocities, rows

    # ---- energies

    def energy(self, state: State | Tensor, targets: Targets | None = None) -> Tensor:
        """Mechanical energy of each environment [B] [J], differentiable twice.

        Elastic energy, springs of soft pins, weight (zero at the origin) and, for a `State`, kinetic energy.

        Args:
            state: a `State`, or positions [B, V, 3] alone.
            targets: of pins, as in `forward`.
        """
        positions = self.positions_of(state)
        refuse_tangents(positions)
        arrays = self.material_at(targets, positions.shape[0])
        material = dict(zip(MATERIAL_ROWS, arrays, strict=True))
        energy = cast(Tensor, _ops.element_energy(positions, arrays, list(self.plan.arrays))).sum(-1)
        weight = (positions * material["gravity"].unsqueeze(-2)).sum(-1)
        energy = energy - (material["masses"] * weight).sum(-1)
        if len(self.plan.pin_vertex):
            energy = energy + self._spring_energy(positions, material["pin_stiffness"], material["pin_targets"])
        if not isinstance(state, Tensor):
            energy = energy + 0.5 * (material["masses"] * state[1].square().sum(-1)).sum(-1)
        return energy

    def _spring_energy(self, positions: Tensor, stiffness: Tensor, targets: Tensor) -> Tensor:
        vertices = self.plan.vertex_order[self.plan.pin_vertex.long()].long()
        soft = torch.where(torch.isinf(stiffness), torch.zeros_like(stiffness), stiffness)
        return 0.5 * (soft * (positions[:, vertices] - targets).square().sum(-1)).sum(-1)

    def gradient(self, positions: State | Tensor) -> Tensor:
        """Gradient of the elastic energy [B, V, 3] [N]: minus the elastic forces.

        Args:
            positions: [B, V, 3], or a `State`.
        """
        positions = self.positions_of(positions, "positions")
        result: Tensor = _ops.gradient(positions, self.material(), list(self.plan.arrays))
        return result

    def step_gradient(
        self, state: State, after: State | Tensor, forces: Tensor | None = None, targets: Targets | None = None
    ) -> Tensor:
        """Gradient of the objective of a step at some positions [B, V, 3] [N]: what a solve brings to zero.

        Contacts do not enter: where one holds a vertex, its force remains, see `contact_forces`. Hard pins have none.

        Args:
            state: where the step starts.
            after: the positions [B, V, 3] to judge, or a `State`, for example the next one.
            forces: as in `forward`.
            targets: as in `forward`.
        """
        return step_gradient(self.checked_call(state, after, forces, targets))


def _first_iterate(start: str | Tensor, positions: Tensor) -> tuple[Tensor | None, bool]:
    if isinstance(start, Tensor):
        check_like("start", start, positions, "first iterate, m")
        if start.requires_grad and torch.is_grad_enabled():
            raise ValueError(
                "start, the first iterate, requires a gradient, but a solved step does not depend on it: detach() it"
            )
        return start, False
    if not _is_start(start):
        raise ValueError(f'start must be "velocity", "inertial" or positions [B, V, 3], got {_in_short(start)}')
    return None, start == "inertial"


def _is_start(start: object) -> bool:
    return isinstance(start, str) and start in ("velocity", "inertial")


def _in_short(value: object) -> str:
    return repr(value) if isinstance(value, str) else type(value).__name__


def _requires_grad(*tensors: Tensor | None) -> bool:
    return any(tensor is not None and tensor.requires_grad for tensor in tensors)
