"""Implicit Euler with any elastic energy, minimised in float64: the converged solution of a method with this energy.

L-BFGS with the multilevel preconditioner of the same body; gradients by torch. The preconditioner fits because each of
these energies equals that of projective dynamics to first order, or a multiple of it bounds them. Cloth takes hundreds
of iterations, since the preconditioner resists out of the plane as in it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import torchpd as pd

from .problem import Problem, Sheet

Array = NDArray[np.float64]
Density = Callable[[Tensor], Tensor]  # energy per volume [E] Pa of F [E, 3, 3]
Energy = Callable[[Tensor], Tensor]  # elastic energy [J] of positions [V, 3]

_PAIRS = 12
_ITERATIONS = 20_000
_SOLVED = 1e-9  # |grad E| over that at the start


def stable_neo_hookean(mu: float, lame: float) -> Density:
    """Smith, De Goes and Kim 2018 without the logarithm, as in Newton's SolverVBD (Lame's mu and lambda in Pa)."""
    volume = lame + mu
    alpha = 1.0 + mu / volume
    return lambda f: (
        0.5 * mu * (f.square().sum((1, 2)) - 3.0)
        + 0.5 * volume * ((torch.linalg.det(f) - alpha) ** 2 - (1 - alpha) ** 2)
    )


def of_tetrahedra(problem: Problem, density: Density) -> Energy:
    """The elastic energy of a body of tetrahedra."""
    values = problem.scene().values()
    tets, rest = torch.from_numpy(values.tets), torch.from_numpy(values.rest_positions)
    edges = (rest[tets][:, 1:] - rest[tets][:, :1]).mT
    inverse, volumes = torch.linalg.inv(edges), torch.linalg.det(edges) / 6.0
    return lambda x: (volumes * density((x[tets][:, 1:] - x[tets][:, :1]).mT @ inverse)).sum()


def of_sheet(problem: Sheet) -> Energy:
    """Newton's energy of cloth at Poisson ratio 0: the stable Neo-Hookean membrane, and squares of dihedral angles.

    mu / 2 (|F|^2 - 2) + mu / 2 (J - 2)^2 per area, with J the ratio of areas and 2 mu the stiffness, and for each
    hinge of an edge L, of triangles of total area A, kb / 2 L^2 / A angle^2.
    """
    membrane, hinge = problem.scene().values().stencils
    triangles, gradients, areas = (
        torch.from_numpy(a) for a in (membrane.corners, membrane.gradients, membrane.measure)
    )
    corners, total = torch.from_numpy(hinge.corners), torch.from_numpy(hinge.measure)
    rest = torch.tensor(problem.mesh.vertices)
    lengths = (rest[corners[:, 1]] - rest[corners[:, 0]]).square().sum(1)
    mu, bend = 0.5 * problem.youngs, problem.bending * lengths / total

    def energy(x: Tensor) -> Tensor:
        f = torch.einsum("nak,nad->nkd", x[triangles], gradients)
        grown = torch.linalg.cross(f[:, :, 0], f[:, :, 1]).norm(dim=1)
        stretched = 0.5 * mu * (f.square().sum((1, 2)) - 2.0 + (grown - 2.0) ** 2 - 1.0)
        x0, x1, x2, x3 = (x[corners[:, a]] for a in range(4))
        edge = x1 - x0
        n, m = torch.linalg.cross(edge, x2 - x0), torch.linalg.cross(x3 - x0, edge)
        angle = torch.atan2((torch.linalg.cross(n, m) * edge).sum(1) / edge.norm(dim=1), (n * m).sum(1))
        return (areas * stretched).sum() + 0.5 * (bend * angle**2).sum()

    return energy


def minimise(problem: Problem, elastic: Energy, first: Array | None = None) -> tuple[Array, float]:
    """The minimising displacement [V, 3] m, and |grad E| there over that at u_0.

    `first` is the first iterate, u_0 by default. A folded sheet has several minima.
    """
    sim = pd.Simulator(
        problem.scene(), problem.time_step, 0, pd.Multilevel("lbfgs"), torch.float64, progress=False
    )  # only for its preconditioner
    start = torch.tensor(problem.start)
    weight = torch.from_numpy(sim.scene.values().masses / problem.time_step**2)[:, None]
    target = torch.from_numpy(problem.first) + problem.time_step**2 * torch.tensor(problem.gravity)
    free = torch.ones(len(start), 1, dtype=torch.bool)
    free[torch.from_numpy(problem.held)] = False

    def evaluate(u: Tensor) -> tuple[float, Tensor]:
        u = u.detach().requires_grad_()
        energy = 0.5 * (weight * free * (u - target).square()).sum() + elastic(start + u)
        (gradient,) = torch.autograd.grad(energy, u)
        return float(energy.detach()), gradient * free

    least = torch.from_numpy(problem.first) * free
    scale = float(evaluate(least)[1].norm())
    found, left = _lbfgs(
        evaluate, least if first is None else torch.from_numpy(first) * free, scale,
        lambda g: torch.ops.torchpd.precondition(g[None], list(sim.plan.arrays))[0],
    )  # fmt: skip
    return found.numpy(), left


def _lbfgs(
    evaluate: Callable[[Tensor], tuple[float, Tensor]],
    u: Tensor,
    first: float,
    precondition: Callable[[Tensor], Tensor],
) -> tuple[Tensor, float]:
    energy, gradient = evaluate(u)
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
            # where energies differ by rounding alone, Armijo's condition by slopes (Hager and Zhang 2005)
            flat = abs(reached - energy) <= 1e-9 * abs(energy) and float((step * there).sum()) <= -0.9998 * slope
            if flat or reached <= energy + 1e-4 * length * slope:
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
