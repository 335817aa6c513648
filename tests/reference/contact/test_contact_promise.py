"""Free of crossings at every iterate, however few, by exact signs; and crossings where a part of the method is out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from contact_scenes import (
    ContactCase,
    ball_on_sheet,
    fixed_edge,
    folded_cloth,
    free_hit,
    needle,
    plates,
    ring_line,
    rings,
    twisted_strip,
    two_cubes,
    watched,
)

from torchpd.reference.contact import crossings, hands, limit, linking_number, lists, step
from torchpd.reference.contact.distance import closest
from torchpd.reference.contact.planes import Planes, make_planes
from torchpd.reference.contact.search import near_pairs


@pytest.mark.parametrize(
    ("case", "steps"),
    [(two_cubes(), 12), (free_hit(2, 10.0), 4), (needle(), 8), (fixed_edge(), 8)],
    ids=["two cubes", "free hit", "needle", "edge"],
)
@pytest.mark.parametrize("iterations", [2, 16])
def test_bodies_that_hit(case: ContactCase, steps: int, iterations: int) -> None:
    run = watched(case, steps, iterations)
    assert run.crossed == 0
    assert run.finite
    assert 0.099 <= run.gap < 1.1
    assert run.steps[-1].frozen == 0


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


@pytest.mark.parametrize(("speed", "iterations"), [(20.0, 4), (20.0, 16), (20.0, 64), (40.0, 16)])
def test_a_ball_on_a_sheet(speed: float, iterations: int) -> None:
    """33 to 67 cm a step on cells of 33 mm, and the ball stays above."""
    case = ball_on_sheet(speed=speed)
    run = watched(case, 8, iterations)
    assert run.crossed == 0
    assert run.finite
    for result in run.steps:
        assert height_above_sheet(case, result.history.positions) > 0.0
    assert any(float(result.contacts.held.normal.sum()) > 0.0 for result in run.steps)


def test_without_planes_cubes_cross(monkeypatch: pytest.MonkeyPatch) -> None:
    """A control: half-spaces that hold everything."""

    def nowhere(*args: Any) -> Planes:
        made = make_planes(*args)
        far = torch.full_like(made.above, torch.inf)
        return replace(made, above=-far, below=far, frozen=torch.zeros_like(made.frozen))

    monkeypatch.setattr(lists, "make_planes", nowhere)
    assert watched(free_hit(2, 10.0), 4, 8).crossed > 0


def test_without_balls_cubes_cross(monkeypatch: pytest.MonkeyPatch) -> None:
    """A control: pairs that no search has found do not hinder."""

    def anywhere(_: limit.Balls, positions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return positions, torch.zeros(len(positions), dtype=torch.bool)

    monkeypatch.setattr(limit, "into_balls", anywhere)
    monkeypatch.setattr(step, "into_balls", anywhere)
    assert watched(free_hit(2, 10.0), 4, 8).crossed > 0


def test_without_the_share_of_colliders_plates_cross(monkeypatch: pytest.MonkeyPatch) -> None:
    """A control: what moves by hand goes where it wants."""

    def whole(_: Any, group: torch.Tensor, count: int, *args: Any) -> torch.Tensor:
        return torch.ones(count, dtype=torch.float64)

    monkeypatch.setattr(hands, "largest_shares", whole)
    assert watched(plates(-0.002, 0.1, 2), 8, 8).crossed > 0


def test_plates_that_would_pass_each_other() -> None:
    """They end short of each other, as `held_back` says, and the cube springs back when they open."""
    case = plates(-0.002, 0.2, 2, opens=True)
    run = watched(case, 24, 16)
    assert run.crossed == 0
    assert run.finite
    squeezed = run.steps[11]
    assert 0.9e-3 <= float(squeezed.held_back.max()) <= 2.5e-3
    tops = squeezed.history.poses[:, 1]
    assert float(tops[0] + 0.053) > float(tops[1] - 0.053)
    volume = [volume_of(case, result.positions) for result in run.steps]
    assert 0.0 < volume[11] < 0.2 * 1e-3
    assert volume[-1] > 0.5 * 1e-3
    assert float(run.steps[-1].held_back.max()) == 0.0


def volume_of(case: ContactCase, positions: torch.Tensor) -> float:
    """Volume [m^3] inside the surface of the first body."""
    surfaces = case.scene.surfaces
    faces = surfaces.triangles[surfaces.body[surfaces.triangles[:, 0]] == 0]
    a, b, c = positions.double()[faces].unbind(dim=1)
    return float((torch.linalg.cross(a, b) * c).sum() / 6.0)


@pytest.mark.parametrize("iterations", [4, 16])
def test_rings_stay_linked(iterations: int) -> None:
    case = rings()

    def number(places: torch.Tensor) -> int:
        lines = [places.double().numpy()[ring_line(ring)] for ring in (0, 1)]
        return linking_number(*lines)

    before = number(case.scene.surfaces.rest)
    assert abs(before) == 1
    run = watched(case, 12, iterations)
    assert run.crossed == 0
    assert run.finite
    assert all(number(result.positions) == before for result in run.steps)


@pytest.mark.parametrize("friction", [0.0, 0.3, 1.0])
def test_a_twisted_strip(friction: float) -> None:
    """Ten turns within .5 s, in knots of its own: finite, and pins held back by what is left."""
    run = watched(twisted_strip((16, 3), seconds=0.5, friction=friction), 29, 8)
    assert run.crossed == 0
    assert run.finite
    assert max(result.pairs for result in run.steps) > 500
    assert all(result.pins_held_back < 0.06 for result in run.steps)


@pytest.mark.parametrize("self_contact", [True, False])
def test_a_cloth_that_folds_on_itself(self_contact: bool) -> None:
    """It keeps the floor to itself; without contact of its parts both layers lie in one plane: the control."""
    case = folded_cloth(12, speed=2.0, self_contact=self_contact)
    whole = folded_cloth(12).scene.surfaces
    gap = 1.0
    for result in case.steps(12, 16):
        x = result.positions
        pairs = near_pairs(whole, x, torch.zeros(len(x), dtype=x.dtype))
        distance = closest(pairs.corners(x), pairs.points).distance
        gap = min(gap, float((distance / pairs.thickness).min())) if len(pairs) else gap
        assert len(crossings(whole, x)) == 0 or not self_contact
        assert x.isfinite().all()
    assert (gap >= 0.099) == self_contact


@pytest.mark.parametrize("case", [free_hit(2, 10.0), ball_on_sheet(8, 20.0, 2), plates(0.0, 0.1, 2)])
def test_straight_ways_between_iterates(case: ContactCase) -> None:
    """The set is convex: places between two iterates are free of crossings, too."""
    last: list[torch.Tensor] = []

    def observe(k: int, places: torch.Tensor) -> None:
        for share in (0.25, 0.5, 0.75) if k else ():
            assert len(crossings(case.scene.surfaces, torch.lerp(last[-1], places, share))) == 0
        last.append(places)

    for _ in case.steps(6, 8, observe=observe):
        pass
    assert len(last) >= 54  # coarse corrections count, too
