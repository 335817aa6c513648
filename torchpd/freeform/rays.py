"""Ray casting against free-form patches: first hits of the surface in any pose, or of the published field.

Hits on the surface are differentiable by the implicit function theorem. The search itself is not: one Newton step from
its result carries the derivative and leaves the value unchanged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from ..common.reprs import by_sizes
from ..common.small_matrices import product
from . import ops as patch_ops  # noqa: F401  (registers the ops)
from .quadrics import dimensions, matrix_sets
from .surface import PatchPose, PatchSamples, PatchSurface, SurfacePoints, check_pose
from .tessellation import grid, tessellate, weld

__all__ = ["PatchHits", "SurfaceRays"]

_ops = torch.ops.torchpd
_CHECKS = 4  # segments of the grid on which a cell is compared with its triangle
_FINEST = 32


@dataclass(frozen=True, eq=False)
class PatchHits:
    """Hits of B x R rays. Misses have infinite depth, patch -1, zeros. All but `hit` and `patch` have gradients."""

    hit: Tensor  # bool [B, R]
    depth: Tensor  # [B, R] m along the ray
    patch: Tensor  # int32 [B, R]
    barycentrics: Tensor  # [B, R, 3]
    points: Tensor  # [B, R, 3] m
    normals: Tensor  # [B, R, 3] unit, outwards

    def __repr__(self) -> str:
        return by_sizes(self, self.depth, "batch", "rays", trailing=0)


class SurfaceRays:
    """The search of `PatchRays`, documented there."""

    def __init__(self, patches: PatchSurface, level: int | None = None) -> None:
        if not isinstance(patches, PatchSurface):
            raise TypeError(f"PatchRays: patches must be FreeFormPatches, got {type(patches).__name__}")
        if level is None:
            level = _fine_enough(patches)
        _check_level(level)
        self.patches, self.level = patches, level
        self._samples = tessellate(patches, _CHECKS * level).samples
        device, dtype = patches.vertices.device, patches.vertices.dtype
        cells, weights, places = _cells(patches, level)
        self._cells = torch.as_tensor(cells, dtype=torch.int32, device=device).contiguous()
        order = _tree_order(patches.vertices.detach()[patches.triangles.long()].cpu().double().mean(1).numpy(), 1)
        self._order = torch.as_tensor(order, dtype=torch.int32, device=device)
        self._weights, self._places = (torch.as_tensor(a, dtype=dtype, device=device) for a in (weights, places))

    def cast(
        self,
        origins: Tensor,
        directions: Tensor,
        pose: PatchPose | None = None,
        *,
        patches: PatchSurface | None = None,
        near: float = 0.0,
        far: float = math.inf,
    ) -> PatchHits:
        """The first hit of every ray.

        Gradients flow to quadrics, pose, base, origins and directions. The switch between hit and miss has none, nor
        has the outline of the surface. With gradients, hits are gathered, which waits for the device.

        Args:
            origins: [R, 3], or [B, R, 3] in B poses [m].
            directions: like origins, of any nonzero length.
            pose: of B environments; default at rest, B = 1.
            patches: replace those of the constructor; they must have the same triangles.
            near, far: hits count between these distances along the ray [m].
        """
        surface = self._surface(patches)
        at = _posed(surface, pose)
        found = self._find(origins, directions, at, surface, near, far, shape=True)
        hits = PatchHits(found[1] >= 0, *found)
        q = surface.quadrics
        inputs = (surface.vertices, surface.directors, q.amplitudes, q.centres, q.factors, *at, origins, directions)
        if not (torch.is_grad_enabled() and any(t.requires_grad for t in inputs)):
            return hits
        o, d = (t.expand(len(hits.depth), -1, -1) for t in _rays(origins, directions, surface))
        return _with_gradients(surface, at, hits, o, d)

    @torch.no_grad()
    def search(
        self,
        origins: Tensor,
        directions: Tensor,
        pose: PatchPose | None = None,
        *,
        patches: PatchSurface | None = None,
        near: float = 0.0,
        far: float = math.inf,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Search for hits without gradients and without waiting for the device.

        The only wait is the comparison of triangles, if `patches` have their own.

        Returns:
            Depth [B, R] in m, infinite for a miss; patch int32 [B, R], -1 for a miss; barycentrics [B, R, 3].
        """
        surface = self._surface(patches)
        at = _posed(surface, pose)
        depth, patch, b, _, _ = self._find(origins, directions, at, surface, near, far, shape=False)
        return depth, patch, b

    @torch.no_grad()
    def _find(
        self,
        origins: Tensor,
        directions: Tensor,
        pose: PatchPose,
        surface: PatchSurface,
        near: float,
        far: float,
        *,
        shape: bool,
    ) -> tuple[Tensor, ...]:
        """The result of `search`; with `shape` also the points and normals of the hits."""
        o, d = _batched("origins", origins, surface), _batched("directions", directions, surface)
        q = surface.quadrics
        found: tuple[Tensor, ...] = _ops.patch_surface_rays(
            o, d, self._samples.barycentrics, self._cells, self._weights, self._places, *pose, surface.vertices,
            surface.directors, q.amplitudes, q.centres, q.entries(), [*surface.lists, *self._samples.lists],
            level=self.level, on_surface=surface.measured_at == "surface", phong=surface.base == "phong",
            shape=shape, near=near, far=far,
        )  # fmt: skip
        return found

    def cast_field(
        self,
        origins: Tensor,
        directions: Tensor,
        *,
        far: float,
        near: float = 0.0,
        positions: Tensor | None = None,
        reading: Literal["clip", "literal"] = "clip",
        matrices: Tensor | None = None,
        exhaustive: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """The first point on every ray where `FreeFormPatches.field` is not negative on any patch.

        A ray that starts inside ends at once. The result is exact up to rounding for any quadrics: along a ray the
        field is piecewise polynomial. A tree of boxes finds the patches that a ray may enter. Every ray tries a patch
        with a quadric of positive amplitude that is not an ellipsoid. With zero thickness and no quadrics the solid has
        no inside, and rays pass. No gradients.

        Args:
            origins, directions: as for `cast`.
            far: end of the ray [m], finite.
            near: start of the ray [m].
            positions: vertices [B, V, 3] [m]; default at rest.
            reading, matrices: as for `FreeFormPatches.field`.
            exhaustive: try every patch for every ray; slower, with the same result.

        Returns:
            Depth [B, R] in m, infinite for a miss, and patch int32 [B, R], -1 for a miss.
        """
        surface = self.patches
        if reading not in ("clip", "literal"):
            raise ValueError(f"reading must be one of clip, literal, got {reading!r}")
        o, d = _rays(origins, directions, surface)
        W = surface.quadrics.normalized_matrices() if matrices is None else matrices
        v = surface.vertices[None] if positions is None else positions
        nowhere = surface.samples(torch.empty(0, dtype=torch.int32), surface.vertices[:0])
        arguments = (o, d, v, surface.quadrics.amplitudes, matrix_sets(W))
        depth, patch = _ops.patch_field_rays(
            *(t.detach() for t in arguments), self._order, [*surface.lists, *nowhere.lists],
            thickness=surface.thickness, clip=reading == "clip", near=near, far=far, exhaustive=exhaustive,
        )  # fmt: skip
        return depth, patch

    def _surface(self, patches: PatchSurface | None) -> PatchSurface:
        if patches is None:
            return self.patches
        if not isinstance(patches, PatchSurface):
            raise TypeError(f"PatchRays: patches must be FreeFormPatches, got {type(patches).__name__}")
        mine, theirs = self.patches, patches
        same = theirs.triangles is mine.triangles or (
            theirs.triangles.device == mine.triangles.device and torch.equal(theirs.triangles, mine.triangles)
        )
        if not same or theirs.vertices.dtype != mine.vertices.dtype:
            raise ValueError(
                f"PatchRays: patches must have the triangles of those given at the start, be {mine.vertices.dtype} and "
                f"on {mine.vertices.device}, got {theirs!r} in {theirs.vertices.dtype} on {theirs.vertices.device}"
            )
        return patches


def _check_level(level: Any) -> None:
    if isinstance(level, bool) or not isinstance(level, int) or not 1 <= level <= _FINEST:
        raise ValueError(f"PatchRays: level must be a whole number in 1..{_FINEST}, got {level!r}")


def _batched(name: str, rays: Tensor, surface: PatchSurface) -> Tensor:
    wanted = f"cast: {name} must be a tensor [R, 3], or [B, R, 3] in B poses"
    if dimensions(rays) < 0:
        raise TypeError(f"{wanted}, got {type(rays).__name__}")
    if rays.dim() not in (2, 3) or rays.shape[-1] != 3:
        raise ValueError(f"{wanted}, got {list(rays.shape)}")
    like = surface.vertices
    if rays.dtype != like.dtype or rays.device != like.device:
        raise ValueError(
            f"cast: {name} must be {like.dtype} on {like.device} like the patches, got {rays.dtype} on {rays.device}"
        )
    return rays if rays.dim() == 3 else rays[None]


def _rays(origins: Tensor, directions: Tensor, surface: PatchSurface) -> tuple[Tensor, Tensor]:
    """Add a batch and normalise the directions."""
    o, d = _batched("origins", origins, surface), _batched("directions", directions, surface)
    # first divide by the largest component, whose square alone might overflow
    d = d / d.detach().abs().amax(-1, keepdim=True)
    return o, torch.nn.functional.normalize(d, dim=-1, eps=0.0)


def _posed(surface: PatchSurface, pose: PatchPose | None) -> PatchPose:
    if pose is not None:
        check_pose(pose)
        return pose
    eye = torch.eye(3, dtype=surface.vertices.dtype, device=surface.vertices.device)
    return PatchPose(surface.vertices[None], eye.expand(1, len(surface.vertices), 3, 3))


def _fine_enough(patches: PatchSurface) -> int:
    """Cells no longer than half the radii of quadrics: twice the largest |M_i e| over the edges e of its patches."""
    quadric, patch = patches.lists[2].long(), patches.lists[3].long()
    if len(quadric) == 0:
        return 4
    corners = patches.vertices.detach()[patches.triangles.long()][patch]
    edges = corners - corners.roll(1, dims=1)
    M = patches.quadrics.triangular().detach()[quadric]
    return min(_FINEST, max(4, math.ceil(2.0 * float(product(edges, M.mT).norm(dim=2).max()))))


def _cells(patches: PatchSurface, level: int) -> tuple[Any, Any, Any]:
    """Cells [C, 17], weights [12, 3] and barycentrics [m^2, 9] in the layout of csrc/freeform/rays.h."""
    elements = patches.triangles.cpu().numpy().astype(np.int64)
    steps, triangles = grid(level)
    fine = _CHECKS * level
    number = weld(elements, len(patches.vertices), grid(fine)[0], fine)
    inner = grid(_CHECKS)[0]
    corners = np.eye(3, dtype=np.int64) * _CHECKS
    inner = np.concatenate([corners, inner[inner.max(axis=1) < _CHECKS]])
    # position in the fine grid of every corner and check point of a cell
    place = np.einsum("kc,tcs->tks", inner, steps[triangles])
    row = fine - place[..., 0]
    points = number[:, row * (row + 1) // 2 + place[..., 2]]  # [P, m^2, 15]
    count = len(triangles)
    patch = np.repeat(np.arange(len(elements)), count)
    cells = np.concatenate(
        [points.reshape(-1, 15), patch[:, None], np.tile(np.arange(count), len(elements))[:, None]], axis=1
    )
    b = steps[triangles] / level
    rest = patches.vertices.detach().cpu().double().numpy()[elements]
    centroids = np.einsum("tkc,pcx->ptx", b, rest).reshape(-1, 3) / 3.0
    return cells[_tree_order(centroids, 2)], inner[3:] / _CHECKS, b.reshape(count, 9)


def _tree_order(centroids: Any, per_leaf: int) -> Any:
    """The order of the leaves: halved at the median of the longest extent, recursively.

    The halves are those of the complete tree in csrc/freeform/box_tree.h: leaf l of 2^L starts at l C / 2^L, and each
    has at least `per_leaf` items.
    """
    count = len(centroids)
    order = np.arange(count)
    parts = 1
    while 2 * per_leaf * parts <= count:
        start = np.arange(parts + 1) * count // parts
        part = np.repeat(np.arange(parts), np.diff(start))
        low, high = (f.reduceat(centroids[order], start[:-1], axis=0) for f in (np.minimum, np.maximum))
        along = centroids[order, np.argmax(high - low, axis=1)[part]]
        order = order[np.lexsort((order, along, part))]
        parts *= 2
    return order


def _in_poses(surface: PatchSurface, pose: PatchPose, number: Tensor, where: PatchSamples) -> SurfacePoints:
    """The surface at samples that each have their own pose: all poses side by side as one surface, without a batch."""
    batch, V, P = len(pose.positions), len(surface.vertices), len(surface.triangles)
    if batch * 3 * P >= 2**31:
        raise ValueError(f"cast: poses x patches must stay below 2^31 / 3, got {batch} x {P}")
    step = torch.arange(batch, dtype=torch.int32, device=number.device)[:, None]
    triangles, start, corner = surface.lists[0], surface.lists[6], surface.lists[7]
    zeros, empty = (start.new_zeros(n) for n in (batch * P + 1, 0))
    lists = [
        (triangles[None] + V * step[..., None]).flatten(0, 1), zeros, empty, empty, zeros[:1], empty,
        torch.cat([(start[:-1] + 3 * P * step).flatten(), start.new_full((1,), 3 * P * batch)]),
        (corner + 3 * P * step).flatten(),
    ]  # fmt: skip
    patch = number.to(torch.int32) * P + where.patch
    ordered, order = torch.sort(patch, stable=True)
    begins = torch.searchsorted(ordered, torch.arange(batch * P + 1, dtype=torch.int32, device=patch.device))
    h, slopes = surface.heights(where)
    points, tangents = _ops.patch_surface(
        pose.positions.flatten(0, 1)[None], pose.frames.flatten(0, 1)[None],
        surface.vertices.repeat(batch, 1), surface.directors.repeat(batch, 1), h, slopes, where.barycentrics,
        [*lists, patch, begins.to(torch.int32), order.to(torch.int32)], phong=surface.base == "phong",
    )  # fmt: skip
    normal = torch.linalg.cross(tangents[0, :, 0], tangents[0, :, 1])
    return SurfacePoints(points[0], torch.nn.functional.normalize(normal, dim=-1, eps=0.0), tangents[0])


def _with_gradients(surface: PatchSurface, pose: PatchPose, hits: PatchHits, o: Tensor, d: Tensor) -> PatchHits:
    """The same hits, with gradients by the implicit function theorem."""
    number, ray = hits.hit.nonzero(as_tuple=True)
    where = surface.samples(hits.patch[hits.hit], hits.barycentrics[hits.hit])
    at = _in_poses(surface, pose, number, where)
    # S(b) = o + t d: b and t change by the solution of a linear system whose matrix may be treated as constant
    o, d = o[number, ray], d[number, ray]
    left = at.points - (o + hits.depth[hits.hit][:, None] * d)
    matrix = torch.cat([at.tangents.detach(), -d.detach()[:, None]], dim=1).mT
    moved = -torch.linalg.solve_ex(matrix, left[..., None])[0][..., 0]
    moved = moved - moved.detach()  # zero in value, but with a gradient
    changed = torch.cat([moved[:, :2], -moved[:, :1] - moved[:, 1:2]], dim=1)
    at = _in_poses(surface, pose, number, where.at(where.barycentrics + changed))

    def traced(value: Tensor, change: Tensor) -> Tensor:
        return value.index_put((number, ray), value[number, ray] + (change - change.detach()))

    return PatchHits(
        hits.hit,
        traced(hits.depth, moved[:, 2]),
        hits.patch,
        traced(hits.barycentrics, changed),
        traced(hits.points, at.points),
        traced(hits.normals, at.normals),
    )
