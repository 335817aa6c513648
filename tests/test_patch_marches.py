"""Rays on free-form patches against marches in small steps."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from patch_cases import F64, quadrics_on, triangle
from torch import Tensor

import torchpd as pd

STEPS = 6001
TOUCH = 1e-9  # m: how near to the surface a ray must come for a hit that no march sees


def level_sheet(cells: int = 3) -> pd.TriMesh:
    """A square in the plane z = 0: over it a surface of patches is the graph of a function."""
    n = cells + 1
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n), indexing="ij"))
    corner = np.arange(n * n).reshape(n, n)
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]))
    return pd.TriMesh(np.stack([x, y, 0 * x], axis=1), np.concatenate([np.stack(t, 1) for t in ((a, b, c), (a, c, d))]))


def segments(count: int, height: float, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Ends of segments over the square, half of them nearly level: those graze the bumps."""
    rng = np.random.default_rng(seed)
    ends = rng.uniform(-0.99, 0.99, (2, count, 3))
    ends[:, : count // 2, 2] = height * (
        rng.uniform(-1.0, 1.0, count // 2) + 0.02 * rng.standard_normal((2, count // 2))
    )
    return torch.tensor(ends[0]), torch.tensor(ends[1])


def first_change(values: Tensor) -> Tensor:
    """The step [R] after which values [R, steps] first change sign; as many as there are steps if never."""
    change = (values[:, :-1] < 0) != (values[:, 1:] < 0)
    steps = torch.arange(change.shape[1])
    return torch.where(change, steps, change.shape[1] + 1).amin(1)


def compare_with_march(
    excess: Callable[[Tensor, Tensor, Tensor], Tensor], start: Tensor, end: Tensor, depth: Tensor
) -> int:
    """Rays on which a march and `depth` disagree: a crossing that was missed, or a hit where there is none.

    A hit before the first crossing that the march sees must be one at a finer look: 6001 steps within two of the coarse
    ones, or the surface within TOUCH there.
    """
    length = (end - start).norm(dim=1)
    wrong = 0
    for part in torch.arange(len(start)).split(50):
        a, b, t = start[part], end[part], depth[part] / length[part]
        values = excess(a, b, torch.linspace(0, 1, STEPS, dtype=F64).expand(len(a), -1))
        at = first_change(values)
        missed = (at < STEPS) & ~(t <= (at + 1.001) / (STEPS - 1))
        early = t < (at - 0.001) / (STEPS - 1)
        wrong += int(missed.sum())
        if early.any():
            near = t[early, None] + torch.linspace(-2, 2, STEPS, dtype=F64) / (STEPS - 1)
            closer = excess(a[early], b[early], near)
            wrong += int(((first_change(closer) > STEPS) & (closer.abs().amin(1) > TOUCH)).sum())
    return wrong


def graph(measured_at: str = "base", base: str = "flat", dtype: torch.dtype = F64) -> pd.FreeFormPatches:
    mesh = level_sheet()
    # lower where heights are measured on the surface, so that they are unique
    quadrics = quadrics_on(mesh, 8, height=0.1 if measured_at == "base" else 0.08, seed=3)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=F64).expand(len(mesh.vertices), 3)
    made = pd.FreeFormPatches.from_mesh(mesh, quadrics, dtype=F64, directors=up, measured_at=measured_at, base=base)
    return made.to(dtype)


def march_over_graph(measured_at: str, count: int, chosen: slice = slice(None)) -> int:
    patches = graph(measured_at)
    start, end = (ends[chosen] for ends in segments(count, 0.1))
    hits = pd.PatchRays(patches).cast(start, end - start, far=1e6)
    length = (end - start).norm(dim=1)
    depth = torch.where(hits.depth[0] <= length, hits.depth[0], math.inf)
    assert len(depth) == 1 or 0.2 < float(depth.isfinite().double().mean()) < 0.95

    flat = 1.0 if measured_at == "surface" else 0.0
    q, scale = patches.quadrics, start.new_tensor([1.0, 1.0, flat])
    M = q.triangular()

    def excess(a: Tensor, b: Tensor, s: Tensor) -> Tensor:
        """z - sum_i R_i, where each Q_i is a quadratic in s."""
        y0 = torch.einsum("qij,rqj->rqi", M, (scale * a)[:, None] - q.centres)
        y1 = torch.einsum("qij,rj->rqi", M, scale * (b - a))
        coefficients = (1 - (y0 * y0).sum(2), -2 * (y0 * y1).sum(2), -(y1 * y1).sum(2))
        value = a[:, 2:] + s * (b - a)[:, 2:]
        for i in range(len(q)):
            c0, c1, c2 = (c[:, i, None] for c in coefficients)
            Q = torch.addcmul(c0, s, torch.addcmul(c1, s, c2)).clamp_min_(0)
            value.sub_(q.amplitudes[i] * Q * Q * Q)
        return value

    return compare_with_march(excess, start, end, depth)


def test_march_over_a_graph() -> None:
    assert march_over_graph("base", 10_000) == 0


def test_two_crossings_close_to_each_other() -> None:
    """A ray that enters and leaves a bump near its outline, which cells as long as the quadrics' radii miss."""
    assert march_over_graph("base", 100_000, slice(19810, 19811)) == 0


@pytest.mark.slow
@pytest.mark.parametrize("measured_at", ["base", "surface"])
def test_long_march_over_a_graph(measured_at: str) -> None:
    assert march_over_graph(measured_at, 100_000) == 0


def march_through_field(reading: str, count: int) -> int:
    """One patch with quadrics of every kind, cones and hyperboloids among them."""
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
    length = (end - start).norm(dim=1)
    depth, patch = pd.PatchRays(patches).cast_field(start, end - start, far=10.0, reading=reading, matrices=W)
    assert torch.equal(depth[0].isfinite(), patch[0] == 0)
    depth = torch.where(depth[0] <= length, depth[0], math.inf)
    assert 0.1 < float(depth.isfinite().double().mean()) < 0.9

    def field(a: Tensor, b: Tensor, s: Tensor) -> Tensor:
        x = a[:, None] + s[..., None] * (b - a)[:, None]
        flat = x.reshape(-1, 3)
        zero = torch.zeros(len(flat), dtype=torch.int32)
        return patches.field(flat, zero, reading=reading, matrices=W).reshape(x.shape[:-1])

    inside = field(start, end, torch.zeros(count, 1, dtype=F64))[:, 0] >= 0
    assert torch.equal(inside, depth == 0)
    return compare_with_march(field, start[~inside], end[~inside], depth[~inside])


@pytest.mark.parametrize("reading", ["clip", "literal"])
def test_march_through_the_field(reading: str) -> None:
    assert march_through_field(reading, 10_000) == 0


@pytest.mark.slow
@pytest.mark.parametrize("reading", ["clip", "literal"])
def test_long_march_through_the_field(reading: str) -> None:
    assert march_through_field(reading, 100_000) == 0
