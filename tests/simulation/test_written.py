"""What optimisers, averages and users write into a simulator holds, or is refused where no step would see it."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch.optim.swa_utils import AveragedModel

import torchpd as pd


def simulator() -> pd.Simulator:
    """Three hard pins and a soft one."""
    bar = pd.Solid(pd.shapes.box((0.3, 0.1, 0.1), (3, 1, 1)), youngs=2e4)
    scene = pd.Scene(bar, pd.Pin(bar, [0, 1, 2]), pd.Pin(bar, [15], 1e3), pd.Gravity())
    return pd.Simulator(scene, 1 / 60, 100, dtype=torch.float64, progress=False)


def ways(sim: Any, state: pd.State) -> list[Callable[[], object]]:
    return [
        lambda: sim(state),
        lambda: sim.step_(state.clone()),
        lambda: sim.rollout(state, 2),
        lambda: sim.rollout(state, 2, forces=lambda _: None),
        lambda: sim.energy(state),
        lambda: sim.step_gradient(state, state),
    ]


def decay(sim: pd.Simulator) -> pd.Simulator:
    torch.nn.Sequential(sim).requires_grad_(True)
    optimiser = torch.optim.SGD(sim.parameters(), lr=1e-3, weight_decay=1e-2)
    sim(sim.rest_state()).positions.sum().backward()
    optimiser.step()
    return sim.requires_grad_(False)


def average(sim: pd.Simulator) -> Any:
    averaged = AveragedModel(sim)
    averaged.update_parameters(sim)
    averaged.update_parameters(sim)
    return averaged.module


@pytest.mark.parametrize("learn", [decay, average])
def test_weight_decay_and_averages_leave_hard_pins_hard(learn: Callable[[pd.Simulator], Any]) -> None:
    sim = simulator()
    state = sim.rest_state()
    learned = learn(sim)
    assert learned.pin_hard.tolist() == [True, True, True, False]
    assert learned.pin_stiffness[:3].tolist() == [0.0, 0.0, 0.0]
    for way in ways(learned, state):
        way()
    after = learned(state).positions
    assert torch.equal(after[0, :3], learned.pin_targets[:3])
    assert float((after[0, 3:] - sim.rest_positions[3:])[:, 1].mean()) < -1e-4


def test_every_copy_follows_the_mask_that_it_shares() -> None:
    """What a mask lets go moves rigidly in one as in the other, whichever steps first."""
    body = pd.Solid(pd.shapes.box((0.3, 0.1, 0.1), (3, 1, 1)), youngs=2e4)
    sim = pd.Simulator(pd.Scene(body, pd.Pin(body, [0, 1, 2, 3]), pd.Gravity()), 1 / 60, 8, progress=False)
    other, state = copy.copy(sim), sim.rest_state()
    sim.pin_hard.fill_(False)
    assert torch.equal(sim(state).positions, other(state).positions)


def test_an_average_is_of_what_was_learned() -> None:
    """Without an avg_fn of one's own. Masks are copied; torch refuses to average them, use_buffers=True."""
    sim = simulator()
    averaged = AveragedModel(sim)
    for youngs in (1e4, 2e4, 6e4):
        sim.set_material(stiffness=youngs)
        averaged.update_parameters(sim)
    state = sim.rest_state()
    sim.set_material(stiffness=3e4)
    torch.testing.assert_close(averaged(state).positions, sim(state).positions, rtol=1e-12, atol=1e-14)
    sim.set_material(pin_hard=False, pin_stiffness=0.0)
    averaged.update_parameters(sim)
    assert not averaged.module.pin_hard.any()
    whole = AveragedModel(sim, use_buffers=True)
    whole.update_parameters(sim)
    with pytest.raises(RuntimeError, match="bool tensors is not supported"):
        whole.update_parameters(sim)


@pytest.mark.parametrize("learned", ["grad", "given"])
def test_a_rest_shape_is_not_learned(learned: str) -> None:
    sim = simulator()
    state = sim.rest_state()
    given = {"rest_positions": sim.rest_positions.clone().requires_grad_()}
    if learned == "grad":
        sim.rest_positions.requires_grad_()
        calls = [way for number, way in enumerate(ways(sim, state)) if number != 1]  # step_ has no gradients
        calls.append(lambda: sim.gradient(state))
    else:
        calls = [lambda: torch.func.functional_call(sim, given, (state,))]
    for call in calls:
        with pytest.raises(ValueError, match=r"rest_positions .*gradient"):
            call()
    with torch.no_grad():
        sim(state)


def test_a_rest_shape_that_was_changed_is_refused() -> None:
    sim = simulator()
    state = sim.rest_state()
    larger = {"rest_positions": 1.2 * sim.rest_positions}
    message = r"rest_positions .*scene"
    with pytest.raises(ValueError, match=message):
        torch.func.functional_call(sim, larger, (state,))
    sim(state)
    sim.rest_positions.mul_(1.2)
    for way in ways(sim, state):
        with pytest.raises(ValueError, match=message):
            way()
    sim.rest_positions.copy_(state.positions[0])
    sim(state)


def test_who_writes_what_is_there_is_not_refused() -> None:
    """As averages, copies, moves and calls with all arrays do."""
    sim = simulator()
    state = sim.rest_state()
    expected = sim(state).positions
    averaged = AveragedModel(sim)
    averaged.update_parameters(sim)
    averaged.update_parameters(sim)
    everything = {name: array.clone() for name, array in (*sim.named_parameters(), *sim.named_buffers())}
    copies: list[Any] = [averaged, copy.copy(sim), copy.deepcopy(sim), pickle.loads(pickle.dumps(sim))]
    for one in copies:
        assert torch.equal(one(state).positions, expected)
    assert torch.equal(torch.func.functional_call(sim, everything, (state,)).positions, expected)
    single = copy.deepcopy(sim).to(torch.float32)
    assert single(single.rest_state()).positions.dtype == torch.float32
    with torch.inference_mode():
        assert torch.equal(sim(state).positions, expected)
    many = torch.stack([array := state.positions, array + 0.01])
    rest = sim.rest_positions.expand(2, -1, -1)
    mapped = torch.vmap(
        lambda x, r: torch.func.functional_call(sim, {"rest_positions": r}, (pd.State(x, state.velocities),))[0]
    )(many, rest)
    assert torch.equal(mapped[0], expected)
