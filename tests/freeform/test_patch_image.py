"""Pictures of free-form patches: where things appear, their shading, gradients of image losses, refusals."""

from __future__ import annotations

import math

import pytest
import torch
from patch_cases import F64, ball, central, lump, patches_on, triangle, tumbled

import torchpd as pd
from torchpd.viewing.render import Camera

CAMERA = Camera((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), 40.0)
SIZE = (24, 16)  # width, height


def test_pixels_show_what_their_rays_hit(dtype: torch.dtype, device: torch.device) -> None:
    patches = patches_on(dtype=dtype, device=device)
    transport = central(patches)
    pose = transport(tumbled(transport, 2, 0.02) * 0.7)
    rays = pd.PatchRays(patches)
    image = rays.render(CAMERA, SIZE, pose)
    assert image.depth.shape == (2, 16, 24)
    assert image.color.shape == image.points.shape == image.normals.shape == (2, 16, 24, 3)
    directions = torch.tensor(CAMERA.rays(SIZE)).to(patches.vertices)
    origin = patches.vertices.new_tensor(CAMERA.origin)
    for x, y in ((12, 8), (3, 2), (15, 10)):
        hits = rays.cast(origin[None], directions[y, x][None], pose)
        assert torch.equal(hits.depth[:, 0], image.depth[:, y, x])
        assert torch.equal(hits.patch[:, 0], image.patch[:, y, x])
    assert 20 < int(image.hit.sum()) < 2 * 16 * 24
    assert torch.equal(image.hit, image.patch >= 0)
    assert torch.equal(image.hit, image.depth.isfinite())
    assert (image.color[~image.hit] == 1.0).all()


def test_shading_of_a_plane(device: torch.device) -> None:
    """color (ambient + (1 - ambient) cos), from either side; the background is as told."""
    patches = pd.FreeFormPatches.from_mesh(triangle(), dtype=F64).to(device)
    tilt = math.radians(35.0)
    options = {"color": (0.5, 0.6, 0.7), "background": (0.0, 0.2, 0.1), "ambient": 0.3}
    for side in (1.0, -1.0):
        camera = Camera((0.3, 0.3, side * 4.0), (0.3, 0.3, 0.0), 20.0)
        light = (math.sin(tilt), 0.0, side * math.cos(tilt))
        image = pd.PatchRays(patches).render(camera, (9, 9), light=light, **options)
        expected = (0.3 + 0.7 * math.cos(tilt)) * torch.tensor([0.5, 0.6, 0.7], dtype=F64)
        assert float((image.color[image.hit].cpu() - expected).abs().max()) < 1e-14
        assert (image.color[~image.hit].cpu() == torch.tensor([0.0, 0.2, 0.1], dtype=F64)).all()
        behind = pd.PatchRays(patches).render(camera, (9, 9), light=(0.0, 0.0, -side), **options)
        assert (
            float((behind.color[behind.hit].cpu() - 0.3 * torch.tensor([0.5, 0.6, 0.7], dtype=F64)).abs().max()) < 1e-14
        )


def test_gradient_of_an_image_loss(device: torch.device) -> None:
    """For quadrics and the pose, against central differences of the picture, over pixels that stay on the surface."""
    patches = patches_on(ball(), ("phong", "base"), device=device)
    transport = central(patches)
    positions = tumbled(transport, 1, 0.02) - tumbled(transport, 1, 0.02).mean(1, keepdim=True)
    rays, q = pd.PatchRays(patches), patches.quadrics
    weights = torch.randn((1, 16, 24, 3), generator=torch.Generator().manual_seed(0), dtype=F64).to(device)
    with torch.no_grad():
        normals = rays.render(CAMERA, SIZE, transport(positions))
    facing = (normals.normals * weights.new_tensor([0.0, 0.0, 1.0])).sum(-1) > 0.5  # far from the outline
    assert int(facing.sum()) > 20

    def loss(a: torch.Tensor, c: torch.Tensor, m: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        shaped = patches.with_quadrics(pd.Quadrics(a, c, m), keep_lists=True)
        image = rays.render(CAMERA, SIZE, transport(x), patches=shaped, light=(0.3, 0.5, 1.0))
        return ((image.color + image.points + image.depth[..., None]) * weights)[facing].sum()

    leaves = [t.detach().clone().requires_grad_() for t in (q.amplitudes, q.centres, q.factors, positions)]
    gradients = torch.autograd.grad(loss(*leaves), leaves)
    generator = torch.Generator().manual_seed(1)
    for leaf, gradient in zip(leaves, gradients, strict=True):
        way = torch.randn(leaf.shape, generator=generator, dtype=F64).to(device)
        moved = [[t + sign * 1e-6 * way if t is leaf else t for t in leaves] for sign in (1, -1)]
        with torch.no_grad():
            slope = float(loss(*moved[0]) - loss(*moved[1])) / 2e-6
        # eps / step = 2e-10 of a loss of order 1e2, and the second order of the step
        assert float((gradient * way).sum()) == pytest.approx(slope, rel=1e-6, abs=1e-6)


def test_descent_finds_the_height_of_a_bump(device: torch.device) -> None:
    """From a flat triangle, by depth alone: least squares in one number, which Newton's method solves."""
    truth = pd.FreeFormPatches.from_mesh(triangle(), lump(), dtype=F64).to(device)
    rays, q = pd.PatchRays(truth), truth.quadrics
    camera = Camera((0.25, 0.25, 3.0), (0.25, 0.25, 0.0), 12.0)
    seen = rays.render(camera, (12, 12))
    height = torch.zeros(1, dtype=F64, device=device).requires_grad_()
    errors = []
    for _ in range(60):
        guess = truth.with_quadrics(pd.Quadrics(height, q.centres, q.factors), keep_lists=True)
        image = rays.render(camera, (12, 12), patches=guess)
        both = image.hit & seen.hit
        loss = (image.depth - seen.depth)[both].square().mean()
        (slope,) = torch.autograd.grad(loss, [height])
        errors.append(abs(float(height.detach()) - 0.2))
        with torch.no_grad():
            height -= 2.0 * slope
    assert errors[-1] < 1e-3 * errors[0]


def test_refusals() -> None:
    rays = pd.PatchRays(patches_on())
    with pytest.raises(ValueError, match=r"size .*got 0 x 4"):
        rays.render(CAMERA, (0, 4))
    with pytest.raises(ValueError, match=r"ambient .*got 1\.5"):
        rays.render(CAMERA, (4, 4), ambient=1.5)
