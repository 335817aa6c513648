"""The comparison with mechanics: fast cases anew, the page against the results, and the parts that judge them."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from programs import ROOT

import torchpd as tpd

RESULTS = ROOT / "benchmarks" / "results" / "validation.json"


@pytest.fixture(autouse=True)
def _on_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))


def recorded() -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = json.loads(RESULTS.read_text())["rows"]
    return rows


def test_fast_cases_hold_and_give_what_is_recorded(tmp_path: Path, script: Callable[..., str]) -> None:
    """The script ends without an error beyond a bound; its numbers are those of the results, to rounding."""
    from validation import key_of

    out = tmp_path / "validation.json"
    script("benchmarks/validation.py", "--quick", "--out", str(out))
    result = json.loads(out.read_text())
    assert {"command", "created", "commit", "machine", "versions"} <= result.keys()
    known = {key_of(row): row["found"] for row in recorded()}
    assert {row["table"] for row in result["rows"]} == {"Exact cases", "Cantilever", "Torsion", "Cantilever strip"}
    for row in result["rows"]:
        assert {"command", "created", "commit", "machine", "torch"} <= row["run"].keys()
        # Newton's method ends where a step is 1e-11 of the scene; sags are 1e-5 of it and more
        assert row["found"] == pytest.approx(known[key_of(row)], rel=1e-6, abs=1e-10)


def test_results_have_every_case_and_hold() -> None:
    from validation import CASES, key_of

    assert [key_of(row) for row in recorded()] == [case.key for case in CASES]
    for row, case in zip(recorded(), CASES, strict=True):
        assert (row["expected"], row["bound"]) == (pytest.approx(case.expected, rel=1e-9), case.bound)
        assert row["error"] == pytest.approx(case.error(row["found"]), rel=1e-9, abs=1e-15)
        assert case.bound is None or abs(row["error"]) <= case.bound


def test_page_has_the_tables_of_the_results() -> None:
    from validation import TABLES, tables

    page = (ROOT / "docs" / "validation.md").read_text(encoding="utf-8")
    made = tables(recorded())
    assert list(made) == TABLES
    assert [title for title, table in made.items() if table not in page] == []


def test_a_wrong_number_is_an_error(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    import validation
    from mechanics.case import Case

    case = Case("Exact cases", "bar", "force", "E", 2.0, lambda: 2.1, 0.01, quick=True)
    assert case.error(2.1) == pytest.approx(0.05)
    assert replace(case, expected=0.0).error(0.1) == 0.1
    monkeypatch.setattr(validation, "CASES", [case])
    monkeypatch.setattr(sys, "argv", ["validation.py", "--quick"])
    with pytest.raises(SystemExit, match="Exact cases / bar / force"):
        validation.main()
    assert "| bar | force | E | 2 | 2.1 | +5.0 % |" in capsys.readouterr().out


def test_an_equilibrium_that_is_not_found_is_an_error() -> None:
    from mechanics.equilibrium import equilibrium

    mesh = tpd.shapes.box((1.0, 0.2, 0.2), (5, 1, 1))
    body = tpd.Solid(mesh, 1e5)
    with pytest.raises(RuntimeError, match="Newton step must fall to 1e-11"):
        equilibrium(body, tpd.Pin(body, mesh.vertices[:, 0] == 0.0), tpd.Gravity(), most=1)


def test_elastica_of_a_small_load_is_a_beam() -> None:
    from mechanics.cloth import elastica

    x, y = elastica(1e-2)
    assert y == pytest.approx(-1e-2 / 8.0, rel=1e-4)  # the next term is of second order in the load
    assert x == pytest.approx(1.0, abs=1e-5)


def test_quadratic_tetrahedra_sag_by_the_beam_formula() -> None:
    """Without a Poisson's ratio, the clamp takes no part: 1 % of shear aside, Timoshenko's sag."""
    from mechanics import quadratic, solids

    mesh = tpd.shapes.box((1.0, 0.2, 0.2), (10, 2, 2))
    assert quadratic.sag(mesh, solids.YOUNGS, 0.0, 10.0) == pytest.approx(solids.timoshenko(0.0, 10.0), rel=2e-3)


def test_shadow_counts_folds_once() -> None:
    from mechanics.drape import shadow

    square = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.1], [0.0, 0.1]])
    # cells along the border: 4 x 0.1 x 5e-4
    assert shadow(square, np.array([[0, 1, 2], [2, 3, 0]]), 5e-4) == pytest.approx(0.01, abs=1e-4)
    assert shadow(square, np.array([[0, 1, 2], [2, 1, 0]]), 5e-4) == pytest.approx(0.005, abs=1e-4)


def test_a_stiff_disc_does_not_drape() -> None:
    from mechanics.drape import FABRICS, drape_coefficient

    stiff = replace(FABRICS[-1], bending=(1.0, 1.0))
    assert drape_coefficient(stiff, 0.03, seconds=0.1) == pytest.approx(1.0, abs=0.01)
