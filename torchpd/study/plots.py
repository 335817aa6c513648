"""Pictures of a study (matplotlib): error against time, each axis by itself, and the effect on a motion."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..accuracy.candidates import DEFAULT
from .results_log import Row

__all__ = [
    "PALETTE",
    "SLOPES",
    "STYLES",
    "TOP",
    "axis_label",
    "curves_of",
    "draw_study",
    "float32_floor",
    "method_label",
    "pareto_front",
]

TOP = 2.0  # where a failure is drawn: above the first iterate, whose error is 1
_LOWEST = 1e-7
# Okabe and Ito's palette, distinct under every kind of colour blindness. Solvers of this library have strong colours
# and full lines; published methods have thin lines, dashed where Python takes much of their time.
STYLES: dict[str, tuple[str, float, str]] = {
    DEFAULT: ("#d55e00", 2.8, "solid"),
    "classic Chebyshev": ("#0072b2", 2.0, "solid"),
    "Multilevel": ("#56b4e9", 2.0, "solid"),
    "inexact Newton": ("#cc79a7", 2.0, "solid"),
    "Multilevel, tolerance": ("#2b6f95", 2.0, "solid"),
    "Jacobi": ("#6f737b", 2.0, "solid"),
    "damped Jacobi": ("#a9adb5", 1.4, "solid"),
    "guarded Chebyshev, NumPy": ("#d55e00", 1.2, "dashed"),
    "Gauss-Seidel": ("#009e73", 1.2, "dashed"),
    "Gauss-Seidel + Chebyshev": ("#005c43", 1.2, "dashed"),
    "PCG global step": ("#e69f00", 1.2, "dashed"),
    "direct global step": ("#8c5f00", 1.2, "solid"),
    "direct global step + Chebyshev": ("#e69f00", 1.2, "solid"),
    "direct global step, dense": ("#8c5f00", 1.6, "solid"),
    "direct global step + Chebyshev, dense": ("#e69f00", 1.6, "solid"),
    "Newton": ("#cc79a7", 1.2, "dashed"),
    "Newton-PCG with M": ("#1b1b1b", 1.2, "solid"),
    "L-BFGS": ("#7d3c98", 1.2, "dashed"),
    "L-BFGS with A^-1": ("#7d3c98", 1.2, "solid"),
}
_OTHER = ("#b0447b", 2.0, "solid")  # solvers without a style above
_LABELS = {  # methods on a GPU
    "direct global step, dense": "direct global step, dense inverse (cuBLAS, float32)",
    "direct global step + Chebyshev, dense": "direct global step + Chebyshev, dense inverse (cuBLAS, float32)",
}
_INK, _PAPER_GRID = "#3e4046", "#e4e5e8"
# left out of the picture of all methods, where their curves coincide with Jacobi's; the report shows them
_REPEATED = ("damped Jacobi",)


# the theoretical slope of an axis: the power, and its name
PALETTE = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00")  # of scenes, in turn
SLOPES = {"time step": (1.0, "order one in h"), "mesh": (-2.0 / 3.0, "order two in the edge")}


def axis_label(name: str) -> str:
    """Label of a figure's axis."""
    return {
        "error": "error of the step, |x − x*| / |x₀ − x*|",
        "milliseconds": "time of a step [ms]",
        "iterations": "iterations of a step",
    }[name]


def method_label(row: Row) -> str:
    """A published method with the language it runs in, unless its name says so."""
    return row.method if "NumPy" in row.method else f"{row.method} (float64: {row.parts or 'NumPy'})"


def pareto_front(rows: list[Row]) -> list[Row]:
    """Points that no other point beats in both error and milliseconds, by time; failures are excluded."""
    sound = [row for row in rows if row.status == "ok" and row.milliseconds is not None]
    front: list[Row] = []
    for row in sorted(sound, key=lambda row: (row.milliseconds or 0.0, row.error)):
        if not front or row.error < front[-1].error:
            front.append(row)
    return front


def curves_of(rows: list[Row], key: Callable[[Row], Any]) -> dict[Any, list[Row]]:
    """Rows by their key, each ordered by iterations."""
    found: dict[Any, list[Row]] = {}
    for row in rows:
        found.setdefault(key(row), []).append(row)
    return {name: sorted(group, key=lambda row: row.iterations) for name, group in found.items()}


def draw_study(rows: list[Row], out: Path, *, scene_name: str) -> list[Path]:
    """Write the pictures for which the rows have data."""
    drawers: dict[str, tuple[tuple[str, ...], Callable[[list[Row], Path, str], Path]]] = {
        "solver.png": (("solver",), _draw_solvers),
        "stiffness.png": (("stiffness",), _draw_stiffness),
        "cost.png": (("stiffness",), _draw_cost),
        "axes.png": (("time step", "mesh", "float"), _draw_axes),
        "trajectory.png": (("trajectory",), _draw_trajectory),
        "contact.png": (("contact",), _draw_contact),
    }
    written = []
    for name, (axes, draw) in drawers.items():
        chosen = [row for row in rows if row.axis in axes]
        if chosen:
            written.append(draw(chosen, out / name, scene_name))
    return written


def _figure(columns: int, title: str, *, width: float = 5.2) -> tuple[Any, list[Any]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width * columns, 4.8), dpi=140, layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, color=_INK)
    axes = list(figure.subplots(1, columns, squeeze=False)[0])
    for axis in axes:
        axis.grid(which="major", color=_PAPER_GRID, linewidth=0.8)
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _error_axis(axis: Any, errors: list[float], label: str) -> None:
    lowest = min((error for error in errors if 0.0 < error < math.inf), default=1e-2)
    axis.set_yscale("log")
    axis.set_ylim(max(10.0 ** math.floor(math.log10(lowest)), _LOWEST), 3.0)
    axis.set_ylabel(label)


def _drawn(rows: list[Row]) -> list[float]:
    """Plotted errors: failures at the top, values below the axis on its edge."""
    return [min(max(row.error, _LOWEST), TOP) for row in rows]


def _mark_failures(axis: Any, xs: Sequence[float | None], rows: list[Row], color: str) -> None:
    """Draw crosses at the top, and rings around uncertain errors."""
    failed = [x for x, row in zip(xs, rows, strict=True) if row.failed]
    if failed:  # an empty unclipped line has no bounds, which breaks the layout
        axis.plot(failed, [TOP] * len(failed), "x", color=color, markersize=7, markeredgewidth=2, zorder=5)
    pairs = [(x, y) for x, y, row in zip(xs, _drawn(rows), rows, strict=True) if row.status == "uncertain"]
    if pairs:
        axis.plot(*zip(*pairs, strict=True), "o", color=color, fillstyle="none", markersize=8, zorder=5)


def _note_uncertain(figure: Any, rows: list[Row]) -> None:
    """Explain the rings below the panels."""
    if any(row.status == "uncertain" for row in rows):
        figure.supxlabel("rings: uncertain, no converged step is known well enough", fontsize=9, color="#b3261e")


# ---- all solvers


def _drawn_curves(rows: list[Row]) -> dict[str, list[Row]]:
    """Curves of the picture: this library in float32, published methods in float64."""
    chosen = [row for row in rows if row.method not in _REPEATED and (row.precision == "float32" or not row.compiled)]
    return dict(curves_of(chosen, lambda row: row.method))


def _draw_solvers(rows: list[Row], path: Path, scene_name: str) -> Path:
    first = rows[0]
    figure, (left, right) = _figure(
        2, f"{scene_name}: {max(row.tets for row in rows):,} elements, Young's modulus {_pascals(first.youngs)}, "
        f"time step {first.time_step:.3g} s. One step.", width=6.6,
    )  # fmt: skip
    curves, refused = _drawn_curves(rows), dict[str, list[str]]()
    for name, own in curves.items():
        color, width, dash = STYLES.get(name, _OTHER)
        timed = [row for row in own if row.milliseconds is not None]
        if own[0].refusal:
            refused.setdefault(own[0].refusal, []).append(name)
            continue
        label = _LABELS.get(name, f"{name}, C++ float32" if own[0].compiled else method_label(own[0]))
        for axis, xs in ((left, [row.iterations for row in timed]), (right, [row.milliseconds for row in timed])):
            axis.plot(
                xs, _drawn(timed), color=color, linewidth=width, linestyle=dash, label=label if axis is left else ""
            )
            _mark_failures(axis, xs, timed, color)
    _mark_default(left, right, rows)
    _mark_floor(left, rows)
    front = pareto_front([row for own in curves.values() for row in own])
    right.plot(
        [row.milliseconds for row in front], _drawn(front), color="#f0e442", linewidth=9, alpha=0.55, zorder=0,
        solid_capstyle="round", label="Pareto front: no method is faster and better",
    )  # fmt: skip
    for axis, name in ((left, "iterations"), (right, "milliseconds")):
        axis.set_xscale("log")
        axis.set_xlabel(axis_label(name))
        _error_axis(axis, [row.error for row in rows], axis_label("error"))
        axis.axhline(1.0, color=_INK, linewidth=0.8, linestyle=(0, (2, 3)))
    figure.legend(frameon=False, loc="outside right upper", fontsize=9)
    _note_uncertain(figure, rows)
    if refused:
        words = (f"refused, so not drawn\n({why}):\n" + "\n".join(names) for why, names in refused.items())
        figure.text(0.995, 0.02, "\n".join(words), ha="right", va="bottom", fontsize=8)
    figure.savefig(path)
    return path


def _mark_default(left: Any, right: Any, rows: list[Row]) -> None:
    for row in (row for row in rows if row.default):
        star = {"marker": "*", "markersize": 17, "color": "#d55e00", "markeredgecolor": "white", "linestyle": "none"}
        left.plot([row.iterations], _drawn([row]), zorder=6, label=f"default: {row.iterations} iterations", **star)
        right.plot([row.milliseconds], _drawn([row]), zorder=6, **star)


def float32_floor(rows: list[Row]) -> float | None:
    """Error of the default in float32 after the most iterations, if float64 has less than half of it; else None."""
    last = {row.precision: row for row in sorted(rows, key=lambda row: row.iterations) if row.method == DEFAULT}
    single, double = last.get("float32"), last.get("float64")
    if single is None or double is None or single.iterations != double.iterations:
        return None
    return single.error if single.error > 2.0 * double.error else None


def _mark_floor(axis: Any, rows: list[Row]) -> None:
    """Mark where float32 levels off, if it does within the study."""
    floor = float32_floor(rows)
    if floor is not None:
        axis.axhline(floor, color="#d55e00", linewidth=1.2, linestyle="dotted", label="float32 levels off")


# ---- three stiffnesses, as in the source paper


_SHADES = ("#56b4e9", "#0072b2", "#002b4d")  # soft to stiff


def _draw_stiffness(rows: list[Row], path: Path, scene_name: str) -> Path:
    rows = [row for row in rows if row.precision == "float64"]
    methods = list(dict.fromkeys(row.method for row in rows))
    figure, axes = _figure(len(methods), f"{scene_name}: error of one step at three stiffnesses, float64", width=5.6)
    stiffnesses = sorted({row.youngs for row in rows})
    shades = dict(zip(stiffnesses, _SHADES, strict=False))
    for axis, method in zip(axes, methods, strict=True):
        for youngs in stiffnesses:
            own = sorted(
                (row for row in rows if (row.method, row.youngs) == (method, youngs)), key=lambda row: row.iterations
            )
            xs = [row.iterations for row in own]
            axis.plot(xs, _drawn(own), color=shades.get(youngs, _OTHER[0]), linewidth=2.0, label=_pascals(youngs))
            _mark_failures(axis, xs, own, shades.get(youngs, _OTHER[0]))
        axis.set_title("without acceleration: Jacobi" if method == "Jacobi" else method, fontsize=10, loc="left")
        axis.set_xscale("log")
        axis.set_xlabel(axis_label("iterations"))
        _error_axis(axis, [row.error for row in rows], axis_label("error"))
    axes[0].legend(frameon=False, title="Young's modulus")
    figure.savefig(path)
    return path


def _draw_cost(rows: list[Row], path: Path, scene_name: str) -> Path:
    """Error against milliseconds of the default and `Multilevel` in float32: the cost of accuracy for users."""
    from matplotlib.ticker import FuncFormatter

    own = [row for row in rows if row.precision == "float32" and row.milliseconds is not None]
    if not own:
        return path
    first = own[0]
    title = f"{scene_name}, {first.tets:,} elements, float32: cost of accuracy on this machine"
    figure, (axis,) = _figure(1, title, width=8.2)
    shades = dict(zip(sorted({row.youngs for row in own}), _SHADES, strict=False))
    methods = list(dict.fromkeys(row.method for row in own))
    dashes = {method: "-" if method == DEFAULT else (0, (2.2, 1.4)) for method in methods}
    for (youngs, color), method in itertools.product(shades.items(), methods):
        of_both = (row for row in own if (row.youngs, row.method) == (youngs, method))
        curve = sorted(of_both, key=lambda row: row.iterations)
        xs = [row.milliseconds for row in curve]
        axis.fill_betweenx(
            _drawn(curve), [row.milliseconds_p5 for row in curve], [row.milliseconds_p95 for row in curve], color=color,
            alpha=0.15, linewidth=0,
        )  # fmt: skip
        axis.plot(
            xs, _drawn(curve), color=color, linewidth=2.6, linestyle=dashes[method],
            label=_pascals(youngs) if method == methods[0] else "",
        )  # fmt: skip
        _mark_failures(axis, xs, curve, color)
        for row in (row for row in curve if row.default):
            axis.plot(
                [row.milliseconds], _drawn([row]), "*", color=color, markersize=18, markeredgecolor="white", zorder=6
            )
    for method, dash in dashes.items():
        axis.plot([], [], color=_INK, linewidth=2.0, linestyle=dash, label=method)
    axis.plot([], [], "*", color=_INK, markersize=14, markeredgecolor="white", label="the default: 64 iterations")
    axis.axvline(1e3 * first.time_step, color=_INK, linewidth=1.0, linestyle=(0, (2, 3)))
    axis.annotate(
        "real time ", (1e3 * first.time_step, 1.0), xycoords=("data", "axes fraction"), va="top", ha="right",
        fontsize=9, color=_INK,
    )  # fmt: skip
    axis.set_xscale("log")
    axis.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axis.set_xlabel(f"time of a step [ms], of {1e3 * first.time_step:.3g} ms of motion")
    _error_axis(axis, [row.error for row in own], axis_label("error"))
    axis.legend(frameon=False, title="Young's modulus", loc="lower left")
    figure.savefig(path)
    return path


def _pascals(youngs: float) -> str:
    """Format Young's modulus: 10 kPa rather than 10000 Pa."""
    for factor, unit in ((1e9, "GPa"), (1e6, "MPa"), (1e3, "kPa")):
        if youngs >= factor:
            return f"{youngs / factor:g} {unit}"
    return f"{youngs:g} Pa"


# ---- time step, mesh, float32


def _draw_axes(rows: list[Row], path: Path, scene_name: str) -> Path:
    figure, axes = _figure(3, f"{scene_name}: the other errors, each by itself (everything else {_how_solved(rows)})")
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


# ---- effect on a motion


def _draw_trajectory(rows: list[Row], path: Path, scene_name: str) -> Path:
    stiffest = max(row.youngs for row in rows)
    curves = curves_of([row for row in rows if row.youngs == stiffest], lambda row: row.method)
    shown = [row for curve in curves.values() for row in curve]
    own = curves.get(DEFAULT) or next(iter(curves.values()))
    seconds = own[0].more["seconds_of_motion"]
    figure, (left, right) = _figure(
        2, f"{scene_name}: {seconds:g} s of motion at a Young's modulus of {_pascals(own[0].youngs)}, against the "
        "converged motion",
        width=6.2,
    )  # fmt: skip
    for name, curve in curves.items():
        color, width, dash = STYLES.get(name, _OTHER)
        counts = [row.iterations for row in curve]
        label = f"{name}: mean of its steps" if "tolerance" in curve[0].more else name
        left.plot(counts, _drawn(curve), marker="o", color=color, linewidth=width, linestyle=dash, label=label)
        _mark_failures(left, counts, curve, color)
    _error_axis(left, [row.error for row in shown], "largest distance from the converged path,\nover the displacement")
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
    right.axhline(0.0, color=_INK, linewidth=0.8)
    right.set_ylabel("relative to the converged motion;\nenergies over the kinetic energy of the start")
    right.set_title(f"its effect on the motion: {own[0].method}", fontsize=10, loc="left")
    left.legend(frameon=False, fontsize=9)
    right.legend(frameon=False, fontsize=9)
    _note_uncertain(figure, shown)
    for axis, among in ((left, shown), (right, own)):
        axis.set_xscale("log")
        ticks = sorted({row.iterations for row in among if "tolerance" not in row.more})
        axis.set_xticks(ticks, [str(x) for x in ticks])
        axis.set_xticks([], minor=True)
        axis.set_xlabel(axis_label("iterations"))
        axis.axvline(64, color=_INK, linewidth=1.0, linestyle=(0, (2, 3)))
        axis.annotate(
            "default ", (64, 0.25), xycoords=("data", "axes fraction"), va="bottom", ha="right", fontsize=9, color=_INK
        )
    figure.savefig(path)
    return path


# ---- bodies that meet


def _draw_contact(rows: list[Row], path: Path, _: str) -> Path:
    """Error of a step against its time, what it leaves of the momentum, and the path of a motion, scene by scene."""
    figure, axes = _figure(
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
            values = [min(max(down(row), _LOWEST), TOP) for row in own]
            axis.plot([across(row) for row in own], values, color=color, linewidth=2.0, label=scene)
            stars = [(across(row), value) for row, value in zip(own, values, strict=True) if row.default]
            if stars:
                axis.plot(*zip(*stars, strict=True), "*", color=color, markersize=15, markeredgecolor="white", zorder=6)
        axis.set_xscale("log")
        axis.set_xlabel(axis_label(name))
        _error_axis(axis, [down(row) for row in rows], label)
    figure.legend(*axes[0].get_legend_handles_labels(), frameon=False, loc="outside right upper", fontsize=9)
    _note_uncertain(figure, rows)
    figure.savefig(path)
    return path
