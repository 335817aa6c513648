"""The material arrays of a simulator: initial values, shapes and checks."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ..common.tables import HISTORY_ROWS, MATERIAL_TABLE, PLANES, SPHERES, MaterialRow
from ..scene.pins import PIN_HARD, hold_exactly, split_springs
from ..scene.scene import SceneValues

__all__ = [
    "CORE_ROWS",
    "HISTORY_PLACES",
    "LOAD_ROWS",
    "MATERIAL_ROWS",
    "SCENE_NAME_HINTS",
    "check_array",
    "check_batches",
    "check_environments",
    "check_material",
    "check_pin_hard",
    "dims_of",
    "effect_rows",
    "environments_of_material",
    "expand_rows",
    "fingerprint",
    "material_of",
    "material_rows",
    "named_arrays",
    "ops_names",
    "real_tensor",
    "with_absent",
]

# arrays of loads, from which a step computes forces before it calls an op; only some scenes have them
LOAD_ROWS = (
    MaterialRow("pressure", 1, "pressure", "overpressure at the rest volume [Pa]", True),
    MaterialRow("wind", 3, "one", "velocity of the wind [m/s]", True),
)
MATERIAL_ROWS = {row.name: row for row in (*MATERIAL_TABLE, *LOAD_ROWS)}
CORE_ROWS = tuple(row.name for row in MATERIAL_TABLE if not row.effect)  # arrays that every scene has
HISTORY_PLACES = tuple(MATERIAL_TABLE.index(row) for row in HISTORY_ROWS)  # in the material of the ops
# hints for names of scene arguments given to `set_material`
SCENE_NAME_HINTS = {
    "activation": "it is an input of steps, targets={fibres: activation}; fibre_length is 1 - contraction activation",
    "area_density": "masses holds the mass of each vertex [kg], area_density times its share of the area",
    "density": "masses holds the mass of each vertex [kg], density times its share of the volume",
    "youngs": "stiffness holds Young's modulus of each tetrahedron [Pa]",
}

_POSITIVE = ("stiffness", "masses", "membrane_youngs", "thickness", "plastic_youngs", "yield_strain")
_NOT_NEGATIVE = (
    "bending", "rest_curvature", "spring_stiffness", "rest_length", "tie_stiffness", "fibre_stiffness", "fibre_length",
    "thread_stiffness", "stiffness_damping", "hardening", "creep_time",
)  # fmt: skip
_LIMITS = ("solid_limit", "cloth_limit")
_POISSON = ("poisson", "plastic_poisson")
_UNIT_SLACK = 1e-4  # tolerance on the length of a plane normal: float32 rounding, and that of a training step


def material_of(values: SceneValues, dtype: torch.dtype) -> dict[str, Tensor]:
    """Material arrays of a scene by name, as `named_arrays`, in the simulation precision; checked after rounding."""
    at_rest = MATERIAL_ROWS["spheres"].width - values.spheres.shape[1]
    spheres = np.pad(values.spheres, ((0, 0), (0, at_rest)))
    material = {
        name: torch.tensor(spheres if name == "spheres" else getattr(values, name), dtype=dtype) for name in CORE_ROWS
    }
    others = effect_rows(values) | _load_rows(values)
    material |= {name: torch.tensor(row, dtype=dtype) for name, row in others.items()}
    soft = torch.isfinite(torch.from_numpy(values.pin_stiffness.copy()))
    if not bool(torch.isfinite(material["pin_stiffness"])[soft].all()):
        raise ValueError(
            f"Pin.stiffness must be finite in {dtype}, got inf after rounding; leave stiffness out for hard pins"
        )
    for name, tensor in material.items():
        check_material("Simulator", name, tensor)
    material["pin_stiffness"], material[PIN_HARD] = split_springs(material["pin_stiffness"])
    return material


def effect_rows(values: SceneValues) -> dict[str, NDArray[np.float64]]:
    """Arrays of a scene that only some scenes have, in the order of the table."""
    of_tets = {"poisson": values.poisson, "stiffness_damping": values.stiffness_damping}
    found = {name: row for name, row in of_tets.items() if row is not None}
    for group in values.stencils:
        found |= group.trainable
    return {row.name: found[row.name] for row in MATERIAL_TABLE if row.name in found}


def _load_rows(values: SceneValues) -> dict[str, NDArray[np.float64]]:
    """Arrays of the loads that a scene has, in the order of the table."""
    found = {row.name: getattr(values, row.name) for row in LOAD_ROWS}
    return {name: row for name, row in found.items() if row is not None}


def dims_of(name: str) -> int:
    """Number of dimensions of an array without a batch."""
    return 1 if name == PIN_HARD else MATERIAL_ROWS[name].dims


def named_arrays(sim: nn.Module) -> dict[str, Tensor]:
    """Material arrays of a simulator by name: the trainable ones and the mask of hard pins."""
    return {name: getattr(sim, name) for name in (*vars(sim)["material_names"], PIN_HARD)}


def material_rows(arrays: Mapping[str, Tensor]) -> list[Tensor]:
    """Rows of the material in the order of the ops, from the arrays by name."""
    held = {"pin_stiffness": hold_exactly(arrays["pin_stiffness"], arrays[PIN_HARD])}
    names = ops_names(arrays)
    return with_absent([held.get(name, arrays[name]) for name in names], names)


def ops_names(names: Iterable[str]) -> tuple[str, ...]:
    """The arrays that the ops read, of those of a simulator."""
    others = {PIN_HARD, *(row.name for row in LOAD_ROWS)}
    return tuple(name for name in names if name not in others)


def with_absent(arrays: list[Tensor], names: Iterable[str]) -> list[Tensor]:
    """The material of the ops: an effect that the scene lacks is an empty array, if the scene has another one."""
    by_name = dict(zip(names, arrays, strict=True))
    if len(by_name) == len(CORE_ROWS):
        return arrays
    return [
        by_name[row.name] if row.name in by_name else arrays[0].new_empty(0 if row.width == 1 else (0, row.width))
        for row in MATERIAL_TABLE
    ]


def _require(good: Tensor, name: str, contract: str, tensor: Tensor) -> None:
    if bool(good.all()):
        return
    bad = good.logical_not().nonzero()
    place = bad[0].tolist()
    where = f" at {place} ({len(bad)} in all)" if place else ""
    raise ValueError(f"{name} must be {contract} in {tensor.dtype}, got {tensor[tuple(place)].cpu().numpy()}{where}")


def check_material(owner: str, name: str, tensor: Tensor) -> None:
    """Refuse values that a step cannot use; the caller checks shapes."""
    full = f"{owner}: {name}"
    if name == "pin_stiffness":
        _require(tensor >= 0, full, ">= 0, inf for pins that hold exactly,", tensor)
        return
    if name == "max_flow":
        _require(tensor > 0, full, "positive, inf for no bound,", tensor)
        return
    _require(tensor.isfinite(), full, "finite", tensor)
    if name in _POSITIVE:
        _require(tensor > 0, full, "positive", tensor)
    elif name in _NOT_NEGATIVE:
        _require(tensor >= 0, full, ">= 0", tensor)
    elif name == "membrane_poisson":
        _require((tensor > -1) & (tensor < 1), full, "in (-1, 1)", tensor)
    elif name in _POISSON:
        _require((tensor > -1) & (tensor < 0.495), full, "in (-1, 0.495)", tensor)
    elif name == "damping":
        _require(tensor >= 0, full, ">= 0", tensor)
    elif name in _LIMITS:
        low, high, stiffness = tensor.unbind(-1)
        _require((low >= 0) & (low <= 1), f"{full}: lo (column 0)", "in [0, 1]", low)
        _require(high >= 1, f"{full}: hi (column 1)", "at least 1", high)
        _require(stiffness >= 0, f"{full}: stiffness (column 2)", ">= 0", stiffness)
    elif name == "flow":
        plastic = tensor[..., :9].unflatten(-1, (3, 3))
        _require(torch.linalg.det(plastic) > 0, f"{full}: Fp (columns 0 to 8)", "of positive determinant", tensor)
    elif name == "planes":
        lengths = tensor[..., PLANES["normal"]].norm(dim=-1)
        _require((lengths - 1).abs() <= _UNIT_SLACK, f"{full}: the normal (columns 0 to 2)", "of unit length", tensor)
        friction = PLANES["friction"]
        _require(tensor[..., friction] >= 0, f"{full}: friction (column {friction})", ">= 0", tensor)
    elif name == "spheres":
        radius, friction = SPHERES["radius"], SPHERES["friction"]
        _require(tensor[..., radius] > 0, f"{full}: the radius (column {radius})", "positive", tensor)
        _require(tensor[..., friction] >= 0, f"{full}: friction (column {friction})", ">= 0", tensor)


def real_tensor(owner: str, name: str, value: Tensor | float) -> Tensor:
    """Convert to a dense tensor of real numbers, on the CPU if it is not a tensor yet."""
    # torch would round a Python number to its default precision
    wide = torch.float64 if isinstance(value, float) else None
    try:
        tensor = value if isinstance(value, Tensor) else torch.as_tensor(value, dtype=wide, device="cpu")
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"{owner}: {name} must be a number or a tensor, got {value!r}") from None
    if tensor.is_complex() or tensor.dtype == torch.bool:
        raise TypeError(f"{owner}: {name} must hold real numbers, got {tensor.dtype}")
    if tensor.layout != torch.strided or tensor.is_meta:
        raise TypeError(f"{owner}: {name} must be dense and have values, got {tensor.layout} on {tensor.device}")
    return tensor


def expand_rows(name: str, tensor: Tensor, rows: int) -> Tensor:
    """Expand one number, [] or [1], to [rows], and one per environment, [B, 1], to [B, rows].

    The last dimension always counts rows: [n] is one number for each of n rows, never for each of n environments. Only
    an array without rows, `damping`, has one number for each environment: [B], or [B, 1].
    """
    if tensor.dim() > 2 or (name in MATERIAL_ROWS and MATERIAL_ROWS[name].width > 1):
        return tensor
    if dims_of(name) == 0:
        return tensor.squeeze(-1) if tensor.dim() == 2 else tensor
    one = tensor.dim() == 0 or tensor.shape[-1] == 1
    return tensor.expand(*tensor.shape[:-1], rows) if one else tensor


def check_array(owner: str, name: str, value: Tensor | float, own: Tensor) -> Tensor:
    """Check a value for the material array `own`; returns it in the precision and on the device of `own`."""
    row, tensor = MATERIAL_ROWS[name], real_tensor(owner, name, value).detach()
    tensor = tensor.to(dtype=own.dtype, device=own.device)
    shape = tuple(own.shape[own.dim() - row.dims :])
    alone = tensor.dim() == 0
    tensor = expand_rows(name, tensor, shape[0] if shape else 1)
    if tuple(tensor.shape) != shape and tuple(tensor.shape[1:]) != shape:
        came = f"one number, {tensor.item():g}" if alone else list(tensor.shape)
        irregular = {"tet": "tetrahedra", "vertex": "vertices", "plastic": "plastic tetrahedra"}
        things = irregular.get(row.rows, f"{row.rows}s")
        scene = "" if row.rows == "one" else f"; {things} of the scene: {shape[0]}"
        raise ValueError(f"{owner}: {name} must be {list(shape)}, or with a batch in front, got {came}{scene}")
    check_material(owner, name, tensor)
    return tensor.contiguous()


def check_pin_hard(owner: str, value: Tensor | float, own: Tensor) -> Tensor:
    """Check a value for the mask of hard pins `own`; returns it on the device of `own`."""
    try:
        tensor = value if isinstance(value, Tensor) else torch.as_tensor(value, device="cpu")
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"{owner}: {PIN_HARD} must be a bool or a bool tensor, got {value!r}") from None
    if tensor.dtype != torch.bool:
        raise TypeError(f"{owner}: {PIN_HARD} must be bool for each pin, got {tensor.dtype}")
    tensor = tensor.to(own.device)
    shape = own.shape[-1:]
    tensor = expand_rows(PIN_HARD, tensor, shape[0])
    if tensor.dim() > 2 or tensor.shape[-1:] != shape:
        raise ValueError(
            f"{owner}: {PIN_HARD} must be one bool, {list(shape)}, [B, 1] or [B, {shape[0]}], got "
            f"{list(tensor.shape)}; pins of the scene: {shape[0]}"
        )
    return tensor.contiguous()


def fingerprint(arrays: Iterable[Tensor]) -> str:
    """Hash of the shapes and bits of arrays. Copies them to the CPU."""
    found = hashlib.blake2b(digest_size=16)
    for array in arrays:
        found.update(repr(tuple(array.shape)).encode())
        found.update(array.detach().cpu().contiguous().numpy().tobytes())
    return found.hexdigest()


def check_batches(owner: str, new: Mapping[str, Tensor], kept: Mapping[str, Tensor]) -> None:
    """Refuse arrays with different numbers of environments; an array without a batch, or with 1, suits any number."""
    first: tuple[int, str] | None = None
    for name in kept:
        array, stays = new.get(name, kept[name]), "" if name in new else " (kept)"
        count = len(array) if array.dim() > dims_of(name) else 1
        if count == 0:
            raise ValueError(f"{owner}: {name} must have at least one environment, got {list(array.shape)}")
        if first is not None and count not in (1, first[0]):
            raise ValueError(
                f"{owner}: arrays must have one number of environments or none, got {first[0]} environments in "
                f"{first[1]} and {count} in {name}{stays}; replace them in one call"
            )
        if count != 1:
            first = count, name + stays


def check_environments(name: str, batch: int, arrays: Mapping[str, Tensor]) -> None:
    """Refuse a state whose batch differs from that of the material; `name` names the state in the error."""
    for row, array in arrays.items():
        if array.dim() > dims_of(row) and len(array) not in (1, batch):
            raise ValueError(
                f"{name} must have as many environments as the simulator's {row}, {len(array)}, got {batch}; replace "
                f"{row} by set_material, for this batch or shared by all environments"
            )


def environments_of_material(arrays: Mapping[str, Tensor]) -> int:
    """Number of environments of the material arrays by name; 1 where all share them."""
    return max(len(array) if array.dim() > dims_of(name) else 1 for name, array in arrays.items())
