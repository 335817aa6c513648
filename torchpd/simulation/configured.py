"""Settings and present material of a simulator, and the plan that follows them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from ..common.checks import check_whole
from ..estimate.solver_choice import Choice
from ..plan.compiled import Planned, persistent_tensors
from ..plan.material import CORE_ROWS, with_absent
from ..plan.mutation_guard import MutationGuard
from ..plan.placement import is_recording
from ..scene.pins import PIN_HARD, PinnedComponents, hold_exactly
from ..scene.scene import Scene
from ..scene.solvers import LARGEST_COUNT, Solver, SolverName
from ..scene.targets import Anchors
from .pin_mask import PinMask, held_springs, read_pin_mask, serves_any_mask
from .settings import (
    EVERY_STEP,
    NO_STEP,
    SETTINGS,
    Configuration,
    check_iterations,
    prepare,
    reconfigure,
)
from .state_checks import check_time_step, check_tolerance

if TYPE_CHECKING:
    from .body_contact import BodyContact

__all__ = ["CONTACT_TENSORS", "Configured"]

CONTACT_TENSORS = ("contact_friction", "contact_thickness")
_PIN_STIFFNESS = CORE_ROWS.index("pin_stiffness")


class Configured(Planned, nn.Module):
    """What a `Model` is set to; whatever changes plan or settings goes through `_take`."""

    scene: Scene
    pinned: PinnedComponents
    choice: Choice | None  # of "auto"
    anchors: Anchors
    pin_hard: Tensor
    body_contact: BodyContact | None = None  # None without `Contact`
    contact_friction: Tensor  # of scenes with `Contact`, as the next: see `Simulator`
    contact_thickness: Tensor  # on the CPU
    progress: bool = True  # whether bars show while a large scene compiles, for another device too
    _batch: int | None
    _kernel: str
    _solver: Solver
    _adjoint: str
    _ops_names: tuple[str, ...]
    _pin_guard: MutationGuard

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

    def __setattr__(self, name: str, value: Any) -> None:
        """As `torch.nn.Module`; what `Contact` reads is checked. A number overwrites what no caller trains."""
        if name in CONTACT_TENSORS and self.body_contact is not None:
            checked = self._checked_contact(name, value)
            own = getattr(self, name)
            if not isinstance(value, Tensor) and (isinstance(own, nn.Parameter) or not own.requires_grad):
                with torch.no_grad():
                    own.copy_(checked if checked.shape == own.shape else checked.flatten()[0])
                checked = own
            super().__setattr__(name, checked)
            self._find_near_pairs()
            return
        super().__setattr__(name, value)

    def _checked_contact(self, name: str, value: Any) -> Tensor:
        """What friction or thickness of `Contact` is set to, as a tensor."""
        contact = self._contact(name)
        if name == "contact_friction":
            return contact.checked_friction(value)
        checked = contact.checked_thickness(value)
        contact.with_thickness(checked, self.scene.values())  # refuses what no surface can have
        return checked

    def _contact(self, name: str) -> BodyContact:
        if self.body_contact is None:
            raise ValueError(f"{name}: the scene must have a Contact, got none; add Contact()")
        return self.body_contact

    def _find_near_pairs(self) -> None:
        """Let the plan of `Contact` follow its thickness."""
        if self.body_contact is not None:
            self.body_contact = self.body_contact.with_thickness(self.contact_thickness, self.scene.values())

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
