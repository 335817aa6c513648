"""`solver="auto"`: guarded Chebyshev or Multilevel, whichever should reach an error of 1e-3 sooner.

The choice is made when the simulator is created or moved, and by `Simulator.prepare_solver`. It uses the convergence
estimate (`forecast`) and the cost of an iteration on the device, for the batch given to the simulator. Nothing is
timed, so the choice is reproducible. The batch of a state has no influence: an environment gives the same bits alone
and in any batch.

The estimate bounds the iterations of a step. A tolerance of half the aim ends each step: steps of one motion need
different numbers, and no estimate made before the motion knows them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch

from ..common.gpu import H100
from ..common.warn import warn_user
from ..plan.compiled import CompiledScene
from ..plan.kernel_costs import iteration_microseconds
from ..plan.preconditioner import MOST_DIRECT
from ..scene.solvers import DEFAULT_ITERATIONS, Chebyshev, Jacobi, Multilevel, Solver, check_solver
from .convergence import (
    FAR_TOO_FEW,
    LANDING_ROOTS,
    MOST_OF_LEVELS,
    Forecast,
    Spectrum,
    UnsolvedWarning,
    forecast,
    has_contacts,
    held_up_by,
    is_bound,
    spectrum_of,
)

__all__ = [
    "AIM",
    "CPU_CHEBYSHEV",
    "TOLERANCE",
    "Choice",
    "Cost",
    "choose_solver",
    "multilevel_cost",
    "runs",
    "warn_of_few_iterations",
]

AIM = 1e-3  # relative error that "auto" sets the iterations for
MARGIN = 1.8  # factor on the estimate: enough for 19 of 20 random scenes, and for 99 of 100 steps with an impact
PATIENCE = 4  # further factor, since the tolerance ends easy steps early: hard steps, which no estimate covers, need it
# Tolerance of "auto". Its estimate of the error is up to twice too small in 19 of 20 steps (benchmarks/landings.py).
TOLERANCE = AIM / 2.0
# most iterations, times `PATIENCE`: float32 resolves no more, and a step must end
MOST_OF_CHEBYSHEV = 10_000
# Factor on the time of a Multilevel iteration with contacts. Resting boxes of 125 to 9,261 vertices, compared with
# swinging ones, took 1.1 to 1.7 times as long on an H100, 1.1 to 1.4 times on the CPU.
ON_CONTACTS = 1.4


class Cost(NamedTuple):
    """Time of an iteration in microseconds, for n thousand vertices per environment.

    The first environment takes `latency` + `each` n; every further one takes `more` n + `square` n^2, but no longer
    than the first.
    """

    latency: float
    each: float
    more: float = math.inf
    square: float = 0.0

    def iteration(self, vertices: int, batch: int = 1) -> float:
        """Microseconds of an iteration of all environments."""
        return self.first(vertices) + (batch - 1) * self.other(vertices)

    def first(self, vertices: int) -> float:
        """Microseconds of one environment alone."""
        return self.latency + self.each * vertices / 1000.0

    def other(self, vertices: int) -> float:
        """Microseconds that every further environment adds."""
        thousands = vertices / 1000.0
        return min(self.first(vertices), self.more * thousands + self.square * thousands**2)


# Float32, by `benchmarks/time_to_error.py`, further environments with --batch. The CPU is one AVX-512 core, the GPU an
# H100, where the Chebyshev costs are those of `torchpd.plan.kernel_costs`.
CPU_CHEBYSHEV, CPU_MULTILEVEL = Cost(0.5, 45.0), Cost(2.0, 170.0)
# Batches: 1024 environments of 256 and 936 vertices, 16 of 3,321 and 10,309; the squares are fitted to these. Up to
# MOST_DIRECT vertices M is an inverse without levels; above about 12 thousand it has three levels.
_DIRECT = Cost(30.0, 3.0, 0.73, 0.49)
_TWO_LEVELS, _THREE_LEVELS = Cost(37.0, 0.9, 0.5, 0.098), Cost(49.0, 2.05, 0.5, 0.098)
_MOST_OF_TWO_LEVELS = 12_000


def multilevel_cost(vertices: int, *, on_gpu: bool) -> Cost:
    """Cost of an iteration of `Multilevel`."""
    if not on_gpu:
        return CPU_MULTILEVEL
    if vertices <= MOST_DIRECT:
        return _DIRECT
    return _TWO_LEVELS if vertices <= _MOST_OF_TWO_LEVELS else _THREE_LEVELS


@dataclass(frozen=True)
class Choice:
    """Result of "auto"."""

    iterations: int
    sets_iterations: bool  # the user gave none
    why: str  # continues "chosen because"
    capped: bool = False  # more would be needed, but a step must end


def choose_solver(compiled: CompiledScene, iterations: int | None) -> tuple[Solver, Choice]:
    """Choose the solver for a scene and device, with a reason.

    Chebyshev gets a relaxation of min(1.9, 2 / (1 + mu)), which is optimal for a spectrum of [mu, 1]. On smooth planes
    the iterations of Multilevel are for an impact, a hard one for an uneven body. Without `iterations`, its cost is
    compared at the count of other steps.

    Args:
        compiled: scene, time step, material, device and batch.
        iterations: given by the user, and kept: Chebyshev if they suffice for it, else the solver with the smaller
            error (Chebyshev with friction or spheres). None: the estimate for an error of `AIM`, times `MARGIN`, up to
            `MOST_OF_CHEBYSHEV` or `MOST_OF_LEVELS`, times `PATIENCE`; the tolerance ends most steps long before.
    """

    def chosen(enough: int, why: str, most: int = MOST_OF_CHEBYSHEV) -> Choice:
        if iterations is not None:
            return Choice(iterations, False, why)
        capped = enough > most
        why += f'; "auto" takes no more than {most * PATIENCE:,}' if capped else ""
        return Choice(min(enough, most) * PATIENCE, True, why, capped)

    spectrum = spectrum_of(compiled)
    chebyshev: Solver = Chebyshev(relaxation=_relaxation(spectrum))
    if spectrum is None:
        return chebyshev, chosen(DEFAULT_ITERATIONS, "all vertices are pinned, or values are unknown")
    if cause := held_up_by(compiled):
        plain = _known(forecast(compiled, chebyshev, spectrum))
        why = f"{plain.words(AIM)} iterations of Chebyshev reach {AIM:g}, and {cause} may stall Multilevel"
        return chebyshev, chosen(_enough(plain), why)
    multilevel = Multilevel()
    plain, levels = (_known(forecast(compiled, solver, spectrum)) for solver in (chebyshev, multilevel))
    counts = f"{plain.words(AIM)} iterations of Chebyshev reach {AIM:g}"
    if not runs(multilevel, compiled):
        where = (
            "a scene with Contact"
            if compiled.scene.contact is not None
            else (
                f"{compiled.device} with kernel={compiled.kernel!r}"
                if compiled.device.type == "cuda"
                else str(compiled.device)
            )
        )
        return chebyshev, chosen(_enough(plain), f"{counts}, and Multilevel does not run on {where}")
    batch = compiled.batch or 1
    ratio = _multilevel_time(compiled, batch) / _chebyshev_time(compiled, batch)
    both = f"{counts}, or {levels.words(AIM)} of Multilevel, each as long as {ratio:.2g}"
    both += f" in a batch of {batch}" if batch > 1 else ""
    if iterations is None:
        count = float(levels.iterations(AIM))
        usual = LANDING_ROOTS * math.sqrt(plain.iterations(AIM))
        if has_contacts(compiled) and usual < count:
            count = usual
            both += f"; about {round(usual)} where no sliver or soft part lands"
        better = count * ratio < plain.iterations(AIM)
    else:
        better = iterations < _enough(plain) and levels.rate > plain.rate
        both += f"; {iterations} leave about {plain.error(iterations):.1g} or {levels.error(iterations):.1g}"
    if better:
        return multilevel, chosen(_enough(levels), both, MOST_OF_LEVELS)
    return chebyshev, chosen(_enough(plain), both)


def _chebyshev_time(compiled: CompiledScene, batch: int) -> float:
    """Microseconds of a Chebyshev iteration of a batch in float32; on a GPU for its own plan on an H100.

    The same holds for Multilevel on every GPU and in every precision: only the ratio of both matters.
    """
    if compiled.plan.kernel is None:
        return CPU_CHEBYSHEV.iteration(compiled.vertices, batch)
    return iteration_microseconds(compiled.plan, compiled.named["stiffness"].shape[-1], batch, H100, torch.float32)


def _multilevel_time(compiled: CompiledScene, batch: int) -> float:
    """Microseconds of a `Multilevel` iteration of a batch."""
    free = multilevel_cost(compiled.vertices, on_gpu=compiled.plan.kernel is not None).iteration(
        compiled.vertices, batch
    )
    return free * (ON_CONTACTS if has_contacts(compiled) else 1.0)


def _known(expected: Forecast | None) -> Forecast:
    assert expected is not None  # both have the weighted diagonal
    return expected


def _enough(expected: Forecast) -> int:
    return round(MARGIN * expected.iterations(AIM))


def _relaxation(spectrum: Spectrum | None) -> float | None:
    """Relaxation of Chebyshev; None keeps its default 1.9, which is best for ill-conditioned steps."""
    if spectrum is None:
        return None
    best = 2.0 / (1.0 + spectrum.least)
    return best if best < Chebyshev().settings()["relaxation"] else None


def runs(solver: Solver, compiled: CompiledScene) -> bool:
    """Whether there are kernels for the solver on the device of the scene."""
    if compiled.scene.contact is not None and not isinstance(solver, Chebyshev | Jacobi):
        return False
    try:
        check_solver(solver, compiled.device)
    except RuntimeError:
        return False
    if compiled.device.type != "cuda" or not isinstance(solver, Multilevel):
        return True
    return compiled.kernel in ("auto", "stream") and not compiled.has_stencils


def warn_of_few_iterations(compiled: CompiledScene, choice: Choice | None, changed: str | None = None) -> bool:
    """Warn when the default iterations, or those of "auto", leave a large error.

    Args:
        compiled: with the default iterations, or those of "auto".
        choice: of "auto", which aims at `AIM`; up to ten times that is accepted.
        changed: name of the call that changed material or time step; None when the simulator was just created.

    Returns:
        Whether it warned.
    """
    enough, capped = (FAR_TOO_FEW, False) if choice is None else (10.0 * AIM, choice.capped)
    if is_bound(compiled) and (choice is None or capped):
        return False  # most steps need far fewer
    expected = forecast(compiled)
    if expected is None or expected.error(compiled.iterations) <= enough:
        return False
    count, left = compiled.iterations, expected.error(compiled.iterations)
    what, verb, ways = f"the default of {count} iterations", "leaves", "Give iterations=..., or take"
    if changed is not None:
        what, verb, ways = f"{count} iterations", "now leave", "Set sim.iterations, or take"
    ways += ' solver="auto", or ask sim.tune(error=1e-2)'
    if capped:
        what, verb = f'the {count:,} iterations that "auto" takes at most', "leave"
        ways = "Take a shorter time_step, or give iterations=..."
    elif choice is not None:
        what += ' that "auto" chose before'
        ways = "sim.prepare_solver() chooses again"
    warn_user(
        f"{changed or 'Simulator'}: {what} {verb} a relative error of about {left:.1g} per step (1: unsolved); "
        f"{expected.words(1e-2)} reach 1e-2. {ways}",
        UnsolvedWarning,
    )
    return True
