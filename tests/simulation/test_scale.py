"""Lengths have no natural unit: a scene 2^-14 times as long takes the same steps.

With lengths, speeds and gravity times s and Young's modulus times s^2, at one density, all accelerations are times s.
A length, area or volume that the code compares with a constant shows.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchpd as pd
from torchpd.scene.solvers import Solver

SCALE = 2.0**-14


def scene(scale: float, held: int) -> pd.Scene:
    """A tilted bar that falls on a rough ground and a ball, and one that is held at a point, a line or a plane."""
    loose = pd.shapes.box((0.2, 0.1, 0.1), (4, 2, 2)).transformed(
        np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    )
    bar = pd.shapes.box((0.4, 0.1, 0.1), (8, 2, 2)).translated((1.0, 1.0, 0.0))
    first = pd.Solid(loose.scaled(scale), 1e5 * scale**2)
    second = pd.Solid(bar.scaled(scale), 1e5 * scale**2)
    end = np.flatnonzero(bar.vertices[:, 0] == bar.vertices[:, 0].min())
    rows = end[np.lexsort((bar.vertices[end, 2], bar.vertices[end, 1]))]
    pinned = {1: rows[:1], 2: rows[:3], 3: rows}[held]
    gravity = pd.Gravity((0.0, -9.81 * scale, 0.0))
    ground = pd.Ground(-0.01 * scale, friction=0.5)
    return pd.Scene(
        first,
        second,
        pd.Pin(second, pinned),
        gravity,
        ground,
        pd.Sphere((0.05 * scale, -0.05 * scale, 0.05 * scale), 0.08 * scale),
    )


@pytest.mark.filterwarnings("ignore::torchpd.MeshWarning", "ignore::torchpd.SceneWarning")
@pytest.mark.parametrize("held", [1, 2, 3])
@pytest.mark.parametrize(("solver", "iterations"), [(pd.Chebyshev(), 20), (pd.Multilevel(), 200)])
def test_a_scene_of_another_size_takes_the_same_steps(solver: Solver, iterations: int, held: int) -> None:
    """L-BFGS amplifies rounding until it has converged, so it gets more iterations."""
    tracks = []
    for scale in (1.0, SCALE):
        sim = pd.Simulator(scene(scale, held), 0.01, iterations, solver=solver, dtype=torch.float64, progress=False)
        state = sim.rest_state()
        state.velocities[..., 0] += 0.3 * scale
        track = sim.rollout(state, 12)
        tracks.append(torch.stack([track.positions, track.velocities]) / scale)
    assert float((tracks[0][0, -1] - tracks[0][0, 0]).abs().max()) > 0.05
    # velocities of 240 iterations, each with some tens of roundings of positions of 1.4 m, over 0.01 s
    torch.testing.assert_close(*tracks, rtol=0.0, atol=240 * 30 * 1.4 * 1.1e-16 / 0.01)
