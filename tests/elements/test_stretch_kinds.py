"""Strain limits, the volume law and damping: single elements through the compiled ops, and the majoriser of each.

psi has its closed forms and numbers from an independent float64 prototype.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from element_cases import random_deformations, random_gradients, unit_gradients
from stretch_cases import KINDS, SHEARED, SHEET, placed, rows_of, single

from torchpd.common.tables import MATERIAL_TABLE
from torchpd.reference.kinds import damping_target
from torchpd.reference.laws import Damped

ops = torch.ops.torchpd
H = 0.1  # time step of `single`, s


def stress(sim, F, **rows):
    """psi and P of one element of stiffness one at F, from E = V psi and the forces V P g_a."""
    x = placed(sim, F[None])
    material, plan = rows_of(sim, **rows), list(sim.plan.arrays)
    width = F.shape[1]
    volume = 1.0 / (6.0 if width == 3 else 2.0)
    energy = float(ops.effect_energy(x, material, plan)) / volume
    forces = ops.gradient(x, material, plan)[0].numpy() / volume
    return energy, forces[1:].T  # g_a of the unit simplex are the axes


@pytest.mark.parametrize(
    ("kind", "F", "rows", "energy", "entries"),
    [
        ("solid_limit", SHEARED, {"stiffness": [0.0], "solid_limit": [[0.95, 1.05, 1.0]]}, 0.0534945564887,
         {(0, 0): 0.0750619053935, (2, 2): 0.2787569508876}),
        ("cloth_limit", SHEET, {"membrane_youngs": [1e-300], "cloth_limit": [[0.95, 1.05, 1.0]]}, 0.0257453805182, {}),
    ],
)  # fmt: skip
def test_known_energies_and_stresses(kind, F, rows, energy, entries):
    found, P = stress(single(kind, unit_gradients(F.shape[1])), F, **rows)
    assert found == pytest.approx(energy, rel=1e-9)
    for place, value in entries.items():
        assert P[place] == pytest.approx(value, rel=1e-9)


def test_known_volume_energy():
    """E with 3 lambda = 1 is mu |F - R|^2 + psi / 2 dist^2; the first part is that of a material without lambda."""
    nu = 0.25
    youngs = (1.0 + nu) * (1.0 - 2.0 * nu) / (3.0 * nu)
    sim = single("volume", unit_gradients(3))
    with_both, P = stress(sim, SHEARED, stiffness=[youngs], poisson=[nu])
    U, _, V = np.linalg.svd(SHEARED)
    apart = SHEARED - U @ V
    mu = youngs / (2.0 * (1.0 + nu))
    assert with_both - mu * (apart**2).sum() == pytest.approx(0.0144971184378, rel=1e-9)
    assert P[0, 0] - 2.0 * mu * apart[0, 0] == pytest.approx(0.0942891129186, rel=1e-9)


def test_known_damping_force():
    """2 mu beta / h (s - s_t) = 0.5 (1.07 - 1.02) along the axis."""
    sim = single("damper", unit_gradients(3))
    F, start = (placed(sim, np.diag([s, 1.0, 1.0])[None]) for s in (1.07, 1.02))
    material = rows_of(sim, stiffness=[1.0], poisson=[0.0], stiffness_damping=[0.5 * H])
    forces = ops.damping_gradient(F, start, material, list(sim.plan.arrays), time_step=H)[0] * 6.0
    np.testing.assert_allclose(forces[1:].T, np.diag([0.025, 0.0, 0.0]), atol=1e-15)


def states(rng, kind, count):
    """Random material rows [B, ...], F and F at the start of the step [B, 3, d]."""
    width = 2 if kind == "cloth_limit" else 3
    F, start = (random_deformations(rng, count)[:, :, :width] for _ in range(2))
    stiff = 10.0 ** rng.uniform(-2.0, 2.0, (count, 1))
    limits = np.stack([rng.uniform(0.0, 1.0, count), rng.uniform(1.0, 2.0, count), stiff[:, 0]], axis=1)[:, None]
    rows = {
        "solid_limit": {"solid_limit": limits, "stiffness": 10.0 ** rng.uniform(-2.0, 2.0, (count, 1))},
        "cloth_limit": {"cloth_limit": limits},
        "volume": {"stiffness": stiff, "poisson": rng.uniform(0.01, 0.49, (count, 1))},
        "damper": {"stiffness": stiff, "poisson": rng.uniform(0.0, 0.49, (count, 1)), "stiffness_damping": [H]},
    }[kind]
    return rows, F, start


def energy_of(kind, sim, x, start, material):
    plan = list(sim.plan.arrays)
    if kind != "damper":
        return ops.effect_energy(x, material, plan).numpy()
    rest = sim.rest_positions.numpy()
    inverse = np.linalg.inv(rest[1:] - rest[0])
    F, before = ((y[:, 1:] - y[:, :1]).numpy().transpose(0, 2, 1) @ inverse.T for y in (x, start))
    names = [row.name for row in MATERIAL_TABLE]
    youngs, nu = (material[names.index(name)].numpy()[:, 0] for name in ("stiffness", "poisson"))
    volume = np.full(len(F), abs(np.linalg.det(rest[1:] - rest[0])) / 6.0)
    return Damped(youngs / (1.0 + nu), damping_target(before), volume).evaluate(F)[0]


def broken(kind, rounds=20, count=1000, *, scale=1.0):
    """Number of states of `rounds` elements in which a step along the gradient lowers E by less than promised."""
    failures = 0
    for seed in range(rounds):
        rng = np.random.default_rng(seed)
        width = 2 if kind == "cloth_limit" else 3
        sim = single(kind, random_gradients(rng, 3, width + 1, width)[seed % 3])
        rows, F, before = states(rng, kind, count)
        material, plan = rows_of(sim, **rows), list(sim.plan.arrays)
        x, start = placed(sim, F), placed(sim, before)
        if kind == "damper":
            gradient = ops.damping_gradient(x, start, material, plan, time_step=H)
            elastic = ops.elastic_diagonal(material, plan, weighted=True)
            diagonal = ops.elastic_diagonal(material, plan, weighted=True, time_step=H) - elastic
        else:
            gradient = ops.gradient(x, material, plan)
            diagonal = ops.elastic_diagonal(material, plan, weighted=True)
        diagonal = scale * diagonal.reshape(-1, diagonal.shape[-1], 1).expand(count, -1, 1)
        energy = energy_of(kind, sim, x, start, material)
        for theta in (0.3, 1.0, 1.9):
            after = energy_of(kind, sim, x - theta * gradient / diagonal, start, material)
            promised = theta * (1.0 - theta / 2.0) * (gradient**2 / diagonal).sum((1, 2)).numpy()
            failures += int((after > energy - promised + 1e-9 * (energy + 1e-12)).sum())
    return failures


@pytest.mark.parametrize("kind", KINDS)
def test_constant_majoriser_in_random_states(kind):
    assert broken(kind) == 0
    assert broken(kind, rounds=2, scale=0.3) > 0  # a smaller diagonal is none
