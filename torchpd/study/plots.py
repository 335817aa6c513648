"""Pictures of a study (matplotlib): error against time, each axis by itself, and the effect on a motion."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from .motion_plots import draw_axes, draw_contact, draw_trajectory
from .results_log import Row
from .step_plots import draw_cost, draw_solvers, draw_stiffness

__all__ = ["draw_study"]


def draw_study(rows: list[Row], out: Path, *, scene_name: str) -> list[Path]:
    """Write the pictures for which the rows have data."""
    drawers: dict[str, tuple[tuple[str, ...], Callable[[list[Row], Path, str], Path]]] = {
        "solver.png": (("solver",), draw_solvers),
        "stiffness.png": (("stiffness",), draw_stiffness),
        "cost.png": (("stiffness",), draw_cost),
        "axes.png": (("time step", "mesh", "float"), draw_axes),
        "trajectory.png": (("trajectory",), draw_trajectory),
        "contact.png": (("contact",), draw_contact),
    }
    written = []
    for name, (axes, draw) in drawers.items():
        chosen = [row for row in rows if row.axis in axes]
        if chosen:
            written.append(draw(chosen, out / name, scene_name))
    return written
