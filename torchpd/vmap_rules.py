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
from torch._C._functorch import is_legacy_batchedtensor
from torch.utils import _pytree as pytree

__all__ = ["Rule", "register_rule"]

Rule = Callable[..., tuple[Any, int]]  # of info, in_dims and arguments: the outputs, and where all of them are mapped

_LIBRARY = torch.library.Library("torchpd", "IMPL")


def register_rule(name: str, rule: Rule) -> None:
    """Make an op of torchpd follow a rule, see `torch.library.register_vmap`."""
    torch.library.register_vmap(f"torchpd::{name}", rule)
    _LIBRARY.impl(name, _for_older_vmap(rule), "Batched")


def _for_older_vmap(rule: Rule) -> Callable[..., Any]:
    def kernel(*args: Any, **numbers: Any) -> Any:
        level = torch._C._vmapmode_increment_nesting() - 1
        torch._C._vmapmode_decrement_nesting()
        leaves, spec = pytree.tree_flatten(args)
        mapped = [isinstance(leaf, Tensor) and is_legacy_batchedtensor(leaf) for leaf in leaves]
        plain = [
            torch._remove_batch_dim(leaf, level, 1, 0) if m else leaf for leaf, m in zip(leaves, mapped, strict=True)
        ]
        dims = [0 if m else None for m in mapped]
        info = SimpleNamespace(batch_size=len(plain[mapped.index(True)]))
        out, dim = rule(info, pytree.tree_unflatten(dims, spec), *pytree.tree_unflatten(plain, spec), **numbers)
        return pytree.tree_map(lambda tensor: torch._add_batch_dim(tensor, dim, level), out)

    return kernel
