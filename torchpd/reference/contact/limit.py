"""The nearest allowed place of every vertex: in its ball, and in the half-spaces of its pairs and of the scene.

All sets are convex, so that a state in them and the straight way to it from another are free of crossings. A free
vertex is projected on the half-spaces that it violates, one after another in up to four rounds, then into its ball.
What is still violated then shortens its way from the present place, which is allowed. Vertices that move by hand take
the largest share of their way instead: a collider one for all its vertices along its screw, each pin one of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from .planes import Planes
from .surfaces import Pairs

__all__ = ["Balls", "HalfSpaces", "Limited", "Walls", "halved", "into_balls", "largest_shares", "limit"]

ROUNDS = 4  # of projections; 1 and 16 end alike
_HALVINGS = 30  # of the interval of a share


def place_margin(positions: Tensor) -> Tensor:
    """Rounding [N] m of n . x at places [N, 3] m."""
    return 2.0 * torch.finfo(positions.dtype).eps * positions.abs().sum(dim=1)


@dataclass(frozen=True)
class Balls:
    """The balls of the vertices, around their places at the last search."""

    centers: Tensor  # [N, 3] m
    radii: Tensor  # [N] m, inf for vertices inside bodies


@dataclass(frozen=True)
class Walls:
    """Half-spaces n . x >= bound of planes and spheres of the scene, linearised, for every vertex."""

    normals: Tensor  # [N, H, 3]
    bounds: Tensor  # [N, H] m, -inf for what moves by hand

    def violated(self, positions: Tensor) -> Tensor:
        """Whether each vertex [N] is outside, beyond rounding."""
        slack = (self.normals * positions[:, None]).sum(dim=2) - self.bounds
        return (slack < -place_margin(positions)[:, None]).any(dim=1)


@dataclass(frozen=True)
class HalfSpaces:
    """The half-spaces of all pairs by vertex: m . x >= c, four of each pair."""

    vertices: Tensor  # [4 m]
    normals: Tensor  # [4 m, 3]
    bounds: Tensor  # [4 m]
    margins: Tensor  # [4 m] rounding of a place, m

    @staticmethod
    def of(pairs: Pairs, planes: Planes) -> HalfSpaces:
        on_a = pairs.on_a
        sign = torch.where(on_a, 1.0, -1.0).to(planes.normals.dtype)
        bounds = torch.where(on_a, planes.above[:, None], -planes.below[:, None])
        return HalfSpaces(
            pairs.vertices.reshape(-1),
            (sign[:, :, None] * planes.normals[:, None]).reshape(-1, 3),
            bounds.reshape(-1),
            planes.margin[:, None].expand(-1, 4).reshape(-1),
        )

    def slack(self, positions: Tensor) -> Tensor:
        """m . x - c [4 m] m."""
        return (self.normals * positions[self.vertices]).sum(dim=1) - self.bounds

    def chosen(self, of: Tensor) -> HalfSpaces:
        return HalfSpaces(self.vertices[of], self.normals[of], self.bounds[of], self.margins[of])


@dataclass(frozen=True)
class Limited:
    """Allowed places, and which vertices did not get where they wanted to."""

    positions: Tensor  # [N, 3] m
    outside: Tensor  # [N] wanted out of the ball
    shortened: Tensor  # [N] took a part of the way


def into_balls(balls: Balls, positions: Tensor) -> tuple[Tensor, Tensor]:
    """Positions [N, 3] m projected into the balls, and whether each was outside [N]."""
    arms = positions - balls.centers
    length = arms.norm(dim=1)
    outside = length > balls.radii * (1.0 + 1e-6)
    inside = balls.centers + (balls.radii / length)[:, None] * arms
    return torch.where(outside[:, None], inside, positions), outside


def limit(
    target: Tensor, positions: Tensor, spaces: HalfSpaces, balls: Balls, walls: Walls, stuck: Tensor, table: Tensor
) -> Limited:
    """Allowed places of free vertices that want to go from `positions` to `target` [N, 3] m.

    `stuck` [N] do not move. `table` [N, M] lists the half-spaces of each vertex in order, 4 m for none.
    """
    aimed, outside = into_balls(balls, target)
    broken = torch.zeros(len(target), dtype=torch.bool)
    broken[spaces.vertices[spaces.slack(aimed) < 0.0]] = True
    broken |= walls.violated(aimed)
    shortened = stuck.clone()
    result = torch.where(stuck[:, None], positions, aimed)
    some = (broken & ~stuck).nonzero()[:, 0]
    if len(some):
        own = table[some]
        own = own[:, : int((own < len(spaces.vertices)).sum(dim=1).amax())]
        none = torch.zeros((1, 3), dtype=target.dtype)
        normals = torch.cat([torch.cat([spaces.normals, none])[own], walls.normals[some]], dim=1)
        bounds = torch.cat([torch.cat([spaces.bounds, none[0, :1] - torch.inf])[own], walls.bounds[some]], dim=1)
        rounding = place_margin(positions[some])[:, None]
        margins = torch.cat(
            [torch.cat([spaces.margins, none[0, :1]])[own], rounding.expand(-1, walls.bounds.shape[1])], dim=1
        )
        moved = _projected(aimed[some], normals, bounds)
        moved = into_balls(Balls(balls.centers[some], balls.radii[some]), moved)[0]
        share = _ray_share(moved, positions[some], normals, bounds - margins)
        cut = share < 1.0
        along = positions[some] + share[:, None] * (moved - positions[some])
        result[some] = torch.where(cut[:, None], along, moved)
        shortened[some] |= cut
    return Limited(result, outside, shortened)


def _projected(points: Tensor, normals: Tensor, bounds: Tensor) -> Tensor:
    """Points [n, 3] after projections on violated half-spaces [n, M] in their order, in up to `ROUNDS` rounds."""
    points, number = points.clone(), torch.arange(bounds.shape[1])
    left = torch.arange(len(points))
    for _ in range(ROUNDS):
        at = torch.full((len(left),), -1)
        moved = torch.zeros(len(left), dtype=torch.bool)
        while True:
            slack = (normals[left] * points[left, None]).sum(dim=2) - bounds[left]
            bad = (slack < 0.0) & (number > at[:, None])
            has = bad.any(dim=1)
            if not has.any():
                break
            first = bad.int().argmax(dim=1)
            row = has.nonzero()[:, 0]
            which, column = left[row], first[row]
            points[which] -= slack[row, column, None] * normals[which, column]
            at = torch.where(has, first, len(number))
            moved |= has
        left = left[moved]
        if not len(left):
            break
    return points


def _ray_share(target: Tensor, start: Tensor, normals: Tensor, bounds: Tensor) -> Tensor:
    """Largest share [n] of the way from `start` that violates no half-space [n, M]."""
    after = (normals * target[:, None]).sum(dim=2) - bounds
    before = ((normals * start[:, None]).sum(dim=2) - bounds).clamp(min=0.0)
    share = torch.where(after < 0.0, before / torch.where(after < 0.0, before - after, torch.ones_like(after)), 1.0)
    return share.amin(dim=1)


def largest_shares(
    way: Callable[[Tensor], Tensor],
    group: Tensor,
    count: int,
    spaces: HalfSpaces,
    balls: Balls,
    walls: Walls,
    stuck: Tensor,
) -> Tensor:
    """Largest shares [count] of the ways of groups at which all their vertices are allowed.

    `way` gives positions [N, 3] m at shares [count]; `group` [N] is -1 for vertices that are not asked. Along a
    straight way the allowed shares are an interval. Places are tested as they are rounded.
    """
    asked = group >= 0
    spaces = spaces.chosen(asked[spaces.vertices])

    def allowed(share: Tensor) -> Tensor:
        places = way(share)
        bad = into_balls(balls, places)[1] | walls.violated(places)
        bad[spaces.vertices[spaces.slack(places) < -spaces.margins]] = True
        fine = torch.ones(count, dtype=torch.bool)
        fine[group[bad & asked]] = False
        return fine

    held = torch.zeros(count, dtype=torch.bool)
    held[group[stuck & asked]] = True
    return halved(allowed, held, balls.radii.dtype)


def halved(allowed: Callable[[Tensor], Tensor], held: Tensor, dtype: torch.dtype, halvings: int = _HALVINGS) -> Tensor:
    """Largest shares [n] in [0, 1] that are `allowed`, by halving; 0 of what is `held` [n]."""
    least, most = torch.zeros(len(held), dtype=dtype), torch.ones(len(held), dtype=dtype)
    whole = allowed(most) & ~held
    if whole.all():
        return most
    for _ in range(halvings):
        middle = torch.where(whole, 1.0, torch.where(held, 0.0, 0.5 * (least + most)))
        fine = allowed(middle)
        least, most = torch.where(fine, middle, least), torch.where(fine, most, middle)
    return torch.where(whole, 1.0, torch.where(held, 0.0, least))
