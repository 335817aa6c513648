"""Activations of fibres as an input of steps."""

from __future__ import annotations

import pickle

import pytest
import torch
from torch import Tensor

import torchpd as pd

CONTRACTION = 0.4


def muscle(dtype: torch.dtype = torch.float64) -> tuple[pd.Simulator, pd.Fibres, pd.Fibres]:
    solid = pd.Solid(pd.shapes.box((1, 0.2, 0.2), (2, 1, 1)), 1e5)
    upper = pd.Fibres(solid, (1, 0, 0), 1e5, CONTRACTION, tets=range(5))
    lower = pd.Fibres(solid, (1, 0, 0), 1e5, torch.linspace(0.1, 0.3, 12), activation=0.5)
    pin = pd.Pin(solid, solid.mesh.vertices[:, 0] == 0.0)
    return pd.Simulator(pd.Scene(upper, solid, pin, lower), 1 / 30, 200, dtype=dtype), upper, lower


@pytest.mark.parametrize("shape", [(), (1,), (5,), (3,), (1, 1), (3, 1), (1, 5), (3, 5)])
def test_shapes(shape: tuple[int, ...]) -> None:
    """A number for all, for each fibre, for each environment, or for each of both; other fibres stay."""
    sim, upper, lower = muscle()
    activation = torch.rand(shape, dtype=torch.float64)
    state = sim.rest_state(3)
    after = sim(state, targets={upper: activation})
    of_each = activation[:, None] if shape == (3,) else activation
    L = sim.fibre_length.detach().repeat(3, 1)
    L[:, :5] = 1.0 - CONTRACTION * of_each
    expected = torch.func.functional_call(sim, {"fibre_length": L}, (state,))
    assert torch.equal(after.positions, expected.positions)
    assert not torch.equal(after.positions, sim(state).positions)
    tension = sim.tensions(after, {upper: activation})
    assert not torch.equal(tension[upper].tension, sim.tensions(after)[upper].tension)
    assert torch.equal(tension[lower].tension, sim.tensions(after)[lower].tension)


def test_no_length_is_negative() -> None:
    sim, upper, _ = muscle()
    state, much = sim.rest_state(), torch.tensor(9.0, dtype=torch.float64)
    assert torch.equal(sim(state, targets={upper: much}).positions, sim(state, targets={upper: much + 1}).positions)
    assert torch.equal(sim.energy(state, {upper: much}), sim.energy(state, {upper: much + 1}))


@pytest.mark.parametrize("shape", [(4,), (2, 5), (3, 4), (3, 3, 5)])
def test_other_shapes_are_refused(shape: tuple[int, ...]) -> None:
    sim, upper, _ = muscle()
    with pytest.raises(ValueError, match=r"targets of Fibres must be an activation \[\], \[5\], \[3\] or \[3, 5\]"):
        sim(sim.rest_state(3), targets={upper: torch.zeros(shape).double()})


def test_what_is_ambiguous_or_of_another_type_is_refused() -> None:
    sim, upper, _ = muscle()
    with pytest.raises(ValueError, match=r"\[5\] may be .* 5 fibres or of 5 environments; give \[1, 5\] or \[5, 1\]"):
        sim(sim.rest_state(5), targets={upper: torch.zeros(5).double()})
    with pytest.raises(TypeError, match=r"targets of Fibres must be a tensor of torch.float64 .*, got float"):
        sim(sim.rest_state(), targets={upper: 0.5})  # type: ignore[dict-item]
    with pytest.raises(TypeError, match=r"targets of Fibres must be torch.float64 .*, got torch.float32"):
        sim(sim.rest_state(), targets={upper: torch.tensor(0.5)})
    other = pickle.loads(pickle.dumps(sim))
    with pytest.raises(ValueError, match=r"this Fibres is not a Pin, .* of the scene"):
        other(other.rest_state(), targets={upper: torch.tensor(0.5).double()})
    assert other(other.rest_state(), targets={other.scene.fibres[0]: torch.tensor(0.5).double()}) is not None


def test_a_rollout_with_a_function_has_gradients() -> None:
    """Activation as a function of the step, by central differences."""
    sim, upper, lower = muscle()
    state = sim.rest_state(2)

    def reach(a: Tensor) -> Tensor:
        track = sim.rollout(state, 4, targets=lambda step: {upper: a * (step + 1) / 4, lower: a[:, None] * 0.5})
        return track.positions[-1, :, :, 1].sum() + track.positions[-1, 0, :, 0].sum()

    a = torch.tensor([0.3, 0.8], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(reach(a), a)
    for item in range(2):
        step = torch.zeros(2, dtype=torch.float64)
        step[item] = 1e-5
        with torch.no_grad():
            difference = (reach(a + step) - reach(a - step)) / 2e-5
        assert float(gradient[item]) == pytest.approx(float(difference), rel=1e-5)


def test_a_function_of_the_step_gives_the_bits_of_steps() -> None:
    sim, upper, _ = muscle(torch.float32)
    values = torch.rand(5, 2)
    track = sim.rollout(sim.rest_state(2), 5, targets=lambda step: {upper: values[step]})
    state = sim.rest_state(2)
    for number, value in enumerate(values):
        state = sim(state, targets={upper: value})
        assert torch.equal(track.positions[number], state.positions)


def test_a_compiled_step_takes_activations() -> None:
    sim, upper, lower = muscle(torch.float32)
    state = sim.rest_state(2)

    def step(x: Tensor, a: Tensor) -> Tensor:
        after: pd.State = sim(pd.State(x, torch.zeros_like(x)), targets={upper: a, lower: a * 0.5})
        return after.positions

    a = torch.tensor([[0.2], [0.6]])
    compiled = torch.compile(step, backend="aot_eager", fullgraph=True)
    assert torch.equal(compiled(state.positions, a), step(state.positions, a))


def test_a_wider_simulator_knows_contractions_to_its_own_precision() -> None:
    sim, upper, lower = muscle(torch.float32)
    wide, *_ = muscle()
    state, activation = wide.rest_state(), torch.tensor(0.7, dtype=torch.float64)
    assert torch.equal(
        sim.double().material_at({sim.scene.fibres[1]: activation}, 1)[-2][5:],
        wide.material_at({wide.scene.fibres[1]: activation}, 1)[-2][5:],
    )
    assert sim(state, targets={upper: activation, lower: activation}).positions.dtype == torch.float64
