"""The scripts behind the numbers of docs/accuracy.md: what they count and how they judge."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch


@pytest.mark.usefixtures("on_path")
def test_promises_and_refusals_are_counted_apart() -> None:
    from tune import summary

    def row(attained: bool, error: float, promised: float, *, trusted: bool = True) -> dict[str, object]:
        return {
            "attained": attained, "promised": promised, "errors": [error], "errors_with_rounding": [error],
            "studied_errors": [5e-3, 1e-3], "studied_residuals": [1e-2, 1e-3], "residuals": [2.0 * promised],
            "trusted": [trusted], "audits": [error], "held": error <= promised, "tuning_seconds": 1.0,
            "budget": {"kept": True, "steady": True, "share": 0.9},
        }  # fmt: skip

    still = {
        **row(True, 0.0, 1e-2),
        "errors": [],
        "errors_with_rounding": [],
        "trusted": [],
        "audits": [],
        "residuals": [],
    }
    counts = summary(
        [row(True, 5e-3, 1e-2), row(True, 2e-2, 1e-2, trusted=False), row(False, 0.1, 0.2), row(False, 0.3, 0.2), still]
    )
    assert counts["scenes"] == 4
    assert counts["without motion"] == 1
    assert counts["attained"] == {"scenes": 2, "held": 1}
    assert counts["best reachable"] == {"scenes": 2, "held": 1}
    assert counts["held"] == 0.5
    assert counts["with an error beyond rounding"] == {"scenes": 4, "held": 2}
    assert summary([row(True, 0.0, 1e-2)])["with an error beyond rounding"] == {"scenes": 0, "held": 0}
    assert counts["broken steps"] == {
        "steps": 2,
        "doubted by holds(info)": 1,
        "doubted by estimate(info)": 2,
        "doubted by audit": 2,
    }
    assert counts["kept steps"] == {
        "steps": 2,
        "doubted by holds(info)": 0,
        "doubted by estimate(info)": 2,
        "doubted by audit": 0,
    }


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


@pytest.mark.usefixtures("on_path")
def test_scenes_that_were_judged_are_kept(tmp_path: Path, script: Callable[..., str]) -> None:
    from tune import main

    out = tmp_path / "tune.json"
    script("benchmarks/tune.py", "--scenes", "1", "--out", str(out))
    first = json.loads(out.read_text())
    assert first["summary"]["scenes"] == 1
    assert first["command"] == f"python benchmarks/tune.py --scenes 1 --out {out.name}"
    first["rows"][0]["tuning_seconds"] = 123.0
    out.write_text(json.dumps(first))
    main(["--scenes", "1", "--out", str(out)])
    assert json.loads(out.read_text())["rows"][0]["tuning_seconds"] == 123.0


def _time_to_error_row(plain: int | None, levels: int | None, took: str) -> dict[str, Any]:
    def own(count: int | None, milliseconds: float) -> dict[str, Any]:
        times = {"min": milliseconds, "median": milliseconds}
        error = 9e-4 if count else 0.2
        return {"iterations": count, "error": error, "milliseconds": times, "microseconds_an_iteration": milliseconds}

    row: dict[str, Any] = {
        "vertices": 1000, "youngs": 1e6, "most": 8192, "kernel": None,
        "solvers": {"Chebyshev": own(plain, 30.0), "Multilevel": own(levels, 6.0)},
        "auto": {"solver": took, "iterations": 40, "error": 1e-4, "milliseconds": {"min": 8.0, "median": 8.0}},
    }  # fmt: skip
    return row


@pytest.mark.usefixtures("on_path")
def test_time_to_error_keeps_failures_and_wrong_choices() -> None:
    from time_to_error import judged, matrix, table

    cases = [(300, 20, "Multilevel"), (300, 20, "Chebyshev"), (None, 20, "Multilevel"), (300, None, "Chebyshev")]
    rows = [{**(row := _time_to_error_row(*case)), **judged(row)} for case in cases]
    assert [row["times_faster"] for row in rows] == [5.0, 5.0, 5.0, None]
    assert [row["at_least"] for row in rows] == [False, False, True, False]
    assert [row["faster"] for row in rows] == ["Multilevel", "Multilevel", "Multilevel", "Chebyshev"]
    assert [row["auto_took_the_faster"] for row in rows] == [True, False, True, True]
    assert [row["auto_loses"] for row in rows] == [1.0, 5.0, 1.0, 1.0]
    right, wrong, bound, failed = table(rows).splitlines()[2:]
    assert "| 300 it., 30 ms | 20 it., 6 ms | 5 | Multilevel: 40 it., 8 ms, error 0.0001 |" in right
    assert "Chebyshev, the slower by 5:" in wrong
    assert "| not in 8192 it., 30 ms: error 0.2 | 20 it., 6 ms | more than 5.0 |" in bound
    assert "Multilevel failed" in failed
    short = [matrix([row]).splitlines()[-1] for row in rows]
    assert short[0] == "| 1,000 | 30 / 6.0: 5.0 x |"
    assert short[2] == "| 1,000 | > 30 / 6.0: > 5.0 x |"
    # bounds from below are never rounded up
    for number, word, bound in (
        (12.9, "13", "12"),
        (4.97, "5.0", "4.9"),
        (1699.0, "1,700", "1,600"),
        (0.3, "0.3", "0.3"),
    ):
        assert matrix([{**rows[0], "times_faster": number}]).endswith(f": {word} x |")
        assert matrix([{**rows[2], "times_faster": number}]).endswith(f": > {bound} x |")
    assert "`Multilevel` failed" in short[3]


@pytest.mark.usefixtures("on_path")
def test_costs_are_fitted_to_the_times_of_iterations() -> None:
    from time_to_error import costs

    rows = []
    for thousands in (1.0, 3.0, 10.0):
        row = _time_to_error_row(300, 20, "Multilevel")
        row["vertices"] = int(1000 * thousands)
        row["solvers"]["Chebyshev"]["microseconds_an_iteration"] = 2.0 + 40.0 * thousands
        row["solvers"]["Multilevel"]["microseconds_an_iteration"] = 10.0 + 160.0 * thousands
        rows.append(row)
    plain, levels = costs(rows).splitlines()
    assert plain.startswith("cpu: Chebyshev: Cost(2, 40) measured")
    assert levels.startswith("cpu: Multilevel: Cost(10, 160) measured")
    assert costs(rows[:1]) == ""


@pytest.mark.usefixtures("on_path")
def test_costs_of_a_batch_come_beside_the_first_environment() -> None:
    from time_to_error import CPU_CHEBYSHEV, cost_in_use, costs_of_batches, multilevel_cost

    row = {**_time_to_error_row(300, 20, "Multilevel"), "kernel": None, "vertices": 500, "batch": 11}
    table = CPU_CHEBYSHEV, multilevel_cost(500, on_gpu=False)
    for own, cost in zip(row["solvers"].values(), table, strict=True):
        own["microseconds_an_iteration"] = cost.iteration(500) + 10 * 0.15
    lines = costs_of_batches([row]).splitlines()
    assert [line.split(" adds ")[1].split(" us, ")[0] for line in lines] == ["0.15", "0.15"]
    assert [line.split(" us, ")[-1] for line in lines] == [f"{cost.other(500):.2g} by the table" for cost in table]
    # of a GPU Chebyshev's are elsewhere
    row["kernel"] = "block"
    plain, levels = costs_of_batches([row]).splitlines()
    assert plain.endswith("us an iteration")
    assert f"{multilevel_cost(500, on_gpu=True).other(500):.2g} by the table" in levels
    assert cost_in_use("Multilevel", {**row, "vertices": 5000}) == multilevel_cost(5000, on_gpu=True)


@pytest.mark.usefixtures("on_path")
def test_time_to_error_on_a_small_beam(monkeypatch: pytest.MonkeyPatch) -> None:
    """The iterations that it finds are the fewest, to a sixteenth; more of them it refuses to try."""
    import time_to_error
    import torch

    monkeypatch.setitem(time_to_error.SIZES, "1k", 2)
    monkeypatch.setitem(time_to_error.MOST, "1k", 64)
    monkeypatch.setattr(time_to_error, "milliseconds", lambda case, timed, seconds: {n: {"min": 1.0} for n in timed})
    row = time_to_error.run_case("1k", 1e6, torch.device("cpu"), 0.0, batch=2)
    assert row["batch"] == 2
    assert row["uncertainty"] < 1e-8
    assert row["solvers"]["Chebyshev"]["iterations"] is None
    assert row["solvers"]["Chebyshev"]["error"] > 1e-3
    count = row["solvers"]["Multilevel"]["iterations"]
    case = time_to_error.Case(2, 1e6, torch.device("cpu"))
    solver = time_to_error.SOLVERS["Multilevel"]
    assert case.error(solver, count) <= 1e-3 < case.error(solver, count - 1 - count // 16)
    assert row["auto"]["solver"] == "Multilevel"
    assert row["auto"]["error"] <= 1e-3


@pytest.mark.usefixtures("on_path")
def test_contacts_finds_the_fewest_iterations(monkeypatch: pytest.MonkeyPatch) -> None:
    import contacts

    monkeypatch.setattr(contacts, "COUNTS", [1, 2, 3, 4, 6, 8, 12, 16, 24])
    row = contacts.compare("cube slides", 1, 1e6, 0.5, "cpu", 0.0)
    assert row["residual"] <= 1e-9
    assert row["vertices"] == 64
    plain, levels = (found["iterations"] for found in row["solvers"].values())
    assert plain[-1] is None
    assert levels == sorted(levels)
    assert levels[-1] <= 16
    assert row["solvers"]["Chebyshev"]["ms"][-1] is None
    assert all(ms > 0.0 for ms in row["solvers"]["Multilevel"]["ms"])
    head, line = contacts.table([row]).splitlines()
    assert "Chebyshev: it. and ms to 0.1, 0.01, 0.001" in head
    assert line.startswith("cube slides")
    assert "> 24" in line


@pytest.mark.usefixtures("on_path")
def test_forecasts_are_judged_by_what_was_needed() -> None:
    from forecast import summary

    def row(needed: int | None, error: float, support: str = "held") -> dict[str, Any]:
        own = {"forecast": [5, 10, 20], "needed": [4, 9, needed]}
        auto = {"error": error, "solver": "Multilevel", "iterations": 12, "fewest": needed and needed // 2}
        return {"support": support, "Chebyshev": own, "Multilevel": own, "auto": auto}

    found = summary([row(20, 1e-4), row(30, 2e-3), row(None, 1e-4, "ground"), {"left_out": "no motion"}])
    assert (found["scenes"], found["left out"]) == (3, 1)
    assert found["Chebyshev, no contacts: needed / forecast to 0.001"]["95 %"] == 1.0
    assert found["Multilevel, contacts: needed / forecast to 0.001"]["50 %"] == np.inf
    ratio = {"sum": 24 / 25, "median": 1.0}
    own = {"largest error": 2e-3, "iterations over the fewest": ratio}
    assert found["auto, no contacts"] == {"steps": 2, "error 0.001 reached": 1, "Multilevel": 2, **own}
    assert found["auto, contacts"] == {"steps": 1, "error 0.001 reached": 1, "Multilevel": 1}


@pytest.mark.usefixtures("on_path")
def test_landings_are_judged_by_what_their_steps_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    import landings

    def row(forecast: int, *steps: tuple[int | None, float], uneven: bool = False) -> dict[str, Any]:
        auto = {
            "solver": "Multilevel" if forecast > 10 else "Chebyshev",
            "iterations": 2 * forecast,
            "fewest": forecast,
        }
        shared = {"energy": -0.1, "residual": 1e-10}
        own = [{"needed": needed, "auto": {**auto, "error": error}, **shared} for needed, error in steps]
        return {"uneven": uneven, "forecast": forecast, "steps": own}

    rows = [row(20, (8, 1e-4), (36, 1e-3)), row(20, (37, 2e-3)), row(5, (9, 1e-9)), {"left_out": "soft"}]
    found = landings.summary([*rows, row(20, (None, 0.5), (5, 1e-9), uneven=True)])
    assert (found["scenes"], found["left out"]) == (4, 1)
    assert found["even"] == {
        "scenes": 3,
        "steps": 4,
        "steps that 2048 iterations leave unsolved": 0,
        "of those": {},
        "of the others: within 1.8 of the forecast": 3,
        "auto": {
            "steps": 4,
            "error 0.001 reached": 3,
            "Multilevel": 3,
            "largest error": 2e-3,
            "iterations over the fewest": {"sum": 2.0, "median": 2.0},
        },
    }
    assert found["uneven"]["steps that 2048 iterations leave unsolved"] == 1
    assert found["uneven"]["of those"] == {"in a minimum of less energy": 1}
    assert landings.place_of({"energy": -0.1, "residual": 1e-8}) == "on their way"
    assert landings.place_of({"energy": 0.1, "residual": 1e-10}) == "in one of more energy"
    assert found["uneven"]["auto"]["error 0.001 reached"] == 1

    # those from which an error stays, 1e-3 or less from 13 iterations on, but not with 16, and in the end or not
    def judged(end: float) -> dict[str, Any]:
        errors = {count: 1.0 if count < 13 or count == 16 else 1e-4 for count in landings.COUNTS} | {2048: end}
        monkeypatch.setattr(
            landings, "errors_of", lambda sim, state, exact: landings.Errors(errors[sim.iterations], 0.2, 0.3, 0.4)
        )
        found: dict[str, Any] = landings.needed(SimpleNamespace(), None, None)
        return found

    assert judged(1e-3) == {"needed": 19, "last": 1e-3}
    assert judged(0.1) == {"needed": None, "last": 0.1, "energy": 0.2, "residual": 0.3}
    # it meets the ground in the first step, or soon
    for number in range(6):
        _, sim, state = landings.random_landing(np.random.default_rng(number))
        gap = float(state.positions[0, :, 1].min() - sim.planes[0, 3])
        assert 0.0 < gap < 1.2 * sim.time_step * -float(state.velocities[0, 0, 1])


@pytest.mark.usefixtures("on_path")
def test_tumbles_count_what_rigid_motions_take_elsewhere() -> None:
    import tumbles

    def row(friction: float, *left: tuple[float, float]) -> dict[str, Any]:
        own = [{"residual of iterations": residual, "moved": moved} for residual, moved in left]
        return {"friction": friction, "steps": 8, "left": own}

    assert tumbles.summary([row(0.0), row(2.0, (1e-3, 0.1), (1e-9, 2e-9), (1e-9, 1e-10))]) == {
        "steps": 16,
        "steps that keep more than 1e-05 of their residual": 3,
        "of those: that further iterations do not solve": 1,
        "of the others: that rigid motions take elsewhere": [{"friction": 2.0, "moved": 2e-9}],
    }
    assert tumbles.run_scene(2)["left"] == []


@pytest.mark.usefixtures("on_path")
@pytest.mark.parametrize("number", [2, 111])
def test_what_iterations_solve_stays(number: int) -> None:
    """With friction of 2 a body may stick as well as slide: a rigid one has a solution elsewhere, too."""
    import tumbles

    _, sim, state = tumbles.random_tumble(np.random.default_rng([tumbles.SEED, number]))
    before = state.positions[0].numpy(), state.velocities[0].numpy()
    problem = tumbles.step_problem(sim.scene.values(), *before, sim.time_step)
    after = sim.time_step * sim(state).velocities[0].detach().numpy()
    assert tumbles.residual_of(problem, after) <= 1e-8
    found = tumbles.judge(problem, after)
    assert found["residual of iterations"] <= 1e-8
    assert found["moved"] <= 1e-9


@pytest.mark.usefixtures("on_path")
@pytest.mark.parametrize("option", ["--blocks", "--mesh", "--cells", "--youngs", "--contrasts"])
def test_multilevel_does_not_run_something_else_for_an_option_without_values(
    option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    from multilevel import main

    with pytest.raises(SystemExit):
        main([option])
    said = capsys.readouterr()
    assert f"argument {option}: expected at least one argument" in said.err
    assert not said.out


@pytest.mark.usefixtures("on_path")
@pytest.mark.parametrize("batch", ["0", "-3", "1.5"])
def test_time_to_error_refuses_a_batch_of_none(batch: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from time_to_error import main

    with pytest.raises(SystemExit):
        main(["--batch", batch, "--sizes", "1k", "--out", str(tmp_path / "times.json")])
    assert f"argument --batch: must be a whole number >= 1, got '{batch}'" in capsys.readouterr().err


@pytest.mark.usefixtures("on_path")
def test_time_to_error_keeps_rows_of_every_batch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One file for two batches; rows of files from before there were batches count as of one environment."""
    import time_to_error

    measured: list[int] = []

    def measure(size: str, youngs: float, *rest: Any) -> dict[str, Any]:
        *_, batch = rest
        measured.append(batch)
        row = {**_time_to_error_row(300, 20, "Multilevel"), "size": size, "youngs": youngs, "batch": batch}
        return {**row, **time_to_error.judged(row)}

    monkeypatch.setattr(time_to_error, "run_case", measure)
    out = tmp_path / "times.json"
    for words, kept in (([], [1]), (["--batch", "4"], [1, 4]), (["--batch", "4"], [1, 4]), ([], [1, 4])):
        time_to_error.main([*words, "--sizes", "1k", "--youngs", "1e6", "--out", str(out)])
        record = json.loads(out.read_text())
        assert [row.get("batch", 1) for row in record["rows"]] == kept
        # the tables are of the batch that was asked for
        printed = capsys.readouterr().out
        assert printed.count("30 ms") == 1
        assert ("4 of 1,000 vertices" in printed) == bool(words)
        record["rows"][0].pop("batch", None)
        out.write_text(json.dumps(record))
    assert measured == [1, 4]


@pytest.mark.usefixtures("on_path")
def test_what_a_gradient_costs() -> None:
    from gradients import line_of, measure_scene

    for solver, iterations in (("Chebyshev", 64), ("Multilevel", 16)):
        row = measure_scene((2, 1, 1), 2, 1e5, solver, torch.device("cpu"), 0.0)
        assert (row["batch"], row["vertices"], row["iterations"]) == (2, 12, iterations)
        assert row["forward"] > 0
        assert row["backward"] > 0
        assert line_of({**row, "forward": 2.0, "backward": 3.0}) == f"| 2 x 12 | 1e+05 Pa | {solver} | 2 | 3 | 1.5 |"
    row = measure_scene((2, 1, 1), 1, 1e5, "Chebyshev", torch.device("cpu"), 0.0, "multilevel")
    assert row["backward"] > 0
    assert "| Chebyshev, multilevel adjoint made in 2 s |" in line_of({**row, "making": 2.0})


def test_accuracy_by_kind_counts_iterations_and_draws(tmp_path: Path, script: Callable[..., str]) -> None:
    """Errors fall with the iterations to the smallest goal, and the picture is written beside the rows."""
    out = tmp_path / "rod.json"
    said = script("benchmarks/accuracy_by_kind.py", "--scenes", "rod", "--seconds", "0", "--out", str(out))
    assert "rod, 1e7 Pa, Chebyshev" in said
    (row,) = json.loads(out.read_text())["rows"]
    points = row["solvers"]["Chebyshev"]["points"]
    assert points[0]["error"] > 0.5 > 1e-3 >= points[-1]["error"]
    assert row["auto"]["solver"] == "Chebyshev"
    assert row["default"]["error"] > 0.1
    script("benchmarks/accuracy_by_kind.py", "--draw", str(out))
    assert out.with_suffix(".png").stat().st_size > 1000


@pytest.mark.usefixtures("on_path")
def test_corrections_of_solved_tumbles_are_counted() -> None:
    import coarse

    def step(moved: float, error: float) -> dict[str, float]:
        return {"moved": moved, "moved between": 0.0, "error alone": 1.0, "error": error}

    counts = coarse.summary([{"solved": [step(2e-8, 1e-4)]}, {"solved": [step(1e-9, 1e-2)]}, {"solved": []}])
    assert counts["solved steps"] == 2
    assert counts["moved"] == {"furthest": 2e-8, "by more than 1e-08 m": 1}
    assert counts["moved between"] == {"furthest": 0.0, "by more than 1e-08 m": 0}
    assert counts["error"]["geometric mean"] == pytest.approx(1e-3)
    assert counts["error"]["worst"] == 1e-2
    found = coarse.run_scene(2)["solved"]
    assert len(found) == 8
    assert all(row["error"] <= row["error alone"] for row in found)
