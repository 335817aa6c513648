"""Forces of pressure and wind on the vertices of surfaces, as functions of positions and velocities.

Triangles are gathered to vertices in a fixed order, and so are the derivatives: equal bits alone and in a batch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..common.small_matrices import dot, length, tree_sum
from ..scene.loads import Pressure, Wind, enclosed_volume, wind_surface
from ..scene.scene import Scene

__all__ = ["LoadInputs", "SurfaceLoads"]

Index = NDArray[np.int64]
LoadInputs = Mapping[Any, Tensor]  # values of a step by Pressure or Wind

# The gas law takes volumes of at least this share of that at rest.
_LEAST_VOLUME = 1e-2


class _Corners(torch.autograd.Function):
    """Positions of the corners [B, F, 3, 3] from those of vertices [B, V, 3]."""

    generate_vmap_rule = True

    @staticmethod
    def forward(values: Tensor, triangles: Tensor, around: Tensor) -> Tensor:
        return values[:, triangles]

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
        total = rows[:, around[:, 0]]
        for column in range(1, around.shape[1]):
            total = total + rows[:, around[:, column]]
        return total

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
    around: Tensor  # [V, k] of 3 f + corner; 3 F where there are fewer

    @staticmethod
    def of(triangles: Index, vertices: int, device: torch.device) -> _Surface:
        corners = triangles.reshape(-1)
        order = np.argsort(corners, kind="stable")
        counts = np.bincount(corners, minlength=vertices)
        rank = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
        around = np.full((vertices, int(counts.max())), len(corners), dtype=np.int64)
        around[corners[order], rank] = order
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
    part: Pressure
    surface: _Surface
    rest_volume: float

    def forces(self, positions: Tensor, given: Tensor | None) -> Tensor:
        corners = self.surface.corners(positions)
        areas = _area_vectors(corners)
        pascals = _given(self.part, "pascals", given, positions, ())
        if pascals is None:
            pascals = positions.new_full((len(positions),), self.part.pascals)
        if self.part.gas:
            least = _LEAST_VOLUME * self.rest_volume
            volume = _volume(corners, areas).clamp(min=least)
            pascals = (pascals + self.part.ambient) * (self.rest_volume / volume) - self.part.ambient
        return self.surface.thirds(pascals[:, None, None] * areas)


@dataclass(frozen=True, eq=False)
class _Blown:
    part: Wind
    velocity: Tensor  # [3]
    surface: _Surface
    two_sided: Tensor  # [F]
    shares: Tensor  # [F, 3] of each triangle in the surface around its corners

    def forces(
        self, positions: Tensor, velocities: Tensor, masses: Tensor, time_step: float, given: Tensor | None
    ) -> Tensor:
        areas = _area_vectors(self.surface.corners(positions))
        size = length(areas)
        normals = areas / torch.where(size > 0.0, size, 1.0)[..., None]
        wind = _given(self.part, "velocity", given, positions, (3,))
        if wind is None:
            wind = self.velocity.expand(len(positions), 3)
        own = self.surface.corners(velocities)
        along = dot(wind[:, None] - (own[:, :, 0] + own[:, :, 1] + own[:, :, 2]) / 3.0, normals)
        along = torch.where(self.two_sided | (along < 0.0), along, 0.0)
        push = 0.5 * self.part.density * self.part.drag * size * along.abs()  # [kg/s]
        at_corners = masses[..., self.surface.triangles] * self.shares
        mass = at_corners[..., 0] + at_corners[..., 1] + at_corners[..., 2]
        return self.surface.thirds((push * along / (1.0 + time_step * push / mass))[..., None] * normals)


class SurfaceLoads:
    """Pressures and winds on the bodies of a scene, as forces of a step.

    Args:
        scene: the scene that is stepped.
        parts: `Pressure` on bodies of that scene, and `Wind`.
        dtype, device: those of states.

    Example:
        >>> loads = SurfaceLoads(scene, [Wind((5.0, 0.0, 0.0))])
        >>> push = loads.forces(*state, sim.masses, sim.time_step)
        >>> state = sim(state, forces=push)
    """

    def __init__(
        self,
        scene: Scene,
        parts: Sequence[Pressure | Wind],
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        place, count = torch.device(device), len(scene.rest_positions)
        self._gases: list[_Gas] = []
        self._winds: list[_Blown] = []
        for part in parts:
            if isinstance(part, Pressure):
                triangles = part.triangles + scene.vertex_range(part.body).start
                volume = enclosed_volume(part.body.mesh.vertices, part.triangles)
                self._gases.append(_Gas(part, _Surface.of(triangles, count, place), volume))
            elif isinstance(part, Wind):
                self._winds.append(_blown(scene, part, count, dtype, place))
            else:
                raise TypeError(f"SurfaceLoads: parts must be Pressure or Wind, got {type(part).__name__}")

    def forces(
        self, positions: Tensor, velocities: Tensor, masses: Tensor, time_step: float, loads: LoadInputs | None = None
    ) -> Tensor:
        """Forces on the vertices [B, V, 3] N at the start of a step, differentiable.

        Args:
            positions: [B, V, 3] m.
            velocities: [B, V, 3] m/s.
            masses: of the vertices [V] or [B, V] kg, which limit the wind.
            time_step: [s].
            loads: pressures [] or [B] Pa, and velocities of the wind [3] or [B, 3] m/s, by part; others are those of
                the parts.
        """
        inputs = dict(loads or {})
        total = torch.zeros_like(positions)
        for gas in self._gases:
            total = total + gas.forces(positions, inputs.pop(gas.part, None))
        for blown in self._winds:
            given = inputs.pop(blown.part, None)
            total = total + blown.forces(positions, velocities, masses, time_step, given)
        if inputs:
            kind = type(next(iter(inputs))).__name__
            raise ValueError(f"loads: this {kind} is none of the parts, which go by identity")
        return total


def _blown(scene: Scene, part: Wind, count: int, dtype: torch.dtype, device: torch.device) -> _Blown:
    triangles, both = [], []
    for body in scene.bodies:
        surface = wind_surface(body)
        if surface is not None:
            triangles.append(surface[0] + scene.vertex_range(body).start)
            both.append(np.full(len(surface[0]), surface[1]))
    if not triangles:
        raise ValueError("Wind: the scene must have a Cloth or a Solid, got none; rods do not feel the wind")
    corners = np.concatenate(triangles)
    places = scene.rest_positions[corners]
    areas = np.linalg.norm(np.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]), axis=1)
    around = np.bincount(corners.reshape(-1), weights=np.repeat(areas, 3), minlength=count)
    shares = torch.tensor(areas[:, None] / around[corners], dtype=dtype, device=device)
    two_sided = torch.tensor(np.concatenate(both), device=device)
    velocity = torch.tensor(part.velocity, dtype=dtype, device=device)
    return _Blown(part, velocity, _Surface.of(corners, count, device), two_sided, shares)


def _given(part: object, name: str, value: Tensor | None, like: Tensor, shape: tuple[int, ...]) -> Tensor | None:
    """A value of a step for every environment [B, *shape], or None."""
    if value is None:
        return None
    owner, batch = f"loads of a {type(part).__name__} ({name})", len(like)
    if not isinstance(value, Tensor):
        raise TypeError(f"{owner} must be a tensor of {like.dtype} on {like.device}, got {type(value).__name__}")
    if value.shape not in (shape, (1, *shape), (batch, *shape)):
        raise ValueError(f"{owner} must be {list(shape)} or {[batch, *shape]}, got {list(value.shape)}")
    if value.dtype != like.dtype or value.device != like.device:
        raise TypeError(f"{owner} must be {like.dtype} on {like.device}, got {value.dtype} on {value.device}")
    expanded: Tensor = value.expand(batch, *shape)
    return expanded


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
