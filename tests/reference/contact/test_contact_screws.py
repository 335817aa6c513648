"""Poses and the screws between them."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchpd.reference.contact.screws import placed, screw_between, screw_pose


def random_poses(count: int, seed: int) -> Tensor:
    poses = torch.randn((count, 7), dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    poses[:, 3:] /= poses[:, 3:].norm(dim=1, keepdim=True)
    return poses


@pytest.mark.parametrize("scale", [1e-9, 1e-3, 0.05, 1.0])
def test_a_screw_ends_at_its_pose_and_goes_on_as_itself(scale: float) -> None:
    """exp(xi) leads from one to the other; what is left after a share is the same screw."""
    start = random_poses(20, 0)
    end = start + scale * random_poses(20, 1)
    end[:, 3:] /= end[:, 3:].norm(dim=1, keepdim=True)
    points = random_poses(20, 2)[:, :3]
    screw, whole = screw_between(start, end), torch.ones(20, dtype=torch.float64)
    nearly = screw_pose(screw, (1.0 - 1e-15) * whole)
    assert (placed(nearly, points) - placed(end, points)).abs().max() < 1e-13
    part = screw_pose(screw, 0.3 * whole)
    rest = screw_pose(screw_between(part, end), 0.5 * whole)
    assert (placed(rest, points) - placed(screw_pose(screw, 0.65 * whole), points)).abs().max() < 1e-13
    assert torch.equal(screw_pose(screw, whole), end)
    assert torch.equal(screw_pose(screw, 0.0 * whole), start)


def test_a_turning_body_keeps_its_size() -> None:
    """Half way through a quarter turn about an axis through (1, 0, 0): on the arc, not on the chord."""
    start = torch.tensor([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    half = math.sqrt(0.5)
    end = torch.tensor([[1.0, -1.0, 0.2, half, 0.0, 0.0, half]], dtype=torch.float64)
    middle = screw_pose(screw_between(start, end), torch.tensor([0.5], dtype=torch.float64))[0]
    expected = [1.0 - half, -half, 0.1, math.cos(math.pi / 8), 0.0, 0.0, math.sin(math.pi / 8)]
    assert middle.tolist() == pytest.approx(expected, abs=1e-14)
