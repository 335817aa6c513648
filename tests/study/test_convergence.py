"""The comparison of solvers: errors start at one, fall to rounding, and friction does not blur them."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import torchpd as pd
from torchpd.study.convergence import SolvedAlreadyError, compare_solvers, measure_convergence, plot_convergence


def _pressed_beam(friction: float) -> tuple[pd.Simulator, pd.State]:
    """A beam that moves down and sideways into the ground."""
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (10, 2, 2))
    scene = pd.Scene(
        pd.Solid(mesh, youngs=1e5), pd.Gravity(), pd.Ground(float(mesh.bounds[0, 1]) + 0.01, friction=friction)
    )
    sim = pd.Simulator(scene, 1 / 60)
    start = sim.rest_state()
    return sim, pd.State(start.positions, start.velocities + torch.tensor([0.5, -2.0, 0.0]))


def test_every_solver_comes_to_the_same_step() -> None:
    sim, state = _pressed_beam(friction=0.5)
    curves = compare_solvers(sim, state, iterations=512).values()
    assert [type(curve.solver).__name__ for curve in curves] == ["Jacobi", "Chebyshev", "Chebyshev"]
    # float64 rounding times the condition of this step, below 1e4
    assert max(curve.errors[-1] for curve in curves) < 1e4 * np.finfo(np.float64).eps


def test_guarded_chebyshev_is_ahead_of_jacobi() -> None:
    sim, state = _pressed_beam(friction=0.5)
    jacobi, classic, guarded = (curve.errors[-1] for curve in compare_solvers(sim, state, iterations=64).values())
    # sqrt(condition) against condition: with 64 iterations and a condition of hundreds, several digits
    assert guarded < 1e-2 * jacobi
    assert classic < jacobi < 1.0


def test_friction_of_the_scene_does_not_matter() -> None:
    (rough, state), (smooth, _) = _pressed_beam(0.8), _pressed_beam(0.0)
    solvers = {"guarded": pd.Chebyshev()}
    one, other = (measure_convergence(sim, state, solvers, iterations=32)["guarded"] for sim in (rough, smooth))
    assert one == other


def test_diverging_solver_is_measured_and_drawn(tmp_path: Path) -> None:
    sim, state = _pressed_beam(0.0)
    # far too long a step for the plain diagonal, whose spectral radius on this mesh is close to 2
    curves = measure_convergence(
        sim, state, {"jacobi": pd.Jacobi(relaxation=1.99, diagonal="plain"), "guarded": pd.Chebyshev()}, iterations=512
    )
    assert curves["jacobi"].errors[-1] > 1.0
    assert not any(np.isnan(curves["jacobi"].errors))
    path = plot_convergence(curves, tmp_path / "plot.png", title="a beam", mark=64)
    picture = np.asarray(Image.open(path).convert("RGB"))
    assert picture.shape[1] >= 1000
    assert (picture == 255).mean() > 0.5  # mostly paper
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20


def test_free_fall_has_nothing_to_measure() -> None:
    sim, state = _pressed_beam(0.0)
    falling = pd.State(state.positions + torch.tensor([0.0, 5.0, 0.0]), state.velocities)
    with pytest.raises(SolvedAlreadyError, match="first iterate solves this step"):
        measure_convergence(sim, falling, {"guarded": pd.Chebyshev()}, iterations=8)


def test_bad_requests_are_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    sim, state = _pressed_beam(0.0)
    with pytest.raises(ValueError, match=r"state .*got 2"):
        measure_convergence(sim, sim.rest_state(batch=2), {})
    curves = measure_convergence(sim, state, {"guarded": pd.Chebyshev()}, iterations=4)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install torchpd\[demo\]"):
        plot_convergence(curves, tmp_path / "plot.png", title="")
