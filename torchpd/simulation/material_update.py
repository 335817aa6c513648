"""Replacement of the material of a simulator: all arrays are checked first, then all or none are written."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import is_parametrized

from ..common.checks import check_has_values
from ..common.tables import EFFECT_ROWS, PLANES, SPHERES
from ..common.warn import warn_user
from ..ops.diagonal import named_material
from ..plan.compiled import CompiledScene, persistent_tensors
from ..plan.cpu_plan import Plan
from ..plan.material import (
    MATERIAL_ROWS,
    SCENE_NAME_HINTS,
    check_array,
    check_batches,
    check_pin_hard,
    dims_of,
    expand_rows,
    material_rows,
    named_arrays,
    real_tensor,
)
from ..plan.placement import plan_after_release, plan_for_solver
from ..plan.preconditioner import has_outliers, has_preconditioner
from ..scene.averaging import check_signs
from ..scene.pins import PIN_HARD, split_springs
from ..scene.scene import Scene
from .parametrization import apply_parametrization, invert_parametrization, parametrization

__all__ = [
    "MaterialChange",
    "check_change",
    "check_keys",
    "check_originals",
    "load_material",
    "warn_of_new_parameters",
    "write_change",
]

# arrays that the convergence rate of a step depends on
_RATE_ARRAYS = (
    "stiffness", "masses", "damping", "pin_stiffness", PIN_HARD, *(row.name for row in EFFECT_ROWS)
)  # fmt: skip
# columns by name: the arrays that have one, and its place there
COLUMNS = {
    "friction": {"planes": PLANES["friction"], "spheres": SPHERES["friction"]},
    "height": {"planes": PLANES["height"]},
    "radius": {"spheres": SPHERES["radius"]},
}
_OWNERS_OF_ROWS = {"planes": "grounds", "spheres": "spheres"}


class MaterialChange(NamedTuple):
    """A checked change of the material, and the plan that suits it."""

    arrays: dict[str, Tensor]  # new values by name
    originals: dict[str, Tensor]  # originals of parametrized arrays
    replaced: dict[str, Tensor]  # new parameters, or a new buffer, where the present ones cannot be written in place
    plan: Plan
    new_trainable: list[str]  # trainable parameters that are new because the batch changed

    @property
    def changes_pins(self) -> bool:
        """Whether the change touches the pins."""
        return "pin_stiffness" in self.arrays or PIN_HARD in self.arrays

    @property
    def changes_rate(self) -> bool:
        """Whether the change may alter the convergence rate of a step."""
        return any(name in _RATE_ARRAYS for name in self.arrays)


def check_change(
    sim: nn.Module, compiled: CompiledScene, owner: str, arrays: Mapping[str, Tensor | float], *, assign: bool = False
) -> MaterialChange:
    """Check the arrays of `set_material` or of a state_dict; `assign`: make new parameters, write none in place."""
    check_has_values(owner, compiled.device)
    own = named_arrays(sim)
    for name in arrays:
        if name not in own and name not in COLUMNS:
            names = ", ".join([*own, *COLUMNS])
            raise TypeError(f"{owner}: no array {name!r}; there are {names}{_hint(name)}")
    arrays = _expand_columns(own, owner, arrays)
    for name, value in arrays.items():
        if own[name].numel() == 0:
            _refuse_values(owner, name, value)
    replaces_hard, hard = PIN_HARD in arrays, arrays.pop(PIN_HARD, False)
    checked = {name: check_array(owner, name, value, own[name]) for name, value in arrays.items()}
    for name, value in arrays.items():
        if torch.is_grad_enabled() and isinstance(value, Tensor) and value.requires_grad:
            warn_user(
                f"{owner} copies the values of {name}, so gradients do not reach the tensor given. Detach it, or "
                f'pass it per call: torch.func.functional_call(sim, {{"{name}": ...}}, (state,))'
            )
    if "poisson" in checked:
        check_signs(f"{owner}: poisson", checked["poisson"].cpu().double().numpy(), compiled.scene.averaging_groups)
    if "stiffness_damping" in checked:
        _check_damped(owner, checked["stiffness_damping"], compiled.scene)
    if replaces_hard:
        checked[PIN_HARD] = check_pin_hard(owner, hard, own[PIN_HARD])
    hard_of_springs = {PIN_HARD: checked["pin_stiffness"]} if "pin_stiffness" in checked else {}
    check_batches(owner, hard_of_springs | checked, own)
    if "pin_stiffness" in checked:
        checked |= _split_pins(own[PIN_HARD], owner, checked["pin_stiffness"], checked.get(PIN_HARD))
    with persistent_tensors():
        originals = {}
        for name in [name for name in checked if is_parametrized(sim, name)]:
            originals[name], checked[name] = invert_parametrization(owner, sim, name, checked[name])
        reshaped = {name for name, tensor in checked.items() if tensor.shape != own[name].shape}
        replaced = {
            name: tensor.clone()
            if name == PIN_HARD
            else nn.Parameter(tensor.clone(), requires_grad=own[name].requires_grad)
            for name, tensor in checked.items()
            if name not in originals and (assign or name in reshaped)
        }
        new_trainable = [name for name, tensor in replaced.items() if name in reshaped and tensor.requires_grad]
        return MaterialChange(checked, originals, replaced, _updated_plan(compiled, own, checked), new_trainable)


def _refuse_values(owner: str, name: str, value: Tensor | float) -> None:
    """Refuse values of an array without rows, which would have no effect."""
    tensor = value if isinstance(value, Tensor) else None
    if name != PIN_HARD:
        tensor = real_tensor(owner, name, value)
    if tensor is None or tensor.numel() > 0:
        came = repr(value) if tensor is None or tensor.dim() == 0 else list(tensor.shape)
        raise ValueError(f"{owner}: {name} has no rows in this scene, so it must be left out, got {came}{_hint(name)}")


def _check_damped(owner: str, seconds: Tensor, scene: Scene) -> None:
    """Refuse damping of tetrahedra whose solid has none compiled in."""
    given = (seconds.detach().cpu() != 0.0).reshape(-1, seconds.shape[-1]).any(0).numpy()
    bad = np.flatnonzero(given & ~scene.damped_tets)
    if bad.size:
        raise ValueError(
            f"{owner}: stiffness_damping must be 0 in tetrahedra of a solid without it, got another number at "
            f"{int(bad[0])} ({bad.size} in all); give that Solid(stiffness_damping=) a number, too"
        )


def _hint(name: str) -> str:
    """What to do instead of setting an array that a scene lacks, or of which it has no rows."""
    if name == "stiffness":
        return "; it is that of elastic solids. Plastic solids have plastic_youngs, cloth has membrane_youngs"
    if name == "poisson":
        return (
            "; every elastic solid has poisson=0.0, which leaves it out: give Solid(poisson=) another number or an "
            "array. Plastic solids have plastic_poisson"
        )
    if name == "stiffness_damping":
        return "; every solid has stiffness_damping=0.0, which leaves it out: give Solid(stiffness_damping=)"
    if name == "rest_curvature":
        return "; it is 0 in the whole scene, which leaves it out: give a Cloth or a Rod another rest_curvature"
    if name in ("solid_limit", "cloth_limit"):
        part = "solid" if name == "solid_limit" else "cloth"
        return f"; no {part} has a strain_limit, which leaves it out: give {part.title()}(strain_limit=)"
    if name in MATERIAL_ROWS and MATERIAL_ROWS[name].rows == "plastic":
        return "; no solid is plastic, which leaves it out: give Solid(plastic=)"
    if name in MATERIAL_ROWS:
        rows = MATERIAL_ROWS[name].rows
        return f"; the scene has no {name if rows == 'one' else rows}"
    return f"; {SCENE_NAME_HINTS[name]}" if name in SCENE_NAME_HINTS else ""


def write_change(sim: nn.Module, change: MaterialChange) -> None:
    """Write the arrays of a change; the caller replaces the plan."""
    with persistent_tensors():
        for name, tensor in change.arrays.items():
            if name in change.originals:
                parametrization(sim, name).original.copy_(change.originals[name])
            elif name in change.replaced:
                setattr(sim, name, change.replaced[name])
            else:
                getattr(sim, name).copy_(tensor)


def warn_of_new_parameters(change: MaterialChange) -> None:
    """Warn of new parameters that an existing optimiser does not hold."""
    if change.new_trainable:
        warn_user(
            f"the simulator has a new parameter for {' and '.join(change.new_trainable)}, because the batch changed. "
            "An existing optimiser still holds the former one: create the optimiser again, or set the batch first"
        )


def _split_pins(was: Tensor, owner: str, springs: Tensor, hard: Tensor | None) -> dict[str, Tensor]:
    """Split springs into stored values and the mask of hard pins; `was` is the present mask.

    A pin is hard where its spring is inf, or where `hard` says so.
    """
    stored, infinite = split_springs(springs)
    if hard is not None:
        _refuse_pins(f"{owner}: pin_stiffness must be finite where {PIN_HARD} is False, got inf", infinite & ~hard)
        return {"pin_stiffness": stored, PIN_HARD: hard}
    if was.dim() == 2 and was.shape != springs.shape:
        was = was.any(0)
    # sim.pin_stiffness holds 0 at hard pins: scaling it must not release them silently
    _refuse_pins(
        f"{owner}: pin_stiffness is 0 at hard pins, which may mean to keep or to release them. Give inf to keep them "
        f"hard, {PIN_HARD}=False to release them, or {PIN_HARD} of every pin",
        was & (springs == 0.0),
    )
    return {"pin_stiffness": stored, PIN_HARD: infinite}


def _refuse_pins(fault: str, bad: Tensor) -> None:
    if bool(bad.any()):
        places = bad.nonzero()
        raise ValueError(f"{fault}; at {places[0].tolist()} ({len(places)} in all)")


def _updated_plan(compiled: CompiledScene, own: dict[str, Tensor], arrays: dict[str, Tensor]) -> Plan:
    """The plan that suits the material after some arrays are replaced."""
    if "pin_stiffness" not in arrays and PIN_HARD not in arrays:
        return compiled.plan
    now = material_rows(own | arrays)
    plan = plan_after_release(compiled, arrays.get(PIN_HARD, own[PIN_HARD]))
    if not has_preconditioner(plan.arrays):
        return plan
    # pinned vertices are part of the structure of a preconditioner
    held = _hard_everywhere(compiled.material), _hard_everywhere(now)
    if torch.equal(*held) and not has_outliers(plan, now, compiled.time_step):
        return plan
    return plan_for_solver(replace(compiled, plan=plan, material=now))


def _hard_everywhere(material: list[Tensor]) -> Tensor:
    """Whether each pin is hard in all environments [P]."""
    hard = named_material(material)["pin_stiffness"].isinf()
    return hard.all(0) if hard.dim() == 2 else hard


# ---- columns by name: friction, height of grounds, radius of spheres


def _expand_columns(
    own: Mapping[str, Tensor], owner: str, arrays: Mapping[str, Tensor | float]
) -> dict[str, Tensor | float]:
    """Write named columns into whole arrays; the caller checks values."""
    whole = {name: value for name, value in arrays.items() if name not in COLUMNS}
    for name in [name for name in arrays if name in COLUMNS]:
        if given := [array for array in COLUMNS[name] if array in arrays]:
            column = COLUMNS[name][given[0]]
            raise TypeError(f"{owner}: give {name} or {given[0]} (it is column {column} there), got both")
        rows = {array: own[array].shape[-2] for array in COLUMNS[name]}
        value = _column(own["planes"], owner, name, arrays[name], rows)
        for array, part in zip(rows, value.split(list(rows.values()), dim=-1), strict=True):
            if rows[array]:
                now = whole.get(array, own[array].detach())
                assert isinstance(now, Tensor)
                whole[array] = _with_column(owner, name, array, now, part)
    return whole


def _column(like: Tensor, owner: str, name: str, value: Tensor | float, rows: Mapping[str, int]) -> Tensor:
    """Expand a column value to [rows] or [B, rows], in the precision and on the device of `like`."""
    things, count = " and ".join(_OWNERS_OF_ROWS[array] for array in rows), sum(rows.values())
    if count == 0:
        raise ValueError(f"{owner}: {name} belongs to {things}, and the scene has none")
    tensor = real_tensor(owner, name, value)
    if tensor.dim() > 2 or tensor.numel() == 0 or (tensor.dim() > 0 and tensor.shape[-1] not in (1, count)):
        raise ValueError(
            f"{owner}: {name} must be [{count}], or with a batch in front, got {list(tensor.shape)}; {things} of the "
            f"scene: {count}"
        )
    return tensor.to(dtype=like.dtype, device=like.device).expand(*tensor.shape[:-1], count)


def _with_column(owner: str, name: str, array: str, own: Tensor, value: Tensor) -> Tensor:
    """Copy of an array [rows, width], or with a batch, with one column replaced."""
    batches = [len(t) for t, dims in ((own, MATERIAL_ROWS[array].dims), (value, 1)) if t.dim() > dims]
    if len(batches) == 2 and batches[0] != batches[1] and 1 not in batches:
        raise ValueError(
            f"{owner}: {name} must have the {batches[0]} environments of {array}, got {batches[1]}; give {array} "
            "instead"
        )
    if batches:
        own, value = own.expand(max(batches), *own.shape[-2:]), value.expand(max(batches), value.shape[-1])
    column = COLUMNS[name][array]
    return torch.cat([own[..., :column], value[..., None], own[..., column + 1 :]], dim=-1)


# ---- loading


def check_dtype_device(sim: nn.Module, owner: str, arrays: Mapping[str, Any]) -> None:
    """Refuse tensors of another precision or device, which a simulator cannot adopt without a conversion."""
    for name, array in arrays.items():
        own = getattr(sim, name)
        if isinstance(array, Tensor) and (array.dtype, array.device) != (own.dtype, own.device):
            raise TypeError(
                f"{owner}: {name} must be {own.dtype} on {own.device} like the simulator, got {array.dtype} on "
                f"{array.device}; without assign=True it is converted"
            )


def load_material(
    sim: nn.Module,
    state_dict: dict[str, Any],
    prefix: str,
    rest: tuple[Any, ...],
    replace_material: Callable[..., None],
    load: Callable[..., None],
) -> None:
    """Check the material in a state_dict, write it, then call `load`, torch's own loader.

    Takes the arguments of `Module._load_from_state_dict`. Arrays that environments shared may get a batch.
    """
    local_metadata, *_, errors = rest
    assign = bool(local_metadata.get("assign_to_params_buffers", False))
    owner = f"{type(sim).__name__}.load_state_dict"
    arrays = {n: state_dict[prefix + n] for n in named_arrays(sim) if prefix + n in state_dict}
    # former files mark hard pins by inf in pin_stiffness
    older, original = PIN_HARD not in arrays, f"{prefix}parametrizations.pin_stiffness.original"
    try:
        with torch.no_grad():
            if older and original in state_dict and is_parametrized(sim, "pin_stiffness"):
                made = apply_parametrization(sim, "pin_stiffness", state_dict[original])
                arrays |= {"pin_stiffness": made} if bool(made.isinf().any()) else {PIN_HARD: made.isinf()}
            check_saved_shapes(sim, owner, arrays)
            if older and PIN_HARD not in arrays and bool(arrays.get("pin_stiffness", torch.zeros(())).isinf().any()):
                # present files hold no inf: 0 there is a pin that was released
                arrays[PIN_HARD] = arrays["pin_stiffness"].isinf()
            if assign:
                check_dtype_device(sim, owner, arrays)
            elif PIN_HARD in arrays:
                arrays[PIN_HARD] = arrays[PIN_HARD].bool()  # torch converts the other arrays likewise
            replace_material(owner, arrays, assign=assign)
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
            state_dict[prefix + "pin_stiffness"] = named_arrays(sim)["pin_stiffness"].detach()
    load(state_dict, prefix, *rest)


def check_saved_shapes(sim: nn.Module, owner: str, arrays: Mapping[str, Any]) -> None:
    """Refuse shapes that `set_material` would expand: torch would refuse them after writing other arrays."""
    for name, array in arrays.items():
        if not isinstance(array, Tensor):
            raise TypeError(f"{owner}: {name} must be a tensor, got {type(array).__name__}")
        dims = dims_of(name)
        if array.dim() < dims:
            raise ValueError(f"{owner}: {name} must have {dims} or {dims + 1} dimensions, got {list(array.shape)}")
        own = getattr(sim, name).shape
        if expand_rows(name, array, own[-1] if dims else 1).shape != array.shape:
            wanted = list(own[len(own) - dims :])
            raise ValueError(
                f"{owner}: {name} must be {wanted}, or with a batch in front, got {list(array.shape)}; set_material "
                "takes one number for all"
            )


def check_originals(sim: nn.Module, state_dict: Mapping[str, Any]) -> None:
    """Refuse originals of a wrong shape: torch would find them after writing other arrays."""
    own = sim.state_dict()
    for name, array in state_dict.items():
        if not name.startswith("parametrizations.") or name not in own:
            continue
        if not isinstance(array, Tensor) or array.shape != own[name].shape:
            came = list(array.shape) if isinstance(array, Tensor) else type(array).__name__
            raise ValueError(
                f"{type(sim).__name__}.load_state_dict: {name} must be a tensor {list(own[name].shape)}, as in the "
                f"simulator, got {came}"
            )


def check_keys(sim: nn.Module, state_dict: Mapping[str, Any], *, strict: bool) -> None:
    """Refuse an object that is no state_dict or, if `strict`, one with other keys, before anything is loaded."""
    if not isinstance(state_dict, Mapping):
        raise TypeError(
            f"{type(sim).__name__}.load_state_dict: state_dict must be a mapping from state_dict(), got "
            f"{type(state_dict).__name__}"
        )
    # a hook may rename keys
    if strict and not sim._load_state_dict_pre_hooks:
        wanted = sim.state_dict()
        faults = [
            f"{fault} key(s) in state_dict: {', '.join(map(repr, keys))}"
            for fault, keys in (
                # former files have no mask of hard pins
                ("Missing", [key for key in wanted if key not in (*state_dict, PIN_HARD)]),
                ("Unexpected", [key for key in state_dict if key not in wanted]),
            )
            if keys
        ]
        if faults:
            raise RuntimeError(f"{type(sim).__name__}.load_state_dict: nothing is loaded. {'. '.join(faults)}")
