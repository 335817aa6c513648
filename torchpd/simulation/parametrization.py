"""Material that `torch.nn.utils.parametrize` makes of something else, for one of its logarithm."""

from __future__ import annotations

import copy
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import ParametrizationList, is_parametrized, type_before_parametrizations

__all__ = ["invert", "make", "parametrization", "plain_copy"]

_Module = TypeVar("_Module", bound=nn.Module)


def parametrization(module: nn.Module, name: str) -> ParametrizationList:
    """What makes a parametrized array."""
    found: ParametrizationList = module.parametrizations[name]  # type: ignore[index, assignment]
    return found


def make(module: nn.Module, name: str, original: Tensor) -> Tensor:
    """What a parametrization makes of another original than its own."""
    steps: list[Any] = list(parametrization(module, name))
    for one in steps:
        original = one(original)
    return original


def invert(owner: str, module: nn.Module, name: str, wanted: Tensor) -> tuple[Tensor, Tensor]:
    """What to make an array of, and what that makes: `wanted`, up to rounding. Nothing is changed.

    Raises:
        ValueError: another shape, no right_inverse, one that gives several tensors, or one that does not give it back.
    """
    makes, shape = parametrization(module, name), getattr(module, name).shape
    steps: list[Any] = list(makes)
    kind = " and ".join(type(one).__name__ for one in steps)
    if wanted.shape != shape:
        raise ValueError(
            f"{owner}: {name} is made by the parametrization {kind}, of {list(shape)}, and keeps its shape, got "
            f"{list(wanted.shape)}: take the parametrization away first, and put it back for the other batch"
        )
    if not makes.is_tensor or not all(hasattr(one, "right_inverse") for one in steps):
        raise ValueError(
            f"{owner}: {name} is made by the parametrization {kind}, which has no right_inverse to say of what "
            f"one tensor: set sim.parametrizations.{name} itself, or take the parametrization away"
        )
    original = wanted.clone()
    for one in reversed(steps):
        original = one.right_inverse(original)
    made = make(module, name, original)
    fits = original.shape == makes.original.shape and made.shape == shape
    if not (fits and torch.allclose(made, wanted, rtol=1e-3, atol=0.0, equal_nan=True)):
        raise ValueError(
            f"{owner}: the parametrization {kind} of {name} makes other numbers of what its right_inverse gives "
            f"than these: set sim.parametrizations.{name} itself, or give it what it can make"
        )
    return original, made


def plain_copy(module: _Module) -> _Module:
    """A deep copy whose arrays are numbers, which nothing makes and nobody learns: any others may replace them."""
    with torch.inference_mode(False), torch.no_grad():
        copied = copy.deepcopy(module)
        # what a copy compiles is nobody's to wait for
        if "progress" in vars(copied):
            vars(copied)["progress"] = False
        if is_parametrized(copied):
            made: Any = copied.parametrizations
            arrays = {name: getattr(copied, name).detach().clone() for name in made}
            # remove_parametrizations would take the properties from the class, which the copy shares with the module
            copied.__class__ = type_before_parametrizations(copied)
            del copied.parametrizations
            for name, array in arrays.items():
                copied.register_parameter(name, nn.Parameter(array, requires_grad=False))
        return copied.requires_grad_(False)
