"""Material arrays under `torch.nn.utils.parametrize`, such as one stored as its logarithm."""

from __future__ import annotations

import copy
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import ParametrizationList, is_parametrized, type_before_parametrizations

__all__ = ["HostTensor", "apply_parametrization", "invert_parametrization", "parametrization", "plain_copy"]

_Module = TypeVar("_Module", bound=nn.Module)


class HostTensor:
    """A tensor of a module that stays on the host where the module moves, with its gradient."""

    def __init__(self, module: nn.Module, name: str) -> None:
        holder, self._name = module, name
        if is_parametrized(module, name):
            holder, self._name = parametrization(module, name), "original"
        tensors = holder._parameters if self._name in holder._parameters else holder._buffers
        self._tensors: dict[str, Tensor | None] = tensors  # type: ignore[assignment]
        own = tensors[self._name]
        assert own is not None
        self._own, self._values, self._grad = own, own.data, own.grad if own.is_leaf else None

    def restore(self, dtype: torch.dtype) -> None:
        """Put it back after `Module._apply`, in this precision."""
        if isinstance(self._own, nn.Parameter):
            self._own.grad, self._own.data = None, self._values.to(dtype)
            self._own.grad = None if self._grad is None else self._grad.to(dtype)
        else:
            self._tensors[self._name] = self._own.to(dtype)


def parametrization(module: nn.Module, name: str) -> ParametrizationList:
    """The parametrization of an array."""
    found: ParametrizationList = module.parametrizations[name]  # type: ignore[index, assignment]
    return found


def apply_parametrization(module: nn.Module, name: str, original: Tensor) -> Tensor:
    """Apply the parametrization of an array to another original."""
    steps: list[Any] = list(parametrization(module, name))
    for one in steps:
        original = one(original)
    return original


def invert_parametrization(owner: str, module: nn.Module, name: str, wanted: Tensor) -> tuple[Tensor, Tensor]:
    """Original whose parametrization gives `wanted` up to rounding, and the array that it gives. Changes nothing.

    Raises:
        ValueError: another shape; no right_inverse, or one that returns several tensors; or the result differs from
            `wanted`.
    """
    makes, shape = parametrization(module, name), getattr(module, name).shape
    steps: list[Any] = list(makes)
    kind = " and ".join(type(one).__name__ for one in steps)
    if wanted.shape != shape:
        raise ValueError(
            f"{owner}: {name} must keep the shape {list(shape)} of its parametrization {kind}, got "
            f"{list(wanted.shape)}; remove the parametrization first, and register it again for the other batch"
        )
    if not makes.is_tensor or not all(hasattr(one, "right_inverse") for one in steps):
        raise ValueError(
            f"{owner}: {name} has the parametrization {kind} without a right_inverse to one tensor; set "
            f"sim.parametrizations.{name} itself, or remove the parametrization"
        )
    original = wanted.clone()
    for one in reversed(steps):
        original = one.right_inverse(original)
    made = apply_parametrization(module, name, original)
    fits = original.shape == makes.original.shape and made.shape == shape
    if not (fits and torch.allclose(made, wanted, rtol=1e-3, atol=0.0, equal_nan=True)):
        raise ValueError(
            f"{owner}: {name} must be a value of its parametrization {kind}, whose right_inverse does not give it "
            f"back; set sim.parametrizations.{name} itself, or give another value"
        )
    return original, made


def plain_copy(module: _Module) -> _Module:
    """Deep copy with plain arrays, without parametrizations or gradients, so that any value may replace them."""
    with torch.inference_mode(False), torch.no_grad():
        copied = copy.deepcopy(module)
        # a copy compiles without a progress bar
        if "progress" in vars(copied):
            vars(copied)["progress"] = False
        if is_parametrized(copied):
            made: Any = copied.parametrizations
            arrays = {name: getattr(copied, name).detach().clone() for name in made}
            # remove_parametrizations would delete the properties from the class, which the copy shares
            copied.__class__ = type_before_parametrizations(copied)
            del copied.parametrizations
            for name, array in arrays.items():
                copied.register_parameter(name, nn.Parameter(array, requires_grad=False))
        return copied.requires_grad_(False)
