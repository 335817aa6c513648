"""Surfaces of several bodies in one array of vertices, and which of their pairs count.

A pair is a vertex and a triangle (PT) or two edges (EE) without a common vertex. Side A is the vertex or the first
edge, side B the triangle or the second edge. Vertices that move by hand, those of colliders and hard pins, are
kinematic: two sides of kinematic vertices alone are never a pair.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from .distance import closest

__all__ = ["FLOOR", "Pairs", "Surfaces", "joined", "surface_triangles"]

FLOOR = 0.1  # least distance of the promise over the thickness


@dataclass(frozen=True)
class Pairs:
    """m pairs: `points` vertices against triangles, then edges against edges."""

    vertices: Tensor  # [m, 4] side A first: 1 + 3, then 2 + 2
    points: int
    keys: Tensor  # [m] a number of the pair that no search changes
    thickness: Tensor  # [m] r_p, m
    friction: Tensor  # [m]

    def __len__(self) -> int:
        return len(self.vertices)

    @property
    def floor(self) -> Tensor:
        """f_p [m] m: no plane lets the sides of a pair come nearer."""
        return FLOOR * self.thickness

    def corners(self, positions: Tensor) -> Tensor:
        """Positions of the four vertices [m, 4, 3] m."""
        return positions[self.vertices]

    @cached_property
    def on_a(self) -> Tensor:
        """Whether each of the four vertices [m, 4] is of side A."""
        number = torch.arange(4).expand(len(self), 4)
        edges = (torch.arange(len(self)) >= self.points).long()[:, None]
        return number <= edges

    def chosen(self, of: Tensor) -> Pairs:
        """Some of the pairs, by a mask or by increasing indices [n]."""
        of = of.nonzero()[:, 0] if of.dtype == torch.bool else of
        points = int((of < self.points).sum())
        return Pairs(self.vertices[of], points, self.keys[of], self.thickness[of], self.friction[of])


@dataclass(frozen=True)
class Surfaces:
    """Triangles and rods of all bodies, with what decides about their pairs."""

    rest: Tensor  # [N, 3] m
    triangles: Tensor  # [T, 3]
    body: Tensor  # [N] number of the body
    kinematic: Tensor  # [N] whether the vertex moves by hand
    self_contact: Tensor  # [bodies] whether parts of a body are pairs
    thickness: float  # r, m: surfaces rest r apart
    friction: Tensor  # [bodies, bodies] of each pair of bodies
    segments: Tensor | None = None  # [n, 2] of rods

    def __post_init__(self) -> None:
        if not self.thickness > 0.0:
            raise ValueError(f"thickness must be positive [m], got {self.thickness}; 1e-3 suits bodies of 0.1 m")
        self._check_resolution()

    def _check_resolution(self) -> None:
        """Rounding must not reach the floor: 64 ulp of places, 256 of the longest edge, which directions turn by."""
        extent = float(self.rest[self.vertices].abs().max())
        longest = float((self.rest[self.edges[:, 1]] - self.rest[self.edges[:, 0]]).norm(dim=1).max())
        least = torch.finfo(self.rest.dtype).eps * max(64.0 * extent, 256.0 * longest) / FLOOR
        if self.thickness < least:
            raise ValueError(
                f"thickness must be at least {least:.3g} m for places of up to {extent:.3g} m and edges of up to "
                f"{longest:.3g} m in {self.rest.dtype}, got {self.thickness}; move the scene to the origin, refine "
                "its triangles, raise thickness or use float64"
            )

    @cached_property
    def edges(self) -> Tensor:
        """Edges of the triangles and of rods [E, 2], each once."""
        sides = torch.cat([self.triangles[:, [0, 1]], self.triangles[:, [1, 2]], self.triangles[:, [2, 0]]])
        sides = sides if self.segments is None else torch.cat([sides, self.segments])
        edges: Tensor = torch.unique(sides.sort(dim=1).values, dim=0)
        return edges

    @cached_property
    def vertices(self) -> Tensor:
        """Ends of the edges [S]."""
        vertices: Tensor = torch.unique(self.edges)
        return vertices

    @cached_property
    def cell(self) -> Tensor:
        """Mean length of the edges of the body of each vertex [N] m."""
        length = (self.rest[self.edges[:, 1]] - self.rest[self.edges[:, 0]]).norm(dim=1)
        of, count = self.body[self.edges[:, 0]], len(self.self_contact)
        sums = torch.zeros(count, dtype=length.dtype).index_add_(0, of, length)
        mean: Tensor = sums / torch.bincount(of, minlength=count).clamp(min=1)
        return mean[self.body]

    def counts(self, vertices: Tensor) -> Tensor:
        """Whether pairs of vertices [m, 4], or of an edge and a triangle [m, 5], may be in contact [m].

        The first one or two columns are side A; only the bodies of the first and the last column are compared.
        """
        body = self.body[vertices]
        same = body[:, 0] == body[:, -1]
        moving = ~self.kinematic[vertices].all(dim=1)
        return moving & (~same | self.self_contact[body[:, 0]])

    def point_pairs(self, vertex: Tensor, triangle: Tensor) -> Pairs:
        """The pairs of vertices [m] with triangles [m] that count, in order."""
        corners = self.triangles[triangle]
        keys = vertex * len(self.triangles) + triangle
        met = (corners == vertex[:, None]).any(dim=1)
        return self._pairs(torch.cat([vertex[:, None], corners], dim=1), keys, met, points=True)

    def edge_pairs(self, first: Tensor, second: Tensor) -> Pairs:
        """The pairs of edges [m] with edges [m] that count, in order."""
        a, b = self.edges[first], self.edges[second]
        keys = len(self.rest) * len(self.triangles) + first * len(self.edges) + second
        met = (a[:, :, None] == b[:, None, :]).any(dim=2).any(dim=1)
        return self._pairs(torch.cat([a, b], dim=1), keys, met, points=False)

    def _pairs(self, vertices: Tensor, keys: Tensor, met: Tensor, *, points: bool) -> Pairs:
        keep = ~met & self.counts(vertices)
        vertices, keys = vertices[keep], keys[keep]
        body = self.body[vertices[:, [0, 3]]]
        count = len(vertices) if points else 0
        thickness = torch.full((len(vertices),), self.thickness, dtype=self.rest.dtype)
        same = body[:, 0] == body[:, 1]
        if same.any():
            own = vertices[same]
            half = 0.5 * closest(self.rest[own], len(own) if points else 0).distance
            if (half == 0.0).any():
                at = own[(half == 0.0).nonzero()[0, 0]].tolist()
                raise ValueError(
                    f"rest positions must keep parts of a body apart, got distance 0 between vertices {at}; "
                    "merge the vertices, or give the parts as bodies of their own"
                )
            thickness[same] = half.clamp(max=self.thickness)
        return Pairs(vertices, count, keys, thickness, self.friction[body[:, 0], body[:, 1]])


def surface_triangles(tets: Tensor) -> Tensor:
    """Faces of tetrahedra [E, 4] that belong to one of them alone [T, 3], wound outward."""
    faces = torch.cat([tets[:, list(side)] for side in ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))])
    _, number, count = torch.unique(faces.sort(dim=1).values, dim=0, return_inverse=True, return_counts=True)
    return faces[count[number] == 1]


def joined(points: Pairs, edges: Pairs) -> Pairs:
    """Pairs of vertices and triangles, then pairs of edges, as one list."""
    return Pairs(
        torch.cat([points.vertices, edges.vertices]),
        len(points),
        torch.cat([points.keys, edges.keys]),
        torch.cat([points.thickness, edges.thickness]),
        torch.cat([points.friction, edges.friction]),
    )
