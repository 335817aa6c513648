"""Implicit Euler with any elastic energy, minimised in float64: the converged solution of a method with this energy.

L-BFGS with the multilevel preconditioner of the same body; gradients by torch. The preconditioner fits because each of
these energies equals that of projective dynamics to first order, or a multiple of it bounds them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import torchpd as pd

from .problem import GRAVITY, Problem

Array = NDArray[np.float64]
Density = Callable[[Tensor], Tensor]  # energy per volume [E] Pa of F [E, 3, 3]

_PAIRS = 12
_ITERATIONS = 400
_SOLVED = 1e-9  # |grad E| over that at the start


def stable_neo_hookean(mu: float, lame: float) -> Density:
    """Smith, De Goes and Kim 2018 without the logarithm, as in Newton's SolverVBD (Lame's mu and lambda in Pa)."""
    volume = lame + mu
    alpha = 1.0 + mu / volume
    return lambda f: (
        0.5 * mu * (f.square().sum((1, 2)) - 3.0)
        + 0.5 * volume * ((torch.linalg.det(f) - alpha) ** 2 - (1 - alpha) ** 2)
    )


def minimise(problem: Problem, density: Density) -> tuple[Array, float]:
    """The minimising displacement [V, 3] m, and |grad E| there over that at the first iterate."""
    sim = pd.Simulator(
        problem.scene(), problem.time_step, 0, pd.Multilevel(), torch.float64, progress=False
    )  # only for its preconditioner
    values = sim.scene.values()
    tets = torch.from_numpy(values.tets)
    rest = torch.from_numpy(values.rest_positions)
    edges = (rest[tets][:, 1:] - rest[tets][:, :1]).mT
    inverse, volumes = torch.linalg.inv(edges), torch.linalg.det(edges) / 6.0
    weight = torch.from_numpy(values.masses / problem.time_step**2)[:, None]
    fall = torch.tensor([0.0, GRAVITY * problem.time_step**2, 0.0])
    target = torch.from_numpy(problem.first) + fall
    free = torch.ones(len(rest), 1, dtype=torch.bool)
    free[torch.from_numpy(problem.held)] = False

    def evaluate(u: Tensor) -> tuple[float, Tensor]:
        u = u.detach().requires_grad_()
        x = (rest + u)[tets]
        f = (x[:, 1:] - x[:, :1]).mT @ inverse
        energy = 0.5 * (weight * free * (u - target).square()).sum() + (volumes * density(f)).sum()
        (gradient,) = torch.autograd.grad(energy, u)
        return float(energy.detach()), gradient * free

    start = torch.from_numpy(problem.first) * free
    found, left = _lbfgs(evaluate, start, lambda g: torch.ops.torchpd.precondition(g[None], list(sim.plan.arrays))[0])
    return found.numpy(), left


def _lbfgs(
    evaluate: Callable[[Tensor], tuple[float, Tensor]], u: Tensor, precondition: Callable[[Tensor], Tensor]
) -> tuple[Tensor, float]:
    energy, gradient = evaluate(u)
    first = float(gradient.norm())
    pairs: list[tuple[Tensor, Tensor]] = []
    for _ in range(_ITERATIONS):
        if float(gradient.norm()) <= _SOLVED * first:
            break
        step = _two_loops(gradient, pairs, precondition)
        slope, length = float((step * gradient).sum()), 1.0
        if slope >= 0.0:
            pairs, step = [], -precondition(gradient)
            slope = float((step * gradient).sum())
        while True:
            reached, there = evaluate(u + length * step)
            flat = abs(reached - energy) <= 1e-13 * abs(energy)
            if reached <= energy + 1e-4 * length * slope or (flat and float(there.norm()) < float(gradient.norm())):
                break
            length *= 0.5
            if length < 1e-10:
                return u, float(gradient.norm()) / first
        s, y = length * step, there - gradient
        if float((s * y).sum()) > 1e-12 * float(s.norm() * y.norm()):
            pairs = [*pairs[-(_PAIRS - 1) :], (s, y)]
        u, energy, gradient = u + s, reached, there
    return u, float(gradient.norm()) / first


def _two_loops(
    gradient: Tensor, pairs: list[tuple[Tensor, Tensor]], precondition: Callable[[Tensor], Tensor]
) -> Tensor:
    q, weights = gradient, []
    for s, y in reversed(pairs):
        weights.append(float((s * q).sum() / (s * y).sum()))
        q = q - weights[-1] * y
    d = precondition(q)
    for (s, y), weight in zip(pairs, reversed(weights), strict=True):
        d = d + (weight - float((y * d).sum() / (s * y).sum())) * s
    return -d
