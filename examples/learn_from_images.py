"""Recover the bumps of a posed body from pictures: gradients through rays that hit free-form patches."""

from __future__ import annotations

import argparse
import math

import torch
import trimesh
from PIL import Image

import torchpd as tpd
from torchpd.viewing.render import Camera

VIEWS = 4
CAMERA = Camera((0.0, 0.6, 4.2), (0.0, 0.0, 0.0), 36.0)


def body() -> tuple[tpd.FreeFormPatches, tpd.Quadrics]:
    """A ball of 80 patches, and the bumps and dents of the true pictures."""
    ball = tpd.TriMesh.from_trimesh(trimesh.creation.icosphere(subdivisions=1))
    n = torch.arange(14, dtype=torch.float64)  # evenly distributed on a spiral over the ball
    y, turn = 1 - (2 * n + 1) / 14, math.pi * (3 - math.sqrt(5)) * n
    ring = (1 - y * y).sqrt()
    centres = torch.stack([ring * turn.cos(), y, ring * turn.sin()], dim=1)
    amplitudes = 0.12 * torch.tensor([1.0, -0.8, 0.6, 1.0, -0.5, 0.9, 0.7], dtype=torch.float64).repeat(2)
    quadrics = tpd.Quadrics.from_radii(amplitudes, centres, torch.full((14,), 0.55, dtype=torch.float64))
    return tpd.FreeFormPatches.from_mesh(ball, quadrics, dtype=torch.float64, base="phong"), quadrics


def turned(patches: tpd.FreeFormPatches) -> tpd.PatchPose:
    """The body in front of the camera: stretched, and rotated differently in every view."""
    transport = tpd.PatchTransport(patches, patches.vertices.mean(0, keepdim=True), torch.zeros(80, dtype=torch.int64))
    angles = torch.arange(VIEWS, dtype=torch.float64) * 2 * math.pi / VIEWS
    c, s, zero = angles.cos(), angles.sin(), torch.zeros(VIEWS, dtype=torch.float64)
    rows = [torch.stack(row, 1) for row in ((1.1 * c, zero, s), (zero, 0 * zero + 0.9, zero), (-1.1 * s, zero, c))]
    return transport(transport.rest_positions @ torch.stack(rows, 1).mT)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=80, help="of the optimiser")
    parser.add_argument("--pixels", type=int, default=64, help="pixels per side of a picture")
    parser.add_argument("--out", help="picture file (PNG) with truth, start and end")
    options = parser.parse_args()
    patches, truth = body()
    pose, rays, size = turned(patches), tpd.PatchRays(patches), (options.pixels, options.pixels)

    def look(quadrics: tpd.Quadrics) -> tpd.PatchImage:
        # bumps move to other patches: update the lists
        return rays.render(CAMERA, size, pose, patches=patches.with_quadrics(quadrics), light=(0.6, 1.0, 0.8))

    with torch.no_grad():
        seen = look(truth)
        generator = torch.Generator().manual_seed(1)
        moved = truth.centres + 0.05 * torch.randn(truth.centres.shape, generator=generator, dtype=torch.float64)
    amplitudes = torch.zeros_like(truth.amplitudes).requires_grad_()
    centres = moved.clone().requires_grad_()
    optimiser = torch.optim.Adam([{"params": [amplitudes], "lr": 0.01}, {"params": [centres], "lr": 0.005}])
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, options.steps, eta_min=2e-4)

    print("step    color   depth [mm]  height [mm]  centre [mm]")
    pictures = [seen.color]
    for step in range(options.steps + 1):
        image = look(tpd.Quadrics(amplitudes, centres, truth.factors))
        both = seen.hit & image.hit  # outlines have no gradient
        color = (image.color - seen.color)[both].square().mean()
        depth = (image.depth - seen.depth)[both].square().mean()
        if step in (0, options.steps):
            pictures.append(image.color.detach())
        if step % max(1, options.steps // 10) == 0 or step == options.steps:
            height = 1e3 * float((amplitudes - truth.amplitudes).detach().abs().mean())
            place = 1e3 * float((centres - truth.centres).detach().norm(dim=1).mean())
            errors = (1e3 * float(depth.detach()) ** 0.5, height, place)
            print(f"{step:4d} {float(color.detach()) ** 0.5:8.5f} " + " ".join(f"{error:12.3f}" for error in errors))
        optimiser.zero_grad()
        (color + 10.0 * depth).backward()
        optimiser.step()
        schedule.step()
    if options.out:
        rows = torch.cat([picture.transpose(0, 1).flatten(1, 2) for picture in pictures])
        Image.fromarray((255 * rows.clamp(0, 1) ** (1 / 2.2)).byte().numpy()).save(options.out)


if __name__ == "__main__":
    main()
