"""The start of a step: whole bodies move first, each by a common share of its way.

A body takes the straight way of its velocities, x + h v, if parts of it stay apart all along: for every pair within
reach one direction separates both ends of the way, and so all between, since the gap is concave in the share. Else a
body without pins takes its rigid motion x + h (v_c + omega x (x - c)), an affine map that folds nothing and shortens no
distance. Colliders take their screws. Planes between bodies, at the present places, bound the share of each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from .distance import closest
from .limit import Balls, HalfSpaces, Walls, largest_shares
from .planes import gap_along, make_planes, separate
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
    bounds = torch.where(own[body, None], -torch.inf, walls.bounds)
    return _allowed(surfaces, positions, way, deformable, Walls(walls.normals, bounds))


def _allowed(
    surfaces: Surfaces, positions: Tensor, way: Callable[[Tensor], Tensor], deformable: Tensor, walls: Walls
) -> Approach:
    """Largest shares that the walls and planes between different bodies at `positions` [N, 3] m allow."""
    count = len(deformable)
    end = way(torch.ones(count, dtype=positions.dtype))
    # a helix leaves the box of its ends by half a chord at most, for a turn below pi
    bow = torch.where(deformable[surfaces.body], 0.0, 0.5 * (end - positions).norm(dim=1))
    low, high = torch.minimum(positions, end), torch.maximum(positions, end)
    pairs = boxed_pairs(surfaces, low, high, bow + 0.5 * surfaces.thickness)
    pairs = pairs.chosen(surfaces.body[pairs.vertices[:, 0]] != surfaces.body[pairs.vertices[:, 3]])
    near = closest(pairs.corners(positions), pairs.points)
    planes = make_planes(pairs, positions, end, near)
    stuck = torch.zeros(len(positions), dtype=torch.bool)
    stuck[pairs.vertices[planes.frozen]] = True
    anywhere = Balls(positions, torch.full_like(positions[:, 0], torch.inf))
    spaces = HalfSpaces.of(pairs, planes)
    shares = largest_shares(way, surfaces.body, count, spaces, anywhere, walls, stuck)
    return Approach(shares, way(shares))


def _unfolded(surfaces: Surfaces, positions: Tensor, ways: Tensor, rigid: Tensor) -> Tensor:
    """Whether the parts of each body [bodies] stay apart along `ways` [N, 3] m.

    A rigid motion shortens no distance. So only pairs within reach of the rest of the ways can meet.
    """
    pairs = near_pairs(surfaces, positions, (ways - rigid).norm(dim=1))
    body = surfaces.body[pairs.vertices]
    pairs = pairs.chosen(body[:, 0] == body[:, 3])
    free = torch.ones(len(surfaces.self_contact), dtype=torch.bool)
    if len(pairs):
        free[surfaces.body[pairs.vertices[~_keeps_apart(pairs, positions, positions + ways), 0]]] = False
    return free


def _keeps_apart(pairs: Pairs, start: Tensor, end: Tensor) -> Tensor:
    """Whether one direction separates the sides of each pair [m] at both ends, no nearer than before or than f."""
    ends = [pairs.corners(start), pairs.corners(end)]
    result = torch.zeros(len(pairs), dtype=torch.bool)
    before = separate(ends[0], pairs.points, closest(ends[0], pairs.points))[1]
    least = torch.minimum(before, pairs.floor)
    for corners in ends:
        normals, _, bound = separate(corners, pairs.points, closest(corners, pairs.points))
        gaps = [gap_along(normals, other, pairs.points) for other in ends]
        result |= (gaps[0] > bound) & (gaps[1] > bound) & (gaps[1] >= least) & (gaps[0] >= least)
    return result


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
