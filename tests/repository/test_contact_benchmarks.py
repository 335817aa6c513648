"""Benchmarks of contact run from end to end; how fast it is, no test judges."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


def test_body_contact_times_every_scene(tmp_path: Path, script: Callable[..., str]) -> None:
    out = tmp_path / "contact.json"
    script("benchmarks/body_contact.py", "--cells", "2", "--steps", "2", "--out", str(out))
    rows = json.loads(out.read_text())["rows"]
    assert [row["scene"] for row in rows] == ["rest", "stack", "sheet", "apart", "octopus"]
    assert [row["triangles"] for row in rows[:4]] == [48 + 72, 96, 48 + 288, 96]
    assert all(row["milliseconds"] > 0.0 < row["milliseconds_without"] for row in rows)


def test_contact_statics_measures_every_case(tmp_path: Path, script: Callable[..., str]) -> None:
    out = tmp_path / "statics.json"
    script("benchmarks/contact_statics.py", "--steps", "2", "--out", str(out))
    rows = json.loads(out.read_text())["rows"]
    assert {name: len(found) for name, found in rows.items()} == {
        "stack": 2, "angle": 4, "stop": 8, "momentum": 5, "corner": 12, "gap": 4,
    }  # fmt: skip
    assert all(abs(row["relative error"]) < 0.02 for row in rows["stop"])
    assert all(row["linear, change"] < 1e-12 and row["largest force [N]"] > 1.0 for row in rows["momentum"])
    # friction turns bodies by the thickness
    solved = [row["angular, balance of steps"] < 1e-12 for row in rows["momentum"]]
    assert solved == [False, True, False, False, False]


@pytest.mark.usefixtures("on_path")
def test_parts_of_a_soak_join_to_the_whole(tmp_path: Path) -> None:
    """A part that was stopped goes on where it was; scenes that two files hold are refused."""
    from contact_soak import join, summary
    from judge import judge_scenes

    judged: list[int] = []

    def judge(number: int) -> dict[str, Any]:
        judged.append(number)
        gap = float("inf") if number == 3 else 0.1 + 0.01 * abs(number - 5)
        fault = "crosses" if number == 9 else None
        counts = {"steps": number, "overflow": number % 2, "frozen": number % 3}
        return {"scene": number, "fault": fault, "gap": gap, "seconds": 0.5, **counts}

    def run(*words: object) -> dict[str, Any]:
        out = str(tmp_path / str(words[-1]))
        judge_scenes([*map(str, words[:-1]), "--out", out], "Parts.", 12, judge, summary, join)
        found: dict[str, Any] = json.loads(Path(out).read_text())
        return found

    whole = run("whole.json")
    assert [row["scene"] for row in whole["rows"]] == list(range(12))
    judged.clear()
    run("--summary", "--scenes", 4, "first.json")
    assert run("--summary", "--seconds", 0.0, "--scenes", 7, "first.json")["parts"][1]["scenes"] == [[4, 5]]
    run("--summary", "--scenes", 8, "first.json")
    run("--summary", "--first", 8, "--scenes", 4, "second.json")
    assert judged == list(range(12))
    judge_scenes(["--first", "10", "--scenes", "5"], "Parts.", 12, judge, summary, most=12)
    assert judged[12:] == [10, 11]
    files = [tmp_path / "first.json", tmp_path / "second.json"]
    joined = run("--join", *files, "joined.json")
    assert joined["summary"] == whole["summary"]
    assert joined["summary"]["faults"] == [{"scene": 9, "fault": "crosses"}]
    assert [part["scenes"] for part in joined["parts"]] == [[[0, 4]], [[4, 5]], [[5, 8]], [[8, 12]]]
    assert str(tmp_path) not in json.dumps(joined)
    with pytest.raises(ValueError, match=r"different scenes, got \[\[0, 8\]\] twice"):
        run("--join", *files, files[0], "again.json")
    with pytest.raises(ValueError, match="one with rows"):
        run("--join", tmp_path / "whole.json", "again.json")


@pytest.mark.usefixtures("on_path")
def test_nothing_crosses_in_the_first_scenes_of_the_soak() -> None:
    """Of those, some have pairs; and a start that crosses would be found. Some thicknesses are refused."""
    soak = importlib.import_module("contact_soak")
    rows = [soak.run_scene(number) for number in range(30)]
    found = soak.summary(rows)
    assert found["faults"] == []
    assert found["scenes"] == 30 - found["left out"] >= 25
    assert found["nearer than the promise"] == found["overflows"] == found["scenes with frozen vertices"] == 0
    assert found["scenes with pairs"] > 10


@pytest.mark.usefixtures("on_path")
@pytest.mark.parametrize("number", [2, 11, 34, 65])
def test_the_promise_holds_in_scenes(number: int) -> None:
    """The first are a cube on another, on a needle, in a gripper, and a bar that is wrung."""
    promise = importlib.import_module("contact_promise")
    row = promise.run_scene(number)
    assert row["fault"] is None
    assert row["overflow"] == row["frozen"] == 0
    assert 0.099 < row["gap"] < 2.0
