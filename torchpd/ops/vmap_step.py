"""Rules for vmap: the mapped dimension joins the leading batch of the ops."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from ..common.tables import MATERIAL_TABLE
from .vmap import Rule, register_rule

__all__ = ["rollout_vjp_rule", "step_vjp_rule"]

_ops = torch.ops.torchpd
_OWN = {row.name: row.dims for row in MATERIAL_TABLE}  # dimensions of an array without a batch
_ELASTIC = tuple(row.name for row in MATERIAL_TABLE if row.effect or row.name == "stiffness")


def _named(material: Sequence[Any]) -> dict[str, Any]:
    """Arrays of a material, or their mapped dimensions, by name: those of every scene, or all."""
    return dict(zip(list(_OWN)[: len(material)], material, strict=True))


def _shape_of_one(tensor: Tensor, dim: int | None) -> torch.Size:
    """Shape of one map, as the mapped function sees it."""
    return torch.Size(length for place, length in enumerate(tensor.shape) if place != dim)


def _check_one(fits: bool, op: Any, in_dims: Any, args: Any, **numbers: Any) -> None:
    """Run the op on one map if its shape is wrong, so that the op raises its error: joined, it may be valid."""
    if not fits:
        op(*pytree.tree_map(lambda t, dim: t if dim is None else t.select(dim, 0), args, in_dims), **numbers)


def _join(tensor: Tensor, dim: int | None, size: int, batch: int, own: int) -> Tensor:
    """Merge a mapped dimension into the leading batch of an array with `own` dimensions without a batch.

    Shared arrays stay shared. An array for each of `batch` environments is repeated for each of the `size` maps.
    """
    if dim is None:
        shared = tensor.dim() == own or (len(tensor) == 1 and batch > 1)
        return tensor if shared else tensor.repeat(size, *[1] * own)
    tensor = tensor.movedim(dim, 0)
    if tensor.dim() == own + 1:
        return tensor.repeat_interleave(batch, 0)
    return tensor.expand(size, batch, *tensor.shape[2:]).flatten(0, 1)


def _check_plan(dims: Any) -> None:
    if any(dim is not None for dim in dims):
        raise ValueError("torchpd: the plan cannot be mapped by vmap; it is the same for all environments")


def _fits(state: Sequence[torch.Size], material: Mapping[str, torch.Size]) -> bool:
    """Whether state arrays are [batch, V, 3], and material arrays suit that batch or are shared."""
    batch, *_ = *state[0], 0
    return all(len(shape) == 3 and shape == state[0] for shape in state) and all(
        len(shape) == _OWN[name] or (len(shape) == _OWN[name] + 1 and shape[0] in (1, batch))
        for name, shape in material.items()
    )


def _join_all(
    op: Any, info: Any, in_dims: Any, args: Any, tracks: int = 0, read: Iterable[str] = _OWN, **numbers: Any
) -> tuple[list[Any], tuple[int, int]]:
    """Join the arguments (state arrays, material, plan) of all maps, and count maps and environments.

    The first `tracks` arguments hold all steps, [step, batch, V, 3]. `read` names the material arrays that the op
    reads.
    """
    *state, material, plan = args
    *state_dims, material_dims, plan_dims = in_dims
    _check_plan(plan_dims)
    mapped = _named(material_dims)
    arrays = {name: (array, mapped[name]) for name, array in _named(material).items() if name in read}
    shapes = [_shape_of_one(t, d) for t, d in zip(state, state_dims, strict=True) if t is not None]
    of_steps = shapes[:tracks]
    shapes = shapes[tracks:]
    _check_one(
        _fits(shapes, {name: _shape_of_one(t, d) for name, (t, d) in arrays.items()})
        and all(len(shape) == 4 and shape == of_steps[0] and shape[1:] == shapes[0] for shape in of_steps),
        op, in_dims, args, **numbers,
    )  # fmt: skip
    size, batch = info.batch_size, shapes[0][0]
    joined = [
        t.repeat(1, size, 1, 1) if dim is None else t.movedim(dim, 1).flatten(1, 2)
        for t, dim in zip(state[:tracks], state_dims[:tracks], strict=True)
    ]
    joined += [
        None if t is None else _join(t, d, size, batch, 2)
        for t, d in zip(state[tracks:], state_dims[tracks:], strict=True)
    ]
    values = {name: _join(t, d, size, batch, _OWN[name]) for name, (t, d) in arrays.items()}
    return [*joined, [values.get(name, t) for name, t in _named(material).items()], plan], (size, batch)


def _batch_rule(name: str, dim: int = 0, read: Iterable[str] = _OWN) -> Rule:
    """Rule for an op whose outputs have their batch at `dim`; `read` names the material arrays that it reads."""
    op = getattr(_ops, name)

    def rule(info: Any, in_dims: Any, *args: Any, **numbers: Any) -> tuple[Any, int]:
        joined, maps = _join_all(op, info, in_dims, args, read=read, **numbers)
        return pytree.tree_map(lambda t: t.unflatten(dim, maps), op(*joined, **numbers)), dim

    return rule


def step_vjp_rule(info: Any, in_dims: Any, *args: Any, **numbers: Any) -> tuple[list[Tensor], int]:
    """Rule for the adjoint of a step. The gradient of a shared array sums over the environments of each map."""
    return _vjp_rule(_ops.step_vjp, info, in_dims, args, **numbers)


def rollout_vjp_rule(info: Any, in_dims: Any, *args: Any, **numbers: Any) -> tuple[list[Tensor], int]:
    """Rule for the adjoint of a rollout; its gradients and states come first and hold all steps."""
    return _vjp_rule(_ops.rollout_vjp, info, in_dims, args, tracks=4, **numbers)


def _vjp_rule(
    op: Any, info: Any, in_dims: Any, args: Any, *, tracks: int = 0, **numbers: Any
) -> tuple[list[Tensor], int]:
    (*state, values, plan), maps = _join_all(op, info, in_dims, args, tracks, **numbers)
    each = [
        t.expand(maps[0] * maps[1], *t.shape[t.dim() - _OWN[name] :]).contiguous() for name, t in _named(values).items()
    ]
    grads = [t.unflatten(0, maps) for t in op(*state, each, plan, **numbers)]
    shapes = [_shape_of_one(t, d) for t, d in zip(args[-2], in_dims[-2], strict=True)]
    asked = [True] * len(shapes) if numbers.get("wanted") is None else numbers["wanted"]
    rows = [(shape, _OWN[name]) for (name, shape), wanted in zip(_named(shapes).items(), asked, strict=True) if wanted]
    summed = [
        grad.sum(1, keepdim=len(shape) > own) if len(shape) == own or shape[0] < maps[1] else grad
        for grad, (shape, own) in zip(grads[3:], rows, strict=True)
    ]
    return [*grads[:3], *summed], 0


def _history_vjp_rule(
    info: Any, in_dims: Any, gradients: list[Tensor], *args: Any, **numbers: Any
) -> tuple[list[Tensor], int]:
    op, dims = _ops.next_history_vjp, in_dims[0]

    def of_one(*own: Any, **settings: Any) -> Any:
        chosen = [t if dim is None else t.select(dim, 0) for t, dim in zip(gradients, dims, strict=True)]
        return op(chosen, *own, **settings)

    joined, maps = _join_all(of_one, info, in_dims[1:], args, read=_ELASTIC, **numbers)
    wide = [_join(t, dim, *maps, 2) for t, dim in zip(gradients, dims, strict=True)]
    return [t.unflatten(0, maps) for t in op(wide, *joined, **numbers)], 0


def _diagonal_rule(info: Any, in_dims: Any, material: list[Tensor], plan: list[Tensor], **options: Any) -> Any:
    _check_plan(in_dims[1])
    place = list(_OWN).index("stiffness")
    stiffness, dim = material[place], in_dims[0][place]
    if dim is None:
        rows = _ops.elastic_diagonal(material, plan, **options)
        return rows.expand(info.batch_size, *rows.shape), 0
    mapped = stiffness.movedim(dim, 0)
    _check_one(mapped.dim() in (2, 3), _ops.elastic_diagonal, in_dims, (material, plan), **options)
    joined = [mapped.flatten(0, -2) if i == place else array for i, array in enumerate(material)]
    return _ops.elastic_diagonal(joined, plan, **options).unflatten(0, mapped.shape[:-1]), 0


def _precondition_rule(info: Any, in_dims: Any, field: Tensor, plan: list[Tensor]) -> tuple[Tensor, int]:
    _check_plan(in_dims[1])
    mapped = field.movedim(in_dims[0], 0)
    _check_one(mapped.dim() == 4, _ops.precondition, in_dims, (field, plan))
    return _ops.precondition(mapped.flatten(0, 1), plan).unflatten(0, mapped.shape[:2]), 0


def _rotation_rule(name: str) -> Rule:
    op = getattr(_ops, name)

    def rule(info: Any, in_dims: Any, *matrices: Tensor) -> tuple[Tensor, int]:
        shapes = [_shape_of_one(m, d) for m, d in zip(matrices, in_dims, strict=True)]
        _check_one(all(len(shape) > 1 and shape == shapes[0] for shape in shapes), op, in_dims, matrices)
        moved = [
            m.movedim(d, 0) if d is not None else m.expand(info.batch_size, *m.shape)
            for m, d in zip(matrices, in_dims, strict=True)
        ]
        return op(*moved), 0

    return rule


def _motion_rule(name: str) -> Rule:
    """Rule for an op whose arrays expand to [batch, colliders, numbers]."""
    op = getattr(_ops, name)

    def rule(info: Any, in_dims: Any, *arrays: Tensor | None, **numbers: Any) -> tuple[Any, int]:
        pairs = list(zip(arrays, in_dims, strict=True))
        shapes = [_shape_of_one(t, d) for t, d in pairs if t is not None]
        batch, colliders = torch.broadcast_shapes(*(shape[:-1] for shape in shapes if len(shape) == 3))
        maps = info.batch_size, batch

        def joined(tensor: Tensor | None, dim: int | None) -> Tensor | None:
            if tensor is None:
                return None
            front = tensor.unsqueeze(0) if dim is None else tensor.movedim(dim, 0)
            wide = front.reshape(len(front), *[1] * (4 - front.dim()), *front.shape[1:])
            return wide.expand(*maps, colliders, -1).flatten(0, 1)

        _check_one(all(0 < len(shape) < 4 for shape in shapes), op, in_dims, arrays, **numbers)
        return pytree.tree_map(lambda t: t.unflatten(0, maps), op(*(joined(t, d) for t, d in pairs), **numbers)), 0

    return rule


for _name in ("free_motion", "free_motion_vjp", "motion_after", "motion_after_vjp"):
    register_rule(_name, _motion_rule(_name))
for _name in ("gradient", "hessian_product", "effect_energy"):
    register_rule(_name, _batch_rule(_name, read=_ELASTIC))
register_rule("damping_gradient", _batch_rule("damping_gradient", read=_ELASTIC))
for _name in ("element_energy", "element_energy_product"):
    register_rule(_name, _batch_rule(_name, read=("stiffness",)))
register_rule("next_history", _batch_rule("next_history", read=_ELASTIC))
register_rule("next_history_vjp", _history_vjp_rule)
register_rule("step", _batch_rule("step"))
register_rule("rollout", _batch_rule("rollout", 1))
register_rule("elastic_diagonal", _diagonal_rule)
register_rule("precondition", _precondition_rule)
for _name in ("nearest_rotation", "rotation_differential"):
    register_rule(_name, _rotation_rule(_name))
