"""Pictures of free-form patches by rays: depth, normals, patch numbers and shaded colours, with gradients.

A pixel shows the hit of the ray through its centre. Gradients are those of the hit, for the quadrics, the pose and the
base (see `PatchRays.cast`). A switch of a pixel to the background or to another part of the surface is a jump without
gradient. Outlines alone therefore do not move the surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..common.reprs import by_sizes
from ..viewing.render import Camera
from .rays import SurfaceRays
from .surface import PatchPose, PatchSurface

__all__ = ["PatchImage", "render_patches"]

Color = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class PatchImage:
    """B pictures of H x W pixels. Background pixels: no hit, infinite depth, zero normal, patch -1."""

    hit: Tensor  # bool [B, H, W]
    depth: Tensor  # [B, H, W] m along the ray
    normals: Tensor  # [B, H, W, 3] unit, outwards
    patch: Tensor  # int32 [B, H, W]
    barycentrics: Tensor  # [B, H, W, 3]
    points: Tensor  # [B, H, W, 3] m
    color: Tensor  # [B, H, W, 3] linear RGB

    def __repr__(self) -> str:
        return by_sizes(self, self.color, "batch", "height", "width")


def render_patches(
    rays: SurfaceRays,
    camera: Camera,
    size: tuple[int, int],
    pose: PatchPose | None = None,
    *,
    patches: PatchSurface | None = None,
    color: Color = (0.75, 0.75, 0.75),
    background: Color = (1.0, 1.0, 1.0),
    light: Color | None = None,
    ambient: float = 0.2,
) -> PatchImage:
    """Render the surface in B poses, each from the same camera.

    Shading is Lambert's, for the visible side of the surface: color (ambient + (1 - ambient) [n . l]_+).

    Args:
        rays: rays of the surface.
        camera: pinhole, see `torchpd.viewing.render.Camera`.
        size: width and height in pixels.
        pose: of B environments; default at rest, B = 1.
        patches: as for `PatchRays.cast`.
        color: reflectance, linear RGB in 0..1.
        background: linear RGB.
        light: direction towards a distant light; default: from the camera.
        ambient: fraction of the light that comes from all directions, in 0..1.
    """
    _check_kinds(camera, size)
    width, height = size
    if min(width, height) < 1:
        raise ValueError(f"render: size must be at least 1 x 1 pixel, got {width} x {height}")
    if not 0.0 <= ambient <= 1.0:
        raise ValueError(f"render: ambient must lie in 0..1, got {ambient}")
    like = rays.patches.vertices
    directions = torch.as_tensor(camera.rays(size)).to(like).reshape(-1, 3)
    origin = torch.tensor(camera.origin).to(like)
    hits = rays.cast(origin.expand_as(directions), directions, pose, patches=patches)
    facing = _dot(hits.normals, directions)
    if light is None:
        lit = facing.abs()
    else:
        towards = torch.nn.functional.normalize(like.new_tensor(light), dim=0)
        lit = (torch.where(facing > 0.0, -1.0, 1.0) * _dot(hits.normals, towards)).clamp_min(0.0)
    share = torch.where(hits.hit, ambient + (1.0 - ambient) * lit, 0.0)
    behind = (~hits.hit)[..., None] * like.new_tensor(background)
    shown = torch.addcmul(behind, share[..., None], like.new_tensor(color))
    shape = (-1, height, width)
    flat = (hits.hit, hits.depth, hits.normals, hits.patch, hits.barycentrics, hits.points, shown)
    return PatchImage(*(t.reshape(*shape, *t.shape[2:]) for t in flat))


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Dot product by components: a sum over a dimension of three is slow."""
    (x, y, z), (u, v, w) = a.unbind(-1), b.unbind(-1)
    return x * u + y * v + z * w


def _check_kinds(camera: Any, size: Any) -> None:
    if not isinstance(camera, Camera):
        raise TypeError(f"render: camera must be a torchpd.viewing.render.Camera, got {type(camera).__name__}")
    if not isinstance(size, (tuple, list)) or [type(n) for n in size] != [int, int]:
        raise TypeError(f"render: size must be two whole numbers, width and height in pixels, got {size!r}")
