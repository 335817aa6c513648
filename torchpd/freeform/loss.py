"""Distance of patches from a target as a differentiable loss, for fits inside training code."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm.auto import tqdm

from ..common.checks import check_scalar, check_whole
from .fit_samples import FitSamples, edge_pairs, mean_edges, sample_target
from .least_squares import QuadricParameters, within_radii
from .quadrics import Quadrics
from .surface import PatchSamples, PatchSurface
from .targets import target_of

__all__ = ["PatchLoss", "descend"]

_RELIST = 20  # iterations between updates of the patches that quadrics touch


class PatchLoss:
    """Error of patches against a target at fixed samples: distances, normals, and creases between patches.

    The loss is mean ((S - S*) . n*)^2 / L^2 + w_n mean |n - n*|^2 + w_e mean |n_left - n_right|^2. S* is the point of
    the target on the director, n* its normal, and L the mean edge of the base [m]. The first two means are over the
    area, the third over samples on edges. Small angles enter squared, in radians. Device and precision are those of the
    patches.

    Args:
        patches: patches whose base has the samples; their quadrics are ignored.
        target: as in `FreeFormPatches.fit`, with `normals` or `bounds` if it needs them.
        level: segments between samples along every edge of a patch.
        normal_weight: w_n, at least 0.
        edge_weight: w_e, at least 0.

    Raises:
        ValueError: as for `FreeFormPatches.fit`, if the target is not a height over the base.
    """

    targets: Tensor  # S* [S, 3]
    target_normals: Tensor  # n* [S, 3]
    areas: Tensor  # [S]

    def __init__(
        self,
        patches: PatchSurface,
        target: Any,
        *,
        level: int = 8,
        normal_weight: float = 1e-3,
        edge_weight: float = 1e-3,
        normals: Any = None,
        bounds: Any = None,
    ) -> None:
        _check_patches(patches)
        level = check_whole("PatchLoss: level", level, minimum=2)
        exact = patches.to(device="cpu", dtype=torch.float64).with_quadrics(Quadrics.none(torch.float64))
        samples = sample_target(exact, target_of(target, normals, bounds), level)
        self._take(patches, samples, level, normal_weight, edge_weight)

    @classmethod
    def from_samples(cls, patches: PatchSurface, samples: FitSamples, level: int) -> PatchLoss:
        """The loss for a sampled target, with the default weights."""
        loss = cls.__new__(cls)
        loss._take(patches, samples, level, 1e-3, 1e-3)
        return loss

    def _take(
        self, patches: PatchSurface, samples: FitSamples, level: int, normal_weight: float, edge_weight: float
    ) -> None:
        self.normal_weight = check_scalar("PatchLoss: normal_weight", normal_weight, minimum=0.0)
        self.edge_weight = check_scalar("PatchLoss: edge_weight", edge_weight, minimum=0.0)
        self._triangles = patches.triangles
        exact = patches.to(device="cpu", dtype=torch.float64)
        self.length = float(mean_edges(exact).mean())
        like = patches.vertices
        points = samples.points + samples.heights[:, None] * samples.directors
        for name, array in (("targets", points), ("target_normals", samples.normals), ("areas", samples.areas)):
            setattr(self, name, torch.tensor(array).to(like))
        patch, coordinates = edge_pairs(patches.triangles.cpu().numpy().astype(np.int64), level)
        self.places = _moved(patches, samples.places.patch, samples.places.barycentrics)
        self.sides = _moved(patches, torch.tensor(patch.reshape(-1)), torch.tensor(coordinates.reshape(-1, 3)))

    def terms(self, patches: PatchSurface) -> tuple[Tensor, Tensor, Tensor]:
        """The means of the three squared terms: distance over L, normal and crease."""
        _check_patches(patches)
        mine, theirs = self._triangles, patches.triangles
        if patches.vertices.dtype != self.targets.dtype or theirs.device != mine.device:
            raise TypeError(
                f"PatchLoss: patches must be {self.targets.dtype} on {mine.device} like those that the loss was made "
                f"for, got {patches.vertices.dtype} on {theirs.device}"
            )
        if theirs is not mine and not torch.equal(theirs, mine):
            raise ValueError(
                f"PatchLoss: patches must have the {len(mine)} triangles that the loss was made for, got {patches!r}"
            )
        surface = patches.surface(self.places)
        distance = ((surface.points - self.targets) * self.target_normals).sum(-1) / self.length
        turned = (surface.normals - self.target_normals).square().sum(-1)
        left, right = patches.surface(self.sides).normals.chunk(2)
        creases = (left - right).square().sum(-1)
        crease = creases.mean() if len(creases) else creases.sum()
        return (self.areas * distance.square()).sum(), (self.areas * turned).sum(), crease

    def __call__(self, patches: PatchSurface) -> Tensor:
        """The loss of patches over the same triangles, with other quadrics or another shape (`with_shape`)."""
        distance, normal, crease = self.terms(patches)
        return distance + self.normal_weight * normal + self.edge_weight * crease


def _check_patches(patches: Any) -> None:
    if not isinstance(patches, PatchSurface):
        raise TypeError(f"PatchLoss: patches must be FreeFormPatches, got {type(patches).__name__}")


def _moved(patches: PatchSurface, patch: Tensor, barycentrics: Tensor) -> PatchSamples:
    return patches.samples(patch.to(patches.vertices.device), barycentrics.to(patches.vertices))


def descend(
    loss: PatchLoss,
    patches: PatchSurface,
    numbers: QuadricParameters,
    *,
    iterations: int,
    least: float,
    progress: bool = False,
) -> QuadricParameters:
    """Adam with a learning rate that decays to zero; each radius stays between `least` and its cap [m]."""
    parts = [torch.tensor(part, requires_grad=True) for part in np.split(numbers.rows, [1, 4], axis=1)]
    rates = (0.02 * loss.length * 0.1, 0.02 * loss.length, 0.02)
    # factors off the diagonal are in 1/m
    slanted = torch.tensor([1.0] * 3 + [1.0 / loss.length] * 3, dtype=torch.float64)
    parts[2] = (parts[2].detach() / slanted).requires_grad_()
    optimizer = torch.optim.Adam([{"params": [p], "lr": r} for p, r in zip(parts, rates, strict=True)])
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, iterations)
    current = patches
    for step in tqdm(range(iterations), desc="fitting patches", disable=not progress, leave=False):
        if step % _RELIST == 0:
            numbers = _within(parts, slanted, numbers, least)
        quadrics = Quadrics(parts[0][:, 0], parts[1], parts[2] * slanted)
        current = current.with_quadrics(quadrics, keep_lists=step % _RELIST != 0)
        optimizer.zero_grad()
        loss(current).backward()
        optimizer.step()
        falling.step()
    return _within(parts, slanted, numbers, least)


def _within(parts: list[Tensor], slanted: Tensor, numbers: QuadricParameters, least: float) -> QuadricParameters:
    """Clamp the radii of the parameters to their bounds, in place."""
    with torch.no_grad():
        rows = torch.cat([parts[0], parts[1], parts[2] * slanted], dim=1).numpy()
        kept = within_radii(QuadricParameters(rows, numbers.cap), least)
        parts[2].copy_(torch.tensor(kept.rows[:, 4:]) / slanted)
    return kept
