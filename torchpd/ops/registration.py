"""Python side of the ops: fake kernels and derivatives. Importing this module loads the extension."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.utils._pytree import tree_leaves

from .. import _C
from ..common.tables import (
    EFFECT_ROWS,
    HISTORY_ROWS,
    KINDS,
    MATERIAL_TABLE,
    MULTILEVEL_TABLE,
    PLAN_TABLE,
    STENCIL_TABLE,
    MaterialRow,
)
from .adjoint import adjoint_fallback
from .diagonal import named_material
from .vmap import register_rule
from .vmap_step import rollout_vjp_rule, step_vjp_rule

__all__ = ["INFO_WIDTH", "nearest_rotation", "refuse_forward_mode"]

INFO_WIDTH = _C.info_numbers

_ops = torch.ops.torchpd
_STIFFNESS = [row.name for row in MATERIAL_TABLE].index("stiffness")
_POISSON = [row.name for row in MATERIAL_TABLE].index("poisson")
_STENCIL_PLAN = len(PLAN_TABLE) + len(STENCIL_TABLE)
_CORE = len(MATERIAL_TABLE) - len(EFFECT_ROWS)  # arrays that every scene has


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


# ---- fake kernels: shapes, types and devices only


def _register_fake(name: str) -> Callable[[Callable[..., Any]], None]:
    """Register a fake kernel that refuses arguments partly on "meta".

    Torch also takes a fake kernel when one argument of several is on "meta", and would return uninitialised memory.
    """

    def register(kernel: Callable[..., Any]) -> None:
        def checked(*given: Any, **settings: Any) -> Any:
            first, *others = (leaf for leaf in tree_leaves(given) if isinstance(leaf, Tensor))
            if first.device.type != "meta" and any(other.device.type == "meta" for other in others):
                raise RuntimeError(
                    f"torchpd::{name}: arguments must be on one device, got some on {first.device} and some on "
                    '"meta", where tensors have no values'
                )
            return kernel(*given, **settings)

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
def _(positions: Tensor, material: Sequence[Tensor], plan: Sequence[Tensor]) -> Tensor:
    return positions.new_empty(positions.shape)


@_register_fake("hessian_product")
def _(positions: Tensor, direction: Tensor, material: Sequence[Tensor], plan: Sequence[Tensor]) -> Tensor:
    return positions.new_empty(positions.shape)


@_register_fake("element_energy")
def _(positions: Tensor, material: Sequence[Tensor], plan: Sequence[Tensor]) -> Tensor:
    return positions.new_empty((positions.shape[0], material[_STIFFNESS].shape[-1]))


@_register_fake("element_energy_product")
def _(positions: Tensor, direction: Tensor, material: Sequence[Tensor], plan: Sequence[Tensor]) -> Tensor:
    return positions.new_empty((positions.shape[0], material[_STIFFNESS].shape[-1]))


@_register_fake("effect_energy")
def _(positions: Tensor, material: Sequence[Tensor], plan: Sequence[Tensor]) -> Tensor:
    return positions.new_empty(positions.shape[:1])


@_register_fake("lame_product")
def _(positions: Tensor, direction: Tensor | None, material: Sequence[Tensor], plan: Sequence[Tensor]) -> Tensor:
    return positions.new_empty((*positions.shape[:1], material[_STIFFNESS].shape[-1], 2))


@_register_fake("effect_products")
def _(positions: Tensor, direction: Tensor | None, material: Sequence[Tensor], plan: Sequence[Tensor]) -> list[Tensor]:
    return _fake_products(positions, material)


def _fake_products(positions: Tensor, material: Sequence[Tensor]) -> list[Tensor]:
    """Derivatives by the arrays that only some scenes have, of every environment."""
    rows = zip(EFFECT_ROWS, material[_CORE:], strict=False)
    return [positions.new_empty((len(positions), *array.shape[array.dim() - row.dims :])) for row, array in rows]


@_register_fake("damping_gradient")
def _(positions: Tensor, *_: Any, time_step: float) -> Tensor:
    return positions.new_empty(positions.shape)


@_register_fake("damping_vjp")
def _(
    positions: Tensor, start: Tensor, direction: Tensor, material: Sequence[Tensor], plan: Sequence[Tensor], **_: Any
) -> list[Tensor]:
    by_state = [positions.new_empty(positions.shape) for _ in range(2)]
    by_stiffness = positions.new_empty((len(positions), material[_STIFFNESS].shape[-1]))
    return [*by_state, by_stiffness, *_fake_products(positions, material)]


@_register_fake("next_history")
def _(positions: Tensor, material: Sequence[Tensor], plan: Sequence[Tensor], *, time_step: float) -> list[Tensor]:
    named = named_material(material)
    return [positions.new_empty((len(positions), *named[row.name].shape[-2:])) for row in HISTORY_ROWS]


@_register_fake("next_history_vjp")
def _(
    gradients: Sequence[Tensor], positions: Tensor, material: Sequence[Tensor], plan: Sequence[Tensor], **_: Any
) -> list[Tensor]:
    return [positions.new_empty(positions.shape), *_fake_products(positions, material)]


@_register_fake("elastic_diagonal")
def _(material: Sequence[Tensor], plan: Sequence[Tensor], *, weighted: bool, time_step: float = 0.0) -> Tensor:
    stiffness, (_, vertex_order, *_) = material[_STIFFNESS], plan
    own = [len(array) for row, array in _elastic_rows(material) if array.dim() > row.dims]
    return stiffness.new_empty((*own[:1], vertex_order.shape[0]))


@_register_fake("stiffness_at_rest")
def _(material: Sequence[Tensor], plan: Sequence[Tensor], *, time_step: float = 0.0) -> Tensor:
    named, stiffness = named_material(material), material[_STIFFNESS]
    own = [len(array) for row, array in _elastic_rows(material) if array.dim() > row.dims]
    rows = {row.name: row for row in MATERIAL_TABLE}
    counts = [
        named[name].shape[named[name].dim() - rows[name].dims]
        for name, *_ in (kind.own_rows for kind in KINDS.values() if kind.own_rows)
        if name in named
    ]
    # the material does not tell which tetrahedra have stencils
    some = any(named[name].shape[-1] > 0 for name in ("poisson", "stiffness_damping") if name in named)
    count = torch.library.get_ctx().new_dynamic_size() if some else stiffness.shape[-1] + sum(counts)
    return stiffness.new_empty((*own[:1], count))


@_register_fake("precondition")
def _(field: Tensor, plan: Sequence[Tensor]) -> Tensor:
    return field.new_empty(field.shape)


@_register_fake("adjoint_system")
def _(*step: Any, time_step: float) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    _, _, _, positions, _, _, material, _ = step
    batch, vertices, _ = positions.shape
    rows = list(zip(MATERIAL_TABLE[: len(material)], material, strict=True))
    touching = any(row.name in ("planes", "spheres") and array.shape[-2] > 0 for row, array in rows)
    # arrays that inertia and diagonal depend on
    own = touching or any(
        (row.effect or row.name in ("stiffness", "masses", "damping", "pin_stiffness"))
        and array.dim() > row.dims
        and len(array) != 1
        and array.shape[1:].numel() > 0
        for row, array in rows
    )
    inertia, inverse = (positions.new_empty((batch if own else 1, vertices)) for _ in range(2))
    held = batch if touching else 0
    projector = positions.new_empty((held, vertices, 3, 3))
    stuck = positions.new_empty((held, vertices), dtype=torch.bool)
    sliding = positions.new_empty((held, vertices, _C.slide_vectors, 3))
    return positions.new_empty(positions.shape), inertia, inverse, projector, stuck, sliding


@_register_fake("contact_gradients")
def _(multiplier: Tensor, *step: Any, time_step: float) -> tuple[Tensor, Tensor]:
    material = named_material(step[-2])
    planes, spheres = (
        multiplier.new_empty((len(multiplier), *material[name].shape[-2:])) for name in ("planes", "spheres")
    )
    return planes, spheres


@_register_fake("conjugate_gradients")
def _(positions: Tensor, *_: Any, **__: Any) -> tuple[Tensor, Tensor]:
    return positions.new_empty(positions.shape), positions.new_empty(positions.shape[:1], dtype=torch.float64)


@_register_fake("adjoint_fallback")
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


@torch.library.impl("torchpd::adjoint_fallback", ("cpu", "cuda"))
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
    return [stiffness if place == _STIFFNESS else array for place, array in enumerate(material)]


def _elastic_rows(material: Sequence[Tensor]) -> list[tuple[MaterialRow, Tensor]]:
    """Arrays of the material that the elastic energy depends on, with their rows of the table."""
    rows = MATERIAL_TABLE[: len(material)]
    pairs = zip(rows, material, strict=True)
    return [(row, array) for row, array in pairs if row.name == "stiffness" or row.effect]


def _for_material(
    material: Sequence[Tensor], stiffness: Tensor | None, effects: Sequence[Tensor | None] | None = None
) -> list[Tensor | None]:
    """Gradients of the material: stiffness and effects enter the elastic energy."""
    count = len(material) - _CORE
    grads: list[Tensor | None] = [stiffness if place == _STIFFNESS else None for place in range(_CORE)]
    return [*grads, *([None] * count if effects is None else effects)]


def _sum_to_rows(material: Sequence[Tensor], each: Sequence[Tensor]) -> list[Tensor | None]:
    """Gradients of the effects from those of every environment."""
    shared = zip(MATERIAL_TABLE[_CORE:], material[_CORE:], each, strict=True)
    return [
        None if array.numel() == 0 else grad.sum(0) if array.dim() == row.dims else grad.sum_to_size(array.shape)
        for row, array, grad in shared
    ]


def _effect_energy_backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, list[Tensor | None], list[None]]:
    positions, *material = ctx.saved_tensors
    stiffness, x, w, effects = material[_STIFFNESS], None, None, None
    if ctx.needs_input_grad[0]:
        x = grad[:, None, None] * _ops.gradient(positions, material, ctx.plan)
    if ctx.needs_input_grad[1][_STIFFNESS]:
        w = _sum_to_stiffness(grad[:, None] * _by_stiffness(positions, None, material, ctx.plan), stiffness)
    if any(ctx.needs_input_grad[1][_CORE:]):
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
    unit = _with_stiffness(material, torch.ones_like(material[_STIFFNESS]))
    found: Tensor
    if direction is None:
        found = _ops.element_energy(positions, unit, plan)
    else:
        found = _ops.element_energy_product(positions, direction, unit, plan)
    return found


def _has_poisson(material: Sequence[Tensor]) -> bool:
    return len(material) > _CORE and material[_POISSON].shape[-1] > 0


def _refuse_poisson(material: Sequence[Tensor]) -> None:
    """Refuse derivatives of energies of single elements that average their trace over a group."""
    if _has_poisson(material):
        raise RuntimeError(
            "torchpd: energies of single elements have no derivative with Poisson's ratio, which groups of elements "
            "share; differentiate effect_energy, their sum"
        )


def _tets_alone(material: Sequence[Tensor], stiffness: Tensor) -> list[Tensor]:
    """The material with another stiffness, for a plan without stencils."""
    return _with_stiffness(material, stiffness)[:_CORE]


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
    stiffness, x, w = material[_STIFFNESS], None, None
    if ctx.needs_input_grad[0]:
        x = _ops.gradient(positions, _tets_alone(material, grad * stiffness), _without_stencils(ctx.plan))
    if ctx.needs_input_grad[1][_STIFFNESS]:
        unit = _with_stiffness(material, torch.ones_like(stiffness))
        w = _sum_to_stiffness(grad * _ops.element_energy(positions, unit, ctx.plan), stiffness)
    return x, _for_material(material, w), _for_plan(ctx)


def _gradient_backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, list[Tensor | None], list[None]]:
    positions, *material = ctx.saved_tensors
    stiffness, x, w, effects = material[_STIFFNESS], None, None, None
    if ctx.needs_input_grad[0]:
        x = _ops.hessian_product(positions, grad, material, ctx.plan)
    if ctx.needs_input_grad[1][_STIFFNESS]:
        w = _sum_to_stiffness(_by_stiffness(positions, grad, material, ctx.plan), stiffness)
    if any(ctx.needs_input_grad[1][_CORE:]):
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
    stiffness = _sum_to_stiffness(w, material[_STIFFNESS])
    return x, before, _for_material(material, stiffness, _sum_to_rows(material, effects)), _for_plan(ctx)


def _element_energy_product_backward(
    ctx: Any, grad: Tensor
) -> tuple[Tensor | None, Tensor | None, list[Tensor | None], list[None]]:
    positions, direction, *material = ctx.saved_tensors
    _refuse_poisson(material)
    stiffness, x, d, w = material[_STIFFNESS], None, None, None
    scaled, plan = _tets_alone(material, grad * stiffness), _without_stencils(ctx.plan)
    if ctx.needs_input_grad[0]:
        x = _ops.hessian_product(positions, direction, scaled, plan)
    if ctx.needs_input_grad[1]:
        d = _ops.gradient(positions, scaled, plan)
    if ctx.needs_input_grad[2][_STIFFNESS]:
        unit = _with_stiffness(material, torch.ones_like(stiffness))
        w = _sum_to_stiffness(grad * _ops.element_energy_product(positions, direction, unit, ctx.plan), stiffness)
    return x, d, _for_material(material, w), _for_plan(ctx)


def _hessian_product_backward(ctx: Any, grad: Tensor) -> tuple[None, Tensor | None, list[Tensor | None], list[None]]:
    wanted = ctx.needs_input_grad[2]
    if ctx.needs_input_grad[0] or wanted[_STIFFNESS] or any(wanted[_CORE:]):
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
    if wanted[_STIFFNESS] or any(wanted[_CORE:]):
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


register_rule("step_vjp", step_vjp_rule)
register_rule("rollout_vjp", rollout_vjp_rule)


torch.library.register_autograd("torchpd::elastic_diagonal", _diagonal_backward, setup_context=_save_nothing)
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
