"""Axis-aligned boxes that meet, by brute force in chunks."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["overlaps"]

_CHUNK = 1 << 20  # pairs of boxes tested at a time


def overlaps(
    low: Tensor, high: Tensor, other_low: Tensor, other_high: Tensor, *, strict: bool = False
) -> tuple[Tensor, Tensor]:
    """Numbers i and j of boxes [n, 3] and other boxes [m, 3] that meet, sorted by i, then by j.

    `strict` leaves out boxes that only touch.
    """
    below = torch.lt if strict else torch.le
    rows = max(1, _CHUNK // max(1, len(other_low)))
    first, second = [torch.zeros(0, dtype=torch.int64)], [torch.zeros(0, dtype=torch.int64)]
    # the axis along which the boxes are spread most goes over all pairs, the others over what is left
    spread = torch.cat([low, other_low])
    axes = (spread.amax(0) - spread.amin(0)).argsort(descending=True).tolist() if len(spread) else [0, 1, 2]
    for start in range(0, len(low), rows):
        of, k = slice(start, start + rows), axes[0]
        meet = below(low[of, k, None], other_high[None, :, k]) & below(other_low[None, :, k], high[of, k, None])
        i, j = meet.nonzero(as_tuple=True)
        i = i + start
        for k in axes[1:]:
            meet = below(low[i, k], other_high[j, k]) & below(other_low[j, k], high[i, k])
            i, j = i[meet], j[meet]
        first.append(i)
        second.append(j)
    return torch.cat(first), torch.cat(second)
