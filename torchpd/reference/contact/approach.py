"""The start of a step: whole bodies move first, each by a common share of its way.

A body takes the straight way of its velocities, x + h v, if parts of it stay apart all along. Else a body without pins
takes its rigid motion x + h (v_c + omega x (x - c)), an affine map that folds nothing and shortens no distance.
Colliders take their screws.

Parts stay apart along straight ways if one direction separates both ends: the gap along it is concave in the share.
First, bodies that may meet go together by one share, so that what moves alike does not hinder itself. Then each goes on
alone, by the share that planes between bodies allow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from .distance import closest
from .limit import Balls, HalfSpaces, Walls, halved, largest_shares
from .planes import best_of, candidates, gap_along, gap_bounds, make_planes
from .search import boxed_pairs, near_pairs
from .surfaces import Pairs, Surfaces

__all__ = ["Approach", "approach", "rigid_ways"]


@dataclass(frozen=True)
class Approach:
    """Shares of the ways of the bodies, and where these lead."""

    shares: Tensor  # [bodies]
    positions: Tensor  # [N, 3] m


def approach(
    surfaces: Surfaces,
    positions: Tensor,
    want: Tensor,
    masses: Tensor,
    walls: Walls,
    collider_ways: Callable[[Tensor], Tensor],
) -> Approach:
    """Move whole bodies from positions toward `want` [N, 3] m.

    Args:
        surfaces: all bodies.
        positions: [N, 3] m.
        want: [N, 3] m, x + h v out of the planes of the scene, pins and colliders at their targets.
        masses: [N] kg, 0 for colliders.
        walls: of the scene at `positions`; rigid motions do not enter them.
        collider_ways: positions [N, 3] m with the colliders after a share [bodies] of their ways.
    """
    body, count = surfaces.body, len(surfaces.self_contact)
    rigid = rigid_ways(positions, want - positions, masses, body, count)
    deformable = torch.zeros(count, dtype=torch.bool)
    deformable[body[masses > 0.0]] = True
    own = _unfolded(surfaces, positions, want - positions, rigid) & deformable
    pinned = torch.zeros(count, dtype=torch.bool)
    pinned[body[surfaces.kinematic & (masses > 0.0)]] = True
    none = torch.zeros_like(rigid)
    ways = torch.where(own[body, None], want - positions, torch.where(pinned[body, None], none, rigid))

    def way(shares: Tensor) -> Tensor:
        places = positions + shares[body, None] * ways
        whole = torch.where((shares[body] >= 1.0) & own[body], 1.0, 0.0)[:, None]
        places = torch.where(whole > 0.0, want, places)
        return torch.where(deformable[body, None], places, collider_ways(shares))

    # what takes its own way ends out of the planes of the scene already
    outside = Walls(walls.normals, torch.where(own[body, None], -torch.inf, walls.bounds))
    moves = (way(torch.ones(count, dtype=positions.dtype)) - positions).abs().amax(dim=1) > 0.0
    moving = torch.zeros(count, dtype=torch.bool)
    moving[body[moves]] = True
    together = _together(surfaces, positions, way, deformable, moving, outside)
    rest = 1.0 - together
    alone = _alone(surfaces, way(together), lambda shares: way(together + shares * rest), deformable, outside)
    shares = together + alone * rest
    return Approach(shares, way(shares))


def _between(surfaces: Surfaces, start: Tensor, end: Tensor, deformable: Tensor) -> Pairs:
    """Pairs of different bodies that may meet on the way from `start` to `end` [N, 3] m."""
    # a helix leaves the box of its ends by half a chord at most, for a turn below pi
    bow = torch.where(deformable[surfaces.body], 0.0, 0.5 * (end - start).norm(dim=1))
    low, high = torch.minimum(start, end), torch.maximum(start, end)
    pairs = boxed_pairs(surfaces, low, high, bow + 0.5 * surfaces.thickness)
    return pairs.chosen(surfaces.body[pairs.vertices[:, 0]] != surfaces.body[pairs.vertices[:, 3]])


def _together(
    surfaces: Surfaces,
    start: Tensor,
    way: Callable[[Tensor], Tensor],
    deformable: Tensor,
    moving: Tensor,
    walls: Walls,
) -> Tensor:
    """Largest shares [bodies] of the ways, one for all moving bodies that pairs couple."""
    count = len(deformable)
    end = way(torch.ones(count, dtype=start.dtype))
    pairs = _between(surfaces, start, end, deformable)
    normals, least = directions_of(pairs, start, end)
    body = surfaces.body[pairs.vertices[:, [0, 3]]]
    both = body[moving[body].all(dim=1)]
    graph = coo_array((np.ones(len(both)), both.T.numpy()), shape=(count, count))
    group = torch.as_tensor(connected_components(graph, directed=False)[1]).long()
    own = torch.where(moving[body[:, 0]], group[body[:, 0]], group[body[:, 1]])

    def allowed(share: Tensor) -> Tensor:
        places = way(share[group])
        corners = pairs.corners(places)
        gap = gap_along(normals[:, None], corners, pairs.points)[:, 0]
        fine = torch.ones(count, dtype=torch.bool)
        fine[own[(gap < least) | (gap <= gap_bounds(corners))]] = False
        fine[group[surfaces.body[walls.violated(places)]]] = False
        return fine

    held = torch.zeros(count, dtype=torch.bool)
    return halved(allowed, held, start.dtype)[group]


def _alone(
    surfaces: Surfaces, start: Tensor, way: Callable[[Tensor], Tensor], deformable: Tensor, walls: Walls
) -> Tensor:
    """Largest shares [bodies] of the ways from `start` [N, 3] m that walls and planes between bodies allow."""
    count = len(deformable)
    end = way(torch.ones(count, dtype=start.dtype))
    if torch.equal(start, end):
        return torch.ones(count, dtype=start.dtype)
    pairs = _between(surfaces, start, end, deformable)
    planes = make_planes(pairs, start, end, closest(pairs.corners(start), pairs.points))
    stuck = torch.zeros(len(start), dtype=torch.bool)
    stuck[pairs.vertices[planes.frozen]] = True
    anywhere = Balls(start, torch.full_like(start[:, 0], torch.inf))
    return largest_shares(way, surfaces.body, count, HalfSpaces.of(pairs, planes), anywhere, walls, stuck)


def directions_of(pairs: Pairs, start: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
    """The direction [m, 3] with the largest gap at both ends, and the gap [m] m that must be kept along it.

    That is the floor, or the gap at the start where it is less. If no direction has it at both ends, the one with the
    largest gap at the start is taken.
    """
    first, last = pairs.corners(start), pairs.corners(end)
    near = [closest(corners, pairs.points) for corners in (first, last)]
    way = last - first
    relative = (way * pairs.on_a[:, :, None]).sum(dim=1) / pairs.on_a.sum(dim=1, keepdim=True)
    relative = relative - (way * ~pairs.on_a[:, :, None]).sum(dim=1) / (~pairs.on_a).sum(dim=1, keepdim=True)
    length = (relative**2).sum(dim=1, keepdim=True)
    share = (near[0].diff * relative).sum(dim=1, keepdim=True) / torch.where(length > 0.0, length, 1.0)
    across = near[0].diff - share * relative
    among = torch.cat(
        [candidates(first, pairs.points, near[0], across), candidates(last, pairs.points, near[1])], dim=1
    )
    before = gap_along(among, first, pairs.points)
    both, lower = best_of(among, torch.minimum(before, gap_along(among, last, pairs.points)))
    own, largest = best_of(among, before)
    least = torch.minimum(largest, pairs.floor)
    return torch.where((lower >= least)[:, None], both, own), least


def _unfolded(surfaces: Surfaces, positions: Tensor, ways: Tensor, rigid: Tensor) -> Tensor:
    """Whether the parts of each body [bodies] stay apart along `ways` [N, 3] m.

    A rigid motion shortens no distance. So only pairs within reach of the rest of the ways can meet.
    """
    pairs = near_pairs(surfaces, positions, (ways - rigid).norm(dim=1))
    body = surfaces.body[pairs.vertices]
    pairs = pairs.chosen(body[:, 0] == body[:, 3])
    free = torch.ones(len(surfaces.self_contact), dtype=torch.bool)
    if len(pairs):
        end = positions + ways
        normals, least = directions_of(pairs, positions, end)
        corners = pairs.corners(end)
        gap = gap_along(normals[:, None], corners, pairs.points)[:, 0]
        folds = (gap < least) | (least <= gap_bounds(corners))
        free[surfaces.body[pairs.vertices[folds, 0]]] = False
    return free


def rigid_ways(positions: Tensor, ways: Tensor, masses: Tensor, body: Tensor, count: int) -> Tensor:
    """The rigid part w_c + omega x (x - c) [N, 3] m of the ways of every body, by its momenta."""
    sums = torch.zeros(count, dtype=masses.dtype).index_add_(0, body, masses)
    mass = torch.where(sums > 0.0, sums, 1.0)[:, None]

    def total(each: Tensor) -> Tensor:
        return torch.zeros((count, *each.shape[1:]), dtype=each.dtype).index_add_(0, body, each)

    middle, mean = (total(masses[:, None] * each) / mass for each in (positions, ways))
    arms = positions - middle[body]
    momentum = total(masses[:, None] * torch.linalg.cross(arms, ways))
    square = (arms**2).sum(dim=1)[:, None, None] * torch.eye(3, dtype=arms.dtype)
    inertia = total(masses[:, None, None] * (square - arms[:, :, None] * arms[:, None, :]))
    turn = (torch.linalg.pinv(inertia, hermitian=True) @ momentum[:, :, None])[:, :, 0]
    moved: Tensor = mean[body] + torch.linalg.cross(turn[body], arms)
    return moved
