"""Plastic flow: its update, the derivative of the update, and a bar pulled beyond its yield and pressed back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from element_cases import random_rotations
from stencil_scenes import PLASTIC_ALPHA, PLASTIC_FORCES, plastic_bar

from torchpd.reference import step_problem
from torchpd.reference.plastic import Flow, PlasticLaw, flow, flow_product, flowed, uniaxial_yield
from torchpd.reference.solvers import newton


def law(
    count: int, strain: float, *, hardening: float = 0.0, creep_time: float = 0.0, most: float = np.inf
) -> PlasticLaw:
    return PlasticLaw(np.full(count, strain), np.full(count, hardening), creep_time, most)


def virgin(count: int) -> Flow:
    return Flow(np.tile(np.eye(3), (count, 1, 1)), np.zeros(count))


@pytest.mark.parametrize(
    ("hardening", "gamma", "stretches"),
    [
        (0.0, 0.0988649278, (1.0840704324, 0.9604422363, 0.9604422363)),
        (0.5, 0.0659099518, (1.0552896197, 0.9734511598, 0.9734511598)),
    ],
)
def test_flow_of_a_uniaxial_stretch(hardening: float, gamma: float, stretches: tuple[float, ...]) -> None:
    after = flow(law(1, 0.05, hardening=hardening), np.diag([1.2, 1.0, 1.0])[None], virgin(1), 0.1)
    assert after.hardening[0] == pytest.approx(gamma, abs=1e-10)
    np.testing.assert_allclose(after.plastic[0], np.diag(stretches), atol=1e-10)


def test_yield_strain_is_that_of_a_uniaxial_test() -> None:
    """A bar of nu = .3 at its yield strain e has log strains e (1, -nu, -nu): it flows just beyond."""
    strain = float(uniaxial_yield(np.array([0.02]), np.array([0.3]))[0])
    for factor, flows in ((0.999, False), (1.001, True)):
        elastic = np.diag(np.exp(factor * 0.02 * np.array([1.0, -0.3, -0.3])))[None]
        assert (flow(law(1, strain), elastic, virgin(1), 0.1).hardening[0] > 0.0) == flows


def test_creep_and_the_bound_of_flow() -> None:
    elastic, full = np.diag([1.2, 1.0, 1.0])[None], 0.0988649278
    slow = flow(law(1, 0.05, creep_time=0.2), elastic, virgin(1), 0.1)
    assert slow.hardening[0] == pytest.approx(full * (1.0 - np.exp(-0.5)), abs=1e-9)
    bounded = flow(law(1, 0.05, most=0.03), elastic, virgin(1), 0.1)
    assert np.linalg.norm(np.log(np.linalg.svd(bounded.plastic[0])[1])) == pytest.approx(0.03, rel=1e-12)
    inverted = flow(law(1, 0.05), np.diag([1.2, 1.0, -1.0])[None], virgin(1), 0.1)
    np.testing.assert_array_equal(inverted.plastic, virgin(1).plastic)


def test_flow_keeps_the_volume_and_its_direction_turns_with_the_body() -> None:
    """D = V exp(gamma n) V^T depends on F_e^T F_e alone, and has determinant 1."""
    rng = np.random.default_rng(0)
    elastic = np.eye(3) + 0.2 * rng.standard_normal((50, 3, 3))
    state = Flow(random_rotations(rng, 50), rng.uniform(0.0, 0.1, 50))
    one = flow(law(50, 0.05, hardening=0.3), elastic, state, 0.1)
    turned = flow(law(50, 0.05, hardening=0.3), random_rotations(rng, 50) @ elastic, state, 0.1)
    np.testing.assert_allclose(turned.plastic, one.plastic, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(one.plastic), 1.0, rtol=1e-13)


@pytest.mark.parametrize("stretches", [(1.3, 1.1, 0.7), (1.2, 1.0, 1.0), (1.01, 1.0, 0.99)])
def test_flow_product_is_its_derivative(stretches: tuple[float, ...]) -> None:
    """Also for two equal stretches and without flow; central differences of D, whose third derivative is below 1e3."""
    rng = np.random.default_rng(1)
    given, state = law(20, 0.05, hardening=0.3, creep_time=0.1), virgin(20)
    elastic = random_rotations(rng, 20) @ np.diag(stretches) @ random_rotations(rng, 20)
    change, step = rng.standard_normal((20, 3, 3)), 1e-5
    ends = [flow(given, elastic + h * change, state, 0.1).plastic for h in (step, -step)]
    product = flow_product(given, elastic, change, state, 0.1)
    np.testing.assert_allclose(product, (ends[0] - ends[1]) / (2.0 * step), atol=1e-6)


def test_bar_beyond_its_yield() -> None:
    """Ends moved by 3/80 a step to 1.3 and back; the state at the start of every step is at rest."""
    values, bar = plastic_bar()
    x, state, rest = values.rest_positions, virgin(len(bar.corners)), values.rest_positions
    right = values.pin_targets[:, 0] > 0.5
    ends = np.concatenate([1.0 + 0.0375 * np.arange(1, 9), 1.0 + 0.0375 * np.arange(7, -1, -1)])
    forces = {}
    for number, end in enumerate(ends, start=1):
        targets = values.pin_targets + np.where(right, end - 1.0, 0.0)[:, None] * [1.0, 0.0, 0.0]
        elements = flowed(bar, state.plastic)
        mixed = replace(values, stencils=(elements,))
        problem = step_problem(mixed, x, np.zeros_like(x), 1.0 / 30.0, pin_targets=targets)
        u = newton(problem, problem.first_iterate("velocity"))
        group = problem.groups[0]
        elastic = group.deformation(u)
        forces[number] = float(group.nodal(group.law.evaluate(elastic)[1])[rest[:, 0] > 1.0 - 1e-9, 0].sum())
        x, state = x + u, flow(law(len(bar.corners), 0.05), elastic, state, 1.0 / 30.0)
    assert {step: forces[step] for step in PLASTIC_FORCES} == pytest.approx(PLASTIC_FORCES, rel=1e-6)
    assert state.hardening.mean() == pytest.approx(PLASTIC_ALPHA, abs=1e-6)
    np.testing.assert_allclose(np.linalg.det(state.plastic), 1.0, rtol=1e-13)
