"""Transport of the published field's quadrics by a pose: one affine frame per quadric."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..common.small_matrices import inverse, product
from ..ops.registration import nearest_rotation
from . import ops as patch_ops  # noqa: F401  (registers the ops)
from .adjacency import corner_lists
from .surface import PatchSurface
from .transport import PatchTransport

__all__ = ["QuadricTransport"]

_ops = torch.ops.torchpd
_STEPS = 9  # midpoints along an edge, for the integration of the weights


class QuadricTransport:
    """Carries the quadrics of `FreeFormPatches.field` along, as splats are carried.

    Every patch moves by an affine map, x -> v + G (x - V). A quadric moves by T, the mean of the maps of the patches
    that it touches, weighted by the integral of [Q]_+^3 over each. Its matrix becomes W' = T^-T W T^-1. So a quadric
    stays one quadric, and its field is as smooth in a pose as at rest. An affine motion of vertices and apexes carries
    it exactly while no singular value is clamped. (In `FreeFormPatches.surface` quadrics never move.)

    The weights are computed once from `patches` and stay constant; centres and factors have gradients.

    Args:
        transport: of the same patches: their gradients, clamps and mode.
        patches: at rest.

    Raises:
        ValueError: patches with other vertices or triangles than those of the transport.
    """

    def __init__(self, transport: PatchTransport, patches: PatchSurface) -> None:
        for name, given, want in (("transport", transport, PatchTransport), ("patches", patches, PatchSurface)):
            if not isinstance(given, want):
                raise TypeError(f"QuadricTransport: {name} must be a {want.__name__}, got {type(given).__name__}")
        self.transport, self.patches = transport, patches
        self._check_kind()
        tets, rest = transport.tets, transport.rest_positions[: transport.vertices]
        same = rest.shape == patches.vertices.shape and len(tets) == len(patches.triangles)
        if not same or not (torch.equal(tets[:, :3], patches.triangles) and torch.equal(rest, patches.vertices)):
            raise ValueError(
                "QuadricTransport: patches must have the rest vertices and triangles of the transport "
                f"({transport.vertices} and {len(tets)}), got {len(patches.vertices)} and {len(patches.triangles)} or "
                "others; make the transport of these patches"
            )
        self._patch, self._quadric, self.weights = _shares(patches)
        self._counts = torch.bincount(self._quadric, minlength=len(patches.quadrics))
        count = len(patches.quadrics)
        own = np.arange(4 * count, dtype=np.int64).reshape(count, 4)
        arrays = (own, *corner_lists(own, 4 * count))
        # inputs of the op that clamps, one per quadric
        self._own = [torch.as_tensor(a, dtype=torch.int32, device=tets.device).contiguous() for a in arrays]

    def __call__(self, positions: Tensor, fallback: Tensor | None = None) -> Tensor:
        """Matrices W' [B, Q, 4, 4], for `matrices` of `FreeFormPatches.field` and `PatchRays.cast_field`.

        Args:
            positions: vertices, then apexes, [B, V + K, 3] [m].
            fallback: see `PatchTransport.gradients`.
        """
        self._check_kind()
        patches, q = self.patches, self.patches.quadrics
        first = patches.triangles[:, 0].long()[self._patch]
        G = self.transport.gradients(positions, fallback)[:, self._patch]  # [B, N, 3, 3] of every pair
        offset = q.centres[self._quadric] - patches.vertices[first]
        moved = positions[:, first] + product(G, offset[..., None])[..., 0]
        mean = self._mean(torch.cat([G.flatten(2), moved], dim=2))
        centres = mean[..., 9:]
        back = inverse(self._clamped(mean[..., :9].unflatten(2, (3, 3))))
        # T^-1 maps a point of the pose back to rest: x -> A^-1 (x - c') + c
        back = torch.cat([back, (q.centres - product(back, centres[..., None])[..., 0])[..., None]], dim=3)
        last = back.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*back.shape[:2], 1, 4)
        back = torch.cat([back, last], dim=2)
        return product(product(back.mT, q.normalized_matrices()), back)

    def _mean(self, of_pairs: Tensor) -> Tensor:
        """Weighted means over the pairs of every quadric, [B, N, C] to [B, Q, C], in the order of pairs."""
        batch, _, width = of_pairs.shape
        rows = (self.weights[:, None] * of_pairs).transpose(0, 1).flatten(1).contiguous()
        if len(self._counts) == 0:
            return of_pairs.new_empty((batch, 0, width))
        sums: Tensor = torch.segment_reduce(rows, "sum", lengths=self._counts, axis=0)
        means: Tensor = sums.unflatten(1, (batch, width)).transpose(0, 1)
        return means

    def _check_kind(self) -> None:
        mine, theirs = self.patches.vertices, self.transport.rest_positions
        if mine.dtype != theirs.dtype or mine.device != theirs.device:
            raise TypeError(
                f"QuadricTransport: patches are {mine.dtype} on {mine.device} and the transport {theirs.dtype} on "
                f"{theirs.device}; make both, and this, of patches.to(...)"
            )

    def _clamped(self, mean: Tensor) -> Tensor:
        """Clamp the mean of clamped gradients, which can still be flat where patches rotate apart."""
        if self.transport.mode == "rotation":
            return nearest_rotation(mean)
        corners = torch.cat([torch.zeros_like(mean[..., :1]), mean], dim=3).mT.flatten(1, 2)
        eye = torch.eye(3, dtype=mean.dtype, device=mean.device).repeat(mean.shape[1], 1, 1)
        lower, upper = self.transport.stretch
        clamped: Tensor = _ops.patch_deformation(corners, eye, None, self._own, lower=lower, upper=upper)
        return clamped


@torch.no_grad()
def _shares(patches: PatchSurface) -> tuple[Tensor, Tensor, Tensor]:
    """Patch, quadric and weight of every pair [N], ordered by quadric; the weights of each sum to 1."""
    q = patches.quadrics
    corners = patches.vertices[patches.triangles.long()]
    edges = corners[:, 1:] - corners[:, :1]
    areas = 0.5 * torch.linalg.cross(edges[:, 0], edges[:, 1]).norm(dim=1)
    patch, number = patches.lists[3].long(), patches.lists[2].long()  # of every pair that touches
    # centroids of the cells of a triangle cut into _STEPS x _STEPS
    rows = [((3 * i + 1, 3 * j + 1), (3 * i + 2, 3 * j + 2)) for i in range(_STEPS) for j in range(_STEPS)]
    b = np.array([p for cell in rows for p in cell if sum(p) < 3 * _STEPS]) / (3 * _STEPS)
    places = product(torch.as_tensor(np.column_stack([1.0 - b.sum(1), b])).to(corners), corners[patch])
    y = product(places - q.centres[number][:, None], q.triangular()[number].mT)
    bump = (1.0 - y.square().sum(2)).clamp_min(0.0).pow(3).mean(1) * areas[patch]
    # a quadric that no triangle reaches takes the patches that it touches, else the nearest
    total = torch.zeros_like(q.amplitudes).index_add_(0, number, bump)
    bump = torch.where(total[number] > 0.0, bump, areas[patch])
    lonely = torch.ones_like(q.amplitudes, dtype=torch.bool).index_fill_(0, number, False).nonzero()[:, 0]
    nearest = torch.cdist(q.centres[lonely], corners.mean(1)).argmin(1)
    patch, number = torch.cat([patch, nearest]), torch.cat([number, lonely])
    bump = torch.cat([bump, areas[nearest]])
    order = torch.argsort(number, stable=True)
    patch, number, bump = patch[order], number[order], bump[order]
    total = torch.segment_reduce(bump, "sum", lengths=torch.bincount(number, minlength=len(q))) if len(q) else bump
    return patch, number, bump / total[number]
