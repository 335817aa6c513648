"""Forces of pressure and wind on the vertices of surfaces, as functions of positions and velocities.

Triangles are gathered to vertices in a fixed order, and so are the derivatives: equal bits alone and in a batch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..common.small_matrices import dot, length, tree_sum
from ..scene.loads import Wind, enclosed_volume, wind_surface
from ..scene.scene import Scene

__all__ = ["Blown", "SurfaceLoads"]

Index = NDArray[np.int64]

# The gas law takes volumes of at least this share of that at rest.
_LEAST_VOLUME = 1e-2


class _Corners(torch.autograd.Function):
    """Positions of the corners [B, F, 3, 3] from those of vertices [B, V, 3]."""

    generate_vmap_rule = True

    @staticmethod
    def forward(values: Tensor, triangles: Tensor, around: Tensor) -> Tensor:
        found: Tensor = values.index_select(1, triangles.flatten()).unflatten(1, triangles.shape)
        return found

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[1:])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return _Gathered.apply(gradient, *ctx.saved_tensors), None, None  # type: ignore[no-untyped-call]


class _Gathered(torch.autograd.Function):
    """Sums over the corners at each vertex, [B, F, 3, 3] to [B, V, 3]: the transpose of `_Corners`."""

    generate_vmap_rule = True

    @staticmethod
    def forward(values: Tensor, triangles: Tensor, around: Tensor) -> Tensor:
        rows = values.flatten(1, 2)
        rows = torch.cat([rows, torch.zeros_like(rows[:, :1])], dim=1)
        first, *others = (rows.index_select(1, column) for column in around)
        for other in others:
            first = first + other
        return first

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[1:])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return _Corners.apply(gradient, *ctx.saved_tensors), None, None  # type: ignore[no-untyped-call]


@dataclass(frozen=True, eq=False)
class _Surface:
    """Triangles of a scene, and the corners around each vertex."""

    triangles: Tensor  # [F, 3]
    around: Tensor  # [k, V] of 3 f + corner; 3 F where there are fewer

    @staticmethod
    def of(triangles: Index, vertices: int, device: torch.device) -> _Surface:
        corners = triangles.reshape(-1)
        order = np.argsort(corners, kind="stable")
        counts = np.bincount(corners, minlength=vertices)
        rank = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
        around = np.full((int(counts.max()), vertices), len(corners), dtype=np.int64)
        around[rank, corners[order]] = order
        return _Surface(torch.tensor(triangles, device=device), torch.tensor(around, device=device))

    def corners(self, values: Tensor) -> Tensor:
        """Values of vertices [B, V, 3] at the corners [B, F, 3, 3]."""
        found: Tensor = _Corners.apply(values, self.triangles, self.around)  # type: ignore[no-untyped-call]
        return found

    def thirds(self, forces: Tensor) -> Tensor:
        """Forces of triangles [B, F, 3], a third to each corner, at vertices [B, V, 3]."""
        shared = (forces / 3.0)[:, :, None].expand(-1, -1, 3, -1)
        found: Tensor = _Gathered.apply(shared, self.triangles, self.around)  # type: ignore[no-untyped-call]
        return found


@dataclass(frozen=True, eq=False)
class _Gas:
    """A gas in one surface."""

    surface: _Surface
    ambient: float | None  # [Pa] by the gas law, None for a constant pressure
    rest_volume: float

    def forces(self, positions: Tensor, pascals: Tensor) -> Tensor:
        """p A n of every triangle, with pressures [] or [B] Pa."""
        corners = self.surface.corners(positions)
        areas = _area_vectors(corners)
        if self.ambient is not None:
            volume = _volume(corners, areas).clamp(min=_LEAST_VOLUME * self.rest_volume)
            pascals = (pascals + self.ambient) * (self.rest_volume / volume) - self.ambient
        return self.surface.thirds(pascals[..., None, None] * areas)


@dataclass(frozen=True, eq=False)
class Blown:
    """Wind on the surfaces of all bodies."""

    surface: _Surface
    two_sided: Tensor  # [F]
    shares: Tensor  # [F, 3] of each triangle in the surface around its corners
    drag: float  # rho c / 2 [kg/m^3]

    def forces(self, positions: Tensor, velocities: Tensor, masses: Tensor, time_step: float, wind: Tensor) -> Tensor:
        """Drag of every triangle, with a wind [3] or [B, 3] m/s."""
        areas = _area_vectors(self.surface.corners(positions))
        size = length(areas)
        normals = areas / torch.where(size > 0.0, size, 1.0)[..., None]
        own = self.surface.corners(velocities)
        along = dot(wind[..., None, :] - (own[:, :, 0] + own[:, :, 1] + own[:, :, 2]) / 3.0, normals)
        along = torch.where(self.two_sided | (along < 0.0), along, 0.0)
        at_corners = masses[..., self.surface.triangles] * self.shares
        mass = at_corners[..., 0] + at_corners[..., 1] + at_corners[..., 2]
        push = torch.minimum(self.drag * size * along.abs(), mass / time_step)  # [kg/s]
        return self.surface.thirds((push * along)[..., None] * normals)


@dataclass(frozen=True, eq=False)
class SurfaceLoads:
    """The pressures and the wind of a scene, as forces of a step."""

    gases: tuple[_Gas, ...]
    wind: Blown | None

    @staticmethod
    def of(scene: Scene, dtype: torch.dtype, device: torch.device) -> SurfaceLoads | None:
        """The loads of a scene in the precision of states; None without any."""
        if not scene.pressures and scene.wind is None:
            return None
        gases = []
        for part in scene.pressures:
            triangles = part.triangles + scene.vertex_range(part.body).start
            volume = enclosed_volume(part.body.mesh.vertices, part.triangles)
            surface = _Surface.of(triangles, len(scene.rest_positions), device)
            gases.append(_Gas(surface, part.ambient if part.gas else None, volume))
        return SurfaceLoads(tuple(gases), None if scene.wind is None else _blown(scene, scene.wind, dtype, device))

    def forces(
        self, state: tuple[Tensor, Tensor], masses: Tensor, time_step: float, values: Mapping[str, Tensor]
    ) -> Tensor:
        """Forces on the vertices [B, V, 3] N at the start of a step, differentiable.

        Args:
            state: positions and velocities [B, V, 3].
            masses: of the vertices [V] or [B, V] kg, which limit the wind.
            time_step: [s].
            values: `pressure` [n] or [B, n] Pa and `wind` [3] or [B, 3] m/s, those that the scene has.
        """
        positions, velocities = state
        total = torch.zeros_like(positions)
        for number, gas in enumerate(self.gases):
            total = total + gas.forces(positions, values["pressure"][..., number])
        if self.wind is not None:
            total = total + self.wind.forces(positions, velocities, masses, time_step, values["wind"])
        return total


def _blown(scene: Scene, part: Wind, dtype: torch.dtype, device: torch.device) -> Blown:
    triangles, both = [], []
    for body in scene.bodies:
        surface = wind_surface(body)
        if surface is not None:
            triangles.append(surface[0] + scene.vertex_range(body).start)
            both.append(np.full(len(surface[0]), surface[1]))
    corners, vertices = np.concatenate(triangles), scene.rest_positions
    places = vertices[corners]
    areas = np.linalg.norm(np.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]), axis=1)
    around = np.bincount(corners.reshape(-1), weights=np.repeat(areas, 3), minlength=len(vertices))
    shares = torch.tensor(areas[:, None] / around[corners], dtype=dtype, device=device)
    two_sided = torch.tensor(np.concatenate(both), device=device)
    drag = 0.5 * part.density * part.drag
    return Blown(_Surface.of(corners, len(vertices), device), two_sided, shares, drag)


def _area_vectors(corners: Tensor) -> Tensor:
    """Areas times normals [B, F, 3] of corners [B, F, 3, 3]."""
    origin = corners[:, :, 0]
    doubled: Tensor = torch.linalg.cross(corners[:, :, 1] - origin, corners[:, :, 2] - origin)
    return 0.5 * doubled


def _volume(corners: Tensor, areas: Tensor) -> Tensor:
    """Enclosed volume [B]: sum of x_0 . A n / 3, about a corner of the surface against cancellation."""
    arms = corners[:, :, 0] - corners[:, :1, 0]
    total: Tensor = tree_sum((dot(arms, areas) / 3.0)[..., None])[:, 0]
    return total
