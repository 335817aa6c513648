"""Poses of rigid bodies (x, y, z, qw, qx, qy, qz), and the screw from one to another.

The screw turns about one axis and slides along it at constant rates: exp(s xi) for a share s in [0, 1] of the way. A
vertex moves on a helix; the chord between two poses would shrink a body that turns.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["Screw", "placed", "screw_between", "screw_pose"]


@dataclass(frozen=True)
class Screw:
    """Motions of n bodies: a turn phi [n, 3] rad about each origin, and the rate v [n, 3] m of the origin."""

    start: Tensor  # [n, 7]
    end: Tensor  # [n, 7]
    turn: Tensor
    rate: Tensor


def placed(pose: Tensor, points: Tensor) -> Tensor:
    """World positions [n, 3] m of points [n, 3] of bodies at poses [n, 7]."""
    return pose[:, :3] + _rotated(pose[:, 3:], points)


def screw_between(start: Tensor, end: Tensor) -> Screw:
    """The screw of the smaller turn, below pi, from poses [n, 7] to others."""
    turn = _rotation_vector(_product(end[:, 3:], _conjugate(start[:, 3:])))
    # end - start = V v with V = int_0^1 exp(s phi) ds, so v = V^-1 (end - start)
    return Screw(start, end, turn, torch.linalg.solve(_mean_rotation(turn), (end - start)[:, :3, None])[:, :, 0])


def screw_pose(screw: Screw, share: Tensor) -> Tensor:
    """Poses [n, 7] after shares [n] of the way."""
    turn = share[:, None] * screw.turn
    place = screw.start[:, :3] + (_mean_rotation(turn) @ (share[:, None] * screw.rate)[:, :, None])[:, :, 0]
    angle = turn.norm(dim=1, keepdim=True)
    half = 0.5 * torch.special.sinc(0.5 * angle / torch.pi)  # sin (angle / 2) / angle
    quaternion = _product(torch.cat([torch.cos(0.5 * angle), half * turn], dim=1), screw.start[:, 3:])
    moved = torch.cat([place, quaternion / quaternion.norm(dim=1, keepdim=True)], dim=1)
    # ends exactly: a body that stands still keeps its bits
    share = share[:, None]
    return torch.where(share <= 0.0, screw.start, torch.where(share >= 1.0, screw.end, moved))


def _mean_rotation(turn: Tensor) -> Tensor:
    """int_0^1 exp(s phi) ds = 1 + (1 - cos a) / a^2 [phi] + (a - sin a) / a^3 [phi]^2 [n, 3, 3]; a = |phi|."""
    angle = turn.norm(dim=1)
    safe = torch.where(angle > 0.1, angle, 1.0)
    one_minus_cos = 0.5 * torch.special.sinc(0.5 * angle / torch.pi) ** 2
    series = 1.0 / 6.0 - angle**2 / 120.0 + angle**4 / 5040.0 - angle**6 / 362880.0
    minus_sin = torch.where(angle > 0.1, (safe - torch.sin(safe)) / safe**3, series)
    x, y, z = turn.unbind(dim=1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)
    unit = torch.eye(3, dtype=turn.dtype)
    mean: Tensor = unit + one_minus_cos[:, None, None] * cross + minus_sin[:, None, None] * (cross @ cross)
    return mean


def _rotation_vector(quaternion: Tensor) -> Tensor:
    quaternion = torch.where(quaternion[:, :1] < 0.0, -quaternion, quaternion)
    size = quaternion[:, 1:].norm(dim=1, keepdim=True)
    angle = 2.0 * torch.atan2(size, quaternion[:, :1])
    return (
        torch.where(size > 0.0, angle / torch.where(size > 0.0, size, torch.ones_like(size)), 2.0) * quaternion[:, 1:]
    )


def _conjugate(quaternion: Tensor) -> Tensor:
    return torch.cat([quaternion[:, :1], -quaternion[:, 1:]], dim=1)


def _product(a: Tensor, b: Tensor) -> Tensor:
    w = a[:, :1] * b[:, :1] - (a[:, 1:] * b[:, 1:]).sum(dim=1, keepdim=True)
    return torch.cat([w, a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + torch.linalg.cross(a[:, 1:], b[:, 1:])], dim=1)


def _rotated(quaternion: Tensor, points: Tensor) -> Tensor:
    axis = quaternion[:, 1:]
    across = 2.0 * torch.linalg.cross(axis, points)
    rotated: Tensor = points + quaternion[:, :1] * across + torch.linalg.cross(axis, across)
    return rotated
