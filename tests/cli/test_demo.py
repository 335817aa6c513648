"""The commands: the demo writes everything it promises, and bad requests get one sentence."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pygltflib
import pytest
import trimesh
from PIL import Image
from pxr import Usd

import torchpd as pd
from torchpd.__main__ import main
from torchpd.cli.demo import DemoOptions, _place_body, run_demo

STEPS = 24


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """What a tiny demo of a bar prints, and the folder with its files."""
    folder = tmp_path_factory.mktemp("demo")
    trimesh.creation.box((2.0, 0.5, 0.5)).export(folder / "bar.obj")
    words = [
        "demo",
        str(folder / "bar.obj"),
        "--cells",
        "6",
        "--steps",
        str(STEPS),
        "--quick",
        "--out",
        str(folder / "out"),
    ]
    ended = subprocess.run([sys.executable, "-m", "torchpd", *words], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout, folder / "out"


def test_table_names_what_was_done(demo: tuple[str, Path]) -> None:
    text, folder = demo
    rows = dict(re.findall(r"^(\S[\w -]*?)  +(\S.*)$", text, flags=re.MULTILINE))
    assert rows["mesh"] == "bar.obj"
    assert int(rows["tets"].replace(",", "")) > 100
    assert rows["steps"] == f"{STEPS} of 16.7 ms"
    assert rows["iterations"] == "64 a step"
    assert float(rows["time per step"].split()[0]) > 0.0
    assert 0.0 <= float(rows["final residual"]) < 1.0
    listed = {Path(line.strip()) for line in text.split("written:")[1].splitlines() if line.strip()}
    assert listed == set(folder.iterdir())


def test_pictures_show_something(demo: tuple[str, Path]) -> None:
    _, folder = demo
    for name in ("picture.png", "contact_sheet.png", "convergence.png"):
        assert np.asarray(Image.open(folder / name).convert("RGB")).std() > 10.0
    sheet = np.asarray(Image.open(folder / "contact_sheet.png"))
    first, last = sheet[8:188, 8:248].astype(int), sheet[196:376, 504:744].astype(int)
    assert np.abs(first - last).mean() > 5.0  # the body has moved


def test_first_picture_is_told_before_the_report(demo: tuple[str, Path]) -> None:
    text, folder = demo
    assert text.startswith(f"first picture: {folder / 'picture.png'}\n")
    picture = np.asarray(Image.open(folder / "picture.png").convert("RGB"))
    assert picture[:, 100:140].std() > 10.0


def test_films_play_in_real_time(demo: tuple[str, Path]) -> None:
    _, folder = demo
    pictures = STEPS // 6 + 1
    film = Image.open(folder / "animation.gif")
    assert film.n_frames == pictures
    assert film.info["duration"] == 100  # six steps of 1/60 s
    reader = imageio_ffmpeg.read_frames(str(folder / "animation.mp4"))
    assert next(reader)["fps"] == 10.0
    assert len(list(reader)) == pictures


def test_surfaces_move_in_real_time(demo: tuple[str, Path]) -> None:
    _, folder = demo
    stage = Usd.Stage.Open(str(folder / "animation.usdc"))
    assert stage.GetEndTimeCode() / stage.GetTimeCodesPerSecond() == pytest.approx(STEPS / 60)
    document = pygltflib.GLTF2().load(str(folder / "animation.glb"))
    assert document.accessors[document.animations[0].samplers[0].input].max[0] == pytest.approx(STEPS / 60)


def test_arms_of_the_octopus_meet_each_other() -> None:
    """The demo's octopus is a mesh that `Contact` takes: parts do not touch at rest, at any resolution."""
    for cells in (12, 16, 24):
        mesh = _place_body(pd.shapes.octopus(), cells)
        scene = pd.Scene(pd.Solid(mesh, youngs=3e4, density=1000.0), pd.Contact(friction=0.3))
        sim = pd.Simulator(scene, 1 / 60, 2, batch=1)
        sim.check(sim(sim.rest_state()))


def test_the_octopus_is_shown_with_contact(tmp_path: Path) -> None:
    report = run_demo(DemoOptions(cells=12, steps=2, quick=True, out=tmp_path / "out"))
    assert re.search(r"^contact +ground, and with itself$", report, flags=re.MULTILINE)


def test_tetrahedral_mesh_is_taken_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (5, 1, 1))
    mesh.to_file(tmp_path / "bar.vtk")
    assert main(["demo", str(tmp_path / "bar.vtk"), "--steps", "2", "--quick", "--out", str(tmp_path / "out")]) == 0
    assert re.search(rf"^tets +{len(mesh.tets)}$", capsys.readouterr().out, flags=re.MULTILINE)
    assert not (tmp_path / "out" / "convergence.png").exists()  # two steps of free fall leave nothing to solve


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["demo", "nowhere.obj"], "nowhere.obj"),
        (["demo", "--device", "tpu9"], "tpu9"),
        (["demo", "--device", "meta"], "cpu or cuda"),
        (["study", "--device", "tpu"], "--device must be cpu or cuda, got tpu"),
    ],
)
def test_bad_requests_get_one_sentence(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.strip().splitlines()) == 1
    assert error.startswith("torchpd: ")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["demo", "--steps", "0"], "argument --steps: must be at least 1, got 0"),
        (["demo", "--cells", "many"], "argument --cells: must be a whole number, got 'many'"),
        (["demo", "--youngs", "-3"], "argument --youngs: must be positive and finite, got -3"),
        (["demo", "--youngs", "stiff"], "argument --youngs: must be a number, got 'stiff'"),
        (["dance"], "invalid choice: 'dance'"),
    ],
)
def test_bad_words_are_named(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


def test_missing_package_is_said_before_the_work(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(
        "torchpd.cli.demo.missing_packages", lambda packages: [p for p in packages if p.module == "mitsuba"]
    )
    assert main(["demo", "--out", str(tmp_path / "out")]) == 2
    assert "mitsuba, not installed: pip install torchpd[demo]" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("words", [["demo"], ["demo", "--patches"], ["study"]])
def test_a_file_in_the_way_of_the_folder_is_named_at_once(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "afile").touch()
    for out in (tmp_path / "afile", tmp_path / "afile" / "below"):
        assert main([*words, "--out", str(out)]) == 2
        said = capsys.readouterr().err
        assert said.startswith("torchpd: --out must be a folder or a new name, got the file")
        assert said.count("\n") == 1


def test_version_and_doctor(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"torchpd {pd.__version__}\n"
    assert main(["doctor"]) == 0
    assert pd.__version__ in capsys.readouterr().out
