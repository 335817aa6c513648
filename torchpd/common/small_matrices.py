"""Products of small matrices and vectors in full precision; torch's own are rounded under autocast.

Sums run term by term: the order of a torch reduction may depend on the batch.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["dot", "inverse", "length", "product", "root", "tree_sum"]


def product(A: Tensor, B: Tensor) -> Tensor:
    """Product A B of [..., n, k] and [..., k, m], summed over k in order."""
    total = A[..., :, 0, None] * B[..., None, 0, :]
    for k in range(1, A.shape[-1]):
        total = total + A[..., :, k, None] * B[..., None, k, :]
    return total


def inverse(A: Tensor) -> Tensor:
    """Inverse of well-conditioned matrices [..., 3, 3] by Cramer's rule."""
    a, b, c = A.unbind(-1)
    rows = [torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)]
    result: Tensor = torch.stack(rows, dim=-2) / dot(a, rows[0])[..., None, None]
    return result


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Scalar product of vectors [..., 3]."""
    x, y, z = (a * b).unbind(-1)
    return x + y + z


def root(squared: Tensor) -> Tensor:
    """Square root with derivative zero at zero."""
    return torch.where(squared > 0.0, torch.where(squared > 0.0, squared, 1.0).sqrt(), squared)


def length(a: Tensor) -> Tensor:
    """Length of vectors [..., 3], with derivative zero at zero."""
    return root(dot(a, a))


def tree_sum(values: Tensor) -> Tensor:
    """Sum over vertices of [..., n, k] by a binary tree: the same order for any leading dimensions."""
    if values.shape[-2] == 0:
        return values.sum(-2)
    while (count := values.shape[-2]) > 1:
        half = count // 2
        pairs = values[..., :half, :] + values[..., half : 2 * half, :]
        values = torch.cat([pairs, values[..., 2 * half :, :]], dim=-2) if count % 2 else pairs
    return values[..., 0, :]
