"""The list of pairs of a search, with balls, planes and multipliers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from .distance import Closest, closest
from .limit import Balls, HalfSpaces
from .planes import Planes, make_planes
from .prox import Multipliers, directions
from .search import near_pairs, within
from .surfaces import Pairs, Surfaces

__all__ = ["Contacts", "found"]


@dataclass(frozen=True)
class Contacts:
    """Pairs of a search, in their fixed order."""

    pairs: Pairs
    balls: Balls
    planes: Planes
    held: Multipliers
    table: Tensor  # [N, M] half-spaces of each vertex in order

    def near(self, positions: Tensor) -> Closest:
        """Closest points at positions [N, 3] m."""
        return closest(self.pairs.corners(positions), self.pairs.points)

    def normals(self, near: Closest) -> Tensor:
        """Directions of the forces [m, 3] toward side A."""
        return directions(near, self.planes.normals)

    @cached_property
    def spaces(self) -> HalfSpaces:
        return HalfSpaces.of(self.pairs, self.planes)

    def refreshed(self, positions: Tensor, want: Tensor, near: Closest) -> Contacts:
        """The list with new planes at `positions` for pairs whose planes `want` [N, 3] m violates."""
        broken = (self.spaces.slack(want) < 0.0).reshape(-1, 4).any(dim=1) | self.planes.frozen
        some = broken.nonzero()[:, 0]
        if not len(some):
            return self
        pairs = self.pairs.chosen(some)
        own = Closest(near.weights[some], near.diff[some], near.distance[some])
        made = make_planes(pairs, positions, want, own, self.planes.normals[some])
        return replace(self, planes=self.planes.replaced(some, made))

    @property
    def stuck(self) -> Tensor:
        """Vertices [N] of pairs that no plane separates."""
        stuck = torch.zeros(len(self.balls.radii), dtype=torch.bool)
        stuck[self.pairs.vertices[self.planes.frozen]] = True
        return stuck


def found(surfaces: Surfaces, positions: Tensor, want: Tensor, keys: Tensor, known: Multipliers) -> Contacts:
    """The list of a search at positions [N, 3] m whose vertices want to go to `want` [N, 3] m.

    A ball reaches over what its vertex wants and the thickness. Where less than half of the room to the nearest other
    side is wanted, it takes that: no pair more comes into the list. It never exceeds a quarter of an edge. Multipliers
    are those `known` of pairs with the same `keys` [n], increasing; 0 for other pairs.
    """
    cap = 0.25 * surfaces.cell
    pairs = near_pairs(surfaces, positions, cap)
    near = closest(pairs.corners(positions), pairs.points)
    radii = torch.minimum(1.2 * (want - positions).norm(dim=1) + surfaces.thickness * ~surfaces.kinematic, cap)
    room = torch.full_like(cap, torch.inf).scatter_reduce(
        0, pairs.vertices.reshape(-1), near.distance[:, None].expand(-1, 4).reshape(-1), "amin"
    )
    roomy = torch.minimum(0.49 * (room - surfaces.thickness), cap)
    radii = torch.where(surfaces.kinematic, radii, torch.maximum(radii, roomy))
    pairs = pairs.chosen(within(pairs, near.distance, radii, surfaces.thickness))
    inside = torch.ones(len(radii), dtype=torch.bool)
    inside[surfaces.vertices] = False
    balls = Balls(positions, torch.where(inside, torch.inf, radii))
    near = closest(pairs.corners(positions), pairs.points)
    planes = make_planes(pairs, positions, want, near)
    held = _warm(pairs, directions(near, planes.normals), keys, known)
    return Contacts(pairs, balls, planes, held, _table(pairs.vertices, len(positions)))


def _warm(pairs: Pairs, normals: Tensor, keys: Tensor, known: Multipliers) -> Multipliers:
    """Multipliers of the pairs, tangential ones along their surfaces."""
    if not len(keys) or not len(pairs):
        return Multipliers.none(len(pairs), normals.dtype)
    at = torch.searchsorted(keys, pairs.keys).clamp(max=len(keys) - 1)
    same = keys[at] == pairs.keys
    along = known.tangential[at] - (known.tangential[at] * normals).sum(dim=1, keepdim=True) * normals
    return Multipliers(known.normal[at] * same, along * same[:, None])


def _table(vertices: Tensor, count: int) -> Tensor:
    """The entries of each vertex [count, M] among pairs [m, 4] in order; 4 m where a row ends."""
    flat = vertices.reshape(-1)
    order = flat.argsort(stable=True)
    sizes = torch.bincount(flat, minlength=count)
    rank = torch.arange(len(flat)) - (sizes.cumsum(0) - sizes)[flat[order]]
    table = torch.full((count, int(sizes.max()) if len(flat) else 0), len(flat))
    table[flat[order], rank] = order
    return table
