"""Pictures of motions (matplotlib): by time step, mesh and precision, by iterations, and of bodies that meet."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..accuracy.candidates import DEFAULT
from .curves import PALETTE, SLOPES, STYLES, TOP, axis_label, curves_of, shown_youngs
from .panels import INK, LOWEST, OTHER, drawn, error_axis, figure_of, mark_failures, note_uncertain
from .results_log import Row

__all__ = ["draw_axes", "draw_contact", "draw_trajectory"]


def draw_axes(rows: list[Row], path: Path, scene_name: str) -> Path:
    figure, axes = figure_of(3, f"{scene_name}: the other errors, each by itself (everything else {_how_solved(rows)})")
    by_axis = curves_of(rows, lambda row: row.axis)
    _panel(
        axes[0], by_axis.get("time step", []), lambda row: 1e3 * row.time_step, "time step [ms]",
        "error of the motion by its time step", slope=SLOPES["time step"],
    )  # fmt: skip
    _panel(
        axes[1], by_axis.get("mesh", []), lambda row: row.tets, "elements", "error of the motion by its mesh",
        slope=SLOPES["mesh"],
    )  # fmt: skip
    _panel(
        axes[2], by_axis.get("float", []), lambda row: row.iterations, axis_label("iterations"),
        "float32 against float64, same iterations", slope=None,
    )  # fmt: skip
    figure.savefig(path)
    return path


def _how_solved(rows: list[Row]) -> str:
    return "not solved for sure" if any(row.status == "uncertain" for row in rows) else "solved to 1e-9"


def _panel(
    axis: Any,
    rows: list[Row],
    place: Callable[[Row], float],
    label: str,
    title: str,
    *,
    slope: tuple[float, str] | None,
) -> None:
    """Error against one quantity, with its theoretical slope."""
    sound = [row for row in rows if 0.0 < row.error < math.inf]
    axis.set_title(title, fontsize=10, loc="left")
    axis.set_xlabel(label)
    if not sound:
        why = rows[0].status if rows else "not studied"
        axis.text(0.5, 0.5, why.replace(": ", ":\n"), ha="center", va="center", transform=axis.transAxes, fontsize=9)
        return
    xs = np.array([place(row) for row in sound], dtype=np.float64)
    errors = np.array([row.error for row in sound])
    axis.plot(xs, errors, "o-", color="#d55e00", linewidth=2.0, label="measured")
    unsure = [row.status == "uncertain" for row in sound]
    if any(unsure):
        label = "uncertain: steps unsolved"
        axis.plot(xs[unsure], errors[unsure], "o", color="#d55e00", fillstyle="none", markersize=11, label=label)
        axis.legend(frameon=False)
    if slope is not None and len(xs) > 1:
        finest, (power, name) = int(errors.argmin()), slope
        axis.plot(
            xs, errors[finest] * (xs / xs[finest]) ** power, color="#8a8d93", linestyle="dashed", linewidth=1.2,
            label=name,
        )  # fmt: skip
        axis.legend(frameon=False)
    axis.set_xscale("log")
    axis.set_yscale("log")
    # ticks at the measured values; minor ticks of a short logarithmic axis would overlap
    shown = xs if len(xs) <= 6 else xs[::3]
    axis.set_xticks(shown, [f"{x:,.0f}" if x >= 100.0 else f"{x:.3g}" for x in shown])
    axis.set_xticks([], minor=True)
    low, high = errors.min(), errors.max()
    axis.set_ylim(10.0 ** math.floor(math.log10(low)), 10.0 ** math.ceil(math.log10(high)))
    axis.set_ylabel("relative error of positions")


def draw_trajectory(rows: list[Row], path: Path, scene_name: str) -> Path:
    stiffest = max(row.youngs for row in rows)
    curves = curves_of([row for row in rows if row.youngs == stiffest], lambda row: row.method)
    shown = [row for curve in curves.values() for row in curve]
    own = curves.get(DEFAULT) or next(iter(curves.values()))
    seconds = own[0].more["seconds_of_motion"]
    figure, (left, right) = figure_of(
        2, f"{scene_name}: {seconds:g} s of motion at a Young's modulus of {shown_youngs(own[0].youngs)}, against the "
        "converged motion",
        width=6.2,
    )  # fmt: skip
    for name, curve in curves.items():
        color, width, dash = STYLES.get(name, OTHER)
        counts = [row.iterations for row in curve]
        label = f"{name}: mean of its steps" if "tolerance" in curve[0].more else name
        left.plot(counts, drawn(curve), marker="o", color=color, linewidth=width, linestyle=dash, label=label)
        mark_failures(left, counts, curve, color)
    error_axis(left, [row.error for row in shown], "largest distance from the converged path,\nover the displacement")
    left.set_title("distance of the body from its converged path", fontsize=10, loc="left")
    xs = [row.iterations for row in own]
    names = {
        "softness": ("overshoot: false softness", "#0072b2"),
        "energy": ("energy at the end: above 0 it grew", "#009e73"),
        "growth": ("highest energy above the start", "#cc79a7"),
        "turn": ("time of the first turning point", "#e69f00"),
    }
    for name, (label, color) in names.items():
        values = [row.more.get(name) for row in own]
        pairs = [(x, value) for x, value in zip(xs, values, strict=True) if value is not None and math.isfinite(value)]
        if pairs:
            right.plot(*zip(*pairs, strict=True), "o-", color=color, linewidth=1.8, markersize=4, label=label)
    right.set_yscale("symlog", linthresh=1e-3)
    right.axhline(0.0, color=INK, linewidth=0.8)
    right.set_ylabel("relative to the converged motion;\nenergies over the kinetic energy of the start")
    right.set_title(f"its effect on the motion: {own[0].method}", fontsize=10, loc="left")
    left.legend(frameon=False, fontsize=9)
    right.legend(frameon=False, fontsize=9)
    note_uncertain(figure, shown)
    for axis, among in ((left, shown), (right, own)):
        axis.set_xscale("log")
        ticks = sorted({row.iterations for row in among if "tolerance" not in row.more})
        axis.set_xticks(ticks, [str(x) for x in ticks])
        axis.set_xticks([], minor=True)
        axis.set_xlabel(axis_label("iterations"))
        axis.axvline(64, color=INK, linewidth=1.0, linestyle=(0, (2, 3)))
        axis.annotate(
            "default ", (64, 0.25), xycoords=("data", "axes fraction"), va="bottom", ha="right", fontsize=9, color=INK
        )
    figure.savefig(path)
    return path


def draw_contact(rows: list[Row], path: Path, _: str) -> Path:
    """Error of a step against its time, what it leaves of the momentum, and the path of a motion, scene by scene."""
    figure, axes = figure_of(
        3, "bodies that meet: one step, and a second of motion, float32; stars: the default", width=5.6
    )
    curves = curves_of(rows, lambda row: row.method)
    panels: list[tuple[str, str, Callable[[Row], Any], Callable[[Row], float]]] = [
        ("milliseconds", axis_label("error"), lambda row: row.milliseconds, lambda row: row.error),
        ("iterations", "momentum that no force explains, a share", lambda row: row.iterations,
         lambda row: row.more["momentum"]),
        ("iterations", "largest distance from the converged motion,\nover the displacement", lambda row: row.iterations,
         lambda row: row.more["path"]),
    ]  # fmt: skip
    for axis, (name, label, across, down) in zip(axes, panels, strict=True):
        for color, (scene, own) in zip(itertools.cycle(PALETTE), curves.items(), strict=False):
            values = [min(max(down(row), LOWEST), TOP) for row in own]
            axis.plot([across(row) for row in own], values, color=color, linewidth=2.0, label=scene)
            stars = [(across(row), value) for row, value in zip(own, values, strict=True) if row.default]
            if stars:
                axis.plot(*zip(*stars, strict=True), "*", color=color, markersize=15, markeredgecolor="white", zorder=6)
        axis.set_xscale("log")
        axis.set_xlabel(axis_label(name))
        error_axis(axis, [down(row) for row in rows], label)
    figure.legend(*axes[0].get_legend_handles_labels(), frameon=False, loc="outside right upper", fontsize=9)
    note_uncertain(figure, rows)
    figure.savefig(path)
    return path
