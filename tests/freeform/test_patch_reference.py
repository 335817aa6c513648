"""Free-form patches against a float64 reference written from the formulas alone, in both precisions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from patch_cases import F64, KIND_NAMES, KINDS, ball, central, patches_on, samples_on, sheet, tumbled
from torch import Tensor

import torchpd as pd
from torchpd.freeform.reference import PatchReference, clamped_gradient, literal_field, vertex_frames


def array(tensor: Tensor) -> np.ndarray:
    return np.asarray(tensor.detach().cpu().double().numpy())


@pytest.mark.usefixtures("poisoned")
@pytest.mark.parametrize("mesh", [ball(), sheet()], ids=["ball", "sheet"])
@pytest.mark.parametrize("kind", KINDS, ids=KIND_NAMES)
def test_heights_and_points(kind: tuple[str, str], mesh: pd.TriMesh, device: torch.device, dtype: torch.dtype) -> None:
    patches = patches_on(mesh, kind, height=0.02, device=device, dtype=dtype)
    exact = PatchReference(patches)
    where = samples_on(patches, 60)
    transport = central(patches)
    positions = tumbled(transport)
    pose = transport(positions)
    h, _ = patches.heights(where)
    rest, posed = patches.surface(where), patches.surface(where, pose)
    b, numbers = array(where.barycentrics), where.patch.tolist()
    expected = np.array([exact.height(p, c) for p, c in zip(numbers, b, strict=True)])
    assert np.abs(expected).max() > 0.005
    # b sums to one within eps, coordinates are up to 2, M (x - c) loses |M| |x| = 10 roundings, R is 0.02 at most
    limit = 20 * torch.finfo(dtype).eps
    np.testing.assert_allclose(array(h), expected, rtol=0, atol=limit)
    points = np.array([exact.point(p, c) for p, c in zip(numbers, b, strict=True)])
    np.testing.assert_allclose(array(rest.points), points, rtol=0, atol=2 * limit)
    for row in range(len(positions)):
        v, A = array(pose.positions[row]), array(pose.frames[row])
        points = np.array([exact.point(p, c, v, A) for p, c in zip(numbers, b, strict=True)])
        np.testing.assert_allclose(array(posed.points[row]), points, rtol=0, atol=10 * limit)


@pytest.mark.parametrize("mesh", [ball(), sheet()], ids=["ball", "sheet"])
def test_frames(mesh: pd.TriMesh, device: torch.device, dtype: torch.dtype) -> None:
    """Clamped on both sides, inverted ones turned back."""
    patches = patches_on(mesh, device=device, dtype=dtype)
    transport = central(patches, stretch=(0.6, 1.4))
    positions = tumbled(transport, 4, 0.4)
    gradients = transport.gradients(positions)
    tets, rest = transport.tets.cpu().numpy(), array(transport.rest_positions)
    used = []
    for row, x in enumerate(array(positions)):
        Ds = np.swapaxes(x[tets[:, 1:]] - x[tets[:, :1]], 1, 2)
        Dm = np.swapaxes(rest[tets[:, 1:]] - rest[tets[:, :1]], 1, 2)
        G = Ds @ np.linalg.inv(Dm)
        s = np.linalg.svd(G, compute_uv=False)
        used += [s, np.linalg.det(G)]
        expected = np.array([clamped_gradient(g, 0.6, 1.4) for g in G])
        found = array(gradients[row])
        # where the last singular values nearly cancel, or nearly vanish, their directions are ill-defined
        gap = s[:, 1] + np.where(np.linalg.det(G) < 0, -1.0, 1.0) * s[:, 2]
        limit = 200 * torch.finfo(dtype).eps / np.minimum(gap, 1.0)
        assert np.all(np.abs(found - expected).max(axis=(1, 2)) <= limit)
        assert np.all(np.linalg.det(found) > 0)
        frames = vertex_frames(found, patches.triangles.cpu().numpy(), array(patches.vertices))
        np.testing.assert_allclose(
            array(transport.frames(gradients)[row]), frames, rtol=0, atol=20 * torch.finfo(dtype).eps
        )
    assert min(s.min() for s in used[::2]) < 0.6
    assert max(s.max() for s in used[::2]) > 1.4
    assert min(d.min() for d in used[1::2]) < 0.0


@pytest.mark.usefixtures("poisoned")
@pytest.mark.parametrize("reading", ["clip", "literal"])
def test_field(reading: str, device: torch.device, dtype: torch.dtype) -> None:
    """Around each patch, with quadrics of any kind, in three poses that carry them along or not."""
    bare = patches_on(device=device, dtype=dtype)
    patches = pd.FreeFormPatches(bare.vertices, bare.triangles, bare.quadrics, directors=bare.directors, thickness=0.05)
    rng = np.random.default_rng(3)
    patch = torch.tensor(rng.integers(0, len(patches.triangles), 80), device=device)
    corners = patches.vertices[patches.triangles.long()[patch]]
    positions = patches.vertices + 0.05 * torch.tensor(rng.standard_normal((3, *patches.vertices.shape))).to(corners)
    x = corners.mean(1) + 0.1 * torch.tensor(rng.standard_normal((3, 80, 3))).to(corners)
    general = torch.tensor(rng.standard_normal((3, len(patches.quadrics), 4, 4))).to(corners)
    starts, quadric = patches.lists[1].tolist(), patches.lists[2].tolist()
    for W in (None, general[0], general):
        found = patches.field(x, patch, positions=positions, matrices=W, reading=reading)  # type: ignore[arg-type]
        own = patches.quadrics.normalized_matrices() if W is None else W
        matrices = array(own.expand(3, *own.shape[-3:]))
        for row in range(3):
            for s, p in enumerate(patch.tolist()):
                numbers = quadric[starts[p] : starts[p + 1]]
                expected = literal_field(
                    array(x[row, s]),
                    array(positions[row])[patches.triangles[p].tolist()],
                    array(patches.quadrics.amplitudes)[numbers],
                    matrices[row][numbers],
                    thickness=0.05,
                    clip=reading == "clip",
                )
                # general quadrics reach 20 here, their cubes lose 3 * 16 roundings
                size = max(1.0, abs(expected))
                assert abs(float(found[row, s]) - expected) <= 200 * torch.finfo(dtype).eps * size


def test_collapsed_constraints_take_what_stands_in(device: torch.device, dtype: torch.dtype) -> None:
    """A patch shrunk to a line or a point, or that is not finite: the nearest rotation, or the fallback."""
    patches = patches_on(ball(0), dtype=dtype, device=device)
    transport = central(patches)
    rest = transport.rest_positions[None].clone()
    for collapse in ("line", "point", "nan"):
        positions = rest.clone()
        if collapse == "line":
            positions = positions * positions.new_tensor([1.0, 0.0, 0.0])
        if collapse == "point":
            positions[:] = 0.5
        if collapse == "nan":
            positions[0, patches.triangles[0].long()] = float("nan")
        G = transport.gradients(positions)
        fallback = 2.0 * torch.eye(3, dtype=dtype, device=device).expand_as(G).contiguous()
        assert torch.equal(transport.gradients(positions, fallback)[0, 0], fallback[0, 0])
        if collapse == "nan":
            assert bool(G[0, 0].isnan().all())
            continue
        eye = torch.eye(3, dtype=dtype, device=device).expand_as(G)
        torch.testing.assert_close(G.mT @ G, eye, rtol=0, atol=20 * torch.finfo(dtype).eps)
        assert bool((torch.linalg.det(G) > 0).all())
    # and it is not taken anywhere else
    assert torch.equal(transport.gradients(rest, fallback), transport.gradients(rest))


def test_nan_stays_in_its_environment(device: torch.device) -> None:
    patches = patches_on(device=device)
    transport = central(patches)
    positions = tumbled(transport, 3)
    clean = patches.surface(samples_on(patches), transport(positions))
    positions[1, 0] = float("nan")
    spoilt = patches.surface(samples_on(patches), transport(positions))
    assert bool(spoilt.points[1].isnan().any())
    for row in (0, 2):
        assert torch.equal(spoilt.points[row], clean.points[row])
        assert torch.equal(spoilt.normals[row], clean.normals[row])


def test_flattened_and_inverted_surroundings(device: torch.device, dtype: torch.dtype) -> None:
    """Pressed flat, shrunk, blown up or turned inside out: gradients that are none of it, finite points."""
    patches = patches_on(dtype=dtype, device=device)
    transport = central(patches)
    # the last inversion has no nearest rotation: each patch takes one of them, and their mean may be singular
    for scale in ((1.0, 1.0, 0.0), (1e-3, 1e-3, 1e-3), (50.0, 50.0, 50.0), (1.0, 1.0, -0.5), (1.0, 1.0, -1.0)):
        positions = transport.rest_positions[None] * transport.rest_positions.new_tensor(scale)
        gradients = transport.gradients(positions)
        assert bool((torch.linalg.det(gradients) > 0).all())
        stretch = torch.linalg.svdvals(gradients)
        assert float(stretch.min()) >= 0.3 * (1.0 - 1e-5)
        assert float(stretch.max()) <= 3.0 * (1.0 + 1e-5)
        pose = transport(positions)
        assert scale[2] == -1.0 or bool((torch.linalg.det(pose.frames) > 0).all())
        assert bool(patches.surface(samples_on(patches), pose).points.isfinite().all())


def test_precisions_agree() -> None:
    """float32 patches are the float64 ones to float32 rounding: the lists are the same."""
    exact = patches_on(kind=("phong", "surface"))
    rounded = exact.to(torch.float32)
    grid = exact.tessellate(5)
    points = rounded.surface(samples := rounded.tessellate(5).samples).points
    assert len(samples) == len(grid.samples)
    torch.testing.assert_close(points.double(), exact.surface(grid.samples).points, rtol=0, atol=1e-6)
    assert all(torch.equal(a, b) for a, b in zip(exact.lists, rounded.lists, strict=True))
    assert rounded.quadrics.factors.dtype == torch.float32
    assert exact.vertices.dtype == F64
