"""Errors of steps with cloth, rods, springs, ties and fibres: the reference has the simulator's present material."""

from __future__ import annotations

import pytest
import torch
from runs import noise
from sheets import cloth, surface

import torchpd as pd
from torchpd.accuracy.error import exact_steps, problem_of


def test_the_reference_has_the_present_material_of_every_kind() -> None:
    """Gradients of the objective agree, for environments of their own and an activation of the step."""
    solid = pd.Solid(pd.shapes.box((1, 0.3, 0.3), (1, 1, 1)), 1e5, poisson=0.3)
    sheet = cloth(bending=1e-3, warp=20.0, grain=(1.0, 0.0, 0.0))
    rod = pd.Rod([[0.0, 1, 0], [0.5, 1, 0], [1, 1, 0]], 1e6, 1e-2)
    fibres = pd.Fibres(solid, (1, 0, 0), 1e4)
    tie = pd.Tie(sheet, [0], solid, [[0.1, 0.1, 0.1]], stiffness=30.0)
    springs = pd.Springs(rod, [[0, 2]], 50.0, other=sheet)
    parts = (sheet, solid, rod, springs, tie, fibres, pd.Pin(solid, [0]), pd.Gravity())
    sim = pd.Simulator(pd.Scene(*parts), dtype=torch.float64)
    factor = torch.tensor([[0.8], [1.2]], dtype=torch.float64)
    rows = [
        name for name in sim.material_names if name not in ("gravity", "damping", "pin_targets", "planes", "spheres")
    ]
    sim.set_material(**{name: getattr(sim, name) * factor for name in rows if name != "pin_stiffness"})
    x, v = sim.rest_state(2)
    state = pd.State(x + 0.01 * noise(x, 1), noise(v, 2))
    after = state.positions + 0.02 * noise(x, 3)
    targets = {fibres: torch.tensor([0.3, 0.9], dtype=torch.float64)}
    gradient = sim.step_gradient(state, after, targets=targets)
    for item in range(2):
        problem = problem_of(sim, state, item, targets=targets)
        expected = torch.from_numpy(problem.gradient((after - state.positions)[item].numpy()))
        scale = float(expected.abs().max())
        torch.testing.assert_close(gradient[item], expected, rtol=0.0, atol=1e-11 * scale)
    with pytest.raises(AssertionError):  # the activation matters
        torch.testing.assert_close(gradient, sim.step_gradient(state, after), rtol=0.0, atol=1e-6 * scale)


def test_a_step_of_a_hanging_cloth_is_solved_and_tuned() -> None:
    sheet = cloth(surface(cells=(6, 6)), youngs=1e6, bending=1e-4)
    sim = pd.Simulator(pd.Scene(sheet, pd.Pin(sheet, [0, 6]), pd.Gravity()), dtype=torch.float64)
    state = sim.rollout(sim.rest_state(), 8).state()
    (exact,) = exact_steps(sim, state)
    assert exact.uncertainty < 1e-8
    sim.iterations = 3000
    after = sim(state)
    assert exact.position_error(((after.positions - state.positions)[0]).numpy()) < 1e-5
    result = sim.tune(state, error=1e-2)
    assert result.attained
