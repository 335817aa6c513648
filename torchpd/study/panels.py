"""Panels of a study's pictures (matplotlib): axes, failures and what is uncertain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from .curves import TOP
from .results_log import Row

__all__ = ["INK", "LOWEST", "OTHER", "drawn", "error_axis", "figure_of", "mark_failures", "note_uncertain"]

LOWEST = 1e-7
OTHER = ("#b0447b", 2.0, "solid")  # solvers without a style above  # solvers without a style
INK, _PAPER_GRID = "#3e4046", "#e4e5e8"


def figure_of(columns: int, title: str, *, width: float = 5.2) -> tuple[Any, list[Any]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width * columns, 4.8), dpi=140, layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, color=INK)
    axes = list(figure.subplots(1, columns, squeeze=False)[0])
    for axis in axes:
        axis.grid(which="major", color=_PAPER_GRID, linewidth=0.8)
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def error_axis(axis: Any, errors: list[float], label: str) -> None:
    lowest = min((error for error in errors if 0.0 < error < math.inf), default=1e-2)
    axis.set_yscale("log")
    axis.set_ylim(max(10.0 ** math.floor(math.log10(lowest)), LOWEST), 3.0)
    axis.set_ylabel(label)


def drawn(rows: list[Row]) -> list[float]:
    """Plotted errors: failures at the top, values below the axis on its edge."""
    return [min(max(row.error, LOWEST), TOP) for row in rows]


def mark_failures(axis: Any, xs: Sequence[float | None], rows: list[Row], color: str) -> None:
    """Draw crosses at the top, and rings around uncertain errors."""
    failed = [x for x, row in zip(xs, rows, strict=True) if row.failed]
    if failed:  # an empty unclipped line has no bounds, which breaks the layout
        axis.plot(failed, [TOP] * len(failed), "x", color=color, markersize=7, markeredgewidth=2, zorder=5)
    pairs = [(x, y) for x, y, row in zip(xs, drawn(rows), rows, strict=True) if row.status == "uncertain"]
    if pairs:
        axis.plot(*zip(*pairs, strict=True), "o", color=color, fillstyle="none", markersize=8, zorder=5)


def note_uncertain(figure: Any, rows: list[Row]) -> None:
    """Explain the rings below the panels."""
    if any(row.status == "uncertain" for row in rows):
        figure.supxlabel("rings: uncertain, no converged step is known well enough", fontsize=9, color="#b3261e")
