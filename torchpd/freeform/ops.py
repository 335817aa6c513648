"""Python side of the ops of free-form patches: fake kernels, derivatives, vmap rules.

The kernels are in csrc/freeform. The adjoint of each op is an op too, `<name>_vjp`, without a derivative.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..ops import registration as ops  # noqa: F401  (load the extension, register the rules for vmap)
from . import vmap as patch_batching  # noqa: F401  (load the extension, register the rules for vmap)

__all__: list[str] = []

_ops = torch.ops.torchpd
_Lists = Sequence[Tensor]

# ---- fake kernels: shapes, types and devices only


@torch.library.register_fake("torchpd::patch_height")
def _(
    vertices: Tensor,
    directors: Tensor,
    amplitudes: Tensor,
    centres: Tensor,
    factors: Tensor,
    barycentrics: Tensor,
    lists: _Lists,
    **_: Any,
) -> tuple[Tensor, Tensor]:
    samples = barycentrics.shape[0]
    return vertices.new_empty((samples,)), vertices.new_empty((samples, 2))


@torch.library.register_fake("torchpd::patch_height_vjp")
def _(grad_heights: Tensor, grad_slopes: Tensor, heights: Tensor, *inputs: Any, **_: Any) -> tuple[Tensor, ...]:
    return tuple(t.new_empty(t.shape) for t in inputs[:6])


@torch.library.register_fake("torchpd::patch_surface")
def _(
    positions: Tensor,
    frames: Tensor,
    vertices: Tensor,
    directors: Tensor,
    heights: Tensor,
    slopes: Tensor,
    barycentrics: Tensor,
    lists: _Lists,
    **_: Any,
) -> tuple[Tensor, Tensor]:
    shape = (positions.shape[0], barycentrics.shape[0])
    return positions.new_empty((*shape, 3)), positions.new_empty((*shape, 2, 3))


@torch.library.register_fake("torchpd::patch_surface_vjp")
def _(grad_points: Tensor, grad_tangents: Tensor, *inputs: Any, **_: Any) -> tuple[Tensor, ...]:
    return tuple(t.new_empty(t.shape) for t in inputs[:7])


@torch.library.register_fake("torchpd::patch_field")
def _(points: Tensor, *_: Any, **__: Any) -> Tensor:
    return points.new_empty(points.shape[:2])


@torch.library.register_fake("torchpd::patch_field_vjp")
def _(grad: Tensor, *inputs: Any, **_: Any) -> tuple[Tensor, ...]:
    return tuple(t.new_empty(t.shape) for t in inputs[:4])


@torch.library.register_fake("torchpd::patch_deformation")
def _(positions: Tensor, inverse_rest: Tensor, fallback: Tensor | None, constraints: _Lists, **_: Any) -> Tensor:
    return positions.new_empty((positions.shape[0], inverse_rest.shape[0], 3, 3))


@torch.library.register_fake("torchpd::patch_deformation_vjp")
def _(
    grad: Tensor, positions: Tensor, inverse_rest: Tensor, fallback: Tensor | None, constraints: _Lists, **_: Any
) -> tuple[Tensor, Tensor, Tensor]:
    instead = grad.new_empty((0, *grad.shape[1:]) if fallback is None else grad.shape)
    return positions.new_empty(positions.shape), inverse_rest.new_empty(inverse_rest.shape), instead


@torch.library.register_fake("torchpd::patch_frames")
def _(gradients: Tensor, weights: Tensor, lists: _Lists) -> Tensor:
    return gradients.new_empty((gradients.shape[0], lists[6].shape[0] - 1, 3, 3))


@torch.library.register_fake("torchpd::patch_frames_vjp")
def _(grad: Tensor, frames: Tensor, gradients: Tensor, weights: Tensor, lists: _Lists) -> tuple[Tensor, Tensor]:
    return gradients.new_empty(gradients.shape), weights.new_empty(weights.shape)


@torch.library.register_fake("torchpd::patch_surface_rays")
def _(origins: Tensor, directions: Tensor, *inputs: Any, shape: bool, **_: Any) -> tuple[Tensor, ...]:
    positions, rays = inputs[4], origins.shape[1]
    batch, shaped = positions.shape[0], rays if shape else 0
    depth, patch = positions.new_empty((batch, rays)), positions.new_empty((batch, rays), dtype=torch.int32)
    return depth, patch, *(positions.new_empty((batch, count, 3)) for count in (rays, shaped, shaped))


@torch.library.register_fake("torchpd::patch_field_rays")
def _(origins: Tensor, directions: Tensor, positions: Tensor, *_: Any, **__: Any) -> tuple[Tensor, Tensor]:
    shape = (positions.shape[0], origins.shape[1])
    return positions.new_empty(shape), positions.new_empty(shape, dtype=torch.int32)


# ---- derivatives: each is another op


def _wanted(ctx: Any, grads: Sequence[Tensor]) -> tuple[Tensor | None, ...]:
    return tuple(g if needed else None for g, needed in zip(grads, ctx.needs_input_grad, strict=False))


def _save(ctx: Any, inputs: tuple[Any, ...], keyword_only_inputs: dict[str, Any], output: Any) -> None:
    *tensors, ctx.lists = inputs
    ctx.options = keyword_only_inputs
    ctx.save_for_backward(*tensors)


def _save_height(ctx: Any, inputs: tuple[Any, ...], keyword_only_inputs: dict[str, Any], output: Any) -> None:
    *tensors, ctx.lists = inputs
    ctx.options = keyword_only_inputs
    ctx.save_for_backward(output[0], *tensors)


def _save_frames(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    *tensors, ctx.lists = inputs
    ctx.save_for_backward(output, *tensors)


def _height_backward(ctx: Any, grad_heights: Tensor, grad_slopes: Tensor) -> tuple[Any, ...]:
    grads = _ops.patch_height_vjp(grad_heights, grad_slopes, *ctx.saved_tensors, ctx.lists, **ctx.options)
    return *_wanted(ctx, grads), [None] * len(ctx.lists)


def _surface_backward(ctx: Any, grad_points: Tensor, grad_tangents: Tensor) -> tuple[Any, ...]:
    grads = _ops.patch_surface_vjp(grad_points, grad_tangents, *ctx.saved_tensors, ctx.lists, **ctx.options)
    return *_wanted(ctx, grads), [None] * len(ctx.lists)


def _field_backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:
    grads = _ops.patch_field_vjp(grad, *ctx.saved_tensors, ctx.lists, **ctx.options)
    return *_wanted(ctx, grads), [None] * len(ctx.lists)


def _deformation_backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:
    grads = _ops.patch_deformation_vjp(grad, *ctx.saved_tensors, ctx.lists, **ctx.options)
    return *_wanted(ctx, grads), [None] * len(ctx.lists)


def _frames_backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:
    grads = _ops.patch_frames_vjp(grad, *ctx.saved_tensors, ctx.lists)
    return *_wanted(ctx, grads), [None] * len(ctx.lists)


def _no_second_derivative(ctx: Any, *_: Any) -> None:
    raise RuntimeError("torchpd: second derivatives of free-form patches are not provided; detach the first")


def _no_derivative(ctx: Any, *_: Any) -> None:
    raise RuntimeError("torchpd: the ray search has no derivative; PatchRays.cast differentiates its result")


def _save_nothing(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    """Nothing to save."""


def _save_nothing_named(ctx: Any, inputs: tuple[Any, ...], keyword_only_inputs: dict[str, Any], output: Any) -> None:
    """Nothing to save."""


for _name, _backward, _setup in (
    ("height", _height_backward, _save_height),
    ("surface", _surface_backward, _save),
    ("field", _field_backward, _save),
    ("deformation", _deformation_backward, _save),
    ("frames", _frames_backward, _save_frames),
):
    torch.library.register_autograd(f"torchpd::patch_{_name}", _backward, setup_context=_setup)
    torch.library.register_autograd(
        f"torchpd::patch_{_name}_vjp",
        _no_second_derivative,
        setup_context=_save_nothing if _name == "frames" else _save_nothing_named,
    )
for _name in ("surface_rays", "field_rays"):
    torch.library.register_autograd(f"torchpd::patch_{_name}", _no_derivative, setup_context=_save_nothing_named)
