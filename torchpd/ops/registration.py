"""Python side of the ops: derivatives. Importing this module loads the extension."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from ..common.tables import MATERIAL_TABLE, MULTILEVEL_TABLE, PLAN_TABLE, STENCIL_TABLE
from .adjoint import adjoint_fallback
from .diagonal import CORE_COUNT, STIFFNESS_PLACE
from .fake_kernels import CONTACT_FRICTION, CONTACT_MISSING, CONTACT_RIGID, CONTACT_THICKNESS, INFO_WIDTH
from .vmap import register_rule
from .vmap_step import rollout_vjp_rule, step_vjp_rule

__all__ = ["INFO_WIDTH", "nearest_rotation", "refuse_forward_mode"]

_ops = torch.ops.torchpd
_POISSON = [row.name for row in MATERIAL_TABLE].index("poisson")
_WRENCH = 6  # numbers of a wrench, csrc/contact/motion_views.h
_STENCIL_PLAN = len(PLAN_TABLE) + len(STENCIL_TABLE)


def nearest_rotation(F: Tensor) -> Tensor:
    """The rotation R nearest to each matrix: argmax of tr(R^T F) over det R = +1.

    Safe for inverted, rank-deficient, huge and tiny matrices. Zero gives the identity; a matrix with NaN or infinity
    gives NaN. Differentiable for matrices of magnitude 1e-12 to 1e12 (float64: 1e-101 to 1e101). The derivative is
    unbounded where the two smallest singular values cancel (with the sign of det F on the smallest): there the nearest
    rotation jumps.

    Method: largest root of Davenport's quartic (Markley 1993) in closed form, and one Newton step; signed SVD near
    double roots.

    Args:
        F: float32 or float64 [..., 3, 3].

    Returns:
        [..., 3, 3].

    Raises:
        TypeError: F is not a tensor.
    """
    if not isinstance(F, Tensor):
        raise TypeError(f"nearest_rotation: F must be a tensor [..., 3, 3], got {type(F).__name__}")
    refuse_forward_mode(F)
    result: Tensor = _ops.nearest_rotation(F)
    return result


def refuse_forward_mode(*tensors: Tensor | None) -> None:
    """Refuse forward-mode derivatives, which the ops lack: torch would take them to be zero."""
    if forward_ad._current_level < 0:
        return
    for tensor in tensors:
        if tensor is not None and forward_ad.unpack_dual(tensor).tangent is not None:
            raise RuntimeError(
                "torchpd: forward-mode derivatives are not provided; use reverse mode (backward, torch.autograd.grad)"
            )


# ---- kernels


@torch.library.impl("torchpd::adjoint_fallback", ("cpu", "cuda"))
def _(*args: Any, time_step: float) -> Tensor:
    return adjoint_fallback(*args, time_step=time_step)


@torch.library.impl("torchpd::contact_fallback", ("cpu", "cuda"))
def _(*args: Any, time_step: float) -> Tensor:
    return adjoint_fallback(*args, time_step=time_step)


# ---- derivatives: each is another op


def _save(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    ctx.save_for_backward(*inputs)


def _save_elastic(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    """Save the inputs of an op of a state, a material and a plan."""
    *state, material, ctx.plan = inputs
    ctx.save_for_backward(*state, *material)


def _sum_to_stiffness(per_environment: Tensor, stiffness: Tensor) -> Tensor:
    """Sum over the environments that share a stiffness."""
    return per_environment.sum(0) if stiffness.dim() == 1 else per_environment.sum_to_size(stiffness.shape)


def _with_stiffness(material: Sequence[Tensor], stiffness: Tensor) -> list[Tensor]:
    return [stiffness if place == STIFFNESS_PLACE else array for place, array in enumerate(material)]


def _for_material(
    material: Sequence[Tensor], stiffness: Tensor | None, effects: Sequence[Tensor | None] | None = None
) -> list[Tensor | None]:
    """Gradients of the material: stiffness and effects enter the elastic energy."""
    count = len(material) - CORE_COUNT
    grads: list[Tensor | None] = [stiffness if place == STIFFNESS_PLACE else None for place in range(CORE_COUNT)]
    return [*grads, *([None] * count if effects is None else effects)]


def _sum_to_rows(material: Sequence[Tensor], each: Sequence[Tensor]) -> list[Tensor | None]:
    """Gradients of the effects from those of every environment."""
    shared = zip(MATERIAL_TABLE[CORE_COUNT:], material[CORE_COUNT:], each, strict=True)
    return [
        None if array.numel() == 0 else grad.sum(0) if array.dim() == row.dims else grad.sum_to_size(array.shape)
        for row, array, grad in shared
    ]


def _effect_energy_backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, list[Tensor | None], list[None]]:
    positions, *material = ctx.saved_tensors
    stiffness, x, w, effects = material[STIFFNESS_PLACE], None, None, None
    if ctx.needs_input_grad[0]:
        x = grad[:, None, None] * _ops.gradient(positions, material, ctx.plan)
    if ctx.needs_input_grad[1][STIFFNESS_PLACE]:
        w = _sum_to_stiffness(grad[:, None] * _by_stiffness(positions, None, material, ctx.plan), stiffness)
    if any(ctx.needs_input_grad[1][CORE_COUNT:]):
        products = _ops.effect_products(positions, None, material, ctx.plan)
        each = [grad.view(-1, *[1] * (product.dim() - 1)) * product for product in products]
        effects = _sum_to_rows(material, each)
    return x, _for_material(material, w, effects), _for_plan(ctx)


def _by_stiffness(
    positions: Tensor, direction: Tensor | None, material: Sequence[Tensor], plan: Sequence[Tensor]
) -> Tensor:
    """Derivatives by the stiffness [B, E] of the energy, or of the gradient's product with a direction."""
    if _has_poisson(material):
        lame: Tensor = _ops.lame_product(positions, direction, material, plan)
        return lame[..., 0]
    unit = _with_stiffness(material, torch.ones_like(material[STIFFNESS_PLACE]))
    found: Tensor
    if direction is None:
        found = _ops.element_energy(positions, unit, plan)
    else:
        found = _ops.element_energy_product(positions, direction, unit, plan)
    return found


def _has_poisson(material: Sequence[Tensor]) -> bool:
    return len(material) > CORE_COUNT and material[_POISSON].shape[-1] > 0


def _refuse_poisson(material: Sequence[Tensor]) -> None:
    """Refuse derivatives of energies of single elements that average their trace over a group."""
    if _has_poisson(material):
        raise RuntimeError(
            "torchpd: energies of single elements have no derivative with Poisson's ratio, which groups of elements "
            "share; differentiate effect_energy, their sum"
        )


def _tets_alone(material: Sequence[Tensor], stiffness: Tensor) -> list[Tensor]:
    """The material with another stiffness, for a plan without stencils."""
    return _with_stiffness(material, stiffness)[:CORE_COUNT]


def _without_stencils(plan: Sequence[Tensor]) -> list[Tensor]:
    """The arrays of a plan without those of its stencils and of its preconditioner, on a CPU."""
    stencils = len(plan) in (_STENCIL_PLAN, _STENCIL_PLAN + len(MULTILEVEL_TABLE))
    return list(plan[: len(PLAN_TABLE)]) if stencils else list(plan)


def _for_plan(ctx: Any) -> list[None]:
    """No gradient for any array of the plan, in the form that autograd expects."""
    return [None] * len(ctx.plan)


def _element_energy_backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, list[Tensor | None], list[None]]:
    positions, *material = ctx.saved_tensors
    _refuse_poisson(material)
    stiffness, x, w = material[STIFFNESS_PLACE], None, None
    if ctx.needs_input_grad[0]:
        x = _ops.gradient(positions, _tets_alone(material, grad * stiffness), _without_stencils(ctx.plan))
    if ctx.needs_input_grad[1][STIFFNESS_PLACE]:
        unit = _with_stiffness(material, torch.ones_like(stiffness))
        w = _sum_to_stiffness(grad * _ops.element_energy(positions, unit, ctx.plan), stiffness)
    return x, _for_material(material, w), _for_plan(ctx)


def _gradient_backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, list[Tensor | None], list[None]]:
    positions, *material = ctx.saved_tensors
    stiffness, x, w, effects = material[STIFFNESS_PLACE], None, None, None
    if ctx.needs_input_grad[0]:
        x = _ops.hessian_product(positions, grad, material, ctx.plan)
    if ctx.needs_input_grad[1][STIFFNESS_PLACE]:
        w = _sum_to_stiffness(_by_stiffness(positions, grad, material, ctx.plan), stiffness)
    if any(ctx.needs_input_grad[1][CORE_COUNT:]):
        effects = _sum_to_rows(material, _ops.effect_products(positions, grad, material, ctx.plan))
    return x, _for_material(material, w, effects), _for_plan(ctx)


def _save_history(ctx: Any, inputs: tuple[Any, ...], keyword_only_inputs: dict[str, Any], output: Any) -> None:
    positions, material, ctx.plan = inputs
    ctx.time_step = keyword_only_inputs["time_step"]
    ctx.save_for_backward(positions, *material)


def _history_backward(ctx: Any, grads: Sequence[Tensor]) -> tuple[Tensor, list[Tensor | None], list[None]]:
    positions, *material = ctx.saved_tensors
    given = [grad.contiguous() for grad in grads]
    x, *each = _ops.next_history_vjp(given, positions, material, ctx.plan, time_step=ctx.time_step)
    return x, _for_material(material, None, _sum_to_rows(material, each)), _for_plan(ctx)


def _save_damping(ctx: Any, inputs: tuple[Any, ...], keyword_only_inputs: dict[str, Any], output: Any) -> None:
    positions, start, material, ctx.plan = inputs
    ctx.time_step = keyword_only_inputs["time_step"]
    ctx.save_for_backward(positions, start, *material)


def _damping_backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, list[Tensor | None], list[None]]:
    positions, start, *material = ctx.saved_tensors
    x, before, w, *effects = _ops.damping_vjp(positions, start, grad, material, ctx.plan, time_step=ctx.time_step)
    stiffness = _sum_to_stiffness(w, material[STIFFNESS_PLACE])
    return x, before, _for_material(material, stiffness, _sum_to_rows(material, effects)), _for_plan(ctx)


def _element_energy_product_backward(
    ctx: Any, grad: Tensor
) -> tuple[Tensor | None, Tensor | None, list[Tensor | None], list[None]]:
    positions, direction, *material = ctx.saved_tensors
    _refuse_poisson(material)
    stiffness, x, d, w = material[STIFFNESS_PLACE], None, None, None
    scaled, plan = _tets_alone(material, grad * stiffness), _without_stencils(ctx.plan)
    if ctx.needs_input_grad[0]:
        x = _ops.hessian_product(positions, direction, scaled, plan)
    if ctx.needs_input_grad[1]:
        d = _ops.gradient(positions, scaled, plan)
    if ctx.needs_input_grad[2][STIFFNESS_PLACE]:
        unit = _with_stiffness(material, torch.ones_like(stiffness))
        w = _sum_to_stiffness(grad * _ops.element_energy_product(positions, direction, unit, ctx.plan), stiffness)
    return x, d, _for_material(material, w), _for_plan(ctx)


def _hessian_product_backward(ctx: Any, grad: Tensor) -> tuple[None, Tensor | None, list[Tensor | None], list[None]]:
    wanted = ctx.needs_input_grad[2]
    if ctx.needs_input_grad[0] or wanted[STIFFNESS_PLACE] or any(wanted[CORE_COUNT:]):
        raise RuntimeError(
            "torchpd: third derivatives of the elastic energy are not provided; detach positions and stiffness before "
            "differentiating a Hessian-vector product"
        )
    positions, _, *material = ctx.saved_tensors
    d = _ops.hessian_product(positions, grad, material, ctx.plan) if ctx.needs_input_grad[1] else None
    return None, d, _for_material(material, None), _for_plan(ctx)


def _save_nothing(ctx: Any, inputs: tuple[Any, ...], keyword_only_inputs: dict[str, Any], output: Any) -> None:
    """Nothing to save."""


def _diagonal_backward(ctx: Any, grad: Tensor) -> tuple[list[None], list[None]]:
    wanted, of_plan = ctx.needs_input_grad
    if wanted[STIFFNESS_PLACE] or any(wanted[CORE_COUNT:]):
        raise RuntimeError("torchpd: the elastic diagonal, a preconditioner, has no derivative; detach stiffness")
    return [None] * len(wanted), [None] * len(of_plan)


def _precondition_setup(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    ctx.plan = inputs[1]


def _precondition_backward(ctx: Any, grad: Tensor) -> tuple[Tensor, list[None]]:
    # the preconditioner is linear and symmetric
    return _ops.precondition(grad, ctx.plan), _for_plan(ctx)


def _rotation_differential(F: Tensor, direction: Tensor) -> Tensor:
    """Differential dR along dF from torch operations, so that it is differentiable again.

    R [h]_x with (tr(S) I - S) h = axis(R^T dF).
    """
    R = nearest_rotation(F)
    S = R.mT @ F
    A = R.mT @ direction
    axis = torch.stack((A[..., 2, 1] - A[..., 1, 2], A[..., 0, 2] - A[..., 2, 0], A[..., 1, 0] - A[..., 0, 1]), dim=-1)
    S = 0.5 * (S + S.mT)
    trace = S.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    # A singular matrix gives inf or NaN; a check would wait for the GPU.
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
    # in the precision of F, also under autocast
    with torch.enable_grad(), torch.autocast(grad.device.type, enabled=False):
        inputs = [saved.detach().requires_grad_() for saved in ctx.saved_tensors]
        grads: tuple[Tensor | None, ...] = torch.autograd.grad(_rotation_differential(*inputs), inputs, grad)
    return grads


def _refuse_mapped_contact(*_: Any, **__: Any) -> Any:
    raise RuntimeError(
        "torchpd::contact_step: a step with Contact must not be mapped by vmap; put the environments in the batch of a "
        "state instead: sim.rest_state(batch)"
    )


def _save_contact(ctx: Any, inputs: tuple[Any, ...], keyword_only_inputs: dict[str, Any], output: Any) -> None:
    positions, velocities, forces, poses, history, material, ctx.plan, contact = inputs
    after, _, info, numbers, held_back, actual, keys, pair_forces, pushes = output
    ctx.mark_non_differentiable(info, numbers, held_back, keys, pair_forces, pushes)  # reports
    ctx.time_step, ctx.counts = keyword_only_inputs["time_step"], (len(history), len(material), len(contact))
    ctx.set_materialize_grads(False)
    kept = (history[0], actual, keys, pair_forces)
    ctx.save_for_backward(positions, velocities, forces, poses, after, pushes, numbers, *kept, *material, *contact)


def _contact_backward(ctx: Any, *grads: Tensor | None) -> tuple[Any, ...]:
    grad_positions, grad_velocities, *_, grad_poses, _, _, _ = grads
    positions, velocities, forces, poses, after, pushes, numbers, *others = ctx.saved_tensors
    history, others = others[:4], others[4:]
    count_history, count_material, count_contact = ctx.counts
    material, contact = others[:count_material], others[count_material:]

    def known(gradient: Tensor | None, like: Tensor) -> Tensor:
        return torch.zeros_like(like) if gradient is None else gradient

    wanted = list(ctx.needs_input_grad[5])
    x, v, f, target, start, friction, thickness, rigid, *asked = _ops.contact_step_vjp(
        known(grad_positions, after),
        known(grad_velocities, after),
        known(grad_poses, poses),
        after,
        positions,
        velocities,
        forces,
        poses,
        history,
        pushes,
        numbers[:, CONTACT_MISSING] > 0,
        material,
        ctx.plan,
        contact,
        time_step=ctx.time_step,
        wanted=wanted,
    )
    rows = iter(asked)
    of_contact: list[Tensor | None] = [None] * count_contact
    of_contact[CONTACT_FRICTION], of_contact[CONTACT_RIGID] = friction, rigid
    if ctx.needs_input_grad[7][CONTACT_THICKNESS]:  # a number of the host
        of_contact[CONTACT_THICKNESS] = thickness.cpu()
    return (
        x,
        v,
        None if forces is None else f,
        target,
        [start, *[None] * (count_history - 1)],
        [next(rows) if one else None for one in wanted],
        _for_plan(ctx),
        of_contact,
    )


def _save_motion(ctx: Any, inputs: tuple[Any, ...], keyword_only_inputs: dict[str, Any], output: Any) -> None:
    ctx.time_step = keyword_only_inputs["time_step"]
    ctx.save_for_backward(*inputs)


def _motion_backward(vjp: Any) -> Any:
    """Backward pass of an op of colliders with a mass, whose arrays expand to [batch, colliders, numbers]."""

    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors
        # arrays that were left out have their place in the row
        widths = [_WRENCH if array is None else array.shape[-1] for array in inputs]
        rows = vjp(*grads, *inputs, time_step=ctx.time_step).split(widths, dim=-1)
        return tuple(
            None if array is None else row.sum_to_size(array.shape) for array, row in zip(inputs, rows, strict=True)
        )

    return backward


def _refuse_second_derivatives(ctx: Any, *_: Any) -> Any:
    raise RuntimeError(
        "torchpd: a step has first derivatives only; differentiate without create_graph, or take differences of the "
        "gradients of two steps"
    )


register_rule("contact_step", _refuse_mapped_contact)
register_rule("step_vjp", step_vjp_rule)
register_rule("rollout_vjp", rollout_vjp_rule)


torch.library.register_autograd("torchpd::elastic_diagonal", _diagonal_backward, setup_context=_save_nothing)
torch.library.register_autograd("torchpd::contact_step", _contact_backward, setup_context=_save_contact)
torch.library.register_autograd("torchpd::contact_step_vjp", _refuse_second_derivatives, setup_context=_save_nothing)
for _name in ("free_motion", "motion_after"):
    _vjp = getattr(_ops, f"{_name}_vjp")
    torch.library.register_autograd(f"torchpd::{_name}", _motion_backward(_vjp), setup_context=_save_motion)
    torch.library.register_autograd(f"torchpd::{_name}_vjp", _refuse_second_derivatives, setup_context=_save_nothing)
torch.library.register_autograd("torchpd::damping_gradient", _damping_backward, setup_context=_save_damping)
torch.library.register_autograd("torchpd::next_history", _history_backward, setup_context=_save_history)
torch.library.register_autograd("torchpd::precondition", _precondition_backward, setup_context=_precondition_setup)

for _name, _backward, _setup in (
    ("element_energy", _element_energy_backward, _save_elastic),
    ("effect_energy", _effect_energy_backward, _save_elastic),
    ("gradient", _gradient_backward, _save_elastic),
    ("element_energy_product", _element_energy_product_backward, _save_elastic),
    ("hessian_product", _hessian_product_backward, _save_elastic),
    ("nearest_rotation", _rotation_backward, _save),
    ("rotation_differential", _rotation_differential_backward, _save),
):
    torch.library.register_autograd(f"torchpd::{_name}", _backward, setup_context=_setup)
