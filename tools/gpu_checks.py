"""Run and record all checks that need a GPU: the test suite, sanitizers, and planted errors that they must find.

python tools/gpu_checks.py --out benchmarks/results/gpu-checks-h100.json
python tools/gpu_checks.py --only clean plants --jobs 16 --out ...                   # keeps the other rows of --out
python tools/gpu_checks.py --only clean --kernels block far --out ...                # only kernels that changed

suite     the tests that use a GPU, counted by pytest
list      every kernel of benchmarks/results/cuda-registers.csv runs in tools/sanitize.py
clean     compute-sanitizer: memcheck, racecheck, initcheck and synccheck, each on all kernels, find nothing
plants    each tool finds the error that tools/sanitize.py --plant makes, in one of the kernels of each plan;
          synccheck has none

racecheck examines shared memory only: the tests that compare the bits of runs cover messages between blocks through
device memory. Exits with 1 if any check fails.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import torch
from sanitize import RUNS

from torchpd.common.provenance import describe_run

ROOT = Path(__file__).resolve().parent.parent
KINDS = ("suite", "list", "clean", "plants")
TOOLS = ("memcheck", "racecheck", "initcheck", "synccheck")
FOUND = 86  # exit code of a sanitizer that has found an error
SEPARATE = {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}  # one allocation per tensor
Row = dict[str, Any]


class Check(NamedTuple):
    """A command and its expected exit code."""

    kind: str
    name: str
    command: list[str]
    wanted: int = 0

    def run(self) -> Row:
        begin = time.perf_counter()
        done = subprocess.run(
            self.command, cwd=ROOT, env={**os.environ, **SEPARATE}, capture_output=True, text=True, check=False
        )
        row = {"kind": self.kind, "name": self.name, "command": shlex.join(["python", *self.command[1:]])}
        if "compute-sanitizer" in self.command[0]:
            row["command"] = shlex.join(self.command).replace(sys.executable, "python")
        row |= {"exit": done.returncode, "wanted": self.wanted, "ok": done.returncode == self.wanted}
        if not row["ok"]:
            row["said"] = (done.stdout + done.stderr)[-2000:]
        return {**row, "seconds": round(time.perf_counter() - begin, 1)}


def checks(kinds: Sequence[str], kernels: Sequence[str] = RUNS) -> list[Check]:
    """The checks of tools/sanitize.py, longest first."""
    program = [sys.executable, "tools/sanitize.py"]

    def guarded(tool: str, *words: str) -> list[str]:
        return ["compute-sanitizer", "--tool", tool, "--error-exitcode", str(FOUND), *program, *words]

    found = [
        Check("clean", f"{tool}, {kernel}", guarded(tool, "--kernel", kernel))
        for kernel in RUNS[::-1]
        for tool in TOOLS
        if kernel in kernels
    ]
    found.append(Check("list", "all kernels run", [*program, "--list"]))
    found += [
        Check("plants", f"{tool}, {kernel}", guarded(tool, "--plant", tool, "--kernel", kernel), FOUND)
        for tool in TOOLS[:-1]
        for kernel in RUNS
        if kernel in kernels and (tool, kernel) != ("racecheck", "patches")  # those have no shared memory
    ]
    return [check for check in found if check.kind in kinds]


def run_suite(words: list[str]) -> Row:
    """Run the tests with "cuda", "gpu" or "sanitize" in their names; counts come from pytest's report."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        command = [sys.executable, "-m", "pytest", "-q", "-k", "cuda or gpu or sanitize", *words]
        begin = time.perf_counter()
        done = subprocess.run([*command, f"--junitxml={report}", "tests"], cwd=ROOT, check=False)
        counts = counted(report.read_text(encoding="utf-8")) if report.exists() else {}
    return {
        "kind": "suite", "name": "tests", "command": shlex.join(["python", *command[1:], "tests"]),
        "exit": done.returncode, "wanted": 0, "ok": done.returncode == 0 and bool(counts), **counts,
        "seconds": round(time.perf_counter() - begin, 1),
    }  # fmt: skip


def counted(report: str) -> dict[str, Any]:
    """Number of tests by outcome, and the names of the failed ones."""
    cases = list(ET.fromstring(report).iter("testcase"))
    failed = [case for case in cases if case.find("failure") is not None or case.find("error") is not None]
    skipped = [case for case in cases if case.find("skipped") is not None]
    names = [f"{case.get('classname')}::{case.get('name')}" for case in failed]
    return {"passed": len(cases) - len(failed) - len(skipped), "skipped": len(skipped), "failed": names}


def record(out: Path | None, rows: list[Row]) -> None:
    """Write the rows, and the earlier rows of the file that this run does not repeat."""
    if out is None:
        return
    run = describe_run("", torch.device("cuda" if torch.cuda.is_available() else "cpu"), torch.get_num_threads())
    own = {(row["kind"], row["name"]) for row in rows}
    known = json.loads(out.read_text(encoding="utf-8"))["rows"] if out.exists() else []
    kept = [row for row in known if (row["kind"], row["name"]) not in own]
    rows = [*kept, *({**row, "commit": run["commit"], "created": run["created"]} for row in rows)]
    # each row has its own command, commit and time
    head = {name: run[name] for name in ("machine", "versions")}
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps({"schema": 1, **head, "rows": rows}, indent=1) + "\n", encoding="utf-8")


def main(words: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--kernels", nargs="+", choices=RUNS, default=RUNS, help="of sanitizers")
    parser.add_argument("--jobs", type=int, default=8, help="sanitizers in parallel (%(default)s)")
    parser.add_argument("--pytest", type=shlex.split, default=[], help="more arguments for pytest, such as '-n 8'")
    parser.add_argument("--out", type=Path, help="output file (JSON)")
    options = parser.parse_args(words)
    if not torch.cuda.is_available():
        parser.error("torch finds no CUDA device")
    rows = [run_suite(options.pytest)] if "suite" in options.only else []
    record(options.out, rows)
    with ThreadPoolExecutor(options.jobs) as pool:
        for row in pool.map(Check.run, checks(options.only, options.kernels)):
            rows.append(row)
            print(
                f"{row['kind']}: {row['name']}: {'ok' if row['ok'] else 'NOT AS WANTED'}, {row['seconds']} s",
                flush=True,
            )
            record(options.out, rows)
    return 0 if all(row["ok"] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
