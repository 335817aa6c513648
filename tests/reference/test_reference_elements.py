"""Energies of single elements: exact values, and finite differences of every derivative."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from element_cases import ELEMENT_CASES, ElementCase, random_material, random_rotations, unit_gradients

from torchpd.reference import Array
from torchpd.reference.geometry import spreads
from torchpd.reference.groups import ElementGroup
from torchpd.reference.kinds import KINDS, Given
from torchpd.reference.laws import Corotated

COUNT = 7 * 40


def single(case: ElementCase) -> ElementGroup:
    start = case.positions if case.start is None else case.start
    return ElementGroup(case.group(), np.zeros(1, dtype=np.int64), start, case.time_step)


@pytest.mark.parametrize("case", ELEMENT_CASES, ids=lambda case: case.name)
def test_element_has_its_exact_energy_and_stress(case: ElementCase) -> None:
    element = single(case)
    F = element.deformation(case.positions - element.positions)
    energies, stress = element.law.evaluate(F)
    assert energies[0] == pytest.approx(case.energy, rel=1e-12)  # numbers have 13 digits
    assert {place: stress[0][place] for place in case.stress} == pytest.approx(case.stress, abs=1e-10)  # ten digits


@pytest.mark.parametrize(
    ("gradients", "expected"),
    [
        (np.array([[1.0, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]]), 4.0 / 3.0),  # regular
        (np.array([[-1.0, 0, 0], [1, -1, 0], [0, 1, -1], [0, 0, 1]]), 2.0),  # Kuhn
        (np.array([[0.0, 2], [-np.sqrt(3), -1], [np.sqrt(3), -1]]), 1.5),  # equilateral
        (unit_gradients(2), 2.0),  # right isosceles
        (unit_gradients(1), 2.0),
        (np.array([[2.0], [2], [-1], [-3]]), 4.0),
        (np.array([[1.0], [-2], [1], [0]]), 3.0),  # of a rod: the last corner has no weight
    ],
)
def test_spread_of_known_elements(gradients: np.ndarray, expected: float) -> None:
    assert spreads(gradients[None])[0] == pytest.approx(expected, rel=1e-13)


GROUPS = np.arange(COUNT) // 4


def smooth_states(rng: np.random.Generator, width: int) -> Array:
    """F [N, 3, d] of moderate stretches, half of them inverted, some beyond the cap, some with equal stretches."""
    stretches = rng.uniform(0.3, 1.5, (COUNT, 3)) * rng.choice([1.0, 2.0], (COUNT, 1))
    stretches[::2, 2] *= -1.0
    stretches[1::10] = rng.uniform(0.4, 1.4, (COUNT // 10, 1))
    return ((random_rotations(rng, COUNT) * stretches[:, None]) @ random_rotations(rng, COUNT))[:, :, :width]


def smooth_elements(kind: str) -> tuple[Given, Array, Array]:
    """What makes the law, F, and a direction; groups of four share their trace."""
    rng, width = np.random.default_rng(3), KINDS[kind].width
    F, start = smooth_states(rng, width), smooth_states(rng, width)
    slack = np.asarray(np.arange(COUNT) % 2, np.float64)[:, None]
    material = random_material(rng, kind, COUNT, decades=1.0)
    given = Given(material, slack, rng.uniform(0.5, 2.0, COUNT), GROUPS, start, 0.1)
    return given, F, rng.standard_normal(F.shape)


def by_group(values: Array) -> Array:
    return np.bincount(GROUPS, weights=values)


STEP = 3e-6


def check_derivative(function: Callable[[float], Array], expected: Array) -> None:
    """The central difference quotient of each row is the expected derivative, to 1e-6, wherever it has converged.

    It has if that of a doubled step differs by less than 1e-7. It has not beside a kink, or a state whose nearest point
    is not unique: few rows. Both carry the rounding of the function over the step, and 1e-12 for moduli near one.
    """
    values = [function(h).reshape(len(expected), -1) for h in (STEP, -STEP, 2 * STEP, -2 * STEP)]
    rounding = 1e-12 + 10.0 * np.finfo(np.float64).eps * np.abs(values).max(axis=(0, 2)) / STEP
    near, far = (values[0] - values[1]) / (2 * STEP), (values[2] - values[3]) / (4 * STEP)
    size = np.linalg.norm(near, axis=1)
    converged = np.linalg.norm(near - far, axis=1) <= 1e-7 * size + rounding
    error = np.linalg.norm(near - expected.reshape(near.shape), axis=1)
    assert converged.mean() >= 0.9
    assert (error <= 1e-6 * size + rounding)[converged].all()


@pytest.mark.parametrize("kind", KINDS)
def test_stress_and_its_derivative_are_those_of_the_energy(kind: str) -> None:
    given, F, dF = smooth_elements(kind)
    law = KINDS[kind].law(given)
    slope = by_group(np.einsum("nij,nij->n", law.evaluate(F)[1], dF))
    check_derivative(lambda h: by_group(law.evaluate(F + h * dF)[0]), slope)
    check_derivative(lambda h: law.evaluate(F + h * dF)[1], law.differential(F, dF))


@pytest.mark.parametrize("kind", KINDS)
def test_blocks_and_coupling_are_the_second_derivative(kind: str) -> None:
    """They make the same product as `differential`; clamped blocks are positive and agree where nothing is clamped."""
    given, F, dF = smooth_elements(kind)
    law = KINDS[kind].law(given)
    flat = np.swapaxes(dF, 1, 2).reshape(COUNT, -1)
    blocks, clamped = law.blocks(F, positive=False), law.blocks(F, positive=True)
    product = np.einsum("nij,nj->ni", blocks, flat)
    joined = law.coupling(F)
    if joined is not None:
        sums = joined.factor * np.bincount(joined.group, weights=np.einsum("nij,nij->n", joined.rows, dF))
        product += sums[joined.group][:, None] * np.swapaxes(joined.rows, 1, 2).reshape(COUNT, -1)
    expected = np.swapaxes(law.differential(F, dF), 1, 2).reshape(COUNT, -1)
    size = np.linalg.norm(expected, axis=1) + law.quadratic * law.measure
    assert (np.linalg.norm(product - expected, axis=1) <= 1e-10 * size).all()
    least, scale = np.linalg.eigvalsh(blocks)[:, 0], np.linalg.norm(blocks, axis=(1, 2))
    assert (np.linalg.eigvalsh(clamped)[:, 0] >= -1e-12 * scale).all()
    same = least >= 0.0
    assert (np.linalg.norm(clamped - blocks, axis=(1, 2))[same] <= 1e-10 * scale[same]).all()


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_by_the_rows_of_the_material(kind: str) -> None:
    """By every row of one member of each group: of the energy, and of the stress along a direction."""
    given, F, dF = smooth_elements(kind)
    law = KINDS[kind].law(given)
    rates = KINDS[kind].rows(given, law.rates(F))
    products = KINDS[kind].rows(given, law.products(F, dF))
    # the rows of flow change the state, and F through it, but not the law
    of_flow = {"yield_strain", "hardening", "creep_time", "max_flow", "flow"}
    assert list(rates) == list(products) == [name for name in given.material if name not in of_flow]
    for name, column in ((name, c) for name, values in rates.items() for c in range(values[0].size)):
        step = np.zeros((COUNT, rates[name][0].size))
        step[1::4, column] = 1.0

        def moved(h: float, name: str = name, step: Array = step) -> tuple[Array, Array]:
            values = given.material[name] + h * step.reshape(given.material[name].shape)
            energies, stress = KINDS[kind].law(given._replace(material=given.material | {name: values})).evaluate(F)
            return by_group(energies), by_group(np.einsum("nij,nij->n", stress, dF))

        expected = [table[name].reshape(COUNT, -1)[1::4, column] for table in (rates, products)]
        check_derivative(lambda h, of=moved: of(h)[0], expected[0])
        check_derivative(lambda h, of=moved: of(h)[1], expected[1])


def test_members_of_a_group_share_their_trace() -> None:
    """p = lambda_e min(t, c) with t = sum V lambda t / sum V lambda and c the least 2 mu / lambda of the group.

    A member without lambda and one with a negative Poisson's ratio have traces of their own.
    """
    F = np.array([np.diag(d) for d in ([1.2, 1.1, 1.0], [1.0, 0.9, 1.05], [1.3, 1.0, 1.0], [1.1, 1.1, 1.0])])
    shear, bulk = np.array([1.0, 2.0, 1.0, 4.0]), np.array([2.0, 30.0, 0.0, -1.0])
    measure = np.array([0.5, 2.0, 1.0, 1.0])
    stress = Corotated(shear, bulk, measure, np.zeros(4, dtype=np.int64)).evaluate(F)[1]
    t = (0.5 * 2.0 * 0.3 + 2.0 * 30.0 * -0.05) / (0.5 * 2.0 + 2.0 * 30.0)
    pressure = bulk * np.array([t, t, 0.0, 0.2])
    expected = measure[:, None, None] * (shear[:, None, None] * (F - np.eye(3)) + pressure[:, None, None] * np.eye(3))
    np.testing.assert_allclose(stress, expected, atol=1e-14)
    wide = Corotated(shear, bulk, measure, np.zeros(4, dtype=np.int64)).evaluate(2.0 * F)[1]
    pressure = bulk * np.array([1.0 / 15.0, 1.0 / 15.0, 0.0, 2.0 * 3.2 - 3.0])
    rest = measure[:, None, None] * (shear[:, None, None] * (2.0 * F - np.eye(3)) + pressure[:, None, None] * np.eye(3))
    np.testing.assert_allclose(wide, rest, atol=1e-13)
