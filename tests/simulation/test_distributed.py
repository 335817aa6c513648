"""Each rank keeps the material of its environments, and learns with the others what they share."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest
import torch
from programs import HELPERS
from two_ranks import Falling, gradients, youngs

import torchpd as pd


@pytest.fixture(scope="module")
def ranks(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """What two processes found."""
    folder = tmp_path_factory.mktemp("ranks")
    program = HELPERS / "two_ranks.py"
    command = [sys.executable, str(program)]
    runs = [subprocess.Popen([*command, str(rank), str(folder)], stderr=subprocess.PIPE, text=True) for rank in (0, 1)]
    errors = [run.communicate(timeout=120)[1] for run in runs]
    assert [run.returncode for run in runs] == [0, 0], errors
    return [torch.load(folder / f"{rank}.pt") for rank in (0, 1)]


@pytest.mark.parametrize("kind", ["part", "alone"])
def test_every_rank_keeps_its_own_material(ranks: list[dict[str, Any]], kind: str) -> None:
    for rank, found in enumerate(ranks):
        assert torch.equal(found[kind]["youngs"], youngs()[rank::2])


def test_what_is_shared_is_learned_from_all_environments(ranks: list[dict[str, Any]]) -> None:
    """As one process does that has them all; steps are converged, so that gradients are as exact as arithmetic."""
    model = Falling(youngs())
    model().mean().backward()
    expected = gradients(model)
    assert set(expected) == {"push", "sim.damping"}
    for found in ranks:
        assert torch.equal(found["part"]["push"], model.push.detach())  # that of rank 0
        assert set(found["part"]["gradients"]) == set(expected)
        for name, gradient in found["part"]["gradients"].items():
            torch.testing.assert_close(gradient, expected[name], rtol=1e-7, atol=0)


def test_gradients_of_environments_stay_with_their_rank(ranks: list[dict[str, Any]]) -> None:
    for rank, found in enumerate(ranks):
        sim = Falling(youngs()[rank::2]).sim
        sim.stiffness.requires_grad_()
        sim(sim.rest_state()).positions.sum().backward()
        assert sim.stiffness.grad is not None
        assert torch.equal(found["alone"]["gradients"]["stiffness"], sim.stiffness.grad)


def test_a_module_with_a_simulator_is_not_wrapped_as_it_is(ranks: list[dict[str, Any]]) -> None:
    for found in ranks:
        assert "sim.stiffness" in found["refused"]
        assert "sim.rest_positions" in found["refused"]
        assert "sim.damping" not in found["refused"]  # shared, and learned
        assert "wrap torchpd.keep_material_per_rank(module)" in found["refused"]
        assert "stiffness" in found["refused alone"]


def test_names_are_kept_beside_those_of_others() -> None:
    model = Falling(youngs())
    model._ddp_params_and_buffers_to_ignore = ["push"]
    assert pd.keep_material_per_rank(model) is model
    kept = set(model._ddp_params_and_buffers_to_ignore)
    assert {"push", "sim.stiffness", "sim.gravity", "sim.rest_positions"} <= kept
    assert "sim.damping" not in kept
