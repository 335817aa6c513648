"""Distances to sets of stretches, k / 2 V |F - Z|^2 with Z the nearest point: strain limits and the set det F = 1."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .laws import Law, Linear, inner, scaled
from .rotations import LEAST, singular_frames

__all__ = ["Limit", "Stretches", "Volume", "nearest_unit_volume"]

Array = NDArray[np.float64]


def _frames(F: Array) -> tuple[Array, Array, Array]:
    """F = U S V^T: U [N, 3, 3], stretches [N, d], V^T [N, d, d]; signed for d = 3 (`singular_frames`)."""
    return singular_frames(F) if F.shape[2] == 3 else np.linalg.svd(F, full_matrices=True)


def _assembled(left: Array, values: Array, right: Array) -> Array:
    return np.asarray((left[:, :, : values.shape[1]] * values[:, None]) @ right)


@dataclass(frozen=True)
class Stretches(Law):
    """E = k / 2 V |F - Z|^2 with Z = U diag(z(S)) V^T the nearest point of a set of stretches, F = U S V^T."""

    stiffness: Array  # [N] k
    measure: Array

    @property
    def quadratic(self) -> Array:
        return self.stiffness

    @abstractmethod
    def nearest(self, stretches: Array) -> Array:
        """z [N, d] of stretches [N, d]."""

    @abstractmethod
    def slopes(self, stretches: Array, nearest: Array) -> Array:
        """dz_i / ds_j [N, d, d]."""

    def evaluate(self, F: Array) -> tuple[Array, Array]:
        left, values, right = _frames(F)
        apart = values - self.nearest(values)
        weight = self.stiffness * self.measure
        return 0.5 * weight * (apart**2).sum(axis=1), scaled(weight, _assembled(left, apart, right))

    def linearised(self, F: Array) -> Linear:
        """dZ = U M' V^T with M = U^T dF V: the diagonal by `slopes`, other entries by quotients.

        The symmetric part of a pair has (z_i - z_j) / (s_i - s_j), the antisymmetric part (z_i + z_j) / (s_i + s_j).
        """
        left, s, right = _frames(F)
        z, width = self.nearest(s), s.shape[1]
        slopes, diagonal = self.slopes(s, z), np.arange(width)
        apart = s[:, :, None] - s[:, None, :]
        equal = np.abs(apart) <= 1e-9 * np.maximum(np.abs(s[:, :1, None]), 1.0)
        own = np.einsum("nii->ni", slopes)[:, :, None]
        quotient = np.where(equal, own - slopes, (z[:, :, None] - z[:, None, :]) / np.where(equal, 1.0, apart))
        sums = (z[:, :, None] + z[:, None, :]) / np.maximum(s[:, :, None] + s[:, None, :], LEAST)
        outside = (z / np.maximum(s, LEAST))[:, None]  # of the normal, for d = 2
        weight = self.stiffness * self.measure

        def along(dF: Array) -> Array:
            moved = np.swapaxes(left, 1, 2) @ dF @ np.swapaxes(right, 1, 2)
            square = moved[:, :width]
            turned = np.swapaxes(square, 1, 2)
            inside = 0.5 * (quotient * (square + turned) + sums * (square - turned))
            inside[:, diagonal, diagonal] = np.einsum("nij,njj->ni", slopes, square)
            change = left @ np.concatenate([inside, moved[:, width:] * outside], axis=1) @ right
            return scaled(weight, dF - change)

        return along

    def rates(self, F: Array) -> dict[str, Array]:
        _, values, _ = _frames(F)
        return {"stiffness": 0.5 * self.measure * ((values - self.nearest(values)) ** 2).sum(axis=1)}

    def products(self, F: Array, dF: Array) -> dict[str, Array]:
        left, values, right = _frames(F)
        return {"stiffness": self.measure * inner(_assembled(left, values - self.nearest(values), right), dF)}


@dataclass(frozen=True)
class Limit(Stretches):
    """Distance to the stretches in [lo, hi] with det F > 0."""

    low: Array  # [N]
    high: Array  # [N]

    def nearest(self, stretches: Array) -> Array:
        return np.clip(stretches, self.low[:, None], self.high[:, None])

    def slopes(self, stretches: Array, nearest: Array) -> Array:
        return np.asarray((stretches == nearest)[:, :, None] * np.eye(stretches.shape[1]))

    def _passed(self, change: Array, values: Array) -> dict[str, Array]:
        """Derivatives by the bounds, from what multiplies k V at every stretch that passes them [N, d]."""
        weight = self.stiffness * self.measure
        below, above = values < self.low[:, None], values > self.high[:, None]
        return {"low": -weight * (change * below).sum(axis=1), "high": -weight * (change * above).sum(axis=1)}

    def rates(self, F: Array) -> dict[str, Array]:
        _, values, _ = _frames(F)
        return super().rates(F) | self._passed(values - self.nearest(values), values)

    def products(self, F: Array, dF: Array) -> dict[str, Array]:
        left, values, right = _frames(F)
        change = np.einsum("nij,nik,njk->nj", left[:, :, : values.shape[1]], dF, right)
        # the stretches change by the diagonal of U^T dF V
        return super().products(F, dF) | self._passed(change, values)


def nearest_unit_volume(stretches: Array, *, samples: int = 48, sweeps: int = 55) -> Array:
    """The nearest z [N, 3] > 0 with z_1 z_2 z_3 = 1 of signed stretches s_1 >= s_2 >= |s_3|.

    A stationary point has z_i - s_i + m / z_i = 0; in the nearest one only z_3 = t may be the smaller of the two roots.
    With m = t (s_3 - t) this leaves g(t) = sum log z_i = 0, which grows for t >= s_3 / 2. Below, it may have two more
    roots, found by signs on a grid. The nearer one of the least and the largest root is taken.
    """

    def point(t: Array) -> Array:
        m = t * (stretches[:, 2] - t)
        upper = stretches[:, :2]
        root = np.sqrt(np.maximum(upper**2 - 4.0 * m[:, None], 0.0))
        return np.stack([*(0.5 * (upper + root)).T, t], axis=1)

    def g(t: Array) -> Array:
        return np.asarray(np.log(np.maximum(point(t), 1e-300)).sum(axis=1))

    def bisected(low: Array, high: Array) -> Array:
        for _ in range(sweeps):
            middle = np.sqrt(low * high)
            above = g(middle) > 0.0
            low, high = np.where(above, low, middle), np.where(above, middle, high)
        return point(np.sqrt(low * high))

    half = np.maximum(0.5 * stretches[:, 2], 0.0)
    least = 1.0 / np.maximum(stretches[:, 0] * stretches[:, 1], 1e-300)  # g < 0 below it, for t < s_3
    bottom = 0.5 * np.minimum(np.where(half > 0.0, half, 1e-8), least)
    grid = bottom[:, None] * (np.maximum(half, bottom) / bottom)[:, None] ** np.linspace(0.0, 1.0, samples)
    top = np.maximum(stretches[:, 2], 0.0) + 1.0
    signs = np.stack([g(column) for column in grid.T], axis=1) > 0.0
    rises = signs[:, 1:] & ~signs[:, :-1]
    rows = np.arange(len(stretches))
    first = rises.argmax(axis=1)
    some = rises.any(axis=1)
    near = bisected(np.where(some, grid[rows, first], bottom), np.where(some, grid[rows, first + 1], top))
    last = samples - 2 - rises[:, ::-1].argmax(axis=1)
    inside = signs[:, -1] & some
    far = bisected(np.where(inside, grid[rows, last], grid[:, -1]), np.where(inside, grid[rows, last + 1], top))
    better = ((far - stretches) ** 2).sum(axis=1) < ((near - stretches) ** 2).sum(axis=1)
    return np.where(better[:, None], far, near)


@dataclass(frozen=True)
class Volume(Stretches):
    """Distance to det F = 1 (Bouaziz et al. 2014)."""

    def nearest(self, stretches: Array) -> Array:
        return nearest_unit_volume(stretches)

    def slopes(self, stretches: Array, nearest: Array) -> Array:
        """Derivative of the stationary point: (1 - m / z_i^2) dz_i + dm / z_i = ds_i and sum dz_i / z_i = 0."""
        m = (nearest * (stretches - nearest)).mean(axis=1)[:, None]
        stiff = 1.0 - m / nearest**2
        stiff = np.where(np.abs(stiff) < LEAST, LEAST, stiff)
        across = 1.0 / (stiff * nearest)
        total = (across / nearest).sum(axis=1)[:, None, None]
        own = (1.0 / stiff)[:, :, None] * np.eye(3)
        return np.asarray(own - across[:, :, None] * across[:, None, :] / total)
