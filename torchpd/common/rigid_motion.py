"""The motion of colliders with a mass: free in a step, and what a step leaves of it.

With the mass m, the centre of mass c, the rotation R and the angular momentum L about c, the free motion of a step is

    c_goal = c + h V,   V = v + h (g + F / m);   Q = cay(u) R,   u = h J^-1 L_free,   L_free = L + h T.

cay(u) turns about u by 2 atan(|u| / 2). J is the moment of inertia at the middle of that turn: the midpoint rule, which
keeps L_free. A step ends at c' and cay(u) R (csrc/solver/contact/rigid.h). It leaves

    v' = V + (c' - c_goal) / h,   L' = L_free - (1 + [u] / 2 + u u^T / 4) (L_free - J u / h).

Once converged, m (v' - V) = h f and L' - L_free = h t, with the force f and the torque t of contact at the end.
All is made of sums, products, quotients and roots: others have other bits in vectors than alone.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .small_matrices import dot, inverse, length, product

__all__ = ["FreeMotion", "RigidBodies"]

_MIDPOINT_ROUNDS = 12  # each takes off a factor of about half of the turn
_MIDDLE = 1.0  # most |u| of which the middle is taken
_HALF_TURN = 1e-9  # least cosine of half of a turn


class FreeMotion(NamedTuple):
    """The free motion of a step."""

    poses: Tensor  # [B, C, 7] at its end
    velocity: Tensor  # [B, C, 3] m/s of the centre of mass
    momentum: Tensor  # [B, C, 3] kg m^2/s about it
    inertia: Tensor  # [B, C, 3, 3] kg m^2 in world axes at the middle


class RigidBodies(NamedTuple):
    """Colliders with a mass, among all."""

    is_rigid: Tensor  # [C, 1] bool
    mass: Tensor  # [C, 1] kg, 1 for others
    center: Tensor  # [C, 3] m, in their own axes
    inertia: Tensor  # [C, 3, 3] kg m^2, the identity for others

    def free_motion(
        self, poses: Tensor, motion: Tensor, wrenches: Tensor | None, gravity: Tensor, time_step: float
    ) -> FreeMotion:
        """The free motion from poses [B, C, 7] and velocities [B, C, 6]; gravity [3] or [B, 3]."""
        turn = _rotation(poses[..., 3:])
        arm = _times(turn, self.center)
        velocity = motion[..., :3] + time_step * gravity.unsqueeze(-2)
        momentum = _times(self._at(turn), motion[..., 3:])
        if wrenches is not None:
            force, torque = wrenches[..., :3], wrenches[..., 3:]
            velocity = velocity + (time_step / self.mass) * force
            momentum = momentum + time_step * (torque - torch.linalg.cross(arm, force))
        inertia = self._at(turn)
        for _ in range(_MIDPOINT_ROUNDS):
            by = time_step * _times(inverse(inertia), momentum)
            by = by / (length(by)[..., None] / _MIDDLE).clamp(min=1.0)
            # the mean of two unit quaternions is half way
            inertia = self._at(_rotation(poses[..., 3:] + _turned(by, poses[..., 3:])))
        end = _turned(time_step * _times(inverse(inertia), momentum), poses[..., 3:])
        origin = poses[..., :3] + time_step * velocity + (arm - _times(_rotation(end), self.center))
        return FreeMotion(torch.cat([origin, end], dim=-1), velocity, momentum, inertia)

    def rows(self, free: FreeMotion, time_step: float) -> Tensor:
        """Rows [B C, 13] of the op, csrc/contact/views.h: zeros for colliders without a mass."""
        batch, inertia = len(free.poses), free.inertia * time_step**-2
        mass = (self.mass * time_step**-2).expand(batch, -1, 1)
        sides = [inertia[..., 0, :], inertia[..., 1, 1:], inertia[..., 2, 2:]]
        row = torch.cat([mass, self.center.expand(batch, -1, 3), *sides, free.momentum / time_step], dim=-1)
        return torch.where(self.is_rigid, row, torch.zeros_like(row)).flatten(0, 1)

    def motion_after(self, free: FreeMotion, before: Tensor, poses: Tensor, time_step: float) -> Tensor:
        """Velocities [B, C, 6] of the centre of mass and angular ones, after a step from poses `before`."""
        goal, end = _rotation(free.poses[..., 3:]), _rotation(poses[..., 3:])
        left = (poses[..., :3] - free.poses[..., :3]) + (_times(end, self.center) - _times(goal, self.center))
        turn = _turn_between(before[..., 3:], poses[..., 3:])
        rest = free.momentum - _times(free.inertia, turn) / time_step
        taken = rest + 0.5 * torch.linalg.cross(turn, rest) + 0.25 * dot(turn, rest)[..., None] * turn
        # to the bit where nothing was in the way, and for any turn
        arrived = (poses == free.poses).all(dim=-1, keepdim=True)
        momentum = torch.where(arrived, free.momentum, free.momentum - taken)
        angular = _times(inverse(self._at(end)), momentum)
        moves = torch.cat([free.velocity + left / time_step, angular], dim=-1)
        return torch.where(self.is_rigid, moves, torch.zeros_like(moves))

    def _at(self, turn: Tensor) -> Tensor:
        """Moments of inertia in world axes."""
        return product(product(turn, self.inertia.expand_as(turn)), turn.mT)


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return dot(matrix, vector.unsqueeze(-2).expand_as(matrix))


def _rotation(quaternion: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] of quaternions [..., 4], which need not have length 1."""
    w, x, y, z = quaternion.unbind(-1)
    s = 2.0 / (w * w + x * x + y * y + z * z)
    rows = [
        [1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
        [s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)],
        [s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def _turned(turn: Tensor, quaternion: Tensor) -> Tensor:
    """Unit quaternions turned by Cayley's vectors [..., 3]; without a turn the same bits."""
    own, of, axis = quaternion[..., :1], quaternion[..., 1:], 0.5 * turn
    w = own - dot(axis, of)[..., None]
    across = of + own * axis + torch.linalg.cross(axis, of)
    size = (w * w + dot(across, across)[..., None]).sqrt()
    turns = (turn != 0.0).any(dim=-1, keepdim=True)
    return torch.where(turns, torch.cat([w, across], dim=-1) / size, quaternion)


def _turn_between(start: Tensor, end: Tensor) -> Tensor:
    """Cayley's vectors [..., 3] of the smaller turn from one unit quaternion to another."""
    w, axis = start[..., :1], -start[..., 1:]
    own, of = end[..., :1], end[..., 1:]
    along = own * w - dot(of, axis)[..., None]
    across = own * axis + w * of + torch.linalg.cross(of, axis)
    sign: Tensor = torch.where(along < 0.0, -2.0, 2.0).to(start.dtype)
    turn: Tensor = sign * across / along.abs().clamp(min=_HALF_TURN)
    return turn
