"""Gaps and creases between free-form patches: known angles, and none where the surface is smooth."""

from __future__ import annotations

import math

import pytest
import torch
import trimesh
from patch_cases import F64, ball, patches_on, sheet, triangle

import torchpd as pd
from torchpd.freeform.continuity import PatchContinuity, measure_continuity


def test_creases_of_a_cube_and_its_diagonals() -> None:
    cube = pd.FreeFormPatches.from_mesh(pd.TriMesh.from_trimesh(trimesh.creation.box()), dtype=F64)
    # 12 edges of 90 degrees and 6 diagonals of 0
    assert measure_continuity(cube) == pytest.approx((0.0, 60.0, 90.0), abs=1e-12)


def test_a_quadric_across_an_edge_leaves_a_plane_smooth() -> None:
    surface = sheet()
    flat = pd.TriMesh(surface.vertices * [1.0, 1.0, 0.0], surface.triangles)
    continuity = measure_continuity(patches_on(flat))
    assert continuity.gap == 0.0
    assert continuity.largest_angle < 1e-5  # an angle of acos or atan2 from rounding of 1e-16 in 1e-1


def test_a_similarity_keeps_creases() -> None:
    patches = patches_on(ball())
    pose = pd.PatchPose(patches.vertices[None] * 2.0, 2.0 * torch.eye(3, dtype=F64).expand(1, 42, 3, 3))
    rest, posed = measure_continuity(patches), measure_continuity(patches, pose)
    assert rest.gap < 1e-15
    assert posed.gap < 2e-15
    assert posed[1:] == pytest.approx(rest[1:], abs=1e-9)


def test_one_patch_has_no_seam() -> None:
    assert measure_continuity(pd.FreeFormPatches.from_mesh(triangle())) == PatchContinuity(0.0, 0.0, 0.0)


def test_roof() -> None:
    # two squares' halves that meet at 2 atan(1/2) along the ridge
    points = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 1.0, -0.5], [0.5, -1.0, -0.5]]
    roof = pd.FreeFormPatches.from_mesh(pd.TriMesh(points, [[0, 1, 2], [1, 0, 3]]), dtype=F64)
    angle = math.degrees(2.0 * math.atan(0.5))
    assert measure_continuity(roof) == pytest.approx((0.0, angle, angle), abs=1e-12)
