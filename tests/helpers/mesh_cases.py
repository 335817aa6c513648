"""A mesh that is no grid, volumes with their signs, and closed surfaces."""

from __future__ import annotations

import numpy as np
import trimesh

from torchpd import TetMesh, TriMesh
from torchpd.geometry import shapes


def signed_volumes(mesh: TetMesh) -> np.ndarray:
    x = mesh.vertices[mesh.tets]
    return np.linalg.det(x[:, 1:] - x[:, :1]) / 6.0


def jittered_box(amount: float = 0.2) -> TetMesh:
    mesh = shapes.box((1.0, 0.8, 0.6), (4, 4, 3))
    noise = np.random.default_rng(0).uniform(-amount, amount, mesh.vertices.shape)
    return TetMesh(mesh.vertices + 0.2 * noise, mesh.tets)


def surface_of(made: trimesh.Trimesh) -> TriMesh:
    return TriMesh.from_trimesh(made)


def block(*size: float) -> TriMesh:
    return surface_of(trimesh.creation.box(size))
