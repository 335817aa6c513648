"""What minimises the energy of one step: the iterations of the library in float64, and solutions to rounding error."""

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
    """The end of an iteration and what it went through."""

    displacement: Array  # [V, 3] u_K, aligned as the start was
    residual: float  # `StepProblem.relative_residual` of u_K, with the diagonal of the iteration
    iterations: int  # carried out
    restarts: list[int] = field(default_factory=list)  # iterations k whose check found the energy risen
    energies: list[tuple[int, float]] = field(default_factory=list)  # (k, E(u_k)) at every check
    converged: bool = False  # stopped by the tolerance


class _Plain:
    """omega = 1: Jacobi iteration."""

    def omega(self, iteration: int) -> float:
        return 1.0

    def check(self, energy: float) -> bool:
        return False


class _Classic:
    """The recurrence of Wang 2015: 1 before the delay S, 2 / (2 - rho^2) at S, 4 / (4 - rho^2 omega) after it."""

    def __init__(self, rho: float, delay: int) -> None:
        self.rho, self.delay, self.last = rho, delay, 1.0

    def omega(self, iteration: int) -> float:
        if iteration >= self.delay:
            at_start = iteration == self.delay
            self.last = 2.0 / (2.0 - self.rho**2) if at_start else 4.0 / (4.0 - self.rho**2 * self.last)
        return self.last

    def check(self, energy: float) -> bool:
        return False


class _Guarded:
    """Momentum kin / (kin + 3), up to the limit of Chebyshev's recurrence; it starts anew when the energy has risen."""

    def __init__(self, rho: float, tolerance: float) -> None:
        self.limit = ((1.0 - np.sqrt(1.0 - rho**2)) / rho) ** 2 if rho > 0.0 else 0.0
        self.tolerance, self.age, self.last = tolerance, 0, np.inf

    def omega(self, iteration: int) -> float:
        momentum = min(self.limit, self.age / (self.age + 3.0))
        self.age += 1
        return 1.0 + momentum

    def check(self, energy: float) -> bool:
        risen = energy > self.last * (1.0 + self.tolerance)
        self.age, self.last = 0 if risen else self.age, energy
        return bool(risen)


def classic_omegas(rho: float, delay: int, iterations: int) -> list[float]:
    """omega_0 .. omega_{K-1} of the classic schedule."""
    schedule = _Classic(rho, delay)
    return [schedule.omega(k) for k in range(iterations)]


def _iterate(
    problem: StepProblem,
    first: Array,
    schedule: _Plain | _Classic | _Guarded,
    *,
    diagonal: Array,
    relaxation: float,
    iterations: int,
    tolerance: float,
    observe: Observer | None,
) -> Iterates:
    """u_{k+1} = P(u_{k-1} + omega_k (u_k - theta g / D - u_{k-1})), u_{-1} = u_0."""
    result = Iterates(first, 1.0, 0)
    least = float((problem.weight / diagonal)[problem.free].min(initial=1.0))
    slowest, left = max(1.0 - relaxation * least, 0.0), 0.0
    previous = current = first
    coming = schedule.omega(0)
    for k in range(iterations):
        energy, gradient = problem.evaluate(current)
        omega, coming = coming, schedule.omega(k + 1)
        if k % 4 == 0:
            result.energies.append((k, energy))
            # acts on the omega after the next: the sums of one iteration are worked out during the next
            if schedule.check(energy):
                result.restarts.append(k)
        step = current - relaxation * gradient / diagonal[:, None]
        following = problem.project(previous + omega * (step - previous), current)
        previous, current = current, following
        result.iterations = k + 1
        if observe is not None:
            observe(k + 1, current)
        if tolerance > 0.0:
            left = _error_left(float(np.linalg.norm(current - previous)), left, slowest, omega)
            if left <= tolerance * _way(problem, previous):
                result.converged = True
                break
    result.displacement = problem.align(current)
    result.residual = problem.relative_residual(result.displacement, diagonal)
    return result


def _error_left(change: float, before: float, slowest: float, omega: float) -> float:
    """About |u - u*|, by the change of an iteration of weight omega and what was left before.

    An iteration leaves |r| of the slowest mode, r the larger root of r^2 - omega g r + omega - 1, where one of Jacobi's
    leaves g, and changes 1 - r of it where r is real. Where it is complex the mode swings and turns: what was left
    before counts on, times |r|.
    """
    square = (omega * slowest) ** 2 - 4.0 * (omega - 1.0)
    if square > 1e-6:
        kept = (omega * slowest + math.sqrt(square)) / 2.0
        return change / (1.0 - kept) if kept < 1.0 else math.inf
    kept = math.sqrt(omega - 1.0)
    return max(change / (1.0 - kept), kept * before)


def _way(problem: StepProblem, displacement: Array) -> float:
    """What elasticity and contacts have done, or gravity if that is more."""
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
    """Jacobi iteration; `observe(k, u_k)` sees every iterate from the first update on."""
    diagonal = problem.weighted_diagonal if weighted else problem.plain_diagonal
    return _iterate(problem, first, _Plain(), diagonal=diagonal, relaxation=relaxation, iterations=iterations,
                    tolerance=tolerance, observe=observe)  # fmt: skip


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
    """The accelerated iteration of the paper; rho estimates the spectral radius of the Jacobi iteration."""
    diagonal = problem.weighted_diagonal if weighted else problem.plain_diagonal
    return _iterate(problem, first, _Classic(rho, delay), diagonal=diagonal, relaxation=relaxation,
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
    """The default scheme of the library; rho = min(0.99999, 1 - theta mu) unless given.

    It restarts when the energy has risen by more than the share `check_tolerance` in four iterations, see
    `guard_tolerance`.
    """
    radius = min(0.99999, 1.0 - relaxation * problem.smallest_ratio if rho is None else rho)
    schedule = _Guarded(radius, guard_tolerance(problem) if check_tolerance is None else check_tolerance)
    return _iterate(problem, first, schedule, diagonal=problem.weighted_diagonal, relaxation=relaxation,
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
    """L-BFGS from H_0 = relaxation M, two loops over its pairs (Nocedal 1980), in a step without contact.

    Every iteration takes a full step. One that fails the decrease of Armijo, 1e-4, is an error, since what the library
    then does is not textbook; or it is halved until it does not, and the iterations end where no step descends.

    Args:
        problem: the step.
        first: u_0 [V, 3].
        precondition: M of a gradient [V, 3], zero at hard pins.
        iterations: to carry out.
        relaxation: of M, in (0, 2).
        memory: pairs that are kept, of those that saw positive curvature.
        backtrack: halve steps that fail.
        observe: sees (k, u_k) from the first update on.
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
                raise RuntimeError(f"preconditioned_lbfgs: iteration {k} fails to lower the energy enough")
        s, y = following - u, gradient - before
        curvature = float(np.vdot(s, y))
        if curvature > 0.0:
            pairs = [*pairs, (s, y, curvature)][-memory:]
        u = following
        if observe is not None:
            observe(k + 1, u)
    return u


def guard_tolerance(problem: StepProblem) -> float:
    """Relative rise of the energy that is no reason to restart.

    1e-5 for rounding. Sliding with friction does work that this energy does not contain: 1e-2 where there is friction.
    """
    planes, spheres = problem.values.planes, problem.values.spheres
    friction = np.append(planes[:, PLANES["friction"]], spheres[:, SPHERES["friction"]])
    return 1e-2 if (friction > 0.0).any() else 1e-5


def relative_error(displacement: Array, solution: Array, first: Array) -> float:
    """|x - x*| / |x_0 - x*| over all vertices."""
    return float(np.linalg.norm(displacement - solution) / np.linalg.norm(first - solution))


def _force_scale(problem: StepProblem) -> float:
    """|grad E(0)| [N]: all that is out of balance where the step starts; the size of inertia if that is nothing."""
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
    """The minimiser near `first` of a step without contact: |grad E(u)| <= tolerance |grad E(0)|, then on to rounding.

    Stiff bodies almost at rest cannot have such a gradient; a step shorter than positions round ends there too.

    Exact Hessian where its direction descends steeply enough, else the positive semidefinite one; backtracking on the
    energy (Armijo, 1e-4), and on |grad E| once energies differ by rounding only.
    """
    if len(problem.values.planes) or len(problem.values.spheres):
        raise ValueError("newton solves steps without contact; use solve_with_contact")
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
    raise RuntimeError(f"newton: stopped at |grad E| = {size:.3e} N, wanted {tolerance * scale:.3e} N")


def newton_step(problem: StepProblem, displacement: Array) -> Array | None:
    """Where the quadratic of E around u has its minimum, from u [V, 3] m: the first order of u* - u near a minimum.

    None where that is no way down.
    """
    gradient = problem.evaluate(displacement)[1]
    direction, own = _newton_direction(problem, displacement, gradient, _free_rows(problem))
    return direction if own else None


def _descend(
    problem: StepProblem, displacement: Array, energy: float, gradient: Array, direction: Array
) -> tuple[Array, float, Array]:
    """Backtrack along a descent direction; without any descent the displacement itself comes back."""
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
    """The step to the minimum of the quadratic; where that is no way down, of one that curves upwards, and False."""
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
    """The fixed point of the guarded scheme: |r(u)| <= tolerance |grad E(0)|, r as in `StepProblem.residual`.

    Exact Coulomb friction: there the contact forces (n, t) of a slipping vertex satisfy |t| = friction |n|, t against
    the displacement, whatever the length of the step that is projected.
    """
    u = problem.first_iterate() if first is None else first
    scale = _force_scale(problem)
    for _ in range(0, iterations, 250):
        u = guarded_chebyshev(problem, u, iterations=250).displacement
        size = float(np.linalg.norm(problem.residual(u)))
        if size <= tolerance * scale:
            return u
    raise RuntimeError(f"solve_with_contact: {iterations} iterations leave |r| = {size:.3e} N")


def spectrum(problem: StepProblem, *, weighted: bool = False) -> tuple[float, float]:
    """Smallest and largest eigenvalue of D^-1 A (Dbar^-1 A when `weighted`) over the free vertices."""
    free = np.flatnonzero(problem.free)
    diagonal = (problem.weighted_diagonal if weighted else problem.plain_diagonal)[free]
    half = diags_array(1.0 / np.sqrt(diagonal))
    scaled = csc_array(half @ problem.matrix[free][:, free] @ half)
    largest = eigsh(scaled, k=1, which="LA", return_eigenvectors=False)
    smallest = eigsh(scaled, k=1, sigma=0.0, which="LM", return_eigenvectors=False)
    return float(smallest[0]), float(largest[0])
