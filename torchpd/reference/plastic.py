"""Multiplicative plastic flow: F = F_e Fp, any law on F_e, and the update of Fp at the end of a step.

The stencil of F_e = F Fp^-1 has the corners g_a' = Fp^-T g_a, with the same measure, since det Fp = 1.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..scene.stencils import StencilGroup
from .rotations import singular_frames

__all__ = ["Flow", "PlasticLaw", "flow", "flow_product", "flowed", "uniaxial_yield"]

Array = NDArray[np.float64]


class Flow(NamedTuple):
    """The state of plastic elements."""

    plastic: Array  # [N, 3, 3] Fp
    hardening: Array  # [N] alpha, accumulated flow


class PlasticLaw(NamedTuple):
    """Parameters of the flow."""

    yield_strain: Array  # [N] Frobenius norm of the deviator of log strain at first yield (`uniaxial_yield`)
    hardening: Array  # [N] H
    creep_time: float = 0.0  # tau [s]; 0: flow ends within the step
    max_flow: float = math.inf  # bound of |log s|, s the stretches of Fp

    def share(self, time_step: float) -> float:
        """The fraction of the flow that a step of `time_step` [s] reaches."""
        return 1.0 - math.exp(-time_step / self.creep_time) if self.creep_time > 0.0 else 1.0


def uniaxial_yield(strain: Array, poisson: Array) -> Array:
    """Norm of the deviator of log strain in a uniaxial test at the yield strain: sqrt(2/3) (1 + nu) strain."""
    return np.asarray(math.sqrt(2.0 / 3.0) * (1.0 + poisson) * strain)


def flowed(group: StencilGroup, plastic: Array) -> StencilGroup:
    """The group with the corners of F Fp^-1."""
    return replace(group, gradients=np.asarray(group.gradients @ np.linalg.inv(plastic)))


def flow(law: PlasticLaw, elastic: Array, state: Flow, time_step: float) -> Flow:
    """The state after a step that ended with F_e [N, 3, 3].

    With F_e = U S V^T, d is the deviator of log S and n = d / |d|. The flow gamma of the step is the share of creep
    times max(0, |d| - (yield + H alpha)) / (1 + H). Then Fp <- V exp(gamma n) V^T Fp, divided by the cube root of its
    determinant, and alpha <- alpha + gamma. Nothing flows where det F_e <= 0.
    """
    _, values, right = singular_frames(elastic)
    sound = values[:, 2] > 0.0
    strain = np.log(np.where(sound[:, None], values, 1.0))
    deviator = strain - strain.mean(axis=1, keepdims=True)
    size = np.linalg.norm(deviator, axis=1)
    excess = np.maximum(size - (law.yield_strain + law.hardening * state.hardening), 0.0)
    gamma = np.where(sound, excess / (1.0 + law.hardening) * law.share(time_step), 0.0)
    stretch = np.exp(gamma[:, None] * deviator / np.where(size > 0.0, size, 1.0)[:, None])
    plastic = np.swapaxes(right, 1, 2) @ (stretch[:, :, None] * right) @ state.plastic
    root = np.where(gamma > 0.0, np.cbrt(np.linalg.det(plastic)), 1.0)
    return Flow(_bounded(plastic / root[:, None, None], law.max_flow), state.hardening + gamma)


def _bounded(plastic: Array, most: float) -> Array:
    """Fp with |log s| of its stretches scaled down to `most`."""
    left, values, right = singular_frames(plastic)
    strain = np.log(values)
    size = np.linalg.norm(strain, axis=1)
    over = size > most
    scale = np.where(over, most / np.where(over, size, 1.0), 1.0)
    bounded = (left * np.exp(scale[:, None] * strain)[:, None]) @ right
    return np.where(over[:, None, None], bounded, plastic)


def flow_product(law: PlasticLaw, elastic: Array, change: Array, state: Flow, time_step: float) -> Array:
    """Derivative of D = V exp(gamma n) V^T [N, 3, 3] along dF_e, at a fixed state and without the bound of Fp.

    In the frame V of C = F_e^T F_e = V diag(c) V^T, with f = exp(x) and x = gamma n: D' has C'_ij (f_i - f_j) /
    (c_i - c_j) off its diagonal and f_i x_i' on it. There, e_i' = C'_ii / 2 c_i changes the strains.
    """
    _, values, right = singular_frames(elastic)
    back = np.swapaxes(right, 1, 2)
    moved = right @ (np.swapaxes(elastic, 1, 2) @ change) @ back
    moved = moved + np.swapaxes(moved, 1, 2)
    sound = values[:, 2] > 0.0
    c = np.where(sound[:, None], values, 1.0) ** 2
    strain = 0.5 * np.log(c)
    d = strain - strain.mean(axis=1, keepdims=True)
    size = np.maximum(np.linalg.norm(d, axis=1), 1e-300)[:, None]
    threshold = (law.yield_strain + law.hardening * state.hardening)[:, None]
    flows = (size > threshold) & sound[:, None]
    share = (law.share(time_step) / (1.0 + law.hardening))[:, None]
    x = np.where(flows, share * (1.0 - threshold / size) * d, 0.0)
    rate = np.einsum("nii->ni", moved) / (2.0 * c)
    rate = rate - rate.mean(axis=1, keepdims=True)
    along = (d * rate).sum(axis=1, keepdims=True)
    slope = np.where(flows, share * (rate - threshold * (rate / size - d * along / size**3)), 0.0)
    f = np.exp(x)
    apart = c[:, :, None] - c[:, None, :]
    equal = np.abs(apart) <= 1e-9 * c[:, :1, None]
    # for equal stretches f is a function of c alone to first order, with the slope of the whole deviator
    limit = np.where(flows, share * (1.0 - threshold / size), 0.0)[:, :, None] * f[:, :, None] / (2.0 * c[:, :, None])
    inside = moved * np.where(equal, limit, (f[:, :, None] - f[:, None, :]) / np.where(equal, 1.0, apart))
    diagonal = np.arange(3)
    inside[:, diagonal, diagonal] = f * slope
    return np.asarray(back @ inside @ right)
