"""Multipliers of contact in closed form, and the augmented Lagrangian of the guard."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from torchpd.reference.contact.distance import closest
from torchpd.reference.contact.prox import Multipliers, augmented_lagrangian, directions, forces, prox, slips
from torchpd.reference.contact.surfaces import Pairs

DOUBLE = torch.float64
THICKNESS = 0.01


def over_a_triangle(height: float, friction: float = 0.0) -> tuple[Tensor, Pairs]:
    x = torch.tensor([[0.25, height, 0.25], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], dtype=DOUBLE)
    one = torch.ones(1, dtype=DOUBLE)
    return x, Pairs(torch.arange(4)[None], 1, torch.zeros(1, dtype=torch.int64), THICKNESS * one, friction * one)


def solved(
    x: Tensor, pairs: Pairs, target: Tensor, inverse: Tensor, scale: float, sweeps: int, start: Tensor | None = None
) -> tuple[Tensor, Multipliers, Tensor, Tensor]:
    near = closest(pairs.corners(x), pairs.points)
    normals = directions(near, near.diff)
    held = Multipliers.none(len(pairs), DOUBLE)
    begin = x if start is None else start
    moved, held = prox(pairs, near.weights, normals, held, target, begin, inverse, scale, sweeps)
    return moved, held, near.weights, normals


@pytest.mark.parametrize("scale", [1.0, 1.9, 3.6])
def test_one_vertex_on_a_fixed_triangle(scale: float) -> None:
    """It ends at r in one sweep, by a force of depth D / c that no scale changes the work of."""
    x, pairs = over_a_triangle(0.02)
    target = x.clone()
    target[0] += torch.tensor([0.3, -0.05, 0.1], dtype=DOUBLE)
    inverse = torch.tensor([0.5, 0.0, 0.0, 0.0], dtype=DOUBLE)
    moved, held, weights, normals = solved(x, pairs, target, inverse, scale, 1)
    assert moved[0].tolist() == pytest.approx([0.55, THICKNESS, 0.35], abs=1e-15)
    assert float(held.normal) == pytest.approx(0.04 / (0.5 * scale))
    pushes = forces(pairs, weights, normals, held, 4)
    assert float(pushes.sum(dim=0).abs().max()) < 1e-16
    assert torch.equal(moved[1:], x[1:])


def test_a_vertex_that_stays_away_is_not_touched() -> None:
    x, pairs = over_a_triangle(0.02)
    inverse = torch.full((4,), 0.5, dtype=DOUBLE)
    moved, held, *_ = solved(x, pairs, x, inverse, 1.9, 4)
    assert torch.equal(moved, x)
    assert float(held.normal) == 0.0


@pytest.mark.parametrize(("friction", "slip"), [(0.0, 0.03), (0.2, 0.03 - 0.2 * 0.04), (1.0, 0.0)])
def test_coulomb(friction: float, slip: float) -> None:
    """Pushed in by .04 m and along by .03 m: the force along is at most friction times that across."""
    x, pairs = over_a_triangle(THICKNESS, friction)
    target = x.clone()
    target[0] += torch.tensor([0.03, -0.04, 0.0], dtype=DOUBLE)
    inverse = torch.tensor([0.5, 0.0, 0.0, 0.0], dtype=DOUBLE)
    moved, held, *_ = solved(x, pairs, target, inverse, 1.9, 1)
    assert (moved[0] - x[0]).tolist() == pytest.approx([slip, 0.0, 0.0], abs=1e-15)
    assert float(held.tangential.norm()) <= friction * float(held.normal) * (1.0 + 1e-15)
    assert (held.tangential[0, 0] <= 0.0).item()


def test_weights_on_what_moves_by_hand_alone() -> None:
    """A closest point that is a fixed vertex on both sides: 0, not 1 / 0."""
    x = torch.tensor([[0.0, 1e-3, 0.0], [0.5, 0.5, 0.0], [0.0, 0.0, 0.0], [0.5, -0.5, 0.0]], dtype=DOUBLE)
    one = torch.ones(1, dtype=DOUBLE)
    pairs = Pairs(torch.arange(4)[None], 0, torch.zeros(1, dtype=torch.int64), THICKNESS * one, one)
    inverse = torch.tensor([0.0, 1.0, 0.0, 1.0], dtype=DOUBLE)
    near = closest(pairs.corners(x), 0)
    held = Multipliers(one, torch.ones((1, 3), dtype=DOUBLE))
    moved, held = prox(pairs, near.weights, directions(near, near.diff), held, x, x, inverse, 1.9, 4)
    assert torch.equal(moved, x)
    assert float(held.normal) == float(held.tangential.abs().max()) == 0.0


def crowd() -> tuple[Tensor, Pairs, Tensor, Tensor]:
    """Eight random pairs of six vertices, with friction."""
    random = torch.Generator().manual_seed(4)
    x = 0.02 * torch.rand((6, 3), dtype=DOUBLE, generator=random)
    vertices = torch.stack([torch.randperm(6, generator=random)[:4] for _ in range(8)])
    pairs = Pairs(vertices, 4, torch.arange(8), torch.full((8,), THICKNESS, dtype=DOUBLE), torch.full((8,), 0.3))
    inverse = torch.tensor([1.0, 2.0, 0.0, 0.5, 1.0, 3.0], dtype=DOUBLE)
    return x, pairs, inverse, x + 0.004 * torch.randn((6, 3), dtype=DOUBLE, generator=random)


def test_forces_are_those_of_the_fixed_point_for_any_scale() -> None:
    """Many sweeps on overlapping pairs: complementarity and Coulomb's law; c lambda does not depend on c."""
    x, pairs, inverse, target = crowd()
    moved, held, weights, normals = solved(x, pairs, target, inverse, 1.9, 20_000)
    gap = (normals * (weights[:, :, None] * moved[pairs.vertices]).sum(dim=1)).sum(dim=1)
    assert (gap >= THICKNESS - 1e-9).all()
    assert (held.normal * (gap - THICKNESS)).abs().max() <= 1e-9 * held.normal.max()
    slip = slips(pairs, weights, normals, moved - x)
    size, bound = held.tangential.norm(dim=1), 0.3 * held.normal
    sliding = slip.norm(dim=1) > 1e-6
    assert (size <= bound + 1e-9).all()
    assert ((size - bound)[sliding].abs() <= 1e-6).all()
    assert ((held.tangential * slip).sum(dim=1) <= 1e-12).all()
    again, other, *_ = solved(x, pairs, target, inverse, 0.7, 20_000)
    assert (again - moved).abs().max() < 1e-8
    assert float(held.normal.sum()) > 0.0
    assert (
        0.7 * forces(pairs, weights, normals, other, 6) - 1.9 * forces(pairs, weights, normals, held, 6)
    ).abs().max() < 1e-6


def test_the_augmented_lagrangian_has_the_forces_of_the_multipliers() -> None:
    """At d = r without slip its derivative by d is -lambda, by the slip -lambda_t; sliding it is cut to the bound."""
    x, pairs, inverse, _ = crowd()
    weights = closest(pairs.corners(x), 4).weights
    random = np.random.default_rng(0)
    held = Multipliers(torch.tensor(random.random(8)), torch.tensor(0.1 * random.standard_normal((8, 3))))
    length = held.tangential.norm(dim=1)
    within = torch.minimum(torch.ones(8, dtype=DOUBLE), 0.3 * held.normal / length)
    held = Multipliers(held.normal, within[:, None] * held.tangential)
    gap, slip = pairs.thickness.clone(), torch.zeros((8, 3), dtype=DOUBLE)

    def psi(change: float, along: Tensor) -> float:
        return augmented_lagrangian(pairs, weights, inverse, held, gap + change, slip + along)

    nothing, step = torch.zeros((8, 3), dtype=DOUBLE), 1e-7
    assert psi(0.0, nothing) == pytest.approx(0.0, abs=1e-15)
    moves = (inverse[pairs.vertices] * weights**2).sum(dim=1) > 0.0
    rate = (psi(step, nothing) - psi(-step, nothing)) / (2.0 * step)
    assert rate == pytest.approx(-float(held.normal[moves].sum()), rel=1e-5)
    along = torch.tensor([1.0, 0.0, 0.0], dtype=DOUBLE).expand(8, 3)
    inside = Multipliers(held.normal, 0.5 * held.tangential)
    rate = (
        augmented_lagrangian(pairs, weights, inverse, inside, gap, step * along)
        - augmented_lagrangian(pairs, weights, inverse, inside, gap, -step * along)
    ) / (2.0 * step)
    assert rate == pytest.approx(-float(inside.tangential[moves, 0].sum()), rel=1e-5)
    far = augmented_lagrangian(pairs, weights, inverse, held, gap, 1e3 * along)
    farther = augmented_lagrangian(pairs, weights, inverse, held, gap, (1e3 + 1.0) * along)
    assert farther - far == pytest.approx(float(0.3 * held.normal[moves].sum()), rel=1e-6)
