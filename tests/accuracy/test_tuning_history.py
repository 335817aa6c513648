"""`Simulator.tune` on scenes whose states have a history: bodies in contact, and plastic solids."""

from __future__ import annotations

import pytest
import torch

import torchpd as pd
from torchpd.accuracy.error import settled_steps
from torchpd.accuracy.tuning_study import make_study


def dropped() -> tuple[pd.Simulator, pd.Collider]:
    """A cube above a plate."""
    cube = pd.Solid(pd.shapes.box((0.1, 0.1, 0.1), (2, 2, 2)).translated((0.0, 0.002, 0.0)), youngs=1e5, density=1000.0)
    plate = pd.Collider(pd.shapes.box((0.3, 0.02, 0.3), (1, 1, 1)).translated((-0.1, -0.02, -0.1)))
    scene = pd.Scene(cube, plate, pd.Gravity(), pd.Contact(friction=0.4, thickness=1e-3))
    return pd.Simulator(scene, 1 / 60, progress=False), plate


def thrown(sim: pd.Simulator, *velocity: float) -> pd.HistoryState:
    state = sim.rest_state()
    state.velocities[:] = torch.tensor(velocity)
    return state


def test_the_bound_holds_in_another_motion_of_bodies_in_contact() -> None:
    sim, _ = dropped()
    result = sim.tune(thrown(sim, 0.3, -1.0, 0.0), error=0.1)
    assert result.attained
    assert isinstance(sim.solver, pd.Chebyshev | pd.Jacobi)
    state, touched = thrown(sim, -0.5, -1.5, 0.2), 0
    for _ in range(6):
        (exact,) = settled_steps(sim, state)
        before = state
        state, info = sim(state, return_info=True)
        assert exact.uncertainty < 1e-3
        error = exact.error_beyond_rounding(state.velocities[0].double().numpy() / 60, sim.dtype)
        assert error <= 0.1
        # four times as many iterations leave an error of their own
        assert float(result.verify(sim, before, state)) == pytest.approx(error, abs=0.01)
        touched += int(info.contact_gap < 1.1)
    assert touched >= 4
    # far fewer are not enough
    sim.iterations = max(1, sim.iterations // 16)
    state = thrown(sim, -0.5, -1.5, 0.2)
    (exact,) = settled_steps(sim, state)
    assert exact.error_beyond_rounding(sim(state).velocities[0].double().numpy() / 60, sim.dtype) > 0.1


def test_bodies_that_meet_are_studied_at_other_speeds_too() -> None:
    """Which pairs touch first depends on the speed, and so does what a step needs."""
    sim, _ = dropped()
    start = thrown(sim, 0.3, -1.0, 0.0)
    studied = make_study(sim, start, None, 0.1).state.velocities
    for speed in (0.6, 1.0, 1.3):
        assert bool((studied == speed * start.velocities).flatten(1).all(dim=1).any())


def test_a_plastic_bar_is_tuned() -> None:
    mesh = pd.shapes.box((0.4, 0.1, 0.1), (4, 2, 2))
    body = pd.Solid(mesh, youngs=1e6, plastic=pd.Plastic(yield_strain=2e-3))
    scene = pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity())
    sim = pd.Simulator(scene, 1 / 60, progress=False)
    result = sim.tune(error=0.1)
    assert result.attained
    state = sim.rest_state()
    for _ in range(4):
        state = sim(state)
    assert bool((state.history.flow != sim.rest_state().history.flow).any())


def test_colliders_stay_where_the_state_has_them() -> None:
    sim, plate = dropped()
    pose = torch.tensor([0.0, 0.1, 0.0, 1.0, 0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match=r"tune: targets must not move a Collider, .* leave it out"):
        sim.tune(error=0.1, targets={plate: pose})
