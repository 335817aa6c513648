"""The study of scenes in which bodies meet: its rows, its table, and the momentum that no force explains."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from torchpd.simulation.state import HistoryState
from torchpd.study import contact_table
from torchpd.study.bench import Bench
from torchpd.study.contact import CONTACT_SCENES, contact_rows, momentum_error
from torchpd.study.plots import draw_study
from torchpd.study.results_log import Row
from torchpd.study.scenes import study_scene

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    bench = Bench(study_scene("beam"), CPU, series=1, seconds=0.0)
    return contact_rows(bench, "two cubes hit", [8, 64], steps=3)


def test_rows_of_a_scene(rows: list[Row]) -> None:
    few, default = rows
    assert (few.default, default.default) == (False, True)
    assert default.status == "ok"
    assert default.error < 0.5 * few.error < 1.0
    assert default.more["path"] < few.more["path"]
    assert 0.09 < default.more["gap"] <= 1.01
    assert default.more["crosses"] == 0.0
    # the coarse correction of bodies that meet keeps the momentum, however few iterations follow
    assert max(row.more["momentum"] for row in rows) < 1e-5


def test_momentum_that_no_force_explains() -> None:
    """A speed that is added to all vertices shows whole; the plate takes the weight of the stack."""
    scene = CONTACT_SCENES["three cubes in a stack"]
    sim = scene.simulator(torch.float64, 64)
    state = scene.start(sim)
    for _ in range(3):
        state, before = sim(state), state
    assert momentum_error(sim, before, state) < 1e-3
    push = torch.tensor([0.03, 0.0, 0.0], dtype=torch.float64)
    pushed = HistoryState(state.positions, state.velocities + push, state.history)
    masses = sim.masses.reshape(-1, 1)
    pushes = masses * ((pushed.velocities[0] - before.velocities[0]) / sim.time_step - sim.gravity)
    weight = masses.sum() * sim.gravity.norm()  # on the plate
    added = float(masses.sum() * push.norm() / sim.time_step / (pushes.norm(dim=1).sum() + weight))
    assert momentum_error(sim, before, pushed) == pytest.approx(added, rel=0.05)


@pytest.mark.parametrize("name", CONTACT_SCENES)
def test_bodies_meet_in_every_scene(name: str) -> None:
    """In the step that is studied, and without crossings."""
    scene = CONTACT_SCENES[name]
    sim = scene.simulator(torch.float32, 16)
    state = scene.start(sim)
    for step in range(scene.steps_before + 1):
        state, info = sim(state, targets=scene.targets(sim, step), return_info=True)
    sim.check(state)
    assert (state.history.forces[..., 0] > 0.0).any()
    assert float(info.contact_gap[0]) < 3.0


def test_table_and_picture(rows: list[Row], tmp_path: Path) -> None:
    lines = contact_table(rows).splitlines()
    assert lines[1].startswith("two cubes hit")
    assert f"{rows[1].error:.1e}" in lines[1]
    assert lines[2] == "steps with a crossing: 0 of 2"
    crossing = dataclasses.replace(rows[0], more={**rows[0].more, "crosses": 1.0})
    assert contact_table([crossing, rows[1]]).splitlines()[2] == "steps with a crossing: 1 of 2"
    assert contact_table([]) == ""
    written = draw_study(rows, tmp_path, scene_name="beam")
    assert [path.name for path in written] == ["contact.png"]
