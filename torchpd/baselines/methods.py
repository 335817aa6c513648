"""Published methods on the step of `reference`, for comparison with the library: float64, on the CPU.

Iterations and errors of these methods are exact. Their local step is the compiled one of the library (`CompiledStep`)
on the same number of threads, so that milliseconds compare methods. `Baseline.parts` names the rest of the code:

- SuperLU's triangular solves are compiled, but not tuned to the machine.
- NumPy loops over vertices, colours or elements add an overhead of their own: such milliseconds are upper bounds.
- The twins of compiled solvers, "..., NumPy", are NumPy throughout. Compare "guarded Chebyshev, NumPy" with
  "guarded Chebyshev" for the cost of the language.

Every method starts from the same iterate. Contacts need a projection per vertex (the Jacobi family) or active sets
(Newton-PCG, without friction).
"""

from __future__ import annotations

import dataclasses
import time
import tracemalloc
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import cg, splu

from ..common.checks import optional_module
from ..common.tables import PLANES, SPHERES
from ..reference.problem import StepProblem
from ..reference.solvers import (
    classic_chebyshev,
    classic_omegas,
    guarded_chebyshev,
    jacobi,
    newton,
    preconditioned_lbfgs,
)
from .compiled_step import CompiledStep, CountedStep
from .contact_newton import ContactNewton
from .newton_krylov import NewtonKrylov

__all__ = [
    "BASELINES",
    "Baseline",
    "GaussSeidel",
    "Trace",
    "colour_vertices",
    "factorised",
    "refuse_contacts",
    "run_baseline",
    "two_stage_rho",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Observer = Callable[[int, Array], None]
Solve = Callable[[Array], Array]  # an approximate A^-1 on [V, 3]
Run = Callable[[int, Observer], object]  # (iterations, observer): runs up to so many iterations

_PCG_TOLERANCE = 1e-2  # |A d - r| / |r| of an inexact global step
_LBFGS_PAIRS = 8


@dataclass(frozen=True)
class Baseline:
    """A method: `prepare(problem, first)` does the work once per step and returns the iteration."""

    prepare: Callable[[StepProblem, Array], Run]
    contacts: bool = False  # supports planes and spheres
    compiled_twin: str | None = None  # the compiled solver with the same iterates; this one runs in NumPy throughout
    parts: str = "NumPy"  # languages and libraries it runs in
    iteration: str = "local step + global step"  # work of one iteration
    few: bool = False  # ten or twenty iterations find the minimum to rounding


@dataclass
class Trace:
    """History of a baseline run, by iteration."""

    setup_seconds: float  # colouring, factorisation, estimate of rho
    displacements: dict[int, Array] = field(default_factory=dict)  # [V, 3] m
    seconds: dict[int, float] = field(default_factory=dict)  # after the set-up, without the observer
    local_steps: dict[int, int] = field(default_factory=dict)  # evaluations of E and grad E, products with H
    peak_bytes: int = 0  # largest allocation of Python and NumPy, if requested

    @property
    def last(self) -> int:
        """The last iteration done."""
        return max(self.displacements)


def refuse_contacts(problem: StepProblem) -> None:
    """Refuse a scene with contacts, for methods that do not support them.

    Raises:
        ValueError: the scene has planes or spheres.
    """
    planes, spheres = len(problem.values.planes), len(problem.values.spheres)
    if planes or spheres:
        raise ValueError(
            f"scene must have no contacts for this method; got {planes} planes and {spheres} spheres: "
            "use the Jacobi family or Newton-PCG"
        )


def run_baseline(
    method: Baseline,
    problem: StepProblem,
    first: Array,
    iterations: int,
    *,
    memory: bool = False,
    clock: Callable[[], float] = time.perf_counter,
) -> Trace:
    """Iterate from `first` and keep every iterate; BLAS uses as many threads as torch.

    Args:
        method: an entry of `BASELINES`.
        problem: the step.
        first: u_0 [V, 3] m.
        iterations: upper limit; a method that finds the minimum earlier stops there.
        memory: trace allocations. This slows the run: do not use its times.
        clock: returns seconds.

    Raises:
        ValueError: the scene has contacts and the method does not support them.
    """
    if not method.contacts:
        refuse_contacts(problem)
    fields = {f.name: getattr(problem, f.name) for f in dataclasses.fields(StepProblem)}
    counted = (CountedStep if method.compiled_twin else CompiledStep)(**fields)
    if memory:
        tracemalloc.start()
    try:
        with _blas_threads():
            counted.evaluate(first)  # compiles the plan or assembles the operator: common to all methods, not timed
            begin = clock()
            run = method.prepare(counted, first)
            trace = Trace(clock() - begin, {0: first}, {0: 0.0}, {0: 0})
            counted.calls[0] = 0
            stopwatch = _Stopwatch(clock)

            def observe(iteration: int, displacement: Array) -> None:
                with stopwatch.paused():
                    trace.displacements[iteration] = np.array(displacement)
                    trace.seconds[iteration] = stopwatch.seconds
                    trace.local_steps[iteration] = counted.calls[0]

            run(iterations, observe)
        trace.peak_bytes = tracemalloc.get_traced_memory()[1] if memory else 0
    finally:
        if memory:
            tracemalloc.stop()
    return trace


def _blas_threads() -> AbstractContextManager[object]:
    """Limit BLAS to the threads of torch: processor time also counts threads that wait."""
    threads = optional_module("threadpoolctl", "threadpoolctl", "studies", "study")
    limits: AbstractContextManager[object] = threads.threadpool_limits(torch.get_num_threads(), user_api="blas")
    return limits


class _Stopwatch:
    """Elapsed time [s] without the pauses."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock, self._begin, self.seconds = clock, clock(), 0.0

    def paused(self) -> _Stopwatch:
        return self

    def __enter__(self) -> None:
        self.seconds += self._clock() - self._begin

    def __exit__(self, *_: object) -> None:
        self._begin = self._clock()


# ---- splittings: u <- u_prev + omega (u - P^-1 grad E(u) - u_prev)


def _iterate(problem: StepProblem, first: Array, solve: Solve, omegas: list[float], observe: Observer) -> Array:
    """The Chebyshev semi-iterative method on the splitting P of A; omega = 1 is the plain iteration."""
    before = current = first
    for k, omega in enumerate(omegas):
        stepped = current - solve(problem.gradient(current))
        current, before = before + omega * (stepped - before), current
        observe(k + 1, current)
    return current


def _ignore(iteration: int, displacement: Array) -> None:
    """An observer that does nothing."""


def two_stage_rho(problem: StepProblem, first: Array, solve: Solve, *, iterations: int = 32, delay: int = 10) -> float:
    """The source paper's estimate of rho for any splitting: |e^K| / |e^{K-1}| with e = grad E, refined by trial runs.

    Source: Vyatkin and Dolgovesov 2023; the same search as `torchpd.estimate_rho`.
    """

    def residual(omegas: list[float]) -> float:
        with np.errstate(all="ignore"):
            size = float(np.linalg.norm(problem.gradient(_iterate(problem, first, solve, omegas, _ignore))))
        return size if np.isfinite(size) else np.inf

    before, after = (residual([1.0] * k) for k in (iterations - 1, iterations))
    ratio = min(after / before, 0.99999) if 0.0 < before < np.inf else 0.9
    trials = [min(max(1.0 - (1.0 - ratio) * 0.5**halvings, 0.05), 0.99999) for halvings in range(-1, 8)]
    return min((residual(classic_omegas(rho, delay, iterations)), rho) for rho in trials)[1]


def colour_vertices(matrix: csr_array) -> Index:
    """A colour for every row; rows of one colour share no entry. Greedy, largest degree first.

    networkx gives the same colours in 30 times the time.
    """
    starts, neighbours = matrix.indptr, matrix.indices
    colours = np.full(matrix.shape[0], -1, dtype=np.int64)
    for vertex in np.argsort(-np.diff(starts), kind="stable"):
        taken = set(colours[neighbours[starts[vertex] : starts[vertex + 1]]].tolist())
        colours[vertex] = next(colour for colour in range(len(taken) + 1) if colour not in taken)
    return colours


class GaussSeidel:
    """One coloured Gauss-Seidel sweep of A d = r from d = 0: vertices of one colour at once (Fratarcangeli 2016).

    `symmetric` adds a backward sweep. The iteration matrix is then similar to a symmetric one with eigenvalues in
    [0, 1), as the Chebyshev method requires.
    """

    def __init__(self, problem: StepProblem, *, symmetric: bool = False) -> None:
        free = np.flatnonzero(problem.free)
        matrix = csr_array(problem.matrix[free][:, free])
        colours = colour_vertices(matrix)
        self.free, self.symmetric = free, symmetric
        self.groups = [np.flatnonzero(colours == colour) for colour in range(int(colours.max()) + 1)]
        self._rows = [csr_array(matrix[group]) for group in self.groups]
        self._inverse = [1.0 / matrix.diagonal()[group][:, None] for group in self.groups]

    def __call__(self, residual: Array) -> Array:
        right, d = residual[self.free], np.zeros((len(self.free), residual.shape[1]))
        order = list(range(len(self.groups)))
        for colour in [*order, *reversed(order)] if self.symmetric else order:
            group = self.groups[colour]
            d[group] += self._inverse[colour] * (right[group] - self._rows[colour] @ d)
        out = np.zeros_like(residual)
        out[self.free] = d
        return out


def _conjugate_gradients(problem: StepProblem) -> Solve:
    """An inexact global step: SciPy's CG with the diagonal preconditioner, to 1e-2, axis by axis."""
    free = np.flatnonzero(problem.free)
    matrix = csr_array(problem.matrix[free][:, free])
    inverse = diags_array(1.0 / matrix.diagonal())

    def solve(residual: Array) -> Array:
        out = np.zeros_like(residual)
        for axis in range(3):
            out[free, axis] = cg(matrix, residual[free, axis], rtol=_PCG_TOLERANCE, M=inverse)[0]
        return out

    return solve


def factorised(problem: StepProblem) -> Solve:
    """An exact global step: a sparse factorisation made once (SuperLU through SciPy)."""
    free = np.flatnonzero(problem.free)
    factor = splu(csc_array(problem.matrix[free][:, free]), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})

    def solve(residual: Array) -> Array:
        out = np.zeros_like(residual)
        out[free] = factor.solve(residual[free])
        return out

    return solve


def _plain(make: Callable[[StepProblem], Solve]) -> Callable[[StepProblem, Array], Run]:
    def prepare(problem: StepProblem, first: Array) -> Run:
        solve = make(problem)
        return lambda iterations, observe: _iterate(problem, first, solve, [1.0] * iterations, observe)

    return prepare


def _accelerated(make: Callable[[StepProblem], Solve]) -> Callable[[StepProblem, Array], Run]:
    def prepare(problem: StepProblem, first: Array) -> Run:
        solve = make(problem)
        rho = two_stage_rho(problem, first, solve)
        return lambda iterations, observe: _iterate(problem, first, solve, classic_omegas(rho, 10, iterations), observe)

    return prepare


# ---- the library's own iterations in NumPy, and second-order methods


def _jacobi(problem: StepProblem, first: Array) -> Run:
    return lambda iterations, observe: jacobi(problem, first, iterations=iterations, weighted=False, observe=observe)


def _classic(problem: StepProblem, first: Array) -> Run:
    diagonal = problem.plain_diagonal[:, None]
    rho = two_stage_rho(problem, first, lambda gradient: gradient / diagonal, iterations=64)
    return lambda iterations, observe: classic_chebyshev(
        problem, first, iterations=iterations, rho=rho, observe=observe
    )


def _guarded(problem: StepProblem, first: Array) -> Run:
    return lambda iterations, observe: guarded_chebyshev(problem, first, iterations=iterations, observe=observe)


def _newton(problem: StepProblem, first: Array) -> Run:
    def run(iterations: int, observe: Observer) -> None:
        try:
            newton(problem, first, iterations=iterations, observe=observe)
        except RuntimeError:
            return  # stopped before the minimum, as intended: the study measures the error there

    return run


def _newton_krylov(problem: StepProblem, first: Array) -> Run:
    """Newton-PCG; with contacts, on active sets."""
    passes = problem.calls if isinstance(problem, CountedStep) else [0]
    planes, spheres = problem.values.planes, problem.values.spheres
    if not len(planes) and not len(spheres):
        method = NewtonKrylov(problem, passes)
        return lambda iterations, observe: method.minimise(first, iterations, observe)
    if (planes[:, PLANES["friction"]] > 0.0).any() or (spheres[:, SPHERES["friction"]] > 0.0).any():
        raise ValueError("friction of planes and spheres must be 0 for Newton-PCG with M; set friction=0")
    sets = ContactNewton(problem, passes)
    return lambda iterations, observe: sets.minimise(first, iterations=iterations, observe=observe)


def _quasi_newton(problem: StepProblem, first: Array) -> Run:
    """L-BFGS that starts from the global step, with backtracking (Liu, Bouaziz and Kavan 2017)."""
    solve = factorised(problem)
    return lambda iterations, observe: preconditioned_lbfgs(
        problem, first, solve, iterations=iterations, relaxation=1.0, memory=_LBFGS_PAIRS, backtrack=True,
        observe=observe,
    )  # fmt: skip


def _lbfgs(problem: StepProblem, first: Array) -> Run:
    """SciPy's L-BFGS-B in the variables sqrt(D) u, which applies the preconditioner of the Jacobi family."""
    free = problem.free
    scale = np.sqrt(problem.plain_diagonal[free])[:, None]

    def displaced(flat: Array) -> Array:
        u = np.array(first)
        u[free] = flat.reshape(-1, 3) / scale
        return u

    def objective(flat: Array) -> tuple[float, Array]:
        energy, gradient = problem.evaluate(displaced(flat))
        return energy, (gradient[free] / scale).reshape(-1)

    def run(iterations: int, observe: Observer) -> None:
        count = 0

        def callback(flat: Array) -> None:
            nonlocal count
            count += 1
            observe(count, displaced(flat))

        options = {"maxiter": iterations, "maxfun": 20 * iterations, "maxcor": _LBFGS_PAIRS, "ftol": 0.0, "gtol": 0.0}
        start = (first[free] * scale).reshape(-1)
        minimize(objective, start, jac=True, method="L-BFGS-B", callback=callback, options=options)

    return run


BASELINES: dict[str, Baseline] = {
    "Jacobi, NumPy": Baseline(_jacobi, contacts=True, compiled_twin="Jacobi"),
    "classic Chebyshev, NumPy": Baseline(_classic, contacts=True, compiled_twin="classic Chebyshev"),
    "guarded Chebyshev, NumPy": Baseline(_guarded, contacts=True, compiled_twin="guarded Chebyshev"),
    "Gauss-Seidel": Baseline(
        _plain(GaussSeidel), iteration="local step + one sweep over the colours", parts="C++, sweeps in SciPy"
    ),
    "Gauss-Seidel + Chebyshev": Baseline(
        _accelerated(lambda problem: GaussSeidel(problem, symmetric=True)),
        iteration="local step + sweep there and back",
        parts="C++, sweeps in SciPy",
    ),
    "PCG global step": Baseline(
        _plain(_conjugate_gradients), iteration="local step + CG to 1e-2", parts="C++, CG in SciPy"
    ),
    "direct global step": Baseline(
        _plain(factorised), iteration="local step + two triangular solves", parts="C++, SuperLU"
    ),
    "direct global step + Chebyshev": Baseline(
        _accelerated(factorised), iteration="local step + two triangular solves", parts="C++, SuperLU"
    ),
    "Newton": Baseline(
        _newton,
        iteration="Hessian, factorisation, line search",
        few=True,
        parts="C++, Hessian in NumPy, SuperLU",
    ),
    "Newton-PCG with M": Baseline(
        _newton_krylov,
        contacts=True,
        few=True,
        iteration="conjugate gradients on the Hessian, line search",
        parts="C++, torch; contacts in NumPy",
    ),
    "L-BFGS": Baseline(_lbfgs, iteration="local step + two-loop recursion", parts="C++, SciPy"),
    "L-BFGS with A^-1": Baseline(
        _quasi_newton,
        iteration="local step + two-loop recursion around two triangular solves",
        parts="C++, SuperLU, NumPy",
    ),
}
