"""What a study measures has the known orders, and its tables and pictures say what was measured."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import warnings
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from torchpd.accuracy.candidates import CANDIDATES, DEFAULT
from torchpd.accuracy.error import ExactStep
from torchpd.baselines import BASELINES
from torchpd.baselines.dense_direct import DENSE
from torchpd.study import StudyOptions, cost_table, paper_table, run_study, study_table
from torchpd.study import axes as study_axes
from torchpd.study import bench as study_bench
from torchpd.study.axes import (
    baseline_rows,
    candidate_rows,
    dense_rows,
    float_rows,
    mesh_rows,
    paper_rows,
    time_step_rows,
)
from torchpd.study.bench import (
    Bench,
    Setting,
    Timing,
    UncertainWarning,
    count_kernels,
    row_statuses,
    solved_step,
    time_calls,
)
from torchpd.study.curves import STYLES, float32_floor, method_label, pareto_front
from torchpd.study.plots import draw_study
from torchpd.study.results_log import Row
from torchpd.study.scenes import STUDY_SCENES

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Bench(STUDY_SCENES["beam"](), CPU, series=1, seconds=0.0)


def test_the_time_step_has_order_one(bench: Bench) -> None:
    """Implicit Euler: half the step, half the error, as far as the finest run stands for the limit (an eighth left)."""
    rows = time_step_rows(bench, Setting(1e5, 1 / 60, 1), 4)
    ratios = [coarse.error / fine.error for coarse, fine in pairwise(rows)]
    # from h to h/2 with a reference at h_f: (h - h_f) / (h/2 - h_f), 2.08 and 2.33 for the last two pairs
    assert ratios[-2] == pytest.approx(2.0, abs=0.35)
    assert ratios[-1] == pytest.approx(2.14, abs=0.35)
    assert [row.time_step for row in rows] == [1 / 60, 1 / 120, 1 / 240, 1 / 480]


def test_a_finer_mesh_is_nearer(bench: Bench) -> None:
    rows = mesh_rows(bench, Setting(1e5, 1 / 60, 1), (1, 2, 4))
    assert [row.tets for row in rows] == [30, 240]
    assert rows[0].error > 2.0 * rows[1].error
    assert mesh_rows(bench, Setting(1e5, 1 / 60, 1), (1,))[0].status.startswith("refused: a tetrahedral mesh")


def test_float32_differs_by_rounding(bench: Bench) -> None:
    once, often = float_rows(bench, Setting(1e5, 1 / 60, 1), [1, 32])
    # a few operations on positions of a metre, over |u_0 - u*| of the whole body
    assert once.error_metres is not None
    assert 0.0 < once.error_metres < 8 * 2.0**-24
    assert often.error < 1e-4


def test_solvers_and_methods_meet_at_the_converged_step(bench: Bench) -> None:
    setting = Setting(1e5, 1 / 60, 1)
    (ours,) = candidate_rows(bench, "guarded Chebyshev", torch.float64, setting, [300])
    *_, theirs = baseline_rows(bench, "Newton", setting, [30])
    assert max(ours.error, theirs.error) < 1e-9
    assert (ours.compiled, theirs.compiled) == (True, False)
    assert (ours.parts, theirs.parts) == ("", "C++, Hessian in NumPy, SuperLU")
    assert (ours.bytes_by, theirs.bytes_by) == ("layout", "tracemalloc")
    assert ours.milliseconds_p5 <= ours.milliseconds <= ours.milliseconds_p95
    (same,) = [row for row in baseline_rows(bench, "guarded Chebyshev, NumPy", setting, [8]) if row.iterations == 8]
    (compiled,) = candidate_rows(bench, "guarded Chebyshev", torch.float64, setting, [8])
    # the same iterates in two languages
    assert same.error == pytest.approx(compiled.error, rel=1e-9)
    assert (method_label(theirs), method_label(same)) == (
        "Newton (float64: C++, Hessian in NumPy, SuperLU)",
        "guarded Chebyshev, NumPy",
    )


def test_refusals_and_divergence_become_rows() -> None:
    landing = Bench(STUDY_SCENES["octopus"](), CPU, series=1, seconds=0.0)
    (row,) = baseline_rows(landing, "Newton", Setting(3e4, 1 / 60, 8), [4])
    assert row.status.startswith("refused: scene must have no contacts")
    assert math.isinf(row.error)
    (plain,) = candidate_rows(landing, "Jacobi", torch.float32, Setting(3e4, 1 / 60, 8), [4])
    assert plain.status == "ok"


def test_rows_of_the_direct_step_on_the_device(device: torch.device) -> None:
    """They approach the converged step, float64 further than float32; contacts and large meshes are refused."""
    bench, setting = Bench(STUDY_SCENES["beam"](), device, series=1, seconds=0.0), Setting(1e5, 1 / 60, 2)
    for name in DENSE:
        for dtype, floor in ((torch.float32, 1e-4), (torch.float64, 1e-6)):
            rows = dense_rows(bench, name, dtype, setting, [1, 4, 16, 64])
            assert [row.iterations for row in rows] == [1, 4, 16, 64]
            assert [row.status for row in rows] == ["ok"] * 4
            assert all(before.error > after.error for before, after in pairwise(rows[:3]))
            assert rows[-1].error < floor
            assert all(row.milliseconds and row.setup_milliseconds and row.bytes for row in rows)
    landing = Bench(STUDY_SCENES["octopus"](), device, series=1, seconds=0.0)
    (row,) = dense_rows(landing, "direct global step, dense", torch.float32, Setting(3e4, 1 / 60, 8), [4])
    assert row.refusal == "scene must have no contacts for this method"


def test_the_tests_of_the_paper_are_solved(bench: Bench) -> None:
    rows = paper_rows(bench)
    assert [row.more["constraints"] for row in rows] == [1200.0, 1000.0, 200.0]
    assert [row.tets for row in rows] == [1200, 1008, 198]
    assert max(row.error for row in rows) < 1e-3


def test_times_are_percentiles_of_calls() -> None:
    calls: list[int] = []
    timing = time_calls(lambda: calls.append(1), CPU, least=9, seconds=0.0, series=6)
    # one that is not counted, and up to six series where times scatter
    assert (len(calls) - 1) % 9 == 0
    assert 10 <= len(calls) <= 55
    assert timing.p5 <= timing.median <= timing.p95
    assert Timing.of([1.0, 2.0, 3.0]).median == 2000.0
    assert Timing(2.0, 1.0, 4.0).scatter == 4.0


def test_the_front_has_what_nothing_beats() -> None:
    points = [(1.0, 0.5), (2.0, 0.1), (3.0, 0.2), (4.0, 0.01), (0.5, math.inf)]
    rows = [
        Row("solver", "x", error=error, milliseconds=ms, status="ok" if error < 1 else "diverged")
        for ms, error in points
    ]
    assert pareto_front(rows) == [rows[0], rows[1], rows[3]]


def test_every_curve_looks_different() -> None:
    drawn = [name for name, method in BASELINES.items() if method.compiled_twin in (None, DEFAULT)]
    styles = [STYLES[name] for name in (*CANDIDATES, *drawn, *DENSE)]
    assert len(set(styles)) == len(styles)


def test_motions_are_drawn_without_the_default_too(tmp_path: Path) -> None:
    """What the right panel shows is one solver's."""
    more = {"softness": 0.1, "energy": 0.2, "growth": 0.0, "turn": 0.1, "seconds_of_motion": 1.0}
    rows = [
        Row("trajectory", method, iterations=count, error=1.0 / count, youngs=1e5, milliseconds=1.0, more=more)
        for method in ("Multilevel", "Jacobi")
        for count in (4, 8)
    ]
    (path,) = draw_study(rows, tmp_path, scene_name="x")
    assert Image.open(path).size[0] > 1000


def test_table_says_what_is_not_reached() -> None:
    rows = [Row("solver", "x", iterations=4, error=0.05, milliseconds=2.0), Row("solver", "y", error=math.inf)]
    lines = study_table(rows).splitlines()
    assert lines[1].split() == ["x", "float64", "4", "it.,", "2", "ms", *["not", "reached"] * 2]
    assert lines[2].split() == ["y", "float64", *["not", "reached"] * 3]


def test_float32_levels_off_where_float64_goes_on() -> None:
    def rows(single: list[float], double: list[float]) -> list[Row]:
        return [
            Row("solver", DEFAULT, precision=precision, iterations=2**number, error=error)
            for precision, errors in (("float32", single), ("float64", double))
            for number, error in enumerate(errors)
        ]

    assert float32_floor(rows([0.5, 1e-5, 8e-6], [0.5, 1e-6, 1e-9])) == 8e-6
    # too few iterations for either, and one that did not go as far
    assert float32_floor(rows([0.5, 0.4, 0.3], [0.5, 0.4, 0.3])) is None
    assert float32_floor(rows([0.5, 1e-5], [0.5, 1e-5, 1e-9])) is None
    assert float32_floor(rows([0.5, 1e-5], [])) is None


def test_diverged_is_what_ends_so() -> None:
    """Not the first iterate of a method that descends in energy; and an error that nobody knows is neither."""
    assert row_statuses([3.05, 0.4, 1e-3]) == ["ok", "ok", "ok"]
    assert row_statuses([0.9, 3.0, math.inf]) == ["ok", "diverged", "diverged"]
    assert row_statuses([math.nan, 0.1]) == ["diverged", "ok"]
    assert row_statuses([3.0, 0.4, 1e-3, 1e-12], 0.02) == ["ok", "ok", "uncertain", "uncertain"]
    # below what any figure shows
    assert row_statuses([1e-12], 1e-10) == ["ok"]
    # the last iterate has less energy than the converged step: they go to another minimum
    assert row_statuses([0.5, math.inf, 0.7], 0.0, [0.3, None, -1e-3]) == ["uncertain", "diverged", "uncertain"]
    assert row_statuses([0.5, 1e-9], 0.0, [0.3, -1e-15]) == ["ok", "ok"]


def test_a_stiff_beam_is_compared_with_its_converged_step() -> None:
    """3,321 vertices at 1e8 Pa, on which Chebyshev does not converge."""
    bench, setting = Bench(STUDY_SCENES["beam"](), CPU, series=1, seconds=0.0), Setting(1e8, 1 / 30, 8)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UncertainWarning)
        rows = candidate_rows(bench, "Multilevel", torch.float64, setting, [1, 16, 64])
    assert [row.status for row in rows] == ["ok"] * 3
    assert rows[-1].error < 1e-6
    assert study_table(rows).splitlines()[1].count("16 it.") >= 2
    sim = bench.simulator(setting, torch.float64)
    after, solved = solved_step(sim, bench.start(sim))
    assert solved
    exact = bench.hard_step(setting)[1]
    assert exact.errors_of(after.velocities[0].numpy() * sim.time_step).position < 1e-6


def test_uncertain_rows_are_marked_everywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the table, CSV, JSON and report, and by a warning."""
    honest = study_bench.exact_steps

    def doubtful(*given: Any, **more: Any) -> list[ExactStep]:
        return [dataclasses.replace(step, uncertainty=0.05) for step in honest(*given, **more)]

    monkeypatch.setattr(study_bench, "exact_steps", doubtful)
    monkeypatch.setattr(study_axes, "solved_step", lambda sim, state: (sim(state), False))
    options = StudyOptions(resolution=1, youngs=1e5, quick=True, axes=("solver", "time step"), out=tmp_path)
    with pytest.warns(UncertainWarning, match=r"uncertainty of 5\.0e-02"):
        said = run_study(options, progress=False)
    assert "uncertain" in next(line for line in said.splitlines() if line.startswith("Multilevel"))
    rows = [Row.from_json(row) for row in json.loads((tmp_path / "study.json").read_text())["rows"]]
    for row in rows:
        if row.axis == "solver":
            assert row.uncertainty == 0.05
            assert (row.status == "uncertain") == (row.error < 0.5)
        else:
            assert row.status == "uncertain"
    assert "uncertain" in (tmp_path / "study.csv").read_text()
    assert 'class="bad">uncertain' in (tmp_path / "report.html").read_text()


def test_table_tells_refusals_from_what_is_not_reached() -> None:
    """A method that could not be run is not one that ran in vain."""
    row = Row("solver", "z", status="refused: knows no contacts; others do")
    assert row.refusal == "knows no contacts"
    assert Row("solver", "z", status="diverged").refusal is None
    assert study_table([row]).splitlines()[1].split() == ["z", "float64", "refused:", "knows", "no", "contacts"]


def test_the_cost_of_an_error_is_tabled() -> None:
    def row(method: str, k: int, error: float) -> Row:
        return Row(
            "stiffness", method, precision="float32", youngs=1e4, iterations=k, error=error, milliseconds=0.1 * k,
            default=method == DEFAULT and k == 64,
        )  # fmt: skip

    rows = [row("Multilevel", 8, 5e-3)]
    rows += [row(DEFAULT, k, error) for k, error in ((32, 0.02), (64, 1e-3), (128, 1e-5))]
    default, other = (re.split(r"  +", line) for line in cost_table(rows).splitlines()[1:])
    assert default == [
        "10000", DEFAULT, "32 it., 3.2 ms", *["64 it., 6.4 ms"] * 2, "1.0e-03", "not studied",
    ]  # fmt: skip
    assert other == ["10000", "Multilevel", *["8 it., 0.8 ms"] * 2, "not reached"]
    assert cost_table([]) == study_table([]) == paper_table([]) == ""


def test_kernels_are_counted_where_there_are_some(device: torch.device) -> None:
    """A sum and a product are two kernels; the CPU has none to count."""
    vector = torch.ones(8, device=device)
    assert count_kernels(lambda: (vector * 2.0).exp_(), device) == (2 if device.type == "cuda" else None)
