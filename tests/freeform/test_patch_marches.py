"""Rays on free-form patches against marches in small steps."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pytest
import torch
from patch_cases import F64, level_sheet, quadrics_on, triangle
from torch import Tensor

import torchpd as pd

STEPS, PART = 6001, 60  # places on a ray, and how many steps of it are left out or taken together
NEVER = STEPS

# blocks of numbers that fit the cache are too small to be shared out
pytestmark = pytest.mark.usefixtures("one_thread")
READINGS = ["clip", "literal"]
TOUCH = 1e-9  # m: how near to the surface a ray must come for a hit that no march sees


def segments(count: int, height: float, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Ends of segments over the square, half of them nearly level: those graze the bumps."""
    rng = np.random.default_rng(seed)
    ends = rng.uniform(-0.99, 0.99, (2, count, 3))
    ends[:, : count // 2, 2] = height * (
        rng.uniform(-1.0, 1.0, count // 2) + 0.02 * rng.standard_normal((2, count // 2))
    )
    return torch.tensor(ends[0]), torch.tensor(ends[1])


class Profiles(NamedTuple):
    """What R rays see from s = 0 to 1: a value that is made of lines, and of sum_i a_i [Q_i]_+^3 with quadratics Q_i in
    s, and that grows with each of them."""

    lines: Tensor  # value and slope [L, 2, R, 1]
    quadratics: Tensor  # coefficients of 1, s and s^2 [Q, 3, R, 1]
    amplitudes: Tensor  # a [Q]
    join: Callable[[Sequence[Tensor], Tensor], Tensor]

    def of(self, rays: Tensor) -> Profiles:
        return self._replace(lines=self.lines[:, :, rays], quadratics=self.quadratics[:, :, rays])

    def values(self, s: Tensor) -> Tensor:
        """At s [R, steps]."""
        bumps = torch.zeros_like(s)
        for a, (c0, c1, c2) in zip(self.amplitudes, self.quadratics, strict=True):
            Q = torch.addcmul(c0, s, torch.addcmul(c1, s, c2)).clamp_min_(0)
            bumps.addcmul_(Q * Q, a * Q)
        return self.join([torch.addcmul(value, s, slope) for value, slope in self.lines], bumps)

    def bounds(self, begin: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
        """Least and greatest that the values may be within begin <= s <= end, each [K]: of every part on its own."""
        low, high = (torch.zeros(self.lines.shape[2], len(begin), dtype=F64) for _ in range(2))
        for a, (c0, c1, c2) in zip(self.amplitudes, self.quadratics, strict=True):
            # a quadratic is extreme at the ends, or at its vertex between them
            vertex = torch.nan_to_num(-0.5 * c1 / c2).clamp(begin, end)
            Q = [(c0 + s * (c1 + s * c2)).clamp_min_(0) for s in (begin, end, vertex)]
            R = [a * q * q * q for q in Q]
            low += torch.minimum(torch.minimum(R[0], R[1]), R[2])
            high += torch.maximum(torch.maximum(R[0], R[1]), R[2])
        ends = [(value + begin * slope, value + end * slope) for value, slope in self.lines]
        return (
            self.join([torch.minimum(*pair) for pair in ends], low),
            self.join([torch.maximum(*pair) for pair in ends], high),
        )


def first_change(values: Tensor) -> Tensor:
    """The step [R] after which values [R, steps] first change sign; NEVER if they do not."""
    change = (values[:, :-1] < 0) != (values[:, 1:] < 0)
    steps = torch.arange(change.shape[1])
    return torch.where(change, steps, NEVER).amin(1)


def march(profiles: Profiles) -> Tensor:
    """`first_change` over STEPS places on each ray; parts of a ray where the values keep their sign are left out."""
    s = torch.linspace(0, 1, STEPS, dtype=F64)
    first = torch.full((profiles.lines.shape[2],), NEVER)
    for rays in torch.arange(len(first)).split(1000):
        low, high = profiles.of(rays).bounds(s[:-1:PART], s[PART::PART])
        # but for rounding, which is far less
        ray, part = ((low <= 1e-12) & (high >= -1e-12)).nonzero(as_tuple=True)
        for some, begin in zip(rays[ray].split(500), (PART * part).split(500), strict=True):
            at = first_change(profiles.of(some).values(s[begin[:, None] + torch.arange(PART + 1)]))
            first.scatter_reduce_(0, some, begin + at, "amin")
    return first.clamp_max(NEVER)


def test_nothing_that_is_left_out_of_a_march_changes_sign() -> None:
    for profiles in (profiles_of_graph(graph(), *segments(500, 0.1)), *(field_case(r, 500)[0] for r in READINGS)):
        values = profiles.values(torch.linspace(0, 1, STEPS, dtype=F64).expand(500, -1))
        assert torch.equal(march(profiles), first_change(values))


def compare_with_march(profiles: Profiles, length: Tensor, depth: Tensor) -> int:
    """Rays on which a march and `depth` disagree: a crossing that was missed, or a hit where there is none.

    A hit before the first crossing that the march sees must be one at a finer look: 6001 steps within two of the coarse
    ones, or the surface within TOUCH there.
    """
    at, t = march(profiles), depth / length
    missed = (at < NEVER) & ~(t <= (at + 1.001) / (STEPS - 1))
    wrong = int(missed.sum())
    (early,) = (t < (at - 0.001) / (STEPS - 1)).nonzero(as_tuple=True)
    for some in early.split(50):
        near = t[some, None] + torch.linspace(-2, 2, STEPS, dtype=F64) / (STEPS - 1)
        closer = profiles.of(some).values(near)
        wrong += int(((first_change(closer) == NEVER) & (closer.abs().amin(1) > TOUCH)).sum())
    return wrong


def test_a_march_counts_what_is_missed_and_what_is_not_there() -> None:
    """The exact depth of a plane agrees; without it, a tenth deeper, or with a hit far in front of it, nothing does."""
    start, end = segments(100, 0.1)
    a, b = start[:, 2], end[:, 2]
    depth = torch.where(a * b < 0, a / (a - b), math.inf)
    one, nothing = torch.ones(100, dtype=F64), torch.zeros(0, 3, 100, 1, dtype=F64)
    plane = Profiles(torch.stack([a, b - a])[None, ..., None], nothing, one[:0], lambda lines, R: lines[0] + R)
    crossed = depth.isfinite()
    assert 10 < int(crossed.sum()) < 90
    assert compare_with_march(plane, one, depth) == 0
    for wrong in (math.inf, depth + 0.1, depth - 0.1):
        assert compare_with_march(plane, one, torch.where(crossed, wrong, depth)) == int(crossed.sum())
    assert compare_with_march(plane, one, torch.where(crossed, depth, 0.5)) == 100 - int(crossed.sum())


def graph(measured_at: str = "base", base: str = "flat", dtype: torch.dtype = F64) -> pd.FreeFormPatches:
    mesh = level_sheet()
    # lower where heights are measured on the surface, so that they are unique
    quadrics = quadrics_on(mesh, 8, height=0.1 if measured_at == "base" else 0.08, seed=3)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=F64).expand(len(mesh.vertices), 3)
    made = pd.FreeFormPatches.from_mesh(mesh, quadrics, dtype=F64, directors=up, measured_at=measured_at, base=base)
    return made.to(dtype)


def profiles_of_graph(patches: pd.FreeFormPatches, start: Tensor, end: Tensor) -> Profiles:
    """z - sum_i R_i, each R_i measured over the plane or in space."""
    scale = start.new_tensor([1.0, 1.0, 1.0 if patches.measured_at == "surface" else 0.0])
    q = patches.quadrics
    y0 = torch.einsum("qij,rqj->qri", q.triangular(), (scale * start)[:, None] - q.centres)
    y1 = torch.einsum("qij,rj->qri", q.triangular(), scale * (end - start))
    coefficients = (1 - (y0 * y0).sum(2), -2 * (y0 * y1).sum(2), -(y1 * y1).sum(2))
    z = torch.stack([start[:, 2:], (end - start)[:, 2:]])
    return Profiles(z[None], torch.stack(coefficients, 1)[..., None], -q.amplitudes, lambda lines, R: lines[0] + R)


def march_over_graph(measured_at: str, count: int, chosen: slice = slice(None)) -> int:
    patches = graph(measured_at)
    start, end = (ends[chosen] for ends in segments(count, 0.1))
    hits = pd.PatchRays(patches).cast(start, end - start, far=1e6)
    length = (end - start).norm(dim=1)
    depth = torch.where(hits.depth[0] <= length, hits.depth[0], math.inf)
    assert len(depth) == 1 or 0.2 < float(depth.isfinite().double().mean()) < 0.95
    return compare_with_march(profiles_of_graph(patches, start, end), length, depth)


@pytest.mark.parametrize("measured_at", ["base", "surface"])
def test_march_over_a_graph(measured_at: str) -> None:
    assert march_over_graph(measured_at, 100_000) == 0


def test_two_crossings_close_to_each_other() -> None:
    """A ray that enters and leaves a bump near its outline, which cells as long as the quadrics' radii miss."""
    assert march_over_graph("base", 100_000, slice(19810, 19811)) == 0


def test_bumps_as_narrow_as_the_finest_cells() -> None:
    """Patches of a metre and bumps of 2 to 4 cm, up to 20 times as high as wide: no level is fine enough, and cells are
    as long as radii. Less than one in a hundred of the rays that are aimed at them may be missed."""
    rng, pairs = np.random.default_rng(1), 6
    mesh = level_sheet(2)
    centres = np.zeros((2 * pairs, 3))
    centres[::2, :2] = rng.uniform(-0.8, 0.8, (pairs, 2))
    centres[1::2, :2] = centres[::2, :2] + rng.uniform(-0.06, 0.06, (pairs, 2))
    radii, heights = 0.04 * rng.uniform(0.5, 1.0, 2 * pairs), 0.4 * rng.uniform(0.3, 1.0, 2 * pairs)
    quadrics = pd.Quadrics.from_radii(*(torch.tensor(a) for a in (heights, centres, radii)))
    up = torch.tensor([0.0, 0.0, 1.0], dtype=F64).expand(len(mesh.vertices), 3)
    patches = pd.FreeFormPatches.from_mesh(mesh, quadrics, dtype=F64, directors=up)
    which = rng.integers(0, 2 * pairs, 20_000)
    aim = centres[which] + rng.uniform([-1, -1, 0], [1, 1, 1], (20_000, 3)) * np.stack(
        [radii[which], radii[which], heights[which]], axis=1
    )
    d = rng.standard_normal((20_000, 3)) * [1.0, 1.0, 0.1]
    d /= np.linalg.norm(d, axis=1)[:, None]
    inside = (np.abs(aim) + 0.5 * np.abs(d))[:, :2].max(axis=1) < 0.99
    start, end = torch.tensor((aim - 0.5 * d)[inside]), torch.tensor((aim + 0.5 * d)[inside])
    rays = pd.PatchRays(patches)
    assert rays.level == 32
    depth = rays.search(start, end - start, far=1.0)[0][0]
    wrong = compare_with_march(profiles_of_graph(patches, start, end), torch.ones(len(depth), dtype=F64), depth)
    assert 100 * wrong <= len(depth)


def field_case(reading: str, count: int) -> tuple[Profiles, pd.FreeFormPatches, Tensor, Tensor, Tensor]:
    """One patch with quadrics of every kind, cones and hyperboloids among them; W, and rays from a to b."""
    rng = np.random.default_rng(5)
    matrices = rng.standard_normal((5, 4, 4))
    W = torch.tensor(matrices + matrices.transpose(0, 2, 1))
    amplitudes = torch.tensor([0.2, -0.1, 0.05, 0.02, -0.03], dtype=F64)
    q = pd.Quadrics.from_radii(amplitudes, torch.zeros(5, 3, dtype=F64), torch.ones(5, dtype=F64))
    ellipsoids = quadrics_on(triangle(), 5, height=0.1, seed=2).normalized_matrices()
    W[:3] = ellipsoids[:3]
    patches = pd.FreeFormPatches.from_mesh(triangle(), q, dtype=F64, thickness=0.05)
    start = torch.tensor(rng.uniform(-0.7, 1.3, (count, 3)))
    end = torch.tensor(rng.uniform(-0.3, 1.0, (count, 3)))
    start[: count // 2, 2] = end[: count // 2, 2] = torch.tensor(rng.uniform(-0.15, 0.3, count // 2))
    # of the unit right triangle: its edges, and planes tau above and below
    planes = torch.tensor([[1, 0, 0, 0], [0, 1, 0, 0], [-(0.5**0.5), -(0.5**0.5), 0, 0.5**0.5]], dtype=F64)
    bases = torch.tensor([[0, 0, 1, 0.05], [0, 0, -1, 0.05]], dtype=F64)
    o = torch.cat([start, torch.ones(count, 1, dtype=F64)], 1)
    d = torch.cat([end - start, torch.zeros(count, 1, dtype=F64)], 1)
    lines = torch.stack([torch.cat([planes, bases]) @ x.T for x in (o, d)], 1)
    forms = [torch.einsum("rx,qxy,ry->qr", x, W, y) for x, y in ((o, o), (o, d), (d, d))]
    quadratics = torch.stack([forms[0], 2 * forms[1], forms[2]], 1)

    def clip(lines: Sequence[Tensor], bumps: Tensor) -> Tensor:
        return functools.reduce(torch.minimum, [*lines[:4], lines[4] + bumps])

    def literal(lines: Sequence[Tensor], bumps: Tensor) -> Tensor:
        return functools.reduce(torch.minimum, lines) + bumps

    join = clip if reading == "clip" else literal
    return Profiles(lines[..., None], quadratics[..., None], amplitudes, join), patches, W, start, end


@pytest.mark.parametrize("reading", READINGS)
def test_profiles_are_those_of_the_field(reading: str) -> None:
    profiles, patches, W, start, end = field_case(reading, 500)
    s = torch.linspace(0, 1, 7, dtype=F64)
    points = start[:, None] + s[:, None] * (end - start)[:, None]
    zero = torch.zeros(7 * 500, dtype=torch.int32)
    field = patches.field(points.reshape(-1, 3), zero, reading=reading, matrices=W).view(500, 7)
    torch.testing.assert_close(profiles.values(s.expand(500, -1)), field, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("reading", READINGS)
def test_march_through_the_field(reading: str) -> None:
    profiles, patches, W, start, end = field_case(reading, 100_000)
    length = (end - start).norm(dim=1)
    depth, patch = pd.PatchRays(patches).cast_field(start, end - start, far=10.0, reading=reading, matrices=W)
    assert torch.equal(depth[0].isfinite(), patch[0] == 0)
    depth = torch.where(depth[0] <= length, depth[0], math.inf)
    assert 0.1 < float(depth.isfinite().double().mean()) < 0.9
    inside = profiles.values(torch.zeros(len(start), 1, dtype=F64))[:, 0] >= 0
    assert torch.equal(inside, depth == 0)
    outside = (~inside).nonzero()[:, 0]
    assert compare_with_march(profiles.of(outside), length[outside], depth[outside]) == 0
