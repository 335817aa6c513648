"""Bodies that friction holds: every solver, and those that are chosen, leave them where they are."""

from __future__ import annotations

import pytest
import torch

import torchpd as pd


def cube_on_a_slope(youngs: float = 1e6) -> pd.Scene:
    """Its weight pulls along the ground with less than friction may take back."""
    cube = pd.Solid(pd.shapes.box((0.2, 0.2, 0.2), (3, 3, 3)), youngs, 1000.0)
    return pd.Scene(cube, pd.Gravity((6.0, -9.81, 0.0)), pd.Ground(0.0, friction=0.8))


def slide(sim: pd.Simulator, steps: int = 90) -> tuple[float, float]:
    """How far the cube has come, and how fast it still is."""
    track = sim.rollout(sim.rest_state(), steps)
    way = track.positions[-1] - sim.rest_positions
    return float(way[..., 0].mean()), float(track.velocities[-20:].norm(dim=-1).max())


@pytest.mark.parametrize("outer", ["lbfgs", "momentum"])
@pytest.mark.parametrize("youngs", [1e5, 1e6, 1e7])
def test_few_iterations_of_multilevel_leave_it_where_it_is(youngs: float, outer: str) -> None:
    iterations = 30 if outer == "momentum" else 10
    expected, _ = slide(pd.Simulator(cube_on_a_slope(youngs), 1 / 60, 512))
    way, speed = slide(pd.Simulator(cube_on_a_slope(youngs), 1 / 60, iterations, pd.Multilevel(outer)))
    assert abs(way - expected) < 1e-3
    assert speed < 2e-3


@pytest.mark.parametrize("youngs", [1e6, 1e7])
@pytest.mark.parametrize("friction", [0.3, 0.8])
def test_no_iterate_is_worse_than_the_first(youngs: float, friction: float) -> None:
    """Of a stiff bar that lands and slides."""
    mesh = pd.shapes.box((0.6, 0.15, 0.15), (8, 2, 2))
    scene = pd.Scene(pd.Solid(mesh, youngs), pd.Gravity((3.0, -9.81, 0.0)), pd.Ground(-0.02, friction=friction))
    exact = pd.Simulator(scene, 1 / 60, 6000, dtype=torch.float64, tolerance=1e-12)
    state = exact.rest_state()
    state.velocities[..., 0] = 1.0
    state.velocities[..., 1] = 2.0 * state.positions[..., 0] - 1.0
    for _ in range(4):
        after = exact(state)
        first = (state.positions + state.velocities / 60 - after.positions).norm()
        for iterations in (5, 10, 40):
            sim = pd.Simulator(scene, 1 / 60, iterations, pd.Multilevel(), dtype=torch.float64)
            assert (sim(state).positions - after.positions).norm() < 1.05 * first, iterations
        state = after


def test_automatic_and_tuned_solvers_hold_it() -> None:
    chosen = pd.Simulator(cube_on_a_slope(), 1 / 60, solver="auto", progress=False)
    assert isinstance(chosen.solver, pd.Chebyshev)
    assert "friction may stall Multilevel" in str(chosen)
    tuned = pd.Simulator(cube_on_a_slope(), 1 / 60, progress=False)
    tuned.tune(error=1e-2)
    assert not isinstance(tuned.solver, pd.Multilevel)
    for sim in (chosen, tuned):
        way, speed = slide(sim)
        assert abs(way) < 2e-3
        assert speed < 1e-3
