"""The simulator: a compiled scene as an `nn.Module` that steps states."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import torch
from torch import Tensor, nn

from .adjoint import AdjointCall, step_gradient
from .automatic import Choice, choose_solver
from .capture import CapturedStep
from .forecast import warn_of_few_iterations
from .material import MATERIAL_ROWS, check_material, material_of
from .multilevel import has_levels, precondition_plan, reference_of, without_levels
from .ops import INFO_WIDTH, refuse_tangents
from .placing import check_wanted_device, plan_on
from .plan import Plan, compile_plan
from .regimes import check_kernel
from .rollout import PerStep, Rollout, roll
from .scene import Scene
from .solvers import DEFAULT_ITERATIONS, Chebyshev, Multilevel, Solver, check_solver
from .state import Info, State, Track
from .summary import describe
from .targets import Anchors, Targets

if TYPE_CHECKING:
    from .tuning import Promise

__all__ = ["Simulator", "Targets"]

_ops = torch.ops.torchpd


class Simulator(nn.Module):
    """Steps a scene through time by implicit Euler, solved approximately by projective dynamics.

    The values that training may change are parameters (without gradient until asked), for all environments or, with a
    leading batch, for each: `stiffness` [E] Pa, `masses` [V] kg, `gravity` [3] m/s^2, `damping` [] 1/s,
    `pin_stiffness` [P] N/m, `pin_targets` [P, 3] m, `planes` [C, 5], `spheres` [S, 8]. `set_material` replaces
    them.

    Args:
        scene: what there is.
        time_step: h [s], positive.
        iterations: local and global steps of one time step, at most. None: 64, or what "auto" chooses. Where 64 are
            expected to leave a tenth of the error or more an `UnsolvedWarning` says so; `print(sim)` tells for any.
        solver: `Chebyshev()`, `Jacobi()` or `Multilevel()`; `sim.solver` may be replaced later. None is Chebyshev.
            "auto" takes Chebyshev or Multilevel, whichever is expected to reach an error of 1e-3 sooner on the device,
            and as many iterations as that takes unless they are given; `print(sim)` says why. It chooses anew when the
            simulator moves to another device and in `prepare_solver`.
        dtype: precision, torch.float32 or torch.float64.
        tolerance: an environment stops iterating when |x_{k+1} - x_k| <= tolerance |x_{k+1} - x_t|; 0 never.
        kernel: how a GPU is to step the scene after `.to("cuda")`: "block", "grid" or "stream", see `torchpd.regimes`;
            "auto" takes the first that fits. Changes nothing on the CPU.
        progress: show a bar while a large scene compiles.
    """

    rest_positions: Tensor
    stiffness: Tensor
    masses: Tensor
    gravity: Tensor
    damping: Tensor
    pin_stiffness: Tensor
    pin_targets: Tensor
    planes: Tensor
    spheres: Tensor

    def __init__(
        self,
        scene: Scene,
        time_step: float = 1 / 60,
        iterations: int | None = None,
        solver: Solver | Literal["auto"] | None = None,
        dtype: torch.dtype = torch.float32,
        *,
        tolerance: float = 0.0,
        kernel: str = "auto",
        progress: bool = True,
    ) -> None:
        super().__init__()
        if not isinstance(scene, Scene):
            raise TypeError(f"Simulator: scene must be a Scene, got {type(scene).__name__}")
        self.scene = scene
        self.time_step = _positive("time_step", time_step, "s")
        self.iterations = DEFAULT_ITERATIONS if iterations is None else _whole("iterations", iterations, 0)
        solver = Chebyshev() if solver is None else solver
        if solver != "auto":
            check_solver(solver, torch.device("cpu"))
        self.tolerance = float(tolerance)
        if not 0.0 <= self.tolerance < 1.0:
            raise ValueError(f"Simulator: tolerance must lie in [0, 1), got {tolerance}")
        self.promise: Promise | None = None  # of `tune`
        self.kernel = check_kernel(kernel)
        values = scene.values()
        self.plan: Plan = compile_plan(values, dtype=dtype, progress=progress)
        self.anchors = Anchors(scene, self.time_step)
        self.register_buffer("rest_positions", torch.tensor(values.rest_positions, dtype=dtype), persistent=False)
        for name, value in material_of(values, dtype).items():
            self.register_parameter(name, nn.Parameter(value, requires_grad=False))
        self.choice: Choice | None = None  # of "auto"
        if solver == "auto":
            self._choose_solver(None if iterations is None else self.iterations)
        else:
            self.solver = solver
            if iterations is None:
                warn_of_few_iterations(self)

    # ---- what a simulation is made of

    @property
    def vertices(self) -> int:
        """Vertices of all bodies."""
        return self.plan.vertices

    @property
    def dtype(self) -> torch.dtype:
        """Precision of states."""
        return self.plan.dtype

    @property
    def device(self) -> torch.device:
        """Where states have to be."""
        return self.plan.device

    @property
    def solver(self) -> Solver:
        """How a step is solved. A multilevel one is prepared when it is set; "auto" sets iterations too."""
        return self._solver

    @solver.setter
    def solver(self, solver: Solver | Literal["auto"]) -> None:
        if solver == "auto":
            return self._choose_solver(None)
        self._solver, self.choice = check_solver(solver, self.device), None
        if isinstance(solver, Multilevel) != has_levels(self.plan.arrays):
            self._prepare()
        return None

    def _choose_solver(self, iterations: int | None) -> None:
        """What "auto" does, see `choose_solver`."""
        self.solver, choice = choose_solver(self, iterations)
        self.iterations, self.choice = choice.iterations, choice

    def _choose_again(self, choice: Choice) -> None:
        """Iterations that somebody has set since stay."""
        own = choice.sets_iterations and self.iterations == choice.iterations
        self._choose_solver(None if own else self.iterations)

    def prepare_solver(self) -> None:
        """Make anew what the solver prepares of the material: the preconditioner of `Multilevel`, the choice of "auto".

        Worth it after the material has changed unevenly, which `Info.rho` and `Info.residual` tell, or time_step has.
        `set_material` does it by itself when it pins other vertices hard, or frees some. Takes 0.3 s for 8 thousand
        vertices, seconds for a million tetrahedra. Other solvers prepare nothing.
        """
        if self.choice is not None:
            self._choose_again(self.choice)
        self._prepare()

    def _prepare(self) -> None:
        self.plan = without_levels(self.plan)
        if isinstance(self.solver, Multilevel):
            reference = reference_of(self.plan, self.material(), self.time_step)
            self.plan = precondition_plan(self.plan, self.scene.values(), *reference)

    def material(self) -> list[Tensor]:
        """The differentiable arrays in the order of the ops."""
        return [getattr(self, name) for name in MATERIAL_ROWS]

    def set_material(self, **arrays: Tensor | float) -> None:
        """Replace differentiable arrays, for all environments or with a leading batch for each; all of them, or none.

        An array of the same shape is overwritten, so that optimisers keep it; another batch makes a new parameter.

        Args:
            arrays: by name, see the class. Shapes and values are checked here, once.
        """
        checked = {name: self._checked_material(name, value) for name, value in arrays.items()}
        held = self._held_everywhere()
        with torch.no_grad():
            for name, tensor in checked.items():
                own = getattr(self, name)
                if own.shape == tensor.shape:
                    own.copy_(tensor)
                else:
                    setattr(self, name, nn.Parameter(tensor.clone(), requires_grad=own.requires_grad))
        # what is held belongs to the structure of a preconditioner
        if has_levels(self.plan.arrays) and not torch.equal(held, self._held_everywhere()):
            self._prepare()

    def _held_everywhere(self) -> Tensor:
        """Whether each pin holds exactly in all environments [P]."""
        hard = self.pin_stiffness.isinf()
        return hard.all(0) if hard.dim() == 2 else hard

    def _checked_material(self, name: str, value: Tensor | float) -> Tensor:
        if name not in MATERIAL_ROWS:
            raise TypeError(f"set_material: no array {name!r}; there are {', '.join(MATERIAL_ROWS)}")
        own = getattr(self, name)
        tensor = torch.as_tensor(value).detach()
        if tensor.is_complex() or tensor.dtype == torch.bool:
            raise TypeError(f"set_material: {name} must hold real numbers, got {tensor.dtype}")
        tensor = tensor.to(dtype=self.dtype, device=self.device)
        shape = tuple(own.shape[own.dim() - MATERIAL_ROWS[name].dims :])
        tensor = tensor.expand(shape) if tensor.dim() == 0 else tensor
        if tuple(tensor.shape) != shape and tuple(tensor.shape[1:]) != shape:
            raise ValueError(
                f"set_material: {name} must be {list(shape)}, or with a batch in front, got {list(tensor.shape)}"
            )
        check_material(name, tensor)
        return tensor.contiguous()

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        """Checks values, and takes arrays of every environment where this simulator had shared ones."""
        for name in MATERIAL_ROWS:
            if prefix + name in state_dict:
                self.set_material(**{name: state_dict[prefix + name]})
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def check_state(self, state: State) -> None:
        """Refuse a state of another precision or on another device."""
        if state[0].dtype != self.dtype or state[0].device != self.device:
            raise TypeError(
                f"state must be {self.dtype} on {self.device} like the simulator, got {state[0].dtype} on "
                f"{state[0].device}; sim.to(...) changes the simulator"
            )

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Simulator:
        wanted = check_wanted_device(fn, torch.empty(0, dtype=self.dtype, device=self.device))
        choice = self.choice
        if choice is not None and wanted.device.type not in (self.device.type, "meta"):
            # whatever it was, the other device may choose differently
            iterations, self.solver = self.iterations, Chebyshev()
            try:
                return self._apply(fn, recurse)
            finally:
                self.iterations = iterations
                self._choose_again(choice)
        if wanted.dtype not in (torch.float32, torch.float64):
            raise TypeError(f"Simulator runs in torch.float32 or torch.float64, not in {wanted.dtype}")
        if wanted.device.type == "cuda":
            check_solver(self.solver, wanted.device)
        changes_precision = wanted.dtype != self.dtype
        # first, because it may refuse
        plan = plan_on(self, wanted.dtype, wanted.device)
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        self.plan = plan
        if changes_precision:
            # digits that float32 has lost do not come back by widening. The material may have been trained, and keeps
            # the digits it has.
            positions = self.scene.values().rest_positions
            self.rest_positions = torch.tensor(positions, dtype=wanted.dtype, device=wanted.device)
        return self

    def extra_repr(self) -> str:
        return describe(self)

    def __repr__(self) -> str:
        return f"{type(self).__name__}(\n  {self.extra_repr()}\n)"

    # ---- states

    def rest_state(self, batch: int = 1) -> State:
        """Everything at rest, [batch, V, 3]."""
        shape = (_whole("batch", batch, 0), -1, -1)
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

        Args:
            state: positions and velocities [B, V, 3] [m, m/s].
            forces: on the vertices [B, V, 3] [N], constant during the step.
            targets: where pins and spheres are at the end of the step [m]: by part, or one tensor [P, 3] or [B, P, 3]
                for all pins together. A sphere takes its centre [3] or [B, 3], and with its velocity [6] or [B, 6],
                which friction then drags vertices along with.
            start: first iterate: "velocity" (x + h v), "inertial" (with gravity and forces), or positions [B, V, 3].
            return_info: also how the solve went; costs two more local steps, no synchronisation.

        Returns:
            The next state, or (state, info). Gradients: `torch.autograd` (implicit adjoint at the end of the step; its
            error follows the residual). Forward mode and `torch.func.grad` are not provided.
        """
        material = self.material_at(targets, state[0].shape[0])
        after, rows = self.advance(state, forces, material, start, report=return_info)
        return (after, Info.from_rows(rows)) if return_info else after

    def advance(
        self, state: State, forces: Tensor | None, material: list[Tensor], start: str | Tensor, *, report: bool
    ) -> tuple[State, Tensor]:
        """One step with a given material, see `material_at`: the next state, and rows for `Info.from_rows`."""
        self.check_state(state)
        given, inertial = _first_iterate(start)
        refuse_tangents(*state, forces, *material)
        positions, velocities, rows = _ops.step(
            state[0],
            state[1],
            forces,
            given,
            material,
            list(self.plan.arrays),
            **self.numbers(inertial=inertial, report=report),
        )
        # a report, not a function to differentiate: torch would pass zeros back through it
        return State(positions, velocities), rows.detach()

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

        Args:
            info: rows [B, 6] float64 to fill in, see `Info.from_rows`; None leaves out residual and energy.
        """
        if state[0].requires_grad or state[1].requires_grad:
            raise ValueError(
                "step_ overwrites the state, so it must not require gradients; detach it or call the simulator"
            )
        self.check_state(state)
        given, inertial = _first_iterate(start)
        rows = state[0].new_empty((state[0].shape[0], INFO_WIDTH), dtype=torch.float64) if info is None else info
        _ops.step_(
            state[0],
            state[1],
            rows,
            forces,
            given,
            self.material_at(targets, state[0].shape[0]),
            list(self.plan.arrays),
            **self.numbers(inertial=inertial, report=info is not None),
        )

    def rollout(
        self,
        state: State,
        steps: int,
        every: int = 1,
        *,
        forces: Tensor | PerStep | None = None,
        targets: Targets | PerStep | None = None,
        start: str = "velocity",
        return_info: bool = False,
        progress: bool = False,
    ) -> Track:
        """Many time steps.

        Args:
            state: where to start.
            steps: how many.
            every: steps from one record to the next; the track has steps // every records.
            forces: constant, or a function of the step number.
            targets: constant (a sphere with a velocity goes on with it), or a function of the step number (a sphere's
                velocity then follows from its centres).
            start: first iterate of every step, "velocity" or "inertial".
            return_info: fill in residual and energy of the recorded steps; NaN otherwise.
            progress: show a bar.

        Returns:
            Track of the recorded states.
        """
        steps, every = _whole("steps", steps, 0), _whole("every", every, 1)
        if start not in ("velocity", "inertial"):
            raise ValueError(f'rollout: start must be "velocity" or "inertial", got {start!r}')
        return roll(self, Rollout(state, steps, every, forces, targets, start, return_info), progress=progress)

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
        candidates: Sequence[Solver] | None = None,
        most: int = 2048,
        progress: bool = False,
    ) -> Promise:
        """Choose solver and iterations for an error or a time, from a short study on this scene; sets them.

        The promise also stays in `self.promise`: `promise.holds(info)` says during a run whether to rely on it. A
        target out of reach gets the best there is, a promise with `attained=False`, and a `TuningWarning`. Files do not
        keep it: times are of the machine that measured them.

        Args:
            state: where typical motions start [B, V, 3], the rest state by default; up to four environments are
                studied over 30 steps, without forces and with the targets of the scene. Times are for its batch.
            error: of a step, |x - x*| / |x_0 - x*|, x* converged and x_0 the first iterate; in (0, 1).
            milliseconds: of a step on this machine; the error is then as low as that allows.
            candidates: solvers to choose from; by default those that cannot diverge.
            most: iterations of a step, at most.
            progress: show a bar.

        Raises:
            ValueError: states that are not finite, a singular system, a scene without motion.
        """
        from .tuning import tune

        return tune(
            self,
            state,
            error=error,
            milliseconds=milliseconds,
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
        positions = state if isinstance(state, Tensor) else state[0]
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

    def gradient(self, positions: Tensor) -> Tensor:
        """Gradient of the elastic energy [B, V, 3] [N]: minus the elastic forces."""
        result: Tensor = _ops.gradient(positions, self.stiffness, list(self.plan.arrays))
        return result

    def step_gradient(
        self, state: State, after: State | Tensor, forces: Tensor | None = None, targets: Targets | None = None
    ) -> Tensor:
        """Gradient of the objective of a step at some positions [B, V, 3] [N]: what a solve brings to zero.

        Contacts do not enter: where one holds a vertex, its reaction remains. Hard pins have none.

        Args:
            state: where the step starts.
            after: the positions to judge, for example the next state.
            forces: as in `forward`.
            targets: as in `forward`.
        """
        self.check_state(state)
        positions = after if isinstance(after, Tensor) else after[0]
        material = self.material_at(targets, state[0].shape[0])
        call = AdjointCall(state[0], state[1], forces, positions, material, list(self.plan.arrays), self.time_step)
        return step_gradient(call)

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

    # ---- arguments of the ops

    def numbers(self, *, inertial: bool, report: bool) -> dict[str, Any]:
        """The settings as keyword arguments of the ops."""
        return {
            **self.solver.numbers(),
            "iterations": self.iterations,
            "time_step": self.time_step,
            "tolerance": self.tolerance,
            "inertial": inertial,
            "report": report,
        }

    def material_at(self, targets: Targets | None, batch: int) -> list[Tensor]:
        """The material with pins and spheres where `targets` puts them."""
        if targets is None:
            return self.material()
        pins, spheres = self.anchors.place(targets, self.pin_targets, self.spheres, batch)
        replaced = {"pin_targets": pins, "spheres": spheres}
        return [replaced.get(name, getattr(self, name)).contiguous() for name in MATERIAL_ROWS]


def _first_iterate(start: str | Tensor) -> tuple[Tensor | None, bool]:
    if isinstance(start, Tensor):
        return start, False
    if start not in ("velocity", "inertial"):
        raise ValueError(f'start must be "velocity", "inertial" or positions [B, V, 3], got {start!r}')
    return None, start == "inertial"


def _positive(name: str, value: float, unit: str) -> float:
    number = float(value)
    if not 0.0 < number < float("inf"):
        raise ValueError(f"{name} must be positive and finite [{unit}], got {value}")
    return number


def _whole(name: str, value: int, least: int) -> int:
    if isinstance(value, bool) or int(value) != value or value < least:
        raise ValueError(f"{name} must be a whole number >= {least}, got {value!r}")
    return int(value)
