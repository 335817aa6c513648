"""Base of a simulator: a compiled scene with its material, precision and device."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch import Tensor, nn

from ..common.checks import check_whole
from ..common.synonyms import check_arguments
from ..estimate.solver_choice import Choice
from ..ops.diagonal import named_material
from ..plan.compiled import persistent_tensors
from ..plan.cpu_plan import Plan, compile_plan
from ..plan.kernel_choice import check_kernel
from ..plan.material import CORE_ROWS, HISTORY_PLACES, material_of, ops_names, with_absent
from ..plan.mutation_guard import MutationGuard, check_rest
from ..plan.placement import check_target_device, is_recording
from ..scene.pins import PIN_HARD, hold_exactly
from ..scene.scene import Scene
from ..scene.solvers import DEFAULT_ITERATIONS, LARGEST_COUNT, Chebyshev, Solver, SolverName, check_solver
from ..scene.targets import Anchors, Targets
from .load_checks import warn_of_loads
from .material_update import (
    check_change,
    check_keys,
    check_originals,
    load_material,
    warn_of_new_parameters,
    write_change,
)
from .notices import Notices, warn_of_scene
from .pin_mask import PinMask, held_springs, read_pin_mask, serves_any_mask
from .settings import (
    EVERY_STEP,
    NO_STEP,
    SETTINGS,
    Configuration,
    check_contact,
    check_iterations,
    choose,
    choose_again,
    is_auto,
    moved,
    prepare,
    reconfigure,
)
from .state import ContactHistory, History, HistoryState, State, history_of
from .state_checks import (
    check_adjoint,
    check_batch,
    check_state,
    check_time_step,
    check_tolerance,
    positions_of,
    report_resolution,
)
from .surface_loads import SurfaceLoads

if TYPE_CHECKING:
    from typing_extensions import Self

    from .body_contact import BodyContact

__all__ = ["Model"]

_PIN_STIFFNESS = CORE_ROWS.index("pin_stiffness")
_FLOW_WIDTH = 10  # of `History.flow`


class _TuningResult(Protocol):
    """What the model calls of a `TuningResult`."""

    def invalidate(self, other: bool) -> None: ...


class Model(nn.Module):
    """Plan, settings and material of a `Simulator`, which documents the arguments, and their changes."""

    rest_positions: Tensor
    stiffness: Tensor
    masses: Tensor
    gravity: Tensor
    damping: Tensor
    pin_stiffness: Tensor
    pin_hard: Tensor
    pin_targets: Tensor
    planes: Tensor
    spheres: Tensor
    fibre_contraction: Tensor | None  # [fibres]
    pressure: Tensor  # where the scene has it, like the next
    wind: Tensor
    material_names: tuple[str, ...]  # trainable arrays of the scene, in the order of the tables
    loads: SurfaceLoads | None  # None without pressure or wind
    body_contact: BodyContact | None = None  # None without `Contact`
    progress: bool = True  # whether bars show while a large scene compiles, for another device too

    @check_arguments("Simulator")
    def __init__(
        self,
        scene: Scene,
        time_step: float = 1 / 60,
        iterations: int | None = None,
        solver: Solver | SolverName | None = None,
        dtype: torch.dtype = torch.float32,
        *,
        tolerance: float = 0.0,
        kernel: str = "auto",
        batch: int | None = None,
        adjoint: str = "solver",
        device: torch.device | str | None = None,
        progress: bool = True,
    ) -> None:
        super().__init__()
        if not isinstance(scene, Scene):
            raise TypeError(f"Simulator: scene must be a Scene, got {type(scene).__name__}")
        if device is not None:  # before a large scene is compiled
            target = check_target_device(lambda probe: probe.to(device), torch.empty(0, dtype=dtype))
            check_contact(scene, device=target.device)
        self.scene = scene
        self._time_step = check_time_step(time_step, dtype)
        self.iterations = DEFAULT_ITERATIONS if iterations is None else iterations
        self._solver: Solver = Chebyshev()
        given = self._solver if solver is None or is_auto(solver) else check_solver(solver, torch.device("cpu"))
        self.tolerance = tolerance
        self.tuning_result: _TuningResult | None = None
        self.choice: Choice | None = None  # of "auto"
        self._kernel = check_kernel(kernel)
        self._batch = check_batch(batch)
        self._adjoint = check_adjoint(adjoint)
        check_contact(scene, solver=given, adjoint=adjoint)
        self.progress = progress
        values = scene.values()
        report_resolution(scene, dtype)
        self.anchors = Anchors(scene)
        self.pinned = values.pinned
        self._rest_guard, self._pin_guard, self._notices = MutationGuard(), MutationGuard(), Notices(self, scene)
        with persistent_tensors():
            if values.contact is not None:
                from .body_contact import BodyContact  # scenes without contact load nothing of it

                self.body_contact = BodyContact.of(values, dtype)
            self.plan: Plan = compile_plan(values, dtype=dtype, progress=progress)
            self.register_buffer("rest_positions", torch.tensor(values.rest_positions, dtype=dtype), persistent=False)
            contraction = self.anchors.contraction
            held = None if contraction is None else torch.tensor(contraction, dtype=dtype)
            self.register_buffer("fibre_contraction", held, persistent=False)
            arrays = material_of(values, dtype)
            hard = arrays.pop(PIN_HARD)
            self.material_names, self._ops_names = tuple(arrays), ops_names(arrays)
            for name, array in arrays.items():
                self.register_parameter(name, nn.Parameter(array, requires_grad=False))
            self.register_buffer(PIN_HARD, hard)
            self.loads = SurfaceLoads.of(scene, dtype, self.device)
        self._refresh_pin_mask()
        warn_of_scene(scene)
        if self.loads is not None:
            warn_of_loads(self.compiled, self.loads)
        if device is not None:  # first, since "auto" chooses for it
            self.to(device)
        if is_auto(solver):
            with persistent_tensors():
                self._take(choose(self.compiled, None if iterations is None else self.iterations))
        else:
            self.solver = given
            self.named_iterations = iterations is not None
            self.check_iterations(None)

    @property
    def vertices(self) -> int:
        """Number of vertices of all bodies."""
        return self.plan.vertices

    @property
    def dtype(self) -> torch.dtype:
        """Precision of states."""
        return self.plan.dtype

    @property
    def device(self) -> torch.device:
        """Device of plan and states."""
        return self.plan.device

    @property
    def batch(self) -> int | None:
        """Expected environments of a step, or None; setting it replans a GPU and lets "auto" choose again."""
        return self._batch

    @batch.setter
    def batch(self, batch: int | None) -> None:
        self._reconfigure(batch=batch)

    @property
    def kernel(self) -> str:
        """Requested kernel of a GPU; setting it replans a GPU and lets "auto" choose again."""
        return self._kernel

    @kernel.setter
    def kernel(self, kernel: str) -> None:
        self._reconfigure(kernel=kernel)

    @property
    def time_step(self) -> float:
        """h [s]; setting it may give an `UnsolvedWarning`, as `set_material` does."""
        return self._time_step

    @time_step.setter
    def time_step(self, time_step: float) -> None:
        self._time_step = check_time_step(time_step, self.dtype)
        shortest, longest = self._checked_time_steps
        # a time step that changes in every step is rarely outside of the checked range
        if not (shortest <= self._time_step <= longest or is_recording(self.device)):
            self.check_iterations("time_step")

    @property
    def iterations(self) -> int:
        """Most local and global steps in a time step."""
        return self._iterations

    @iterations.setter
    def iterations(self, iterations: int) -> None:
        self._iterations = check_whole("Simulator: iterations", iterations, minimum=0, maximum=LARGEST_COUNT)
        self.named_iterations = True

    @property
    def named_iterations(self) -> bool:
        """Whether the user gave the number of iterations: then no warning says that it has become too small."""
        return self._named_iterations

    @named_iterations.setter
    def named_iterations(self, named: bool) -> None:
        self._named_iterations = named
        self._checked_time_steps = EVERY_STEP if named else NO_STEP

    def check_iterations(self, changed: str | None) -> None:
        """Warn once if default iterations are too few after a change of `changed`; waits for a GPU until then."""
        if self._checked_time_steps != EVERY_STEP:
            now = self.compiled
            self._checked_time_steps = EVERY_STEP  # also if the warning is raised as an error
            self._checked_time_steps = check_iterations(now, changed).checked_time_steps

    @property
    def tolerance(self) -> float:
        """Estimated relative displacement error below which an environment stops iterating; 0: never."""
        return self._tolerance

    @tolerance.setter
    def tolerance(self, tolerance: float) -> None:
        self._tolerance = check_tolerance(tolerance)

    @property
    def solver(self) -> Solver:
        """The solver. Setting `Multilevel` prepares its matrix; "auto" sets iterations too."""
        return self._solver

    @solver.setter
    def solver(self, solver: Solver | SolverName) -> None:
        self._reconfigure(solver=solver)

    @property
    def adjoint(self) -> str:
        """Preconditioner of gradients, "solver" or "multilevel"; setting "multilevel" prepares its matrix."""
        return self._adjoint

    @adjoint.setter
    def adjoint(self, adjoint: str) -> None:
        self._reconfigure(adjoint=adjoint)

    @property
    def contact_friction(self) -> Tensor:
        """Coulomb's coefficient between bodies of `Contact` [Q, Q]: those of the scene in its order, then colliders.

        Set a number, or a symmetric table; gradients of later steps flow to what was set. A table of its own for each
        environment is not provided.

        Example:
            >>> friction = torch.tensor(0.3, requires_grad=True)
            >>> sim.contact_friction = friction
            >>> sim(state).positions.sum().backward()
        """
        return self._contact().friction

    @contact_friction.setter
    def contact_friction(self, friction: Tensor | float) -> None:
        self.body_contact = self._contact().with_friction(friction)

    def _contact(self) -> BodyContact:
        if self.body_contact is None:
            raise ValueError("contact_friction: the scene must have a Contact, got none; add Contact()")
        return self.body_contact

    @property
    def compiled(self) -> Configuration:
        """Plan, material and present settings, for modules below the simulator."""
        return self._with_material(self.material())

    def _with_material(self, material: list[Tensor]) -> Configuration:
        own = {name: getattr(self, "_" + name) for name in SETTINGS}
        kept = {name: getattr(self, name) for name in ("scene", "pinned", "plan", "choice", "progress")}
        return Configuration(material=material, **kept, **own)

    def _reconfigure(self, **changes: Any) -> None:
        with persistent_tensors():
            self._take(reconfigure(self.compiled, **changes))

    def _take(self, new: Configuration) -> None:
        """Take over plan and settings, all of them at once."""
        own = {"_" + name: getattr(new, name) for name in SETTINGS}
        vars(self).update(own, plan=new.plan, choice=new.choice)

    def prepare_solver(self) -> None:
        """Prepare the matrix of `Multilevel` or `adjoint` for the present material, and let "auto" choose again.

        Call it after large changes of material or time_step, which `Info.rho`, `Info.residual` and, for "auto", an
        `UnsolvedWarning` show. Then capture captured steps again; compiled steps recompile. It takes 0.3 s for 8
        thousand vertices and seconds for a million tetrahedra. Other solvers prepare nothing.

        `set_material` calls it only when it pins other vertices hard, frees some, or gives them much stiffer springs.
        """
        with persistent_tensors():
            self._take(prepare(self.compiled))

    def material(self) -> list[Tensor]:
        """The differentiable arrays in the order of the ops, contiguous whatever a call or a parametrization gives.

        Springs of hard pins are inf here. The plan follows when `pin_hard` releases pins.
        """
        arrays = self._own_arrays()
        if self.anchors.pinned:
            arrays[_PIN_STIFFNESS] = self._held_springs(arrays)
        # is_contiguous() is far cheaper than contiguous(), which takes 6 of the 40 us of a tiny step
        return [array if array.is_contiguous() else array.contiguous() for array in arrays]

    def _own_arrays(self) -> list[Tensor]:
        arrays = [getattr(self, name) for name in self._ops_names]
        return arrays if len(arrays) == len(CORE_ROWS) else with_absent(arrays, self._ops_names)

    def _held_springs(self, arrays: list[Tensor]) -> Tensor:
        hard = self._buffers[PIN_HARD]  # nn.Module.__getattr__ would double the time of this method
        assert hard is not None
        if torch.compiler.is_compiling():
            return hold_exactly(arrays[_PIN_STIFFNESS], hard)
        guard = self._pin_guard
        mask = guard.found if guard.is_current(hard) else self._read_pin_mask(arrays, hard)
        return held_springs(mask, arrays[_PIN_STIFFNESS], hard)

    def _read_pin_mask(self, arrays: list[Tensor], hard: Tensor, *, wait: bool = False) -> PinMask:
        """Let the plan follow a mask that releases pins the plan relies on.

        A step reads the mask, and waits for a GPU, only after a write to it, and only if the plan relies on hard pins.
        With `wait` it always does.
        """
        if not wait and serves_any_mask(self.plan):
            return PinMask(some=True)
        guard, self.plan = read_pin_mask(self._with_material(arrays), hard, wait=wait)
        if guard.is_current(hard):
            self._pin_guard = guard
        mask: PinMask = guard.found
        return mask

    def _refresh_pin_mask(self) -> None:
        """Read the pins after they were set or moved, so that later steps need not wait for a GPU."""
        self._pin_guard = MutationGuard()
        if self.anchors.pinned:
            with persistent_tensors():
                self._read_pin_mask(self._own_arrays(), self.pin_hard, wait=True)

    def __copy__(self) -> Self:
        """A shallow copy; torch refuses to copy parametrized modules through pickling."""
        copied = type(self).__new__(type(self))
        copied.__dict__.update(self.__dict__)
        return copied

    def set_material(self, **arrays: Tensor | float) -> None:
        """Check and replace material arrays, shared or with a leading batch; all of them, or none.

        An array of the same shape is overwritten, so optimisers keep it. Another batch makes a new parameter, with a
        warning if the former one was trained. No gradient reaches the given values, and a warning says so. To get one,
        give arrays to a call by `torch.func.functional_call`, or register a parametrization
        (`torch.nn.utils.parametrize`). A registered one is written through its `right_inverse`.

        `pin_hard` releases pins and grasps again: one bool, [P], [B, 1] or [B, P]. A soft pin is a spring of its
        `pin_stiffness`; 0 N/m holds nothing. `pin_stiffness` without `pin_hard` also sets which pins are hard: inf is
        hard and stored as 0, any other number is a spring. 0 for a pin that is now hard is refused as ambiguous.

            sim.set_material(pin_hard=holds[:, None])                     # [B] bool: some environments release
            sim.set_material(pin_hard=True, pin_targets=where)            # grasp at [B, P, 3] m

        A number replaces the effect of `mesh.fill`; multiply `sim.stiffness` instead to keep it.

        Other hard pins, or much stiffer ones, prepare the matrix of `Multilevel` or `adjoint` again, see
        `prepare_solver`. Releasing a body that hard pins clamped makes the plan again. After either, capture captured
        steps again. An `UnsolvedWarning` comes once if default iterations, or those of "auto", become too few.

        Args:
            arrays: by name, see `Simulator`. One number is for all elements, vertices or pins of an array without
                columns; [B, 1] is one number for each environment, also of `damping`. The last dimension never counts
                environments.
            friction, height, radius: columns of `planes` and `spheres`, in place of these. `friction` is [C + S] with
                grounds first, `height` [C] m, `radius` [S] m. Each may be one number, or [B, 1].

        Raises:
            ValueError, TypeError: shapes, values, or batches that disagree with each other or with arrays that stay.
        """
        self._replace_material("set_material", arrays)

    def _replace_material(self, owner: str, arrays: Mapping[str, Tensor | float], *, assign: bool = False) -> None:
        change = check_change(self, self.compiled, owner, arrays, assign=assign)
        result = self.tuning_result
        if result is not None and any(not torch.equal(new, getattr(self, n)) for n, new in change.arrays.items()):
            result.invalidate(True)
        write_change(self, change)
        if change.changes_pins:
            self.plan = change.plan
            self._refresh_pin_mask()
        if change.changes_rate:
            self.check_iterations(owner)
        warn_of_new_parameters(change)

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """As `torch.nn.Module.load_state_dict`, but loads all arrays or none.

        Material of another batch makes new parameters, with the warning of `set_material`. With `assign` nothing is
        converted: arrays of another precision are refused.

        If the simulator is a submodule, torch loads it in its own order. Arrays that do not fit are then reported
        together with torch's other errors.
        """
        check_keys(self, state_dict, strict=strict)
        check_originals(self, state_dict)
        return super().load_state_dict(state_dict, strict, assign)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        load_material(self, state_dict, prefix, rest, self._replace_material, super()._load_from_state_dict)
        self._refresh_pin_mask()

    def check_state(self, state: State | HistoryState, *, forces: Tensor | None = None, fix: str = "") -> Tensor | None:
        """Check a state and forces; return the forces of every environment.

        Args:
            state: of the precision and device of the simulator, velocities like positions.
            forces: as in `forward`.
            fix: end of the errors about forces of another shape.
        """
        return check_state(self._checked_rest(), state, self.history_at_rest(), forces=forces, fix=fix)

    def positions_of(self, state: State | HistoryState | Tensor, name: str = "state") -> Tensor:
        """Positions of a state, or positions alone, after all checks."""
        return positions_of(self._checked_rest(), state, self.history_at_rest(), name)

    @property
    def keeps_history(self) -> bool:
        """Whether a step leaves more than positions and velocities, so that states are a `HistoryState`."""
        return self.body_contact is not None or self._flows

    @property
    def _flows(self) -> bool:
        """Whether the history has material of plastic solids."""
        return any(name in self.material_names for name in History._fields)

    def history_at_rest(self) -> History | ContactHistory | None:
        """The history of a new state, with or without a batch; None where the scene keeps none."""
        own = [getattr(self, name) for name in History._fields] if self._flows else []
        if self.body_contact is None:
            return History(*own) if own else None
        (flow,) = own or [self.rest_positions.new_zeros(0, _FLOW_WIDTH)]
        return ContactHistory(*self.body_contact.history, flow.detach())

    def with_history(self, material: list[Tensor], state: State | HistoryState | Tensor) -> list[Tensor]:
        """The material with the history of a checked state; positions alone have that of a new state."""
        if isinstance(state, Tensor) or not self._flows:
            return material
        history = history_of(state[2])  # type: ignore[misc]
        own = dict(zip(HISTORY_PLACES, (getattr(history, name) for name in History._fields), strict=True))
        return [own[place].contiguous() if place in own else array for place, array in enumerate(material)]

    def _checked_rest(self) -> Tensor:
        rest = self.rest_positions
        guard = check_rest(self._rest_guard, rest, self.scene)
        if guard is not self._rest_guard:
            self._rest_guard = guard
        return rest

    def step_settings(self, *, inertial: bool, report: bool) -> dict[str, Any]:
        """The settings as keyword arguments of the ops."""
        return {
            **self.solver.settings(),
            "iterations": self.iterations,
            "time_step": self.time_step,
            "tolerance": self.tolerance,
            "inertial": inertial,
            "report": report,
        }

    def material_at(self, targets: Targets | None, batch: int, *, fix: str = "") -> list[Tensor]:
        """The material with pins, spheres and fibres as `targets` say; `fix` ends errors about another shape."""
        material = self.material()
        if targets is None:
            return material
        named = named_material(material)
        placed = self.anchors.place(
            targets, named, self.fibre_contraction, batch=batch, time_step=self.time_step, fix=fix
        )
        return [placed.get(row, array).contiguous() for row, array in named.items()]

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        wanted = check_target_device(fn, torch.empty(0, dtype=self.dtype, device=self.device))
        if wanted.dtype not in (torch.float32, torch.float64):
            raise TypeError(f"Simulator: dtype must be torch.float32 or torch.float64, got {wanted.dtype}")
        check_time_step(self.time_step, wanted.dtype)
        check_contact(self.scene, device=wanted.device)
        contact = None if self.body_contact is None else self.body_contact.to(wanted.dtype, wanted.device)
        choice, ends = self.choice, {self.device.type, wanted.device.type}
        # widening does not restore the digits that float32 lost, and "meta" has none
        loses_positions = wanted.dtype != self.dtype or self.device.type == "meta"
        with persistent_tensors():
            # another device may choose differently; a simulator from "meta" has no values to choose by
            if chooses := choice is not None and len(ends) == 2 and "meta" not in ends:
                new = moved(reconfigure(self.compiled, solver=Chebyshev()), wanted.dtype, wanted.device)
            else:
                new = moved(self.compiled, wanted.dtype, wanted.device)
            super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
            self._take(new)
            if contact is not None:
                self.body_contact = contact
            if self.loads is not None:
                self.loads = SurfaceLoads.of(self.scene, wanted.dtype, wanted.device)
            if loses_positions:
                # the material may have been trained, so it keeps its digits
                report_resolution(self.scene, wanted.dtype)
                self.rest_positions = torch.tensor(self.scene.rest_positions, dtype=wanted.dtype, device=wanted.device)
                if (contraction := self.anchors.contraction) is not None:
                    self.fibre_contraction = torch.tensor(contraction, dtype=wanted.dtype, device=wanted.device)
        self._refresh_pin_mask()
        if chooses:
            with persistent_tensors():
                self._take(choose_again(replace(self.compiled, choice=choice)))
        return self
