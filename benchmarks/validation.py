"""torchpd beside closed forms and published measurements: the tables of docs/validation.md.

Every case is a row of data: what is compared, with what, and what torchpd gives (float64, CPU). Statics come from
energy and forces of the compiled ops, minimised to rounding, so that no time step and no solver enters.

    python benchmarks/validation.py --out benchmarks/results/validation.json      # minutes; prints the tables
    python benchmarks/validation.py --only Torsion --out ...                      # rows with this in a label, anew
    python benchmarks/validation.py --page benchmarks/results/validation.json     # the tables of a file
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch
from machine import describe_run, run_of, write_result
from mechanics import cloth, drape, solids
from mechanics.case import Case
from tqdm.auto import tqdm

Record = dict[str, Any]

CASES = [*solids.cases(), *cloth.cases(), *drape.cases()]
TABLES = list(dict.fromkeys(case.table for case in CASES))
# Tables of one number a row have its closed form and error; the others have found / expected, column by column.
LISTED = ("Exact cases", "Bending length")


def run_case(case: Case) -> Record:
    begin = time.perf_counter()
    found = case.run()
    error = case.error(found)
    return {
        "table": case.table,
        "row": case.row,
        "column": case.column,
        "source": case.source,
        "expected": case.expected,
        "found": found,
        "error": error,
        "published": case.published,
        "bound": case.bound,
        "holds": case.bound is None or abs(error) <= case.bound,
        "seconds": time.perf_counter() - begin,
    }


def key_of(row: Record) -> str:
    return f"{row['table']} / {row['row']} / {row['column']}"


def chosen(options: argparse.Namespace) -> list[Case]:
    own = [case for case in CASES if not options.only or any(words in case.key for words in options.only)]
    return [case for case in own if case.quick] if options.quick else own


def ordered(rows: list[Record]) -> list[Record]:
    """In the order of the cases; rows of cases that no longer exist are left out."""
    by_key = {key_of(row): row for row in rows}
    return [by_key[case.key] for case in CASES if case.key in by_key]


def error_text(row: Record) -> str:
    """Relative error, absolute where zero is expected; what is below 1e-9 is rounding."""
    error = abs(row["error"])
    if error >= 1e-3:
        return f"{100.0 * row['error']:+.1f} %"
    return f"{row['error']:+.1e}" if error >= 1e-9 else "below 1e-9"


def listed(rows: list[Record]) -> list[list[str]]:
    head = ["case", "compared", "closed form", "its value", "torchpd", "error"]
    lines = [
        [
            row["row"], row["column"], row["source"], f"{row['expected']:.6g}",
            f"{row['found']:.6g}" if abs(row["found"]) >= 1e-9 else "0", error_text(row),
        ]
        for row in rows
    ]  # fmt: skip
    return [head, *lines]


def matrix(rows: list[Record]) -> list[list[str]]:
    """Found over expected where that is a closed form; found and measured side by side for the drape test."""
    columns, names = (list(dict.fromkeys(row[name] for row in rows)) for name in ("column", "row"))
    cells = {(row["row"], row["column"]): f"{row['found']:.3f}" for row in rows}
    published = {row["row"]: row["published"] or f"{row['expected']:.3f}" for row in rows}
    measured = ["measured"] if set(published.values()) != {"1.000"} else []
    lines = [
        [name, *(published[name] for _ in measured), *(cells.get((name, column), "") for column in columns)]
        for name in names
    ]
    return [["", *measured, *columns], *lines]


def markdown(lines: list[list[str]]) -> str:
    head, *body = ["| " + " | ".join(line) + " |" for line in lines]
    return "\n".join([head, "|" + "---|" * len(lines[0]), *body])


def tables(rows: list[Record]) -> dict[str, str]:
    """The tables of docs/validation.md by title."""
    found = {}
    for title in TABLES:
        own = [row for row in rows if row["table"] == title]
        if own:
            found[title] = markdown(listed(own) if title in LISTED else matrix(own))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a few seconds: the smallest meshes of each table")
    parser.add_argument("--only", nargs="+", help="cases with one of these words in table, row or column")
    parser.add_argument("--page", type=Path, help="print the tables of this file and end")
    parser.add_argument("--out", type=Path, help="output file (JSON); its other rows are kept")
    options = parser.parse_args()
    if not chosen(options):
        parser.error(f"--only must name cases of {', '.join(TABLES)}, got {' '.join(options.only)}")
    if options.page:
        rows = json.loads(options.page.read_text())["rows"]
    else:
        torch.set_num_threads(1)
        now = describe_run(torch.device("cpu"), 1)
        own = [{**run_case(case), "run": run_of(now)} for case in tqdm(chosen(options), desc="cases", unit="case")]
        kept = json.loads(options.out.read_text())["rows"] if options.out and options.out.exists() else []
        rows = ordered([*kept, *own])
        if options.out:
            write_result(options.out, {"schema": 1, **now, "rows": rows})
    for title, table in tables(rows).items():
        print(f"\n## {title}\n\n{table}")
    wrong = [key_of(row) for row in rows if not row["holds"]]
    if wrong:
        raise SystemExit(f"errors beyond their bounds: {'; '.join(wrong)}")


if __name__ == "__main__":
    main()
