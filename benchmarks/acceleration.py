"""How many times fewer iterations Chebyshev needs than Jacobi, at three stiffnesses and four errors: about ten, says
the source paper.

The step of the beam of `beam.py`, float64, start "inertial". Jacobi is that of the paper (plain diagonal); the classic
schedule has the paper's two-stage rho, with 64 iterations of pre-simulation. Counts are the fewest iterations.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from beam import STIFFNESSES, beam, iterations_to, solution
from machine import describe_run
from tqdm.auto import tqdm

from torchpd.contenders import CONTENDERS

ERRORS = (1e-1, 1e-2, 1e-3, 1e-4)
NAMES = ("Jacobi", "classic Chebyshev", "guarded Chebyshev")


def count_all(most: int) -> list[dict[str, Any]]:
    """A row for every stiffness and solver: iterations to each error, None beyond `most`."""
    rows = []
    with tqdm(total=len(STIFFNESSES) * len(NAMES), desc="counting", unit="solver", leave=False) as bar:
        for youngs in STIFFNESSES:
            sim, state = beam(youngs)
            solved = solution(sim, state)
            for name in NAMES:
                sim.solver = CONTENDERS[name].make(sim, state)
                counts = [iterations_to(sim, state, solved, error, most) for error in ERRORS]
                rows.append(
                    {"youngs": youngs, "solver": name, "rho": sim.solver.numbers()["rho"], "iterations": counts}
                )
                bar.update(1)
    return rows


def with_factors(rows: list[dict[str, Any]], most: int) -> list[dict[str, Any]]:
    """The rows with how many times fewer iterations than Jacobi, at least so many where that needs more than `most`."""
    jacobi = {row["youngs"]: row["iterations"] for row in rows if row["solver"] == "Jacobi"}
    return [
        {
            **row,
            "factors": [
                None if own is None else (plain or most) / own
                for plain, own in zip(jacobi[row["youngs"]], row["iterations"], strict=True)
            ],
            "at_least": [plain is None for plain in jacobi[row["youngs"]]],
        }
        for row in rows
    ]


def table(rows: list[dict[str, Any]], most: int) -> str:
    """Iterations, and in brackets how many times fewer."""
    lines = [f"{'youngs':>8}  {'solver':<18}" + "".join(f"{error:>18.0e}" for error in ERRORS)]
    for row in rows:
        cells = []
        for count, factor, at_least in zip(row["iterations"], row["factors"], row["at_least"], strict=True):
            times = "" if factor is None else f"({'>' if at_least else ''}{factor:.1f} x)"
            cells.append(f"> {most}" if count is None else f"{count} {times}")
        lines.append(f"{row['youngs']:>8.0e}  {row['solver']:<18}" + "".join(f"{cell:>18}" for cell in cells))
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--most", type=int, default=20000, help="iterations at most (%(default)s)")
    parser.add_argument("--out", type=Path, help="file for the result (JSON)")
    options = parser.parse_args()
    rows = with_factors(count_all(options.most), options.most)
    print(table(rows, options.most))
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        record = {
            "schema": 1,
            **describe_run(torch.device("cpu"), torch.get_num_threads()),
            "errors": ERRORS,
            "rows": rows,
        }
        options.out.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
