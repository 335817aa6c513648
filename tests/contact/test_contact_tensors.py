"""Friction and thickness of `Contact` as tensors of the module: set once, trained, saved, of each environment."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
import torch
from body_scenes import slope
from torch import Tensor, nn
from torch.func import functional_call

import torchpd as pd


def sliding(dtype: torch.dtype = torch.float64) -> tuple[pd.Simulator, Any]:
    """A cube that slides on a rigid plane, three steps after it has begun to."""
    course = slope(0.0, 0.4, speed=2.0)
    sim = pd.Simulator(course.scene, iterations=64, dtype=dtype)
    state: Any = course.start(sim)
    for _ in range(3):
        state = sim(state)
    return sim, state


def way(sim: pd.Simulator, state: Any, steps: int = 3) -> Tensor:
    """Mean way in the direction of the slide [B]."""
    after = state
    for _ in range(steps):
        after = sim(after)
    return (after.positions - state.positions)[..., 0].mean(dim=1)


@pytest.mark.parametrize("table", [False, True])
@pytest.mark.parametrize("kind", ["leaf", "parameter"])
def test_what_is_set_once_follows_its_optimiser(kind: str, table: bool) -> None:
    sim, state = sliding()
    shape = sim.contact_friction.shape if table else ()
    given = torch.full(shape, 0.2, dtype=torch.float64)
    sim.contact_friction = friction = nn.Parameter(given) if kind == "parameter" else given.requires_grad_()
    assert sim.contact_friction is friction
    assert any(one is friction for one in sim.parameters()) == (kind == "parameter")
    found = []
    for _ in range(2):
        (gradient,) = torch.autograd.grad(way(sim, state).sum(), friction)
        found.append(float(gradient.sum()))
        with torch.no_grad():
            friction += 0.3
    assert found[0] == pytest.approx(found[1], rel=0.1)  # -h^2 g k (k + 1) / 2 of both
    other, _ = sliding()
    other.contact_friction = float(friction.detach().max())
    assert torch.equal(way(sim, state), way(other, state))


def test_a_call_may_have_its_own() -> None:
    sim, state = sliding()
    own = torch.tensor(0.1, dtype=torch.float64, requires_grad=True)
    after: Any = functional_call(sim, {"contact_friction": own}, (state,))
    slow: Any = sim(state)
    assert after.positions[..., 0].mean() > slow.positions[..., 0].mean()
    assert torch.autograd.grad(after.positions[..., 0].mean(), own)[0] < 0.0


def test_of_each_environment() -> None:
    """Bits of each alone, and gradients of each alone over four steps: of one number for all pairs, and of tables."""
    sim, state = sliding()
    values = torch.tensor([0.1, 0.3, 0.7], dtype=torch.float64)
    many = pd.HistoryState(
        *(array.expand(3, *array.shape[1:]).clone() for array in state[:2]),
        pd.ContactHistory(*(array.expand(3, *array.shape[1:]).clone() for array in state.history)),
    )
    for size in (1, 2):
        table = torch.ones(1, 1) if size == 1 else torch.tensor([[2.0, 1.0], [1.0, 3.0]])
        friction = (values[:, None, None] * table.double()).requires_grad_()
        sim.contact_friction = friction
        together = way(sim, many, 4)
        assert together[0] > together[1] > together[2]
        (gradient,) = torch.autograd.grad(together.sum(), friction)
        for number in range(3):
            of_all = friction.detach()[number]
            for shape in ([1, size, size], [size, size], *([[]] if size == 1 else [])):
                sim.contact_friction = own = of_all.reshape(shape).clone().requires_grad_()
                alone = way(sim, state, 4)
                assert torch.equal(alone[0], together[number])
                (found,) = torch.autograd.grad(alone.sum(), own)
                assert torch.equal(found.reshape(size, size), gradient[number]), (size, number, shape)
    sim.contact_friction = torch.ones(2, 1, 1, dtype=torch.float64)
    with pytest.raises(ValueError, match=r"must be \[2, 2\] or \[3, 2, 2\].* got .*\[2, 2, 2\].*rest_state\(N\)"):
        sim(many)


def test_a_trained_table_stays_symmetric_and_is_loaded() -> None:
    sim, state = sliding()
    sim.contact_friction = nn.Parameter(torch.full((2, 2), 0.3, dtype=torch.float64))
    optimizer = torch.optim.SGD(sim.parameters(), lr=1.0)
    way(sim, state).sum().backward()
    optimizer.step()
    table = sim.contact_friction.detach()
    assert table[0, 1] == table[1, 0]
    assert table[0, 1] != 0.3
    other, _ = sliding()
    other.load_state_dict(sim.state_dict())
    assert torch.equal(way(other, state), way(sim, state))


@pytest.mark.parametrize("name", ["contact_friction", "contact_thickness"])
def test_a_state_dict_is_loaded_whole_or_not_at_all(name: str) -> None:
    sim, _ = sliding()
    given = {key: value.clone() for key, value in sim.state_dict().items()}
    given["stiffness"] *= 2.0
    given[name].fill_(-1.0)
    before = {key: value.clone() for key, value in sim.state_dict().items()}
    with pytest.raises(ValueError, match=rf"{name} must be .*got -1"):
        sim.load_state_dict(given)
    assert all(torch.equal(value, before[key]) for key, value in sim.state_dict().items())


@pytest.mark.parametrize("kind", ["buffer", "parameter"])
def test_another_shape_is_loaded(kind: str) -> None:
    sim, _ = sliding()
    other, _ = sliding()
    other.contact_friction = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)[:, None, None]
    own = torch.full((2, 2), 0.5, dtype=torch.float64)
    sim.contact_friction = nn.Parameter(own) if kind == "parameter" else own.requires_grad_()
    with pytest.warns(UserWarning, match="a new tensor for contact_friction"):
        sim.load_state_dict(other.state_dict())
    assert sim.contact_friction.requires_grad
    assert torch.equal(sim.contact_friction.detach(), other.contact_friction)
    assert len(sim.rest_state().positions) == 3


def test_files_keep_parameters(tmp_path: Path) -> None:
    sim, _ = sliding()
    sim.contact_friction = nn.Parameter(torch.tensor(0.1, dtype=torch.float64))
    sim.save(tmp_path / "sim")
    loaded = pd.Simulator.load(tmp_path / "sim")
    assert "contact_friction" in dict(loaded.named_parameters())
    assert loaded.contact_friction.requires_grad


def test_a_number_overwrites_what_nobody_trains() -> None:
    sim, _ = sliding()
    place = sim.contact_friction.data_ptr()
    sim.contact_friction = 0.25
    assert sim.contact_friction.data_ptr() == place
    assert bool((sim.contact_friction == 0.25).all())
    mine = torch.tensor(0.1, dtype=torch.float64, requires_grad=True)
    sim.contact_friction = mine
    sim.contact_friction = 0.5
    assert float(mine) == 0.1
    sim.contact_thickness = nn.Parameter(torch.tensor(1e-3, dtype=torch.float64))
    sim.contact_thickness = 2e-3
    assert isinstance(sim.contact_thickness, nn.Parameter)
    assert sim.body_contact is not None
    assert float(sim.contact_thickness) == sim.body_contact.plan.thickness == 2e-3


def test_a_parametrized_thickness_stays_on_the_host() -> None:
    class Exp(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return x.exp()

        def right_inverse(self, x: Tensor) -> Tensor:
            return x.log()

    sim, _ = sliding(torch.float32)
    nn.utils.parametrize.register_parametrization(sim, "contact_thickness", Exp())
    assert float(sim.contact_thickness) == pytest.approx(1e-3, rel=1e-6)
    sim = sim.double()
    assert "contact_thickness" not in sim.state_dict()
    assert sim.contact_thickness.dtype == torch.float64
    sim.load_state_dict(sim.state_dict())
    assert way(sim, sim.rest_state()).isfinite().all()


@pytest.mark.parametrize("shape", [(2,), (1, 2), (2, 2, 1)])
def test_a_call_with_another_shape_is_refused(shape: tuple[int, ...]) -> None:
    sim, state = sliding()
    with pytest.raises(ValueError, match=rf"contact_friction must be \[\], \[2, 2\], .* got \[{shape[0]}"):
        functional_call(sim, {"contact_friction": torch.ones(shape, dtype=torch.float64)}, (state,))


@pytest.mark.parametrize("how", ["file", "state_dict", "copy"])
def test_they_are_kept(how: str, tmp_path: Path) -> None:
    sim, state = sliding()
    sim.contact_friction, sim.contact_thickness = torch.tensor(0.1, dtype=torch.float64), 1.1e-3
    if how == "file":
        sim.save(tmp_path / "sim")
        other = pd.Simulator.load(tmp_path / "sim")
    elif how == "state_dict":
        other, _ = sliding()
        other.load_state_dict(sim.state_dict())
    else:
        sim.contact_friction = torch.tensor(0.1, dtype=torch.float64, requires_grad=True)
        other = copy.deepcopy(sim)
    assert float(other.contact_thickness) == 1.1e-3
    assert other.body_contact is not None
    assert other.body_contact.plan.thickness == 1.1e-3
    assert torch.equal(way(other, state), way(sim, state))


def test_another_precision_has_their_values() -> None:
    sim, _ = sliding(torch.float32)
    sim.contact_friction, sim.contact_thickness = 0.25, 1.5e-3
    sim = sim.double()
    assert sim.contact_friction.dtype == sim.contact_thickness.dtype == torch.float64
    assert float(sim.contact_friction[0, 1]) == 0.25
    assert float(sim.contact_thickness) == pytest.approx(1.5e-3, rel=1e-6)


def test_no_optimiser_makes_the_thickness_negative() -> None:
    sim, state = sliding()
    sim.contact_thickness = thickness = torch.tensor(1e-3, dtype=torch.float64, requires_grad=True)
    with torch.no_grad():
        thickness -= 1.0
    with pytest.raises(ValueError, match=r"contact_thickness must be positive .*got -0.999"):
        sim(state)


def test_trained_tensors_are_not_converted() -> None:
    sim, _ = sliding()
    with pytest.raises(
        TypeError, match=r"contact_friction must be torch.float64 on cpu to be trained, got torch.float32"
    ):
        sim.contact_friction = torch.tensor(0.3, requires_grad=True)
    with pytest.raises(TypeError, match="contact_friction must be a number or a tensor, got 'a'"):
        sim.contact_friction = "a"  # type: ignore[assignment]


@pytest.mark.parametrize("what", [float("nan"), -1e5])
def test_material_that_is_none_has_no_residual(what: float) -> None:
    sim = pd.Simulator(slope(0.0, 0.4).scene)
    stiffness = sim.stiffness.expand(2, -1).clone()
    stiffness[1] = what
    _, info = functional_call(sim, {"stiffness": stiffness}, (sim.rest_state(2),), {"return_info": True})
    assert info.residual.isnan().tolist() == [False, True]


def test_a_checked_state_is_finite() -> None:
    sim, state = sliding()
    state.velocities[0, 3] = float("nan")
    with pytest.raises(ValueError, match=r"check: velocities must be finite, .* environment 0"):
        sim.check(state)
