"""The table and the picture of errors against time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

Row = dict[str, Any]

OURS = {
    "Newton VBD": "torchpd", "Newton XPBD": "torchpd", "Newton Style3D": "torchpd",
    "MuJoCo flex, substeps": "torchpd, substeps",
}  # fmt: skip
COLOURS = {
    "torchpd Chebyshev": "tab:blue", "torchpd Chebyshev, float64": "tab:gray", "torchpd Multilevel": "tab:cyan",
    "torchpd, substeps": "tab:blue",
    "Newton VBD": "tab:orange", "Newton XPBD": "tab:red", "Newton Style3D": "tab:purple",
    "MuJoCo flex, substeps": "tab:green",
}  # fmt: skip


def milliseconds_to(method: Row, goal: float) -> float | None:
    """Milliseconds of the fastest measured point within an error; None without one."""
    return min((point["milliseconds"] for point in method["points"] if point["error"] <= goal), default=None)


def best_of_ours(methods: list[Row], peer: str, goal: float) -> float | None:
    """Milliseconds of the fastest solver of this library among those compared with a peer."""
    kind = OURS[peer]
    own = [m for m in methods if m["method"] == kind or (kind == "torchpd" and m["method"].startswith("torchpd "))]
    found = [time for time in (milliseconds_to(method, goal) for method in own) if time is not None]
    return min(found, default=None)


def plain(number: float) -> str:
    """Format two digits without an exponent."""
    return f"{number:.2g}" if number < 1.0 else f"{number:.1f}" if number < 10.0 else f"{float(f'{number:.2g}'):,.0f}"


def cell(methods: list[Row], peer: Row, goal: float) -> str:
    """Milliseconds of this library and the peer, and their ratio; a bound if the peer gave up."""
    own, other = best_of_ours(methods, peer["method"], goal), milliseconds_to(peer, goal)
    if own is None:
        return "neither" if other is None else f"only the other: {plain(other)}"
    if other is None:
        last = peer["points"][-1]
        if not last["error"] < 2.0:
            return f"{plain(own)} / diverges"
        return f"{plain(own)} / > {plain(last['milliseconds'])}: > {plain(last['milliseconds'] / own)} x"
    slower = ": slower here" if other < own else ""
    return f"{plain(own)} / {plain(other)}: {plain(other / own)} x{slower}"


def table(rows: list[Row], goals: tuple[float, ...]) -> str:
    """Format rows by problem, stiffness and peer, in Markdown."""
    lines = [
        "| body | Young's modulus | against | its answer from ours | "
        + " | ".join(f"error {g:g}" for g in goals)
        + " |",
        "|---" * (4 + len(goals)) + "|",
    ]
    for row in rows:
        for peer in row["methods"]:
            if peer["method"] not in OURS:
                continue
            if "refused" in peer:
                cells, apart = ["left out" if peer["missing"] else "does not converge"] * len(goals), ""
            else:
                cells = [cell(row["methods"], peer, goal) for goal in goals]
                apart = f"{peer['own_answer_from_ours']:.1g}"
            unit = row.get("unit", "Pa")
            lines.append(
                f"| {row['problem']} | {row['youngs']:.0e} {unit} | {peer['method']} | {apart} | "
                + " | ".join(cells)
                + " |"
            )
    return "\n".join(lines)


def draw(rows: list[Row], path: Path) -> None:
    """Draw one panel per problem and stiffness: own error against milliseconds."""
    import matplotlib.pyplot as plt

    problems = list(dict.fromkeys(row["problem"] for row in rows))
    stiffnesses = sorted({row["youngs"] for row in rows})
    figure, panels = plt.subplots(
        len(problems),
        len(stiffnesses),
        figsize=(3.4 * len(stiffnesses), 2.9 * len(problems)),
        sharey=True,
        squeeze=False,
    )
    for panel in panels.flat:
        panel.set_visible(False)
    for row in rows:
        panel = panels[problems.index(row["problem"])][stiffnesses.index(row["youngs"])]
        for method in row["methods"]:
            points = [(p["milliseconds"], p["error"]) for p in method["points"] if 0.0 < p["error"] < 100.0]
            if points:
                style = "--" if "substeps" in method["method"] else "-"
                colour = COLOURS[method["method"]]
                panel.plot(*zip(*points, strict=True), style, marker=".", color=colour, label=method["method"])
        panel.set_visible(True)
        panel.set(
            xscale="log",
            yscale="log",
            ylim=(3e-4, 10.0),
            title=f"{row['problem']}\n{row['youngs']:.0e} {row.get('unit', 'Pa')}",
        )
        panel.title.set_fontsize(9)
        panel.grid(alpha=0.3)
        panel.set_xlabel("milliseconds")
        if row["youngs"] == min(other["youngs"] for other in rows if other["problem"] == row["problem"]):
            panel.set_ylabel("distance from its own\nconverged answer")
            panel.tick_params(labelleft=True)
    handles = {
        label: handle for panel in figure.axes for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles.keys(), loc="lower center", ncol=len(handles), fontsize=9)
    figure.tight_layout(rect=(0.0, 0.06, 1.0, 1.0))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
