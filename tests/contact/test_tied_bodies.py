"""Sides that a tie joins are no pair, of one body or of two: nothing pushes a seam open."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from body_scenes import THICKNESS, block, cloth, gravity, simulator
from rod_scenes import rod

import torchpd as pd


def sewn_sheets() -> tuple[pd.Scene, list[int], list[int]]:
    """Two sheets that touch along a line, and the numbers of what is sewn."""
    mesh = pd.shapes.sheet((0.2, 0.2), (4, 4))
    right = mesh.vertices[:, 0].max()
    one, other = cloth(mesh), cloth(mesh.translated((float(np.ptp(mesh.vertices[:, 0])), 0.0, 0.0)))
    seam = np.flatnonzero(np.abs(other.mesh.vertices[:, 0] - right) < 1e-9)
    held = np.flatnonzero(one.mesh.vertices[:, 0] < mesh.vertices[:, 0].min() + 1e-9)
    tie = pd.Tie(other, seam, one, other.mesh.vertices[seam], stiffness=1e3)
    near = [int(np.linalg.norm(mesh.vertices - place, axis=1).argmin()) for place in other.mesh.vertices[seam]]
    scene = pd.Scene(one, other, tie, pd.Pin(one, held), gravity(), pd.Contact(thickness=THICKNESS))
    return scene, near, [len(mesh.vertices) + int(number) for number in seam]


def tied_rods() -> tuple[pd.Scene, list[int], list[int]]:
    one, other = rod((-0.2, 0.0, 0.0), (0.0, 0.0, 0.0), 8), rod((0.0, 0.0, 0.0), (0.1, 0.1, 0.1), 8)
    tie = pd.Tie(other, [0], one, [[0.0, 0.0, 0.0]], stiffness=1e3)
    return pd.Scene(one, other, tie, pd.Pin(one, [0, 1]), gravity(), pd.Contact(thickness=2e-3)), [8], [9]


def rod_on_a_corner() -> tuple[pd.Scene, list[int], list[int]]:
    base = block(0.1, 2, (0.0, 0.05, 0.0))
    corner = int(np.linalg.norm(base.mesh.vertices - [0.05, 0.1, 0.05], axis=1).argmin())
    place = base.mesh.vertices[corner]
    mast = rod(place, place + [0.02, 0.15, 0.03], 8)
    tie = pd.Tie(mast, [0], base, [place], stiffness=1e3)
    scene = pd.Scene(base, mast, tie, pd.Ground(), gravity(), pd.Contact(thickness=THICKNESS))
    return scene, [corner], [len(base.mesh.vertices)]


@pytest.mark.parametrize("make", [sewn_sheets, tied_rods, rod_on_a_corner])
def test_a_tie_stays_closed(make: Callable[[], tuple[pd.Scene, list[int], list[int]]]) -> None:
    """Within a tenth of the thickness, and no pair has a force."""
    scene, one, other = make()
    sim = simulator(scene, 64)
    state = sim.rest_state()
    for _ in range(10):
        state = sim(state)
    assert float((state.positions[0, one] - state.positions[0, other]).norm(dim=-1).max()) < 0.1 * THICKNESS
    assert not state.history.forces.any()  # type: ignore[attr-defined]
    assert torch.isfinite(state.velocities).all()
