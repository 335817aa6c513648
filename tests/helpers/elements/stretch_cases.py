"""Scenes with strain limits, the volume law and stiffness-proportional damping, with known answers."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from cases import Array, Case, beam_mesh, box
from torch import Tensor

import torchpd as pd

KINDS = ("solid_limit", "cloth_limit", "volume", "damper")
# mean of the x = 1 face [m] of the limited beam, and E* [J], by the stiffness beyond the limits
LIMITED_BEAM = {
    1e6: ((1.01866847, -0.17343950, 0.10036641), 64.384202),
    1e7: ((0.99970532, -0.15216458, 0.10114496), 92.143749),
}
# of the beam at 1e6 with nu = 0.3 by the law "volume"
VOLUME_BEAM = (0.963010, -0.182231, 0.100835)
# F, energy density and entries of P, for a stiffness of one
SHEARED = np.array([[1.1, 0.2, -0.1], [0.05, 0.9, 0.3], [0.0, -0.2, 1.3]])
SHEET = np.array([[1.2, 0.3], [0.0, 0.9], [0.1, -0.4]])


def limited_beam(stiffness: float) -> Case:
    """The beam at 1e5, swung and thrown along, with stretches limited to [0.95, 1.05]."""
    mesh = beam_mesh()
    body = pd.Solid(mesh, 1e5, strain_limit=(0.95, 1.05), limit_stiffness=stiffness)
    velocities = np.zeros_like(mesh.vertices)
    velocities[:, 0] = 3.0 * mesh.vertices[:, 0]
    velocities[:, 1] = -10.0 * mesh.vertices[:, 0] ** 2
    scene = pd.Scene(body, pd.Pin(body, np.arange(36)), pd.Gravity((0.0, -9.8, 0.0)))
    return Case(scene, np.array(mesh.vertices), velocities, 1.0 / 30.0)


def volume_beam() -> Case:
    """The swinging beam at 1e6, nu = 0.3, by the law "volume"."""
    mesh = beam_mesh()
    body = pd.Solid(mesh, 1e6, poisson=0.3, law="volume")
    velocities = np.zeros_like(mesh.vertices)
    velocities[:, 1] = -10.0 * mesh.vertices[:, 0] ** 2
    scene = pd.Scene(body, pd.Pin(body, np.arange(36)), pd.Gravity((0.0, -9.8, 0.0)))
    return Case(scene, np.array(mesh.vertices), velocities, 1.0 / 30.0, start="inertial")


def options_of(kind: str) -> dict[str, Any]:
    """Arguments of a small body that has the kind."""
    return {
        "solid_limit": {"strain_limit": (0.97, 1.02), "limit_stiffness": 2e6},
        "volume": {"poisson": 0.4, "law": "volume"},
        "damper": {"stiffness_damping": 0.02, "poisson": 0.3, "averaging": 1},
        "cloth_limit": {"strain_limit": (0.9, 1.02), "limit_stiffness": 5e3},
    }[kind]


def small_body(kind: str, *, held: bool = True) -> Case:
    """A bar, or a sheet, that swings; one with damping starts from a stretched state."""
    rng = np.random.default_rng(3)
    if kind == "cloth_limit":
        points = np.stack(np.meshgrid(np.linspace(0, 0.4, 5), np.linspace(0, 0.3, 4), indexing="ij"), -1).reshape(-1, 2)
        points = points + 0.02 * rng.standard_normal(points.shape)
        sheet = np.column_stack([points, np.zeros(len(points))])
        body: pd.Solid | pd.Cloth = pd.Cloth(
            pd.TriMesh(sheet, pd_triangles(5, 4)), 1e5, 1e-3, 0.3, bending=1e-4, **options_of(kind)
        )
    else:
        vertices, tets = box((0.4, 0.2, 0.2), (4, 2, 2))
        body = pd.Solid(pd.TetMesh(vertices, tets), 1e5, **options_of(kind))
    vertices = body.mesh.vertices
    grips = (pd.Pin(body, vertices[:, 0] < 0.05),) if held else ()
    scene = pd.Scene(body, pd.Gravity((0.0, -9.8, 0.0)), *grips)
    start = vertices * [1.03, 1.0, 0.98] + 0.002 * rng.standard_normal(vertices.shape)
    velocities = 3.0 * rng.standard_normal(vertices.shape) * vertices[:, :1]
    velocities[:, 0] += 4.0 * vertices[:, 0]
    return Case(scene, start, velocities, 1.0 / 60.0)


def pd_triangles(rows: int, columns: int) -> Any:
    """Triangles of a grid, two a cell."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    one = np.stack([corner, corner + columns, corner + columns + 1], axis=1)
    return np.concatenate([one, np.stack([corner, corner + columns + 1, corner + 1], axis=1)])


def single(kind: str, gradients: Array, **options: Any) -> pd.Simulator:
    """One element with given g_a [n, d] at rest, in float64."""
    width = gradients.shape[1]
    edges = np.linalg.inv(gradients[1:].T)  # rows: rest edges
    rest = np.zeros((width + 1, 3))
    rest[1:, :width] = edges
    chosen = {**options_of(kind), **options}
    if width == 2:
        body: pd.Solid | pd.Cloth = pd.Cloth(
            pd.TriMesh(rest, [[0, 1, 2]]), 1.0, 1.0, 1.0, bending=0.0, rest_uv=rest[None, :, :2], **chosen
        )
    else:
        order = [0, 1, 2, 3] if np.linalg.det(edges) > 0.0 else [0, 2, 1, 3]
        body = pd.Solid(pd.TetMesh(rest, [order]), 1.0, 1.0, **chosen)
    return pd.Simulator(pd.Scene(body), 0.1, iterations=1, dtype=torch.float64, progress=False)


def placed(sim: pd.Simulator, F: Array) -> Tensor:
    """Positions [B, n, 3] of one element with F [B, 3, d] of its rest shape."""
    rest = sim.rest_positions.numpy()[:, : F.shape[2]]
    return torch.tensor(np.einsum("bij,nj->bni", F, rest))


def rows_of(sim: pd.Simulator, **changed: Any) -> list[Tensor]:
    """The material of the ops with other rows by name."""
    names = [row.name for row in pd.common.tables.MATERIAL_TABLE]
    material = sim.material()
    for name, value in changed.items():
        material[names.index(name)] = torch.as_tensor(value, dtype=sim.dtype)
    return material
