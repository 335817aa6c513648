"""Pictures of one step (matplotlib): the error of all solvers, at three stiffnesses, and against time."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

from ..accuracy.candidates import DEFAULT
from .curves import SHADES, STYLES, axis_label, curves_of, float32_floor, method_label, pareto_front, shown_youngs
from .panels import INK, OTHER, drawn, error_axis, figure_of, mark_failures, note_uncertain
from .results_log import Row

__all__ = ["draw_cost", "draw_solvers", "draw_stiffness"]

_LABELS = {  # methods on a GPU
    "direct global step, dense": "direct global step, dense inverse (cuBLAS, float32)",
    "direct global step + Chebyshev, dense": "direct global step + Chebyshev, dense inverse (cuBLAS, float32)",
}
# left out of the picture of all methods, where their curves coincide with Jacobi's; the report shows them
_REPEATED = ("damped Jacobi",)


def _drawn_curves(rows: list[Row]) -> dict[str, list[Row]]:
    """Curves of the picture: this library in float32, published methods in float64."""
    chosen = [row for row in rows if row.method not in _REPEATED and (row.precision == "float32" or not row.compiled)]
    return dict(curves_of(chosen, lambda row: row.method))


def draw_solvers(rows: list[Row], path: Path, scene_name: str) -> Path:
    first = rows[0]
    figure, (left, right) = figure_of(
        2, f"{scene_name}: {max(row.tets for row in rows):,} elements, Young's modulus {shown_youngs(first.youngs)}, "
        f"time step {first.time_step:.3g} s. One step.", width=6.6,
    )  # fmt: skip
    curves, refused = _drawn_curves(rows), dict[str, list[str]]()
    for name, own in curves.items():
        color, width, dash = STYLES.get(name, OTHER)
        timed = [row for row in own if row.milliseconds is not None]
        if own[0].refusal:
            refused.setdefault(own[0].refusal, []).append(name)
            continue
        label = _LABELS.get(name, f"{name}, C++ float32" if own[0].compiled else method_label(own[0]))
        for axis, xs in ((left, [row.iterations for row in timed]), (right, [row.milliseconds for row in timed])):
            axis.plot(
                xs, drawn(timed), color=color, linewidth=width, linestyle=dash, label=label if axis is left else ""
            )
            mark_failures(axis, xs, timed, color)
    _mark_default(left, right, rows)
    _mark_floor(left, rows)
    front = pareto_front([row for own in curves.values() for row in own])
    right.plot(
        [row.milliseconds for row in front], drawn(front), color="#f0e442", linewidth=9, alpha=0.55, zorder=0,
        solid_capstyle="round", label="Pareto front: no method is faster and better",
    )  # fmt: skip
    for axis, name in ((left, "iterations"), (right, "milliseconds")):
        axis.set_xscale("log")
        axis.set_xlabel(axis_label(name))
        error_axis(axis, [row.error for row in rows], axis_label("error"))
        axis.axhline(1.0, color=INK, linewidth=0.8, linestyle=(0, (2, 3)))
    figure.legend(frameon=False, loc="outside right upper", fontsize=9)
    note_uncertain(figure, rows)
    if refused:
        words = (f"refused, so not drawn\n({why}):\n" + "\n".join(names) for why, names in refused.items())
        figure.text(0.995, 0.02, "\n".join(words), ha="right", va="bottom", fontsize=8)
    figure.savefig(path)
    return path


def _mark_default(left: Any, right: Any, rows: list[Row]) -> None:
    for row in (row for row in rows if row.default):
        star = {"marker": "*", "markersize": 17, "color": "#d55e00", "markeredgecolor": "white", "linestyle": "none"}
        left.plot([row.iterations], drawn([row]), zorder=6, label=f"default: {row.iterations} iterations", **star)
        right.plot([row.milliseconds], drawn([row]), zorder=6, **star)


def _mark_floor(axis: Any, rows: list[Row]) -> None:
    """Mark where float32 levels off, if it does within the study."""
    floor = float32_floor(rows)
    if floor is not None:
        axis.axhline(floor, color="#d55e00", linewidth=1.2, linestyle="dotted", label="float32 levels off")


def draw_stiffness(rows: list[Row], path: Path, scene_name: str) -> Path:
    rows = [row for row in rows if row.precision == "float64"]
    methods = list(dict.fromkeys(row.method for row in rows))
    figure, axes = figure_of(len(methods), f"{scene_name}: error of one step at three stiffnesses, float64", width=5.6)
    stiffnesses = sorted({row.youngs for row in rows})
    shades = dict(zip(stiffnesses, SHADES, strict=False))
    for axis, method in zip(axes, methods, strict=True):
        for youngs in stiffnesses:
            own = sorted(
                (row for row in rows if (row.method, row.youngs) == (method, youngs)), key=lambda row: row.iterations
            )
            xs = [row.iterations for row in own]
            axis.plot(xs, drawn(own), color=shades.get(youngs, OTHER[0]), linewidth=2.0, label=shown_youngs(youngs))
            mark_failures(axis, xs, own, shades.get(youngs, OTHER[0]))
        axis.set_title("without acceleration: Jacobi" if method == "Jacobi" else method, fontsize=10, loc="left")
        axis.set_xscale("log")
        axis.set_xlabel(axis_label("iterations"))
        error_axis(axis, [row.error for row in rows], axis_label("error"))
    axes[0].legend(frameon=False, title="Young's modulus")
    figure.savefig(path)
    return path


def draw_cost(rows: list[Row], path: Path, scene_name: str) -> Path:
    """Error against milliseconds of the default and `Multilevel` in float32: the cost of accuracy for users."""
    from matplotlib.ticker import FuncFormatter

    own = [row for row in rows if row.precision == "float32" and row.milliseconds is not None]
    if not own:
        return path
    first = own[0]
    title = f"{scene_name}, {first.tets:,} elements, float32: cost of accuracy on this machine"
    figure, (axis,) = figure_of(1, title, width=8.2)
    shades = dict(zip(sorted({row.youngs for row in own}), SHADES, strict=False))
    methods = list(dict.fromkeys(row.method for row in own))
    dashes = {method: "-" if method == DEFAULT else (0, (2.2, 1.4)) for method in methods}
    for (youngs, color), method in itertools.product(shades.items(), methods):
        of_both = (row for row in own if (row.youngs, row.method) == (youngs, method))
        curve = sorted(of_both, key=lambda row: row.iterations)
        xs = [row.milliseconds for row in curve]
        axis.fill_betweenx(
            drawn(curve), [row.milliseconds_p5 for row in curve], [row.milliseconds_p95 for row in curve], color=color,
            alpha=0.15, linewidth=0,
        )  # fmt: skip
        axis.plot(
            xs, drawn(curve), color=color, linewidth=2.6, linestyle=dashes[method],
            label=shown_youngs(youngs) if method == methods[0] else "",
        )  # fmt: skip
        mark_failures(axis, xs, curve, color)
        for row in (row for row in curve if row.default):
            axis.plot(
                [row.milliseconds], drawn([row]), "*", color=color, markersize=18, markeredgecolor="white", zorder=6
            )
    for method, dash in dashes.items():
        axis.plot([], [], color=INK, linewidth=2.0, linestyle=dash, label=method)
    axis.plot([], [], "*", color=INK, markersize=14, markeredgecolor="white", label="the default: 64 iterations")
    axis.axvline(1e3 * first.time_step, color=INK, linewidth=1.0, linestyle=(0, (2, 3)))
    axis.annotate(
        "real time ", (1e3 * first.time_step, 1.0), xycoords=("data", "axes fraction"), va="top", ha="right",
        fontsize=9, color=INK,
    )  # fmt: skip
    axis.set_xscale("log")
    axis.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axis.set_xlabel(f"time of a step [ms], of {1e3 * first.time_step:.3g} ms of motion")
    error_axis(axis, [row.error for row in own], axis_label("error"))
    axis.legend(frameon=False, title="Young's modulus", loc="lower left")
    figure.savefig(path)
    return path
