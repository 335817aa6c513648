"""The study runs from end to end, goes on where it was, and its report opens in a browser."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from torchpd.__main__ import main
from torchpd.geometry.shapes import box
from torchpd.study import AXES, StudyOptions, run_study, study_rows
from torchpd.study import tasks as study
from torchpd.study.axes import baseline_rows, candidate_rows
from torchpd.study.bench import Bench, Setting
from torchpd.study.results_log import Row
from torchpd.study.scenes import study_scene

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A quick study of a coarse beam, and what it says."""
    out = tmp_path_factory.mktemp("study")
    return out, run_study(StudyOptions(resolution=1, quick=True, out=out), progress=False)


def test_files_and_their_schema(quick: tuple[Path, str]) -> None:
    out, said = quick
    record = json.loads((out / "study.json").read_text())
    assert record.keys() == {
        "schema",
        "command",
        "created",
        "commit",
        "machine",
        "versions",
        "clock",
        "subject",
        "rows",
    }
    # folders of this machine are left out
    assert record["command"] == f"python -m torchpd study beam --resolution 1 --out {out.name} --quick"
    rows = [Row.from_json(row) for row in record["rows"]]
    assert {row.axis for row in rows} == set(AXES)
    assert [row.iterations for row in rows if row.axis == "stiffness" and row.youngs == 1e4][:3] == [1, 2, 3]
    assert record["rows"][0]["error"] == rows[0].error
    for name in ("solver", "stiffness", "cost", "axes", "trajectory", "contact"):
        picture = np.asarray(Image.open(out / f"{name}.png").convert("RGB"))
        # mostly paper, but curves over its whole width: no collapsed panel
        inked = (picture.min(axis=2) < 200).any(axis=0)
        assert inked.mean() > 0.6, name
        assert f"{out / name}.png" in said


def test_a_killed_study_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = StudyOptions(resolution=1, quick=True, axes=("stiffness", "float"), out=tmp_path)

    def killed(*_: object) -> list[Row]:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(study, "float_rows", killed)
        with pytest.raises(KeyboardInterrupt):
            study_rows(options, progress=False)
    monkeypatch.setattr(study, "stiffness_rows", lambda *_: pytest.fail("measured again"))
    rows = study_rows(options, progress=False)
    assert {row.axis for row in rows} == {"stiffness", "float"}
    with pytest.raises(ValueError, match="other settings"):
        study_rows(StudyOptions(resolution=2, quick=True, out=tmp_path), progress=False)


def test_report_opens_in_a_browser(quick: tuple[Path, str]) -> None:
    """Its title, a drawn figure for every section, and a silent console."""
    browser = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        pytest.skip(f"no browser is installed ({', '.join(BROWSERS)}): apt-get install chromium")
    out, _ = quick
    command = [
        browser, "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--enable-logging=stderr",
        f"--user-data-dir={out / 'browser'}", "--virtual-time-budget=10000", "--dump-dom",
        (out / "report.html").as_uri(),
    ]  # fmt: skip
    ended = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    assert "<title>What accuracy costs: beam</title>" in ended.stdout
    # plotly turns a div into a plot, with a line for every trace
    assert len(re.findall(r'id="figure-\d+" class="[^"]*js-plotly-plot', ended.stdout)) == 8
    assert len(re.findall(r'class="trace scatter', ended.stdout)) > 30
    assert [line for line in ended.stderr.splitlines() if "CONSOLE" in line] == []
    text = (out / "report.html").read_text(encoding="utf-8")
    # nothing is fetched: no script or style from elsewhere
    assert not re.search(r'<(script|link)[^>]+(src|href)="http', text)


def test_report_has_the_slopes_of_the_pictures(quick: tuple[Path, str]) -> None:
    text = (quick[0] / "report.html").read_text(encoding="utf-8")
    assert text.count('"name":"order one in h"') == text.count('"name":"order two in the edge"') == 1


def test_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["study", "beam", "--resolution", "1", "--quick", "--axes", "paper", "time-step", "--out", str(tmp_path)]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "27 ms" in said
    assert "default: error" not in said
    assert {row["axis"] for row in json.loads((tmp_path / "study.json").read_text())["rows"]} == {"paper", "time step"}
    assert main(["study", "beam", "--axes", "colour", "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert all(word in said for word in ("--axes", "solver, stiffness", "colour"))
    assert main(["study", "--out", str(tmp_path), "--axes", "float", "spot.obj"]) == 2
    said = capsys.readouterr().err
    assert all(word in said for word in ("--axes", "spot.obj", "SUBJECT before"))
    assert main(["study", "nothing.obj", "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert all(word in said for word in ("SUBJECT", "beam, cloth, octopus", "nothing.obj"))


@pytest.fixture
def bar(tmp_path: Path) -> str:
    """The file of a tetrahedral mesh that stands upright."""
    import meshio

    mesh = box((0.5, 2.0, 0.5), (1, 4, 1))
    meshio.write_points_cells(tmp_path / "bar.mesh", mesh.vertices, {"tetra": mesh.tets})
    return str(tmp_path / "bar.mesh")


_NO_CONTACTS = (
    "Gauss-Seidel",
    "PCG global step",
    "direct global step",
    "direct global step + Chebyshev",
    "Newton",
    "L-BFGS",
    "L-BFGS with A^-1",
)


def test_a_body_that_lands_is_refused_by_methods_without_contacts(bar: str, tmp_path: Path) -> None:
    """The table and the report say so, and how they can be had."""
    said = run_study(StudyOptions(bar, quick=True, axes=("solver",), out=tmp_path), progress=False)
    report = (tmp_path / "report.html").read_text(encoding="utf-8")
    for name in _NO_CONTACTS:
        (line,) = [line for line in said.splitlines() if line.startswith(f"{name}  ")]
        assert line.split("float64")[1].strip() == "refused: scene must have no contacts for this method"
        assert f"{name} (refused: scene must have no contacts for this method)" in report
    assert "--scene held" in said
    # on active sets
    assert re.search(r"^Newton-PCG with M +float64 +\d+ it\.", said, re.MULTILINE)


def test_a_body_that_is_held_is_for_every_method(bar: str, tmp_path: Path) -> None:
    options = StudyOptions(bar, scene="held", quick=True, axes=("solver",), out=tmp_path)
    said = run_study(options, progress=False)
    rows = [Row.from_json(row) for row in json.loads((tmp_path / "study.json").read_text())["rows"]]
    assert not [row for row in rows if row.refusal]
    assert "refused" not in said
    # nearer to the converged step than the first iterate, whose error is 1, and Newton, which is quadratic, there
    for name in _NO_CONTACTS:
        assert min(row.error for row in rows if row.method == name) < (1e-6 if name == "Newton" else 1.0)
    assert options.command() == f"python -m torchpd study {bar} --scene held --out {tmp_path} --axes solver --quick"
    assert json.loads((tmp_path / "study.json").read_text())["subject"] == "bar.mesh, held"


def test_held_are_the_vertices_of_the_lowest_tenth(bar: str) -> None:
    studied = study_scene(bar, "held")
    sim = Bench(studied, CPU).simulator(Setting(1e6, 1 / 60, 14), torch.float64)
    mesh = studied.mesh(14)
    (pin,) = sim.scene.pins
    assert sorted(pin.vertices) == np.flatnonzero(mesh.vertices[:, 1] == mesh.bounds[0][1]).tolist()
    speeds = studied.start(sim).velocities.norm(dim=-1)[0]
    assert not speeds[pin.vertices].any()
    assert speeds.max() > 1.0
    with pytest.raises(ValueError, match=r"--scene .*beam.*'held'"):
        study_scene("beam", "held")
    with pytest.raises(ValueError, match=r"--scene .*lands, held.*'flies'"):
        study_scene(bar, "flies")


def test_cloth_is_studied() -> None:
    """Every method runs on it; rows count triangles, and a step has the error of the simulator itself."""
    bench = Bench(study_scene("cloth"), CPU, series=1, seconds=0.0)
    setting = Setting(1e5, 1 / 60, 5)
    rows = candidate_rows(bench, "guarded Chebyshev", torch.float64, setting, [8, 512])
    assert [row.tets for row in rows] == [50, 50]
    assert rows[0].error > 1e-3 > 1e-9 > rows[1].error
    newton = baseline_rows(bench, "Newton", setting, [8])
    assert min(row.error for row in newton) < 1e-9


def test_poissons_ratio_is_studied() -> None:
    bench = Bench(study_scene("beam", poisson=0.45), CPU, series=1, seconds=0.0)
    sim = bench.simulator(Setting(1e5, 1 / 30, 1), torch.float64)
    assert sim.scene.solids[0].poisson == pytest.approx(0.45)
    assert StudyOptions(poisson=0.45).command() == "python -m torchpd study beam --poisson 0.45"
    with pytest.raises(ValueError, match=r"poisson.*0\.6"):
        Bench(study_scene("beam", poisson=0.6), CPU).simulator(Setting(1e5, 1 / 30, 1), torch.float64)
    with pytest.raises(ValueError, match=r"--scene .*cloth.*'held'"):
        study_scene("cloth", "held")


@pytest.mark.parametrize("subject", ["beam", "cloth"])
def test_a_bad_material_is_refused_before_anything_is_written(subject: str, tmp_path: Path) -> None:
    out = tmp_path / "study"
    with pytest.raises(ValueError, match=r"poisson.*1\.5"):
        run_study(StudyOptions(subject, poisson=1.5, quick=True, out=out), progress=False)
    assert not out.exists()


def test_a_tetrahedral_mesh_lands(bar: str) -> None:
    studied = study_scene(bar)
    assert studied.name == "bar.mesh"
    low, high = studied.mesh(14).bounds
    assert (high - low).max() == pytest.approx(1.0)
    assert low[1] == pytest.approx(0.002)
    assert len(studied.resolutions) == 1


def test_missing_packages_are_said_before_the_work(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    some = ("plotly", "threadpoolctl")
    monkeypatch.setattr(study, "missing_packages", lambda found: [p for p in found if p.module in some])
    with pytest.raises(
        ModuleNotFoundError, match=r"plotly, threadpoolctl, not installed: pip install torchpd\[study\]"
    ):
        run_study(StudyOptions(out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()
