"""The scenes of free-form patches: as large as published, closed where they should be, and the demo shows them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import torchpd as pd
from torchpd.__main__ import main
from torchpd.cli.patch_demo import PAPER_SCENES, PatchScene, spindle
from torchpd.freeform.continuity import measure_continuity


@pytest.mark.parametrize("scene", PAPER_SCENES, ids=lambda scene: scene.name)
def test_scenes_are_as_large_as_published(scene: PatchScene) -> None:
    published = {"twist": (1200, 3832), "bend": (1000, 3484), "drop": (200, 664)}
    body = scene.prepare(stiffness=1.5e4, steps=8).body
    assert (len(body.patches.triangles), len(body.patches.quadrics)) == published[scene.name]
    again = scene.prepare(stiffness=1.5e4, steps=8).body
    assert torch.equal(body.patches.quadrics.centres, again.patches.quadrics.centres)


@pytest.mark.parametrize("scene", PAPER_SCENES, ids=lambda scene: scene.name)
def test_scenes_move_without_gaps(scene: PatchScene) -> None:
    prepared = scene.prepare(stiffness=1.5e4, steps=30)
    sim = pd.Simulator(prepared.scene, 1 / 60, 64)
    track = sim.rollout(sim.rest_state(), 30, targets=prepared.targets, return_info=True)
    assert float(track.info.residual.max()) < 0.1
    body = prepared.body
    pose = body.pose(track.positions[-1])
    assert float((pose.positions - body.patches.vertices).norm(dim=-1).max()) > 0.1
    assert measure_continuity(body.patches, pose).gap <= 2**-22  # float32 numbers of about 1
    mesh = body.patches.mesh(2, pose).to_trimesh()
    assert mesh.is_watertight == (scene.name != "bend")


@pytest.mark.parametrize("power", [2.0, 8.0])
def test_spindle_is_closed_and_looks_outwards(power: float) -> None:
    mesh = spindle(10, 12, length=0.6, radius=0.3, power=power)
    assert len(mesh.triangles) == 2 * 10 * 12
    assert mesh.to_trimesh().is_watertight
    ball = 4.0 / 3.0 * np.pi * 0.3**3
    assert 0.8 * ball < mesh.volume() < (1.0 if power == 2.0 else 1.5) * ball


def test_demo_draws_and_times_the_three_scenes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--patches", "--quick", "--steps", "4", "--iterations", "8", "--out", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    rows = {words[0]: words[1:] for words in map(str.split, text.splitlines()[1:4])}
    assert rows["twist"][:2] == ["1,200", "3,832"]
    assert [rows[name][7:9] for name in ("twist", "bend", "drop")] == [["27", "37"], ["26", "38"], ["20", "49"]]
    for row in rows.values():
        simulation, surface, rate = float(row[4]), float(row[5]), float(row[6])
        # both times are rounded to the last digit that they are printed with
        slack = sum(0.5 * 10.0 ** -len(word.partition(".")[2]) for word in row[4:6])
        assert 1e3 / (simulation + surface + slack) - 1.0 <= rate <= 1e3 / (simulation + surface - slack) + 1.0
    assert len(re.findall(r"gap \S+ \S+ m; crease angle mean", text)) == 3
    listed = {Path(line.strip()) for line in text.split("written:")[1].splitlines() if line.strip()}
    assert listed == set(tmp_path.iterdir())
    sheet = np.asarray(Image.open(tmp_path / "patches.png").convert("RGB")).astype(int)
    assert sheet.shape == (3 * 188 + 8, 3 * 248 + 8, 3)
    for row in range(3):  # something red in every first picture
        picture = sheet[8 + 188 * row : 188 + 188 * row, 8:248]
        assert (picture[..., 0] > picture[..., 2] + 40).mean() > 0.02


@pytest.mark.parametrize("words", [["nowhere.obj"], ["--cells", "8"]])
def test_patches_take_no_mesh(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--patches", *words]) == 2
    assert "makes its own bodies: leave out MESH and --cells" in capsys.readouterr().err
