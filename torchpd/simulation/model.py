"""Base of a simulator: a compiled scene with its material, precision and device."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch import Tensor, nn

from ..common.synonyms import check_arguments
from ..common.warn import warn_user
from ..estimate.solver_choice import Choice
from ..ops.diagonal import named_material
from ..plan.compiled import persistent_tensors
from ..plan.cpu_plan import Plan, compile_plan
from ..plan.kernel_choice import check_kernel
from ..plan.material import HISTORY_PLACES, material_of, ops_names
from ..plan.mutation_guard import MutationGuard, check_rest
from ..plan.placement import check_target_device
from ..scene.pins import PIN_HARD
from ..scene.scene import Scene
from ..scene.solvers import DEFAULT_ITERATIONS, Chebyshev, Solver, SolverName, check_solver
from ..scene.targets import Anchors, Targets
from .configured import CONTACT_TENSORS, Configured
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
from .parametrization import HostTensor
from .settings import (
    check_contact,
    choose,
    choose_again,
    is_auto,
    moved,
    reconfigure,
)
from .state import ContactHistory, History, HistoryState, State, history_of
from .state_checks import (
    check_adjoint,
    check_batch,
    check_state,
    check_time_step,
    positions_of,
    report_resolution,
)
from .surface_loads import SurfaceLoads

if TYPE_CHECKING:
    from typing_extensions import Self


__all__ = ["Model"]

_FLOW_WIDTH = 10  # of `History.flow`


class _TuningResult(Protocol):
    """What the model calls of a `TuningResult`."""

    def invalidate(self, other: bool) -> None: ...


class Model(Configured):
    """Plan, settings and material of a `Simulator`, which documents the arguments, and their changes."""

    rest_positions: Tensor
    stiffness: Tensor
    masses: Tensor
    gravity: Tensor
    damping: Tensor
    pin_stiffness: Tensor
    pin_targets: Tensor
    planes: Tensor
    spheres: Tensor
    fibre_contraction: Tensor | None  # [fibres]
    pressure: Tensor  # where the scene has it, like the next
    wind: Tensor
    material_names: tuple[str, ...]  # trainable arrays of the scene, in the order of the tables
    loads: SurfaceLoads | None  # None without pressure or wind

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
                for name, value in self.body_contact.tensors().items():
                    self.register_buffer(name, value)
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
        warn_of_scene(scene, 0.0 if self.body_contact is None else self.body_contact.plan.thickness)
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
        given = {name: state_dict[prefix + name] for name in self._contact_tensors() if prefix + name in state_dict}

        def replace_arrays(owner: str, arrays: Mapping[str, Tensor | float], *, assign: bool) -> None:
            for name, value in given.items():
                self._checked_contact(name, value)
            self._replace_material(owner, arrays, assign=assign)
            self._resize_contact(given)

        load_material(self, state_dict, prefix, rest, replace_arrays, super()._load_from_state_dict)
        self._find_near_pairs()
        self._refresh_pin_mask()

    def _contact_tensors(self) -> dict[str, Tensor]:
        """What is trained of `Contact`, by name."""
        return {} if self.body_contact is None else {name: getattr(self, name) for name in CONTACT_TENSORS}

    def _resize_contact(self, given: Mapping[str, Tensor]) -> None:
        """Make room for friction or thickness of another shape, whose values torch copies."""
        for name, value in given.items():
            own = getattr(self, name)
            if value.shape == own.shape:
                continue
            new = own.detach().new_empty(value.shape)
            kept: Tensor = nn.Parameter(new) if isinstance(own, nn.Parameter) else new
            vars(self)["_parameters" if isinstance(own, nn.Parameter) else "_buffers"][name] = kept
            if kept.requires_grad_(own.requires_grad).requires_grad:
                warn_user(
                    f"the simulator has a new tensor for {name}, because its shape changed. An existing optimiser "
                    "still holds the former one: create the optimiser again"
                )

    def check_state(self, state: State | HistoryState, *, forces: Tensor | None = None, fix: str = "") -> Tensor | None:
        """Check a state and forces; return the forces of every environment.

        Args:
            state: of the precision and device of the simulator, velocities like positions.
            forces: as in `forward`.
            fix: end of the errors about forces of another shape.
        """
        return check_state(
            self._checked_rest(), state, self.history_at_rest(), forces=forces, fix=fix, grows=self._grows
        )

    def positions_of(self, state: State | HistoryState | Tensor, name: str = "state") -> Tensor:
        """Positions of a state, or positions alone, after all checks."""
        return positions_of(self._checked_rest(), state, self.history_at_rest(), name, self._grows)

    @property
    def keeps_history(self) -> bool:
        """Whether a step leaves more than positions and velocities, so that states are a `HistoryState`."""
        return self.body_contact is not None or self._flows

    @property
    def _grows(self) -> bool:
        """Whether steps make the capacity of `Contact` larger."""
        return self.body_contact is not None and self.body_contact.plan.grows

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
            held = None if contact is None else HostTensor(self, "contact_thickness")
            super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
            self._take(new)
            if held is not None:
                self.body_contact = contact
                held.restore(wanted.dtype)
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
