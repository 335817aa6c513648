"""Steps of a compiled scene: an `nn.Module` that advances states."""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor

from ..common.checks import check_like, check_whole
from ..common.synonyms import check_arguments
from ..ops.adjoint import step_gradient
from ..ops.diagonal import elastic_material, named_material
from ..ops.energy import elastic_energy
from ..ops.registration import INFO_WIDTH, refuse_forward_mode
from ..plan.material import check_environments, environments_of_material, named_arrays
from ..scene.targets import NO_INPUTS, ColliderInputs, Targets
from .readable import Readable
from .rollout import PerStep, Rollout, run_rollout
from .state import HistoryState, HistoryTrack, Info, State, StepCall, Track, history_of
from .state_checks import check_info, check_overwritten

__all__ = ["Stepper"]

_ops = torch.ops.torchpd
_OF_CONTACT = 6  # columns of `Contact` in the rows of a report


class Stepper(Readable):
    """Steps, rollouts, energies and gradients of a `Simulator`."""

    __call__: StepCall

    # ---- states

    @check_arguments("Simulator.rest_state")
    def rest_state(self, batch: int | None = None) -> State:
        """The rest positions with zero velocities [batch, V, 3], and the history of a scene that keeps one.

        A `State`, or a `HistoryState` in scenes with plastic solids or `Contact`.

        Args:
            batch: environments; by default one for each environment of the material and of friction between bodies.
        """
        if batch is None:
            tables = [len(value) for value in self._contact_tensors().values() if value.dim() == 3]
            count = max([environments_of_material(named_arrays(self)), *tables])
        else:
            count = check_whole("batch", batch, minimum=0)
        history = self.history_at_rest()
        if history is not None:
            check_environments("Simulator.rest_state: batch", count, {"flow": history.flow})
        shape = (count, -1, -1)
        positions = self.rest_positions.expand(shape).clone()
        state = State(positions, torch.zeros_like(positions))
        if history is None:
            return state
        flow = history.flow.expand(count, *history.flow.shape[-2:])
        others = [array.expand(count, *array.shape) for array in history[:-1]]
        kept = history_of(array.clone() for array in (*others, flow))
        # for type checkers scenes without history are the rule
        return cast(State, HistoryState(*state, kept))

    def _after(self, positions: Tensor, velocities: Tensor, material: list[Tensor]) -> Any:
        """The state after a step with this material."""
        if not self.keeps_history:
            return State(positions, velocities)
        kept = _ops.next_history(positions, material, list(self.plan.arrays), time_step=self.time_step)
        return HistoryState(positions, velocities, history_of(kept))

    def _stepped(
        self,
        state: State | HistoryState,
        forces: Tensor | None,
        given: Tensor | None,
        material: list[Tensor],
        inputs: ColliderInputs,
        *,
        inertial: bool,
        report: bool,
    ) -> tuple[Any, Tensor]:
        """The state after a step from a checked one, and the rows of its report."""
        settings, plan = self.step_settings(inertial=inertial, report=report), list(self.plan.arrays)
        if self.body_contact is None:
            positions, velocities, rows = _ops.step(state[0], state[1], forces, given, material, plan, **settings)
            after = self._after(positions, velocities, material)
        else:
            contact = self.body_contact
            if contact.plan.grows:
                contact.check_eager("Simulator")
                contact = contact.with_capacity(max(contact.plan.capacity, state[2][1].shape[-1]))  # type: ignore[misc]
            taken = (
                state,
                forces,
                given,
                self.contact_friction,
                self.contact_thickness,
                inputs,
                material,
                plan,
                settings,
            )
            after, rows = contact.step(*taken)
            while contact.plan.grows and (missing := _missing_pairs(rows)):
                contact = contact.with_capacity(contact.plan.capacity + max(contact.plan.capacity, missing))
                self._notices.after_growth(self, contact.plan.capacity)
                after, rows = contact.step(*taken)
            self.body_contact = contact
            self._notices.after_contact(self, after[0], rows)
        if report and not torch.compiler.is_compiling():
            self._notices.after(self, after[0], rows)
        return after, rows

    def forward(
        self,
        state: State | HistoryState,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        start: str | Tensor = "velocity",
        return_info: bool = False,
    ) -> Any:
        """Advance a state by one time step.

        `torch.autocast` changes no result; within it, forces may have half precision.

        Gradients come from the implicit adjoint at the end of the step, with friction, and hold for all arguments but
        `start`. Their error follows that of the step: docs/limits.md#friction-and-gradients. Forward mode and
        `torch.func.grad` are not provided. With `Contact` poses have gradients too, forces of contact do not:
        docs/contact.md#gradients.

        Args:
            state: positions and velocities [B, V, 3] [m, m/s]; with plastic solids or `Contact` a `HistoryState`.
            forces: on the vertices [B, V, 3] [N], or [V, 3] or [1, V, 3] for all environments; constant in the step.
            targets: of pins and spheres at the end of the step [m], by part; or one tensor [P, 3] or [B, P, 3] for all
                pins. A sphere takes its centre [3] or [B, 3], or with its velocity [6] or [B, 6], which friction needs.
                `Fibres` take their activation during the step, a number [], [B], [n] or [B, n] for n fibres.
                A `Pressure` takes its overpressure [] or [B] Pa, `Wind` its velocity [3] or [B, 3] m/s. A `Collider`
                takes its pose [7] or [B, 7], see there; one without a target stays. With a mass it takes a wrench [6]
                or [B, 6].
            start: first iterate: "velocity" (x + h v), "inertial" (with gravity and forces), or positions [B, V, 3].
                The first two are moved along rigid motions and out of contacts. A body that planes would squeeze there
                starts from x.
            return_info: also return a report of the solve; costs about ten iterations, no synchronisation.

        Returns:
            The next state, or (state, info).
        """
        forces = self.check_state(state, forces=forces)
        material = self.with_history(self.material_at(targets, state[0].shape[0]), state)
        if self.loads is not None:
            forces = self.forces_at(state, forces, targets, material)
        given, inertial = _first_iterate(start, state[0])
        refuse_forward_mode(state[0], state[1], forces, *material)
        self._notices.before(self, state, material, self.time_step, report=return_info)
        inputs = self.collider_inputs(state, targets)
        after, rows = self._stepped(state, forces, given, material, inputs, inertial=inertial, report=return_info)
        return (after, Info.from_rows(rows)) if return_info else after

    @torch.no_grad()
    def step_(
        self,
        state: State | HistoryState,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        start: str | Tensor = "velocity",
        *,
        info: Tensor | None = None,
    ) -> None:
        """Advance a state in place by one time step, without gradients. Arguments as in `forward`.

        If an exception such as Ctrl-C ends it, each environment is either at the start or at the end of the step.

        Args:
            info: rows [B, 7] float64 to fill in, with `Contact` [B, 13], see `Info.from_rows`; None leaves out
                residual, energy and inverted.
        """
        forces = self.check_state(state, forces=forces)
        if _requires_grad(state[0], state[1], *(state[2] if len(state) > 2 else ())):
            raise ValueError(
                "step_: state must not require gradients, because it is overwritten; detach it or call the simulator"
            )
        if not (info is None or isinstance(info, Tensor)):
            raise TypeError(
                f"step_: info must be None or a float64 tensor {[len(state[0]), self.info_width]} to fill in, got "
                f"{type(info).__name__}"
            )
        if self._grows:
            raise RuntimeError(
                'step_: Contact(capacity="grow") makes the history of a state wider, got a state to overwrite; call '
                "the simulator, or give a number of pairs"
            )
        given, inertial = _first_iterate(start, state[0])
        material = self.with_history(self.material_at(targets, state[0].shape[0]), state)
        if self.loads is not None:
            forces = self.forces_at(state, forces, targets, material)
        self._notices.before(self, state, material, self.time_step, report=info is not None)
        if self.body_contact is not None:
            inputs = self.collider_inputs(state, targets)
            self._step_in_contact(state, forces, given, material, inputs, inertial, info)
            return
        rows = state[0].new_empty((state[0].shape[0], INFO_WIDTH), dtype=torch.float64) if info is None else info
        _ops.step_(
            state[0],
            state[1],
            rows,
            forces,
            given,
            material,
            list(self.plan.arrays),
            **self.step_settings(inertial=inertial, report=info is not None),
        )
        if isinstance(state, HistoryState) or len(state) > 2:
            for kept, new in zip(state[2], self._after(state[0], state[1], material).history, strict=True):
                kept.copy_(new)
        if info is not None:
            self._notices.after(self, state[0], info)

    @property
    def info_width(self) -> int:
        """Columns of the rows of a report."""
        return INFO_WIDTH if self.body_contact is None else INFO_WIDTH + _OF_CONTACT

    def _step_in_contact(
        self,
        state: State | HistoryState,
        forces: Tensor | None,
        given: Tensor | None,
        material: list[Tensor],
        inputs: ColliderInputs,
        inertial: bool,
        info: Tensor | None,
    ) -> None:
        """`step_` in a scene with `Contact`."""
        assert self.body_contact is not None
        check_overwritten(state[2][1], self.body_contact.plan.capacity)  # type: ignore[misc]
        if info is not None:
            check_info(info, (len(state[0]), self.info_width))
        after, rows = self._stepped(state, forces, given, material, inputs, inertial=inertial, report=info is not None)
        old = (state[0], state[1], *state[2])  # type: ignore[misc]
        for kept, new in zip(old, (after[0], after[1], *after[2]), strict=True):
            kept.copy_(new)
        if info is not None:
            info.copy_(rows)

    @check_arguments("Simulator.rollout")
    def rollout(
        self,
        state: State | HistoryState,
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
        """Advance a state by many time steps and record some of them.

        A scene with pressure or wind takes step by step, with the forces at the start of each. So does a scene with
        plastic solids or `Contact`, whose track is a `HistoryTrack`.

        A constant target of a sphere with a velocity moves on with it. If a function gives centres without velocities,
        these are the displacements since the step before. The sphere then starts from its place in the scene, at step 0
        and after steps whose targets leave it out.

        Ctrl-C ends a rollout within a second on a CPU, and on a GPU with `progress`.

        Args:
            state: the start, which is not recorded.
            steps: number of steps.
            every: steps between records; the track has steps // every records.
            forces: as in `forward`, constant, or a function of the step number.
            targets: as in `forward`, constant, or a function of the step number.
            first: number of the first step when this rollout continues another: `rollout(state, 9)` equals
                `rollout(rollout(state, 5).state(), 4, first=5)`. A function of targets is then also called for step
                first - 1.
            start: first iterate of every step, "velocity" or "inertial".
            return_info: fill in residual, energy and inverted of the recorded steps, see `Info`.
            progress: show a bar; a GPU then synchronises every 0.1 s or so.

        Returns:
            Track of the recorded states.
        """
        steps, every = check_whole("steps", steps, minimum=0), check_whole("every", every, minimum=1)
        first = check_whole("first", first, minimum=0)
        if not _is_start(start):
            raise ValueError(f'rollout: start must be "velocity" or "inertial", got {_in_short(start)}')
        call = Rollout(state, steps, every, forces, targets, start == "inertial", return_info, first)
        return cast(Track, run_rollout(self, call, progress=progress))

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
    ) -> tuple[Tensor, ...]:
        """Take steps from a checked state and forces in one call of the op; spheres start where `material` has them.

        `inputs` move colliders.

        Returns:
            Positions and velocities [steps // every, B, V, 3], rows for `Info.from_rows`, and those of the history.
        """
        material = self.with_history(material, state)
        refuse_forward_mode(state[0], state[1], forces, *material)
        self._notices.before(self, state, material, self.time_step, report=report)
        if self.keeps_history:
            after, rows = self._stepped(state, forces, None, material, inputs, inertial=inertial, report=report)
            taken = tuple(array[None] for array in (after[0], after[1], rows, *after[2]))
            return taken if steps else tuple(array[:0] for array in taken)
        # the adjoint needs every state, so the op has a derivative only with every=1
        thinned = every > 1 and torch.is_grad_enabled() and _requires_grad(state[0], state[1], forces, *material)
        found = _ops.rollout(
            state[0],
            state[1],
            forces,
            material,
            list(self.plan.arrays),
            steps=steps // every * every if thinned else steps,
            every=1 if thinned else every,
            **self.step_settings(inertial=inertial, report=report),
        )
        if thinned:
            # copies: a view would keep all states alive, and the adjoint's states must not change with these
            found = [out[every - 1 :: every].clone(memory_format=torch.contiguous_format) for out in found]
        positions, velocities, rows = found
        if report and not torch.compiler.is_compiling():
            for reached, row in zip(positions, rows, strict=True):
                self._notices.after(self, reached, row)
        return positions, velocities, rows

    def track(self, *found: Tensor) -> Track | HistoryTrack:
        """The track of what `advance` returned."""
        positions, velocities, rows, *history = found
        info = Info.from_rows(rows)
        if not history:
            return Track(positions, velocities, info)
        return HistoryTrack(positions, velocities, info, history_of(history))

    # ---- energies

    def energy(self, state: State | HistoryState | Tensor, targets: Targets | None = None) -> Tensor:
        """Mechanical energy of each environment [B] [J], differentiable twice.

        Elastic energy, springs of soft pins, weight (zero at the origin) and, for a `State`, kinetic energy. It leaves
        out pressure and wind, which are forces of a step.

        Args:
            state: a `State`, or positions [B, V, 3] alone; these have the flow of a new state in plastic solids.
            targets: of pins and fibres, as in `forward`.
        """
        positions = self.positions_of(state)
        refuse_forward_mode(positions)
        arrays = self.with_history(self.material_at(targets, positions.shape[0]), state)
        material, elastic, plan = named_material(arrays), elastic_material(arrays), list(self.plan.arrays)
        energy = elastic_energy(positions, elastic, plan)
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

    def gradient(self, positions: State | HistoryState | Tensor) -> Tensor:
        """Gradient of the elastic energy [B, V, 3] [N], the negative of the elastic forces.

        Args:
            positions: [B, V, 3], or a `State`.
        """
        at = self.positions_of(positions, "positions")
        material = elastic_material(self.with_history(self.material(), positions))
        result: Tensor = _ops.gradient(at, material, list(self.plan.arrays))
        return result

    def step_gradient(
        self,
        state: State | HistoryState,
        after: State | HistoryState | Tensor,
        forces: Tensor | None = None,
        targets: Targets | None = None,
    ) -> Tensor:
        """Gradient [B, V, 3] [N] of a step's objective at given positions; a solve drives it to zero.

        Contacts are not part of the objective: their forces remain in the gradient, see `contact_forces`. It is zero at
        hard pins.

        Args:
            state: start of the step.
            after: positions [B, V, 3] at which to evaluate it, or a `State`, for example the next one.
            forces: as in `forward`.
            targets: as in `forward`.
        """
        return step_gradient(self.checked_call(state, after, forces, targets))


def _missing_pairs(rows: Tensor) -> int:
    """Most pairs that the capacity lacks, over all environments. The host waits."""
    missing = Info.from_rows(rows).contact_overflow
    return int(missing.max()) if missing.numel() else 0


def _first_iterate(start: str | Tensor, positions: Tensor) -> tuple[Tensor | None, bool]:
    if isinstance(start, Tensor):
        check_like("start", start, positions, "first iterate, m")
        if start.requires_grad and torch.is_grad_enabled():
            raise ValueError(
                "start must not require a gradient, because a solved step does not depend on it: detach() it"
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
