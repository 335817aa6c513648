"""Planes between the sides of a pair: they separate, in float32, and each side keeps to its half-space."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchpd.reference.contact.distance import closest
from torchpd.reference.contact.planes import divide, separate
from torchpd.reference.contact.surfaces import Pairs


def listed(count: int, points: int, thickness: float, dtype: torch.dtype) -> Pairs:
    vertices = torch.arange(4 * count).reshape(count, 4)
    return Pairs(
        vertices, points, torch.arange(count), torch.full((count,), thickness, dtype=dtype), torch.zeros(count)
    )


def random_pairs(count: int, distance: float, seed: int) -> tuple[Tensor, int]:
    """Pairs in a cube of .1 m in float32 whose sides are moved along their direction until they are this far apart."""
    random = torch.Generator().manual_seed(seed)
    corners = 0.1 * torch.rand((count, 4, 3), dtype=torch.float64, generator=random)
    points = count // 2
    near = closest(corners, points)
    on_a = listed(count, points, 1.0, torch.float64).on_a
    for _ in range(3):
        # the hulls may overlap at first; along diff their distance is then made what it should be
        shift = near.diff * (distance / near.distance - 1.0)[:, None]
        corners = torch.where(on_a[:, :, None], corners + shift[:, None], corners)
        near = closest(corners, points)
    return corners.float(), points


@pytest.mark.parametrize("distance", [1e-2, 1e-3, 1e-4, 3e-5])
def test_the_direction_separates(distance: float) -> None:
    """1e5 pairs in float32: the gap is certain, and .99 of the distance, down to 3e-4 of an edge."""
    corners, points = random_pairs(100_000, distance, 1)
    exact = closest(corners.double(), points).distance
    near = closest(corners, points)
    _, gap, bound = separate(corners, points, near)
    assert (exact > 0.9 * distance).float().mean() > 0.99  # hulls that overlapped are few
    apart = exact > 0.9 * distance
    assert (gap > bound)[apart].all()
    assert (gap >= 0.99 * exact)[apart].all()


@pytest.mark.parametrize("distance", [1e-2, 1e-4, 3e-5])
def test_each_side_keeps_to_its_half_space(distance: float) -> None:
    """All vertices lie in theirs to the rounding of a place, and the half-spaces are f + 2 mg apart, to an ulp."""
    corners, points = random_pairs(100_000, distance, 2)
    pairs = listed(len(corners), points, 5e-4, torch.float32)
    want = corners + 0.01 * torch.randn(corners.shape, generator=torch.Generator().manual_seed(3))
    normals, gap, bound = separate(corners, points, closest(corners, points))
    planes = divide(corners, want, pairs.on_a, pairs.floor, normals, gap, bound)
    roomy = gap >= pairs.floor + 2.0 * planes.margin
    assert roomy.any() == (distance > 5e-5)
    heights = (normals.double()[:, None] * corners.double()).sum(dim=2)
    slack = torch.where(pairs.on_a, heights - planes.above[:, None], planes.below[:, None] - heights)
    assert (slack[roomy] >= -planes.margin[roomy, None]).all()
    between = planes.above.double() - planes.below.double()
    ulp = torch.finfo(torch.float32).eps * corners.abs().amax(dim=(1, 2))
    assert ((between - pairs.floor - 2.0 * planes.margin).abs() <= ulp)[roomy].all()
    # below the floor neither side may come nearer
    tight = ~roomy & ~planes.frozen
    assert (slack[tight] <= planes.margin[tight, None]).any(dim=1).all()
    assert (between[tight] >= gap[tight]).all()


def test_the_gap_is_shared_by_who_comes() -> None:
    """A vertex .01 m above a triangle: whoever comes gets 19 of 20 parts of the way down to the floor."""
    x = torch.tensor([[[0.2, 0.2, 0.01], [0, 0, 0], [1, 0, 0], [0, 1, 0]]], dtype=torch.float64)
    pairs, down = listed(1, 1, 0.01, torch.float64), torch.zeros_like(x)
    down[0, 0, 2] = -1.0
    normals, gap, bound = separate(x, 1, closest(x, 1))
    for want, expected in ((x + down, 0.05), (x - down * 0.0, 0.5)):
        planes = divide(x, want, pairs.on_a, pairs.floor, normals, gap, bound)
        assert float(planes.below) == pytest.approx(expected * 0.009, abs=1e-15)
        assert float(planes.above - planes.below) == pytest.approx(1e-3, abs=1e-15)


def test_a_direction_that_separates_nothing_is_said() -> None:
    """A vertex in the plane of a triangle, inside it: frozen."""
    x = torch.tensor([[[0.2, 0.2, 0.0], [0, 0, 0], [1, 0, 0], [0, 1, 0]]], dtype=torch.float64)
    pairs = listed(1, 1, 0.01, torch.float64)
    planes = divide(x, x, pairs.on_a, pairs.floor, *separate(x, 1, closest(x, 1)))
    assert planes.frozen.tolist() == [True]
