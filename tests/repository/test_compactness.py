"""The compactness study: PN triangles and bytes as they are defined, and a run from end to end."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from patch_cases import ball
from programs import ROOT

import torchpd as pd
from torchpd.freeform.targets import target_of


@pytest.fixture
def compactness(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "path", [str(ROOT / "benchmarks"), *sys.path])
    import compactness

    return compactness


def test_pn_triangles_are_those_of_the_paper(compactness) -> None:
    """Flat where the normals are, through the corners, and of fourth order on a sphere."""
    corners = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    b = np.random.default_rng(0).dirichlet((1, 1, 1), 50)
    flat = compactness.pn_points(corners, np.broadcast_to([0.0, 0, 1], (1, 3, 3)), b)
    np.testing.assert_allclose(flat[0], b @ corners[0], atol=1e-15)
    round_ = ball(1).vertices[ball(1).triangles]
    np.testing.assert_allclose(compactness.pn_points(round_, round_, np.eye(3)), round_, atol=1e-15)
    errors = []
    for mesh in (ball(2), ball(3)):
        c = mesh.vertices[mesh.triangles]
        errors.append(np.abs(np.linalg.norm(compactness.pn_points(c, c, b), axis=2) - 1.0).max())
    assert errors[0] / errors[1] == pytest.approx(16.0, rel=0.2)


def test_rows_of_triangles(compactness) -> None:
    """On a unit sphere plain triangles lie under it by what the cap over them is high."""
    target = target_of(lambda x: x.norm(dim=1) - 1.0, None, [[-1.5] * 3, [1.5] * 3])
    row = compactness.triangle_row("triangles", target, ball(2), compactness.flat_points, 3)
    assert row["bytes"] == 162 * 12 + 320 * 6
    middles = ball(2).vertices[ball(2).triangles].mean(axis=1)
    assert row["largest"] == pytest.approx(1.0 - np.linalg.norm(middles, axis=1).min(), rel=0.05)


def test_the_blob_is_smooth_and_closed(compactness) -> None:
    points = torch.tensor(ball(3).vertices)
    assert torch.isfinite(compactness.blob(torch.zeros(1, 3, dtype=torch.float64))).all()
    radius = 1.0 - compactness.blob(points)
    assert 0.7 < float(radius.min()) < float(radius.max()) < 1.5


@pytest.mark.slow
def test_it_runs(tmp_path: Path, script: Callable[..., str]) -> None:
    mesh, out, picture = tmp_path / "ring.ply", tmp_path / "rows.json", tmp_path / "rows.png"
    ring = trimesh.creation.torus(1.0, 0.4, major_sections=16, minor_sections=8)
    pd.TriMesh.from_trimesh(ring).to_file(mesh)
    script("benchmarks/compactness.py", str(mesh), "--quick", "--out", str(out), "--picture", str(picture))
    record = json.loads(out.read_text())
    assert {row["shape"] for row in record["rows"]} == {"blob", "octopus", "ring"}
    assert all(0 < row["rms"] <= row["largest"] < row["size"] for row in record["rows"])
    assert picture.stat().st_size > 10_000
