"""Rows of a study survive everything but other settings."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import pytest

from torchpd.study.results_log import ResultsLog, Row, write_csv

ROWS = [
    Row("solver", "a", iterations=3, error=0.5, milliseconds=1.5, more={"turn": 0.25}),
    Row("solver", "b", status="diverged", error=math.inf),
]


def test_finished_tasks_are_not_done_again(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    assert ResultsLog(path, {"youngs": 1.0}).rows_of("one", lambda: ROWS) == ROWS
    again = ResultsLog(path, {"youngs": 1.0})
    assert again.has("one")
    assert not again.has("two")
    assert again.rows_of("one", lambda: pytest.fail("done again")) == ROWS


def test_a_task_that_was_cut_off_is_done_again(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    log = ResultsLog(path, {})
    log.rows_of("one", lambda: ROWS)
    log.rows_of("two", lambda: ROWS)
    path.write_text(path.read_text()[:-20])
    again = ResultsLog(path, {})
    assert (again.has("one"), again.has("two")) == (True, False)
    again.rows_of("two", lambda: ROWS[:1])
    # the torn line is gone
    assert ResultsLog(path, {}).rows_of("two", list) == ROWS[:1]


def test_a_failing_task_leaves_nothing_behind(tmp_path: Path) -> None:
    log = ResultsLog(tmp_path / "rows.jsonl", {})
    with pytest.raises(ZeroDivisionError):
        log.rows_of("one", lambda: [Row("solver", "a", error=1 / 0)])
    assert not ResultsLog(tmp_path / "rows.jsonl", {}).has("one")


@pytest.mark.parametrize("text", ["", "no json\n", '{"settings": {"youngs": 2.0}}\n'])
def test_a_file_of_another_study_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"--out .*other settings"):
        ResultsLog(path, {"youngs": 1.0})
    assert path.read_text() == text


def test_json_and_csv_hold_what_was_measured(tmp_path: Path) -> None:
    records = json.loads(json.dumps([row.to_json() for row in ROWS], allow_nan=False))
    assert [Row.from_json(record) for record in records] == ROWS
    with write_csv(ROWS, tmp_path / "rows.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [line["method"] for line in lines] == ["a", "b"]
    assert [line["error"] for line in lines] == ["0.5", ""]
    assert [line["status"] for line in lines] == ["ok", "diverged"]
    assert json.loads(lines[0]["more"]) == {"turn": 0.25}
