"""Files that an earlier version wrote load for good, and step to the positions that it recorded."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from programs import ROOT
from safetensors import safe_open
from safetensors.torch import save_file
from torch.nn.utils.parametrize import register_parametrization

import torchpd as pd

FILES = ROOT / "tests" / "fixtures"
ROUNDING = 1e-6  # m: some units in the last place of a float32 near 0.3 m, times the steps


@pytest.fixture(scope="module")
def steps() -> Any:
    return torch.load(FILES / "steps.pt", weights_only=True)


def scene() -> pd.Scene:
    """That of fixtures/make.py, made anew."""
    box = pd.shapes.box((0.3, 0.1, 0.1), (6, 2, 2))
    body, along = pd.Solid(box, youngs=3e4), box.vertices[:, 0]
    hard = pd.Pin(body, np.flatnonzero(along < along.min() + 1e-6))
    soft = pd.Pin(body, np.flatnonzero(along > along.max() - 1e-6)[:4], stiffness=50.0)
    return pd.Scene(body, hard, soft, pd.Gravity(), pd.Ground(-0.4, friction=0.3), pd.Damping(0.1))


def from_state_dict() -> pd.Simulator:
    sim = pd.Simulator(scene(), 1 / 60, iterations=16)
    sim.load_state_dict(torch.load(FILES / "state_dict.pt", weights_only=True))
    return sim


def from_file() -> pd.Simulator:
    return pd.Simulator.load(FILES / "simulation.safetensors")


@pytest.mark.parametrize("load", [from_state_dict, from_file])
def test_a_simulator_of_an_earlier_version_takes_its_steps(load: Any, steps: Any) -> None:
    sim = load()
    with torch.no_grad():
        after = sim(steps["start"])
        track = sim.rollout(sim.rest_state(), 6, 2)
    for ours, theirs in ((after.positions, steps["after"].positions), (track.positions, steps["track"].positions)):
        torch.testing.assert_close(ours, theirs, rtol=0.0, atol=ROUNDING)
    # its two environments differ in a spring, and nine pins are hard
    assert not torch.equal(after.positions[0], after.positions[1])
    springs = sim.compiled.named["pin_stiffness"]
    assert springs.isinf().sum(1).tolist() == [9, 9]
    # which is said by a mask now
    assert sim.pin_hard.sum(1).tolist() == [9, 9]
    assert not sim.pin_stiffness[:, :9].any()
    assert sim.pin_stiffness.detach()[:, 9:].tolist() == [[50.0, 50.0, 50.0, 50.0], [50.0, 50.0, 50.0, 20.0]]


@pytest.mark.parametrize("how", ["state_dict", "file"])
def test_pins_that_an_earlier_version_let_go_stay_free(how: str, tmp_path: Path) -> None:
    """By 0 N/m beside pins with inf, in one of two environments."""
    source = FILES / ("state_dict.pt" if how == "state_dict" else "simulation.safetensors")
    if how == "state_dict":
        older = torch.load(source, weights_only=True)
        older["pin_stiffness"][1, :9] = 0.0
        sim = pd.Simulator(scene(), 1 / 60, iterations=16)
        sim.load_state_dict(older)
    else:
        with safe_open(source, framework="pt") as file:
            tensors, metadata = {name: file.get_tensor(name) for name in file.keys()}, file.metadata()  # noqa: SIM118
        tensors["material.pin_stiffness"][1, :9] = 0.0
        save_file(tensors, tmp_path / source.name, metadata=metadata)
        sim = pd.Simulator.load(tmp_path / source.name)
    assert sim.pin_hard.sum(1).tolist() == [9, 0]


class Exp(torch.nn.Module):
    """A stiffness by its logarithm."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x.exp()

    def right_inverse(self, x: torch.Tensor) -> torch.Tensor:
        return x.log()


@pytest.mark.parametrize("assign", [False, True])
@pytest.mark.parametrize("parametrized", [False, True])
def test_numbers_of_an_earlier_version_say_by_inf_which_pins_are_hard(assign: bool, parametrized: bool) -> None:
    """As a part of another module, too; strictly, though they know of no mask."""
    parent = torch.nn.Module()
    parent.sim = sim = pd.Simulator(scene(), 1 / 60, iterations=16)
    springs = torch.tensor([torch.inf, *range(1, 13)])
    name = "sim.pin_stiffness"
    if parametrized:
        register_parametrization(sim, "pin_stiffness", Exp())
        name, numbers = "sim.parametrizations.pin_stiffness.original", springs.log()
    else:
        numbers = springs
    older = {key: array for key, array in parent.state_dict().items() if key != "sim.pin_hard"} | {name: numbers}
    parent.load_state_dict(older, assign=assign)
    assert sim.pin_hard.tolist() == [True] + [False] * 12
    torch.testing.assert_close(sim.pin_stiffness.detach(), torch.tensor([0.0, *range(1, 13)]))
    assert all(array.isfinite().all() for array in sim.material()[:4])
    sim.set_material(pin_hard=False)
    assert not sim.material()[4].isinf().any()


def test_what_an_earlier_version_learned_is_learned() -> None:
    assert from_file().stiffness.requires_grad
    assert not from_file().masses.requires_grad


def test_states_and_their_companions_load(steps: Any) -> None:
    start, info, track = pickle.loads((FILES / "steps.pickle").read_bytes())
    for loaded in (start, steps["start"]):
        assert isinstance(loaded, pd.State)
        assert loaded.positions.shape == (2, 63, 3)
    for loaded in (info, steps["info"]):
        assert isinstance(loaded, pd.Info)
        assert loaded.iterations.tolist() == [16, 16]
        assert not loaded.converged.any()
    for loaded in (track, steps["track"]):
        assert isinstance(loaded, pd.Track)
        assert torch.equal(loaded.state(0).positions, start.positions)
        assert loaded.info.residual.shape == (3, 2)
