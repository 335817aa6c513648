"""The results log of a study: rows and motions, kept as one line of JSON per finished task."""

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

__all__ = ["ResultsLog", "Row", "Trajectory", "write_csv"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """One point of a study. Numbers that do not apply are None; the error of a failure is inf."""

    axis: str  # the error studied: "solver", "stiffness", "float", "time step", "mesh", "trajectory", "contact", ...
    method: str
    status: str = "ok"  # or "diverged", "uncertain", or "refused: " and the reason
    precision: str = "float64"
    compiled: bool = True  # a solver of this library, all in C++; otherwise `parts` names the languages
    parts: str = ""  # languages of a published method: "C++" is the local step of this library
    iterations: int = 0
    local_steps: int | None = None  # evaluations of all rotations
    youngs: float = 0.0  # Pa
    time_step: float = 0.0  # s
    vertices: int = 0
    tets: int = 0  # or triangles of cloth
    error: float = math.inf  # relative, of positions
    uncertainty: float | None = None  # of the reference solution, in the unit of the error
    error_energy: float | None = None  # relative
    error_metres: float | None = None  # largest error of a vertex
    residual: float | None = None
    milliseconds: float | None = None  # median
    milliseconds_p5: float | None = None
    milliseconds_p95: float | None = None
    setup_milliseconds: float | None = None  # once per scene or step, not part of `milliseconds`
    bytes: int | None = None
    bytes_by: str | None = None  # "layout" (computed), "tracemalloc" or "torch.cuda" (measured peak)
    kernels: int | None = None  # launched, on a GPU
    default: bool = False  # the default of `Simulator(scene)`
    more: dict[str, float] = dataclasses.field(default_factory=dict)

    @property
    def refusal(self) -> str | None:
        """The reason in a few words why nothing was run; None for rows that ran."""
        verdict, _, why = self.status.partition(": ")
        return why.split(";")[0] if verdict == "refused" else None

    @property
    def failed(self) -> bool:
        """Return whether it diverged; an uncertain row may be correct."""
        return self.status == "diverged"

    def reaches(self, goal: float) -> bool:
        """Return whether the error is certainly below a goal."""
        return self.error + (self.uncertainty or 0.0) <= goal

    def may_reach(self, goal: float) -> bool:
        """Return whether the error may be below a goal."""
        return self.error - (self.uncertainty or 0.0) <= goal

    def to_json(self) -> dict[str, Any]:
        """Plain values for JSON, in which infinity becomes null."""
        return {name: _without_infinity(value) for name, value in dataclasses.asdict(self).items()}

    @classmethod
    def from_json(cls, record: dict[str, Any]) -> Row:
        """Read the result of `to_json`."""
        return cls(**{**record, "error": math.inf if record["error"] is None else record["error"]})


def _without_infinity(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _without_infinity(entry) for name, entry in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


@dataclass(frozen=True)
class Trajectory:
    """A motion, sampled after every time step; the start comes first."""

    time_step: float  # s
    probes: Array  # [T + 1, n, 3] m
    energies: Array  # [T + 1] mechanical, J
    initial_kinetic: float  # kinetic energy at the start, J
    milliseconds: float  # mean per step
    solved: bool = True  # every step was solved, where requested
    iterations: float = math.nan  # mean per step, where not requested


class ResultsLog:
    """Finished tasks in a file, for a study with the given settings.

    Args:
        path: the file; it is created if missing.
        settings: all settings that rows depend on. A file with other settings is refused, so that studies never mix.

    Raises:
        ValueError: the file holds a study with other settings.
    """

    def __init__(self, path: Path, settings: dict[str, Any]) -> None:
        self.path, self._tasks = path, dict[str, list[Row]]()
        # as JSON returns them
        settings = json.loads(json.dumps(settings))
        if not path.exists():
            path.write_text(json.dumps({"settings": settings}) + "\n")
            return
        lines = path.read_text().splitlines()
        found = _parsed(lines[0]) if lines else None
        if found is None or found.get("settings") != settings:
            raise ValueError(
                f"--out must be a new folder or hold this study; {path} has other settings: choose another --out, or "
                "delete it to start again"
            )
        for line in lines[1:]:
            record = _parsed(line)
            if record is not None:  # an interrupted study may leave an incomplete last line
                self._tasks[record["task"]] = [Row.from_json(row) for row in record["rows"]]
        complete = [json.dumps({"settings": settings}), *(self._line(task) for task in self._tasks)]
        path.write_text("\n".join(complete) + "\n")

    def _line(self, task: str) -> str:
        return json.dumps({"task": task, "rows": [row.to_json() for row in self._tasks[task]]})

    def rows_of(self, task: str, work: Callable[[], Iterable[Row]]) -> list[Row]:
        """Rows of a task: read from the file, or measured by `work` and then kept."""
        if task not in self._tasks:
            self._tasks[task] = list(work())
            with self.path.open("a") as file:
                file.write(self._line(task) + "\n")
        return self._tasks[task]

    def has(self, task: str) -> bool:
        """Return whether a task is finished."""
        return task in self._tasks


def _parsed(line: str) -> dict[str, Any] | None:
    try:
        return dict(json.loads(line))
    except (ValueError, TypeError):
        return None


def write_csv(rows: Iterable[Row], path: Path) -> Path:
    """Write the rows as a spreadsheet; `more` is JSON in a column of its own."""
    names = [field.name for field in dataclasses.fields(Row)]
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        for row in rows:
            record = row.to_json()
            writer.writerow({**record, "more": json.dumps(record["more"]) if record["more"] else ""})
    return path
