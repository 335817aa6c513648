"""Sheets of triangles for tests of cloth, and the deformation of stencils."""

from __future__ import annotations

from typing import Any

import numpy as np

import torchpd as pd
from torchpd.scene.stencils import StencilGroup


def sheet(size: tuple[float, float] = (1.0, 1.0), cells: tuple[int, int] = (4, 4), *, alternating: bool = True) -> Any:
    """Vertices and triangles of a grid in the plane of x and z; vertex (i, j) has the number i (nz + 1) + j.

    Diagonals alternate: in cells of even i + j from (i, j) to (i + 1, j + 1); or they are all of that kind.
    """
    x, z = (np.linspace(0.0, length, count + 1) for length, count in zip(size, cells, strict=True))
    vertices = np.stack([np.repeat(x, len(z)), np.zeros(len(x) * len(z)), np.tile(z, len(x))], axis=1)
    i, j = (index.reshape(-1) for index in np.meshgrid(*(np.arange(count) for count in cells), indexing="ij"))
    a = i * (cells[1] + 1) + j
    b, c, d = a + cells[1] + 1, a + cells[1] + 2, a + 1
    even = np.stack([np.stack([a, c, b], axis=1), np.stack([a, d, c], axis=1)], axis=1)
    odd = np.stack([np.stack([a, d, b], axis=1), np.stack([b, d, c], axis=1)], axis=1)
    turned = ((i + j) % 2 == 1) & alternating
    return vertices, np.where(turned[:, None, None], odd, even).reshape(-1, 3)


def surface(**options: Any) -> pd.TriMesh:
    return pd.TriMesh(*sheet(**options))


def cloth(mesh: pd.TriMesh | None = None, **changed: Any) -> pd.Cloth:
    given = {"youngs": 1e5, "thickness": 1e-3, "area_density": 0.2, **changed}
    return pd.Cloth(surface() if mesh is None else mesh, **given)


def group_of(kind: str, *parts: Any) -> StencilGroup:
    """The stencils of one kind of a scene."""
    (found,) = (group for group in pd.Scene(*parts).values().stencils if group.kind == kind)
    return found


def deformation(group: StencilGroup, positions: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """F = sum_a x_a g_a^T of every stencil [N, 3, d]."""
    return np.einsum("nak,nad->nkd", positions[group.corners], group.gradients)


def bending_energy(group: StencilGroup, positions: np.ndarray[Any, Any]) -> float:
    """sum V kb / 2 (|F| - k0)^2 of hinges."""
    curvature = np.linalg.norm(deformation(group, positions)[:, :, 0], axis=1)
    return float(
        (group.measure * group.material["bending"] / 2.0 * (curvature - group.material["rest_curvature"]) ** 2).sum()
    )
