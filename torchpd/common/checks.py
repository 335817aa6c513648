"""Checks of arguments: errors name the argument, the contract and the given value."""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .warn import warn_user

__all__ = [
    "NO_VALUES",
    "STEPS_DIFFER",
    "as_array",
    "check_finite",
    "check_has_values",
    "check_like",
    "check_positive",
    "check_scalar",
    "check_shape",
    "check_target_file",
    "check_vector",
    "check_whole",
    "expand_shared",
    "has_values",
    "optional_module",
    "plain_tensor",
    "tensor_of",
    "to_full_precision",
]

# end of a rollout's errors about its constant forces and targets
STEPS_DIFFER = "; for values that differ between steps, pass a function of the step number"
NO_VALUES = (
    'the simulator is on "meta", where arrays have no values; load them with sim.to_empty(device="cpu") and then '
    "sim.load_state_dict(...)"
)


def check_has_values(name: str, device: torch.device) -> None:
    """Refuse a simulator on "meta", whose arrays have no values."""
    if device.type == "meta":
        raise RuntimeError(f"{name}: {NO_VALUES}")


def optional_module(module: str, package: str, users: str, extra: str = "demo") -> Any:
    """The module of a package that not everybody has, or an error that says what needs it and how it is installed."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise ModuleNotFoundError(f"{users} need {package}: pip install torchpd[{extra}]") from None


def as_array(name: str, value: Any, dtype: Any = None, *, for_picture: bool = False) -> NDArray[Any]:
    """A private contiguous NumPy copy of numbers, sequences, arrays or tensors.

    Warns if the copy cuts off a gradient, except `for_picture`, where nobody expects one.
    """
    if isinstance(value, torch.Tensor):
        if value.requires_grad and torch.is_grad_enabled() and not for_picture:
            warn_user(
                f"{name} is copied, so no gradient reaches the given tensor: pass trained values to calls by "
                "torch.func.functional_call(sim, {...}, (state,)), or detach() it"
            )
        value = value.detach().cpu()
        if value.is_floating_point() and value.element_size() < 4:
            value = value.float()  # NumPy has no bfloat16; nothing is lost
        value = value.numpy()
    try:
        array = np.array(value)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{name} must be numbers in a regular array: {error}") from None
    if array.dtype == np.object_ or array.dtype.kind not in "biuf":
        raise TypeError(f"{name} must hold real numbers, got {array.dtype}")
    return np.ascontiguousarray(array, dtype=dtype) if array.ndim else array.astype(dtype or array.dtype)


def check_shape(name: str, array: NDArray[Any], shape: tuple[int | None, ...], meaning: str) -> None:
    """Check the shape; None stands for any length."""
    matches = array.ndim == len(shape) and all(
        want is None or have == want for have, want in zip(array.shape, shape, strict=True)
    )
    if not matches:
        want = ", ".join("n" if length is None else str(length) for length in shape)
        raise ValueError(f"{name} must be [{want}] ({meaning}), got {list(array.shape)}")


def check_like(name: str, value: Any, positions: torch.Tensor, meaning: str, *, fix: str = "") -> None:
    """Check that a tensor has the shape, precision and device of positions.

    Reads no value, so a GPU is not awaited. `fix` ends the errors about another shape or type.
    """
    like = f"like positions ({meaning}), got"
    if not isinstance(value, torch.Tensor):
        raise TypeError(f"{name} must be a tensor {list(positions.shape)} {like} {type(value).__name__}{fix}")
    if value.dtype != positions.dtype or value.device != positions.device:
        raise TypeError(
            f"{name} must be {positions.dtype} on {positions.device} {like} {value.dtype} on {value.device}"
        )
    if value.shape != positions.shape:
        raise ValueError(f"{name} must be {list(positions.shape)} {like} {list(value.shape)}{fix}")


def tensor_of(array: NDArray[Any]) -> torch.Tensor:
    """A tensor that shares the memory of an array, or a copy if it is empty, which torch.export can save."""
    return torch.from_numpy(np.ascontiguousarray(array)) if array.size else torch.from_numpy(array).clone()


def to_full_precision(value: Any, like: torch.Tensor) -> Any:
    """A half-precision tensor within autocast in the precision of `like`; anything else as it is."""
    half = isinstance(value, torch.Tensor) and value.dtype in (torch.float16, torch.bfloat16) and not value.is_meta
    return value.to(like.dtype) if half and torch.is_autocast_enabled(value.device.type) else value


def expand_shared(value: Any, shape: torch.Size) -> Any:
    """A tensor shared by all environments, [V, 3] or [1, V, 3], as a view [B, V, 3]; anything else as it is."""
    if not isinstance(value, torch.Tensor) or value.shape == shape:
        return value
    return value.expand(shape) if value.shape in (shape[1:], (1, *shape[1:])) else value


def check_finite(name: str, array: NDArray[Any]) -> None:
    """Refuse NaN and infinity."""
    bad = np.flatnonzero(~np.isfinite(array).reshape(-1))
    if bad.size:
        where = [int(i) for i in np.unravel_index(bad[0], array.shape)] if array.ndim else []
        raise ValueError(f"{name} must be finite, got {array.reshape(-1)[bad[0]]} at {where} ({bad.size} in all)")


def check_positive(name: str, array: NDArray[Any], *, unit: str) -> None:
    """Refuse values that are not > 0."""
    bad = np.flatnonzero(~(array > 0))
    if bad.size:
        raise ValueError(f"{name} must be positive [{unit}], got {array[bad[0]]} at {int(bad[0])} ({bad.size} in all)")


def check_scalar(name: str, value: Any, *, minimum: float | None = None) -> float:
    """One finite number, as a float."""
    array = as_array(name, value, np.float64)
    if array.size != 1:
        raise ValueError(f"{name} must be one number, got {list(array.shape)}")
    number = float(array.reshape(()))
    if not np.isfinite(number):
        raise ValueError(f"{name} must be finite, got {number}")
    if minimum is not None and number < minimum:
        raise ValueError(f"{name} must be >= {minimum:g}, got {number}")
    return number


def check_vector(name: str, value: Any) -> NDArray[np.float64]:
    """Three finite numbers, as a read-only array."""
    array = as_array(name, value, np.float64)
    check_shape(name, array, (3,), "a vector")
    check_finite(name, array)
    array.setflags(write=False)
    return array


def check_whole(name: str, value: Any, *, minimum: int, maximum: int | None = None) -> int:
    """One whole number, as an int."""
    try:
        number = int(value)
    except (TypeError, ValueError, OverflowError):
        number = minimum - 1
    if isinstance(value, bool) or number < minimum or number != value:
        raise ValueError(f"{name} must be a whole number >= {minimum}, got {value!r}")
    if maximum is not None and number > maximum:
        raise ValueError(f"{name} must be a whole number <= {maximum:,}, got {value!r}")
    return number


def check_target_file(path: str | os.PathLike[str], name: str = "save") -> Path:
    """The path of a file that can be written or overwritten."""
    target = Path(path)
    if not target.parent.is_dir():
        raise FileNotFoundError(f"{name}: there is no folder {target.parent} for {target.name}")
    if target.is_dir():
        raise IsADirectoryError(f"{name}: path must name a file, got the folder {target}")
    return target


def plain_tensor(tensor: torch.Tensor) -> torch.Tensor:
    """The tensor itself or, under vmap, the whole one with mapped dimensions first."""
    functorch = torch._C._functorch
    mapped = []
    while functorch.is_functorch_wrapped_tensor(tensor):
        mapped.append(functorch.maybe_get_bdim(tensor))
        tensor = functorch.get_unwrapped(tensor)
    for moved, place in enumerate(place for place in reversed(mapped) if place >= 0):
        tensor = tensor.movedim(moved + place, 0)
    return tensor


def has_values(tensor: torch.Tensor) -> bool:
    """Whether the values of a tensor can be read: no subclass, not on "meta"."""
    return type(tensor) in (torch.Tensor, torch.nn.Parameter) and not tensor.is_meta
