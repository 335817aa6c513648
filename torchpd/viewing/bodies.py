"""One surface of all bodies of a scene, to render and to write: solids, sheets, and rods as tubes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.checks import as_array, check_whole
from ..scene.cloth import Cloth
from ..scene.effects import Solid
from ..scene.part import Body
from ..scene.rod import Rod
from ..scene.scene import Scene
from .render import CORAL

__all__ = ["SceneSurface"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# a direction shorter than this share of a unit vector has turned around: any normal serves
_SHORTEST = 1e-6
# linear RGB of the bodies in turn: coral, blue, ochre, green, violet, grey
_COLORS = np.array(
    [CORAL, (0.04, 0.16, 0.42), (0.60, 0.30, 0.03), (0.05, 0.28, 0.16), (0.22, 0.08, 0.36), (0.30, 0.31, 0.33)]
)


class SceneSurface:
    """Surface of all bodies of a scene, for `Studio` and `write_surface`.

    A solid is drawn by its embedded surface, or else by its boundary. A cloth is drawn by its triangles, whose both
    sides are visible. A rod is a closed tube of its radius.

    >>> skin = SceneSurface(sim.scene)
    >>> write_surface("motion.glb", skin.apply(track.positions[:, 0]), skin.triangles, frames_per_second=60)

    Args:
        scene: the scene.
        sides: of the tubes, at least 3.

    Attributes:
        triangles: [T, 3] into the vertices that `apply` returns.
        colors: [n, 3] linear RGB of these vertices, another one for each body, for `Studio(color=)`.
    """

    def __init__(self, scene: Scene, *, sides: int = 8) -> None:
        self._sides = check_whole("SceneSurface: sides", sides, minimum=3)
        self._places = {body: scene.vertex_range(body) for body in scene.bodies}
        self._count = sum(len(body.mesh.vertices) for body in scene.bodies)
        parts: list[Index] = []
        counts: list[int] = []
        for body, place in self._places.items():
            parts.append(self._triangles(body) + sum(counts))
            counts.append(self._drawn(body, scene.rest_positions[None, place]).shape[1])
        self.triangles: Index = np.concatenate(parts)
        self.colors: Array = np.repeat(_COLORS[np.arange(len(counts)) % len(_COLORS)], counts, axis=0)

    def apply(self, positions: Any) -> Array:
        """Vertices of the surface [..., n, 3] m for positions of the scene [..., V, 3]."""
        array = as_array("positions", positions, np.float64, for_picture=True)
        if array.shape[-2:] != (self._count, 3):
            raise ValueError(
                f"SceneSurface.apply: positions must be [..., {self._count}, 3] (vertices of the scene), got "
                f"{list(array.shape)}"
            )
        frames = array.reshape(-1, self._count, 3)
        drawn = np.concatenate([self._drawn(body, frames[:, place]) for body, place in self._places.items()], axis=1)
        return drawn.reshape(*array.shape[:-2], *drawn.shape[1:])

    def _triangles(self, body: Body) -> Index:
        if isinstance(body, Rod):
            return _tube_triangles(len(body.polyline), self._sides)
        if isinstance(body, Solid):
            return body.mesh.boundary() if body.mesh.embedding is None else body.mesh.embedding.surface.triangles
        assert isinstance(body, Cloth)
        return body.surface.triangles

    def _drawn(self, body: Body, frames: Array) -> Array:
        """Surface of a body [T, n, 3] at positions of its vertices [T, V, 3]."""
        if isinstance(body, Rod):
            return _tube(frames, _radii(body), self._sides)
        if isinstance(body, Solid) and body.mesh.embedding is not None:
            return np.asarray(body.mesh.embedding.apply(frames))
        return frames


def _radii(rod: Rod) -> Array:
    """Radius at each vertex: the mean of its segments."""
    ends = np.pad(rod.radius, 1, mode="edge")
    return np.asarray(0.5 * (ends[:-1] + ends[1:]))


def _tube_triangles(vertices: int, sides: int) -> Index:
    """Outward triangles between rings of `sides` vertices, and fans that close the ends."""
    around = np.arange(sides)
    after = (around + 1) % sides
    rings = sides * np.arange(vertices - 1)[:, None]
    a, b, c, d = rings + around, rings + after, rings + sides + around, rings + sides + after
    walls = np.concatenate([np.stack([a, b, d], axis=-1), np.stack([a, d, c], axis=-1)]).reshape(-1, 3)
    fan = np.stack([np.zeros(sides - 2, dtype=np.int64), around[1:-1], around[2:]], axis=1)
    return np.concatenate([walls, fan[:, ::-1], fan + sides * (vertices - 1)])


def _tube(frames: Array, radii: Array, sides: int) -> Array:
    """Rings around the vertices of lines [T, N, 3], as [T, N sides, 3]; normals are carried along without twist."""
    tangents = _tangents(frames)
    normals = np.empty_like(frames)
    normal = _across(tangents[:, 0])
    for number in range(frames.shape[1]):
        tangent = tangents[:, number]
        normal = normal - (normal * tangent).sum(axis=1, keepdims=True) * tangent
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        normal = np.where(length > _SHORTEST, normal / np.maximum(length, _SHORTEST), _across(tangent))
        normals[:, number] = normal
    angle = 2.0 * np.pi * np.arange(sides) / sides
    across = np.cross(tangents, normals)
    ring = np.cos(angle)[:, None] * normals[:, :, None] + np.sin(angle)[:, None] * across[:, :, None]
    return (frames[:, :, None] + radii[:, None, None] * ring).reshape(len(frames), -1, 3)


def _tangents(frames: Array) -> Array:
    """Unit directions at the vertices of lines [T, N, 3]: the mean of both segments, or the first where they cancel."""
    edges = np.diff(frames, axis=1)
    edges = edges / np.maximum(np.linalg.norm(edges, axis=2, keepdims=True), np.finfo(np.float64).tiny)
    before, after = np.concatenate([edges[:, :1], edges], axis=1), np.concatenate([edges, edges[:, -1:]], axis=1)
    both = before + after
    length = np.linalg.norm(both, axis=2, keepdims=True)
    found = np.where(length > _SHORTEST, both / np.maximum(length, _SHORTEST), before)
    return np.where(np.linalg.norm(found, axis=2, keepdims=True) > _SHORTEST, found, [1.0, 0.0, 0.0])


def _across(tangents: Array) -> Array:
    """A unit vector normal to each tangent [T, 3]."""
    axis = np.eye(3)[np.abs(tangents).argmin(axis=1)]
    normal = np.cross(tangents, axis)
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))
