"""The convergence estimate of solids with a Poisson ratio, cloth, rods and mixtures, against spectra and steps."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import torchpd as pd
from torchpd.accuracy.error import exact_steps
from torchpd.estimate.convergence import forecast, spectrum_of
from torchpd.ops.diagonal import step_diagonal

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
NAMES = ("beam 0", "beam 0.3", "beam 0.45", "cloth 1e3", "cloth 1e4", "rod", "mixed")
FACTOR = 2.5  # between the estimate and the iterations of steps that do not buckle; docs/accuracy.md states it


@pytest.fixture
def scenes(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("effect_scenes").EFFECT_SCENES


def smallest_eigenvalue(sim: pd.Simulator, positions: torch.Tensor, steps: int = 300) -> float:
    """Of D^-1 (a + second derivatives), by Lanczos's method."""
    inertia, diagonal = (t[:, None] for t in step_diagonal(sim.plan.arrays, sim.material(), sim.time_step))
    free = inertia.isfinite()
    inertia, half = torch.where(free, inertia, 0.0), torch.where(free, diagonal.rsqrt(), 0.0)
    material, plan = sim.material(), list(sim.plan.arrays)

    def product(vector: torch.Tensor) -> torch.Tensor:
        scaled = half * vector
        return half * (inertia * scaled + torch.ops.torchpd.hessian_product(positions, scaled[None], material, plan)[0])

    vector = torch.where(free, torch.randn(sim.vertices, 3, generator=torch.Generator().manual_seed(0)).double(), 0.0)
    vector, before, beside = vector / vector.norm(), torch.zeros_like(vector), 0.0
    on, off = [], []
    for _ in range(steps):
        after = product(vector) - beside * before
        on.append(float((after * vector).sum()))
        after = after - on[-1] * vector
        beside = float(after.norm())
        off.append(beside)
        before, vector = vector, after / beside
    return float(np.linalg.eigvalsh(np.diag(on) + np.diag(off[:-1], 1) + np.diag(off[:-1], -1))[0])


@pytest.mark.parametrize("name", NAMES)
def test_one_bound_on_the_spectrum_holds_for_every_kind(scenes: Any, name: str) -> None:
    """At rest mu is below the smallest eigenvalue, and not by much."""
    sim = scenes[name].simulator(torch.float64, 64)
    spectrum = spectrum_of(sim.compiled)
    assert spectrum is not None
    smallest = smallest_eigenvalue(sim, sim.rest_state().positions)
    assert (1.0 - 1e-9) * spectrum.least <= smallest < 1.6 * spectrum.least


@pytest.mark.parametrize("name", NAMES)
def test_a_step_takes_what_was_estimated_for_its_kind(scenes: Any, name: str) -> None:
    """Within `FACTOR` at errors of 1e-1, 1e-2 and 1e-3, in float64."""
    scene = scenes[name]
    state, sim = scene.state(), scene.simulator(torch.float64, 64)
    exact = exact_steps(sim, state)[0]
    expected = forecast(sim.compiled)
    assert expected is not None
    for error in (1e-1, 1e-2, 1e-3):
        left = []
        for share in (1.0 / FACTOR, FACTOR):
            sim.iterations = round(share * expected.iterations(error))
            left.append(exact.position_error((sim(state).velocities[0] * sim.time_step).numpy()))
        assert left[0] > error > left[1], error


def test_errors_are_against_the_minimum_that_the_default_reaches(scenes: Any) -> None:
    """Where a sheet buckles a step has several minima, and `Multilevel` ends in another one."""
    scene = scenes["draped"]
    state = scene.state()
    exact = exact_steps(scene.simulator(torch.float64, 64), state)[0]
    assert exact.uncertainty < 1e-9

    def error(solver: Any, iterations: int) -> float:
        sim = scene.simulator(torch.float64, iterations, solver)
        return exact.position_error((sim(state).velocities[0] * sim.time_step).numpy())

    assert error(pd.Chebyshev(), 3000) < 1e-6
    assert error(pd.Multilevel(), 400) > 1e-2


def test_the_description_says_that_buckling_takes_more(scenes: Any) -> None:
    said = "more where cloth or rods buckle"
    assert said in repr(scenes["cloth 1e3"].simulator(torch.float32, 64))
    assert said not in repr(scenes["beam 0.45"].simulator(torch.float32, 64))


def test_auto_takes_chebyshev_for_other_parts_with_enough_iterations(scenes: Any) -> None:
    scene = scenes["cloth 1e3"]
    sim = scene.simulator(torch.float32, None, "auto")
    assert isinstance(sim.solver, pd.Chebyshev)
    state = scene.state()
    exact = exact_steps(sim, pd.State(*(part.float() for part in state)))[0]
    reached = sim(pd.State(*(part.float() for part in state)))
    assert exact.position_error((reached.velocities[0].double() * sim.time_step).numpy()) < 1e-3
