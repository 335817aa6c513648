"""Records of a study: motions, and rows that survive an interruption, one line of JSON for every finished task."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Ledger", "Row", "Trajectory", "write_csv"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """One point of a study. Numbers that do not apply are None; an error of a failure is inf."""

    axis: str  # whose error: "solver", "stiffness", "float", "time step", "mesh", "trajectory", "paper"
    method: str
    status: str = "ok"  # else "diverged", "uncertain", or "refused: " and why
    precision: str = "float64"
    compiled: bool = True  # a solver of this library, throughout C++; else `parts` says what is
    parts: str = ""  # what a method of the literature runs in: "C++" is the local step of this library
    iterations: int = 0
    local_steps: int | None = None  # evaluations of all rotations
    youngs: float = 0.0  # Pa
    time_step: float = 0.0  # s
    vertices: int = 0
    tets: int = 0
    error: float = math.inf  # relative, of positions
    uncertainty: float | None = None  # of what the error is measured against, relative as the error
    error_energy: float | None = None  # relative
    error_metres: float | None = None  # largest of a vertex
    residual: float | None = None
    milliseconds: float | None = None  # median
    milliseconds_p5: float | None = None
    milliseconds_p95: float | None = None
    setup_milliseconds: float | None = None  # once a scene or step, beside `milliseconds`
    bytes: int | None = None
    bytes_by: str | None = None  # "layout" (computed), "tracemalloc" or "torch.cuda" (measured peak)
    kernels: int | None = None  # launched, on a GPU
    default: bool = False  # what `Simulator(scene)` does
    more: dict[str, float] = dataclasses.field(default_factory=dict)

    @property
    def refusal(self) -> str | None:
        """Why nothing was run, in a few words; None for what ran, however badly."""
        verdict, _, why = self.status.partition(": ")
        return why.split(";")[0] if verdict == "refused" else None

    @property
    def failed(self) -> bool:
        """Whether it diverged: what is uncertain may be as good as it says."""
        return self.status == "diverged"

    def reaches(self, goal: float) -> bool:
        """Whether the error is below a goal for sure."""
        return self.error + (self.uncertainty or 0.0) <= goal

    def may_reach(self, goal: float) -> bool:
        """Whether the error may be below a goal."""
        return self.error - (self.uncertainty or 0.0) <= goal

    def to_json(self) -> dict[str, Any]:
        """Plain values; JSON has no infinity, which becomes null."""
        return {name: _without_infinity(value) for name, value in dataclasses.asdict(self).items()}

    @classmethod
    def from_json(cls, record: dict[str, Any]) -> Row:
        """What `to_json` gave."""
        return cls(**{**record, "error": math.inf if record["error"] is None else record["error"]})


def _without_infinity(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _without_infinity(entry) for name, entry in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


@dataclass(frozen=True)
class Trajectory:
    """A motion, sampled at every time step, the start first."""

    time_step: float  # s
    probes: Array  # [T + 1, n, 3] m
    energies: Array  # [T + 1] mechanical, J
    brought: float  # kinetic energy at the start, J
    milliseconds: float  # a step, mean
    solved: bool = True  # every step of it, where that was asked for
    iterations: float = math.nan  # of a step, mean, where it was not


class Ledger:
    """Finished tasks in a file, for a study with the given settings.

    Args:
        path: of the file; made when missing.
        settings: that all rows depend on. A file of other settings is refused, lest two studies mix.
    """

    def __init__(self, path: Path, settings: dict[str, Any]) -> None:
        self.path, self._tasks = path, dict[str, list[Row]]()
        # as they come back from a file
        settings = json.loads(json.dumps(settings))
        if not path.exists():
            path.write_text(json.dumps({"settings": settings}) + "\n")
            return
        lines = path.read_text().splitlines()
        found = _parsed(lines[0]) if lines else None
        if found is None or found.get("settings") != settings:
            raise ValueError(
                f"{path} holds a study with other settings; take another --out, or delete it to start anew"
            )
        for line in lines[1:]:
            record = _parsed(line)
            if record is not None:  # the last line of a killed study may be cut
                self._tasks[record["task"]] = [Row.from_json(row) for row in record["rows"]]
        complete = [json.dumps({"settings": settings}), *(self._line(task) for task in self._tasks)]
        path.write_text("\n".join(complete) + "\n")

    def _line(self, task: str) -> str:
        return json.dumps({"task": task, "rows": [row.to_json() for row in self._tasks[task]]})

    def rows_of(self, task: str, work: Callable[[], Iterable[Row]]) -> list[Row]:
        """Those of a task: from the file, or from doing the work, which is then kept."""
        if task not in self._tasks:
            self._tasks[task] = list(work())
            with self.path.open("a") as file:
                file.write(self._line(task) + "\n")
        return self._tasks[task]

    def has(self, task: str) -> bool:
        """Whether a task is finished."""
        return task in self._tasks


def _parsed(line: str) -> dict[str, Any] | None:
    try:
        return dict(json.loads(line))
    except (ValueError, TypeError):
        return None


def write_csv(rows: Iterable[Row], path: Path) -> Path:
    """The rows for a spreadsheet; `more` as JSON in a column of its own."""
    names = [field.name for field in dataclasses.fields(Row)]
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        for row in rows:
            record = row.to_json()
            writer.writerow({**record, "more": json.dumps(record["more"]) if record["more"] else ""})
    return path
