"""Least-squares fit of heights at samples in the ten parameters of each quadric, by Levenberg-Marquardt.

On a fixed base the heights depend only on the positions of the samples: h(x) = sum_i R_i(x). Each sample lies in a few
quadrics, so the Jacobian is sparse. SciPy's least_squares has no bounds for the radii. On the octopus it takes 5 to 60
times as long, and its result is 4 times worse once the bounds are applied.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from .quadrics import Quadrics

__all__ = [
    "HeightProblem",
    "QuadricParameters",
    "levenberg_marquardt",
    "ridge_amplitudes",
    "triangular",
    "within_radii",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_DENSE = 3000  # most unknowns for which the normal equations are a dense matrix
_ROWS, _COLUMNS = np.array([0, 1, 2, 1, 2, 2]), np.array([0, 1, 2, 0, 0, 1])  # entries of M in the order of `factors`


@dataclass(frozen=True)
class QuadricParameters:
    """Parameters of quadrics in rows [Q, 10]: a, c, and the six `Quadrics.factors`; and their largest radii [Q] [m]."""

    rows: Array
    cap: Array

    def chosen(self, keep: Index | NDArray[np.bool_]) -> QuadricParameters:
        return QuadricParameters(self.rows[keep], self.cap[keep])

    def joined(self, other: QuadricParameters) -> QuadricParameters:
        return QuadricParameters(np.concatenate([self.rows, other.rows]), np.concatenate([self.cap, other.cap]))

    def quadrics(self) -> Quadrics:
        rows = torch.tensor(self.rows)
        return Quadrics(rows[:, 0].clone(), rows[:, 1:4].clone(), rows[:, 4:].clone())

    @classmethod
    def spheres(cls, centres: Array, radii: Array, cap: Array) -> QuadricParameters:
        """Spheres with amplitude 0."""
        rows = np.zeros((len(centres), 10))
        rows[:, 1:4] = centres
        rows[:, 4:7] = -np.log(radii)[:, None]
        return cls(rows, cap)


def triangular(rows: Array) -> Array:
    """M [Q, 3, 3] in 1/m."""
    m = np.zeros((len(rows), 3, 3))
    m[:, _ROWS, _COLUMNS] = np.concatenate([np.exp(rows[:, 4:7]), rows[:, 7:10]], axis=1)
    return m


def within_radii(numbers: QuadricParameters, least: float) -> QuadricParameters:
    """The same quadrics with their half axes clamped to [least, cap]."""
    U, s, Vt = np.linalg.svd(triangular(numbers.rows))
    inside = np.clip(s, 1.0 / numbers.cap[:, None], 1.0 / least)
    changed = (inside != s).any(axis=1)
    if not changed.any():
        return numbers
    # M^T M does not change when M is rotated from the left: to lower triangular, by QR with both orders reversed
    m = ((U * inside[:, None, :]) @ Vt)[changed]
    upper = np.linalg.qr(m[:, ::-1, ::-1])[1]
    lower = upper[:, ::-1, ::-1]
    lower = lower * np.sign(np.diagonal(lower, axis1=1, axis2=2))[:, :, None]
    rows = numbers.rows.copy()
    rows[changed, 4:7] = np.log(np.diagonal(lower, axis1=1, axis2=2))
    rows[changed, 7:10] = lower[:, _ROWS[3:], _COLUMNS[3:]]
    return QuadricParameters(rows, numbers.cap)


@dataclass(frozen=True)
class _Overlaps:
    """Pairs of a sample and a quadric around it, ordered by sample."""

    sample: Index
    quadric: Index
    offset: Array  # x - c [N, 3] [m]
    y: Array  # M (x - c) [N, 3]
    q: Array  # 1 - |y|^2 > 0 [N]


class HeightProblem:
    """The objective sum_j w_j (h(x_j) - h*_j)^2; heights and residuals are weighted by sqrt(w).

    Args:
        points: x [S, 3] [m].
        heights: h* [S] [m].
        weights: w [S], >= 0.
    """

    def __init__(self, points: Array, heights: Array, weights: Array) -> None:
        self.points, self.heights, self.root = points, heights, np.sqrt(weights)
        self.tree = cKDTree(points)

    def overlaps(self, rows: Array) -> _Overlaps:
        m = triangular(rows)
        radius = 1.0 / np.linalg.svd(m, compute_uv=False)[:, -1] if len(rows) else np.empty(0)
        found = self.tree.query_ball_point(rows[:, 1:4], radius) if len(rows) else []
        quadric = np.repeat(np.arange(len(rows)), [len(f) for f in found])
        sample = np.concatenate([np.empty(0, np.int64), *(np.asarray(f, np.int64) for f in found)])
        offset = self.points[sample] - rows[quadric, 1:4]
        y = np.einsum("nij,nj->ni", m[quadric], offset)
        q = 1.0 - (y**2).sum(axis=1)
        inside = np.flatnonzero(q > 0)
        order = inside[np.lexsort((quadric[inside], sample[inside]))]
        return _Overlaps(sample[order], quadric[order], offset[order], y[order], q[order])

    def residuals(self, rows: Array, pairs: _Overlaps | None = None) -> Array:
        pairs = self.overlaps(rows) if pairs is None else pairs
        h = np.bincount(pairs.sample, rows[pairs.quadric, 0] * pairs.q**3, len(self.points))
        return np.asarray(self.root * (h - self.heights))

    def basis(self, rows: Array) -> csr_array:
        """The matrix sqrt(w) [Q_i(x_j)]_+^3 [S, Q] of the amplitudes, which enter linearly."""
        pairs = self.overlaps(rows)
        values = self.root[pairs.sample] * pairs.q**3
        return csr_array((values, (pairs.sample, pairs.quadric)), shape=(len(self.points), len(rows)))

    def linearised(self, rows: Array) -> tuple[Array, csr_array]:
        """Residuals [S], and their derivatives by all parameters [S, 10 Q].

        With q = 1 - |y|^2: dR/da = q^3, dR/dc = 6 a q^2 M^T y, dR/dM_ij = -6 a q^2 y_i (x - c)_j.
        """
        pairs = self.overlaps(rows)
        m = triangular(rows)[pairs.quadric]
        steep = 6.0 * rows[pairs.quadric, 0] * pairs.q**2
        by_entry = -steep[:, None] * pairs.y[:, _ROWS] * pairs.offset[:, _COLUMNS]
        by_entry[:, :3] *= m[:, [0, 1, 2], [0, 1, 2]]
        by_centre = steep[:, None] * np.einsum("nij,ni->nj", m, pairs.y)
        values = np.concatenate([(pairs.q**3)[:, None], by_centre, by_entry], axis=1)
        values *= self.root[pairs.sample, None]
        columns = 10 * pairs.quadric[:, None] + np.arange(10)
        starts = np.concatenate([[0], np.cumsum(np.bincount(pairs.sample, minlength=len(self.points)))]) * 10
        J = csr_array((values.reshape(-1), columns.reshape(-1), starts), shape=(len(self.points), rows.size))
        return self.residuals(rows, pairs), J


def ridge_amplitudes(problem: HeightProblem, numbers: QuadricParameters, ridge: float = 1e-4) -> QuadricParameters:
    """The same ellipsoids with the best amplitudes, regularised by `ridge` times the mean of the diagonal."""
    A = problem.basis(numbers.rows)
    gram = (A.T @ A).toarray()
    gram[np.diag_indices_from(gram)] += ridge * max(np.trace(gram) / max(len(gram), 1), np.finfo(np.float64).tiny)
    rows = numbers.rows.copy()
    rows[:, 0] = np.linalg.solve(gram, A.T @ (problem.root * problem.heights))
    return QuadricParameters(rows, numbers.cap)


def _normal_matrix(J: csr_array) -> Array | csc_array:
    """J^T J, sparse if it is large.

    A sparse product costs about ten times as much per entry as a dense one, which also counts zeros.
    """
    unknowns = J.shape[1]
    if unknowns > _DENSE:
        return csc_array(J.T @ J)
    if J.nnz < 0.1 * J.shape[0] * unknowns:
        return np.asarray((J.T @ J).toarray())
    H = np.zeros((unknowns, unknowns))
    for start in range(0, J.shape[0], 4096):
        block = J[start : start + 4096].toarray()
        H += block.T @ block
    return H


def _damped_step(H: Array | csc_array, gradient: Array, damping: Array) -> Array | None:
    """(H + damping)^-1 gradient; None if the matrix is not positive definite."""
    if not isinstance(H, np.ndarray):
        solver = splu(csc_array(H + diags_array(damping)), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        return np.asarray(solver.solve(gradient))
    dense = H.copy()
    dense[np.diag_indices_from(dense)] += damping
    try:
        return np.asarray(cho_solve(cho_factor(dense, lower=True, overwrite_a=True), gradient))
    except LinAlgError:
        return None


def levenberg_marquardt(
    problem: HeightProblem,
    numbers: QuadricParameters,
    *,
    iterations: int,
    least: float,
    report: Callable[[], object] = lambda: None,
) -> QuadricParameters:
    """Improve quadrics to a smaller sum of squares; each step stays within the radii.

    Marquardt's scaling by the diagonal, Nielsen's rule for the damping (1999). Ends early when eight iterations gain
    less than 1e-3 of the sum.

    Args:
        problem: the least-squares problem.
        numbers: the start.
        iterations: most linear systems to solve.
        least: smallest radius [m].
        report: called after each iteration.
    """
    numbers = within_radii(numbers, least)
    residual, J = problem.linearised(numbers.rows)
    cost, damping, growth = float(residual @ residual), 1e-3, 2.0
    floor = 1e-28 * float((problem.root * problem.heights) @ (problem.root * problem.heights))
    history = [cost]
    H, gradient = _normal_matrix(J), J.T @ residual
    for _ in range(iterations):
        report()
        diagonal = H.diagonal()
        # the mean of the diagonal regularises parameters without influence
        scale = np.maximum(diagonal, 1e-9 * max(float(diagonal.max(initial=0.0)), np.finfo(np.float64).tiny))
        step = _damped_step(H, gradient, damping * scale)
        if step is None:
            damping, growth = damping * growth, 2.0 * growth
            continue
        limited = np.clip(step.reshape(-1, 10), -_most(numbers), _most(numbers))
        trial = within_radii(QuadricParameters(numbers.rows - limited, numbers.cap), least)
        new = float((problem.residuals(trial.rows) ** 2).sum())
        if new < cost:
            promised = float(step @ (damping * scale * step + gradient))
            gain = (cost - new) / max(promised, np.finfo(np.float64).tiny)
            damping *= max(1.0 / 3.0, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3)
            damping, growth, numbers, cost = max(damping, 1e-12), 2.0, trial, new
            residual, J = problem.linearised(numbers.rows)
            H, gradient = _normal_matrix(J), J.T @ residual
        else:
            damping, growth = damping * growth, 2.0 * growth
        history.append(cost)
        if cost <= floor or (len(history) > 8 and history[-1] > (1.0 - 1e-3) * history[-9]) or damping > 1e12:
            break
    return numbers


def _most(numbers: QuadricParameters) -> Array:
    """The longest step of each number: amplitudes freely, centres by half a cap, factors by a factor of e."""
    most = np.full_like(numbers.rows, np.inf)
    most[:, 1:4] = 0.5 * numbers.cap[:, None]
    most[:, 4:7] = 1.0
    most[:, 7:10] = np.exp(numbers.rows[:, 4:7]).max(axis=1, keepdims=True)
    return most
