"""Material that torch.nn.utils.parametrize makes of something else, and parameters that an optimiser loses."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest
import torch
from small_scene import small_simulator
from torch import Tensor
from torch.nn.utils import parametrize

import torchpd as pd

ONE = [pd.Chebyshev()]  # which of several is the fastest may differ from one time to the next


class Exponential(torch.nn.Module):
    def forward(self, logarithm: Tensor) -> Tensor:
        return logarithm.exp()

    def right_inverse(self, value: Tensor) -> Tensor:
        return value.log()


class Overflowing(torch.nn.Module):
    """Softplus, whose inverse is not for large numbers."""

    def forward(self, value: Tensor) -> Tensor:
        return torch.nn.functional.softplus(value.float()).double()

    def right_inverse(self, value: Tensor) -> Tensor:
        return value.float().expm1().log().double()


class Clamped(torch.nn.Module):
    def forward(self, value: Tensor) -> Tensor:
        return value.clamp(min=1.0)

    def right_inverse(self, value: Tensor) -> Tensor:
        return value


class OneWay(torch.nn.Module):
    def forward(self, value: Tensor) -> Tensor:
        return value.abs()


def simulator() -> pd.Simulator:
    mesh = pd.shapes.box((0.3, 0.1, 0.1), (3, 1, 1))
    bar = pd.Solid(mesh, youngs=2e4, density=1000.0)
    scene = pd.Scene(bar, pd.Pin(bar, mesh.vertices[:, 0] == 0.0), pd.Gravity())
    return pd.Simulator(scene, 1 / 60, 200, dtype=torch.float64)


def parametrized(how: torch.nn.Module) -> tuple[pd.Simulator, Tensor]:
    sim = simulator()
    parametrize.register_parametrization(sim, "stiffness", how)
    original: Tensor = sim.parametrizations.stiffness.original  # type: ignore[union-attr, assignment]
    return sim, original


def test_gradients_reach_the_logarithm_through_a_rollout() -> None:
    sim, logarithm = parametrized(Exponential())
    plain = simulator()
    plain.stiffness.requires_grad_()
    tracks = [s.rollout(s.rest_state(2), 3).positions for s in (sim, plain)]
    assert torch.allclose(*tracks, rtol=1e-12, atol=1e-14)
    (wanted,) = torch.autograd.grad(tracks[1].square().sum(), plain.stiffness)
    logarithm.requires_grad_()
    loss = sim.rollout(sim.rest_state(2), 3).positions.square().sum()
    (found,) = torch.autograd.grad(loss, logarithm)
    torch.testing.assert_close(
        found, wanted * plain.stiffness.detach(), rtol=1e-6, atol=1e-9 * float(found.abs().max())
    )


class Motion(torch.nn.Module):
    """What docs/limits.md advises."""

    def __init__(self, sim: pd.Simulator) -> None:
        super().__init__()
        self.sim = sim

    def forward(self, state: pd.State) -> tuple[Tensor, Tensor, Tensor]:
        track = self.sim.rollout(state, 3)
        return track.positions, self.sim.energy(track.state()), self.sim.gradient(track.state())


def test_functional_call_reaches_rollouts_in_a_module() -> None:
    sim, (made, _) = simulator(), parametrized(Exponential())
    logarithm = sim.stiffness.detach().log().requires_grad_()
    state = sim.rest_state(2)
    given = {"sim.stiffness": 2.0 * logarithm.exp()}
    found = torch.func.functional_call(Motion(sim), given, (state,))
    made.set_material(stiffness=2.0 * sim.stiffness)
    original = made.parametrizations.stiffness.original.requires_grad_()  # type: ignore[union-attr, operator]
    for mine, theirs in zip(found, Motion(made)(state), strict=True):
        assert torch.allclose(mine, theirs, rtol=1e-12, atol=1e-12)
        weights = torch.arange(mine.numel(), dtype=torch.float64).view_as(mine)
        slopes = [
            torch.autograd.grad((weights * result).sum(), leaf, retain_graph=True)[0]
            for result, leaf in ((mine, logarithm), (theirs, original))
        ]
        assert float(slopes[1].abs().max()) > 0.0
        torch.testing.assert_close(*slopes, rtol=1e-6, atol=1e-9 * float(slopes[1].abs().max()))


def test_originals_of_another_shape_are_refused_before_anything_is_loaded() -> None:
    sim = small_simulator()
    parametrize.register_parametrization(sim, "stiffness", Exponential())
    before = [array.clone() for array in sim.material()]
    for wrong in (torch.tensor(5.0), 5.0, sim.stiffness.detach().repeat(2, 1)):
        whole = {**sim.state_dict(), "masses": 2.0 * sim.masses, "parametrizations.stiffness.original": wrong}
        with pytest.raises(ValueError, match=r"load_state_dict: parametrizations\.stiffness\.original .*tensor \[48\]"):
            sim.load_state_dict(whole)
        assert all(torch.equal(one, other) for one, other in zip(before, sim.material(), strict=True))


def test_set_material_goes_through_the_right_inverse(tmp_path: Path) -> None:
    sim, logarithm = parametrized(Exponential())
    sim.set_material(stiffness=5e4, masses=2.0 * sim.masses)
    assert sim.parametrizations.stiffness.original is logarithm  # type: ignore[union-attr]
    torch.testing.assert_close(sim.stiffness, torch.full_like(sim.stiffness, 5e4))
    sim.save(tmp_path / "sim.safetensors")
    torch.testing.assert_close(pd.Simulator.load(tmp_path / "sim.safetensors").stiffness, sim.stiffness.detach())


@pytest.mark.parametrize(
    ("how", "batch", "said"),
    [
        (Exponential(), 2, r"stiffness .*got \[2, 18\]"),
        (OneWay(), 0, "parametrization OneWay without a right_inverse"),
    ],
)
def test_what_a_parametrization_cannot_be_is_refused(how: torch.nn.Module, batch: int, said: str) -> None:
    """And the rest stays as it was, too."""
    sim, _ = parametrized(how)
    before = [array.clone() for array in sim.material()]
    value = torch.full((batch, *sim.stiffness.shape) if batch else sim.stiffness.shape, 7e4, dtype=torch.float64)
    with pytest.raises(ValueError, match=said):
        sim.set_material(masses=2.0 * sim.masses, stiffness=value)
    assert all(torch.equal(now, then) for now, then in zip(sim.material(), before, strict=True))


def test_a_learned_parameter_is_not_replaced_in_silence() -> None:
    sim, other = simulator(), simulator()
    sim.stiffness.requires_grad_()
    with pytest.warns(UserWarning, match=r"new parameter .*stiffness.*batch"):
        sim.set_material(stiffness=sim.stiffness.detach().repeat(2, 1))
    assert sim.stiffness.requires_grad
    other.masses.requires_grad_()
    state = sim.state_dict()
    state["masses"] = state["masses"].repeat(2, 1)
    with pytest.warns(UserWarning, match="a new parameter for masses"):
        other.load_state_dict(state)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sim.set_material(stiffness=3.0 * sim.stiffness.detach())  # the same batch
        sim.set_material(masses=sim.masses.repeat(2, 1))  # nobody learns it


def test_a_first_iterate_that_asks_for_a_gradient_is_refused() -> None:
    """Before the step, not on the way back through many."""
    sim = simulator()
    state = sim.rest_state()
    start = state.positions.clone().requires_grad_()
    with pytest.raises(ValueError, match=r"start .*gradient, .*detach\(\)"):
        sim(state, start=start)
    with torch.no_grad():
        sim(state, start=start)
    sim(state, start=start.detach())


def test_all_of_them_or_none() -> None:
    """Where the second right_inverse does not give back what it was asked for."""
    sim, _ = parametrized(Exponential())
    with torch.no_grad():
        parametrize.register_parametrization(sim, "masses", Overflowing())
    before = [array.detach().clone() for array in sim.material()]
    with pytest.raises(ValueError, match=r"masses .*parametrization Overflowing"):
        sim.set_material(stiffness=7e4, masses=torch.full_like(sim.masses, 1e3))
    assert all(torch.equal(now, then) for now, then in zip(sim.material(), before, strict=True))


def test_what_was_given_stays_the_callers() -> None:
    sim, original = parametrized(Clamped())
    address, given = original.data_ptr(), torch.full_like(sim.stiffness, 5e4)
    sim.set_material(stiffness=given)
    with torch.no_grad():
        original += 1.0
    assert original.data_ptr() == address  # which a CUDA graph may know
    assert float(given.max()) == 5e4


def test_a_parametrized_simulator_is_tuned_and_audited() -> None:
    sim, _ = parametrized(Exponential())
    state = sim.rest_state()
    result = sim.tune(state, error=1e-2)
    assert sim.iterations == result.iterations
    after = sim(state)
    assert bool(result.verify(sim, state, after).all())


def test_tuning_asks_for_no_new_optimiser() -> None:
    """The study has environments of its own, in copies; what is learned or made stays as it is."""
    sim = simulator()
    sim.set_material(stiffness=sim.stiffness * torch.linspace(0.5, 1.5, 6, dtype=torch.float64)[:, None])
    learned = [sim.stiffness.requires_grad_(), sim.pin_targets.requires_grad_()]
    places = sim.pin_targets.detach().expand(6, -1, 3).contiguous()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = sim.tune(error=1e-2, targets=places, candidates=ONE)
    assert all(now is then for now, then in zip((sim.stiffness, sim.pin_targets), learned, strict=True))
    assert all(array.requires_grad for array in learned)
    made = simulator()
    made.set_material(stiffness=sim.stiffness.detach())
    for name, how in (("stiffness", Exponential()), ("pin_targets", torch.nn.Identity())):
        parametrize.register_parametrization(made, name, how)
    again = made.tune(error=1e-2, targets=places, candidates=ONE)
    assert again.studied_error == pytest.approx(result.studied_error, rel=1e-6)
    assert all(parametrize.is_parametrized(made, name) for name in ("stiffness", "pin_targets"))
    assert torch.allclose(made.stiffness, sim.stiffness, rtol=1e-14)
