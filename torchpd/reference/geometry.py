"""Shape gradients of elements, the bound of their majoriser, the operator of deformation gradients; normals; twists."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ..common.tables import PLANES, SPHERES

__all__ = ["Elements", "elements", "gaps_of", "gradient_operator", "sphere_normals", "spreads", "twists"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class Elements:
    """Geometry of the tetrahedra, computed from the rest shape."""

    rest_inverse: Array  # [E, 3, 3] Dm^-1, the columns of Dm being the edges x_1 - x_0, x_2 - x_0, x_3 - x_0 [1/m]
    volumes: Array  # [E] m^3
    shape_gradients: Array  # [E, 4, 3] grad N_a [1/m]
    eigenvalue_bound: Array  # [E] l_e = lambda_max(diag(K)^-1/2 K diag(K)^-1/2), K = grad N grad N^T, between 4/3 and 4


def elements(rest_positions: Array, tets: Index) -> Elements:
    """Geometry of linear tetrahedra; grad N_1..3 are the rows of Dm^-1 and grad N_0 is minus their sum."""
    corners = rest_positions[tets]
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    rest_inverse = np.linalg.inv(edges)
    gradients = np.concatenate([-rest_inverse.sum(axis=1, keepdims=True), rest_inverse], axis=1)
    return Elements(np.asarray(rest_inverse, np.float64), np.linalg.det(edges) / 6.0, gradients, spreads(gradients))


def spreads(gradients: Array) -> Array:
    """l_e [N] of gradients [N, n, d]: the least l with |F|^2 <= l sum_a |g_a|^2 |x_a|^2.

    It is the largest eigenvalue of diag(K)^-1/2 K diag(K)^-1/2 with K = g g^T, without corners of g = 0; n for d = 1.
    """
    lengths = np.linalg.norm(gradients, axis=2, keepdims=True)
    directions = gradients / np.where(lengths > 0.0, lengths, 1.0)
    return np.asarray(np.linalg.eigvalsh(directions @ np.swapaxes(directions, 1, 2))[:, -1])


def gradient_operator(gradients: Array, corners: Index, count: int) -> csr_array:
    """The sparse G [dN, V] with (G x) in rows dn..dn+d-1 equal to F_n^T, F = sum_a x_a (x) g_a."""
    number, corner_count, width = gradients.shape
    rows = np.repeat(np.arange(width * number), corner_count)
    columns = np.repeat(corners, width, axis=0).reshape(-1)
    entries = np.swapaxes(gradients, 1, 2).reshape(-1)
    return csr_array((entries, (rows, columns)), shape=(width * number, count))


def sphere_normals(positions: Array, center: Array) -> tuple[Array, Array]:
    """Outward normals [V, 3] of a sphere at positions, upward at its centre, and distances [V] m from the centre."""
    arms = positions - center
    lengths = np.linalg.norm(arms, axis=1, keepdims=True)
    return np.where(lengths > 0.0, arms / np.maximum(lengths, 1e-300), [0.0, 1.0, 0.0]), lengths[:, 0]


def twists(arms: Array) -> Array:
    """[1, -[r]x] [n, 3, 6]: the displacement of points at arms r [n, 3] by a twist (v, w) is v + w x r."""
    modes = np.zeros((len(arms), 3, 6))
    modes[:, :, :3] = np.eye(3)
    for k in range(3):
        modes[:, :, 3 + k] = np.cross(np.eye(3)[k], arms)
    return modes


def gaps_of(positions: Array, planes: Array, centers: Array, spheres: Array) -> Array:
    """Signed distance [n] m of every position to the nearest plane or sphere; inf without any."""
    gaps = np.full(len(positions), np.inf)
    for plane in planes:
        gaps = np.minimum(gaps, positions @ plane[PLANES["normal"]] - plane[PLANES["height"]])
    for center, sphere in zip(centers, spheres, strict=True):
        gaps = np.minimum(gaps, np.linalg.norm(positions - center, axis=1) - sphere[SPHERES["radius"]])
    return gaps
