"""Python side of the ops: fake kernels and derivatives. Importing this module loads the extension."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.utils._pytree import tree_leaves

from .adjoint import mend_adjoint
from .batching import rollout_vjp_rule, step_vjp_rule
from .tables import MATERIAL_TABLE
from .vmap_rules import register_rule

__all__ = ["INFO_WIDTH", "nearest_rotation", "refuse_tangents"]

INFO_WIDTH = 7

_ops = torch.ops.torchpd


def nearest_rotation(F: Tensor) -> Tensor:
    """The rotation R nearest to each matrix: argmax of tr(R^T F) over det R = +1.

    Safe for inverted, rank-deficient, huge and tiny matrices: zero gives the identity, a matrix with NaN or infinity
    gives NaN. Differentiable, of matrices of 1e-12 to 1e12 (in float64 1e-101 to 1e101), infinitely steep where the two
    smallest singular values cancel (with the sign of det F on the smallest): there the nearest rotation jumps.

    Largest root of Davenport's quartic (Markley 1993), closed form, one Newton polish; signed SVD where roots meet.

    Args:
        F: float32 or float64 [..., 3, 3].

    Returns:
        [..., 3, 3].
    """
    if not isinstance(F, Tensor):
        raise TypeError(f"nearest_rotation: F must be a tensor [..., 3, 3], got {type(F).__name__}")
    refuse_tangents(F)
    result: Tensor = _ops.nearest_rotation(F)
    return result


def refuse_tangents(*tensors: Tensor | None) -> None:
    """The ops have no forward-mode derivatives, and torch would take them to be zero."""
    if forward_ad._current_level < 0:
        return
    for tensor in tensors:
        if tensor is not None and forward_ad.unpack_dual(tensor).tangent is not None:
            raise RuntimeError(
                "torchpd: forward-mode derivatives are not provided; use reverse mode (backward, torch.autograd.grad)"
            )


# ---- fake kernels: shapes, types and devices only


def _register_fake(name: str) -> Callable[[Callable[..., Any]], None]:
    """Torch also takes a fake kernel where one argument of several is on "meta", and would return unwritten memory."""

    def register(kernel: Callable[..., Any]) -> None:
        def checked(first: Tensor, *others: Any, **settings: Any) -> Any:
            kinds = {leaf.device.type for leaf in tree_leaves(others) if isinstance(leaf, Tensor)}
            if first.device.type != "meta" and "meta" in kinds:
                raise RuntimeError(
                    f"torchpd::{name}: arguments must be on one device, got some on {first.device} and some on "
                    '"meta", where tensors have no values'
                )
            return kernel(first, *others, **settings)

        torch.library.register_fake(f"torchpd::{name}", checked)

    return register


@_register_fake("step")
def _(positions: Tensor, velocities: Tensor, *_: Any, **__: Any) -> tuple[Tensor, Tensor, Tensor]:
    info = positions.new_empty((positions.shape[0], INFO_WIDTH), dtype=torch.float64)
    return positions.new_empty(positions.shape), positions.new_empty(velocities.shape), info


@_register_fake("step_")
def _(*_: Any, **__: Any) -> None:
    return None


@_register_fake("rollout")
def _(positions: Tensor, *_: Any, steps: int, every: int, **__: Any) -> tuple[Tensor, Tensor, Tensor]:
    shape = (steps // every, *positions.shape)
    info = positions.new_empty((*shape[:2], INFO_WIDTH), dtype=torch.float64)
    return positions.new_empty(shape), positions.new_empty(shape), info


@_register_fake("gradient")
def _(positions: Tensor, stiffness: Tensor, plan: Sequence[Tensor]) -> Tensor:
    return positions.new_empty(positions.shape)


@_register_fake("hessian_product")
def _(positions: Tensor, direction: Tensor, stiffness: Tensor, plan: Sequence[Tensor]) -> Tensor:
    return positions.new_empty(positions.shape)


@_register_fake("element_energy")
def _(positions: Tensor, stiffness: Tensor, plan: Sequence[Tensor]) -> Tensor:
    return positions.new_empty((positions.shape[0], stiffness.shape[-1]))


@_register_fake("element_energy_product")
def _(positions: Tensor, direction: Tensor, stiffness: Tensor, plan: Sequence[Tensor]) -> Tensor:
    return positions.new_empty((positions.shape[0], stiffness.shape[-1]))


@_register_fake("elastic_diagonal")
def _(stiffness: Tensor, plan: Sequence[Tensor], *, weighted: bool) -> Tensor:
    _, vertex_order, *_ = plan
    return stiffness.new_empty((*stiffness.shape[:-1], vertex_order.shape[0]))


@_register_fake("precondition")
def _(field: Tensor, plan: Sequence[Tensor]) -> Tensor:
    return field.new_empty(field.shape)


@_register_fake("adjoint_system")
def _(*step: Any, time_step: float) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    _, _, _, positions, _, _, material, _ = step
    batch, vertices, _ = positions.shape
    rows = list(zip(MATERIAL_TABLE, material, strict=True))
    touching = any(row.name in ("planes", "spheres") and array.shape[-2] > 0 for row, array in rows)
    # those that inertia and diagonal come from
    own = touching or any(
        row.name in ("stiffness", "masses", "damping", "pin_stiffness")
        and array.dim() > row.dims
        and len(array) != 1
        and array.shape[1:].numel() > 0
        for row, array in rows
    )
    inertia, inverse = (positions.new_empty((batch if own else 1, vertices)) for _ in range(2))
    held = batch if touching else 0
    projector = positions.new_empty((held, vertices, 3, 3))
    stuck = positions.new_empty((held, vertices), dtype=torch.bool)
    sliding = positions.new_empty((held, vertices, 5, 3))
    return positions.new_empty(positions.shape), inertia, inverse, projector, stuck, sliding


@_register_fake("contact_gradients")
def _(multiplier: Tensor, *step: Any, time_step: float) -> tuple[Tensor, Tensor]:
    material = dict(zip((row.name for row in MATERIAL_TABLE), step[-2], strict=True))
    planes, spheres = (material[name] for name in ("planes", "spheres"))
    batch = multiplier.shape[0]
    return multiplier.new_empty((batch, planes.shape[-2], 5)), multiplier.new_empty((batch, spheres.shape[-2], 8))


@_register_fake("conjugate_gradients")
def _(positions: Tensor, *_: Any, **__: Any) -> tuple[Tensor, Tensor]:
    return positions.new_empty(positions.shape), positions.new_empty(positions.shape[:1], dtype=torch.float64)


@_register_fake("mend_adjoint")
def _(solution: Tensor, *_: Any, **__: Any) -> Tensor:
    return solution.new_empty(solution.shape)


def _fake_vjp(*call: Any, time_step: float, wanted: Sequence[bool] | None = None) -> list[Tensor]:
    *_, positions, _, _, material, _ = call
    state = [positions.new_empty(positions.shape) for _ in range(3)]
    asked = zip(material, [True] * len(material) if wanted is None else wanted, strict=True)
    return [*state, *(array.new_empty(array.shape) for array, own in asked if own)]


for _name in ("step_vjp", "rollout_vjp"):
    _register_fake(_name)(_fake_vjp)


@_register_fake("adjoint_result")
def _(multiplier: Tensor, *_: Any, **__: Any) -> tuple[Tensor, Tensor, Tensor]:
    x, v, out = (multiplier.new_empty(multiplier.shape) for _ in range(3))
    return x, v, out


@_register_fake("conjugate_gradients_")
def _(*_: Any, **__: Any) -> None:
    return None


@_register_fake("nearest_rotation")
def _(matrices: Tensor) -> Tensor:
    return matrices.new_empty(matrices.shape)


@_register_fake("rotation_differential")
def _(matrices: Tensor, direction: Tensor) -> Tensor:
    return matrices.new_empty(matrices.shape)


# ---- kernels


@torch.library.impl("torchpd::mend_adjoint", ("cpu", "cuda"))
def _(*args: Any, time_step: float) -> Tensor:
    return mend_adjoint(*args, time_step=time_step)


# ---- derivatives: each is another op


def _save(*names: str) -> Callable[..., None]:
    """A setup_context that saves the named inputs: by position, tensors first, the plan last."""

    def setup(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.save_for_backward(*inputs[: len(names)])
        ctx.plan = inputs[len(names)] if len(inputs) > len(names) else None

    return setup


def _like_stiffness(per_environment: Tensor, stiffness: Tensor) -> Tensor:
    """The derivative for a stiffness that all environments share is the sum over them."""
    return per_environment.sum(0) if stiffness.dim() == 1 else per_environment.sum_to_size(stiffness.shape)


def _unit(stiffness: Tensor) -> Tensor:
    return torch.ones_like(stiffness)


def _for_plan(ctx: Any) -> list[None]:
    """The plan has no derivative; autograd wants to hear so for every array of it."""
    return [None] * len(ctx.plan)


def _element_energy_backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None, list[None]]:
    positions, stiffness = ctx.saved_tensors
    x = w = None
    if ctx.needs_input_grad[0]:
        x = _ops.gradient(positions, grad * stiffness, ctx.plan)
    if ctx.needs_input_grad[1]:
        w = _like_stiffness(grad * _ops.element_energy(positions, _unit(stiffness), ctx.plan), stiffness)
    return x, w, _for_plan(ctx)


def _gradient_backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None, list[None]]:
    positions, stiffness = ctx.saved_tensors
    x = w = None
    if ctx.needs_input_grad[0]:
        x = _ops.hessian_product(positions, grad, stiffness, ctx.plan)
    if ctx.needs_input_grad[1]:
        w = _like_stiffness(_ops.element_energy_product(positions, grad, _unit(stiffness), ctx.plan), stiffness)
    return x, w, _for_plan(ctx)


def _element_energy_product_backward(
    ctx: Any, grad: Tensor
) -> tuple[Tensor | None, Tensor | None, Tensor | None, list[None]]:
    positions, direction, stiffness = ctx.saved_tensors
    x = d = w = None
    if ctx.needs_input_grad[0]:
        x = _ops.hessian_product(positions, direction, grad * stiffness, ctx.plan)
    if ctx.needs_input_grad[1]:
        d = _ops.gradient(positions, grad * stiffness, ctx.plan)
    if ctx.needs_input_grad[2]:
        product = _ops.element_energy_product(positions, direction, _unit(stiffness), ctx.plan)
        w = _like_stiffness(grad * product, stiffness)
    return x, d, w, _for_plan(ctx)


def _hessian_product_backward(ctx: Any, grad: Tensor) -> tuple[None, Tensor | None, None, list[None]]:
    if ctx.needs_input_grad[0] or ctx.needs_input_grad[2]:
        raise RuntimeError(
            "torchpd: third derivatives of the elastic energy are not provided; detach positions and stiffness before "
            "differentiating a Hessian-vector product"
        )
    positions, _, stiffness = ctx.saved_tensors
    return None, _ops.hessian_product(positions, grad, stiffness, ctx.plan), None, _for_plan(ctx)


def _save_nothing(ctx: Any, inputs: tuple[Any, ...], keyword_only_inputs: dict[str, Any], output: Any) -> None:
    """Nothing to save."""


def _diagonal_backward(ctx: Any, grad: Tensor) -> tuple[None, None]:
    raise RuntimeError("torchpd: the elastic diagonal, a preconditioner, has no derivative; detach stiffness")


def _precondition_setup(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    ctx.plan = inputs[1]


def _precondition_backward(ctx: Any, grad: Tensor) -> tuple[Tensor, list[None]]:
    # it is linear and symmetric
    return _ops.precondition(grad, ctx.plan), _for_plan(ctx)


def _rotation_differential(F: Tensor, direction: Tensor) -> Tensor:
    """dR along dF from torch operations, R [h]_x with (tr(S) I - S) h = axis(R^T dF): differentiable once more."""
    R = nearest_rotation(F)
    S = R.mT @ F
    A = R.mT @ direction
    axis = torch.stack((A[..., 2, 1] - A[..., 1, 2], A[..., 0, 2] - A[..., 2, 0], A[..., 1, 0] - A[..., 0, 1]), dim=-1)
    S = 0.5 * (S + S.mT)
    trace = S.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    # a singular matrix has no derivative, and says so in its own result: nothing is checked, which would wait for a GPU
    turning = trace * torch.eye(3, dtype=F.dtype, device=F.device) - S
    x, y, z = torch.linalg.solve_ex(turning, axis)[0].unbind(-1)
    zero = torch.zeros_like(x)
    turn = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).unflatten(-1, (3, 3))
    result: Tensor = R @ turn
    return result


def _rotation_backward(ctx: Any, grad: Tensor) -> Tensor:
    (F,) = ctx.saved_tensors
    result: Tensor = _ops.rotation_differential(F, grad)
    return result


def _rotation_differential_backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    # in the precision of F, also where autocast asks for less
    with torch.enable_grad(), torch.autocast(grad.device.type, enabled=False):
        inputs = [saved.detach().requires_grad_() for saved in ctx.saved_tensors]
        grads: tuple[Tensor | None, ...] = torch.autograd.grad(_rotation_differential(*inputs), inputs, grad)
    return grads


register_rule("step_vjp", step_vjp_rule)
register_rule("rollout_vjp", rollout_vjp_rule)


torch.library.register_autograd("torchpd::elastic_diagonal", _diagonal_backward, setup_context=_save_nothing)
torch.library.register_autograd("torchpd::precondition", _precondition_backward, setup_context=_precondition_setup)

for _name, _backward, _inputs in (
    ("element_energy", _element_energy_backward, ("positions", "stiffness")),
    ("gradient", _gradient_backward, ("positions", "stiffness")),
    ("element_energy_product", _element_energy_product_backward, ("positions", "direction", "stiffness")),
    ("hessian_product", _hessian_product_backward, ("positions", "direction", "stiffness")),
    ("nearest_rotation", _rotation_backward, ("matrices",)),
    ("rotation_differential", _rotation_differential_backward, ("matrices", "direction")),
):
    torch.library.register_autograd(f"torchpd::{_name}", _backward, setup_context=_save(*_inputs))
