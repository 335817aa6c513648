"""Iterations that nobody named are judged anew when material or time step change, and only then."""

from __future__ import annotations

import copy
import io
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

import torchpd as pd
from torchpd.estimate.convergence import UnsolvedWarning, forecast
from torchpd.estimate.solver_choice import Choice
from torchpd.plan.compiled import CompiledScene
from torchpd.simulation import settings


def beam(youngs: float = 1e4, time_step: float = 1 / 60, **options: Any) -> pd.Simulator:
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (15, 3, 3))
    body = pd.Solid(mesh, youngs=youngs)
    scene = pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity())
    return pd.Simulator(scene, time_step, progress=False, **options)


def said(call: Callable[[], object]) -> list[str]:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        call()
    assert all(warning.category is UnsolvedWarning and warning.filename == __file__ for warning in found)
    return [str(warning.message) for warning in found]


def one_environment(sim: pd.Simulator) -> None:
    sim.set_material(stiffness=sim.stiffness * torch.tensor([1.0, 1e3, 1.0])[:, None])


def checkpoint(sim: pd.Simulator) -> None:
    sim.load_state_dict({**sim.state_dict(), "stiffness": 1e3 * sim.stiffness})


def checkpoint_of_a_part(sim: pd.Simulator) -> None:
    whole = torch.nn.ModuleDict({"sim": sim})
    whole.load_state_dict({f"sim.{k}": 1e3 * v if k == "stiffness" else v for k, v in sim.state_dict().items()})


def long_step(sim: pd.Simulator) -> None:
    sim.time_step = 1.0


CHANGES: dict[str, Callable[[pd.Simulator], object]] = {
    "set_material": lambda sim: sim.set_material(stiffness=1e7),
    "set_material ": one_environment,
    "set_material  ": lambda sim: sim.set_material(masses=1e-3 * sim.masses),
    "Simulator.load_state_dict": checkpoint,
    "Simulator.load_state_dict ": checkpoint_of_a_part,
    "time_step": long_step,
}


@pytest.mark.parametrize("owner", CHANGES)
def test_a_change_that_leaves_the_default_far_too_few_is_said_once(owner: str) -> None:
    sim = beam()
    (message,) = said(lambda: CHANGES[owner](sim))
    expected = forecast(sim.compiled)
    assert expected is not None
    assert expected.error(64) > 0.1
    assert (
        f"{owner.strip()}: 64 iterations now leave a relative error of about {expected.error(64):.1g} per step"
        in message
    )
    assert f'{expected.words(1e-2)} reach 1e-2. Set sim.iterations, or take solver="auto", or ask' in message
    assert said(lambda: sim.set_material(stiffness=1e8)) == []


@pytest.mark.parametrize("owner", CHANGES)
def test_auto_says_that_it_would_choose_anew(owner: str) -> None:
    sim = beam(solver="auto")
    (message,) = said(lambda: CHANGES[owner](sim))
    assert f'{sim.iterations} iterations that "auto" chose before now leave a relative error of about' in message
    assert message.endswith("sim.prepare_solver() chooses again")
    # which makes it right, and worth a warning again
    sim.prepare_solver()
    expected = forecast(sim.compiled)
    assert expected is not None
    assert expected.error(sim.iterations) <= 1e-3
    sim.solver, sim.choice = pd.Chebyshev(), sim.choice
    assert len(said(lambda: sim.set_material(stiffness=1e12))) == 1


def test_auto_is_held_to_ten_times_what_it_aims_for() -> None:
    """Its 7.2 times the forecast leave 1e-3 ** 7.2; stiffness times 100 makes that 1e-3 ** (7.2 / 10): 7e-3."""
    sim = beam(solver="auto")
    assert said(lambda: sim.set_material(stiffness=1e6)) == []
    assert len(said(lambda: sim.set_material(stiffness=1.5e6))) == 1


def test_shorter_steps_overshoot_with_the_relaxation_of_auto() -> None:
    """Where inertia is all, an iteration multiplies the error by 1 - theta. Those of "auto" suffice, 20 do not."""
    sim = beam(solver="auto")
    for iterations in (sim.iterations, 20):
        sim.iterations, sim.named_iterations = iterations, False
        left = (sim.solver.settings()["relaxation"] - 1.0) ** iterations
        messages = said(lambda: setattr(sim, "time_step", 1e-6))
        assert len(messages) == (left > 1e-2)
    assert f"a relative error of about {left:.1g} per step" in messages[0]


@pytest.mark.parametrize("solver", [None, "auto"])
def test_who_names_a_number_has_decided(solver: Any) -> None:
    """As in the constructor; and so has who sets it later."""
    later = beam(solver=solver)
    later.iterations = 64
    for sim in (beam(iterations=64, solver=solver), later):
        for change in CHANGES.values():
            assert said(lambda change=change, sim=sim: change(copy.deepcopy(sim))) == []


@pytest.mark.parametrize("solver", [None, "auto"])
def test_what_suffices_is_not_said(solver: Any) -> None:
    sim = beam(solver=solver)
    for change in (
        lambda: sim.set_material(stiffness=1.5 * sim.stiffness, damping=0.1),
        lambda: sim.set_material(stiffness=5e3),
        lambda: setattr(sim, "time_step", 1 / 100),
        lambda: setattr(sim, "time_step", 1 / 50),
        lambda: sim.load_state_dict(sim.state_dict()),
        lambda: sim.tune(error=1e-2),
    ):
        assert said(change) == []


def test_bodies_of_a_study_are_not_judged() -> None:
    """Of the environments that `tune` picks none is the user's."""
    sim = beam()
    said(lambda: one_environment(sim))
    sim.named_iterations = False
    assert said(lambda: sim.tune(error=0.1)) == []


def test_a_simulator_that_was_said_to_be_unsolved_says_it_of_another_solver() -> None:
    sim = beam()
    assert len(said(lambda: CHANGES["set_material"](sim))) == 1
    sim.solver = pd.Jacobi()
    assert len(said(lambda: sim.set_material(stiffness=1e7))) == 1
    sim.solver = pd.Multilevel()
    assert said(lambda: sim.set_material(stiffness=1e7)) == []


@pytest.mark.parametrize("solver", [None, "auto"])
def test_files_and_copies_keep_who_named_the_iterations(solver: Any, tmp_path: Path) -> None:
    sim = beam(solver=solver)
    sim.save(tmp_path / "soft")
    for again in (pd.Simulator.load(tmp_path / "soft"), copy.deepcopy(sim).double()):
        assert len(said(lambda again=again: again.set_material(stiffness=1e7))) == 1
    said(lambda: sim.set_material(stiffness=1e7))
    sim.save(tmp_path / "stiff")
    (message,) = said(lambda: pd.Simulator.load(tmp_path / "stiff"))
    assert message.startswith("Simulator.load: ")
    sim.iterations = 64
    sim.save(tmp_path / "stiff")
    assert said(lambda: pd.Simulator.load(tmp_path / "stiff")) == []


def test_what_cannot_matter_costs_no_forecast(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loops that move pins, take shorter steps or have been warned."""
    asked: list[str | None] = []

    def counted(scene: CompiledScene, choice: Choice | None, changed: str | None) -> bool:
        asked.append(changed)
        return changed == "set_material"

    monkeypatch.setattr(settings, "warn_of_few_iterations", counted)
    sim = beam()
    assert asked == [None]
    sim.set_material(pin_targets=sim.pin_targets + 0.1, gravity=torch.zeros(3))
    for sim.time_step in (1 / 60, 1 / 120, 1 / 100, 1 / 50, 1 / 60, 1 / 120, 1 / 50):
        pass
    assert asked == [None, "time_step", "time_step"]
    for _ in range(3):
        sim.set_material(stiffness=2e4)
        sim.time_step *= 2.0
    assert asked == [None, "time_step", "time_step", "set_material"]


def test_a_compiled_step_may_set_its_length() -> None:
    sim = beam()

    def longer(positions: torch.Tensor, velocities: torch.Tensor) -> torch.Tensor:
        sim.time_step = 0.5
        return sim(pd.State(positions, velocities)).positions

    state = sim.rest_state()
    compiled = torch.compile(longer, backend="eager", fullgraph=True)
    said(lambda: compiled(*state))  # some versions of torch set it in Python, where it may warn
    assert sim.time_step == 0.5


def test_a_pickle_keeps_it() -> None:
    file = io.BytesIO()
    torch.save(beam(), file)
    file.seek(0)
    sim = torch.load(file, weights_only=False)
    assert len(said(lambda: sim.set_material(stiffness=1e7))) == 1
