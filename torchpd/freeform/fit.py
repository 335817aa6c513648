"""Fit free-form patches to a surface: a triangle base on it, and quadrics for the remaining height."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm.auto import tqdm

from .fit_samples import FitSamples, inner_points, mean_edges, sample_target
from .least_squares import HeightProblem, QuadricParameters, levenberg_marquardt, ridge_amplitudes
from .loss import PatchLoss, descend
from .surface import PatchSurface
from .targets import FitTarget

__all__ = ["FitReport", "fit_quadrics", "measure_fit"]

Surface = TypeVar("Surface", bound=PatchSurface)

Array = NDArray[np.float64]
Bar: TypeAlias = Callable[[], object]

_LEAST_RADIUS = 1.5  # of a quadric, in sample spacings: smaller ones would fall between samples
_DEAD = 1e-6  # fraction of the heights' mean square below which a quadric has no effect
_RESEEDS = 3


@dataclass(frozen=True)
class FitReport:
    """Error of patches against their target, at points between those of the fit, edges included.

    Distances are from the patches to the target, not the other way: parts of the target that the base skips do not
    appear.
    """

    rms: float  # distance, root mean square over the area [m]
    largest: float  # distance [m]
    normal_error: float  # mean angle between the normals of patches and target [degrees]
    missed: float  # fraction of the fit's samples without a target
    size: float  # longest side of the target's bounding box [m]
    patches: int
    quadrics: int
    quadrics_per_patch: float  # mean number of quadrics that touch a patch
    bytes: int  # float32: 5 per vertex (position, director), 10 per quadric; 3 indices per patch, of 2 or 4 bytes

    def __str__(self) -> str:
        return (
            f"{self.patches} patches, {self.quadrics} quadrics ({self.quadrics_per_patch:.1f} touch a patch), "
            f"{self.bytes:,} bytes: {self.rms:.2e} m rms, {self.largest:.2e} m at most of a size of "
            f"{self.size:.3g} m, normals off by {self.normal_error:.2f} degrees"
        )


def fit_quadrics(
    empty: Surface,
    target: FitTarget,
    count: int,
    *,
    optimizer: Literal["lm", "adam"],
    iterations: int,
    radius_cap: float,
    dtype: torch.dtype,
    progress: bool,
) -> tuple[Surface, FitReport]:
    """Add `count` quadrics that fit patches without quadrics, in float64 on the CPU, to a target."""
    level = sampling_level(len(empty.triangles), count)
    samples = sample_target(empty, target, level)
    stages = _Stages(empty, samples, radius_cap, level)
    if optimizer == "lm":
        total = (2 + _RESEEDS) * iterations
        with tqdm(total=total, desc="fitting patches", disable=not progress, leave=False) as bar:
            numbers = stages.solve(count, iterations, bar.update)
    else:
        seeds = ridge_amplitudes(stages.problem, stages.seed(count, stages.problem.residuals(np.empty((0, 10)))))
        loss = PatchLoss.from_samples(empty, samples, level)
        numbers = descend(loss, empty, seeds, iterations=iterations, least=stages.least, progress=progress)
    fitted = empty.with_quadrics(numbers.quadrics()).to(dtype)
    fitted = fitted.with_quadrics(fitted.quadrics)  # recomputes the lists from the rounded numbers
    return fitted, measure_fit(fitted, target, samples.missed)


def sampling_level(patches: int, quadrics: int) -> int:
    """Segments along an edge that give three to four samples per unknown."""
    return int(np.clip(np.ceil(np.sqrt(2.0 * 35.0 * quadrics / patches)), 5, 40))


class _Stages:
    """Places quadrics where the residual is large: half of them first, the others on the new residual."""

    def __init__(self, empty: PatchSurface, samples: FitSamples, cap: float, level: int) -> None:
        self.problem = HeightProblem(samples.points, samples.heights, samples.areas * samples.cosines**2)
        self.samples = samples
        edges = mean_edges(empty)
        self.cap = cap * edges[samples.places.patch.numpy()]  # at each sample
        self.least = _LEAST_RADIUS * float(edges.mean()) / level

    def seed(self, count: int, residual: Array) -> QuadricParameters:
        """Spheres around samples with a large residual and far from each other."""
        points = self.samples.points
        weight = np.abs(residual) + 1e-3 * np.abs(residual).max(initial=0.0)
        apart = self.cap.copy()
        chosen = []
        for _ in range(count):
            place = int((weight * apart / self.cap).argmax())
            chosen.append(place)
            apart = np.minimum(apart, np.linalg.norm(points - points[place], axis=1))
        cap = np.maximum(self.cap[chosen], 1.01 * self.least)
        return QuadricParameters.spheres(points[chosen], 0.8 * cap, cap)

    def solve(self, count: int, iterations: int, report: Bar) -> QuadricParameters:
        """Levenberg-Marquardt in two stages, repeated while some quadrics have no effect."""
        numbers = self.grow(None, count - count // 2, iterations, report)
        if count > 1:
            numbers = self.grow(numbers, count // 2, iterations, report)
        for _ in range(_RESEEDS):
            alive = self.contributing(numbers)
            if alive.all():
                break
            better = self.grow(numbers.chosen(alive), int(np.sum(~alive)), iterations, report)
            if self.cost(better) >= self.cost(numbers):
                break
            numbers = better
        return numbers.chosen(self.contributing(numbers))

    def grow(self, numbers: QuadricParameters | None, more: int, iterations: int, report: Bar) -> QuadricParameters:
        rows = np.empty((0, 10)) if numbers is None else numbers.rows
        fresh = self.seed(more, self.problem.residuals(rows))
        numbers = fresh if numbers is None else numbers.joined(fresh)
        numbers = ridge_amplitudes(self.problem, numbers)
        return levenberg_marquardt(self.problem, numbers, iterations=iterations, least=self.least, report=report)

    def cost(self, numbers: QuadricParameters) -> float:
        return float((self.problem.residuals(numbers.rows) ** 2).sum())

    def contributing(self, numbers: QuadricParameters) -> NDArray[np.bool_]:
        basis = self.problem.basis(numbers.rows)
        share = numbers.rows[:, 0] ** 2 * np.asarray(basis.power(2).sum(axis=0)).reshape(-1)
        whole = float(((self.problem.root * self.problem.heights) ** 2).sum())
        return np.asarray(share > _DEAD**2 * whole)


def measure_fit(patches: PatchSurface, target: FitTarget, missed: float = 0.0, most: int = 20000) -> FitReport:
    """Measure the error of patches against a target, on a grid of points that no fit uses."""
    level = int(np.clip(np.sqrt(most / len(patches.triangles)), 3, 13))
    inner = inner_points(level)
    on_edge = np.array([[1.0 - t, t, 0.0] for t in (0.21, 0.5, 0.79)])
    places = np.concatenate([inner, *(np.roll(on_edge, k, axis=1) for k in range(3))])
    count = len(patches.triangles)
    b = torch.tensor(np.tile(places, (count, 1)), dtype=patches.vertices.dtype)
    where = patches.samples(torch.arange(count).repeat_interleave(len(places)), b)
    with torch.no_grad():
        surface = patches.surface(where)
    points, normals, tangents = (t.detach().cpu().double().numpy() for t in surface)
    distance, _, wanted = target.near(points)
    area = np.linalg.norm(np.cross(tangents[:, 0], tangents[:, 1]), axis=1)
    # the centroids of the level^2 triangles carry the area; points on edges count in the largest error
    carries = np.tile(np.arange(len(places)) < len(inner), count)
    weight = np.where(carries, area, 0.0) / area[carries].sum()
    cosine = np.clip((normals * wanted).sum(axis=1), -1.0, 1.0)
    corners = 2 if len(patches.vertices) <= 65536 else 4
    return FitReport(
        rms=float(np.sqrt((weight * distance**2).sum())),
        largest=float(np.abs(distance).max()),
        normal_error=float((weight * np.degrees(np.arccos(cosine))).sum()),
        missed=missed,
        size=target.size,
        patches=count,
        quadrics=len(patches.quadrics),
        quadrics_per_patch=float(torch.diff(patches.lists[1].reshape(-1)).double().mean()),
        bytes=20 * len(patches.vertices) + 40 * len(patches.quadrics) + 3 * corners * count,
    )
