"""vmap rules for the ops of free-form patches.

A mapped dimension of a pose, of points or of quadric matrices joins the leading batch of the op. Arguments without a
batch, such as the surface at rest or a gradient summed over poses, are computed one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ..ops.vmap import Rule, register_rule

__all__: list[str] = []

_ops = torch.ops.torchpd


def _refuse_mapped_lists(dims: Any) -> None:
    if any(dim is not None for dim in dims):
        raise ValueError("torchpd: lists of patches must be the same for all under vmap, got mapped ones")


def _one_by_one(op: Any) -> Rule:
    def rule(info: Any, in_dims: tuple[Any, ...], *args: Any, **options: Any) -> tuple[Any, int]:
        *tensors, lists = args
        *dims, list_dims = in_dims
        _refuse_mapped_lists(list_dims)
        found = []
        for n in range(info.batch_size):
            picked = [t if d is None else t.select(d, n) for t, d in zip(tensors, dims, strict=True)]
            found.append(op(*picked, lists, **options))
        if isinstance(found[0], Tensor):
            return torch.stack(found), 0
        return tuple(torch.stack(parts) for parts in zip(*found, strict=True)), 0

    return rule


def _joined(tensor: Tensor | None, dim: int | None, size: int) -> Tensor | None:
    """Merge the mapped dimension into the batch; shared tensors are repeated."""
    if tensor is None:
        return None
    whole = tensor.expand(size, *tensor.shape) if dim is None else tensor.movedim(dim, 0)
    return whole.flatten(0, 1)


def _with_batch(op: Any, batched: Sequence[int], *, grown: Callable[..., Any] | None = None) -> Rule:
    """A rule for an op whose arguments numbered `batched` have a batch; other mapped arguments run one by one."""
    single = _one_by_one(op)

    def rule(info: Any, in_dims: tuple[Any, ...], *args: Any, **options: Any) -> tuple[Any, int]:
        others = [d for n, d in enumerate(in_dims[:-1]) if n not in batched]
        if any(d is not None for d in others):
            return single(info, in_dims, *args, **options)
        _refuse_mapped_lists(in_dims[-1])
        joined = [
            _joined(a, d, info.batch_size) if n in batched else a
            for n, (a, d) in enumerate(zip(args, in_dims, strict=True))
        ]
        if grown is not None:
            joined = grown(joined, args, in_dims, info.batch_size)
        out = op(*joined, **options)
        if isinstance(out, Tensor):
            return out.unflatten(0, (info.batch_size, -1)), 0
        return tuple(t.unflatten(0, (info.batch_size, -1)) for t in out), 0

    return rule


def _field_matrices(joined: list[Any], args: tuple[Any, ...], in_dims: tuple[Any, ...], size: int) -> list[Any]:
    """Keep one set of matrices; repeat a mapped set for the poses of each map."""
    matrices, dim, batch = args[3], in_dims[3], len(joined[0]) // size
    if dim is None and len(matrices) == 1:
        return joined[:3] + [matrices] + joined[4:]
    whole = matrices.expand(size, *matrices.shape) if dim is None else matrices.movedim(dim, 0)
    spread = whole.expand(size, batch, *whole.shape[2:])
    return joined[:3] + [spread.flatten(0, 1)] + joined[4:]


for _name, _batched, _grown in (
    ("surface", (0, 1), None),
    ("field", (0, 1, 3), _field_matrices),
    ("deformation", (0, 2), None),
    ("frames", (0,), None),
):
    _op = getattr(_ops, f"patch_{_name}")
    register_rule(f"patch_{_name}", _with_batch(_op, _batched, grown=_grown))
    register_rule(f"patch_{_name}_vjp", _one_by_one(getattr(_ops, f"patch_{_name}_vjp")))
for _name in ("height", "height_vjp", "surface_rays", "field_rays"):
    register_rule(f"patch_{_name}", _one_by_one(getattr(_ops, f"patch_{_name}")))
