"""The refusal of gradients of steps in which colliders have a mass."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

__all__ = ["refuse_gradients"]


class _Refused(torch.autograd.Function):
    """Passes tensors on, and refuses their gradients."""

    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> tuple[Tensor, ...]:
        return tuple(tensor.view_as(tensor) for tensor in tensors)

    @staticmethod
    def backward(ctx: Any, *_: Any) -> Any:
        raise RuntimeError(
            "gradients of a step must not be asked where a Collider has a mass, got backward() through one; give the "
            "Collider mass=None and its pose as a target, or detach() the state (docs/limits.md)"
        )


def refuse_gradients(*tensors: Tensor) -> tuple[Tensor, ...]:
    """The same tensors, whose backward pass raises."""
    found: tuple[Tensor, ...] = _Refused.apply(*tensors)  # type: ignore[no-untyped-call]
    return found
