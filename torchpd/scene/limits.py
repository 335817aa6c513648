"""Strain limits: stretches that a solid or a sheet may have before it becomes stiffer."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.checks import as_array, check_finite, check_shape
from .part import per_item

__all__ = ["DEFAULT_RATIO", "limit_rows"]

Array = NDArray[np.float64]

DEFAULT_RATIO = 30.0  # of the stiffness beyond the limits to that within


def limit_rows(owner: str, limit: Any, stiffness: Any, within: Array, *, of: str, unit: str) -> Array | None:
    """Rows lo, hi and stiffness [N, 3] of N elements, or None without a limit.

    Args:
        owner: name of the part, for errors.
        limit: (lo, hi), or one pair per element [N, 2]; None: no limit.
        stiffness: beyond the limits, a scalar or one value per element; None: `DEFAULT_RATIO` times `within`.
        within: stiffness of each element [N] without the limit.
        of: what an element is.
        unit: of the stiffness.
    """
    count = len(within)
    if limit is None:
        if stiffness is not None:
            raise ValueError(
                f"{owner}.limit_stiffness acts beyond a strain_limit, got it without; give strain_limit too"
            )
        return None
    name = f"{owner}.strain_limit"
    pairs = as_array(name, limit, np.float64)
    pairs = np.tile(pairs, (count, 1)) if pairs.shape == (2,) else pairs
    check_shape(name, pairs, (count, 2), f"least and largest stretch, or one pair per {of}")
    check_finite(name, pairs)
    bad = np.flatnonzero((pairs[:, 0] < 0.0) | (pairs[:, 0] > 1.0) | (pairs[:, 1] < 1.0))
    if bad.size:
        raise ValueError(
            f"{name} must have a least stretch in [0, 1] and a largest of at least 1, so that the rest shape lies "
            f"within, got {pairs[bad[0]].tolist()} at {int(bad[0])} ({bad.size} in all)"
        )
    if stiffness is None:
        beyond = DEFAULT_RATIO * within
    else:
        beyond = per_item(f"{owner}.limit_stiffness", stiffness, count, of=of, unit=unit)
    return np.concatenate([pairs, beyond[:, None]], axis=1)
