"""Curves of a study's rows, and how they look: for its pictures and its report."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..accuracy.candidates import DEFAULT
from .results_log import Row

__all__ = [
    "PALETTE",
    "SHADES",
    "SLOPES",
    "STYLES",
    "TOP",
    "axis_label",
    "curves_of",
    "float32_floor",
    "method_label",
    "pareto_front",
    "shown_youngs",
]

TOP = 2.0  # where a failure is drawn: above the first iterate, whose error is 1
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
SHADES = ("#56b4e9", "#0072b2", "#002b4d")  # soft to stiff
PALETTE = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00")  # of scenes, in turn  # of scenes, in turn
# the theoretical slope of an axis: the power, and its name
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


def float32_floor(rows: list[Row]) -> float | None:
    """Error of the default in float32 after the most iterations, if float64 has less than half of it; else None."""
    last = {row.precision: row for row in sorted(rows, key=lambda row: row.iterations) if row.method == DEFAULT}
    single, double = last.get("float32"), last.get("float64")
    if single is None or double is None or single.iterations != double.iterations:
        return None
    return single.error if single.error > 2.0 * double.error else None


def shown_youngs(youngs: float) -> str:
    """Format Young's modulus: 10 kPa rather than 10000 Pa."""
    for factor, unit in ((1e9, "GPa"), (1e6, "MPa"), (1e3, "kPa")):
        if youngs >= factor:
            return f"{youngs / factor:g} {unit}"
    return f"{youngs:g} Pa"
