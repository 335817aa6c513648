"""How the material of a simulator is replaced: checked first, then all arrays or none."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import is_parametrized

from .checks import check_has_values
from .diagonal import named_material
from .material import (
    ARRAYS,
    PARTS_OF_ROWS,
    check_array,
    check_batches,
    check_hard,
    dims_of,
    in_order,
    named_arrays,
    one_for_all_rows,
)
from .material_parts import COLUMNS, whole_arrays
from .multilevel import has_levels, has_strangers
from .parametrized import invert, make, parametrization
from .pins import PIN_HARD, hold_exactly, split_springs
from .placing import is_recording, loosened_plan, plan_for_solver, plan_that_holds
from .plan import Plan
from .warn import warn_user
from .written import Seen, has_numbers, plain_tensor

if TYPE_CHECKING:
    from .model import Model

__all__ = [
    "check_keys",
    "check_originals",
    "held_springs",
    "load_material",
    "ordinary",
    "read_pins",
    "replace_material",
]

# what decides how many iterations a step takes
_OF_THE_RATE = ("stiffness", "masses", "damping", "pin_stiffness", PIN_HARD)


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
        if name not in ARRAYS and name not in COLUMNS:
            names = ", ".join([*ARRAYS, *COLUMNS])
            part_of = f"; {PARTS_OF_ROWS[name]}" if name in PARTS_OF_ROWS else ""
            raise TypeError(f"{owner}: no array {name!r}; there are {names}{part_of}")
    arrays = whole_arrays(sim, owner, arrays)
    replaces_hard, hard = PIN_HARD in arrays, arrays.pop(PIN_HARD, False)
    checked = {name: check_array(owner, name, value, getattr(sim, name)) for name, value in arrays.items()}
    for name, value in arrays.items():
        if torch.is_grad_enabled() and isinstance(value, Tensor) and value.requires_grad:
            warn_user(
                f"{owner} copies the numbers of {name}, so no gradient gets to what they were made of: give "
                f'it to calls by torch.func.functional_call(sim, {{"{name}": ...}}, (state,)), or detach() it'
            )
    if replaces_hard:
        checked[PIN_HARD] = check_hard(owner, hard, sim.pin_hard)
    hard_of_springs = {PIN_HARD: checked["pin_stiffness"]} if "pin_stiffness" in checked else {}
    check_batches(owner, hard_of_springs | checked, named_arrays(sim))
    if "pin_stiffness" in checked:
        checked |= _pins_apart(sim, owner, checked["pin_stiffness"], checked.get(PIN_HARD))
    with ordinary():
        originals = {}
        for name in [name for name in checked if is_parametrized(sim, name)]:
            originals[name], checked[name] = invert(owner, sim, name, checked[name])
        parameters = {
            name: nn.Parameter(tensor.clone(), requires_grad=getattr(sim, name).requires_grad)
            for name, tensor in checked.items()
            if name != PIN_HARD and (anew or tensor.shape != getattr(sim, name).shape)
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
            elif name == PIN_HARD and (anew or tensor.shape != sim.pin_hard.shape):
                sim.pin_hard = tensor.clone()
            else:
                getattr(sim, name).copy_(tensor)
    sim.plan = plan
    read_pins(sim)
    if any(name in checked for name in _OF_THE_RATE):
        sim.judge_iterations(owner)
    if learned := [name for name in reshaped if name in parameters and parameters[name].requires_grad]:
        warn_user(
            f"the simulator has a new parameter for {' and '.join(learned)}, of another batch, which an optimiser "
            "of the one before does not know: make the optimiser anew, or set the batch first"
        )


def _pins_apart(sim: Model, owner: str, springs: Tensor, hard: Tensor | None) -> dict[str, Tensor]:
    """Springs as they are stored, and which pins are hard: those given as inf, or those that `hard` says."""
    stored, infinite = split_springs(springs)
    if hard is not None:
        _refuse_pins(f"{owner}: pin_stiffness is inf, which holds exactly, where {PIN_HARD} is False", infinite & ~hard)
        return {"pin_stiffness": stored, PIN_HARD: hard}
    was = sim.pin_hard
    if was.dim() == 2 and was.shape != springs.shape:
        was = was.any(0)
    # what sim.pin_stiffness has there: who scales that must not let go unawares
    _refuse_pins(
        f"{owner}: pin_stiffness is 0 for pins that are hard, and does not say whether these are let go: give inf to "
        f"hold on, {PIN_HARD}=False to let go, or {PIN_HARD} of every pin",
        was & (springs == 0.0),
    )
    return {"pin_stiffness": stored, PIN_HARD: infinite}


def _refuse_pins(fault: str, bad: Tensor) -> None:
    if bool(bad.any()):
        places = bad.nonzero()
        raise ValueError(f"{fault}; at {places[0].tolist()} ({len(places)} in all)")


def _plan_with(sim: Model, arrays: dict[str, Tensor]) -> Plan:
    """The plan that serves the material with some arrays replaced."""
    if "pin_stiffness" not in arrays and PIN_HARD not in arrays:
        return sim.plan
    own = named_arrays(sim)
    now, was = in_order(own | arrays), in_order(own)
    plan = loosened_plan(sim, arrays.get(PIN_HARD, sim.pin_hard))
    if not has_levels(plan.arrays):
        return plan
    # what is held belongs to the structure of a preconditioner
    held = _held_everywhere(was), _held_everywhere(now)
    if torch.equal(*held) and not has_strangers(plan, now, sim.time_step):
        return plan
    return plan_for_solver(sim, now, plan)


def _held_everywhere(material: list[Tensor]) -> Tensor:
    """Whether each pin holds exactly in all environments [P]."""
    hard = named_material(material)["pin_stiffness"].isinf()
    return hard.all(0) if hard.dim() == 2 else hard


class _Found(NamedTuple):
    """What somebody found who looked at the mask of hard pins."""

    some: bool  # whether any pin may be hard
    springs: Tensor | None = None  # those that `held` was made of,
    held: Tensor | None = None  # as the ops take them
    version: int | None = None  # of the springs; None where all pins are hard, whatever the springs


def held_springs(sim: Model, springs: Tensor) -> Tensor:
    """`pin_stiffness` as the ops take it: inf where a pin is hard. The plan follows what `pin_hard` lets go."""
    hard = sim._buffers[PIN_HARD]  # nn.Module.__getattr__ takes as long as all the rest
    assert hard is not None
    if torch.compiler.is_compiling():
        return hold_exactly(springs, hard)
    seen = sim._seen_pins
    some, known, held, version = seen.found if seen.holds(hard) else _look_at_pins(sim, springs, hard)
    if not some:
        return springs
    learned = springs.requires_grad and torch.is_grad_enabled()
    # what a CUDA graph records shall see later masks
    if known is not springs or held is None or learned or (springs.is_cuda and is_recording(springs.device)):
        return hold_exactly(springs, hard)
    if version is not None and springs._version != version:
        return hold_exactly(springs, hard)
    return held


def read_pins(sim: Model) -> None:
    """What later steps need of pins, after these were set or moved: then no step has to wait for a GPU."""
    sim._seen_pins = Seen()
    if sim.anchors.pinned:
        with ordinary():
            _look_at_pins(sim, sim.pin_stiffness, sim.pin_hard, wait=True)


def _look_at_pins(sim: Model, springs: Tensor, hard: Tensor, *, wait: bool = False) -> _Found:
    """Let the plan follow a mask that lets more go than it knows of, and remember what was found.

    Pieces get rigid motions then, and a preconditioner no longer holds what it held. A step reads the mask, for which
    it awaits a GPU, only after somebody has written to it, and not where the plan holds nothing; with `wait` always.
    """
    loose, plain = sim.plan.loose, plain_tensor(hard)
    if not wait and (loose is None or bool(loose.all())) and not has_levels(sim.plan.arrays):
        return _Found(some=True)
    if not has_numbers(plain) or is_recording(plain.device):
        return _Found(some=True)
    mask = plain.cpu().reshape(-1, plain.shape[-1])
    found = _Found(some=bool(mask.any()))
    with ordinary():
        plan = loosened_plan(sim, mask)
        sim.plan = plan_that_holds(sim, plan, mask.all(0))
        # streams wait for what sets the material, but not for what another one has made in a step
        if plain is hard and type(springs) is nn.Parameter and found.some and (wait or not hard.is_cuda):
            version = None if bool(mask.all()) else springs._version
            found = _Found(True, springs, hold_exactly(springs, hard), version)
    if plain is hard:
        sim._seen_pins.remember(hard, found)
    return found


def check_kinds(sim: Model, owner: str, arrays: Mapping[str, Any]) -> None:
    """Refuse what a simulator cannot keep as it is: tensors of another precision or device."""
    for name, array in arrays.items():
        own = getattr(sim, name)
        if isinstance(array, Tensor) and (array.dtype, array.device) != (own.dtype, own.device):
            raise TypeError(
                f"{owner}: {name} must be {own.dtype} on {own.device} like the simulator, got {array.dtype} on "
                f"{array.device}; without assign=True it is converted"
            )


def load_material(
    sim: Model, state_dict: dict[str, Any], prefix: str, rest: tuple[Any, ...], load: Callable[..., None]
) -> None:
    """Check values, and take arrays of every environment where a simulator had shared ones; then `load` as torch does.

    Takes the arguments of `Module._load_from_state_dict`.
    """
    local_metadata, *_, errors = rest
    assign = bool(local_metadata.get("assign_to_params_buffers", False))
    owner = f"{type(sim).__name__}.load_state_dict"
    arrays = {n: state_dict[prefix + n] for n in ARRAYS if prefix + n in state_dict}
    # older ones say by inf which pins are hard
    older, original = PIN_HARD not in arrays, f"{prefix}parametrizations.pin_stiffness.original"
    try:
        with torch.no_grad():
            if older and original in state_dict and is_parametrized(sim, "pin_stiffness"):
                made = make(sim, "pin_stiffness", state_dict[original])
                arrays |= {"pin_stiffness": made} if bool(made.isinf().any()) else {PIN_HARD: made.isinf()}
            check_saved(sim, owner, arrays)
            if older and PIN_HARD not in arrays and bool(arrays.get("pin_stiffness", torch.zeros(())).isinf().any()):
                # none of the present version has inf, so 0 there is a pin that was let go
                arrays[PIN_HARD] = arrays["pin_stiffness"].isinf()
            if assign:
                check_kinds(sim, owner, arrays)
            elif PIN_HARD in arrays:
                arrays[PIN_HARD] = arrays[PIN_HARD].bool()  # as torch converts the others
            replace_material(sim, owner, arrays, anew=assign)
    except (TypeError, ValueError) as error:
        if not prefix:
            raise
        errors.append(f"{prefix.removesuffix('.')}: {error}")
        return
    if older:
        state_dict[prefix + PIN_HARD] = sim.pin_hard
        if "pin_stiffness" in arrays and is_parametrized(sim, "pin_stiffness"):
            state_dict[original] = parametrization(sim, "pin_stiffness").original.detach()
        elif "pin_stiffness" in arrays:
            state_dict[prefix + "pin_stiffness"] = sim.pin_stiffness.detach()
    load(state_dict, prefix, *rest)
    read_pins(sim)


def check_saved(sim: Model, owner: str, arrays: Mapping[str, Any]) -> None:
    """Refuse what `set_material` would stretch, and torch refuses after arrays before it are written."""
    for name, array in arrays.items():
        if not isinstance(array, Tensor):
            raise TypeError(f"{owner}: {name} must be a tensor, got {type(array).__name__}")
        dims = dims_of(name)
        if array.dim() < dims:
            raise ValueError(f"{owner}: {name} must have {dims} or {dims + 1} dimensions, got {list(array.shape)}")
        own = getattr(sim, name).shape
        if one_for_all_rows(name, array, own[-1] if dims else 1).shape != array.shape:
            wanted = list(own[len(own) - dims :])
            raise ValueError(
                f"{owner}: {name} must be {wanted}, or with a batch in front, got {list(array.shape)}; set_material "
                "takes one number for all"
            )


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
                # which pins are hard older ones say by inf
                ("Missing", [key for key in wanted if key not in (*state_dict, PIN_HARD)]),
                ("Unexpected", [key for key in state_dict if key not in wanted]),
            )
            if keys
        ]
        if faults:
            raise RuntimeError(f"{type(sim).__name__}.load_state_dict: nothing is loaded. {'. '.join(faults)}")
