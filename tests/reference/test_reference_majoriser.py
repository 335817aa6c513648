"""The constant majoriser: x - theta g / Dbar lowers E by theta (1 - theta / 2) g^T g / Dbar at least, in any state.

Single elements have corners of their own, so the bound holds for each of them, or for each group that shares its trace.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pytest
from element_cases import RandomElements, random_elements

from torchpd.reference import Array
from torchpd.reference.groups import ElementGroup
from torchpd.reference.kinds import KINDS
from torchpd.reference.laws import Corotated, Law

COUNT = 20000
THETAS = (0.3, 1.0, 1.9)


class Uncapped(Corotated):
    """The same law without the cap: it has no constant majoriser."""

    @cached_property
    def cap(self) -> Array:
        return np.full(len(self.weight), np.inf)


class CappedByMeans(Corotated):
    """The cap of a group from its mean moduli, which does not bound the pressure of each member by its own 2 mu."""

    @cached_property
    def cap(self) -> Array:
        mean = np.bincount(self.members, weights=self.shear * self.measure)
        return np.asarray(mean / np.where(self.weight == 0.0, 1.0, self.weight))


@dataclass(frozen=True)
class Checked(ElementGroup):
    """Elements with another law in place of that of their kind."""

    replaced: type[Corotated] | None = None

    @cached_property
    def law(self) -> Law:
        own = super().law
        if self.replaced is None:
            return own
        assert isinstance(own, Corotated)
        return self.replaced(own.shear, own.bulk, own.measure, own.group)


def broken(
    given: RandomElements, *, size: int = 1, replaced: type[Corotated] | None = None, weight: Array | None = None
) -> tuple[int, float]:
    """Number of groups that break the bound for any theta, and the largest E over that before.

    `weight` [V] adds weight / 2 |x - y|^2 of a random y at every corner: the inertia of a step.
    """
    count = len(given.group.corners)
    numbers = np.arange(count) // size
    start = random_elements(given.group.kind, given.group.gradients.shape[1:], count, seed=9).positions
    elements = Checked(given.group, numbers, start, 0.1, replaced)
    inertia = np.zeros(len(start)) if weight is None else weight
    target = start + 0.1
    owner = numbers[np.repeat(np.arange(count), given.group.corners.shape[1])]

    def summed(corners: Array, members: Array) -> Array:
        return np.bincount(owner, weights=corners) + np.bincount(numbers, weights=members)

    def evaluate(positions: Array) -> tuple[Array, Array]:
        energies, stress = elements.law.evaluate(elements.deformation(positions - start))
        pull = positions - target
        energy = summed(0.5 * inertia * (pull**2).sum(axis=1), energies)
        return energy, elements.nodal(stress) + inertia[:, None] * pull

    diagonal = np.maximum(elements.weighted_diagonal + inertia, 1e-300)  # zero at corners without weight
    energy, gradient = evaluate(given.positions)
    descent = np.bincount(owner, weights=(gradient**2).sum(axis=1) / diagonal)
    # F is the sum of g_a x_a at the start and of its change: their rounding passes into E
    reach = np.bincount(owner, weights=diagonal * (given.positions**2 + start**2).sum(axis=1))
    rounding = 1e-14 * (energy + descent + reach)
    fails, worst = np.zeros(len(energy), dtype=np.bool_), 0.0
    for theta in THETAS:
        after = evaluate(given.positions - theta * gradient / diagonal[:, None])[0]
        fails |= ~(after <= energy - theta * (1.0 - theta / 2.0) * descent + rounding)
        worst = max(worst, float(((after - rounding) / np.maximum(energy, 1e-300)).max()))
    return int(fails.sum()), worst


def sizes(kind: str) -> tuple[int, int]:
    return KINDS[kind].corners, KINDS[kind].width


@pytest.mark.parametrize("kind", KINDS)
def test_every_step_of_the_diagonal_lowers_the_energy(kind: str) -> None:
    given = random_elements(kind, sizes(kind), COUNT)
    corners, alone = given.group.corners.shape[1], np.arange(COUNT) % 2 == 0
    inertia = np.where(np.repeat(alone, corners), 0.0, np.random.default_rng(2).uniform(size=COUNT * corners))
    fails, worst = broken(given, weight=inertia)
    assert fails == 0
    assert worst <= 1.0


@pytest.mark.parametrize(("kind", "name"), [("tet", "poisson"), ("triangle", "membrane_poisson")])
def test_negative_poisson_keeps_the_bound(kind: str, name: str) -> None:
    """For nu in (-1, 0) the volume energy is concave and its slope is below 2 mu: it adds nothing to the diagonal."""
    given = random_elements(kind, sizes(kind), COUNT)
    ratios = np.random.default_rng(3).uniform(-1.0, 0.0, COUNT)
    auxetic = replace(given.group, material=given.group.material | {name: ratios})
    assert broken(RandomElements(auxetic, given.positions)) == (0, pytest.approx(0.5, abs=0.5))


def test_groups_of_mixed_materials_keep_the_bound() -> None:
    """Contrasts up to 1e4 within a group of four."""
    assert broken(random_elements("tet", (4, 3), COUNT), size=4) == (0, pytest.approx(0.5, abs=0.5))


def test_without_the_cap_the_bound_fails() -> None:
    """Beyond a threefold stretch the pressure makes twists unstable: E rises."""
    fails, worst = broken(random_elements("tet", (4, 3), COUNT), replaced=Uncapped)
    assert fails > 500
    assert worst > 1.1


def test_a_cap_from_mean_values_fails() -> None:
    fails, worst = broken(random_elements("tet", (4, 3), COUNT), size=4, replaced=CappedByMeans)
    assert fails > 20
    assert worst > 1.1


def test_curvature_of_a_twist_with_and_without_the_cap() -> None:
    """At diag(4, 1, -1 + 1e-3), nu = .45 and E = 1, along (e2 e3^T - e3 e2^T) / sqrt 2; 2 mu + 3 lambda is 10."""
    F, one = np.diag([4.0, 1.0, -1.0 + 1e-3])[None], np.ones(1)
    twist = np.array([[0.0, 0, 0], [0, 0, 1], [0, -1, 0]])[None] / np.sqrt(2.0)
    shear, bulk = one / 1.45, 0.45 / (1.45 * 0.1) * one
    assert float(shear[0] + 3.0 * bulk[0]) == pytest.approx(10.0)
    curvature = [
        float((law(shear, bulk, one, np.zeros(1, dtype=np.int64)).differential(F, twist) * twist).sum())
        for law in (Corotated, Uncapped)
    ]
    assert curvature == [pytest.approx(shear[0], rel=1e-12), pytest.approx(4.83e3, rel=1e-3)]
