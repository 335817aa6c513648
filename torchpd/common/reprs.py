"""Short reprs of values that hold arrays: one line, with sizes in place of numbers."""

from __future__ import annotations

import inspect
from dataclasses import fields
from typing import Any

import numpy as np
from torch import Tensor

__all__ = ["by_fields", "by_sizes"]

_NONE = object()  # no default
_FEW = 6  # numbers of an array that are printed


def by_sizes(value: object, tensor: Any, *names: str, trailing: int = 1, more: str = "") -> str:
    """`State(batch=32, vertices=4096, float32, cpu)`: a value by the shape of one of its tensors.

    Args:
        value: the value to print.
        tensor: one of its tensors; anything else is printed as it is.
        names: of the dimensions; leading ones may be absent.
        trailing: number of further dimensions, the components of a vector.
        more: text after the sizes.
    """
    kind = type(value).__name__
    if not isinstance(tensor, Tensor):
        return f"{kind}({tensor!r}, ...)"
    shape = tensor.shape[: tensor.dim() - trailing]
    sizes = [f"{name}={length}" for name, length in zip(names[len(names) - len(shape) :], shape, strict=False)]
    return f"{kind}({', '.join([*sizes, *([more] if more else []), _precision(tensor), str(tensor.device)])})"


def by_fields(value: Any) -> str:
    """`Ground(height=0.0, normal=[0.0, 1.0, 0.0], friction=0.5)`: a dataclass, long arrays by precision and shape.

    Keyword-only arguments at their defaults are left out.
    """
    usual = {
        name: argument.default
        for name, argument in inspect.signature(type(value)).parameters.items()
        if argument.kind is argument.KEYWORD_ONLY
    }
    own = {field.name: getattr(value, field.name) for field in fields(value)}
    words = [f"{name}={_in_short(item)}" for name, item in own.items() if not _is_usual(item, usual.get(name, _NONE))]
    return f"{type(value).__name__}({', '.join(words)})"


def _is_usual(item: object, default: object) -> bool:
    return item is default or (isinstance(item, (str, float)) and isinstance(default, type(item)) and item == default)


def _in_short(value: object) -> str:
    if isinstance(value, np.ndarray) and value.size:
        if value.size <= _FEW:
            return str(value.tolist())
        if value.ndim == 1 and value.dtype.kind == "f" and value.min() == value.max():
            return f"{value[0]:g}"  # one number for all elements
    return f"{_precision(value)} {list(value.shape)}" if isinstance(value, np.ndarray | Tensor) else repr(value)


def _precision(array: Any) -> str:
    return str(array.dtype).removeprefix("torch.")
