"""The scripts behind the README's numbers on accuracy: what they count and how they judge."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]


def run(script: str, *words: str) -> str:
    command = [sys.executable, f"benchmarks/{script}", *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout


@pytest.fixture
def on_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))


@pytest.mark.usefixtures("on_path")
def test_acceleration_is_a_ratio_of_iterations() -> None:
    from acceleration import table, with_factors

    rows = [
        {"youngs": 1e5, "solver": "Jacobi", "iterations": [100, None, None, None]},
        {"youngs": 1e5, "solver": "guarded Chebyshev", "iterations": [10, 50, None, None]},
    ]
    plain, fast = with_factors(rows, most=1000)
    assert fast["factors"] == [10.0, 20.0, None, None]
    assert fast["at_least"] == [False, True, True, True]
    assert plain["factors"] == [1.0, None, None, None]
    last = table([plain, fast], 1000).splitlines()[-1]
    assert last.split() == [
        "1e+05",
        "guarded",
        "Chebyshev",
        "10",
        "(10.0",
        "x)",
        "50",
        "(>20.0",
        "x)",
        *[">", "1000"] * 2,
    ]


@pytest.mark.usefixtures("on_path")
def test_promises_and_refusals_are_counted_apart() -> None:
    from tune import summary

    def row(attained: bool, error: float, promised: float, *, trusted: bool = True) -> dict[str, object]:
        return {
            "attained": attained, "promised": promised, "errors": [error], "errors_with_rounding": [error],
            "trusted": [trusted], "audits": [error], "held": error <= promised, "tuning_seconds": 1.0,
            "budget": {"kept": True, "steady": True, "share": 0.9},
        }  # fmt: skip

    still = {**row(True, 0.0, 1e-2), "errors": [], "errors_with_rounding": [], "trusted": [], "audits": []}
    counts = summary(
        [row(True, 5e-3, 1e-2), row(True, 2e-2, 1e-2, trusted=False), row(False, 0.1, 0.2), row(False, 0.3, 0.2), still]
    )
    assert counts["scenes"] == 4
    assert counts["without motion"] == 1
    assert counts["attained"] == {"scenes": 2, "held": 1}
    assert counts["best reachable"] == {"scenes": 2, "held": 1}
    assert counts["held"] == 0.5
    assert counts["broken steps"] == {"steps": 2, "doubted by holds(info)": 1, "doubted by audit": 2}
    assert counts["kept steps"] == {"steps": 2, "doubted by holds(info)": 0, "doubted by audit": 0}


@pytest.mark.usefixtures("on_path")
def test_scenes_are_drawn_from_the_whole_range() -> None:
    from tune import random_scene

    drawn = [random_scene(np.random.default_rng([2024, number]))[0] for number in range(8)]
    assert {row["mesh"] for row in drawn} <= {"bar", "slivers", "ball", "octopus"}
    assert {row["support"] for row in drawn} <= {"held", "free", "ground"}
    logs = np.log10([row["youngs"] for row in drawn])
    assert logs.min() >= 3.0
    assert logs.max() <= 8.0
    # eight draws from five decades reach both ends
    assert logs.min() < 5.0 < 6.0 < logs.max()
    assert all(1e-3 <= row["time_step"] <= 1 / 30 for row in drawn)


def test_scenes_that_were_judged_are_kept(tmp_path: Path) -> None:
    out = tmp_path / "tune.json"
    run("tune.py", "--scenes", "1", "--out", str(out))
    first = json.loads(out.read_text())
    assert first["summary"]["scenes"] == 1
    assert first["command"] == f"python benchmarks/tune.py --scenes 1 --out {out}"
    first["rows"][0]["tuning_seconds"] = 123.0
    out.write_text(json.dumps(first))
    run("tune.py", "--scenes", "1", "--out", str(out))
    assert json.loads(out.read_text())["rows"][0]["tuning_seconds"] == 123.0
