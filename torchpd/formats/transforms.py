"""Rotations in mesh files, as matrices that act on columns."""

from __future__ import annotations

import numpy as np

from .content import Array

__all__ = ["Z_UP", "rotation"]

# from z up to y up: (x, y, z) becomes (x, z, -y)
Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def rotation(axis: Array, degrees: float) -> Array:
    """Rotation matrix [3, 3] by Rodrigues' formula. The axis may have any length; a zero axis gives the identity."""
    x, y, z = np.asarray(axis) / (np.linalg.norm(axis) or 1.0)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.deg2rad(degrees)
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)
