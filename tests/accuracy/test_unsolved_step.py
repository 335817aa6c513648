"""Where errors are measured from, against the float64 reference, and an audit that measures from there."""

from __future__ import annotations

import pytest
import torch
from tuning_cases import bar

import torchpd as pd
from torchpd.accuracy.error import exact_steps, problem_of
from torchpd.accuracy.unsolved_step import unsolved_step

H = 1 / 60


def test_it_is_that_of_the_reference(dtype: torch.dtype, device: torch.device) -> None:
    """Pins of both kinds that move, some of them soft in one environment, a rough slope, a wall, a ball that moves."""
    mesh = pd.shapes.box((0.4, 0.1, 0.1), (4, 2, 2))
    body = pd.Solid(mesh, 1e5, 1000.0)
    held, sprung = pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Pin(body, mesh.vertices[:, 0] == 0.4, stiffness=1e3)
    ball = pd.Sphere((0.2, -0.06, 0.05), 0.1, friction=0.5)
    contacts = (pd.Ground(-0.01, normal=(0.1, 1.0, 0.0), friction=0.4), pd.Ground(-0.35, normal=(-1.0, 0.0, 0.0)), ball)
    sim = pd.Simulator(pd.Scene(body, held, sprung, *contacts, pd.Gravity()), H, dtype=dtype, progress=False)
    stiffness, hard = sim.pin_stiffness.detach().repeat(3, 1), sim.pin_hard.repeat(3, 1)
    stiffness[1, :4], hard[1, :4] = 10.0, False
    sim.set_material(pin_stiffness=stiffness, pin_hard=hard)
    sim.to(device)
    generator = torch.Generator().manual_seed(0)
    state = sim.rest_state(3)
    state = pd.State(
        *(
            part + torch.randn(part.shape, generator=generator).to(part) * s
            for part, s in zip(state, (0.01, 2.0), strict=True)
        )
    )
    pins = sim.pin_targets[: len(held.vertices)].detach() + 0.02
    targets = {held: pins, ball: torch.tensor([0.2, -0.05, 0.05, 0.0, 0.6, 0.0]).to(pins)}
    found = unsolved_step(sim.plan, sim.material_at(targets, 3), sim.time_step, state).cpu().double()
    for item in range(3):
        expected = torch.tensor(problem_of(sim, state, item, targets=targets).unsolved())
        torch.testing.assert_close(found[item], expected, rtol=0, atol=8 * torch.finfo(dtype).eps)
    assert float((found - (H * state.velocities).cpu().double()).norm(dim=-1).max()) > 0.02


@pytest.mark.parametrize("spin", [0.0, 5.0])
def test_an_audit_of_a_body_that_flies_measures_from_there(spin: float) -> None:
    """Rigid motions take such a body nearer to its converged step before the first iteration: no part of its error."""
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (6, 2, 2))
    sim = pd.Simulator(pd.Scene(pd.Solid(mesh, 1e5), pd.Gravity()), H, dtype=torch.float64, progress=False)
    state = sim.rest_state()
    state.velocities[..., 1] = -5.0 * state.positions[..., 0] ** 2
    state.velocities[..., 2] = spin * (state.positions[..., 0] - 0.5)
    result = sim.tune(state, error=1e-2, candidates=[pd.Chebyshev()])
    after = sim(state)
    (exact,) = exact_steps(sim, state)
    error = exact.position_error(after.velocities[0].numpy() * H)
    assert float(result.verify(sim, state, after)) == pytest.approx(error, rel=1e-3)


def test_nothing_is_in_the_way() -> None:
    sim = bar(dtype=torch.float64)
    state = sim.rest_state(2)
    state.velocities[..., 0] = torch.rand(2, sim.vertices, dtype=torch.float64)
    free = sim.rest_positions[:, 0] > 0.0
    found = unsolved_step(sim.plan, sim.material(), sim.time_step, state)
    assert torch.equal(found[:, free], H * state.velocities[:, free])
    assert not bool(found[:, ~free].any())
