"""Material that `torch.nn.utils.parametrize` makes of something else, for one of its logarithm."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import ParametrizationList

__all__ = ["invert", "parametrization"]


def parametrization(module: nn.Module, name: str) -> ParametrizationList:
    """What makes a parametrized array."""
    found: ParametrizationList = module.parametrizations[name]  # type: ignore[index, assignment]
    return found


def invert(module: nn.Module, name: str, wanted: Tensor) -> tuple[Tensor, Tensor]:
    """What to make an array of, and what that makes: `wanted`, up to rounding. Nothing is changed.

    Raises:
        ValueError: another shape, no right_inverse, one that gives several tensors, or one that does not give it back.
    """
    makes, shape = parametrization(module, name), getattr(module, name).shape
    steps: list[Any] = list(makes)
    kind = " and ".join(type(one).__name__ for one in steps)
    if wanted.shape != shape:
        raise ValueError(
            f"set_material: {name} is made by the parametrization {kind}, of {list(shape)}, and keeps its shape, got "
            f"{list(wanted.shape)}: take the parametrization away first, and put it back for the other batch"
        )
    if not makes.is_tensor or not all(hasattr(one, "right_inverse") for one in steps):
        raise ValueError(
            f"set_material: {name} is made by the parametrization {kind}, which has no right_inverse to say of what "
            f"one tensor: set sim.parametrizations.{name} itself, or take the parametrization away"
        )
    original = wanted.clone()
    for one in reversed(steps):
        original = one.right_inverse(original)
    made: Tensor = original
    for one in steps:
        made = one(made)
    fits = original.shape == makes.original.shape and made.shape == shape
    if not (fits and torch.allclose(made, wanted, rtol=1e-3, atol=0.0, equal_nan=True)):
        raise ValueError(
            f"set_material: the parametrization {kind} of {name} makes other numbers of what its right_inverse gives "
            f"than these: set sim.parametrizations.{name} itself, or give it what it can make"
        )
    return original, made
