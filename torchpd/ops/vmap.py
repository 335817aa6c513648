"""Registration of vmap rules with both implementations of torch.

`torch.vmap` uses the functorch dispatch key. `torch.autograd.grad(is_grads_batched=True)` runs an older implementation
with another key, which ignores the rules of the first. So do `torch.autograd.functional.jacobian` and `hessian` with
`vectorize=True`.
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

__all__ = ["Rule", "register_rule"]

Rule = Callable[..., tuple[Any, int]]  # from info, in_dims and arguments to the outputs and their mapped dimension

# its functions are private; without them only `torch.vmap` works
_is_mapped: Any = getattr(getattr(torch._C, "_functorch", None), "is_legacy_batchedtensor", None)
_OLDER = _is_mapped is not None and all(hasattr(torch, name) for name in ("_add_batch_dim", "_remove_batch_dim"))
_LIBRARY = torch.library.Library("torchpd", "IMPL")


def register_rule(name: str, rule: Rule) -> None:
    """Register a vmap rule for an op of torchpd, see `torch.library.register_vmap`."""
    torch.library.register_vmap(f"torchpd::{name}", rule)
    if _OLDER:
        _LIBRARY.impl(name, _for_older_vmap(rule), "Batched")


def _for_older_vmap(rule: Rule) -> Callable[..., Any]:
    def kernel(*args: Any, **numbers: Any) -> Any:
        leaves, spec = pytree.tree_flatten(args)
        mapped = [isinstance(leaf, Tensor) and _is_mapped(leaf) for leaf in leaves]
        level = _level_of(leaves[mapped.index(True)])
        plain = [_without(leaf, level) if m else leaf for leaf, m in zip(leaves, mapped, strict=True)]
        dims = [0 if m else None for m in mapped]
        info = SimpleNamespace(batch_size=len(plain[mapped.index(True)]))
        out, dim = rule(info, pytree.tree_unflatten(dims, spec), *pytree.tree_unflatten(plain, spec), **numbers)
        return pytree.tree_map(lambda tensor: torch._add_batch_dim(tensor, dim, level), out)

    return kernel


def _without(tensor: Tensor, level: int) -> Tensor:
    """Unwrap one level of a mapped tensor, its dimension in front; outer levels stay mapped."""
    return torch._remove_batch_dim(tensor, level, 1, 0)


def _level_of(tensor: Tensor) -> int:
    """Find the level by trial: torch counts levels per thread, and autograd has other threads for a GPU."""
    for level in range(1, 9):
        if not _is_mapped(_without(tensor, level)):
            return level
    raise RuntimeError("torchpd: torch's older vmap, which is_grads_batched and vectorize=True run, cannot be nested")
