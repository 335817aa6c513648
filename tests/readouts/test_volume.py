"""Volumes of solids and closed sheets."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from readout_cases import MESH, SIDE
from runs import noise
from sheets import cloth, surface

import torchpd as pd


def closed() -> pd.TriMesh:
    triangles = MESH.boundary()
    return pd.TriMesh(MESH.vertices + 1e3, triangles, drop_unreferenced=True)  # far from the origin


def test_volumes_of_an_affine_motion() -> None:
    """det A times the volume at rest, by tetrahedra and by the divergence theorem; an open sheet has none."""
    solid, shell, sheet = pd.Solid(MESH, 1e5), cloth(closed()), cloth(surface())
    sim = pd.Simulator(pd.Scene(sheet, shell, solid), dtype=torch.float64, progress=False)
    A = torch.eye(3).double() + 0.3 * noise(torch.zeros(3, 3)).double()
    x = torch.stack([sim.rest_positions, sim.rest_positions @ A.T])
    found = sim.volume(pd.State(x, torch.zeros_like(x)))
    assert list(found) == [shell, solid]
    expected = SIDE**3 * torch.stack([torch.ones(()).double(), torch.det(A)])
    torch.testing.assert_close(found[solid], expected, rtol=1e-12, atol=0.0)
    # positions of 1e3 m and edges of 0.1 m
    torch.testing.assert_close(found[shell], expected, rtol=1e-10, atol=0.0)


def test_inward_triangles_have_a_negative_volume() -> None:
    mesh = closed()
    shell = cloth(pd.TriMesh(mesh.vertices, mesh.triangles[:, ::-1]))
    sim = pd.Simulator(pd.Scene(shell), dtype=torch.float64, progress=False)
    assert float(sim.volume(sim.rest_state())[shell]) == pytest.approx(-(SIDE**3), rel=1e-10)


def test_gradients_by_finite_differences() -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    shell = cloth(pd.TriMesh(corners, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]))
    sim = pd.Simulator(pd.Scene(shell, pd.Solid(pd.shapes.single_tet(), 1e5)), dtype=torch.float64, progress=False)
    x = (sim.rest_positions + 0.1 * noise(sim.rest_positions))[None].repeat(2, 1, 1).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: tuple(sim.volume(x).values()), (x,))
