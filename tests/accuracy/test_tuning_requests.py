"""`Simulator.tune` refuses what cannot be studied, and takes the candidates that it is given."""

from __future__ import annotations

import math
import warnings

import pytest
import torch
from tuning_cases import bar, swinging

import torchpd as pd


def test_candidates_may_be_given() -> None:
    sim = bar()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert sim.tune(swinging(sim), error=0.3, candidates=[pd.Jacobi()]).solver == pd.Jacobi()
    with pytest.raises(ValueError, match=r"candidates .*got none"):
        sim.tune(error=0.1, candidates=[])
    with pytest.raises(TypeError, match=r"candidates .*got 'auto'"):
        sim.tune(error=0.1, candidates=["auto"])  # type: ignore[list-item]
    with pytest.raises(ValueError, match=r"velocities .*got \[3, 63, 3\]"):
        sim.tune(pd.State(sim.rest_state(2).positions, sim.rest_state(3).velocities), error=0.1)


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ({}, "got error=None and milliseconds=None"),
        (
            {"error": 0.1, "milliseconds": 1.0},
            r"got error=0\.1 and milliseconds=1\.0",
        ),
        ({"error": 0.0}, r"error .*got 0\.0"),
        ({"error": 1.5}, r"error .*got 1\.5"),
        ({"milliseconds": -1.0}, r"milliseconds .*got -1\.0"),
        ({"error": 0.1, "most": 0}, "most .*got 0"),
        ({"error": 0.1, "most": 1.5}, r"most .*got 1\.5"),
        ({"error": math.nan}, "error .*got nan"),
        ({"error": 0.1, "candidates": []}, "candidates .*got none"),
    ],
)
def test_bad_requests_are_named(request_: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        bar().tune(**request_)  # type: ignore[arg-type]


@pytest.mark.parametrize("candidates", ["auto", pd.Jacobi()])
def test_candidates_are_a_sequence(candidates: object) -> None:
    with pytest.raises(TypeError, match=r"candidates .*got"):
        bar().tune(error=0.1, candidates=candidates)  # type: ignore[arg-type]


def test_numbers_of_a_request_may_be_tensors() -> None:
    assert bar().tune(error=torch.tensor(0.125)).requested_error == 0.125  # type: ignore[arg-type]


def test_states_that_are_not_finite_are_named() -> None:
    sim = bar()
    state = swinging(sim, batch=3)
    state.velocities[1, 4, 2] = math.nan
    with pytest.raises(ValueError, match=r"state\.velocities .*got NaN .*environment 1"):
        sim.tune(state, error=0.1)


@pytest.mark.parametrize("name", ["forces", "gravity", "pin_targets", "stiffness", "pin_stiffness"])
def test_what_is_no_number_is_named(name: str) -> None:
    sim = bar()
    forces = torch.zeros_like(sim.rest_state().positions)
    array = forces if name == "forces" else getattr(sim, name)
    with torch.no_grad():
        sim.pin_hard[-1] = name != "pin_stiffness"  # of a hard pin no number counts
        array.view(-1)[-1] = math.nan
    with pytest.raises(ValueError, match=rf"tune: {name} .*got NaN .*at \["):
        sim.tune(swinging(sim), error=0.1, forces=forces)


def test_a_singular_system_is_named() -> None:
    sim = bar()
    with torch.no_grad():
        sim.masses[20] = 0.0
    with pytest.raises(ValueError, match=r".*vertex 20 has inertia 0 N/m"):
        sim.tune(swinging(sim), error=0.1)


def test_a_scene_without_motion_is_named() -> None:
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (4, 1, 1))
    free = pd.Simulator(pd.Scene(pd.Solid(mesh, youngs=1e5), pd.Gravity()), progress=False)
    with pytest.raises(ValueError, match=r"tune: .*no motion"):
        free.tune(error=0.1)
    assert free.tuning_result is None


@pytest.mark.parametrize(("youngs", "time_step"), [(1e9, 1 / 30), (3e8, 1 / 15)])
def test_steps_of_bodies_that_come_to_rest_are_left_out(youngs: float, time_step: float) -> None:
    """The last studied step of such a bar moves three times what rounding does: none is sure to a hundredth of it."""
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (8, 2, 2))
    body = pd.Solid(mesh, youngs)
    scene = pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity())
    sim = pd.Simulator(scene, time_step, solver=pd.Multilevel(), dtype=torch.float64)
    assert sim.tune(error=1e-2).attained
