"""The comparison with other simulators: the same body for all, errors from each own answer, gaps that are said."""

from __future__ import annotations

import dataclasses
import functools
import importlib
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
import torch
from programs import ROOT

import torchpd as pd
from torchpd.reference.problem import elastic_energy


@pytest.fixture
def peers(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The modules, by name."""
    monkeypatch.syspath_prepend(str(ROOT))
    return lambda name: importlib.import_module(f"benchmarks.peers.{name}")


def test_the_minimiser_finds_our_own_step(peers: Any) -> None:
    """With the energy of projective dynamics it ends where our solver does: w / 2 |F - R|^2, R through the SVD."""
    problem = peers("problem").beam(2, 1e5)

    def density(f: torch.Tensor) -> torch.Tensor:
        # |F - R|^2 = sum (sigma - 1)^2 while nothing is inverted
        return 0.5 * problem.youngs * (torch.linalg.svdvals(f) - 1.0).square().sum(-1)

    converged = peers("converged")
    found, left = converged.minimise(problem, converged.of_tetrahedra(problem, density))
    ours, _ = peers("ours").converged(problem)
    assert left < 1e-8
    assert problem.error(found, ours) < 1e-6


def test_neo_hookean_agrees_for_small_strain(peers: Any) -> None:
    """Its second derivatives at rest are those of mu |sym|^2 at Poisson ratio 0, w = 2 mu, and its first vanish."""
    density = peers("converged").stable_neo_hookean(0.5, 0.0)
    strain = 1e-4 * torch.randn(50, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    strain = (strain + strain.mT) / 2.0
    rest = density(torch.eye(3, dtype=torch.float64).expand(1, 3, 3))
    risen = density(torch.eye(3, dtype=torch.float64) + strain) - rest
    expected = 0.5 * strain.square().sum((1, 2))
    # what is left out is of third order
    assert torch.allclose(risen, expected, rtol=5e-3)


def test_cloth_of_the_other_solver_agrees_for_small_strain_and_angles(peers: Any, monkeypatch: Any) -> None:
    """Its energy is ours but for third orders: at strains of 1e-3, and at angles of 1e-3 with strains of 1e-6."""
    monkeypatch.setattr(peers("problem"), "SHEET_CELLS", 5)
    for axes, bending in (([0, 2], 1e-6), ([1], 0.7)):
        problem = dataclasses.replace(peers("problem").hanging(1e3), bending=bending)
        x = problem.mesh.vertices.copy()
        x[:, axes] += np.random.default_rng(0).uniform(-2e-4, 2e-4, (len(x), len(axes)))
        found = float(peers("converged").of_sheet(problem)(torch.from_numpy(x)))
        assert found == pytest.approx(elastic_energy(problem.scene().values(), x), rel=5e-3)


def test_cloth_of_springs_balances_where_ours_does(peers: Any, monkeypatch: Any) -> None:
    """In tension and for small shear the three springs are the membrane; what is left has the order of the strain."""
    monkeypatch.setattr(peers("problem"), "SHEET_CELLS", 6)
    problem = peers("problem").hanging(1e3)
    ours, residual = peers("ours").converged(problem)
    found, left = peers("style3d").balance(problem, problem.first)
    assert max(left, residual) < 1e-9
    assert problem.error(found, ours) < 1e-5
    assert not (found[problem.held] - problem.first[problem.held]).any()


def test_the_folded_cloth_moves_and_is_held_by_two_corners(peers: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr(peers("problem"), "SHEET_CELLS", 6)
    problem = peers("problem").folded(1e3)
    assert len(problem.held) == 2
    assert np.array_equal(problem.start[problem.held], problem.mesh.vertices[problem.held])
    # a free fall of 24 steps is 24 * 25 / 2 g h^2 = 0.82 m
    assert problem.start[:, 1].min() == pytest.approx(-0.82, abs=0.05)
    chebyshev, _ = peers("ours").converged(problem)
    step = peers("ours").step(problem, "cpu", pd.Chebyshev(), "torchpd Chebyshev")
    assert problem.error(step.run(2000), chebyshev) < 1e-3


def test_a_file_is_held_and_thrown_like_the_beam(peers: Any, tmp_path: Path) -> None:
    path = tmp_path / "bar.mesh"
    bar = pd.shapes.box((0.2, 4.0, 0.2), (1, 6, 1))
    meshio.Mesh(bar.vertices, [("tetra", bar.tets)]).write(path)
    problem = peers("problem").from_file(str(path), 1e5)
    size = np.ptp(problem.mesh.vertices, axis=0)
    assert size.max() == pytest.approx(1.0)
    assert set(problem.held) == set(np.flatnonzero(problem.mesh.vertices[:, 1] < 0.05))
    assert not problem.velocities[problem.held].any()
    assert np.abs(problem.velocities).max() == pytest.approx(10.0)


def test_a_table_says_who_is_faster_and_what_failed(peers: Any) -> None:
    report = peers("report")

    def method(name: str, *points: tuple[float, float]) -> dict[str, Any]:
        listed = [{"milliseconds": ms, "error": error} for ms, error in points]
        return {"method": name, "points": listed, "own_answer_from_ours": 0.01}

    row = {
        "problem": "bar", "youngs": 1e5,
        "methods": [
            method("torchpd Chebyshev", (1.0, 0.1), (8.0, 0.01)),
            method("torchpd Multilevel", (2.0, 0.1), (4.0, 0.01)),
            method("torchpd, substeps", (5.0, 0.1)),
            method("Newton VBD", (3.0, 0.1), (100.0, 0.02)),
            {"method": "Newton XPBD", "points": [], "refused": "does not settle", "missing": False},
            {"method": "MuJoCo flex, substeps", "points": [], "refused": "not installed", "missing": True},
        ],
    }  # fmt: skip
    lines = report.table([row], (0.1, 0.01)).splitlines()[2:]
    assert "1.0 / 3.0: 3.0 x | 4.0 / > 100: > 25 x" in lines[0]
    assert lines[1].count("does not converge") == 2
    assert lines[2].count("left out") == 2
    row["methods"][3] = method("Newton VBD", (0.5, 0.1), (0.6, 2.5))
    lines = report.table([row], (0.1, 0.01)).splitlines()[2:]
    assert "slower here" in lines[0]
    assert "diverges" in lines[0]


@pytest.mark.parametrize(
    ("module", "make", "missing"),
    [("newton_physics", "vbd", "newton"), ("newton_physics", "style3d", "newton"), ("mujoco_flex", "flex", "mujoco")],
)
def test_what_is_not_installed_is_named(
    peers: Any, module: str, make: str, missing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, missing, None)
    problem = peers("problem").beam(1, 1e5)
    with pytest.raises(peers("problem").MissingPackageError, match=f"left out.*pip install.*{missing}"):
        getattr(peers(module), make)(problem, "cpu")


def test_motions_with_contact_are_judged_by_their_own_and_crossings_are_counted(peers: Any, monkeypatch: Any) -> None:
    contact = peers("contact")
    monkeypatch.setattr(contact, "COUNTS", [4, 64])
    motion = dataclasses.replace(contact.cube_rests(), steps=4, longest=256)
    run = functools.partial(contact.ours, motion, device="cpu")
    row = contact.measure(motion, run, functools.partial(run, dtype=torch.float64), None)
    assert row["settled"] < 1e-3
    coarse, fine = row["points"]
    assert fine["error"] < 0.1 * coarse["error"]
    assert row["crossings_converged"] == coarse["crossings"] == fine["crossings"] == 0
    half = len(motion.start) // 2
    sunk = np.stack([motion.start] * 2)
    sunk[1, half:, 1] -= 0.01
    assert contact.count_crossings(motion, sunk) > 0
    assert contact.at_rest(motion, sunk)["gap"] == pytest.approx(-0.009)
    peer = {**row, "method": "Newton VBD", "penalty": 1e3}
    own = {**row, "method": "torchpd", "penalty": None}
    for of, name in ((own, "cube rests"), (peer, "cube rests")):
        of["motion"] = name
    assert contact.table([own, peer]).count("1.0 x") == len(contact.GOALS)
