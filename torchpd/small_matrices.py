"""Small matrices that keep their precision: within autocast torch's own products are rounded, there and back."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["inverse", "product"]


def product(A: Tensor, B: Tensor) -> Tensor:
    """A B of [..., n, k] and [..., k, m], with k terms one after another."""
    total = A[..., :, 0, None] * B[..., None, 0, :]
    for k in range(1, A.shape[-1]):
        total = total + A[..., :, k, None] * B[..., None, k, :]
    return total


def inverse(A: Tensor) -> Tensor:
    """Of well-conditioned matrices [..., 3, 3], by Cramer's rule."""
    a, b, c = A.unbind(-1)
    rows = [torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)]
    result: Tensor = torch.stack(rows, dim=-2) / (a * rows[0]).sum(-1)[..., None, None]
    return result
