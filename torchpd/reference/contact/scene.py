"""Bodies of a scene and colliders as the surfaces of a step with contact, and the state between steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...scene.cloth import Cloth
from ...scene.effects import Solid
from ...scene.rod import Rod
from ...scene.scene import Scene, SceneValues
from .crossings import crossings
from .distance import closest
from .screws import placed
from .search import near_pairs
from .surfaces import Surfaces, surface_triangles

__all__ = ["Collider", "ContactHistory", "ContactScene", "contact_scene"]

Array = NDArray[np.float64]

STILL = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Collider:
    """A rigid surface that moves by hand.

    Args:
        points: [n, 3] m about its origin.
        triangles: [t, 3].
        pose: (x, y, z, qw, qx, qy, qz) at the start; the origin in world coordinates, and a unit quaternion.
    """

    points: Array
    triangles: NDArray[np.int64]
    pose: Sequence[float] = STILL


@dataclass(frozen=True)
class ContactHistory:
    """What a step leaves for the next one."""

    positions: Tensor  # [N, 3] m, of all vertices at the step's end
    poses: Tensor  # [C, 7] actual poses of the colliders
    keys: Tensor  # [m] of pairs with forces, increasing
    normal: Tensor  # [m] N
    tangential: Tensor  # [m, 3] N


@dataclass(frozen=True)
class ContactScene:
    """Deformable bodies, then colliders, in one array of vertices."""

    values: SceneValues  # of the deformable bodies
    surfaces: Surfaces
    collider: Tensor  # [N] number of the collider of each vertex, -1 for those of bodies
    points: Tensor  # [N, 3] m about the origins of the colliders
    poses: Tensor  # [C, 7] of the colliders at the start

    @property
    def dtype(self) -> torch.dtype:
        return self.surfaces.rest.dtype

    @property
    def count(self) -> int:
        """Number of vertices of the deformable bodies."""
        return len(self.values.rest_positions)

    def collider_places(self, poses: Tensor) -> Tensor:
        """World positions [N - V, 3] m of the vertices of colliders at poses [C, 7]."""
        return placed(poses[self.collider[self.count :]], self.points[self.count :])

    def check_start(self, positions: Tensor) -> None:
        """Refuse positions [N, 3] m that cross, or that touch so closely that no plane separates them.

        Raises:
            ValueError: names the edge and the triangle, or the vertices of the pair.
        """
        found = crossings(self.surfaces, positions)
        body = self.surfaces.body
        if len(found):
            edge, triangle = (int(number) for number in found[0])
            ends, first = self.surfaces.edges[edge], self.surfaces.triangles[triangle, 0]
            raise ValueError(
                f"positions must be free of crossings, got {len(found)}: edge {tuple(ends.tolist())} of body "
                f"{int(body[ends[0]])}, triangle {triangle} of body {int(body[first])}; move the bodies apart"
            )
        pairs = near_pairs(self.surfaces, positions, torch.zeros_like(positions[:, 0]))
        reach = positions[self.surfaces.vertices].abs().sum(dim=1).amax()
        least = 8.0 * torch.finfo(positions.dtype).eps * float(reach)
        distance = closest(pairs.corners(positions), pairs.points).distance
        if len(pairs) and float(distance.min()) <= least:
            four = pairs.vertices[int(distance.argmin())].tolist()
            raise ValueError(
                f"positions must leave {least:.1e} m between surfaces, got {float(distance.min()):.1e} m between "
                f"vertices {four}; leave the thickness of {self.surfaces.thickness} m"
            )


def contact_scene(
    scene: Scene,
    *colliders: Collider,
    thickness: float,
    friction: float | Array = 0.0,
    self_contact: bool | Sequence[bool] = True,
    values: SceneValues | None = None,
    dtype: torch.dtype = torch.float64,
) -> ContactScene:
    """Surfaces of the solids, cloths and rods of a scene and of colliders.

    Args:
        scene: the deformable bodies, bodies 0, 1, ...
        colliders: the next bodies.
        thickness: r [m].
        friction: of every pair of bodies, or a table [bodies, bodies].
        self_contact: of every deformable body, or of each.
        values: arrays of the scene in place of `scene.values()`.
        dtype: of all places and forces of contact.
    """
    values = scene.values() if values is None else values
    places, bodies = [], []
    faces, lines = [torch.zeros((0, 3), dtype=torch.int64)], [torch.zeros((0, 2), dtype=torch.int64)]
    for number, body in enumerate(scene.bodies):
        offset = scene.vertex_range(body).start
        if isinstance(body, Solid):
            faces.append(offset + surface_triangles(torch.as_tensor(np.array(body.mesh.tets))))
        elif isinstance(body, Cloth):
            faces.append(offset + torch.as_tensor(np.array(body.mesh.triangles)))
        elif isinstance(body, Rod):
            lines.append(offset + torch.as_tensor(body.mesh.segments))
        bodies.append(np.full(len(body.mesh.vertices), number))
    own, points = len(scene.bodies), [np.zeros_like(values.rest_positions)]
    start = len(values.rest_positions)
    for number, part in enumerate(colliders):
        faces.append(start + torch.as_tensor(np.array(part.triangles)))
        bodies.append(np.full(len(part.points), own + number))
        points.append(part.points)
        start += len(part.points)
    poses = torch.tensor([list(part.pose) for part in colliders], dtype=dtype).reshape(-1, 7)
    body_of = torch.as_tensor(np.concatenate(bodies))
    local = torch.as_tensor(np.concatenate(points)).to(dtype)
    collider = torch.where(body_of >= own, body_of - own, -1)
    places.append(torch.tensor(values.rest_positions).to(dtype))
    places.append(placed(poses[collider[collider >= 0]], local[collider >= 0]))
    kinematic = collider >= 0
    kinematic[values.pin_vertices[np.isinf(values.pin_stiffness)]] = True
    total = own + len(colliders)
    allowed = torch.zeros(total, dtype=torch.bool)
    allowed[:own] = torch.as_tensor(self_contact)
    surfaces = Surfaces(
        rest=torch.cat(places),
        triangles=torch.cat(faces),
        body=body_of,
        kinematic=kinematic,
        self_contact=allowed,
        thickness=thickness,
        friction=torch.as_tensor(friction, dtype=dtype).expand(total, total),
        segments=torch.cat(lines),
    )
    near_pairs(surfaces, surfaces.rest, torch.full((len(body_of),), thickness, dtype=dtype))  # refuses rest distance 0
    return ContactScene(values, surfaces, collider, local, poses)
