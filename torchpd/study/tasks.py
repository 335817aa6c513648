"""The study `python -m torchpd study`: its tasks, and the files it writes.

A study is a list of tasks, each of which measures rows. Finished tasks are kept in `study.jsonl`, so that an
interrupted study resumes. The rows become `study.json`, `study.csv`, pictures and one HTML report.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tqdm.auto import tqdm

from ..accuracy.candidates import CANDIDATES, DEFAULT
from ..baselines.dense_direct import DENSE
from ..baselines.methods import BASELINES
from ..common.packages import OPTIONAL, missing_packages
from ..common.provenance import describe_run
from ..plan.placement import find_device
from .axes import (
    baseline_rows,
    candidate_rows,
    dense_rows,
    float_rows,
    mesh_rows,
    paper_rows,
    stiffness_rows,
    time_step_rows,
)
from .bench import Bench, Setting, clock_of, precision_name
from .contact import CONTACT_SCENES, contact_rows
from .results_log import ResultsLog, Row, write_csv
from .scenes import StudyScene, study_scene
from .trajectory import tolerance_rows, trajectory_rows

__all__ = [
    "AXES",
    "SCHEMA",
    "StudyOptions",
    "contact_table",
    "cost_table",
    "paper_table",
    "run_study",
    "study_rows",
    "study_table",
]

SCHEMA = 1
AXES = ("solver", "stiffness", "float", "time step", "mesh", "trajectory", "contact", "paper")
_PACKAGES = ("matplotlib", "plotly", "threadpoolctl")
_STIFFNESS_FACTORS = (0.01, 0.1, 1.0)
_STIFF, _STIFF_MOST = "Multilevel", 32  # the solver for stiff bodies, and its iteration limit there
_TOLERANCES = [1e-2, 1e-3, 1e-4], 128  # tolerances of its steps elsewhere, and their iteration limit
_CONTACT_MOST = 512  # iteration limit where bodies meet
_LITERATURE_MOST = 256  # iteration limit of published methods

Task = Callable[[], list[Row]]


@dataclass(frozen=True)
class StudyOptions:
    """Options of `python -m torchpd study`."""

    subject: str = "beam"  # or "octopus", or a mesh file
    scene: str | None = None  # of a body: "lands" on the ground (default) or "held"
    youngs: float | None = None  # Pa; default: that of the study scene
    poisson: float = 0.0
    time_step: float | None = None  # s
    resolution: int | None = None  # cells across the beam, or lattice cells along the longest side
    iterations: int = 1024  # upper limit per step
    axes: tuple[str, ...] = AXES
    device: str = "cpu"
    threads: int | None = None  # CPU threads
    out: Path = Path("out/study")
    quick: bool = False  # few points, only to check that everything runs

    def title(self) -> str:
        """Heading of the figures."""
        ratio = [f"Poisson's ratio {self.poisson:g}"] if self.poisson else []
        return ", ".join([Path(self.subject).name, *([self.scene] if self.scene else []), *ratio])

    def command(self) -> str:
        """Command that repeats this study."""
        words = ["python -m torchpd study", self.subject]
        plain = StudyOptions()
        for name in ("scene", "youngs", "poisson", "time_step", "resolution", "iterations", "device", "threads", "out"):
            value = getattr(self, name)
            if value != getattr(plain, name):
                words.append(f"--{name.replace('_', '-')} {value}")
        if self.axes != AXES:
            words.append("--axes " + " ".join(axis.replace(" ", "-") for axis in self.axes))
        return " ".join([*words, *(["--quick"] if self.quick else [])])


def _counts(most: int) -> list[int]:
    """Iteration counts 1, 2, 3, 4, 6, 8, 12 ...: two in each doubling."""
    powers = [2**power for power in range(int(math.log2(most)) + 1)]
    return sorted({*powers, *(3 * power // 2 for power in powers[1:] if 3 * power // 2 <= most)})


def _setting(studied: StudyScene, options: StudyOptions) -> Setting:
    return Setting(
        options.youngs or studied.youngs,
        options.time_step or studied.time_step,
        options.resolution or studied.resolution,
    )


def _solver_tasks(bench: Bench, setting: Setting, counts: list[int]) -> dict[str, Task]:
    tasks: dict[str, Task] = {}
    for name, candidate in CANDIDATES.items():
        if bench.device.type not in candidate.devices:
            continue
        for dtype in (torch.float32, torch.float64):
            key = f"solver: {name}, {precision_name(dtype)}"
            tasks[key] = partial(candidate_rows, bench, name, dtype, setting, counts)
    fewer = [count for count in counts if count <= _LITERATURE_MOST]
    if bench.device.type == "cuda":
        for name in DENSE:
            for dtype in (torch.float32, torch.float64):
                key = f"solver: {name}, {precision_name(dtype)}"
                tasks[key] = partial(dense_rows, bench, name, dtype, setting, fewer)
    else:
        for name, method in BASELINES.items():
            # one twin is enough to show the cost of the language
            if method.compiled_twin not in (None, DEFAULT):
                continue
            tasks[f"solver: {name}"] = partial(baseline_rows, bench, name, setting, fewer)
    return tasks


def _tasks(bench: Bench, options: StudyOptions) -> dict[str, Task]:
    """All measurements of the study, by name."""
    setting = _setting(bench.study_scene, options)
    counts = _counts(min(options.iterations, 8) if options.quick else options.iterations)
    tasks: dict[str, Task] = _solver_tasks(bench, setting, counts)
    softened = [replace(setting, youngs=factor * setting.youngs) for factor in _STIFFNESS_FACTORS]
    for softer in softened:
        for name, dtype in (("Jacobi", torch.float64), (DEFAULT, torch.float64), (DEFAULT, torch.float32)):
            key = f"stiffness: {name}, {precision_name(dtype)}, {softer.youngs:g} Pa"
            tasks[key] = partial(stiffness_rows, bench, name, dtype, softer, counts)
        few = [count for count in counts if count <= _STIFF_MOST]
        key = f"stiffness: {_STIFF}, float32, {softer.youngs:g} Pa"
        tasks[key] = partial(stiffness_rows, bench, _STIFF, torch.float32, softer, few)
    resolutions = bench.study_scene.resolutions[:3] if options.quick else bench.study_scene.resolutions
    tasks["float: default"] = partial(float_rows, bench, setting, counts)
    if options.quick:
        tasks["time step: default"] = partial(time_step_rows, bench, setting, 2, finer=1)
    else:
        tasks["time step: default"] = partial(time_step_rows, bench, setting, 5)
    tasks["mesh: default"] = partial(mesh_rows, bench, setting, resolutions)
    seconds, fewer = 0.2 if options.quick else 1.0, [count for count in counts if count >= 4][::2]
    for softer in softened:
        for name, own in ((DEFAULT, fewer), (_STIFF, [count for count in fewer if count <= _STIFF_MOST])):
            key = f"trajectory: {name}, {softer.youngs:g} Pa"
            tasks[key] = partial(trajectory_rows, bench, softer, own, seconds=seconds, name=name)
        key = f"trajectory: {_STIFF}, tolerance, {softer.youngs:g} Pa"
        tasks[key] = partial(tolerance_rows, bench, softer, *_TOLERANCES, seconds=seconds, name=_STIFF)
    for name in list(CONTACT_SCENES)[:2] if options.quick else CONTACT_SCENES:
        own = [count for count in counts if 4 <= count <= _CONTACT_MOST]
        tasks[f"contact: {name}"] = partial(contact_rows, bench, name, own, **({"steps": 4} if options.quick else {}))
    tasks["paper: table"] = partial(paper_rows, bench)
    return {key: task for key, task in tasks.items() if key.split(":")[0] in options.axes}


def study_rows(options: StudyOptions, *, progress: bool = True) -> list[Row]:
    """Measure the tasks missing from the results log of `options.out`, and return all rows."""
    studied = study_scene(options.subject, options.scene, options.poisson)
    device = find_device(options.device)
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    bench = Bench(studied, device, series=1, seconds=0.0) if options.quick else Bench(studied, device)
    setting = _setting(studied, options)
    bench.scene(setting)  # refuses its material before anything is written
    options.out.mkdir(parents=True, exist_ok=True)
    settings = {
        "schema": SCHEMA, "subject": options.subject, "scene": options.scene, **asdict(setting),
        **({"poisson": options.poisson} if options.poisson else {}),
        "iterations": options.iterations, "device": options.device, "threads": torch.get_num_threads(),
        "quick": options.quick,
    }  # fmt: skip
    log = ResultsLog(options.out / "study.jsonl", settings)
    rows: list[Row] = []
    tasks = _tasks(bench, options)
    with tqdm(total=len(tasks), desc="study", unit="task", disable=not progress, leave=False) as bar:
        for key, task in tasks.items():
            bar.set_postfix_str(key)
            rows += log.rows_of(key, task)
            bar.update(1)
    return rows


def run_study(options: StudyOptions, *, progress: bool = True) -> str:
    """Measure, write everything to `options.out`, and return the table to print."""
    _check(options)
    rows = study_rows(options, progress=progress)
    from .plots import draw_study
    from .report import write_report

    threads = torch.get_num_threads()
    record: dict[str, Any] = {
        "schema": SCHEMA,
        **describe_run(options.command(), torch.device(options.device), threads),
        "clock": "processor time" if clock_of(torch.device(options.device)) is time.process_time else "wall time",
        "subject": options.title(),
        "rows": [row.to_json() for row in rows],
    }
    written = [options.out / "study.json"]
    written[0].write_text(_lines_of(record) + "\n")
    written.append(write_csv(rows, options.out / "study.csv"))
    written += draw_study(rows, options.out, scene_name=record["subject"])
    written.append(write_report(rows, record, options.out / "report.html"))
    tables = [table for table in (study_table(rows), cost_table(rows), contact_table(rows), paper_table(rows)) if table]
    return "\n".join(["\n\n".join(tables), "", "written:", *(f"  {file}" for file in written)])


def _lines_of(record: dict[str, Any]) -> str:
    """JSON text with one row per line."""
    rows = ",\n".join(json.dumps(row) for row in record["rows"])
    return json.dumps({**record, "rows": []}, indent=1).replace('"rows": []', f'"rows": [\n{rows}\n]')


def _check(options: StudyOptions) -> None:
    unknown = set(options.axes) - set(AXES)
    if unknown:
        raise ValueError(
            f"study: --axes must be among {', '.join(AXES)}, got {', '.join(sorted(unknown))}; put SUBJECT before "
            "--axes, which takes all words after it"
        )
    missing = missing_packages(package for package in OPTIONAL if package.module in _PACKAGES)
    if missing:  # before the work, not after it
        names = ", ".join(package.pip_name for package in missing)
        raise ModuleNotFoundError(f"study needs {names}, not installed: pip install torchpd[study]")


_GOALS = (1e-1, 1e-2, 1e-3)


def study_table(rows: list[Row]) -> str:
    """Table of the solvers: iterations and milliseconds to reach three errors."""
    solver = [row for row in rows if row.axis == "solver"]
    width = max([28, *(len(row.method) + 2 for row in solver)])
    lines = [f"{'solver':<{width}}{'precision':<11}" + "".join(f"{f'to {goal:.0e}':>22}" for goal in _GOALS)]
    for name, precision in dict.fromkeys((row.method, row.precision) for row in solver):
        own = [row for row in solver if (row.method, row.precision) == (name, precision)]
        lines.append(f"{name:<{width}}{precision:<11}{_costs(own)}")
    if any(row.parts for row in solver):
        lines.append("published methods, in float64, also run the C++ local step, except those named ..., NumPy")
    if any(row.status == "uncertain" for row in rows):
        lines.append("uncertain: the converged step is not known well enough, or a state of lower energy was found")
    if any(row.refusal for row in solver):
        lines.append("with --scene held a body has no contacts, and every method runs")
    return "\n".join(lines) if solver else ""


def _costs(rows: list[Row]) -> str:
    """Table cells of one solver."""
    if rows[0].refusal:
        return f"  refused: {rows[0].refusal}"
    return "".join(f"{_first_at(rows, goal):>22}" for goal in _GOALS)


def _first_at(rows: list[Row], goal: float) -> str:
    """The fewest measured iterations that reach an error, and their time."""
    reached = [row for row in rows if row.reaches(goal) and row.milliseconds is not None]
    if not reached:
        return "uncertain" if any(row.may_reach(goal) for row in rows) else "not reached"
    first = min(reached, key=lambda row: row.iterations)
    return f"{first.iterations} it., {first.milliseconds:.2g} ms"


def cost_table(rows: list[Row]) -> str:
    """Table of the cost of an error, for the default and `Multilevel` in float32 at every stiffness.

    Includes the result of 64 iterations. The last column is the largest distance of the body from its converged path,
    over its displacement, when all steps are solved like that.
    """
    own = [row for row in rows if row.axis == "stiffness" and row.precision == "float32"]
    lines = [
        f"{'Young [Pa]':<12}{'':<20}"
        + "".join(f"{f'to {goal:.0e}':>22}" for goal in _GOALS)
        + f"{'default: error':>18}{'its path':>14}"
    ]
    for youngs, method in sorted({(row.youngs, row.method) for row in own}, key=lambda at: (at[0], at[1] != DEFAULT)):
        at = [row for row in own if (row.youngs, row.method) == (youngs, method)]
        line = f"{youngs:<12g}{method:<20}" + "".join(f"{_first_at(at, goal):>22}" for goal in _GOALS)
        if method == DEFAULT:
            default = [f"{row.error:.1e}" for row in at if row.default] or ["not studied"]
            paths = [row for row in rows if row.axis == "trajectory" and row.youngs == youngs and row.default]
            path = f"{paths[0].error:.1e}" if paths else "not studied"
            line += f"{default[0]:>18}{path:>14}"
        lines.append(line)
    return "\n".join(lines) if own else ""


def contact_table(rows: list[Row]) -> str:
    """Table of the scenes in which bodies meet: the cost of an error of a step, and what the default leaves.

    gap: least distance over the thickness. momentum: share that no force explains. path: largest distance from the
    converged motion over the largest displacement.
    """
    own = [row for row in rows if row.axis == "contact"]
    lines = [
        f"{'bodies that meet':<26}"
        + "".join(f"{f'to {goal:.0e}':>22}" for goal in _GOALS)
        + f"{'default: error':>18}{'gap':>8}{'momentum':>11}{'its path':>11}"
    ]
    for name in dict.fromkeys(row.method for row in own):
        at = [row for row in own if row.method == name]
        ends = [
            f"{row.error:>18.1e}{row.more['gap']:>8.2f}{row.more['momentum']:>11.1e}{row.more['path']:>11.1e}"
            for row in at
            if row.default
        ]
        lines.append(f"{name:<26}{_costs(at)}{(ends or [''])[0]}")
    crossed = sum(int(row.more["crosses"]) for row in own)
    return "\n".join([*lines, f"steps with a crossing: {crossed} of {len(own)}"]) if own else ""


def paper_table(rows: list[Row]) -> str:
    """Table of the source paper's tests beside steps of as many tetrahedra, 64 iterations each."""
    tests = [row for row in rows if row.axis == "paper" and row.milliseconds is not None]
    lines = [f"{'constraints':<13}{'tetrahedra':>12}{'paper, GTX 470':>18}{'here':>12}{'error':>12}"]
    lines += [
        f"{row.more['constraints']:<13.0f}{row.tets:>12}{row.more['paper_milliseconds']:>15.0f} ms"
        f"{row.milliseconds:>9.2g} ms{row.error:>12.1e}"
        for row in tests
    ]
    return "\n".join(lines) if tests else ""
