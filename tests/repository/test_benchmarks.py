"""The benchmark runs from end to end and writes what its readers rely on. How fast it is, no test judges."""

from __future__ import annotations

import importlib
import json
import os
import re
import runpy
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from devices import missing_gpu
from programs import ROOT

from torchpd.common.gpu import properties_of
from torchpd.study.axes import PAPER_TESTS

SCHEMA: dict[str, Any] = {
    "schema": int,
    "command": str,
    "created": str,
    "commit": str,
    "machine": {"cpu": str, "logical_cores": int, "threads": int, "simd": str, "device": str, "platform": str},
    "versions": {"torchpd": str, "torch": str, "python": str, "numpy": str, "compiler": str},
    "goals_hold_at": {"multiply_adds_per_second_per_thread": float, "threads": int},
    "call_microseconds": {
        "sim(state)": float,
        "sim(state, return_info=True)": float,
        "sim.step_(state)": float,
        "one step of a rollout": float,
    },
    "results": list,
}
TIMES = {"median": float, "min": float, "repetitions": int}
ROW: dict[str, Any] = {
    "scene": str,
    "dtype": str,
    "batch": int,
    "iterations": int,
    "vertices": int,
    "tets": int,
    "patches": int,
    "plan_seconds": float,
    "plan_bytes": int,
    "workspace_bytes": int,
    "bytes_per_vertex": float,
    "milliseconds": TIMES,
    "tet_iterations_per_second": float,
    "tet_iterations_per_second_median": float,
    "multiply_adds_per_second": {"before": float, "after": float},
    "multiply_adds_per_tet_iteration": float,
    "goal": {"least": float, "aim": float, "share_of_least": float},
    "vectorised_torch": {
        "iterations": int,
        "largest_difference": float,
        "threads": int,
        "milliseconds": TIMES,
        "tet_iterations_per_second": float,
    },
    "speedup": float,
}


def assert_schema(value: Any, schema: Any, where: str) -> None:
    if isinstance(schema, dict):
        assert value.keys() == schema.keys(), where
        for name, inner in schema.items():
            assert_schema(value[name], inner, f"{where}.{name}")
    else:
        assert isinstance(value, schema), where


def run(*words: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, ROOT / "benchmarks" / "run.py", *words]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], str]:
    """The result of a quick run, and what it prints."""
    out = tmp_path_factory.mktemp("benchmarks") / "results" / "quick.json"
    ended = run("--quick", "--threads", "1", "--out", str(out))
    assert ended.returncode == 0, ended.stderr
    return json.loads(out.read_text()), ended.stdout


def test_schema(quick: tuple[dict[str, Any], str]) -> None:
    result, _ = quick
    assert_schema(result, SCHEMA, "result")
    for row in result["results"]:
        without_goal = {**ROW, "goal": type(None)}
        assert_schema(row, ROW if row["goal"] else without_goal, row["scene"])


def test_both_precisions_and_a_batch_are_measured(quick: tuple[dict[str, Any], str]) -> None:
    rows = quick[0]["results"]
    assert {(row["dtype"], row["batch"]) for row in rows} == {
        (dtype, batch) for dtype in ("float32", "float64") for batch in (1, 9)
    }
    for row in rows:
        work = row["tets"] * row["batch"] * row["iterations"]
        assert row["tet_iterations_per_second"] == pytest.approx(1e3 * work / row["milliseconds"]["min"])


def test_plain_torch_takes_the_same_step(quick: tuple[dict[str, Any], str]) -> None:
    # four iterations on positions of at most 1 m: some rounding errors of 1
    rounding = {"float32": 2**-24, "float64": 2**-53}
    for row in quick[0]["results"]:
        assert row["vectorised_torch"]["largest_difference"] <= 16 * rounding[row["dtype"]]


def test_table_shows_every_row(quick: tuple[dict[str, Any], str]) -> None:
    result, text = quick
    lines = text.splitlines()
    assert "M tet-it/s" in lines[0]
    for row, line in zip(result["results"], lines[1:], strict=False):
        assert line.split()[:2] == [row["scene"], row["dtype"]]


def refusal(words: list[str], script: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> str:
    """What a script says that refuses its arguments, in this process: to import everything again takes seconds."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.setattr(sys, "argv", [script, *words])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(ROOT / "benchmarks" / script), run_name="__main__")
    assert ended.value.code == 2
    return capsys.readouterr().err


def test_unknown_scene_is_refused(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    said = refusal(["--only", "nothing"], "run.py", capsys, monkeypatch)
    assert all(word in said for word in ("--only", "1k, 10k", "got nothing"))


def test_beam_counts_iterations(tmp_path: Path, script: Callable[..., str]) -> None:
    """With 150 iterations at most, by which Jacobi comes to a hundredth and not to a thousandth."""
    words = ["--most", "150", "--errors", "0.1", "0.01", "0.001", "--out", str(tmp_path / "beam.json")]
    said = script("benchmarks/beam.py", *words)
    rows = json.loads((tmp_path / "beam.json").read_text())["rows"]
    counts = {row["solver"]: row["iterations"] for row in rows if row["youngs"] == 1e4}
    assert counts["Jacobi"] == [41, 102, None]
    assert counts["guarded Chebyshev"][1:] == [22, 38]
    assert counts["classic Chebyshev"] == sorted(counts["classic Chebyshev"])
    assert counts["classic Chebyshev"][1] < 102 / 3
    soft = next(line for line in said.splitlines() if "1e+04  Jacobi" in line)
    assert soft.split()[-4:] == ["41", "102", ">", "150"]


def test_multilevel_counts_iterations(tmp_path: Path, script: Callable[..., str]) -> None:
    """Of a box; the file has the rows."""
    out = tmp_path / "multilevel.json"
    said = script("benchmarks/multilevel.py", "--cells", "3", "--youngs", "1e6", "--out", str(out))
    name, lbfgs, momentum, chebyshev = said.splitlines()
    written = json.loads(out.read_text())
    assert [row["kind"] for row in written["rows"]] == ["steps"]
    assert [str(count) for count in written["rows"][0]["iterations"]["lbfgs"]] == lbfgs.split()[1:4]
    assert name.startswith("box 3, 1e+06 Pa: 256 vertices")
    for line, outer in ((lbfgs, "lbfgs"), (momentum, "momentum")):
        counts = line.split()[1:4]
        assert line.split()[0] == outer
        assert sorted(counts, key=int) == counts
    assert chebyshev.split()[:4] == ["512", "iterations", "of", "guarded"]


def test_multilevel_counts_iterations_with_stiff_pieces(script: Callable[..., str]) -> None:
    slabs, *rows = script("benchmarks/multilevel.py", "--blocks", "6", "--contrasts", "1e3").splitlines()
    assert slabs.startswith("box 6, slabs at 1000: 1519 vertices")
    assert rows[1].startswith("box 6, cubes at 1000: 1519 vertices")
    for row in rows[::2]:
        # iterations to 1e-2, 1e-3 and 1e-4
        counts = [int(cell.split()[-1]) for cell in row.split(" it.")[:3]]
        assert counts == sorted(counts)
        assert counts[-1] < 40


def test_newton_is_compared_with_multilevel(tmp_path: Path, script: Callable[..., str]) -> None:
    out = tmp_path / "newton.json"
    said = script("benchmarks/newton.py", "--scenes", "beam, 1e6 Pa", "--out", str(out)).splitlines()
    (row,) = json.loads(out.read_text())["rows"]
    assert row["vertices"] == 936
    for line, (name, solver) in zip(said, row["solvers"].items(), strict=True):
        assert line.startswith(f"beam, 1e6 Pa, {name}, residual of x* ")
        assert solver["residual of x*"] <= 1e-9
        counts = [point["iterations"] for point in solver["reached"]]
        assert len(counts) == 4
        assert counts == sorted(counts)
        assert counts[-1] < 40


def test_set_up_times_every_stage(tmp_path: Path, script: Callable[..., str]) -> None:
    out = tmp_path / "set-up.json"
    said = script("benchmarks/set_up.py", "--cells", "3", "--plans", "4", "--out", str(out))
    assert "256 vertices, 810 tetrahedra" in said
    box, plans = json.loads(out.read_text())["rows"]
    assert list(box["stages"]) == ["simulator", "gpu plan", "levels", "gpu levels"]
    assert list(plans["stages"]) == ["simulator", "gpu plan"]
    assert all(stage["processor_seconds"] > 0.0 for stage in box["stages"].values())


@pytest.mark.usefixtures("on_path")
def test_scenes_of_the_gpu_are_what_their_names_say() -> None:
    scenes = importlib.import_module("gpu_scenes")
    named = {scene.name: scene for scene in scenes.GPU_SCENES}
    assert len(named) == len(scenes.GPU_SCENES)
    for scene in scenes.GPU_SCENES:
        vertices = np.prod(np.add(scene.cells, 1))
        assert scene.name.endswith("-effects") == scene.effects
        assert scene.name.endswith(("-free", "-ground")) == scene.loose
        assert scene.name.endswith("-ground") == scene.ground
        name = scene.name.removesuffix("-as-many-tets")
        size = re.sub(f"^one-|-({scene.mesh}|effects|free|ground)$", "", name)
        if name != scene.name:
            # the irregular mesh has 12 % more tetrahedra for as many vertices
            regular = named[name.removesuffix("-irregular")]
            assert 0.88 < vertices / np.prod(np.add(regular.cells, 1)) < 0.9
            assert scene.aims == regular.aims
        elif "x" in size:
            assert size == f"{vertices}x{scene.batch}"
        elif size == "1200-tets":
            assert (5 if scene.mesh == "five" else 6) * np.prod(scene.cells) == 1200
        else:
            goal = float(size.replace("k", "e3").replace("M", "e6"))
            assert goal <= vertices <= 1.05 * goal
        for aim in scene.aims:
            assert aim.stretch is None or (aim.stretch < aim.must) == aim.is_time
    for constraints, _, cells in PAPER_TESTS:
        assert 6 * np.prod(cells) == pytest.approx(constraints, rel=0.02)
    batch = named["256x8192-five"]
    assert batch.aims[1].must == 1.5e6
    # the two goals of a batch ask for about the same
    assert batch.aims[0].must == pytest.approx(1.5e6 * 64 * 5 * np.prod(batch.cells), rel=0.01)


@pytest.mark.usefixtures("on_path")
@pytest.mark.parametrize("cells", [(3, 3, 3), (15, 4, 4)])
def test_irregular_bar_is_a_mesh_of_the_same_size(cells: tuple[int, int, int]) -> None:
    mesh = importlib.import_module("gpu_scenes").irregular_bar(cells)
    corners = mesh.vertices[mesh.tets]
    volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    assert len(mesh.vertices) == np.prod(np.add(cells, 1))
    # nothing but slivers is missing: each has less than a hundredth of a cell
    assert 0.97 * 0.04 <= volumes.sum() <= 0.04 * (1 + 1e-9)
    assert volumes.min() > 0.01 * 0.04 / np.prod(cells)
    assert np.unique(mesh.tets).size == len(mesh.vertices)
    counts = np.bincount(mesh.tets.ravel())
    assert counts.max() > 24  # a regular one has 24 at most


@pytest.mark.usefixtures("on_path")
def test_irregular_bar_is_the_same_in_slabs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Long bars are made by several processes."""
    scenes = importlib.import_module("gpu_scenes")
    cells = (23, 3, 3)
    whole = scenes.irregular_bar(cells)
    monkeypatch.setattr(scenes, "_SLAB", 7)
    slabs = scenes.irregular_bar(cells)
    assert np.array_equal(slabs.vertices, whole.vertices)
    sets = [np.unique(np.sort(mesh.tets, axis=1), axis=0) for mesh in (slabs, whole)]
    assert len(sets[0]) == len(slabs.tets)
    assert np.array_equal(*sets)
    # a sphere that is not seen as a whole may have a point within it
    monkeypatch.setattr(scenes, "_MARGIN", 0.5)
    points = whole.vertices / scenes.SIZE * cells
    with pytest.raises(RuntimeError, match="_MARGIN"):
        scenes._delaunay_slab(points, 7.25, 14.25)


@pytest.mark.usefixtures("on_path")
def test_a_run_that_is_cut_short_leaves_its_rows(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    run = importlib.import_module("run")
    done = []

    def measure(scene: Any, *_: object) -> dict[str, Any]:
        if done:
            raise KeyboardInterrupt
        done.append(scene.name)
        return {"scene": scene.name}

    monkeypatch.setattr(run, "measure_scene", measure)
    monkeypatch.setattr(run, "measure_calls", lambda _: {})
    with pytest.raises(KeyboardInterrupt):
        run.main(["--quick", "--threads", str(torch.get_num_threads()), "--out", str(tmp_path / "here" / "cut.json")])
    assert [row["scene"] for row in json.loads((tmp_path / "here" / "cut.json").read_text())["results"]] == done


@pytest.mark.usefixtures("on_path")
def test_bar_of_five_tetrahedra_a_cell() -> None:
    mesh = importlib.import_module("gpu_scenes").five_tet_bar((15, 3, 3))
    corners = mesh.vertices[mesh.tets]
    volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    assert mesh.tets.shape == (675, 4)
    assert len(mesh.vertices) == 256
    # the one in the middle has a third of its cell, the others a sixth
    np.testing.assert_allclose(np.sort(volumes) * 135 / 0.04, [1 / 6] * 540 + [1 / 3] * 135, rtol=1e-9)
    faces = np.sort(mesh.tets[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3), axis=1)
    _, counts = np.unique(faces, axis=0, return_counts=True)
    # neighbours share their faces: outside lie two for each square
    assert np.bincount(counts).tolist() == [0, 2 * (4 * 15 * 3 + 2 * 3 * 3), (4 * 675 - 396) // 2]


@pytest.mark.usefixtures("on_path")
def test_numbers_of_a_gpu_row() -> None:
    gpu, scenes, timing = (importlib.import_module(name) for name in ("gpu", "gpu_scenes", "gpu_timing"))
    scene = next(s for s in scenes.GPU_SCENES if s.name == "256x8192-five")
    device = timing.Device("H100", 132, 1.98e9, 3e12, 80 << 30)
    assert device.lane_instructions == pytest.approx(33.4e12, rel=1e-2)
    step = 8192 / 1.5e6  # as fast as must be
    facts = {"kernel": "block", "vertices": 256, "tets": 675}
    row = gpu.quantities(scene, facts["tets"], step, 1.9 * step)
    assert row["tet_iterations_per_second"] == pytest.approx(1.5e6 * 675 * 64)
    assert row["marginal_iteration_microseconds"] == pytest.approx(0.9 * row["iteration_microseconds"])
    shares = [aim["share_of_must"] for aim in gpu.aims(scene, row, torch.float32)]
    assert shares == pytest.approx([1.5e6 * 675 * 64 / 65e9, 1.0])
    assert gpu.aims(scene, row, torch.float64) == []
    floor = gpu.floors(scene, facts, device, torch.float32, step)
    assert floor["issue"] == pytest.approx(202 * row["tet_iterations_per_second"] / device.lane_instructions)
    assert floor["bandwidth"] is None
    large = next(s for s in scenes.GPU_SCENES if s.name == "one-1M")
    facts = {"kernel": "stream", "vertices": 1 << 20, "tets": 6_000_000}
    row = gpu.quantities(large, facts["tets"], 64 * 65e-6, 128 * 65e-6)
    assert gpu.aims(large, row, torch.float32)[0]["share_of_must"] == pytest.approx(2.0)  # half the time
    floor = gpu.floors(large, facts, device, torch.float64, 64 * 65e-6)
    assert floor == {"issue": None, "bandwidth": pytest.approx(488 * (1 << 20) / 3e12 / 65e-6)}


@pytest.mark.usefixtures("on_path")
def test_a_result_keeps_rows_of_earlier_runs() -> None:
    gpu = importlib.import_module("gpu")

    def rows(**steps: float) -> list[dict[str, object]]:
        return [{"scene": name.replace("_", "-"), "dtype": "float32", "step": step} for name, step in steps.items()]

    earlier = {
        "results": rows(one_10k=1.0, one_1M=2.0), "call_microseconds": {"block": 3.0}, "call_run": {"commit": "1"},
        "paper": [{"tets": 4}], "commit": "1",
    }  # fmt: skip
    result = {"results": rows(one_1M=5.0, one_100k=6.0), "call_microseconds": {}, "paper": [], "commit": "2"}
    whole = gpu.with_earlier(result, earlier)
    assert whole["results"] == rows(one_10k=1.0, one_100k=6.0, one_1M=5.0)  # in the order of the scenes
    assert (whole["call_microseconds"], whole["paper"]) == ({"block": 3.0}, [{"tets": 4}])
    assert whole["call_run"] == {"commit": "1"}
    assert "commit" not in whole
    assert result["results"] == rows(one_1M=5.0, one_100k=6.0)
    assert gpu.with_earlier(result, {})["results"] == rows(one_100k=6.0, one_1M=5.0)
    again = gpu.with_earlier({**result, "call_microseconds": {"grid": 1.0}, "call_run": {"commit": "2"}}, whole)
    assert (again["call_microseconds"], again["call_run"]) == ({"grid": 1.0}, {"commit": "2"})


@pytest.mark.usefixtures("on_path")
def test_a_run_of_some_batches_keeps_the_others() -> None:
    by_batch = importlib.import_module("kernels_by_batch")

    def row(batch: int, **more: Any) -> dict[str, Any]:
        return {"dtype": "float32", "mesh": "regular", "vertices": 64, "batch": batch, **more}

    heads = [
        {"command": "c", "created": "d", "commit": torch, "machine": {"cpu": "C", "simd": "s", "device": "D"}}
        | {"versions": {"torch": torch}}
        for torch in "12"
    ]
    first, second = map(by_batch.run_of, heads)
    assert second == {"command": "c", "created": "d", "commit": "2", "machine": "C, s, D", "torch": "2"}
    earlier = {**heads[0], "rows": [row(1), row(2, auto="grid")]}
    new = {**heads[1], "rows": [row(2, auto="block", run=second), row(3, run=second)]}
    whole = by_batch.with_earlier(new, earlier)
    assert whole["rows"] == [row(1, run=first), row(2, auto="block", run=second), row(3, run=second)]
    assert {**whole, "rows": 0} == {**heads[1], "rows": 0}
    assert by_batch.with_earlier(earlier, whole)["rows"] == [row(1), row(2, auto="grid"), row(3, run=second)]
    assert by_batch.with_earlier(new, {}) == new


@pytest.mark.usefixtures("on_path")
def test_runs_side_by_side_keep_each_others_rows(tmp_path: Path) -> None:
    gpu, machine = importlib.import_module("gpu"), importlib.import_module("machine")
    path = tmp_path / "deep" / "rows.json"
    names = [scene.name for scene in gpu.GPU_SCENES][:24]

    def write(name: str) -> None:
        result = {"results": [{"scene": name, "dtype": "float32"}], "call_microseconds": {}, "paper": []}
        machine.write_result(path, result, gpu.with_earlier)

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write, names))
    assert [row["scene"] for row in json.loads(path.read_text())["results"]] == names
    assert [file.name for file in path.parent.iterdir()] == ["rows.json"]
    other = tmp_path / "other.json"
    other.symlink_to(path)
    machine.write_result(other, {"results": []})
    assert json.loads(path.read_text()) == {"results": []}
    assert other.is_symlink()
    machine.write_result(Path(os.devnull), {"results": []})


@pytest.mark.skipif(not missing_gpu(), reason="there is a GPU")
def test_a_gpu_that_is_missing_is_refused(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    if torch.cuda.is_available():
        pytest.skip("there is a GPU, but no kernels")
    for script, words in (("run.py", ["--device", "cuda", "--quick"]), ("kernels_by_batch.py", [])):
        assert "torch finds no CUDA device" in refusal(words, script, capsys, monkeypatch)


@pytest.mark.skipif(bool(missing_gpu()), reason="needs a GPU")
def test_quick_run_on_a_gpu(tmp_path: Path) -> None:
    out = tmp_path / "gpu.json"
    ended = run("--quick", "--device", "cuda", "--out", str(out))
    assert ended.returncode == 0, ended.stderr
    result = json.loads(out.read_text())
    clusters = {"cluster"} if properties_of(torch.device("cuda", 0)).cluster > 1 else set()
    kernels = {"block", "grid", "stream"} | clusters
    assert {row["kernel"] for row in result["results"]} == kernels
    assert {name.split(":")[0] for name in result["call_microseconds"]} == kernels
    for row in result["results"]:
        assert row["step_microseconds"] > 0.0
        assert row["aims"][0]["share_of_must"] > 0.0
        assert row["scene"] in ended.stdout
    for parts in result["call_microseconds"].values():
        assert parts.keys() == {"host", "graph", "kernels"}


@pytest.mark.usefixtures("on_path")
def test_a_cube_slides_or_rests_for_its_gradients() -> None:
    """As its rows say: most of the vertices below slide in one scene, and none in the other."""
    benchmark = importlib.import_module("friction_gradients")
    rows = [benchmark.training_row(2, 2, speed, torch.device("cpu"), 0.0) for speed in (3.0, 0.0)]
    assert rows[0]["slide"] >= 4.0
    assert rows[1]["slide"] == 0.0
    # which of the two takes longer depends on other programs
    assert all(row["vertices"] == 27 and min(row["forward"], row["both"]) > 0.0 for row in rows)
