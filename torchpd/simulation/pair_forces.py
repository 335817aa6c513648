"""Forces between surfaces at the end of a step in scenes with `Contact`.

A step leaves a key for every pair with a force, its multiplier lambda and its friction lambda_t [N]. A pair has four
corners. Side A is a vertex and side B a triangle, or both are edges. At the end of the step the closest points have
weights w_i at the corners, those of side A add up to 1 and those of side B to -1, and n points from B to A. Corner i
gets w_i f with

    f = lambda n + lambda_t.

Forces of a pair therefore add up to zero, at any iterate. Closest points are those of csrc/contact/pairs/closest.h.

Places have the precision of the state, all else is float64. Sums run over entries that are sorted by what they belong
to, in a fixed order: an environment has the same bits in every batch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ..common.reprs import by_sizes
from ..common.small_matrices import dot, length
from .state import ContactHistory

__all__ = ["ContactSurfaces", "Met", "PairForces", "empty_pairs", "pair_forces", "sums_by"]


class PairForces(NamedTuple):
    """Forces between surfaces of `Contact` in a step, by pair.

    Vertices have the scene's numbers: those of all bodies, then those of its colliders. P is the most pairs with a
    force in an environment. Where values must not be read, on a GPU and in compiled code, it is `Contact.capacity`.
    """

    vertices: Tensor  # [B, P, 4] int64: a vertex, then a triangle; or two edges; -1 pads
    weights: Tensor  # [B, P, 4] of the closest points: those of side A add up to 1, those of side B to -1
    normals: Tensor  # [B, P, 3] from side B to side A
    force: Tensor  # [B, P, 3] N, on side A: normal part and friction; side B feels the opposite
    counts: Tensor  # [B] int64, pairs of each environment, the first ones
    on_vertices: Tensor  # [B, V, 3] N, the sum on each vertex of the bodies

    def __repr__(self) -> str:
        return by_sizes(self, self.force, "batch", "pairs")


class Flat(NamedTuple):
    """Pairs of all environments in one list; some of them may be no pairs, with zero force."""

    environment: Tensor  # [m]
    vertices: Tensor  # [m, 4]
    used: Tensor  # [m] whether it is a pair
    weights: Tensor  # [m, 4]
    force: Tensor  # [m, 3] N, on side A


class Met(NamedTuple):
    """What surfaces did to each other in a step."""

    pairs: PairForces
    flat: Flat
    places: Tensor  # [B, N, 3] m, of all vertices at the end of the step
    poses: Tensor  # [B, C, 7] of the colliders there
    forces: Tensor  # [B, N, 3] N, on all vertices
    body: Tensor  # [N] number of the body of each vertex, colliders last


def empty_pairs(positions: Tensor) -> PairForces:
    """No pairs, of a scene without `Contact`."""
    none = positions.new_zeros((len(positions), 0, 4))
    zero = positions.new_zeros(()).expand(positions.shape)
    count = torch.zeros(len(positions), dtype=torch.int64, device=positions.device)
    return PairForces(none.long(), none, none[..., :3], none[..., :3], count, zero)


@dataclass(frozen=True, eq=False)
class ContactSurfaces:
    """Surfaces of a scene as tensors; vertices of bodies, then those of colliders, N in all."""

    triangles: Tensor  # [T, 3]
    edges: Tensor  # [E, 2]
    body: Tensor  # [N] number of the body, colliders last
    collider: Tensor  # [N] number of the collider, -1 for vertices of bodies
    points: Tensor  # [N - V, 3] m, about the origins of the colliders
    cell: Tensor  # [N] m, mean edge of the body
    thickness: Tensor  # [1] m

    @property
    def point_keys(self) -> int:
        """Number of keys of a vertex and a triangle, the first ones."""
        return len(self.body) * len(self.triangles)

    def placed(self, positions: Tensor, poses: Tensor) -> Tensor:
        """Places of all vertices [B, N, 3] m, by positions of bodies and poses [B, C, 7]."""
        if not len(self.points):
            return positions
        pose = poses[:, self.collider[positions.shape[1] :].long()]
        axis = pose[..., 4:]
        across = 2.0 * torch.linalg.cross(axis, self.points.expand_as(axis))
        turned = self.points + pose[..., 3:4] * across + torch.linalg.cross(axis, across)
        return torch.cat([positions, pose[..., :3] + turned], dim=1)

    def corners(self, keys: Tensor) -> tuple[Tensor, Tensor]:
        """Vertices of pairs [m, 4], and whether they are edges [m], by keys of pairs, not negative."""
        edges = keys >= self.point_keys
        faces, count = len(self.triangles), max(len(self.triangles), 1)
        rest = torch.where(edges, keys - self.point_keys, 0)
        first = self.edges.long()[rest // len(self.edges)]
        # the last three corners: of a triangle, or of the first edge and the second one
        sides = torch.cat([self.triangles, torch.nn.functional.pad(self.edges, (1, 0))]).long()
        last = sides[torch.where(edges, faces + rest % len(self.edges), keys % count)]
        middle = torch.where(edges, first[..., 1], last[..., 0])
        vertex = torch.where(edges, first[..., 0], keys // count)
        return torch.stack([vertex, middle, last[..., 1], last[..., 2]], dim=-1), edges

    def check(self, history: ContactHistory) -> None:
        """Refuse keys of another scene; reads their values.

        Raises:
            ValueError: names what came.
        """
        keys, most = history.keys, self.point_keys + len(self.edges) ** 2
        if not keys.numel():
            return
        if int(keys.max()) >= most:
            raise ValueError(
                f"after.history.keys must be of this scene, below {most}, got {int(keys.max())}; give the state that "
                "its own simulator returned"
            )
        if not bool(((keys[:, 1:] > keys[:, :-1]) | (keys[:, 1:] == -1)).all()):
            raise ValueError(
                "after.history.keys must increase, with -1 at the end alone, got others; give the history that a step "
                "returned"
            )

    def check_distances(self, environment: Tensor, vertices: Tensor, distance: Tensor) -> None:
        """Refuse forces between surfaces that no step brought together, by lists of pairs [m].

        No vertex leaves a ball of a quarter of its body's mean edge before the next search. Sides of a pair are then at
        most a mean edge and the thickness apart; twice that edge is refused.
        """
        far = distance.detach() - (2.0 * self.cell[vertices].amax(dim=-1) + self.thickness)
        if bool((far > 0.0).any()):
            pair = int(far.argmax())
            raise ValueError(
                "after.history must be the one that its step left at after.positions, got a force between vertices "
                f"{vertices[pair].tolist()} of environment {int(environment[pair])}, whose surfaces are "
                f"{float(distance[pair].detach()):.3g} m apart; give the state that the step returned"
            )


def readable(tensor: Tensor) -> bool:
    """Whether values may be read without a wait: on the CPU, neither traced nor transformed."""
    traced = torch.compiler.is_compiling() or torch._C._functorch.is_functorch_wrapped_tensor(tensor)
    return tensor.device.type == "cpu" and not traced


def pair_forces(surfaces: ContactSurfaces, positions: Tensor, history: ContactHistory) -> Met:
    """Forces of all pairs at the end of a step.

    Args:
        surfaces: of the scene.
        positions: of the bodies at the end of the step [B, V, 3] m.
        history: that the step left.

    Raises:
        ValueError: for a history of another scene or step, on the CPU.
    """
    used, batch = history.keys >= 0, len(positions)
    counts = used.sum(dim=1)
    if values_are_known := readable(positions) and readable(history.keys):
        surfaces.check(history)
        environment, slot = used.nonzero(as_tuple=True)
        width = int(counts.max()) if batch else 0
    else:
        width = used.shape[1]
        number = torch.arange(batch * width, device=used.device)
        environment, slot = number // width, number % width
    used, key, given = (of[environment, slot] for of in (used, history.keys, history.forces))
    places = surfaces.placed(positions, history.poses)
    count = places.shape[1]
    vertices, edges = surfaces.corners(key.clamp(min=0))
    weights, diff = closest_points(edges, places[environment[:, None], vertices].double())
    distance = length(diff)
    if values_are_known:
        surfaces.check_distances(environment, vertices, distance)
    normals = diff / torch.where(distance > 0.0, distance, 1.0)[:, None]
    force = torch.where(used[:, None], given[:, :1] * normals + given[:, 1:], 0.0)
    entries = (weights[..., None] * force[:, None]).flatten(0, 1)
    labels = torch.where(used[:, None], environment[:, None] * count + vertices, batch * count)
    on_all = sums_by(entries, labels.flatten(), batch * count, 4 * width).reshape(batch, count, 3)
    weights, normals, force, on_all = (of.to(positions.dtype) for of in (weights, normals, force, on_all))

    def padded(values: Tensor, fill: int = 0) -> Tensor:
        empty = torch.full((batch, width, values.shape[-1]), fill, dtype=values.dtype, device=values.device)
        return empty.index_put((environment, slot), torch.where(used[:, None], values, fill))

    by_pair = padded(vertices, -1), padded(weights), padded(normals), padded(force)
    pairs = PairForces(*by_pair, counts=counts, on_vertices=on_all[:, : positions.shape[1]])
    return Met(pairs, Flat(environment, vertices, used, weights, force), places, history.poses, on_all, surfaces.body)


def sums_by(values: Tensor, labels: Tensor, count: int, longest: int) -> Tensor:
    """Sums [count, k] of values [n, k] with labels [n]; other labels than 0 .. count - 1 are left out.

    Values are sorted by label and added by doubling distances, so a sum depends on its own entries alone.

    Args:
        values: to add.
        labels: of the values.
        count: of the sums.
        longest: most values of a label below `count`.
    """
    if not len(labels):
        return values.new_zeros((count, values.shape[-1]))
    labels, order = labels.sort(stable=True)
    values, shift = values[order], 1
    while shift < min(longest, len(labels)):
        same = (labels[shift:] == labels[:-shift]) & (labels[shift:] < count)
        if readable(labels) and not bool(same.any()):
            break
        values = torch.cat([values[:shift], values[shift:] + torch.where(same[:, None], values[:-shift], 0.0)])
        shift *= 2
    wanted = torch.arange(count, device=labels.device)
    last = (torch.searchsorted(labels, wanted, right=True) - 1).clamp(min=0)
    return torch.where((labels[last] == wanted)[:, None], values[last], 0.0)


# ---- closest points


def closest_points(edges: Tensor, corner: Tensor) -> tuple[Tensor, Tensor]:
    """Weights [..., 4] of the closest points of pairs with corners [..., 4, 3], and the way [..., 3] from B to A.

    Args:
        edges: whether the pair is of two edges [...]; else of a vertex and a triangle.
        corner: [m].
    """
    weights = torch.where(edges[..., None], edge_edge_weights(corner), vertex_triangle_weights(corner))
    arms = corner[..., 1:, :] - corner[..., :1, :]
    steps = weights[..., 1:, None] * arms
    return weights, steps[..., 0, :] + steps[..., 1, :] + steps[..., 2, :]


def vertex_triangle_weights(corner: Tensor) -> Tensor:
    """Weights [..., 4] of a vertex and the nearest point of a triangle."""
    vertex, *triangle = corner.unbind(-2)
    arms = [place - vertex for place in triangle]
    none, one = torch.zeros_like(vertex[..., 0]), torch.ones_like(vertex[..., 0])
    candidates = []
    for i, j in ((0, 1), (1, 2), (2, 0)):
        along = triangle[j] - triangle[i]
        share = unit_share(-dot(arms[i], along), dot(along, along))
        weights = [none, none, none]
        weights[i], weights[j] = one - share, share
        candidates.append(torch.stack(weights, dim=-1))
    normal = torch.linalg.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])
    areas = [dot(torch.linalg.cross(arms[(k + 1) % 3], arms[(k + 2) % 3]), normal) for k in range(3)]
    total = areas[0] + areas[1] + areas[2]
    inside = (areas[0] >= 0.0) & (areas[1] >= 0.0) & (areas[2] >= 0.0) & (total > 0.0)
    foot = torch.stack(areas, dim=-1) / torch.where(inside, total, 1.0)[..., None]
    candidates.append(torch.where(inside[..., None], foot, candidates[0]))
    among = torch.stack(candidates, dim=-2)
    between = sum(among[..., k, None] * arms[k][..., None, :] for k in range(3))
    assert isinstance(between, Tensor)
    return torch.cat([one[..., None], -nearest(among, dot(between, between))], dim=-1)


def edge_edge_weights(corner: Tensor) -> Tensor:
    """Weights [..., 4] of the closest points of two edges: an end and an edge, or inside both."""
    first, ahead, second, beyond = corner.unbind(-2)
    p, q, r = ahead - first, beyond - second, first - second
    pp, pq, qq, pr, qr = dot(p, p), dot(p, q), dot(q, q), dot(p, r), dot(q, r)
    none, one = torch.zeros_like(pp), torch.ones_like(pp)
    normal = torch.linalg.cross(p, q)
    inner = unit_share(dot(normal, torch.linalg.cross(q, r)), dot(normal, normal))
    across = unit_share(pq * inner + qr, qq)
    shares = [
        (none, unit_share(qr, qq)),
        (one, unit_share(qr + pq, qq)),
        (unit_share(-pr, pp), none),
        (unit_share(pq - pr, pp), one),
        (unit_share(pq * across - pr, pp), across),
    ]
    among = torch.stack([torch.stack(pair, dim=-1) for pair in shares], dim=-2)
    s, t = among.unbind(-1)
    between = r[..., None, :] + s[..., None] * p[..., None, :] - t[..., None] * q[..., None, :]
    s, t = nearest(among, dot(between, between)).unbind(-1)
    return torch.stack([1.0 - s, s, t - 1.0, -t], dim=-1)


def nearest(among: Tensor, square: Tensor) -> Tensor:
    """Of candidates [..., c, k] the one with the least square [..., c]; the first among equals."""
    least = square.detach().argmin(dim=-1)[..., None, None]
    return among.gather(-2, least.expand(*least.shape[:-1], among.shape[-1])).squeeze(-2)


def unit_share(part: Tensor, whole: Tensor) -> Tensor:
    """part / whole within [0, 1]; 0 for an edge without length."""
    return torch.where(whole > 0.0, part / torch.where(whole > 0.0, whole, 1.0), 0.0).clamp(0.0, 1.0)
