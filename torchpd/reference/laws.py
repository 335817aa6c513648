"""Energies of elements in float64: value, stress, second derivative and derivatives by the parameters.

F is [N, 3, d]. Every law is majorised by constants, whatever the state:

    E(F + dF) <= E(F) + P : dF + V sum_a (q l_e + n k) / 2 |g_a|^2 |d_a|^2,     q = `quadratic`, k = `trace`

with n the number of corners of nonzero g_a and l_e from `geometry.spreads`. The energies per element add up to the
energy in joules; stresses and second derivatives are multiplied by the measure V.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .rotations import LEAST, nearest_orthonormal, orthonormal_linearised, singular_frames

__all__ = ["Corotated", "Coupling", "Damped", "Law", "Length", "Linear"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Linear = Callable[[Array], Array]


def inner(a: Array, b: Array) -> Array:
    """a : b [N] of matrices [N, 3, d]."""
    return np.asarray(np.einsum("nij,nij->n", a, b))


def scaled(factor: Array, matrices: Array) -> Array:
    """Each of N matrices times its factor [N]."""
    return np.asarray(factor[:, None, None] * matrices)


def _clamped(blocks: Array) -> Array:
    """Symmetric matrices with their negative eigenvalues set to zero."""
    values, vectors = np.linalg.eigh(blocks)
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None]) @ np.swapaxes(vectors, 1, 2))


@dataclass(frozen=True)
class Coupling:
    """A part of the Hessian that joins elements: sum over groups of factor_g (sum_e rows_e : dF_e)^2."""

    rows: Array  # [N, 3, d]
    group: Index  # [N]
    factor: Array  # [groups]


class Law(ABC):
    """The energy of N elements with their parameters."""

    measure: Array  # [N] V

    @property
    @abstractmethod
    def quadratic(self) -> Array:
        """q [N] of the majoriser."""

    @property
    def trace(self) -> Array:
        """k [N] of the majoriser."""
        return np.zeros_like(self.measure)

    @property
    def matrix_weight(self) -> Array:
        """w [N] of the constant matrix sum V w g g^T."""
        return self.quadratic

    @abstractmethod
    def evaluate(self, F: Array) -> tuple[Array, Array]:
        """Energies [N] in J and V P [N, 3, d]."""

    @abstractmethod
    def linearised(self, F: Array) -> Linear:
        """The map of dF to V dP at F, without `coupling`."""

    @abstractmethod
    def rates(self, F: Array) -> dict[str, Array]:
        """Derivative of the energy by every parameter, [N] each."""

    @abstractmethod
    def products(self, F: Array, dF: Array) -> dict[str, Array]:
        """Derivative of `rates` along dF: the derivative of sum V P : dF by every parameter, [N] each."""

    def differential(self, F: Array, dF: Array) -> Array:
        """V dP [N, 3, d] along dF."""
        own, joined = self.linearised(F)(dF), self.coupling(F)
        if joined is None:
            return own
        sums = np.bincount(joined.group, weights=inner(joined.rows, dF))
        return np.asarray(own + scaled((joined.factor * sums)[joined.group], joined.rows))

    def blocks(self, F: Array, *, positive: bool) -> Array:
        """Second derivative of each element by itself [N, 3 d, 3 d], in the order of F^T, less `coupling`.

        `positive` clamps negative eigenvalues at zero.
        """
        count, _, width = F.shape
        along, columns = self.linearised(F), []
        for k in range(width):
            for i in range(3):
                dF = np.zeros_like(F)
                dF[:, i, k] = 1.0
                columns.append(np.swapaxes(along(dF), 1, 2).reshape(count, -1))
        blocks = np.stack(columns, axis=2)
        blocks = 0.5 * (blocks + np.swapaxes(blocks, 1, 2))
        return _clamped(blocks) if positive else blocks

    def blocks_alone(self, F: Array) -> Array:
        """Second derivative of each element by itself [N, 3 d, 3 d] with its part of `coupling`, clamped at zero."""
        joined = self.coupling(F)
        if joined is None:
            return self.blocks(F, positive=True)
        rows = np.swapaxes(joined.rows, 1, 2).reshape(len(F), -1)
        part = joined.factor[joined.group][:, None, None] * rows[:, :, None] * rows[:, None, :]
        return _clamped(self.blocks(F, positive=False) + part)

    def coupling(self, F: Array) -> Coupling | None:
        """The part of the second derivative that `blocks` lacks."""
        return None


@dataclass(frozen=True)
class Corotated(Law):
    """Corotated elasticity of tetrahedra and membranes, the pressure in tension capped at 2 mu.

    E = mu V |F - R|^2 + B phi(t). t is the mean of tr(R^T F) - d over a group with weights lambda V, B their sum.
    phi(t) = t^2 / 2 up to c, and c t - c^2 / 2 beyond, with c the least 2 mu / lambda of the group. Then
    P = 2 mu (F - R) + p R with p = lambda min(t, c). An element with lambda <= 0 has its own trace, without a cap.
    """

    shear: Array  # [N] 2 mu
    bulk: Array  # [N] lambda
    measure: Array
    group: Index  # [N] number of the group that shares its trace

    @property
    def quadratic(self) -> Array:
        return self.shear

    @property
    def trace(self) -> Array:
        return np.maximum(self.bulk, 0.0)

    @property
    def matrix_weight(self) -> Array:
        return self.shear + self.trace

    @cached_property
    def members(self) -> Index:
        """Number of the group [N] of each element, counted without gaps."""
        alone = self.bulk <= 0.0
        numbers = np.where(alone, self.group.max(initial=0) + 1 + np.arange(len(self.group)), self.group)
        return np.unique(numbers, return_inverse=True)[1].astype(np.int64)

    @cached_property
    def weight(self) -> Array:
        """B [groups] = sum lambda V."""
        return np.asarray(np.bincount(self.members, weights=self.bulk * self.measure), np.float64)

    @cached_property
    def _ratio(self) -> Array:
        positive = self.bulk > 0.0
        return np.where(positive, self.shear / np.where(positive, self.bulk, 1.0), np.inf)

    @cached_property
    def cap(self) -> Array:
        """c [groups]."""
        cap = np.full(len(self.weight), np.inf)
        np.minimum.at(cap, self.members, self._ratio)
        return cap

    @cached_property
    def _sets_cap(self) -> NDArray[np.bool_]:
        """Whether the cap of its group is that of the element [N]: the first of equal ones."""
        least = np.flatnonzero(np.isfinite(self._ratio) & (self._ratio == self.cap[self.members]))
        sets = np.zeros(len(self.bulk), dtype=np.bool_)
        sets[least[np.unique(self.members[least], return_index=True)[1]]] = True
        return sets

    def mean(self, traces: Array) -> Array:
        """Mean [groups] of values of the elements, with weights lambda V."""
        sums = np.bincount(self.members, weights=self.bulk * self.measure * traces)
        return np.asarray(sums / np.where(self.weight == 0.0, 1.0, self.weight))

    def _pressure(self, F: Array, R: Array) -> tuple[Array, Array, Array]:
        """t [N] of the elements, t [groups] and min(t, c) [groups]."""
        own = inner(R, F - R)
        mean = self.mean(own)
        return own, mean, np.minimum(mean, self.cap)

    def evaluate(self, F: Array) -> tuple[Array, Array]:
        R = nearest_orthonormal(F)
        strain = F - R
        stress = scaled(self.shear * self.measure, strain)
        energies = 0.5 * inner(stress, strain)
        if self.bulk.any():
            _, mean, p = self._pressure(F, R)
            bulk = self.bulk * self.measure
            energies = energies + bulk * (p * (mean - 0.5 * p))[self.members]
            stress = stress + scaled(bulk * p[self.members], R)
        return energies, stress

    def linearised(self, F: Array) -> Linear:
        p = self._pressure(F, nearest_orthonormal(F))[2][self.members]
        shear, pressure = self.shear * self.measure, self.bulk * self.measure * p
        turn = orthonormal_linearised(F)
        return lambda dF: scaled(shear, dF) - scaled(shear - pressure, turn(dF))

    def coupling(self, F: Array) -> Coupling:
        R = nearest_orthonormal(F)
        _, mean, p = self._pressure(F, R)
        below = (mean == p) & (self.weight != 0.0)
        factor = below / np.where(self.weight == 0.0, 1.0, self.weight)
        return Coupling(scaled(self.bulk * self.measure, R), self.members, factor)

    def blocks(self, F: Array, *, positive: bool) -> Array:
        """Closed form for d = 3: the derivative of |F - R|^2 / 2 is the identity less 2 / (s_i + s_j) on each twist.

        The twists are U (e_i e_j^T - e_j e_i^T) V^T / sqrt 2 (Smith, De Goes and Kim 2019).
        """
        if F.shape[2] == 2:
            return super().blocks(F, positive=positive)
        left, _, right = frames = singular_frames(F)
        p = self._pressure(F, left @ right)[2][self.members]
        return self._twisted(frames, 1.0 - self.bulk * p / self.shear, positive=positive)

    def _twisted(self, frames: tuple[Array, Array, Array], share: Array, *, positive: bool) -> Array:
        """The blocks from U, s and V^T, with the share of 2 mu that tension leaves."""
        left, values, right = frames
        blocks = np.repeat(np.eye(9)[None], len(left), axis=0)
        for i, j in ((0, 1), (1, 2), (2, 0)):
            twist = np.zeros((3, 3))
            twist[i, j], twist[j, i] = np.sqrt(0.5), -np.sqrt(0.5)
            mode = np.swapaxes(left @ twist @ right, 1, 2).reshape(-1, 9)
            softening = share * 2.0 / np.maximum(values[:, i] + values[:, j], LEAST)
            softening = np.minimum(softening, 1.0) if positive else softening
            blocks -= softening[:, None, None] * mode[:, :, None] * mode[:, None, :]
        return scaled(self.shear * self.measure, blocks)

    def blocks_alone(self, F: Array) -> Array:
        """For d = 3 every element has its own trace, and lambda tr(dF R^T)^2 beside what is clamped."""
        if F.shape[2] == 2:
            return super().blocks_alone(F)
        left, _, right = frames = singular_frames(F)
        R = left @ right
        share = 1.0 - np.minimum(self.bulk * inner(R, F - R), self.shear) / self.shear
        rows = np.swapaxes(R, 1, 2).reshape(-1, 9)
        bulk = scaled(self.bulk * self.measure, rows[:, :, None] * rows[:, None, :])
        return self._twisted(frames, share, positive=True) + bulk

    def _cap_rates(self, rate: Array) -> dict[str, Array]:
        """Derivatives through c [N], from dE/dc [groups]."""
        own = np.where(self._sets_cap, rate[self.members], 0.0)
        bulk = np.where(self._sets_cap, self.bulk, 1.0)
        return {"shear": own / bulk, "bulk": -own * self.shear / bulk**2}

    def rates(self, F: Array) -> dict[str, Array]:
        R = nearest_orthonormal(F)
        own, mean, p = self._pressure(F, R)
        cap = self._cap_rates(self.weight * (mean - p))
        volume = (p * (mean - 0.5 * p))[self.members] + p[self.members] * (own - mean[self.members])
        return {
            "shear": 0.5 * self.measure * inner(F - R, F - R) + cap["shear"],
            "bulk": self.measure * volume + cap["bulk"],
        }

    def products(self, F: Array, dF: Array) -> dict[str, Array]:
        R = nearest_orthonormal(F)
        own, mean, p = self._pressure(F, R)
        change = inner(R, dF)
        together = self.mean(change)
        cap = self._cap_rates(np.where(mean > p, self.weight * together, 0.0))
        slope = np.where(mean > p, 0.0, together)
        volume = p[self.members] * change + slope[self.members] * (own - mean[self.members])
        return {
            "shear": self.measure * inner(F - R, dF) + cap["shear"],
            "bulk": self.measure * volume + cap["bulk"],
        }


@dataclass(frozen=True)
class Length(Law):
    """E = w / 2 V (|F| - L)^2 for d = 1, or zero for |F| < L where the element resists tension only."""

    stiffness: Array  # [N] w
    length: Array  # [N] L >= 0
    measure: Array
    tension_only: NDArray[np.bool_]  # [N]

    @property
    def quadratic(self) -> Array:
        return self.stiffness

    def _direction(self, F: Array) -> tuple[Array, Array, Array]:
        """|F| [N], the unit vector [N, 3, 1], and w V where the element resists [N]."""
        length = np.linalg.norm(F[..., 0], axis=1)
        unit = (
            np.where(length[:, None, None] > 0.0, F, np.eye(3)[:, :1])
            / np.where(length > 0.0, length, 1.0)[:, None, None]
        )
        acts = ~self.tension_only | (length > self.length)
        return length, unit, np.where(acts, self.stiffness * self.measure, 0.0)

    def evaluate(self, F: Array) -> tuple[Array, Array]:
        length, unit, weight = self._direction(F)
        return 0.5 * weight * (length - self.length) ** 2, scaled(weight, F - scaled(self.length, unit))

    def linearised(self, F: Array) -> Linear:
        length, unit, weight = self._direction(F)
        across = weight * self.length / np.maximum(length, LEAST)
        return lambda dF: scaled(weight - across, dF) + scaled(across * inner(unit, dF), unit)

    def rates(self, F: Array) -> dict[str, Array]:
        length, _, weight = self._direction(F)
        apart = np.where(weight != 0.0, length - self.length, 0.0)
        return {"stiffness": 0.5 * self.measure * apart**2, "length": -weight * apart}

    def products(self, F: Array, dF: Array) -> dict[str, Array]:
        length, unit, weight = self._direction(F)
        apart, change = np.where(weight != 0.0, length - self.length, 0.0), inner(unit, dF)
        return {"stiffness": self.measure * apart * change, "length": -weight * change}


@dataclass(frozen=True)
class Damped(Law):
    """E = k / 2 V |F - R T|^2 with R the nearest rotation to F T, and T symmetric: the stretch at the start of a step.

    For k = 2 mu beta / h it is stiffness-proportional damping with the coefficient beta [s]: a rigid rotation of the
    start feels no force, and the axial stress is k (s - s_t).
    """

    stiffness: Array  # [N] k
    target: Array  # [N, 3, 3] T
    measure: Array

    @property
    def quadratic(self) -> Array:
        return self.stiffness

    def evaluate(self, F: Array) -> tuple[Array, Array]:
        apart = F - nearest_orthonormal(F @ self.target) @ self.target
        stress = scaled(self.stiffness * self.measure, apart)
        return 0.5 * inner(stress, apart), stress

    def linearised(self, F: Array) -> Linear:
        turn, weight = orthonormal_linearised(F @ self.target), self.stiffness * self.measure
        return lambda dF: scaled(weight, dF - turn(dF @ self.target) @ self.target)

    def rates(self, F: Array) -> dict[str, Array]:
        apart = F - nearest_orthonormal(F @ self.target) @ self.target
        return {"stiffness": 0.5 * self.measure * inner(apart, apart)}

    def products(self, F: Array, dF: Array) -> dict[str, Array]:
        apart = F - nearest_orthonormal(F @ self.target) @ self.target
        return {"stiffness": self.measure * inner(apart, dF)}
