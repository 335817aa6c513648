"""Registers the rules for vmap with both that torch has.

`torch.vmap` finds rules by the key of functorch. `torch.autograd.grad(is_grads_batched=True)`, and with it
`torch.autograd.functional.jacobian` and `hessian` with `vectorize=True`, run an older vmap of their own, whose tensors
have another key and which knows nothing of the rules of the first.
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

__all__ = ["Rule", "register_rule"]

Rule = Callable[..., tuple[Any, int]]  # of info, in_dims and arguments: the outputs, and where all of them are mapped

# Its functions are private; without them `torch.vmap` is what there is.
_is_mapped: Any = getattr(getattr(torch._C, "_functorch", None), "is_legacy_batchedtensor", None)
_OLDER = _is_mapped is not None and all(hasattr(torch, name) for name in ("_add_batch_dim", "_remove_batch_dim"))
_LIBRARY = torch.library.Library("torchpd", "IMPL")


def register_rule(name: str, rule: Rule) -> None:
    """Make an op of torchpd follow a rule, see `torch.library.register_vmap`."""
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
    """A mapped tensor with the dimension of a level in front; still mapped if that is not its only one."""
    return torch._remove_batch_dim(tensor, level, 1, 0)


def _level_of(tensor: Tensor) -> int:
    """Found by trial: the count that torch keeps is that of a thread, and autograd has others for a GPU."""
    for level in range(1, 9):
        if not _is_mapped(_without(tensor, level)):
            return level
    raise RuntimeError("torchpd: torch's older vmap, which is_grads_batched and vectorize=True run, cannot be nested")
