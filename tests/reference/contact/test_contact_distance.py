"""Closest points of a vertex and a triangle, and of two edges."""

from __future__ import annotations

import pytest
import torch

from torchpd.reference.contact.distance import closest

TRIANGLE = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]


@pytest.mark.parametrize(
    ("point", "distance", "weights"),
    [
        ((0.2, 0.3, 0.5), 0.5, (0.5, 0.2, 0.3)),
        ((2.0, 2.0, 0.0), 3.0 / 2.0**0.5, (0.0, 0.5, 0.5)),
        ((-1.0, -1.0, 1.0), 3.0**0.5, (1.0, 0.0, 0.0)),
        ((0.25, -2.0, 0.0), 2.0, (0.75, 0.25, 0.0)),
    ],
)
def test_point_and_triangle(point: tuple[float, ...], distance: float, weights: tuple[float, ...]) -> None:
    near = closest(torch.tensor([[point, *TRIANGLE]], dtype=torch.float64), 1)
    assert float(near.distance) == pytest.approx(distance, abs=1e-15)
    assert near.weights[0].tolist() == pytest.approx([1.0, *(-w for w in weights)], abs=1e-15)


def edges(*ends: tuple[float, float, float]) -> torch.Tensor:
    return torch.tensor([ends], dtype=torch.float64)


def test_edges_that_cross_in_projection() -> None:
    near = closest(edges((0, 0, 0), (1, 0, 0), (0.5, -1, 0.1), (0.5, 1, 0.1)), 0)
    assert float(near.distance) == pytest.approx(0.1, abs=1e-15)
    assert near.weights[0].tolist() == [0.5, 0.5, -0.5, -0.5]
    assert near.diff[0].tolist() == pytest.approx([0.0, 0.0, -0.1])


@pytest.mark.parametrize("turn", [0.0, 1e-9])
def test_parallel_edges(turn: float) -> None:
    """Turned by 1e-9 rad in their plane, and their direction still separates them."""
    near = closest(edges((0, 0, 0), (1, 0, 0), (0.25, 0, 0.2), (0.75, 0.5 * turn, 0.2)), 0)
    assert float(near.distance) == pytest.approx(0.2, abs=1e-8)
    direction = near.diff[0] / near.distance
    assert float(direction[2]) == pytest.approx(-1.0, abs=1e-8)


def test_no_point_of_either_side_is_nearer() -> None:
    """Against 40 x 40 points of both sides of random pairs: never farther than the least of them."""
    corners = torch.rand((400, 4, 3), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    near = closest(corners, 200)
    u, v = (q.reshape(-1) for q in torch.meshgrid(*[torch.linspace(0, 1, 41, dtype=torch.float64)] * 2, indexing="ij"))
    inside = u + v <= 1.0
    on_triangle = torch.stack([torch.ones_like(u), u + v - 1.0, -u, -v], dim=1)[inside]
    on_edges = torch.stack([1.0 - u, u, v - 1.0, -v], dim=1)
    for of, weights in ((slice(0, 200), on_triangle), (slice(200, 400), on_edges)):
        sampled = torch.einsum("sa,mad->msd", weights, corners[of]).norm(dim=2).amin(dim=1)
        assert (near.distance[of] <= sampled + 1e-15).all()
        # the grid is .025 wide, edges are shorter than sqrt 3: some sample is this near
        assert (sampled <= near.distance[of] + 0.025 * 2.0 * 3.0**0.5).all()
    assert torch.allclose(near.weights[:200, 1:].sum(dim=1), -torch.ones(200, dtype=torch.float64))
    assert torch.allclose(near.weights[200:, :2].sum(dim=1), torch.ones(200, dtype=torch.float64))
