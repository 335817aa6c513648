"""The search finds all pairs in reach, once, in a fixed order."""

from __future__ import annotations

import torch

from torchpd.reference.contact.boxes import overlaps
from torchpd.reference.contact.distance import closest
from torchpd.reference.contact.search import near_pairs
from torchpd.reference.contact.surfaces import Surfaces


def crowd(seed: int = 0, count: int = 40) -> tuple[Surfaces, torch.Tensor]:
    """Random triangles of two bodies in a box, and random radii."""
    random = torch.Generator().manual_seed(seed)
    centers = torch.rand((count, 1, 3), dtype=torch.float64, generator=random)
    corners = centers + 0.2 * torch.rand((count, 3, 3), dtype=torch.float64, generator=random)
    body = torch.arange(count).remainder(2).repeat_interleave(3)
    surfaces = Surfaces(
        rest=corners.reshape(-1, 3),
        triangles=torch.arange(3 * count).reshape(-1, 3),
        body=body,
        kinematic=body == 1,
        self_contact=torch.tensor([True, False]),
        thickness=0.01,
        friction=torch.tensor([[0.1, 0.2], [0.2, 0.3]], dtype=torch.float64),
    )
    return surfaces, 0.05 * torch.rand(3 * count, dtype=torch.float64, generator=random)


def test_all_pairs_in_reach_are_found() -> None:
    """Against all pairs without boxes."""
    surfaces, radii = crowd()
    x = surfaces.rest + 0.05 * torch.randn(surfaces.rest.shape, dtype=torch.float64)
    found = near_pairs(surfaces, x, radii)
    everything = near_pairs(surfaces, x, torch.full_like(radii, 100.0))
    distance = closest(everything.corners(x), everything.points).distance
    radius = radii[everything.vertices]
    side_a = torch.where(everything.on_a, radius, 0.0).amax(dim=1)
    side_b = torch.where(everything.on_a, 0.0, radius).amax(dim=1)
    expected = everything.keys[distance <= side_a + side_b + surfaces.thickness]
    assert found.keys.tolist() == expected.tolist()
    assert 0 < found.points < len(found) < len(everything)
    points, edges = len(surfaces.vertices), len(surfaces.edges)
    # without those of a triangle with itself: 3 vertices, 3 pairs of edges
    between = 20 * 20
    own = 20 * 19 // 2
    assert len(everything) == (2 * 3 * between + 2 * 3 * own) + (9 * between + 9 * own)
    assert points == edges == 120


def test_the_order_is_that_of_the_keys() -> None:
    surfaces, radii = crowd(1)
    pairs = near_pairs(surfaces, surfaces.rest, radii)
    assert (pairs.keys.diff() > 0).all()
    assert torch.equal(pairs.chosen(torch.arange(0, len(pairs), 2)).keys, pairs.keys[::2])
    bodies = surfaces.body[pairs.vertices[:, [0, 3]]]
    assert torch.equal(pairs.friction, surfaces.friction[bodies[:, 0], bodies[:, 1]])
    assert pairs.on_a.sum(dim=1).tolist() == [1] * pairs.points + [2] * (len(pairs) - pairs.points)


def test_boxes_that_meet() -> None:
    """In chunks as at once; `strict` leaves out those that only touch."""
    low = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    first, second = overlaps(low, low + 1.0, low, low + 1.0)
    assert list(zip(first.tolist(), second.tolist(), strict=True)) == [(0, 0), (0, 1), (1, 0), (1, 1), (2, 2)]
    first, second = overlaps(low, low + 1.0, low, low + 1.0, strict=True)
    assert first.tolist() == second.tolist() == [0, 1, 2]
    random = torch.rand((3000, 3), generator=torch.Generator().manual_seed(0))
    first, second = overlaps(random, random + 0.02, random, random + 0.02)
    assert ((random[first] - random[second]).abs() <= 0.02 + 1e-7).all()
    assert (first == second).sum() == 3000
    assert set(zip(first.tolist(), second.tolist(), strict=True)) == set(
        zip(second.tolist(), first.tolist(), strict=True)
    )
