"""Matrices of every kind that a polar decomposition may meet."""

from __future__ import annotations

import numpy as np
from cases import Array
from scipy.spatial.transform import Rotation

COUNT = 3000


def from_singular_values(values: Array, *, seed: int = 0) -> Array:
    """U diag(s) V^T with random rotations U and V."""
    left = Rotation.random(len(values), random_state=seed).as_matrix()
    right = Rotation.random(len(values), random_state=seed + 1).as_matrix()
    matrices: Array = left * values[:, None, :] @ right
    return matrices


def spread(low: float, high: float, *, seed: int = 5) -> Array:
    return np.random.default_rng(seed).uniform(low, high, (COUNT, 3))


CLASSES: dict[str, Array] = {
    "near rest": from_singular_values(spread(0.9, 1.1)),
    "large strain": from_singular_values(spread(0.1, 4.0)),
    "random": np.random.default_rng(0).standard_normal((COUNT, 3, 3)),
    "inverted": from_singular_values(spread(0.2, 2.0) * [1.0, 1.0, -1.0]),
    "mirrored": from_singular_values(np.tile([1.0, 1.0, -1.0], (COUNT, 1))),
    "point reflection": from_singular_values(np.tile([-1.0, -1.0, -1.0], (COUNT, 1))),
    "nearly mirrored": from_singular_values(spread(0.999, 1.001) * [1.0, 1.0, -1.0]),
    "equal values": from_singular_values(np.repeat(spread(0.1, 3.0)[:, :1], 3, axis=1)),
    "rank two": from_singular_values(spread(0.2, 2.0) * [1.0, 1.0, 0.0]),
    "rank one": from_singular_values(spread(0.2, 2.0) * [1.0, 0.0, 0.0]),
    "nearly rank two": from_singular_values(spread(0.2, 2.0) * [1.0, 1.0, 1e-7]),
    "nearly rank one": from_singular_values(spread(0.2, 2.0) * [1.0, 1e-6, 1e-7]),
    "ambiguous": from_singular_values(spread(0.9, 1.1) * [2.0, 0.0, 0.0] + spread(0.1, 0.5)[:, :1] * [0.0, 1.0, -1.0]),
    "many scales": from_singular_values(10.0 ** spread(-8.0, 8.0)),
    "axis aligned": np.eye(3)[np.array([[0, 1, 2], [1, 2, 0], [2, 0, 1]] * 4)] * np.repeat(
        [[[1.0]], [[0.5]], [[-1.0]], [[-2.0]]], 3, axis=0
    ),
}  # fmt: skip
