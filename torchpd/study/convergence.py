"""Convergence of the solvers to the converged step: error against iterations, measured and drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from tqdm.auto import tqdm

from ..accuracy.error import exact_steps, scene_without_friction
from ..accuracy.spectral_radius import estimate_rho
from ..api.simulator import Simulator
from ..common.checks import optional_module
from ..common.warn import warn_user
from ..scene.solvers import Chebyshev, Jacobi, Solver
from ..simulation.state import State

__all__ = ["ConvergenceCurve", "SolvedAlreadyError", "compare_solvers", "measure_convergence", "plot_convergence"]

# Okabe and Ito's palette, distinct under every kind of colour blindness
_COLORS = ("#8a8d93", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00")


_UNCERTAINTY_LIMIT = (
    1e-6  # uncertainty of the converged step, in the unit of the errors, above which a warning is given
)


class SolvedAlreadyError(ValueError):
    """The step leaves nothing to measure: its first iterate is its solution."""


@dataclass(frozen=True)
class ConvergenceCurve:
    """Error |x - x*| / |x_0 - x*| of one solver in one time step; x* is the converged step, x_0 = x + h v."""

    solver: Solver
    iterations: tuple[int, ...]
    errors: tuple[float, ...]  # inf where the iteration overflowed


@torch.no_grad()
def measure_convergence(
    sim: Simulator, state: State, solvers: Mapping[str, Solver], *, iterations: int = 256, progress: bool = False
) -> dict[str, ConvergenceCurve]:
    """Error against iterations of each solver in one step from `state`, in float64 and without friction.

    With friction a sticking vertex has many solutions, all positions inside its friction cone, and each solver stops at
    another one. Their distance would measure neither.

    Args:
        sim: the scene and its time step; its own solver and precision are ignored.
        state: the start of the step, [1, V, 3].
        solvers: the solvers, by their name in the result.
        iterations: the largest of about thirty iteration counts.
        progress: show a progress bar.

    Raises:
        ValueError: the state holds several environments.
        SolvedAlreadyError: the first iterate is the solution.
    """
    if len(state.positions) != 1:
        raise ValueError(f"measure_convergence: state must hold one environment, got {len(state.positions)}")
    study, start = _study(sim, Chebyshev()), _double(state)
    counts = np.unique(np.geomspace(1, max(iterations, 1), 30).round().astype(int)).tolist()

    def after(solver: Solver, count: int) -> torch.Tensor:
        study.solver, study.iterations = solver, count
        after_step: State = study(start)
        return after_step.positions

    exact = exact_steps(study, start)[0]
    if exact.uncertainty > _UNCERTAINTY_LIMIT:
        warn_user(
            f"measure_convergence: the converged step has an uncertainty of {exact.uncertainty:.1g} in the unit of the "
            "curves; ignore errors below it"
        )
    solution = start.positions + torch.from_numpy(exact.solution).to(start.positions.device)
    scale = exact.scale
    # rounding of positions strains a body slightly, even in free fall
    rounding = 10.0 * torch.finfo(state.positions.dtype).eps * float(start.positions.norm())
    if float((after(Chebyshev(), 0) - solution).norm()) <= rounding:
        raise SolvedAlreadyError("measure_convergence: the first iterate solves this step already (free fall, or rest)")
    curves = {}
    with tqdm(total=len(solvers) * len(counts), desc="convergence", disable=not progress, leave=False) as bar:
        for name, solver in solvers.items():
            errors = []
            for count in counts:
                error = float((after(solver, count) - solution).norm()) / scale
                errors.append(error if np.isfinite(error) else np.inf)
                bar.update(1)
            curves[name] = ConvergenceCurve(solver, tuple(counts), tuple(errors))
    return curves


def compare_solvers(
    sim: Simulator, state: State, *, iterations: int = 256, progress: bool = False
) -> dict[str, ConvergenceCurve]:
    """`measure_convergence` of Jacobi, classic Chebyshev with the paper's two-stage rho, and guarded Chebyshev."""
    rho = estimate_rho(_study(sim, Jacobi(diagonal="plain")), _double(state), method="two-stage")
    solvers: dict[str, Solver] = {
        "Jacobi": Jacobi(diagonal="plain"),
        f"classic Chebyshev, rho = {rho:.4f}": Chebyshev("classic", rho=rho),
        "guarded Chebyshev (default)": Chebyshev(),
    }
    return measure_convergence(sim, state, solvers, iterations=iterations, progress=progress)


def _study(sim: Simulator, solver: Solver) -> Simulator:
    """A simulator of the same scene without friction, in float64."""
    scene = scene_without_friction(sim.scene)
    return Simulator(scene, sim.time_step, sim.iterations, solver, dtype=torch.float64, progress=False).to(sim.device)


def _double(state: State) -> State:
    return State(state.positions.double(), state.velocities.double())


def plot_convergence(
    curves: Mapping[str, ConvergenceCurve], path: str | Path, *, title: str, mark: int | None = None
) -> Path:
    """Draw the curves into a picture file.

    Args:
        curves: from `measure_convergence`; the last one is emphasised.
        path: the picture file.
        title: one line above the plot.
        mark: number of iterations to mark by a vertical line, for example those of a run.
    """
    figure = optional_module("matplotlib.figure", "matplotlib", "plots").Figure(
        figsize=(8.0, 5.0), dpi=150, layout="constrained"
    )
    axes = figure.add_subplot()
    lowest = min(min(curve.errors) for curve in curves.values())
    for number, (name, curve) in enumerate(curves.items()):
        last = number == len(curves) - 1
        errors = np.minimum(curve.errors, 30.0)  # a diverging curve leaves the plot at the top
        axes.plot(
            (0, *curve.iterations),
            (1.0, *errors),
            color=_COLORS[number % len(_COLORS)],
            linewidth=2.6 if last else 1.8,
            solid_capstyle="round",
            label=name,
        )
    most = max(curve.iterations[-1] for curve in curves.values())
    axes.set_yscale("log")
    axes.set_xlim(0, most)
    axes.set_ylim(np.clip(10.0 ** np.floor(np.log10(max(lowest, 1e-15))), 1e-10, 1e-2), 3.0)
    if mark is not None and mark <= most:
        axes.axvline(mark, color="#3e4046", linewidth=1.0, linestyle=(0, (2, 3)))
        axes.annotate(
            f" {mark} iterations ", (mark, 1.0), xycoords=("data", "axes fraction"), xytext=(0, -12),
            textcoords="offset points", color="#3e4046", fontsize=9, ha="left" if mark < 0.8 * most else "right",
        )  # fmt: skip
    axes.set_xlabel("iterations of one time step")
    axes.set_ylabel(r"error  $|x - x^*|\;/\;|x_0 - x^*|$")
    axes.set_title(title, loc="left", fontsize=11, color="#3e4046")
    axes.grid(which="major", color="#e4e5e8", linewidth=0.8)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(frameon=False, loc="outside lower center", ncols=3)
    figure.savefig(path)
    return Path(path)
