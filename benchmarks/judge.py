"""Benchmarks of random scenes: run them side by side, keep what was judged, and join the parts of a long one."""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import time
from collections import Counter
from collections.abc import Callable, Container, Iterator
from functools import reduce
from pathlib import Path

import torch
from machine import Record, describe_run, earlier_rows, run_of, write_result
from tqdm.auto import tqdm

__all__ = ["join_parts", "judge_scenes"]

SAVES = 20.0  # s between two

Judge = Callable[[int], Record]
Summary = Callable[[list[Record]], Record]
Join = Callable[[Record, Record], Record]


def judge_scenes(
    words: list[str],
    about: str,
    scenes: int,
    judge: Judge,
    summary: Summary,
    join: Join | None = None,
    most: int | None = None,
) -> None:
    """Run a benchmark of random scenes from the command line, a thread each; an interrupted one resumes.

    Args:
        words: of the command line.
        about: description; its first line is shown.
        scenes: how many by default.
        judge: the row of a scene, by its number.
        summary: of rows, [] too.
        join: the summary of the scenes of two. With it, very many scenes can run in parts, of which no rows are kept.
        most: how many there are; default: without end.
    """
    parser = argparse.ArgumentParser(description=about.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=scenes, help="number of random scenes (%(default)s)")
    parser.add_argument("--first", type=int, default=0, help="number of the first scene (%(default)s)")
    parser.add_argument("--processes", type=int, default=1, help="how many run side by side (%(default)s)")
    parser.add_argument("--seconds", type=float, default=math.inf, help="stop after these, with what is done")
    parser.add_argument("--out", type=Path, help="output file (JSON)")
    if join is not None:
        parser.add_argument("--summary", action="store_true", help="keep no rows, for very many scenes")
        parser.add_argument("--join", type=Path, nargs="+", help="files of --summary, joined in place of a run")
    options = parser.parse_args(words)
    if most is not None:
        options.scenes = min(options.scenes, most - options.first)
    if join is not None and options.join:
        kept = join_parts([json.loads(path.read_text()) for path in options.join], join)
    elif join is not None and options.summary:
        kept = _run_part(options, judge, summary, join)
    else:
        kept = _run_rows(options, judge, summary)
    if options.out:
        write_result(options.out, kept)
    print(json.dumps(kept["summary"], indent=1))


def _run_rows(options: argparse.Namespace, judge: Judge, summary: Summary) -> Record:
    """Judge scenes and keep their rows, those of the file too."""
    now = describe_run(torch.device("cpu"), options.processes)
    rows = {row["scene"]: row for row in earlier_rows(options.out)}

    def result() -> Record:
        kept = [rows[number] for number in sorted(rows)]
        return {"schema": 1, **now, "summary": summary(kept), "rows": kept}

    def take(row: Record) -> None:
        rows[row["scene"]] = {**row, "run": run_of(now)}

    _each(options, judge, rows, take, result)
    return result()


def _run_part(options: argparse.Namespace, judge: Judge, summary: Summary, join: Join) -> Record:
    """Judge scenes that the file does not hold, and join them with those."""
    now = describe_run(torch.device("cpu"), options.processes)
    earlier = [json.loads(options.out.read_text())] if options.out and options.out.exists() else []
    total, done = summary([]), set[int]()

    def result() -> Record:
        part = {"schema": 1, **now, "summary": total, "parts": [{**run_of(now), "scenes": _ranges(done)}]}
        return join_parts([*earlier, part] if done or not earlier else earlier, join)

    def take(row: Record) -> None:
        nonlocal total
        total = join(total, summary([row]))
        done.add(row["scene"])

    kept = join_parts(earlier, join)["parts"] if earlier else []
    held = {number for part in kept for number in _numbers(part["scenes"])}
    _each(options, judge, held, take, result)
    return result()


def join_parts(files: list[Record], join: Join) -> Record:
    """One result of several files of --summary, whose scenes must be different."""
    if not all("parts" in file for file in files):
        raise ValueError("files must come from --summary, got one with rows; name others")
    parts = [part for file in files for part in file["parts"]]
    counts = Counter(number for part in parts for number in _numbers(part["scenes"]))
    if twice := {number for number, count in counts.items() if count > 1}:
        raise ValueError(f"files must hold different scenes, got {_ranges(twice)} twice; leave one of them out")
    return {**files[-1], "summary": reduce(join, [file["summary"] for file in files]), "parts": parts}


def _each(
    options: argparse.Namespace,
    judge: Judge,
    held: Container[int],
    take: Callable[[Record], None],
    result: Callable[[], Record],
) -> None:
    """Judge scenes that are not held, until the time is over, and save what there is every now and then."""
    left = [number for number in range(options.first, options.first + options.scenes) if number not in held]
    begin = saved = time.perf_counter()
    for row in tqdm(_judged(judge, left, options.processes), "scenes", len(left), unit="scene"):
        take(row)
        now = time.perf_counter()
        if options.out and now - saved > SAVES:
            write_result(options.out, result())
            saved = now
        if now - begin > options.seconds:
            break


def _judged(judge: Judge, numbers: list[int], processes: int) -> Iterator[Record]:
    """Rows of scenes, of several processes in the order in which they end."""
    if processes == 1:
        torch.set_num_threads(1)
        yield from map(judge, numbers)
        return
    with multiprocessing.get_context("spawn").Pool(processes, torch.set_num_threads, (1,)) as pool:
        yield from pool.imap_unordered(judge, numbers, chunksize=4)


def _numbers(ranges: list[list[int]]) -> list[int]:
    return [number for first, end in ranges for number in range(first, end)]


def _ranges(numbers: set[int]) -> list[list[int]]:
    """Whole numbers as ranges [first, end]."""
    firsts = sorted(number for number in numbers if number - 1 not in numbers)
    ends = sorted(number + 1 for number in numbers if number + 1 not in numbers)
    return [list(pair) for pair in zip(firsts, ends, strict=True)]
