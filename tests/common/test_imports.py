"""What is loaded with the library, and by a scene that is simulated: of a fresh process."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys

import pytest

OURS = [f"torchpd.{name}" for name in ("baselines", "study", "accuracy.error", "accuracy.tuning", "reference")]
PROGRAM = """
import json, sys, torchpd as pd
loaded = [list(sys.modules)]
mesh = pd.shapes.box((1.0, 1.0, 1.0), (1, 1, 1))
sim = pd.Simulator(pd.Scene(pd.Solid(mesh, youngs=1e5, density=1e3)), progress=False)
sim.rollout(sim.rest_state(), 2)
loaded.append(list(sys.modules))
print(json.dumps(loaded))
"""


@pytest.fixture(scope="module")
def loaded() -> list[list[str]]:
    """Modules after the import, and after a rollout without contact."""
    ended = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    found: list[list[str]] = json.loads(ended.stdout)
    return found


def test_examination_is_not_imported_with_the_library(loaded: list[list[str]]) -> None:
    """Neither the methods to compare with nor what draws them: they are asked for by name."""
    assert all(map(importlib.util.find_spec, OURS))
    unwanted = [*OURS, "plotly", "matplotlib", "threadpoolctl", "trimesh"]
    assert [name for name in unwanted if name in loaded[0]] == []


def test_scenes_without_contact_load_nothing_of_it(loaded: list[list[str]]) -> None:
    contact = [name for name in loaded[1] if "torchpd" in name and "contact" in name]
    assert contact == ["torchpd.scene.contact"]
