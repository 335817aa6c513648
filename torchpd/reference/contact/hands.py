"""Vertices that move by hand: colliders along their screws, pins of bodies along straight ways."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from .limit import Balls, HalfSpaces, Walls, largest_shares
from .scene import ContactScene
from .screws import Screw, screw_between, screw_pose

__all__ = ["Hands"]


@dataclass(frozen=True)
class Hands:
    """Actual places of what moves by hand, and where it should be at the step's end."""

    scene: ContactScene
    poses: Tensor  # [C, 7] actual
    goals: Tensor  # [C, 7]
    targets: Tensor  # [N, 3] m at the step's end; rows of free vertices have no meaning

    @cached_property
    def _screw(self) -> Screw:
        return screw_between(self.poses, self.goals)

    @cached_property
    def group(self) -> Tensor:
        """Group [N] of each vertex that moves by hand: its collider, or a pin's own; -1 for free ones."""
        pins = self.scene.surfaces.kinematic & (self.scene.collider < 0)
        own = len(self.poses) + pins.cumsum(0) - 1
        return torch.where(pins, own, self.scene.collider)

    def placed(self, positions: Tensor, shares: Tensor) -> Tensor:
        """Positions [N, 3] m with what moves by hand after shares [G] of what is left of its way."""
        group, count, colliders = self.group, self.scene.count, len(self.poses)
        share = torch.cat([shares, shares.new_zeros(1)])[group][:, None]
        straight = positions + share * (self.targets - positions)
        moved = torch.where((group >= colliders)[:, None], torch.where(share >= 1.0, self.targets, straight), positions)
        moved[count:] = self.scene.collider_places(self.moved(shares))
        return moved

    def moved(self, shares: Tensor) -> Tensor:
        """Poses [C, 7] of the colliders after shares [G]."""
        return screw_pose(self._screw, shares[: len(self.poses)])

    def limited(
        self, free: Tensor, positions: Tensor, spaces: HalfSpaces, balls: Balls, walls: Walls, stuck: Tensor
    ) -> tuple[Hands, Tensor, Tensor]:
        """Move by the largest allowed shares.

        `free` [N, 3] m has the new places of free vertices, `positions` the present ones of all. Returns the hands, the
        new places of all, and which vertices are held back [N].
        """
        group = self.group
        count = int(group.max()) + 1 if len(group) else 0
        by_hand = group >= 0
        if torch.equal(positions[by_hand], self.targets[by_hand]):
            arrived = torch.where(by_hand[:, None], positions, free)
            return replace(self, poses=self.goals), arrived, torch.zeros_like(by_hand)
        shares = largest_shares(lambda share: self.placed(positions, share), group, count, spaces, balls, walls, stuck)
        places = self.placed(positions, shares)
        result = torch.where(by_hand[:, None], places, free)
        held = torch.cat([shares < 1.0, torch.zeros(1, dtype=torch.bool)])[group]
        return replace(self, poses=self.moved(shares)), result, held

    def held_back(self, positions: Tensor) -> tuple[Tensor, float]:
        """How far the vertices of each collider [C] and of pins are from their targets at most, m."""
        left = (positions - self.targets).norm(dim=1)
        own = self.scene.collider >= 0
        each = [left[self.scene.collider == number].amax() for number in range(len(self.poses))]
        pins = self.scene.surfaces.kinematic & ~own
        return torch.stack(each) if each else left[:0], float(left[pins].max()) if pins.any() else 0.0
