"""Solvers for the energy of one step: the iterations of the library in float64, and solutions to rounding error."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import eigsh, splu

from ..common.tables import PLANES, SPHERES
from .problem import StepProblem
from .schedules import Classic, Guarded, Plain

__all__ = [
    "Iterates",
    "classic_chebyshev",
    "classic_omegas",
    "guard_tolerance",
    "guarded_chebyshev",
    "jacobi",
    "newton",
    "newton_step",
    "preconditioned_lbfgs",
    "relative_error",
    "solve_with_contact",
    "spectrum",
]

Array = NDArray[np.float64]
Observer = Callable[[int, Array], None]


@dataclass
class Iterates:
    """Result of an iteration, with its history."""

    displacement: Array  # [V, 3] u_K, m, after rigid alignment
    residual: float  # `StepProblem.relative_residual` of u_K, with the diagonal of the iteration
    iterations: int  # iterations done
    restarts: list[int] = field(default_factory=list)  # iterations k at which the check found a higher energy
    energies: list[tuple[int, float]] = field(default_factory=list)  # (k, E(u_k)) at every check
    converged: bool = False  # stopped by the tolerance


def classic_omegas(rho: float, delay: int, iterations: int) -> list[float]:
    """The weights omega_0 .. omega_{K-1} of the classic schedule."""
    schedule = Classic(rho, delay)
    return [schedule.omega(k) for k in range(iterations)]


def _iterate(
    problem: StepProblem,
    first: Array,
    schedule: Plain | Classic | Guarded,
    *,
    relaxation: float,
    iterations: int,
    tolerance: float,
    observe: Observer | None,
) -> Iterates:
    """Run u_{k+1} = P(u_{k-1} + omega_k (u_k - theta g / D - u_{k-1})), u_{-1} = u_0."""
    result, diagonal = Iterates(first, 1.0, 0), problem.diagonal
    least = float((problem.weight / diagonal)[problem.free].min(initial=1.0))
    slowest, left = max(1.0 - relaxation * least, 0.0), 0.0
    previous = current = first
    coming = schedule.omega(0)
    for k in range(iterations):
        energy, gradient = problem.evaluate(current)
        omega, coming = coming, schedule.omega(k + 1)
        if k % 4 == 0:
            result.energies.append((k, energy))
            # a restart acts on the omega after the next: a kernel reduces the sums of one iteration during the next
            if schedule.check(energy):
                result.restarts.append(k)
        step = current - relaxation * gradient / diagonal[:, None]
        following = problem.project(previous + omega * (step - previous), current)
        previous, current = current, following
        result.iterations = k + 1
        if observe is not None:
            observe(k + 1, current)
        if tolerance > 0.0:
            left = _estimate_error(float(np.linalg.norm(current - previous)), left, slowest, omega)
            if left <= tolerance * _displacement_scale(problem, previous):
                result.converged = True
                break
    result.displacement = problem.align(current)
    result.residual = problem.relative_residual(result.displacement)
    return result


def _estimate_error(change: float, before: float, slowest: float, omega: float) -> float:
    """Estimate |u - u*| [m] from the change of an iteration of weight omega and the previous estimate.

    A Jacobi iteration damps the slowest mode by g = `slowest`. An iteration of weight omega damps it by |r|, with r the
    larger root of r^2 - omega g r + omega - 1. If r is real, the change is 1 - r of the error. If r is complex, the
    mode oscillates: the previous estimate, times |r|, is a lower bound.
    """
    square = (omega * slowest) ** 2 - 4.0 * (omega - 1.0)
    if square > 1e-6:
        kept = (omega * slowest + math.sqrt(square)) / 2.0
        return change / (1.0 - kept) if kept < 1.0 else math.inf
    kept = math.sqrt(omega - 1.0)
    return max(change / (1.0 - kept), kept * before)


def _displacement_scale(problem: StepProblem, displacement: Array) -> float:
    """Scale of the relative error [m]: displacement by elasticity and contacts, or by gravity if larger."""
    fall = problem.time_step**2 * float(np.linalg.norm(problem.values.gravity)) * math.sqrt(len(displacement))
    return max(float(np.linalg.norm(displacement - problem.target)), fall)


def jacobi(
    problem: StepProblem,
    first: Array,
    *,
    iterations: int,
    relaxation: float = 1.0,
    weighted: bool = True,
    tolerance: float = 0.0,
    observe: Observer | None = None,
) -> Iterates:
    """Jacobi iteration; `observe(k, u_k)` is called with every iterate from the first update on."""
    return _iterate(problem.with_diagonal(weighted=weighted), first, Plain(), relaxation=relaxation,
                    iterations=iterations, tolerance=tolerance, observe=observe)  # fmt: skip


def classic_chebyshev(
    problem: StepProblem,
    first: Array,
    *,
    iterations: int,
    rho: float,
    delay: int = 10,
    relaxation: float = 1.0,
    weighted: bool = False,
    tolerance: float = 0.0,
    observe: Observer | None = None,
) -> Iterates:
    """Classic Chebyshev iteration of the source paper; rho estimates the spectral radius of the Jacobi iteration."""
    return _iterate(problem.with_diagonal(weighted=weighted), first, Classic(rho, delay), relaxation=relaxation,
                    iterations=iterations, tolerance=tolerance, observe=observe)  # fmt: skip


def guarded_chebyshev(
    problem: StepProblem,
    first: Array,
    *,
    iterations: int,
    relaxation: float = 1.9,
    rho: float | None = None,
    check_tolerance: float | None = None,
    tolerance: float = 0.0,
    observe: Observer | None = None,
) -> Iterates:
    """Guarded Chebyshev, the library's default; rho = min(0.99999, 1 - theta mu) unless given.

    It restarts when the energy has risen by more than the fraction `check_tolerance` in four iterations (default:
    `guard_tolerance`).
    """
    radius = min(0.99999, 1.0 - relaxation * problem.smallest_ratio if rho is None else rho)
    schedule = Guarded(radius, guard_tolerance(problem) if check_tolerance is None else check_tolerance)
    return _iterate(problem, first, schedule, relaxation=relaxation,
                    iterations=iterations, tolerance=tolerance, observe=observe)  # fmt: skip


def preconditioned_lbfgs(
    problem: StepProblem,
    first: Array,
    precondition: Callable[[Array], Array],
    *,
    iterations: int,
    relaxation: float = 1.8,
    memory: int = 8,
    backtrack: bool = False,
    observe: Observer | None = None,
) -> Array:
    """L-BFGS from H_0 = relaxation M, with the two-loop recursion (Nocedal 1980), in a step without contact.

    Every iteration takes a full step, and raises if the step fails Armijo's decrease of 1e-4: the library then departs
    from the textbook method. With `backtrack` the step is halved instead; the iterations end where no step descends.

    Args:
        problem: the step.
        first: u_0 [V, 3] m.
        precondition: applies M to a gradient [V, 3] that is zero at hard pins.
        iterations: number of iterations.
        relaxation: scale of M, in (0, 2).
        memory: number of secant pairs kept, among those with positive curvature.
        backtrack: halve steps that fail.
        observe: called with (k, u_k) from the first update on.

    Raises:
        RuntimeError: a full step does not lower the energy enough, without `backtrack`.
    """
    u, pairs = first, list[tuple[Array, Array, float]]()
    energy, gradient = problem.evaluate(u)
    for k in range(iterations):
        direction, weights = gradient, []
        for s, y, curvature in reversed(pairs):
            weights.append(float(np.vdot(s, direction)) / curvature)
            direction = direction - weights[-1] * y
        direction = relaxation * precondition(direction)
        for (s, y, curvature), weight in zip(pairs, reversed(weights), strict=True):
            direction = direction + (weight - float(np.vdot(y, direction)) / curvature) * s
        last, before = energy, gradient
        if backtrack:
            following, energy, gradient = _descend(problem, u, energy, gradient, -direction)
            if following is u:
                break
        else:
            following = u - direction
            energy, gradient = problem.evaluate(following)
            if energy > last - 1e-4 * float(np.vdot(before, direction)) + 1e-12 * abs(last):
                raise RuntimeError(
                    f"preconditioned_lbfgs: the full step of iteration {k} fails the Armijo decrease of 1e-4; "
                    "pass backtrack=True"
                )
        s, y = following - u, gradient - before
        curvature = float(np.vdot(s, y))
        if curvature > 0.0:
            pairs = [*pairs, (s, y, curvature)][-memory:]
        u = following
        if observe is not None:
            observe(k + 1, u)
    return u


def guard_tolerance(problem: StepProblem) -> float:
    """Relative rise of the energy below which the iteration does not restart.

    1e-5 covers rounding. With friction it is 1e-2: sliding does work that this energy does not contain.
    """
    planes, spheres = problem.values.planes, problem.values.spheres
    friction = np.append(planes[:, PLANES["friction"]], spheres[:, SPHERES["friction"]])
    return 1e-2 if (friction > 0.0).any() else 1e-5


def relative_error(displacement: Array, solution: Array, first: Array) -> float:
    """Relative error |x - x*| / |x_0 - x*| over all vertices."""
    return float(np.linalg.norm(displacement - solution) / np.linalg.norm(first - solution))


def _force_scale(problem: StepProblem) -> float:
    """Scale of the forces |grad E(0)| [N] at the start of the step; that of inertia if it is zero."""
    start = float(np.linalg.norm(problem.gradient(problem.first_iterate(problem.positions))))
    return start if start > 0.0 else float(np.linalg.norm(problem.weight * problem.time_step**2))


def _free_rows(problem: StepProblem) -> NDArray[np.int64]:
    return np.flatnonzero(np.repeat(problem.free, 3))


def newton(
    problem: StepProblem,
    first: Array | None = None,
    *,
    tolerance: float = 1e-10,
    iterations: int = 200,
    observe: Observer | None = None,
) -> Array:
    """The minimiser [V, 3] m near `first` of a step without contact, to rounding error.

    It requires |grad E(u)| <= tolerance |grad E(0)|, then continues to rounding. A stiff body almost at rest cannot
    reach such a gradient; a step shorter than the rounding of positions also ends the iteration.

    The direction uses the exact Hessian if it descends steeply enough, else the positive semidefinite one. Backtracking
    (Armijo, 1e-4) acts on the energy, and on |grad E| once energies differ only by rounding.

    Raises:
        ValueError: the scene has contacts.
        RuntimeError: the tolerance was not reached.
    """
    if len(problem.values.planes) or len(problem.values.spheres):
        raise ValueError("problem must have no planes or spheres for newton; use solve_with_contact")
    u = problem.first_iterate() if first is None else first
    rows, scale = _free_rows(problem), _force_scale(problem)
    rounding = float(np.finfo(np.float64).eps * np.linalg.norm(problem.positions))
    energy, gradient = problem.evaluate(u)
    for k in range(iterations):
        size = float(np.linalg.norm(gradient))
        direction = _newton_direction(problem, u, gradient, rows)[0] if size > 0.0 else gradient
        trial, trial_energy, trial_gradient = _descend(problem, u, energy, gradient, direction)
        gain = size - float(np.linalg.norm(trial_gradient))
        solved = size <= tolerance * scale or float(np.linalg.norm(direction)) <= rounding
        if solved and gain < 0.9 * size:
            return u
        if gain == 0.0:
            break
        u, energy, gradient = trial, trial_energy, trial_gradient
        if observe is not None:
            observe(k + 1, u)
    raise RuntimeError(
        f"newton: |grad E| must fall to {tolerance * scale:.3e} N, got {size:.3e} N; raise iterations or tolerance"
    )


def newton_step(problem: StepProblem, displacement: Array) -> Array | None:
    """Newton step [V, 3] m from u: to first order u* - u near a minimum.

    None if the exact Hessian gives no descent direction.
    """
    gradient = problem.evaluate(displacement)[1]
    direction, own = _newton_direction(problem, displacement, gradient, _free_rows(problem))
    return direction if own else None


def _descend(
    problem: StepProblem, displacement: Array, energy: float, gradient: Array, direction: Array
) -> tuple[Array, float, Array]:
    """Backtrack along a descent direction; returns the displacement itself if no step descends."""
    slope, size, length = float((direction * gradient).sum()), float(np.linalg.norm(gradient)), 1.0
    while length > 1e-12:
        trial = displacement + length * direction
        trial_energy, trial_gradient = problem.evaluate(trial)
        if abs(trial_energy - energy) <= 1e-12 * abs(energy):
            descends = float(np.linalg.norm(trial_gradient)) < size
        else:
            descends = trial_energy <= energy + 1e-4 * length * slope
        if descends:
            return trial, trial_energy, trial_gradient
        length *= 0.5
    return displacement, energy, gradient


def _newton_direction(
    problem: StepProblem, displacement: Array, gradient: Array, rows: NDArray[np.int64]
) -> tuple[Array, bool]:
    """Newton direction and True; if it does not descend, that of the positive semidefinite Hessian and False."""
    flat = gradient.reshape(-1)[rows]
    direction = np.zeros(gradient.size)
    for positive in (False, True):
        reduced = csc_array(problem.hessian(displacement, positive=positive)[rows][:, rows])
        direction[rows] = -splu(reduced).solve(flat)
        if direction[rows] @ flat <= -1e-6 * np.linalg.norm(direction) * np.linalg.norm(flat):
            break
    return direction.reshape(-1, 3), not positive


def solve_with_contact(
    problem: StepProblem, first: Array | None = None, *, tolerance: float = 1e-12, iterations: int = 20000
) -> Array:
    """The fixed point [V, 3] m of the guarded scheme: |r(u)| <= tolerance |grad E(0)|, r as in `StepProblem.residual`.

    Friction is exact Coulomb friction there. The contact force (n, t) of a slipping vertex satisfies
    |t| = friction |n|, with t against the displacement, for any length of the projected step.

    Raises:
        RuntimeError: the tolerance was not reached.
    """
    u = problem.first_iterate() if first is None else first
    scale = _force_scale(problem)
    for _ in range(0, iterations, 250):
        u = guarded_chebyshev(problem, u, iterations=250).displacement
        size = float(np.linalg.norm(problem.residual(u)))
        if size <= tolerance * scale:
            return u
    raise RuntimeError(
        f"solve_with_contact: |r| = {size:.3e} N after {iterations} iterations; raise iterations or tolerance"
    )


def spectrum(problem: StepProblem, *, weighted: bool = False) -> tuple[float, float]:
    """Smallest and largest eigenvalue of D^-1 A (Dbar^-1 A when `weighted`) over the free vertices."""
    free = np.flatnonzero(problem.free)
    diagonal = (problem.weighted_diagonal if weighted else problem.plain_diagonal)[free]
    half = diags_array(1.0 / np.sqrt(diagonal))
    scaled = csc_array(half @ problem.matrix[free][:, free] @ half)
    largest = eigsh(scaled, k=1, which="LA", return_eigenvectors=False)
    smallest = eigsh(scaled, k=1, sigma=0.0, which="LM", return_eigenvectors=False)
    return float(smallest[0]), float(largest[0])
