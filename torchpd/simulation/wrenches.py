"""Sums of forces on bodies and colliders, and their torques."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from ..common.checks import to_full_precision
from ..common.reprs import by_sizes
from ..common.small_matrices import tree_sum
from ..scene.contact import Collider, Member, can_touch
from ..scene.part import Body
from ..scene.scene import Scene
from .pair_forces import Met, sums_by

__all__ = ["Loaded", "Wrench", "between", "loaded_bodies", "loaded_colliders", "wrench", "wrenches"]


_Part = TypeVar("_Part", Body, Collider)


class Wrench(NamedTuple):
    """Sum of forces on vertices, and their torque."""

    force: Tensor  # [B, 3] N
    torque: Tensor  # [B, 3] N m, sum of (x' - about) x force
    about: Tensor  # [B, 3] m, the point that the torque is about

    def __repr__(self) -> str:
        return by_sizes(self, self.force, "batch")


class Loaded(NamedTuple):
    """Vertices of a body or a collider, and the point that its torques are about."""

    rows: slice
    positions: Tensor  # [B, n, 3] m
    about: Tensor  # [B, 3] m


def loaded_bodies(scene: Scene, positions: Tensor, masses: Tensor, about: Tensor | None) -> dict[Body, Loaded]:
    """Every body, with its centre of mass or the point `about`."""
    found: dict[Body, Loaded] = {}
    point = None if about is None else _checked_point(about, positions)
    for body in scene.bodies:
        rows = scene.vertex_range(body)
        own, weights = positions[:, rows], masses[..., rows, None]
        center = tree_sum(weights * own) / tree_sum(weights) if point is None else point
        found[body] = Loaded(rows, own, center)
    return found


def loaded_colliders(scene: Scene, met: Met | None, about: Tensor | None) -> dict[Collider, Loaded]:
    """Every collider, with its actual origin or the point `about`; none without `Contact`."""
    found: dict[Collider, Loaded] = {}
    if met is None:
        return found
    point = None if about is None else _checked_point(about, met.places)
    start = sum(len(body.mesh.vertices) for body in scene.bodies)
    for number, collider in enumerate(scene.colliders):
        rows = slice(start, start + len(collider.mesh.vertices))
        found[collider] = Loaded(rows, met.places[:, rows], met.poses[:, number, :3] if point is None else point)
        start = rows.stop
    return found


def _checked_point(about: Tensor, positions: Tensor) -> Tensor:
    if not isinstance(about, Tensor):
        raise TypeError(
            f"about must be a point [3] or [B, 3] as a tensor of {positions.dtype} [m], or None for the centre of mass "
            f"of each body, got {type(about).__name__}; torch.tensor(..., dtype=sim.dtype, device=sim.device) makes one"
        )
    batch = len(positions)
    point: Tensor = to_full_precision(about, positions)
    if point.dtype != positions.dtype or point.device != positions.device:
        raise TypeError(f"about must be {positions.dtype} on {positions.device}, got {point.dtype} on {point.device}")
    if point.shape not in ((3,), (1, 3), (batch, 3)):
        raise ValueError(f"about must be a point [3] or [{batch}, 3] [m], got {list(point.shape)}")
    return point.expand(batch, 3)


def wrench(forces: Tensor, positions: Tensor, about: Tensor) -> Wrench:
    """Sum and torque of forces [B, ..., n, 3] on vertices at positions [B, n, 3]."""
    arms = (positions - about[:, None]).reshape(len(positions), *[1] * (forces.dim() - 3), *positions.shape[1:])
    torque = tree_sum(torch.linalg.cross(arms.expand_as(forces), forces))
    return Wrench(tree_sum(forces), torque, about)


def wrenches(forces: Tensor, parts: Mapping[_Part, Loaded]) -> dict[_Part, Wrench]:
    """Sum and torque on every part of forces [B, ..., V, 3]."""
    return {part: wrench(forces[..., of.rows, :], of.positions, of.about) for part, of in parts.items()}


def between(
    scene: Scene, met: Met | None, parts: Sequence[tuple[Member, Loaded]]
) -> dict[tuple[Member, Member], Wrench]:
    """Force on the first of two parts by the second, for all that can touch.

    Both orders are opposite to the bit. Torques are about the point of the first.

    Args:
        scene: whose parts they are.
        met: the pairs of a step; None without `Contact`.
        parts: all bodies, then all colliders, in the scene's order.
    """
    if met is None or scene.contact is None:
        return {}
    count, flat = len(parts), met.flat
    about = torch.stack([loaded.about for _, loaded in parts], dim=1)
    environment, batch = flat.environment, len(about)
    corners = met.places[environment[:, None], flat.vertices]
    first, second = (met.body.long()[flat.vertices[:, corner]] for corner in (0, 3))
    counts = flat.used & (first != second)
    entries, labels = [], []
    for sign, on, by in ((1.0, first, second), (-1.0, second, first)):
        # weights of side A are positive, those of side B negative
        point = tree_sum((sign * flat.weights).clamp(min=0.0)[..., None] * corners)
        force = sign * flat.force
        torque = torch.linalg.cross(point - about[environment, on], force)
        entries.append(torch.cat([force, torque], dim=-1).double())
        labels.append(torch.where(counts, (environment * count + on) * count + by, batch * count**2))
    # side by side, so that both orders of two parts add up the same
    values, rows = torch.stack(entries, dim=1).flatten(0, 1), torch.stack(labels, dim=1).flatten()
    sums = sums_by(values, rows, batch * count**2, 2 * met.pairs.force.shape[1])
    sums = sums.to(about.dtype).reshape(batch, count**2, 6)
    named = scene.contact.bodies
    taking = [(part, number) for number, (part, _) in enumerate(parts) if not named or part in named]
    return {
        (on, by): Wrench(sums[:, a * count + b, :3], sums[:, a * count + b, 3:], about[:, a])
        for on, a in taking
        for by, b in taking
        if a != b and can_touch(on, by)
    }
