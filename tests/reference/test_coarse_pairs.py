"""Coarse correction of bodies that touch each other: motion after few iterations, momentum, converged steps."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from programs import ROOT

import torchpd as pd
from torchpd.reference import step_problem
from torchpd.reference.pair_step import corrected_pairs, pair_chebyshev

H = 1.0 / 60.0


@pytest.fixture
def pairs(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import coarse_pairs

    return coarse_pairs


def test_an_overhanging_cube_tips_off(pairs: ModuleType) -> None:
    """Iterations alone let a stiff cube hang in the air."""
    bodies = replace(pairs.scenes(1e7, 1)["overhang tips off"], steps=3)
    exact = bodies.run(600)
    assert bodies.error(bodies.run(16), exact) <= 0.01
    assert bodies.error(bodies.run(16, corrections=False), exact) > 0.1


@pytest.mark.parametrize("youngs", [1e5, 1e7])
def test_a_collision_in_flight_keeps_the_momentum(pairs: ModuleType, youngs: float) -> None:
    bodies = replace(pairs.scenes(youngs, 1)["collide in flight"], steps=3)
    values = pd.Scene(*(pd.Solid(mesh, youngs) for mesh in bodies.meshes)).values()
    masses = values.masses[:, None]
    before = (masses * bodies.velocities).sum(axis=0)
    scale = float((masses * np.abs(bodies.velocities)).sum())
    for step, (_, v) in enumerate(bodies.run(16)):
        fall = (step + 1) * H * np.array([0.0, -9.8, 0.0]) * masses.sum()
        assert np.abs((masses * v).sum(axis=0) - before - fall).max() <= 1e-9 * scale
    assert np.abs((masses * (v - bodies.velocities))[: len(v) // 2, 0].sum()) > 0.1 * scale  # they did collide


@pytest.mark.parametrize("name", ["two cubes rest", "dropped on a cube", "collide in flight"])
def test_converged_pairs_stay(pairs: ModuleType, name: str) -> None:
    bodies = pairs.scenes(1e5, 1)[name]
    values = pd.Scene(*(pd.Solid(mesh, 1e5) for mesh in bodies.meshes), *bodies.parts).values()
    x = np.concatenate([mesh.vertices for mesh in bodies.meshes])
    problem = step_problem(values, x, bodies.velocities, H)
    u, touching = pair_chebyshev(problem, bodies.pairs(x), iterations=800, corrections=False)
    assert np.linalg.norm(touching.forces, axis=1).max() > 0.1
    moved, after = corrected_pairs(problem, touching, u)
    assert np.abs(moved - u).max() <= 1e-8
    np.testing.assert_allclose(after.forces, touching.forces, atol=1e-6 * np.abs(touching.forces).max())
