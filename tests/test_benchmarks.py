"""The benchmark runs from end to end and writes what its readers rely on. How fast it is, no test judges."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]

SCHEMA: dict[str, Any] = {
    "schema": int,
    "command": str,
    "created": str,
    "commit": str,
    "machine": {"cpu": str, "logical_cores": int, "threads": int, "simd": str, "device": str, "platform": str},
    "versions": {"torchpd": str, "torch": str, "python": str, "numpy": str, "compiler": str},
    "goals_hold_at": {"multiply_adds_per_second_per_thread": float, "threads": int},
    "call_microseconds": {
        "sim(state)": float,
        "sim(state, return_info=True)": float,
        "sim.step_(state)": float,
        "one step of a rollout": float,
    },
    "results": list,
}
TIMES = {"median": float, "min": float, "repetitions": int}
ROW: dict[str, Any] = {
    "scene": str,
    "dtype": str,
    "batch": int,
    "iterations": int,
    "vertices": int,
    "tets": int,
    "patches": int,
    "plan_seconds": float,
    "plan_bytes": int,
    "workspace_bytes": int,
    "bytes_per_vertex": float,
    "milliseconds": TIMES,
    "tet_iterations_per_second": float,
    "tet_iterations_per_second_median": float,
    "multiply_adds_per_second": {"before": float, "after": float},
    "multiply_adds_per_tet_iteration": float,
    "goal": {"least": float, "aim": float, "share_of_least": float},
    "vectorised_torch": {
        "iterations": int,
        "largest_difference": float,
        "threads": int,
        "milliseconds": TIMES,
        "tet_iterations_per_second": float,
    },
    "speedup": float,
}


def assert_schema(value: Any, schema: Any, where: str) -> None:
    if isinstance(schema, dict):
        assert value.keys() == schema.keys(), where
        for name, inner in schema.items():
            assert_schema(value[name], inner, f"{where}.{name}")
    else:
        assert isinstance(value, schema), where


def run(*words: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    script = ROOT / "benchmarks" / "run.py"
    return subprocess.run(
        [sys.executable, script, *words], env=environment, capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], str]:
    """The result of a quick run, and what it prints."""
    out = tmp_path_factory.mktemp("benchmarks") / "results" / "quick.json"
    ended = run("--quick", "--threads", "1", "--out", str(out))
    assert ended.returncode == 0, ended.stderr
    return json.loads(out.read_text()), ended.stdout


def test_schema(quick: tuple[dict[str, Any], str]) -> None:
    result, _ = quick
    assert_schema(result, SCHEMA, "result")
    for row in result["results"]:
        without_goal = {**ROW, "goal": type(None)}
        assert_schema(row, ROW if row["goal"] else without_goal, row["scene"])


def test_both_precisions_and_a_batch_are_measured(quick: tuple[dict[str, Any], str]) -> None:
    rows = quick[0]["results"]
    assert {(row["dtype"], row["batch"]) for row in rows} == {
        (dtype, batch) for dtype in ("float32", "float64") for batch in (1, 9)
    }
    for row in rows:
        work = row["tets"] * row["batch"] * row["iterations"]
        assert row["tet_iterations_per_second"] == pytest.approx(1e3 * work / row["milliseconds"]["min"])


def test_plain_torch_takes_the_same_step(quick: tuple[dict[str, Any], str]) -> None:
    # four iterations on positions of at most 1 m: some rounding errors of 1
    rounding = {"float32": 2**-24, "float64": 2**-53}
    for row in quick[0]["results"]:
        assert row["vectorised_torch"]["largest_difference"] <= 16 * rounding[row["dtype"]]


def test_table_shows_every_row(quick: tuple[dict[str, Any], str]) -> None:
    result, text = quick
    lines = text.splitlines()
    assert "M tet-it/s" in lines[0]
    for row, line in zip(result["results"], lines[1:], strict=False):
        assert line.split()[:2] == [row["scene"], row["dtype"]]


def test_unknown_scene_is_refused() -> None:
    ended = run("--only", "nothing")
    assert ended.returncode == 2
    assert "no scene nothing; there are 1k, 10k" in ended.stderr


def test_beam_counts_iterations() -> None:
    command = [sys.executable, "benchmarks/beam.py", "--most", "40"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    soft = next(line for line in result.stdout.splitlines() if "1e+04  guarded" in line)
    # 1e-2 and 1e-3 within 40 iterations, 1e-6 not
    assert soft.split()[-4:] == ["22", "38", ">", "40"]
