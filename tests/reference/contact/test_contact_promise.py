"""Free of crossings at every iterate, however few, and between iterates; crossings where a part of the method is out.

Two judges: exact signs at iterates, and ipctk, which also follows the straight ways between them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from contact_scenes import (
    ContactCase,
    Witness,
    ball_on_sheet,
    crossed_rods,
    fixed_edge,
    folded_cloth,
    free_hit,
    gripper,
    needle,
    plates,
    promised,
    ring_line,
    rings,
    rod_on_sheet,
    twisted_strip,
    two_cubes,
    watched,
)

from torchpd.reference.contact import hands, limit, linking_number, lists, step
from torchpd.reference.contact.distance import closest
from torchpd.reference.contact.planes import Planes, make_planes
from torchpd.reference.contact.search import near_pairs

FEW = pytest.mark.parametrize(
    ("iterations", "precision"),
    [(4, torch.float32), (4, torch.float64), (16, torch.float32), (16, torch.float64)],
    ids=["4 float32", "4 float64", "16 float32", "16 float64"],
)


@FEW
@pytest.mark.parametrize("speed", [1.0, 40.0])
def test_rods_that_cross(speed: float, iterations: int, precision: torch.dtype) -> None:
    """Two segments that pass through each other intersect at no time: the witness follows their ways."""
    ends = promised(crossed_rods(speed, dtype=precision), 6, iterations)
    assert min(end.gap for end in ends) < 1.1


@FEW
def test_a_rod_on_a_sheet(iterations: int, precision: torch.dtype) -> None:
    assert min(end.gap for end in promised(rod_on_sheet(dtype=precision), 6, iterations)) < 1.1


def test_the_witness_sees_rods_pass() -> None:
    """The control: without pairs of edges they go through each other, and exact signs know nothing of it."""
    case = crossed_rods()
    witness, rest = Witness(case), case.scene.surfaces.rest
    below = torch.where((case.scene.surfaces.body == 1)[:, None], rest - torch.tensor([0.0, 0.1, 0.0]), rest)
    assert not witness.intersects(below)
    assert witness.collides(rest, below)
    assert not witness.collides(rest, torch.where((case.scene.surfaces.body == 1)[:, None], 2.0 * rest - below, rest))


@FEW
@pytest.mark.parametrize(
    ("make", "steps"),
    [(two_cubes, 12), (needle, 8), (fixed_edge, 8), (lambda **options: gripper(0.8, 2, **options), 16)],
    ids=["two cubes", "needle", "edge", "gripper"],
)
def test_bodies_that_meet(
    make: Callable[..., ContactCase], steps: int, iterations: int, precision: torch.dtype
) -> None:
    ends = promised(make(dtype=precision), steps, iterations)
    assert min(end.gap for end in ends) < 1.1
    assert ends[-1].frozen == 0


@pytest.mark.parametrize("iterations", [2, 4, 16, 64])
def test_cubes_that_hit_at_twenty_metres_a_second(iterations: int, dtype: torch.dtype) -> None:
    """The cheapest scene, in which each part of the method is needed: see the controls below."""
    assert min(end.gap for end in promised(free_hit(2, 10.0, dtype=dtype), 4, iterations)) < 2.0


def height_above_sheet(case: ContactCase, places: torch.Tensor) -> float:
    """Of the ball's lowest point over the triangle of the sheet that is below or above it."""
    surfaces = case.scene.surfaces
    x = places.double()
    ball = x[surfaces.body == 1]
    lowest = ball[ball[:, 1].argmin()]
    corners = x[surfaces.triangles[surfaces.body[surfaces.triangles[:, 0]] == 0]][:, :, [0, 2, 1]]
    edges = corners[:, 1:, :2] - corners[:, :1, :2]
    inverse = torch.linalg.inv(edges.transpose(1, 2))
    share = (inverse @ (lowest[[0, 2]] - corners[:, 0, :2])[:, :, None])[:, :, 0]
    inside = (share >= -1e-9).all(dim=1) & (share.sum(dim=1) <= 1.0 + 1e-9)
    rises = corners[:, 1:, 2] - corners[:, :1, 2]
    return float((lowest[1] - (corners[:, 0, 2] + (share * rises).sum(dim=1)))[inside].min())


@FEW
@pytest.mark.parametrize("speed", [20.0, 40.0])
def test_a_ball_on_a_sheet(speed: float, iterations: int, precision: torch.dtype) -> None:
    """33 to 67 cm a step on cells of 33 mm, and the ball stays above."""
    case = ball_on_sheet(speed=speed, dtype=precision)
    ends = promised(case, 8, iterations)
    for end in ends:
        assert height_above_sheet(case, end.history.positions) > 0.0
    assert any(float(end.contacts.held.normal.sum()) > 0.0 for end in ends)


def nowhere(*args: Any) -> Planes:
    """Half-spaces that hold everything."""
    made = make_planes(*args)
    far = torch.full_like(made.above, torch.inf)
    return replace(made, above=-far, below=far, frozen=torch.zeros_like(made.frozen))


def anywhere(_: limit.Balls, positions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Pairs that no search has found do not hinder."""
    return positions, torch.zeros(len(positions), dtype=torch.bool)


def whole(_: Any, group: torch.Tensor, count: int, *args: Any) -> torch.Tensor:
    """What moves by hand goes where it wants."""
    return torch.ones(count, dtype=torch.float64)


@pytest.mark.parametrize(
    ("case", "count", "changes"),
    [
        (lambda: free_hit(2, 10.0), 4, [(lists, "make_planes", nowhere)]),
        (lambda: free_hit(2, 10.0), 4, [(limit, "into_balls", anywhere), (step, "into_balls", anywhere)]),
        (lambda: plates(-0.002, 0.1, 2), 8, [(hands, "largest_shares", whole)]),
    ],
    ids=["planes", "balls", "the share of colliders"],
)
def test_both_judges_see_what_is_left_out(
    case: Callable[[], ContactCase], count: int, changes: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    for change in changes:
        monkeypatch.setattr(*change)
    run = watched(case(), count, 8)
    assert run.crossed > 0
    assert run.met > 0


def test_the_witness_sees_what_it_should() -> None:
    """A ball that is past the sheet intersects nothing; the way there does."""
    case = ball_on_sheet()
    witness, surfaces = Witness(case), case.scene.surfaces
    ball = (surfaces.body == 1)[:, None]
    rest = surfaces.rest
    down = torch.tensor([0.0, 1.0, 0.0], dtype=rest.dtype)
    height = float(rest[surfaces.body == 1][:, 1].mean() - rest[surfaces.body == 0][:, 1].mean())
    inside, past = (torch.where(ball, rest - share * height * down, rest) for share in (1.0, 2.0))
    assert not witness.intersects(rest)
    assert witness.intersects(inside)
    assert not witness.intersects(past)
    assert witness.collides(rest, past)
    assert not witness.collides(rest, torch.where(ball, rest + down, rest))


def test_plates_that_would_pass_each_other() -> None:
    """They end short of each other, as `held_back` says, and the cube springs back when they open."""
    case = plates(-0.002, 0.1, 2, opens=True)
    ends = promised(case, 12, 16)
    squeezed = ends[5]
    assert 0.9e-3 <= float(squeezed.held_back.max()) <= 3.5e-3
    tops = squeezed.history.poses[:, 1]
    assert float(tops[0] + 0.053) > float(tops[1] - 0.053)
    volume = [volume_of(case, end.positions) for end in ends]
    assert 0.0 < volume[5] < 0.2 * 1e-3
    assert volume[-1] > 0.5 * 1e-3
    assert float(ends[-1].held_back.max()) == 0.0


def volume_of(case: ContactCase, positions: torch.Tensor) -> float:
    """Volume [m^3] inside the surface of the first body."""
    surfaces = case.scene.surfaces
    faces = surfaces.triangles[surfaces.body[surfaces.triangles[:, 0]] == 0]
    a, b, c = positions.double()[faces].unbind(dim=1)
    return float((torch.linalg.cross(a, b) * c).sum() / 6.0)


@FEW
def test_rings_stay_linked(iterations: int, precision: torch.dtype) -> None:
    case = rings(dtype=precision)

    def number(places: torch.Tensor) -> int:
        lines = [places.double().numpy()[ring_line(ring)] for ring in (0, 1)]
        return linking_number(*lines)

    before = number(case.scene.surfaces.rest)
    assert abs(before) == 1
    assert all(number(end.positions) == before for end in promised(case, 8, iterations))


@pytest.mark.parametrize(
    ("friction", "steps", "seconds", "precision"), [(0.0, 16, 0.25, torch.float64), (1.0, 29, 0.5, torch.float32)]
)
def test_a_twisted_strip(friction: float, steps: int, seconds: float, precision: torch.dtype) -> None:
    """Ten turns, in knots of its own: finite, and pins held back by what is left."""
    ends = promised(twisted_strip((16, 3), seconds=seconds, friction=friction, dtype=precision), steps, 8)
    assert max(end.pairs for end in ends) > 400
    assert all(end.pins_held_back < 0.06 for end in ends)


@FEW
def test_a_cloth_that_folds_on_itself(iterations: int, precision: torch.dtype) -> None:
    """Its parts keep the floor to each other."""
    assert min(end.gap for end in promised(folded_cloth(8, speed=2.0, dtype=precision), 12, iterations)) < 2.0


def test_without_contact_of_its_parts_a_cloth_folds_through_itself() -> None:
    """The control: both layers lie in one plane."""
    case, whole = folded_cloth(8, speed=2.0, self_contact=False), folded_cloth(8).scene.surfaces
    gap = 1.0
    for end in case.steps(12, 16):
        pairs = near_pairs(whole, end.positions, torch.zeros(len(end.positions), dtype=end.positions.dtype))
        distance = closest(pairs.corners(end.positions), pairs.points).distance
        gap = min(gap, float((distance / pairs.thickness).min())) if len(pairs) else gap
    assert gap < 0.099
