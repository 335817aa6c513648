"""What a first script meets: types of calls that a checker infers, settings by name, the device at once."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

import torchpd as pd

ROOT = Path(__file__).resolve().parents[2]
SCENE = pd.Scene(pd.Solid(pd.shapes.box((1.0, 0.2, 0.2), (5, 1, 1)), youngs=1e5), pd.Gravity())
SCRIPT = """\
import torchpd as tpd

mesh = tpd.TetMesh.from_file("bar.vtk", unit="mm")
scene = tpd.Scene(tpd.Solid(mesh, youngs=1e5), tpd.Gravity(), tpd.Ground(friction=0.5))
sim = tpd.Simulator(scene, solver="multilevel", device="cpu")
state = sim.rest_state()
reveal_type(sim(state))
reveal_type(sim(state, return_info=True))
reveal_type(sim.rollout(state, 10).state().positions)
tpd.Solid(mesh, youngs=1e5, nu=0.3)
tpd.Cloth()
"""


def test_a_checker_infers_the_types_of_a_script(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT, encoding="utf-8")
    run = subprocess.run(
        [sys.executable, "-m", "mypy", "--config-file", os.devnull, "--cache-dir", str(tmp_path), "script.py"],
        cwd=tmp_path,
        env={**os.environ, "MYPYPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    said = [line.partition(": ")[2] for line in run.stdout.splitlines() if line.startswith("script.py")]
    shown = [line for line in said if "Revealed" in line]
    assert [re.findall(r"torchpd\.simulation\.state\.(\w+)", line) for line in shown] == [
        ["State"],
        ["State", "Info"],
        [],
    ]
    assert shown[-1].endswith('"torch._tensor.Tensor"')
    errors = [line for line in said if line.startswith("error")]
    assert [word in line for line, word in zip(errors, ('"nu"', '"Cloth"'), strict=True)] == [True, True]


@pytest.mark.parametrize(
    ("name", "solver"),
    [("jacobi", pd.Jacobi()), ("chebyshev", pd.Chebyshev()), ("multilevel", pd.Multilevel())],
)
def test_solvers_have_names(name: Any, solver: Any) -> None:
    sim = pd.Simulator(SCENE, iterations=4, solver=name)
    assert sim.solver == solver
    sim.solver = "auto"
    sim.solver = name
    assert sim.solver == solver
    assert sim.choice is None


def test_device_is_where_it_steps() -> None:
    assert pd.Simulator(SCENE, device="cpu").device == torch.device("cpu")
    sim = pd.Simulator(SCENE, device=torch.device("meta"))
    assert (sim.device.type, sim.stiffness.device.type) == ("meta", "meta")


def test_a_device_that_is_not_there_is_refused_before_the_scene_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchpd.simulation.model.compile_plan", lambda *_, **__: pytest.fail("compiled"))
    with pytest.raises(RuntimeError, match="gpu"):
        pd.Simulator(SCENE, device="gpu")


def test_attributes_that_are_not_there_raise_as_usual() -> None:
    sim = pd.Simulator(SCENE, iterations=1)
    assert not hasattr(sim, "step")
    with pytest.raises(AttributeError, match="Simulator has no attribute 'colour'"):
        sim.colour  # noqa: B018
    assert sim.stiffness is sim._parameters["stiffness"]
