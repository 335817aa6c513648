"""Simplified surfaces keep what patches need: topology, orientation, boundary, shape."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from patch_cases import ball, sheet, torus

import torchpd as pd
from torchpd.freeform.checks import check_surface
from torchpd.geometry.decimate import simplify


def euler(mesh: pd.TriMesh) -> int:
    return int(mesh.to_trimesh().euler_number)


@pytest.mark.parametrize("count", [4, 20, 100])
def test_a_ball_stays_a_ball(count: int) -> None:
    coarse = simplify(ball(3), count)
    assert len(coarse.triangles) == count
    assert euler(coarse) == 2
    assert coarse.volume() > 0.1
    check_surface(torch.tensor(coarse.vertices), torch.tensor(coarse.triangles))


def test_a_torus_keeps_its_hole_and_its_volume() -> None:
    fine = pd.TriMesh.from_trimesh(trimesh.creation.torus(1.0, 0.4, major_sections=48, minor_sections=24))
    coarse = simplify(fine, 300)
    assert euler(coarse) == 0
    # a polygon of n corners has 1 - (2 pi / n)^2 / 6 of the area of its circle; about 150 vertices, 9 of them around
    assert coarse.volume() == pytest.approx(fine.volume(), rel=0.1)
    with pytest.raises(ValueError, match=r"simplify: 4 triangles .*topology .* reached \d+"):
        simplify(torus(), 4)


def test_a_sheet_keeps_its_boundary() -> None:
    fine = sheet(12)
    coarse = simplify(fine, 40)
    assert euler(coarse) == 1
    np.testing.assert_allclose(coarse.bounds[:, :2], fine.bounds[:, :2], atol=2e-3)  # its edge is a wave
    open_edges = coarse.to_trimesh().outline().length
    assert open_edges == pytest.approx(fine.to_trimesh().outline().length, rel=0.02)


def test_flat_parts_cost_nothing() -> None:
    """A finely cut cube becomes twelve triangles again, with its eight corners."""
    cube = trimesh.creation.box((1.0, 1.0, 1.0)).subdivide().subdivide().subdivide()
    coarse = simplify(pd.TriMesh.from_trimesh(cube), 12)
    assert len(coarse.vertices) == 8
    assert coarse.volume() == pytest.approx(1.0, rel=0.05)


def test_it_is_the_same_every_time_and_leaves_the_original_alone() -> None:
    fine = ball(3)
    before = fine.triangles.copy()
    first, second = simplify(fine, 60), simplify(fine, 60)
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.triangles, second.triangles)
    np.testing.assert_array_equal(fine.triangles, before)


def test_what_is_coarse_enough_stays() -> None:
    coarse = simplify(ball(0), 20)
    np.testing.assert_array_equal(coarse.triangles, ball(0).triangles)


def test_the_number_of_triangles() -> None:
    with pytest.raises(ValueError, match=r"simplify: triangles .*got 3"):
        simplify(ball(), 3)
