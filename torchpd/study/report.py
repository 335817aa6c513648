"""The report of a study: one HTML file with interactive figures (plotly) that needs no network."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..common.checks import optional_module
from .curves import PALETTE, SHADES, SLOPES, STYLES, TOP, axis_label, curves_of, method_label, pareto_front
from .results_log import Row

__all__ = ["write_report"]

_OTHER = ("#56b4e9", 2.0, "solid")
_COLORS = ("#d55e00", "#0072b2", "#56b4e9")  # the stiffness of the study first, then softer ones
_SYMBOLS = {"diverged": "x", "uncertain": "circle-open"}  # circles for the others
_LOWEST_POWER = -8  # power of ten at the bottom of the error axis
# columns of the table of all rows, and the fields of `Row` that they show
_COLUMNS = {
    "axis": "axis", "method": "method", "precision": "precision", "iterations": "iterations",
    "Young's modulus [Pa]": "youngs", "time step [s]": "time_step", "tets": "tets", "error": "error",
    "uncertainty": "uncertainty", "energy error": "error_energy", "residual": "residual", "ms": "milliseconds",
    "p5": "milliseconds_p5", "p95": "milliseconds_p95", "bytes": "bytes",
}  # fmt: skip
_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>What accuracy costs: {{ record.subject }}</title>
<link rel="icon" href="data:,">
<style>
body { font: 15px/1.5 system-ui, sans-serif; color: #2b2d31; max-width: 1180px; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.6em; margin-bottom: .2em } h2 { font-size: 1.15em; margin: 2.2em 0 .2em }
p { margin: .4em 0 } code, pre { background: #f3f4f6; border-radius: 4px; padding: .15em .4em; font-size: .9em }
pre { padding: .7em 1em; overflow-x: auto } table { border-collapse: collapse; font-size: .82em; margin: .6em 0 }
th, td { text-align: right; padding: .18em .7em; border-bottom: 1px solid #e4e5e8 }
th:first-child, td:first-child, th:nth-child(2), td:nth-child(2) { text-align: left } .bad { color: #b3261e }
details summary { cursor: pointer; margin-top: 2em }
</style>
</head>
<body>
<h1>What accuracy costs: {{ record.subject }}</h1>
<p>Errors are |x &minus; x*| / |x<sub>0</sub> &minus; x*| of one time step: 1 is the first iterate, 0 the
converged step. Thick lines are the solvers of this library; thin ones are published methods. On a GPU those are
dense inverses in cuBLAS. On the CPU they run in float64 on the compiled local step of this library (C++), except
those with NumPy in their names; brackets name the rest of their code. Full lines are compiled in nearly all parts
that take time; dashed ones spend much of it in Python. Their iterations compare exactly, their milliseconds are
upper bounds. Crosses at the top are failures. Rings are uncertain: no converged step is known well enough.
Refused methods did not run. Click a name in a legend to hide it.</p>
<pre>{{ record.command }}</pre>
{% set machine = record.machine -%}
<p>{{ machine.cpu }}, {{ machine.threads }} thread{{ "s" * (machine.threads > 1) }}, {{ machine.simd }}; device:
{{ machine.device }}; milliseconds are {{ record.clock }}<br>
{% for name, version in record.versions.items() %}{{ name }} {{ version }}{{ ", " * (not loop.last) }}{% endfor %}<br>
commit {{ record.commit[:12] }}, {{ record.created }}</p>
{% for row in tests %}{% if loop.first %}<h2>The tests of the source paper</h2>
<table>
<tr><th>test of the paper</th><th>here</th><th>iterations</th><th>paper, GTX 470 [ms]</th><th>this machine [ms]</th>
<th>error of the step</th></tr>
{% endif -%}
<tr><td>{{ "%.0f" | format(row.more.constraints) }} constraints</td><td>{{ row.tets | shown }} tetrahedra</td>
<td>{{ row.iterations }}</td><td>{{ row.more.paper_milliseconds | shown }}</td><td>{{ row.milliseconds | shown }}</td>
<td>{{ row.error | shown }}</td></tr>
{% if loop.last %}</table>
{% endif %}{% endfor %}
{%- for title, words, drawn in figures %}<h2>{{ title }}</h2>
<p>{{ words | safe }}</p>
{{ drawn | safe }}
{% endfor %}
<details><summary>All {{ rows | length }} rows</summary>
<table>
<tr>{% for name in columns %}<th>{{ name }}</th>{% endfor %}<th>status</th></tr>
{% for row in rows %}<tr>{% for field in columns.values() %}<td>{{ row[field] | shown }}</td>{% endfor %}
<td{% if row.status != "ok" %} class="bad"{% endif %}>{{ row.status }}</td></tr>
{% endfor %}</table></details>
</body>
</html>
"""


def write_report(rows: list[Row], record: dict[str, Any], path: Path) -> Path:
    """Write the report.

    rows: rows of the study.
    record: command, machine, versions and subject, as in study.json.
    path: the HTML file.
    """
    plotly = optional_module("plotly.io", "plotly", "reports", "study")
    jinja = optional_module("jinja2", "jinja2", "reports", "study").Environment(autoescape=True)
    jinja.filters["shown"] = _format_cell
    figures = [
        (title, words, plotly.to_html(
            figure, full_html=False, include_plotlyjs="inline" if number == 0 else False,
            config={"displaylogo": False, "responsive": True}, div_id=f"figure-{number}",
        ))
        for number, (title, words, figure) in enumerate(_figures(rows))
    ]  # fmt: skip
    tests = [row for row in rows if row.axis == "paper"]
    page = jinja.from_string(_PAGE)
    path.write_text(
        page.render(record=record, rows=rows, tests=tests, figures=figures, columns=_COLUMNS), encoding="utf-8"
    )
    return path


def _format_cell(value: Any) -> str:
    """Text of a cell: numbers to three digits, integers in full."""
    if isinstance(value, float):
        return f"{value:.3g}" if math.isfinite(value) else ""
    return f"{value:,}" if isinstance(value, int) else str(value or "")


# ---- figures

Figure = tuple[str, str, Any]


def _figures(rows: list[Row]) -> list[Figure]:
    """Title, text and figure for every part that the rows have data for."""
    by_axis = curves_of(rows, lambda row: row.axis)
    found = []
    if "solver" in by_axis:
        own = by_axis["solver"]
        found.append(("Error against time", "The star is the default; the yellow band is the Pareto front.",
                      _solver_figure(own, lambda row: row.milliseconds, "milliseconds")))  # fmt: skip
        found.append(("Error against iterations", "An iteration of another method may cost many of ours: hover.",
                      _solver_figure(own, lambda row: row.iterations, "iterations")))  # fmt: skip
    if "stiffness" in by_axis:
        found.append(("Three stiffnesses", "Plain Jacobi (dashed) and the accelerated default (full), float64.",
                      _stiffness_figure(by_axis["stiffness"])))  # fmt: skip
    others: list[tuple[str, str, Callable[[Row], float], str]] = [
        ("time step", "Error of the time step", lambda row: row.time_step, "time step [s]"),
        ("mesh", "Error of the mesh", lambda row: row.tets, "elements"),
        ("float", "Float32 against float64", lambda row: row.iterations, axis_label("iterations")),
        ("trajectory", "A second of motion", lambda row: row.iterations, axis_label("iterations")),
    ]
    words = {
        "time step": "Whole motions, solved to 1e-9, against 8 times shorter steps.",
        "mesh": "Whole motions on coarser meshes, against the finest one.",
        "float": "The same iterations in both precisions, relative to |x<sub>0</sub> &minus; x*|.",
        "trajectory": "Largest distance from the converged path over the displacement; hover for softness and energy. "
        "Full lines are the default solver, dashed ones Multilevel, with a fixed number of iterations per step or with "
        "a tolerance.",
    }
    for axis, title, place, label in others:
        if axis in by_axis:
            found.append((title, words[axis], _plain_figure(by_axis[axis], place, label, SLOPES.get(axis))))
    if "contact" in by_axis:
        words["contact"] = (
            "One step against its converged one, with friction. Hover for the gap, the momentum that no force "
            "explains, and the distance from the converged motion of a second."
        )
        found.append(("Bodies that meet", words["contact"], _contact_figure(by_axis["contact"])))
    return found


def _contact_figure(rows: list[Row]) -> Any:
    import plotly.graph_objects as go

    figure = go.Figure()
    for color, (name, own) in zip(itertools.cycle(PALETTE), curves_of(rows, lambda r: r.method).items(), strict=False):
        figure.add_trace(_trace(own, lambda row: row.milliseconds, name, (color, 2.0, "solid")))
    return _layout(figure, axis_label("milliseconds"), rows)


def _layout(figure: Any, label: str, rows: list[Row]) -> Any:
    lowest = min((row.error for row in rows if 0.0 < row.error < math.inf), default=1e-2)
    figure.update_layout(
        template="plotly_white", height=480, margin={"l": 70, "r": 20, "t": 20, "b": 60}, hovermode="closest",
        xaxis={"type": "log", "title": {"text": label}, "dtick": 1, "exponentformat": "power"},
        yaxis={"type": "log", "title": {"text": "error"}, "dtick": 1, "exponentformat": "power",
               "range": [max(math.floor(math.log10(lowest)), _LOWEST_POWER), 0.5]},
    )  # fmt: skip
    return figure


def _trace(rows: list[Row], place: Callable[[Row], float | None], name: str, style: tuple[str, float, str]) -> Any:
    import plotly.graph_objects as go

    color, width, dash = style
    drawn = [row for row in rows if place(row) is not None]
    return go.Scatter(
        x=[place(row) for row in drawn],
        y=[min(row.error, TOP) for row in drawn],
        mode="lines+markers",
        name=name,
        line={"color": color, "width": width, "dash": {"solid": "solid", "dashed": "dash"}[dash]},
        marker={
            "size": [18 if row.default else 10 if row.status != "ok" else 5 for row in drawn],
            "symbol": ["star" if row.default else _SYMBOLS.get(row.status, "circle") for row in drawn],
        },
        hovertext=[_hover_text(row) for row in drawn],
        hoverinfo="text",
    )


def _hover_text(row: Row) -> str:
    """Hover text of a point."""
    number = ("error", "uncertainty", "error_energy", "error_metres", "residual", "milliseconds", "milliseconds_p5",
              "milliseconds_p95", "setup_milliseconds", "bytes", "kernels", "local_steps")  # fmt: skip
    values = [(name, getattr(row, name)) for name in number] + list(row.more.items())
    shown = [f"{name.replace('_', ' ')}: {value:.4g}" for name, value in values if value is not None]
    head = f"<b>{row.method}</b>, {row.precision}, {row.iterations} iterations"
    return "<br>".join([head, *([row.status] if row.status != "ok" else []), *shown])


def _solver_figure(rows: list[Row], place: Callable[[Row], float | None], axis: str) -> Any:
    import plotly.graph_objects as go

    figure = go.Figure()
    if axis == "milliseconds":
        front = pareto_front(rows)
        figure.add_scatter(
            x=[row.milliseconds for row in front], y=[row.error for row in front], mode="lines", name="Pareto front",
            line={"color": "rgba(240, 228, 66, .55)", "width": 14}, hoverinfo="skip",
        )  # fmt: skip
    for (name, precision, compiled), own in curves_of(rows, lambda r: (r.method, r.precision, r.compiled)).items():
        color, width, dash = STYLES.get(name, _OTHER)
        if compiled:
            width, name = (width, f"{name}, float32") if precision == "float32" else (1.0, f"{name}, float64")
        elif not own[0].refusal:
            name = method_label(own[0])
        if own[0].refusal:
            figure.add_scatter(x=[None], y=[None], mode="markers", marker={"symbol": "x", "color": color},
                               name=f"{name} (refused: {own[0].refusal})", legendrank=1001)  # fmt: skip
        else:
            figure.add_trace(_trace(own, place, name, (color, width, dash)))
    return _layout(figure, axis_label(axis), rows)


def _stiffness_figure(rows: list[Row]) -> Any:
    import plotly.graph_objects as go

    figure = go.Figure()
    rows = [row for row in rows if row.precision == "float64"]
    shades = dict(zip(sorted({row.youngs for row in rows}), SHADES, strict=False))
    for (method, youngs), own in curves_of(rows, lambda row: (row.method, row.youngs)).items():
        dash = "dashed" if method == "Jacobi" else "solid"
        style = (shades.get(youngs, _OTHER[0]), 2.0, dash)
        figure.add_trace(_trace(own, lambda row: row.iterations, f"{method}, {youngs:g} Pa", style))
    return _layout(figure, axis_label("iterations"), rows)


def _plain_figure(rows: list[Row], place: Callable[[Row], float], label: str, slope: tuple[float, str] | None) -> Any:
    import plotly.graph_objects as go

    figure = go.Figure()
    measured = [row for row in rows if math.isfinite(row.error) or row.iterations]
    for youngs, color in zip(sorted({row.youngs for row in measured}, reverse=True), _COLORS, strict=False):
        for method in dict.fromkeys(row.method for row in measured if row.youngs == youngs):
            own = sorted((row for row in measured if (row.youngs, row.method) == (youngs, method)), key=place)
            first = method == measured[0].method
            style = (color, 2.4, "solid") if first else (color, 1.2, "dashed")
            figure.add_trace(_trace(own, place, f"{method}, {youngs:g} Pa", style))
    sound = [row for row in measured if 0.0 < row.error < math.inf]
    if slope is not None and len(sound) > 1:
        power, name = slope
        least = min(sound, key=lambda row: row.error)
        xs = [place(row) for row in sound]
        figure.add_scatter(
            x=xs, y=[least.error * (x / place(least)) ** power for x in xs], mode="lines", name=name, hoverinfo="skip",
            line={"color": "#8a8d93", "width": 1.4, "dash": "dash"},
        )  # fmt: skip
    for row in rows:
        if row not in measured:
            figure.add_annotation(text=row.status, showarrow=False, xref="paper", yref="paper", x=0.5, y=0.5)
    return _layout(figure, label, rows)
