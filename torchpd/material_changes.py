"""How the material of a simulator is replaced: checked first, then all arrays or none."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import is_parametrized

from .checks import check_has_values
from .material import MATERIAL_ROWS, PARTS_OF_ROWS, check_array, check_batches
from .material_parts import COLUMNS, whole_arrays
from .multilevel import has_levels, has_strangers
from .parametrized import invert, parametrization
from .placing import plan_for_solver
from .plan import Plan
from .warn import warn_user

if TYPE_CHECKING:
    from .model import Model

__all__ = ["check_keys", "check_kinds", "check_originals", "check_saved", "ordinary", "replace_material"]

_OF_THE_RATE = ("stiffness", "masses", "damping", "pin_stiffness")  # what decides how many iterations a step takes


@contextmanager
def ordinary() -> Iterator[None]:
    """For what a simulator keeps: tensors that are made in inference mode can never be changed or differentiated.

    Those that name no device are for the CPU, whatever torch's default device.
    """
    with torch.inference_mode(False), torch.no_grad(), torch.device("cpu"):
        yield


def replace_material(sim: Model, owner: str, arrays: Mapping[str, Tensor | float], *, anew: bool = False) -> None:
    """What `set_material` and loading do, for whom errors name; `anew`: new parameters, nothing is written over."""
    check_has_values(owner, sim.device)
    for name in arrays:
        if name not in MATERIAL_ROWS and name not in COLUMNS:
            names = ", ".join([*MATERIAL_ROWS, *COLUMNS])
            part_of = f"; {PARTS_OF_ROWS[name]}" if name in PARTS_OF_ROWS else ""
            raise TypeError(f"{owner}: no array {name!r}; there are {names}{part_of}")
    arrays = whole_arrays(sim, owner, arrays)
    checked = {name: check_array(owner, name, value, getattr(sim, name)) for name, value in arrays.items()}
    for name, value in arrays.items():
        if torch.is_grad_enabled() and isinstance(value, Tensor) and value.requires_grad:
            warn_user(
                f"{owner} copies the numbers of {name}, so no gradient gets to what they were made of: give "
                f'it to calls by torch.func.functional_call(sim, {{"{name}": ...}}, (state,)), or detach() it'
            )
    check_batches(owner, checked, dict(zip(MATERIAL_ROWS, sim.material(), strict=True)))
    with ordinary():
        originals = {}
        for name in [name for name in checked if is_parametrized(sim, name)]:
            originals[name], checked[name] = invert(owner, sim, name, checked[name])
        parameters = {
            name: nn.Parameter(tensor.clone(), requires_grad=getattr(sim, name).requires_grad)
            for name, tensor in checked.items()
            if anew or tensor.shape != getattr(sim, name).shape
        }
        reshaped = [name for name, tensor in checked.items() if tensor.shape != getattr(sim, name).shape]
        # before anything is replaced, because it may fail
        plan = _plan_with(sim, checked)
        if sim.promise is not None and any(not torch.equal(new, getattr(sim, n)) for n, new in checked.items()):
            sim.promise.doubt(True)
        for name, tensor in checked.items():
            if name in originals:
                parametrization(sim, name).original.copy_(originals[name])
            elif name in parameters:
                setattr(sim, name, parameters[name])
            else:
                getattr(sim, name).copy_(tensor)
    sim._written.remember_pins(sim.pin_stiffness)
    sim.plan = plan
    if any(name in checked for name in _OF_THE_RATE):
        sim.judge_iterations(owner)
    if learned := [name for name in reshaped if name in parameters and parameters[name].requires_grad]:
        warn_user(
            f"the simulator has a new parameter for {' and '.join(learned)}, of another batch, which an optimiser "
            "of the one before does not know: make the optimiser anew, or set the batch first"
        )


def _plan_with(sim: Model, arrays: dict[str, Tensor]) -> Plan:
    """The plan that serves the material with some arrays replaced."""
    if not has_levels(sim.plan.arrays) or "pin_stiffness" not in arrays:
        return sim.plan
    # what is held belongs to the structure of a preconditioner
    held = _held_everywhere(sim.pin_stiffness), _held_everywhere(arrays["pin_stiffness"])
    material = [arrays.get(name, getattr(sim, name)) for name in MATERIAL_ROWS]
    if torch.equal(*held) and not has_strangers(sim.plan, material, sim.time_step):
        return sim.plan
    return plan_for_solver(sim, material)


def _held_everywhere(pin_stiffness: Tensor) -> Tensor:
    """Whether each pin holds exactly in all environments [P]."""
    hard = pin_stiffness.isinf()
    return hard.all(0) if hard.dim() == 2 else hard


def check_kinds(sim: Model, owner: str, arrays: Mapping[str, Any]) -> None:
    """Refuse what a simulator cannot keep as it is: tensors of another precision or device."""
    for name, array in arrays.items():
        own = getattr(sim, name)
        if isinstance(array, Tensor) and (array.dtype, array.device) != (own.dtype, own.device):
            raise TypeError(
                f"{owner}: {name} must be {own.dtype} on {own.device} like the simulator, got {array.dtype} on "
                f"{array.device}; without assign=True it is converted"
            )


def check_saved(owner: str, arrays: Mapping[str, Any]) -> None:
    """Refuse what `set_material` would stretch, and torch refuses after arrays before it are written."""
    for name, array in arrays.items():
        if not isinstance(array, Tensor):
            raise TypeError(f"{owner}: {name} must be a tensor, got {type(array).__name__}")
        dims = MATERIAL_ROWS[name].dims
        if array.dim() < dims:
            raise ValueError(f"{owner}: {name} must have {dims} or {dims + 1} dimensions, got {list(array.shape)}")


def check_originals(sim: Model, state_dict: Mapping[str, Any]) -> None:
    """Refuse what does not fit a parametrization, which torch finds out after arrays before it are written."""
    own = sim.state_dict()
    for name, array in state_dict.items():
        if not name.startswith("parametrizations.") or name not in own:
            continue
        if not isinstance(array, Tensor) or array.shape != own[name].shape:
            came = list(array.shape) if isinstance(array, Tensor) else type(array).__name__
            raise ValueError(
                f"{type(sim).__name__}.load_state_dict: {name} must be a tensor {list(own[name].shape)} like that of "
                f"the simulator, got {came}"
            )


def check_keys(sim: Model, state_dict: Mapping[str, Any], *, strict: bool) -> None:
    """Refuse what is no state_dict and, where `strict`, one with other names, before anything is loaded."""
    if not isinstance(state_dict, Mapping):
        raise TypeError(
            f"{type(sim).__name__}.load_state_dict: state_dict must be what state_dict() gave, got "
            f"{type(state_dict).__name__}"
        )
    # a hook may give keys other names
    if strict and not sim._load_state_dict_pre_hooks:
        wanted = sim.state_dict()
        faults = [
            f"{fault} key(s) in state_dict: {', '.join(map(repr, keys))}"
            for fault, keys in (
                ("Missing", [key for key in wanted if key not in state_dict]),
                ("Unexpected", [key for key in state_dict if key not in wanted]),
            )
            if keys
        ]
        if faults:
            raise RuntimeError(f"{type(sim).__name__}.load_state_dict: nothing is loaded. {'. '.join(faults)}")
