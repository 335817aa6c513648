"""Rays on free-form patches that collapse, are not finite, lie far away, or are not there at all."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from patch_cases import F64, ball, central, level_sheet, patches_on, quadrics_on, towards_ball, triangle

import torchpd as pd


@pytest.mark.parametrize("exhaustive", [False, True])
@pytest.mark.parametrize("reading", ["clip", "literal"])
def test_patches_without_a_plane_are_not_met(
    reading: str, exhaustive: bool, dtype: torch.dtype, device: torch.device
) -> None:
    """The highest patches of a ball collapse, or are not finite; rays from below and past them do not notice."""
    mesh = ball()
    patches = pd.FreeFormPatches.from_mesh(mesh, quadrics_on(mesh, 30), dtype=F64, thickness=0.02)
    patches = patches.to(device=device, dtype=dtype)
    top = int(patches.vertices[:, 2].argmax())
    beside = next(int(v) for t in patches.triangles.tolist() if top in t for v in t if v != top)
    bad = patches.vertices.expand(3, -1, -1).clone()
    bad[0, top], bad[1, top], bad[2, top] = bad[0, beside], math.nan, math.inf
    below = np.column_stack([np.random.default_rng(0).uniform(-0.6, 0.6, (50, 2)), np.full(50, -5.0)])
    past = np.array([[5.0, 5.0, 5.0], [0.1, 3.0, 5.0]])
    o = torch.tensor(np.concatenate([below, past])).to(patches.vertices)
    d = torch.tensor([[0.0, 0.0, 1.0]]).to(o).repeat(52, 1)
    d[-1] = -d[-1]
    rays = pd.PatchRays(patches)
    want, number = rays.cast_field(o, d, far=4.5, reading=reading, exhaustive=exhaustive)
    assert float(want[0, :50].isfinite().double().mean()) > 0.3
    assert not bool(want[0, 50:].isfinite().any())
    found, numbers = rays.cast_field(o, d, far=4.5, reading=reading, exhaustive=exhaustive, positions=bad)
    assert torch.equal(found, want.expand(3, -1))
    assert torch.equal(numbers, number.expand(3, -1))


def test_a_pose_that_is_not_finite_leaves_the_others_alone(dtype: torch.dtype, device: torch.device) -> None:
    patches = patches_on(dtype=dtype, device=device)
    rays, transport = pd.PatchRays(patches), central(patches)
    positions = transport.rest_positions.expand(3, -1, -1).clone()
    positions[1], positions[2] = math.nan, math.inf
    o, d = (t.to(patches.vertices) for t in towards_ball(500))
    depth, patch, b = rays.search(o, d, transport(positions))
    alone = rays.search(o, d, transport(positions[:1]))
    assert all(torch.equal(found[:1], want) for found, want in zip((depth, patch, b), alone, strict=True))
    assert bool(depth[1:].isinf().all())
    assert bool((patch[1:] == -1).all())


@pytest.mark.parametrize(("poses", "count"), [(0, 5), (1, 0), (0, 0)])
def test_no_poses_and_no_rays(poses: int, count: int, dtype: torch.dtype, device: torch.device) -> None:
    patches = patches_on(dtype=dtype, device=device)
    o, d = (t.to(patches.vertices) for t in towards_ball(count))
    transport = central(patches)
    pose = transport(transport.rest_positions.expand(poses, -1, -1))
    hits = pd.PatchRays(patches).cast(o, d, pose)
    assert hits.depth.shape == hits.patch.shape == (poses, count)
    assert hits.points.shape == hits.normals.shape == hits.barycentrics.shape == (poses, count, 3)


def test_a_quadric_that_is_not_finite_spoils_only_what_it_reaches(dtype: torch.dtype, device: torch.device) -> None:
    """Two bumps on one patch, and a ray at each and at none: the height over the sound one is its amplitude, 0.1."""
    at = torch.tensor([[0.15, 0.15, 0.0], [0.6, 0.2, 0.0]], dtype=F64)
    tenth = torch.tensor([0.1, 0.1], dtype=F64)
    up = torch.tensor([[0.0, 0.0, 1.0]], dtype=F64).expand(3, 3)
    patches = pd.FreeFormPatches.from_mesh(
        triangle(), pd.Quadrics.from_radii(tenth, at, tenth), dtype=F64, directors=up
    ).to(device=device, dtype=dtype)
    rays = pd.PatchRays(patches)
    with torch.no_grad():
        patches.quadrics.amplitudes[1] = math.nan
    o = torch.tensor([[0.15, 0.15, 1.0], [0.15, 0.5, 1.0], [0.6, 0.2, 1.0]]).to(patches.vertices)
    depth, patch, _ = rays.search(o, torch.tensor([[0.0, 0.0, -1.0]]).to(o).expand(3, 3))
    torch.testing.assert_close(depth[0, :2], o.new_tensor([0.9, 1.0]))
    assert patch[0].tolist() == [0, 0, -1]


@pytest.mark.parametrize("far", [0.0, 10.0, 1e3])
def test_no_gap_along_edges_far_from_the_origin(far: float, dtype: torch.dtype, device: torch.device) -> None:
    """Rays at the inner edges of a flat sheet of 2 m: rounding moves them to either side, and one of the two is hit."""
    mesh = level_sheet()
    vertices = mesh.vertices + [far, far, 0.0]
    none = pd.Quadrics(torch.zeros(0, dtype=F64), torch.zeros(0, 3, dtype=F64), torch.zeros(0, 6, dtype=F64))
    patches = pd.FreeFormPatches.from_mesh(pd.TriMesh(vertices, mesh.triangles), none, dtype=F64)
    rng = np.random.default_rng(0)
    corner = vertices[mesh.triangles[rng.integers(0, len(mesh.triangles), 4000)]]
    share = rng.random((4000, 1))
    at = corner[:, 0] * share + corner[:, 1] * (1.0 - share)
    at = at[(np.abs(at[:, :2] - far) < 0.99).all(axis=1)]
    d = np.column_stack([rng.uniform(-0.5, 0.5, (len(at), 2)), -np.ones(len(at))])
    patches = patches.to(device=device, dtype=dtype)
    depth, _, _ = pd.PatchRays(patches).search(*(torch.tensor(a).to(patches.vertices) for a in (at - d, d)))
    assert bool(depth.isfinite().all())


@pytest.mark.parametrize("length", [1e-30, 1e-20, 1e20, 1e30])
def test_directions_of_any_length(length: float, dtype: torch.dtype, device: torch.device) -> None:
    patches = patches_on(dtype=dtype, device=device)
    o, d = (t.to(patches.vertices) for t in towards_ball(200))
    want, found = pd.PatchRays(patches).search(o, d)[0], pd.PatchRays(patches).search(o, length * d)[0]
    assert torch.equal(found.isfinite(), want.isfinite())
    hit = want.isfinite()
    assert float((found - want)[hit].abs().max()) < 100 * torch.finfo(dtype).eps * 4.0
