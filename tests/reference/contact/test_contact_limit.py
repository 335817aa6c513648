"""Places that the promise allows: half-spaces, balls, planes of the scene, and shares of what moves by hand."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchpd.reference.contact.distance import closest
from torchpd.reference.contact.limit import Balls, HalfSpaces, Walls, largest_shares, limit
from torchpd.reference.contact.lists import found
from torchpd.reference.contact.planes import make_planes
from torchpd.reference.contact.prox import Multipliers
from torchpd.reference.contact.surfaces import Pairs, Surfaces

DOUBLE = torch.float64
ROOMY = torch.full((4,), 10.0, dtype=DOUBLE)


def vertex_over_triangle(height: float) -> tuple[Tensor, Pairs]:
    """A vertex over the middle of a triangle; r = .01 m, f = 1 mm."""
    x = torch.tensor([[0.25, height, 0.25], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], dtype=DOUBLE)
    one = torch.ones(1, dtype=DOUBLE)
    return x, Pairs(torch.arange(4)[None], 1, torch.zeros(1, dtype=torch.int64), 0.01 * one, 0.0 * one)


def no_walls(count: int = 4) -> Walls:
    return Walls(torch.zeros((count, 0, 3), dtype=DOUBLE), torch.zeros((count, 0), dtype=DOUBLE))


def moved(x: Tensor, pairs: Pairs, want: Tensor, radii: Tensor = ROOMY, walls: Walls | None = None) -> Tensor:
    planes = make_planes(pairs, x, want, closest(pairs.corners(x), 1))
    stuck = torch.zeros(4, dtype=torch.bool)
    table = torch.arange(4)[:, None]
    balls = Balls(x, radii)
    return limit(want, x, HalfSpaces.of(pairs, planes), balls, walls or no_walls(), stuck, table).positions


def shifted(x: Tensor, way: tuple[float, float, float]) -> Tensor:
    """The vertex wants to move; the triangle does not."""
    want = x.clone()
    want[0] += torch.tensor(way, dtype=DOUBLE)
    return want


def test_a_vertex_at_its_floor() -> None:
    """Pushed in, it does not move in; pushed along, it slides; pushed away, it leaves."""
    x, pairs = vertex_over_triangle(1e-3)
    into = moved(x, pairs, shifted(x, (0.0, -0.5, 0.0)))
    assert (into - x).abs().max() < 1e-15
    along = moved(x, pairs, shifted(x, (0.1, -0.5, 0.2)))
    assert along[0].tolist() == pytest.approx([0.35, 1e-3, 0.45], abs=1e-15)
    away = moved(x, pairs, shifted(x, (0.1, 0.5, 0.2)))
    assert (away - shifted(x, (0.1, 0.5, 0.2))).abs().max() < 1e-15


@pytest.mark.parametrize("height", [0.5, 1e-3, 1e-4, 1e-6])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_floor_holds_for_ever(height: float, dtype: torch.dtype) -> None:
    """A hundred pushes into the triangle with planes made anew: down to f where there is room, else no nearer.

    Below the floor each iterate leaves by the rounding of a place, 2 eps of |x|_1.
    """
    x, pairs = vertex_over_triangle(height)
    x = x.to(dtype)
    pairs = Pairs(pairs.vertices, 1, pairs.keys, pairs.thickness.to(dtype), pairs.friction.to(dtype))
    random = torch.Generator().manual_seed(0)
    ulp, radii = torch.finfo(dtype).eps, ROOMY.to(dtype)
    walls = Walls(*(part.to(dtype) for part in (no_walls().normals, no_walls().bounds)))
    for _ in range(100):
        want = x.clone()
        want[0, 1] -= 1.0
        want[0, [0, 2]] = 0.25 + 0.01 * torch.randn(2, dtype=dtype, generator=random)
        x = moved(x, pairs, want, radii, walls)
        x[1:] = vertex_over_triangle(height)[0][1:].to(dtype)  # as if it were fixed
    expected = min(height, 1e-3)
    assert float(x[0, 1]) >= expected - 4.0 * ulp
    assert float(x[0, 1]) <= expected + 100.0 * 2.0 * ulp * 1.1


def test_the_ball_and_the_scene() -> None:
    """Into the ball; never below the ground, nor deeper than at the present place."""
    x, pairs = vertex_over_triangle(0.5)
    radii = 0.1 * torch.ones(4, dtype=DOUBLE)
    assert moved(x, pairs, shifted(x, (1.0, 0.0, 0.0)), radii)[0].tolist() == pytest.approx([0.35, 0.5, 0.25])
    up = torch.tensor([0.0, 1.0, 0.0], dtype=DOUBLE).expand(4, 1, 3)
    ground = Walls(up, torch.tensor([[0.45], [-9.0], [-9.0], [-9.0]], dtype=DOUBLE))
    assert float(moved(x, pairs, shifted(x, (0.0, -0.4, 0.0)), walls=ground)[0, 1]) == pytest.approx(0.45)


def random_state(seed: int) -> tuple[Surfaces, Tensor]:
    random = torch.Generator().manual_seed(seed)
    corners = torch.rand((60, 1, 3), dtype=DOUBLE, generator=random) + 0.15 * torch.rand(
        (60, 3, 3), dtype=DOUBLE, generator=random
    )
    surfaces = Surfaces(
        rest=corners.reshape(-1, 3),
        triangles=torch.arange(180).reshape(-1, 3),
        body=torch.arange(60).repeat_interleave(3),
        kinematic=torch.zeros(180, dtype=torch.bool),
        self_contact=torch.zeros(60, dtype=torch.bool),
        thickness=1e-3,
        friction=torch.zeros((60, 60), dtype=DOUBLE),
    )
    return surfaces, corners.reshape(-1, 3)


def test_every_vertex_ends_in_its_sets() -> None:
    """Random triangles that want to go anywhere: in the half-spaces and balls, and nearer to what they want."""
    for seed in range(5):
        surfaces, x = random_state(seed)
        want = x + 0.03 * torch.randn(x.shape, dtype=DOUBLE, generator=torch.Generator().manual_seed(seed))
        contacts = found(surfaces, x, want, torch.zeros(0, dtype=torch.int64), Multipliers.none(0, DOUBLE))
        walls = no_walls(len(x))
        result = limit(want, x, contacts.spaces, contacts.balls, walls, contacts.stuck, contacts.table)
        own = ~contacts.stuck[contacts.spaces.vertices]
        assert (contacts.spaces.slack(result.positions)[own] >= -2.0 * contacts.spaces.margins[own]).all()
        reach = (result.positions - contacts.balls.centers).norm(dim=1)
        assert (reach <= contacts.balls.radii * (1.0 + 2e-6)).all()
        assert torch.equal(result.positions[contacts.stuck], x[contacts.stuck])
        assert ((result.positions - want).norm(dim=1) <= (x - want).norm(dim=1) + 1e-12).all()
        assert (result.positions - x).norm(dim=1).mean() > 0.005


def test_a_share_is_common_and_the_largest() -> None:
    """A wall of two vertices goes 1 m; a half-space stops one of them after .3 m, so the other, too."""
    x = torch.zeros((3, 3), dtype=DOUBLE)
    spaces = HalfSpaces(
        torch.tensor([1]),
        torch.tensor([[-1.0, 0.0, 0.0]], dtype=DOUBLE),
        torch.tensor([-0.3], dtype=DOUBLE),
        torch.zeros(1, dtype=DOUBLE),
    )
    balls = Balls(x, torch.tensor([torch.inf, torch.inf, 0.6], dtype=DOUBLE))
    way = torch.tensor([1.0, 0.0, 0.0], dtype=DOUBLE)
    free = torch.zeros(3, dtype=torch.bool)

    def shares(group: list[int], stuck: Tensor = free) -> list[float]:
        number = torch.tensor(group)

        def places(share: Tensor) -> Tensor:
            return x + torch.cat([share, share.new_zeros(1)])[number][:, None] * way

        return largest_shares(places, number, max(group) + 1, spaces, balls, no_walls(3), stuck).tolist()

    assert shares([0, 0, 1]) == pytest.approx([0.3, 0.6], abs=1e-6)
    assert shares([0, 1, 2]) == pytest.approx([1.0, 0.3, 0.6], abs=1e-6)
    assert shares([-1, -1, 0]) == pytest.approx([0.6], abs=1e-6)
    assert shares([0, 1, 2], torch.tensor([True, False, False])) == pytest.approx([0.0, 0.3, 0.6], abs=1e-6)
