"""Quadrics of the published field that a pose carries along."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from patch_cases import F64, ball, central, patches_on, sheet, tumbled
from torch import Tensor

import torchpd as pd


def bumps(patches: pd.FreeFormPatches, W: Tensor, x: Tensor) -> Tensor:
    """R_i(x) of every quadric, [B, S, Q]."""
    h = torch.cat([x, torch.ones_like(x[..., :1])], dim=-1)
    q = torch.einsum("bsi,bqij,bsj->bsq", h, W, h)
    return patches.quadrics.amplitudes * q.clamp_min(0.0) ** 3


@pytest.mark.parametrize("mode", ["transport", "rotation"])
def test_at_rest_nothing_moves(mode: str, device: torch.device, dtype: torch.dtype) -> None:
    patches = patches_on(device=device, dtype=dtype)
    transport = central(patches, mode=mode)
    W = pd.QuadricTransport(transport, patches)(transport.rest_positions[None])
    want = patches.quadrics.normalized_matrices()
    # the numbers of W are below 20, the condition of the tetrahedra below 10
    assert float((W[0] - want).abs().max()) <= 20 * 20 * 10 * torch.finfo(dtype).eps


@pytest.mark.parametrize("mesh", [ball(), sheet()], ids=["ball", "sheet"])
def test_affine_motion_carries_quadrics(mesh: pd.TriMesh, device: torch.device, dtype: torch.dtype) -> None:
    """R'(G x + t) = R(x) wherever x is, while no singular value is clamped."""
    patches = patches_on(mesh, device=device, dtype=dtype)
    transport = central(patches)
    rng = np.random.default_rng(1)
    motions = np.linalg.qr(rng.standard_normal((3, 3, 3)))[0]
    motions = motions * np.sign(np.linalg.det(motions))[:, None, None] * rng.uniform(0.6, 1.8, (3, 1, 3))
    G, t = (torch.tensor(a).to(patches.vertices) for a in (motions, rng.standard_normal((3, 1, 3))))
    x = torch.tensor(rng.uniform(-1.2, 1.2, (200, 3))).to(patches.vertices)
    W = pd.QuadricTransport(transport, patches)(transport.rest_positions @ G.mT + t)
    rest = bumps(patches, patches.quadrics.normalized_matrices()[None], x[None])
    assert float((rest != 0).double().mean()) > 0.005
    limit = 0.03 * 3000 * torch.finfo(dtype).eps  # heights to 0.03 m; slopes and conditions multiply up
    assert float((bumps(patches, W, x @ G.mT + t) - rest).abs().max()) <= limit


def test_a_quadric_between_two_patches_goes_by_the_mean() -> None:
    """Two triangles mirror each other at x = 0, the quadric's plane of symmetry: each has half of the weight."""
    mesh = pd.TriMesh([[0.0, -1, 0], [0, 1, 0], [1, 0, 0], [-1, 0, 0]], [[0, 2, 1], [0, 1, 3]])
    quadric = pd.Quadrics.from_radii(*(torch.tensor(a, dtype=F64) for a in ([0.1], [[0.0, 0, 0]], [0.5])))
    patches = pd.FreeFormPatches.from_mesh(mesh, quadric, dtype=F64)
    apexes = torch.tensor([[0.3, 0, -1], [-0.3, 0, -1]], dtype=F64)
    transport = pd.PatchTransport(patches, apexes)
    rule = pd.QuadricTransport(transport, patches)
    assert rule.weights.tolist() == pytest.approx([0.5, 0.5], abs=1e-15)
    positions = transport.rest_positions + 0.1 * torch.tensor(np.random.default_rng(0).standard_normal((6, 3)))
    G = transport.gradients(positions[None])[0]
    first = patches.triangles[:, 0].long()
    maps = [positions[first[p]] - G[p] @ patches.vertices[first[p]] for p in range(2)]
    A, c = G.mean(0), (maps[0] + maps[1]) / 2
    T = torch.eye(4, dtype=F64)
    T[:3, :3], T[:3, 3] = A, c
    back = torch.linalg.inv(T)
    want = back.T @ quadric.normalized_matrices()[0] @ back
    torch.testing.assert_close(rule(positions[None])[0, 0], want, rtol=0, atol=1e-13)


def test_weights_are_integrals_of_the_bump() -> None:
    """Beside sums over 400 x 400 points of a square, of which each triangle has a half."""
    mesh = pd.TriMesh([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    quadric = pd.Quadrics.from_radii(*(torch.tensor(a, dtype=F64) for a in ([0.1], [[0.6, 0.4, 0.1]], [0.5])))
    patches = pd.FreeFormPatches.from_mesh(mesh, quadric, dtype=F64)
    apexes = torch.tensor([[0.5, 0.5, -1]], dtype=F64)
    transport = pd.PatchTransport(patches, apexes, torch.zeros(2, dtype=torch.int64))
    y, x = torch.meshgrid(*2 * [(torch.arange(400, dtype=F64) + 0.5) / 400], indexing="ij")
    bump = (quadric.values(torch.stack([x, y, torch.zeros_like(x)], dim=-1)) / 0.1)[..., 0]
    lower, upper = (bump * (y < x)).sum(), (bump * (y > x)).sum()  # the diagonal is of neither
    found = pd.QuadricTransport(transport, patches).weights
    assert float(lower / (lower + upper)) > 0.8
    torch.testing.assert_close(found, torch.stack([lower, upper]) / (lower + upper), rtol=0, atol=0.01)


def test_turned_field_is_hit_where_it_was(device: torch.device) -> None:
    """A turn of body and rays together leaves the distances as they were."""
    patches = patches_on(device=device)
    patches = pd.FreeFormPatches(
        patches.vertices, patches.triangles, patches.quadrics, directors=patches.directors, thickness=0.02
    )
    transport = central(patches)
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.4, 0.2], [0.4, 0.0, 0.7], [-0.2, -0.7, 0.0]], dtype=F64))
    turn, shift = turn.to(device), torch.tensor([0.5, -1.0, 2.0], dtype=F64, device=device)
    positions = transport.rest_positions @ turn.mT + shift
    W = pd.QuadricTransport(transport, patches)(positions[None])
    rng = np.random.default_rng(2)
    o, at = (torch.tensor(a, device=device) for a in (3 * rng.standard_normal((500, 3)), rng.uniform(-1, 1, (500, 3))))
    rays = pd.PatchRays(patches)
    rest, _ = rays.cast_field(o, at - o, far=5.0)
    posed, _ = rays.cast_field(
        o @ turn.mT + shift, (at - o) @ turn.mT, far=5.0, positions=positions[None, : len(patches.vertices)], matrices=W
    )
    assert torch.equal(rest.isfinite(), posed.isfinite())
    hit = rest.isfinite()
    assert float(hit.double().mean()) > 0.3
    assert float((rest - posed)[hit].abs().max()) < 1e-9


@pytest.mark.parametrize("apex", ["skeleton", "prism"])
def test_of_a_body(apex: str) -> None:
    """A body that has moved as a whole carries its quadrics with it."""
    mesh = ball() if apex == "skeleton" else sheet()
    patches = patches_on(mesh)
    options = {} if apex == "skeleton" else {"thickness": 0.1}
    body = pd.PatchBody(patches, 1e4, 1000.0, apex=apex, **options)  # type: ignore[arg-type]
    rest = torch.tensor(body.mesh.vertices)[None]
    rule = pd.QuadricTransport(body.transport, patches)
    shift = torch.tensor([1.0, -2.0, 0.5], dtype=F64)
    x = torch.tensor(np.random.default_rng(5).uniform(-1, 1, (100, 3)))
    found = bumps(patches, rule(body.points(rest + shift)), (x + shift)[None])
    want = bumps(patches, patches.quadrics.normalized_matrices()[None], x[None])
    assert float((found - want).abs().max()) < 1e-12


def test_gradients() -> None:
    patches = patches_on(count=4)
    transport = central(patches)
    q = patches.quadrics
    x = torch.tensor(np.random.default_rng(3).uniform(-1, 1, (5, 3)))[None]

    def value(positions: Tensor, centres: Tensor, factors: Tensor) -> Tensor:
        moved = patches.with_quadrics(pd.Quadrics(q.amplitudes, centres, factors), keep_lists=True)
        rule = pd.QuadricTransport(transport, moved)
        rule.weights = weights  # constants
        return bumps(patches, rule(positions), x)

    weights = pd.QuadricTransport(transport, patches).weights
    inputs = [tumbled(transport, 1), q.centres.clone(), q.factors.clone()]
    assert torch.autograd.gradcheck(value, [t.requires_grad_() for t in inputs])


def test_quadrics_that_touch_nothing_and_none_at_all() -> None:
    """One far from all patches goes by the motion of the nearest."""
    far = pd.Quadrics.from_radii(*(torch.tensor(a, dtype=F64) for a in ([0.1], [[9.0, 0.5, 0.2]], [0.2])))
    patches = pd.FreeFormPatches.from_mesh(ball(), far, dtype=F64)
    transport = central(patches)
    rule = pd.QuadricTransport(transport, patches)
    middles = patches.vertices[patches.triangles.long()].mean(1)
    nearest = int((middles - far.centres).norm(dim=1).argmin())
    positions = transport.rest_positions.clone()
    positions[patches.triangles[nearest].long()] *= 1.1
    G = transport.gradients(positions[None])[0, nearest]
    corner = int(patches.triangles[nearest, 0])
    T = torch.eye(4, dtype=F64)
    T[:3, :3] = G
    T[:3, 3] = positions[corner] - G @ patches.vertices[corner]
    back = torch.linalg.inv(T)
    want = back.T @ far.normalized_matrices()[0] @ back
    torch.testing.assert_close(rule(positions[None])[0, 0], want, rtol=0, atol=1e-9)  # numbers up to 2000
    bare = patches.with_quadrics(pd.Quadrics.none(F64))
    assert pd.QuadricTransport(transport, bare)(transport.rest_positions[None]).shape == (1, 0, 4, 4)


def test_patches_that_turn_to_opposite_sides_leave_a_finite_quadric() -> None:
    """Two patches that turn by a quarter, one against the other: their mean is flat, and clamped."""
    mesh = pd.TriMesh([[0.0, -1, 0], [0, 1, 0], [1, 0, 0], [-1, 0, 0]], [[0, 2, 1], [0, 1, 3]])
    quadric = pd.Quadrics.from_radii(*(torch.tensor(a, dtype=F64) for a in ([0.1], [[0.0, 0, 0]], [0.5])))
    patches = pd.FreeFormPatches.from_mesh(mesh, quadric, dtype=F64)
    transport = pd.PatchTransport(patches, torch.tensor([[0.3, 0, -1], [-0.3, 0, -1]], dtype=F64))
    positions = transport.rest_positions.clone()
    positions[2], positions[4] = torch.tensor([0.0, 0, 1]), torch.tensor([1.0, 0, 0.3])
    positions[3], positions[5] = torch.tensor([0.0, 0, 1]), torch.tensor([-1.0, 0, 0.3])
    mean = transport.gradients(positions[None])[0].mean(0)
    assert float(torch.linalg.svdvals(mean)[-1]) < 0.2
    W = pd.QuadricTransport(transport, patches)(positions[None])[0, 0]
    # W = -M^T M there: radii of 0.5 m times singular values within the bounds of the transport
    radii = torch.linalg.eigvalsh(-W[:3, :3]).rsqrt()
    assert 0.3 - 1e-9 <= float(radii.min()) / 0.5 <= float(radii.max()) / 0.5 <= 3.0 + 1e-9


def test_patches_of_another_kind_are_refused() -> None:
    patches = patches_on(ball())
    transport = central(patches)
    want = "must have the rest vertices and triangles of the transport"
    with pytest.raises(ValueError, match=want):
        pd.QuadricTransport(transport, patches_on(ball(2)))
    with pytest.raises(ValueError, match=want):
        pd.QuadricTransport(transport, patches.with_shape(2 * patches.vertices, patches.directors))
    with pytest.raises(TypeError, match=r"patches are torch\.float32 .*transport torch\.float64"):
        pd.QuadricTransport(transport, patches.to(dtype=torch.float32))
    with pytest.raises(TypeError, match=r"transport .*got FreeFormPatches"):
        pd.QuadricTransport(patches, transport)  # type: ignore[arg-type]
    rule = pd.QuadricTransport(transport, patches)
    transport.float()
    with pytest.raises(TypeError, match=r"make both, and this, of patches\.to"):
        rule(transport.rest_positions[None])
