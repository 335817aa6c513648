"""Rules for vmap: the mapped dimension joins the leading batch that the ops have anyway."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from .tables import MATERIAL_TABLE

__all__: list[str] = []

_ops = torch.ops.torchpd


def _join(tensor: Tensor, dim: int | None, size: int, batch: int, own: int) -> Tensor:
    """Merge a mapped dimension into the leading batch of an array that has `own` dimensions without one.

    Shared arrays stay shared; an array for each of `batch` environments is repeated for each of the `size` maps.
    """
    if dim is None:
        shared = tensor.dim() == own or (len(tensor) == 1 and batch > 1)
        return tensor if shared else tensor.repeat(size, *[1] * own)
    tensor = tensor.movedim(dim, 0)
    if tensor.dim() == own + 1:
        return tensor.repeat_interleave(batch, 0)
    return tensor.expand(size, batch, *tensor.shape[2:]).flatten(0, 1)


def _split(tensor: Tensor, size: int, dim: int = 0) -> Tensor:
    result: Tensor = tensor.unflatten(dim, (size, -1))
    return result


def _check_plan(dims: Any) -> None:
    if any(dim is not None for dim in dims):
        raise ValueError("torchpd: the plan cannot be mapped by vmap; it is the same for all environments")


def _field_vmap(op: Any) -> Callable[..., tuple[Tensor, int]]:
    def rule(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[Tensor, int]:
        *tensors, plan = args
        *dims, plan_dims = in_dims
        _check_plan(plan_dims)
        size = info.batch_size
        batch = tensors[0].shape[1 if dims[0] == 0 else 0]
        own = (*[2] * (len(tensors) - 1), 1)
        joined = [_join(t, d, size, batch, n) for t, d, n in zip(tensors, dims, own, strict=True)]
        return _split(op(*joined, plan), size), 0

    return rule


@torch.library.register_vmap("torchpd::elastic_diagonal")
def _diagonal_vmap(
    info: Any, in_dims: tuple[Any, ...], stiffness: Tensor, plan: list[Tensor], *, weighted: bool
) -> tuple[Tensor, int]:
    _check_plan(in_dims[1])
    mapped = stiffness.movedim(in_dims[0], 0)
    rows = _ops.elastic_diagonal(mapped.flatten(0, -2), plan, weighted=weighted)
    return rows.unflatten(0, mapped.shape[:-1]), 0


@torch.library.register_vmap("torchpd::precondition")
def _precondition_vmap(info: Any, in_dims: tuple[Any, ...], field: Tensor, plan: list[Tensor]) -> tuple[Tensor, int]:
    _check_plan(in_dims[1])
    mapped = field.movedim(in_dims[0], 0)
    return _split(_ops.precondition(mapped.flatten(0, 1), plan), info.batch_size), 0


def _rotation_vmap(op: Any) -> Callable[..., tuple[Tensor, int]]:
    def rule(info: Any, in_dims: tuple[int | None, ...], *matrices: Tensor) -> tuple[Tensor, int]:
        moved = [
            m.movedim(d, 0) if d is not None else m.expand(info.batch_size, *m.shape)
            for m, d in zip(matrices, in_dims, strict=True)
        ]
        return op(*moved), 0

    return rule


def _join_step(info: Any, dims: Sequence[Any], tensors: Sequence[Any]) -> tuple[list[Any], list[Tensor]]:
    """Joined (positions, velocities, forces, start) and material."""
    *state, material = tensors
    *state_dims, material_dims = dims
    size = info.batch_size
    batch = state[0].shape[1 if state_dims[0] == 0 else 0]
    joined = [None if t is None else _join(t, d, size, batch, 2) for t, d in zip(state, state_dims, strict=True)]
    values = [
        _join(t, d, size, batch, row.dims) for t, d, row in zip(material, material_dims, MATERIAL_TABLE, strict=True)
    ]
    return joined, values


@torch.library.register_vmap("torchpd::step")
def _step_vmap(
    info: Any,
    in_dims: tuple[Any, ...],
    positions: Tensor,
    velocities: Tensor,
    forces: Tensor | None,
    start: Tensor | None,
    material: list[Tensor],
    plan: list[Tensor],
    **numbers: Any,
) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
    _check_plan(in_dims[5])
    state, values = _join_step(info, in_dims[:5], (positions, velocities, forces, start, material))
    out = _ops.step(*state, values, plan, **numbers)
    return tuple(_split(t, info.batch_size) for t in out), (0, 0, 0)


@torch.library.register_vmap("torchpd::rollout")
def _rollout_vmap(
    info: Any,
    in_dims: tuple[Any, ...],
    positions: Tensor,
    velocities: Tensor,
    forces: Tensor | None,
    material: list[Tensor],
    plan: list[Tensor],
    **numbers: Any,
) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
    _check_plan(in_dims[4])
    state, values = _join_step(info, in_dims[:4], (positions, velocities, forces, material))
    out = _ops.rollout(*state, values, plan, **numbers)
    return tuple(_split(t, info.batch_size, 1) for t in out), (1, 1, 1)


for _name in ("gradient", "hessian_product", "element_energy", "element_energy_product"):
    torch.library.register_vmap(f"torchpd::{_name}", _field_vmap(getattr(_ops, _name)))
for _name in ("nearest_rotation", "rotation_differential"):
    torch.library.register_vmap(f"torchpd::{_name}", _rotation_vmap(getattr(_ops, _name)))
