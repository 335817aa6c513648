"""The simulator: a compiled scene as an `nn.Module` that steps states."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor

from .adjoint import step_gradient
from .capture import CapturedStep
from .checks import check_like, check_whole
from .material import MATERIAL_ROWS, environments_of_material, named_arrays
from .ops import INFO_WIDTH, refuse_tangents
from .readable import Readable
from .rollout import PerStep, Rollout, roll
from .solvers import Solver
from .state import Info, State, Track
from .summary import describe
from .targets import Targets

if TYPE_CHECKING:
    from .promise import Promise

__all__ = ["Simulator", "Targets"]

_ops = torch.ops.torchpd


class Simulator(Readable):
    """Steps a scene through time by implicit Euler, solved approximately by projective dynamics.

    The values that training may change are parameters (without gradient until asked), for all environments or, with a
    leading batch, for each: `stiffness` [E] Pa, `masses` [V] kg, `gravity` [3] m/s^2, `damping` [] 1/s,
    `pin_stiffness` [P] N/m, `pin_targets` [P, 3] m, `planes` [C, 5] (unit normal, height, friction), `spheres` [S, 8]
    (centre, radius, friction, motion in a step). The buffer `pin_hard` [P] or [B, P] says which pins hold exactly; it
    may change at run time, to let go and to grasp. `set_material` checks and replaces all of them. Steps do
    not check what an optimiser writes or `torch.func.functional_call` gives, as that would wait for a GPU. Where it is
    NaN, or stiffness, masses or springs are negative, `Info.residual` is NaN, with exceptions named there. Let an
    optimiser learn the logarithm of those. The rest shape is compiled and not learned.

    It is made on the CPU, whatever torch's default device; `.to(...)` moves it.

    Args:
        scene: what there is.
        time_step: h [s], positive.
        iterations: local and global steps of one time step, at most. None: 64, or what "auto" chooses. Where 64 are
            expected to leave a tenth of the error or more an `UnsolvedWarning` says so, once, also when `set_material`,
            `load_state_dict` or another `time_step` has brought that about; `print(sim)` tells for any.
        solver: `Chebyshev()`, `Jacobi()` or `Multilevel()`; `sim.solver` may be replaced later. None is Chebyshev.
            "auto" takes Chebyshev or Multilevel, whichever is expected to reach an error of 1e-3 sooner on the device,
            Chebyshev where there is friction, and as many iterations as that takes unless they are given, four times as
            many where a `tolerance` ends easy steps, but no more than 10,000, and 1000 of Multilevel, times four with a
            tolerance; `print(sim)` says why, an `UnsolvedWarning` where that will not do. It chooses anew when the
            simulator moves to another device, for another `kernel` or `batch`, and in `prepare_solver`, which an
            `UnsolvedWarning` asks for where a change of material or time step makes the old choice leave 1e-2 or more.
        dtype: precision, torch.float32 or torch.float64. A warning tells where float32 resolves rest positions to more
            than 1e-4 of an edge. States that lie farther from the origin are not looked at, which would wait for a GPU.
        tolerance: an environment stops iterating when |x - x*| is about tolerance |x - s| or less, s being where
            inertia, forces and springs alone would take the vertices, so that |x - s| is what elasticity and contacts
            do, or what gravity does if that is more; 0 never. The error is judged by the changes of iterations and by
            how slow the slowest mode can be, from the weights of the step: see docs/limits.md.
        kernel: how a GPU is to step the scene after `.to("cuda")`: "block", "cluster", "grid" or "stream", see
            `torchpd.regimes`; "auto" takes the first that fits, and with `batch` the one expected to be the quickest.
            "benchmark" times a few steps of each that fits, once a process, GPU and size. `sim.kernel` may be set
            later. Changes nothing on the CPU.
        batch: environments that a step will have, where you know it: a GPU's kernel, its patches and thread blocks, the
            patches and preconditioner of `Multilevel` and the choice of "auto" are for so many. States of any batch may
            come, and an environment has the same bits in all of them, but takes longer in some; thread blocks of the
            smallest meshes in float32 are for the batch that comes. None: not known: a small mesh gets "block", which
            is for many, and "auto" chooses for one. `sim.batch` may be set later. Changes nothing on the CPU.
        adjoint: what preconditions the linear system of a gradient. "solver": what the solver has, a diagonal or the
            matrix of `Multilevel`. "multilevel": that matrix beside any solver, made when it is set; docs/accuracy.md
            says when it pays. A GPU needs kernel="stream" for it. `sim.adjoint` may be set later.
        progress: show a bar while a large scene compiles, for another device too.
    """

    promise: Promise | None

    def extra_repr(self) -> str:
        return describe(self)

    def __repr__(self) -> str:
        return f"{type(self).__name__}(\n  {self.extra_repr()}\n)"

    # ---- states

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
        after, rows = self.advance(state, forces, material, start, report=return_info)
        return (after, Info.from_rows(rows)) if return_info else after

    def advance(
        self, state: State, forces: Tensor | None, material: list[Tensor], start: str | Tensor, *, report: bool
    ) -> tuple[State, Tensor]:
        """One step of a checked state and forces with a given material, see `material_at`: the next state, and rows for
        `Info.from_rows`."""
        given, inertial = _first_iterate(start, state[0])
        refuse_tangents(*state, forces, *material)
        self._notices.before(self, state, material, self.time_step, report=report)
        positions, velocities, rows = _ops.step(
            state[0],
            state[1],
            forces,
            given,
            material,
            list(self.plan.arrays),
            **self.numbers(inertial=inertial, report=report),
        )
        if report:
            self._notices.after(self, positions, rows)
        return State(positions, velocities), rows

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
        call = Rollout(state, steps, every, forces, targets, start, return_info, first)
        return roll(self, call, progress=progress)

    def capture(
        self,
        state: State,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        start: str | Tensor = "velocity",
        *,
        return_info: bool = False,
    ) -> CapturedStep:
        """Record `step_` as a CUDA graph, which starts with less work for the host: see `CapturedStep`.

        Args:
            state: what every replay moves on; recording leaves it as it is.
            forces: as in `forward`; change them in place between replays.
            targets: as in `forward`; change them in place between replays.
            start: as in `forward`; positions may be changed in place between replays.
            return_info: fill in `CapturedStep.info`.
        """
        return CapturedStep(self, state, forces, targets, start, report=return_info)

    def tune(
        self,
        state: State | None = None,
        *,
        error: float | None = None,
        milliseconds: float | None = None,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        candidates: Sequence[Solver] | None = None,
        most: int = 2048,
        progress: bool = False,
    ) -> Promise:
        """Choose solver and iterations for an error or a time, from a short study on this scene; sets them.

        No step stops early then: `tolerance` becomes 0. Errors leave out 10 eps |x| of rounding, see `Promise`.

        The promise also stays in `self.promise`: `promise.holds(info)` says during a run whether to rely on it. It is
        for the material that is there now. A target out of reach gets the best there is, a promise with
        `attained=False`, and a `TuningWarning`. Files do not keep it: times are of the machine that measured them.

        Takes about a second for a thousand vertices, 2 to 8 s for 3 thousand and 20 s for 10 thousand on one core of a
        CPU: nine steps of each studied environment are solved to convergence in float64, on the CPU. With friction up
        to three times as long; where steps come to no end there, as of stiff bodies that stick and slip, the target
        counts as out of reach.

        Args:
            state: where typical motions start [B, V, 3], the rest state by default, once for each environment of the
                material; up to four environments are studied over 30 steps. Times are for its batch.
            error: of a step, |x - x*| / |x_0 - x*|, x* converged and x_0 = x + h v; in (0, 1).
            milliseconds: of `sim(state)` on this machine; the error is then as low as that allows, with no more
                iterations than it takes to get below rounding.
            forces: on the vertices during these steps [B, V, 3] [N].
            targets: where pins and spheres are during them, as in `forward`; by default where the scene has them.
            candidates: solvers to choose from, not "auto"; by default those that cannot diverge, and no `Multilevel`
                where there is friction, which may lead it astray in steps that the study has not seen.
            most: iterations of a step, at most.
            progress: show a bar.

        Raises:
            ValueError: states, forces or material that are not finite, a singular system, a scene without motion.
            RuntimeError: no converged step to compare with; solver and iterations stay.
        """
        from .tuning import tune

        return tune(
            self,
            state,
            error=error,
            milliseconds=milliseconds,
            forces=forces,
            targets=targets,
            candidates=candidates,
            most=most,
            progress=progress,
        )

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
        material = dict(zip(MATERIAL_ROWS, self.material_at(targets, positions.shape[0]), strict=True))
        energy = cast(Tensor, _ops.element_energy(positions, material["stiffness"], list(self.plan.arrays))).sum(-1)
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
        result: Tensor = _ops.gradient(positions, self.stiffness.contiguous(), list(self.plan.arrays))
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

    # ---- files

    def save(self, path: str | Path) -> None:
        """Write scene, settings and material to one file: safetensors with JSON metadata, no pickle."""
        from .io import save_simulation

        save_simulation(self, path)

    @staticmethod
    def load(path: str | Path) -> Simulator:
        """Read what `save` wrote, on the CPU."""
        from .io import load_simulation

        return load_simulation(path)


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
