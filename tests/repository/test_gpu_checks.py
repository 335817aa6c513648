"""tools/gpu_checks.py without a GPU: what it runs, how it judges, and what it keeps."""

from __future__ import annotations

import json
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from programs import ROOT

TOOLS = ROOT / "tools"


@pytest.fixture(name="tool", scope="module")
def fixture_tool() -> dict[str, Any]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(TOOLS))
        return runpy.run_path(str(TOOLS / "gpu_checks.py"))


def test_every_tool_sees_every_kernel_and_an_error_in_it(tool: dict[str, Any]) -> None:
    """Nine ways to run, four tools; racecheck has nothing to see in the patches, synccheck no error to find."""
    found = tool["checks"](tool["KINDS"])
    assert len(tool["RUNS"]) == 9
    assert [sum(check.kind == kind for check in found) for kind in ("clean", "plants", "list")] == [36, 26, 1]
    assert {check.wanted for check in found if check.kind == "plants"} == {86}
    assert {check.wanted for check in found if check.kind != "plants"} == {0}
    assert len({(check.kind, check.name) for check in found}) == len(found)
    assert [check.kind for check in tool["checks"](["list"])] == ["list"]
    some = tool["checks"](tool["KINDS"], ["block", "patches"])
    assert [sum(check.kind == kind for check in some) for kind in ("clean", "plants", "list")] == [8, 5, 1]
    assert {check.name.split(", ")[1] for check in some if check.kind != "list"} == {"block", "patches"}


@pytest.mark.parametrize(("code", "wanted", "ok"), [(0, 0, True), (86, 0, False), (86, 86, True), (0, 86, False)])
def test_an_exit_code_decides(tool: dict[str, Any], code: int, wanted: int, *, ok: bool) -> None:
    """A sanitizer that finds nothing where an error was made is as wrong as one that finds something elsewhere."""
    command = [sys.executable, "-c", f"import sys; print('why'); sys.exit({code})"]
    row = tool["Check"]("plants", "x", command, wanted).run()
    assert row["ok"] is ok
    assert row.get("said") == (None if ok else "why\n")


def test_tests_are_counted_by_how_they_ended(tool: dict[str, Any], tmp_path: Path) -> None:
    file = tmp_path / "test_three.py"
    file.write_text(
        "import pytest\n"
        "def test_a(): pass\n"
        "def test_b(): assert False\n"
        "@pytest.mark.skip(reason='r')\n"
        "def test_c(): pass\n"
    )
    report = tmp_path / "report.xml"
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--junitxml={report}", str(file)]
    subprocess.run(words, cwd=tmp_path, capture_output=True, check=False)
    assert tool["counted"](report.read_text()) == {"passed": 1, "skipped": 1, "failed": ["test_three::test_b"]}


def test_earlier_rows_stay_with_their_commit(tool: dict[str, Any], tmp_path: Path) -> None:
    out = tmp_path / "checks.json"
    rows = [{"kind": "clean", "name": name, "ok": True} for name in ("a", "b")]
    tool["record"](out, rows)
    first = json.loads(out.read_text())
    first["rows"][0]["commit"] = "earlier"
    out.write_text(json.dumps(first))
    tool["record"](out, [{"kind": "clean", "name": "b", "ok": False}])
    found = json.loads(out.read_text())
    assert [(row["name"], row["ok"]) for row in found["rows"]] == [("a", True), ("b", False)]
    assert found["rows"][0]["commit"] == "earlier"
    assert sorted(found) == ["machine", "rows", "schema", "versions"]
