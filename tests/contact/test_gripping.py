"""Bodies between contacts that hold them by friction: fingers that squeeze, lift and drop."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import torchpd as pd

pytestmark = pytest.mark.usefixtures("poisoned")

H = 1 / 60
SIDE, RADIUS, DEPTH = 0.1, 0.05, 0.003
CLOSING, LIFTING = 30, 30
SPEED = 0.1
SOLVERS = {"Chebyshev": (pd.Chebyshev(), 64), "Multilevel": (pd.Multilevel(), 24), "Jacobi": (pd.Jacobi(), 1000)}


def gripped(
    youngs: float, friction: float, dtype: torch.dtype, device: torch.device, gravity: float = 0.0
) -> tuple[pd.Simulator, list[pd.Sphere]]:
    """A cube of 1 kg about the origin, and a ball that touches it on either side."""
    body = pd.Solid(pd.shapes.box((SIDE,) * 3, (4, 4, 4)).translated((-SIDE / 2,) * 3), youngs)
    balls = [pd.Sphere((side * (SIDE / 2 + RADIUS), 0.0, 0.0), RADIUS, friction) for side in (-1.0, 1.0)]
    scene = pd.Scene(body, pd.Gravity((0.0, gravity, 0.0)), *balls)
    return pd.Simulator(scene, H, dtype=dtype, progress=False).to(device), balls


def fingers(sim: pd.Simulator, balls: list[pd.Sphere], step: int) -> dict[pd.Sphere, Tensor]:
    """Where the balls are after a step: closing, then going up."""
    closed, lifted = min(1.0, (step + 1) / CLOSING) * DEPTH, max(0, step + 1 - CLOSING) * SPEED * H
    return {
        ball: sim.spheres.new_tensor([ball.center[0] * (1.0 - closed / abs(ball.center[0])), lifted, 0.0])
        for ball in balls
    }


def heights(sim: pd.Simulator, balls: list[pd.Sphere]) -> Tensor:
    track = sim.rollout(sim.rest_state(), CLOSING + LIFTING, targets=lambda step: fingers(sim, balls, step))
    return track.positions[:, 0, :, 1].mean(dim=1).double().cpu()


@pytest.mark.parametrize("youngs", [1e5, 1e6, 1e7])
@pytest.mark.parametrize("name", SOLVERS)
def test_rough_balls_take_a_cube_along(name: str, youngs: float, dtype: torch.dtype, device: torch.device) -> None:
    """However small they are; the way along a ball's surface is no way from it."""
    sim, balls = gripped(youngs, 1.0, dtype, device)
    sim.solver, sim.iterations = SOLVERS[name]
    found = heights(sim, balls)
    lifted = SPEED * H * torch.arange(1, LIFTING + 1)
    assert float(found[:CLOSING].abs().max()) <= 1e-5
    # the body gives by some of what it takes to bring it to that speed, m v / h = 6 N at first, and swings a little
    assert float((found[CLOSING:] - lifted).abs().max()) <= {1e5: 2e-3, 1e6: 2e-4, 1e7: 2e-4}[youngs]
    assert float((found[-10:].diff() / (SPEED * H)).sub(1.0).abs().max()) <= (0.2 if youngs == 1e5 else 0.02)


@pytest.mark.parametrize(("friction", "steps"), [(1.0, 12), (0.02, 3)], ids=["held", "slips"])
def test_it_takes_friction_to_hold_a_weight(
    friction: float, steps: int, dtype: torch.dtype, device: torch.device
) -> None:
    """Of 9.8 N, by two forces of some 99 N times the coefficient. Later the balls catch the next vertices."""
    sim, balls = gripped(1e6, friction, dtype, device, gravity=-9.8)
    sim.set_material(gravity=torch.zeros(3, dtype=dtype, device=device))
    state = sim.rest_state()
    for step in range(CLOSING):
        state = sim(state, targets=fingers(sim, balls, step))
    sim.set_material(gravity=torch.tensor([0.0, -9.8, 0.0], dtype=dtype, device=device))
    still = fingers(sim, balls, CLOSING - 1)
    for _ in range(steps):
        state = sim(state, targets=still)
    fallen = -float(state.positions[0, :, 1].mean())
    # a free fall of 3 steps goes 6 h^2 g
    assert fallen <= 3e-4 if friction == 1.0 else fallen >= 0.5 * 6 * 9.8 * H**2
