"""A bar that hangs from its left end, and how far it has come when that is let go."""

from __future__ import annotations

import numpy as np
from torch import Tensor

import torchpd as pd

H = 1 / 60
BAR = pd.shapes.box((0.3, 0.1, 0.1), (6, 2, 2))
LEFT, RIGHT = (np.flatnonzero(np.abs(BAR.vertices[:, 0] - x) < 1e-6) for x in np.sort(BAR.vertices[:, 0])[[0, -1]])


def fallen(steps: int) -> float:
    """Of a free body from rest by implicit Euler: -g h^2 n (n + 1) / 2 [m]."""
    return -9.81 * H**2 * steps * (steps + 1) / 2


def way(sim: pd.Simulator, positions: Tensor) -> Tensor:
    """Mean height above that at rest, of each environment."""
    return (positions - sim.rest_positions)[..., 1].mean(-1)
