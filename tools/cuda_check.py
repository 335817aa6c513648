"""Compile every CUDA source for the supported architectures. Needs nvcc, but no GPU and no CUDA build of torch.

The C++ sources of a CUDA build get a syntax check.

The reports of ptxas on registers, spills and shared memory go to build/cuda-check/, one per source. --table FILE writes
them as one table (CSV) of all kernels; this repository's is benchmarks/results/cuda-registers.csv.

--compare FILE compiles nothing: it fails if the table is of other sources or flags. Comments, formatting, file names
and include paths do not count. ptxas has compiled all sources when the table was written, so CI compares it and uses
--quick.

--quick compiles one architecture per source, in turn, to PTX and, if nvcc can, without optimisation: a thirtieth of the
work.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import itertools
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CSRC = ROOT / "csrc"
REPORTS = ROOT / "build" / "cuda-check"
TARGETS = ("80", "90")
# only the most common kernels, to save time
NEWER_TARGETS = ("100",)
NEWER_SOURCES = (
    "small_batch_float.cu",
    "fused_float.cu",
    "fused_contacts_float.cu",
    "stream_float.cu",
    "multilevel_float.cu",
)
# C++ sources that only a CUDA build of torch compiles, and those with CUDA parts
GLUE = ("binding/cuda/ops.cpp", "freeform/cuda/ops.cpp", "binding/module.cpp")
# torch without CUDA lacks the header that describes its CUDA build
GLUE_FLAGS = ("-std=c++20", "-Xcompiler=-fsyntax-only,-Wall,-Wextra,-Wno-psabi", "-DC10_CUDA_NO_CMAKE_CONFIGURE_FILE")


def find_tool(name: str) -> str | None:
    """A program of the toolkit: from CUDA_HOME, PATH, or the default location."""
    home = os.environ.get("CUDA_HOME")
    candidates = [f"{home}/bin/{name}"] if home else [name, f"/usr/local/cuda/bin/{name}"]
    return next((found for found in map(shutil.which, candidates) if found), None)


def include_folders() -> list[str]:
    """Include folders of this repository, and of torch and python for the sources that use tensors."""
    from torch.utils.cpp_extension import include_paths

    system = [*include_paths(), sysconfig.get_path("include")]
    return ["-I", str(CSRC), *(word for path in system for word in ("-isystem", path))]


def nvcc_flags() -> tuple[str, ...]:
    """The flags of a build."""
    flags: tuple[str, ...] = runpy.run_path(str(ROOT / "torchpd" / "common" / "toolkit.py"))["NVCC_FLAGS"]
    return flags


def targets_of(source: Path) -> tuple[str, ...]:
    """The architectures that a source is compiled for."""
    return TARGETS + (NEWER_TARGETS if source.name in NEWER_SOURCES else ())


def choose_targets(sources: Sequence[Path], *, quick: bool) -> dict[Path, tuple[str, ...]]:
    """The architectures to compile each source for: all of them, or one in turn if `quick`."""
    targets = {source: targets_of(source) for source in sources}
    if quick:
        return {source: (all_of[i % len(all_of)],) for i, (source, all_of) in enumerate(targets.items())}
    return targets


def command_for(
    nvcc: str, source: Path, folders: list[str], architectures: Sequence[str], *, quick: bool = False
) -> list[str]:
    command = [nvcc, "-c", str(source), "-o", os.devnull, "-DTORCHPD_CUDA", *folders]
    if source.suffix == ".cpp":
        return [*command, *GLUE_FLAGS]
    code = "compute" if quick else "sm"
    targets = [f"-gencode=arch=compute_{target},code={code}_{target}" for target in architectures]
    return [*command, *nvcc_flags(), *targets, "-Xptxas=-v"]


def fast_flags(nvcc: str) -> list[str]:
    """Flags for the fastest compilation that this nvcc supports."""
    described = subprocess.run([nvcc, "--help"], capture_output=True, text=True, check=False).stdout
    return ["--Ofast-compile=max"] if "--Ofast-compile" in described else []


def report_of(source: Path) -> Path:
    return REPORTS / (source.relative_to(CSRC).as_posix().replace("/", "-") + ".txt")


def compile_source(command: list[str], source: Path) -> bool:
    """Compile one source, keep the report, and print errors."""
    name = source.relative_to(CSRC).as_posix()
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    report = report_of(source)
    report.write_text(f"{shlex.join(command)}\n{result.stdout}{result.stderr}", encoding="utf-8")
    passed = result.returncode == 0
    print(f"{'ok  ' if passed else 'FAIL'} {name}  ({report.relative_to(ROOT)})", flush=True)
    if not passed:
        print(result.stderr, file=sys.stderr, flush=True)
    return passed


_ENTRY = re.compile(r"Compiling entry function '(?P<kernel>\w+)' for 'sm_(?P<architecture>\d+)'")
_FRAME = re.compile(r"(?P<stack>\d+) bytes stack frame, (?P<spill_stores>\d+) bytes spill stores, (?P<spill_loads>\d+)")
_USED = re.compile(r"Used (?P<registers>\d+) registers(?:.*?(?P<shared>\d+) bytes smem)?")
# only the first row holds the fingerprint
COLUMNS = (
    "source", "architecture", "kernel", "registers", "stack", "spill_stores", "spill_loads", "shared", "fingerprint",
)  # fmt: skip


def kernels_of(report: str) -> list[dict[str, str]]:
    """Resources of every kernel in a ptxas report: bytes, except registers."""
    rows: list[dict[str, str]] = []
    for line in report.splitlines():
        if entry := _ENTRY.search(line):
            rows.append(entry.groupdict() | {"shared": "0"})
        elif not rows or "registers" in rows[-1]:
            continue  # called functions, listed after the kernel's own lines
        elif frame := _FRAME.search(line):
            rows[-1] |= frame.groupdict()
        elif used := _USED.search(line):
            rows[-1] |= {name: value for name, value in used.groupdict().items() if value}
    return rows


def kernel_name(signature: str) -> str:
    """A demangled function without its return type and arguments; template arguments stay."""
    depth = 0
    for place in reversed(range(len(signature) * signature.endswith(")"))):
        depth += {")": 1, "(": -1}.get(signature[place], 0)
        if depth == 0:
            signature = signature[:place]
            break
    return signature.removeprefix("void ")


_INCLUDE = re.compile(r'^\s*#include "(.+)"', re.MULTILINE)
# a comment or an include, which do not count, or a token
_TOKEN = re.compile(r"""//.*|/\*[\s\S]*?\*/|^\s*#\s*include\b.*|\\\n|("(?:\\.|[^"\\\n])*"|\w+|[^\w\s])""", re.MULTILINE)


def with_headers(sources: Iterable[Path], root: Path) -> list[Path]:
    """Sources and their includes within a folder, by name."""
    found: set[Path] = set()
    new = set(sources)
    while new:
        found |= new
        named = {root / name for path in new for name in _INCLUDE.findall(path.read_text(encoding="utf-8"))}
        new = {path for path in named if path.exists()} - found
    return sorted(found)


def fingerprint(root: Path = CSRC) -> str:
    """Hash of a table's inputs except the compiler: flags, targets, and tokens of CUDA sources and headers."""
    sources = sorted(root.glob("**/*.cu"))
    parts = [repr(nvcc_flags())]
    for path in with_headers(sources, root):
        tokens = [token for token in _TOKEN.findall(path.read_text(encoding="utf-8")) if token]
        parts.append(repr((tokens, targets_of(path) if path in sources else ())))
    return hashlib.sha256("\n".join(sorted(parts)).encode()).hexdigest()[:16]


def read_table(path: Path) -> tuple[str, list[dict[str, str]]]:
    """The fingerprint and the rows of a table."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return rows[0].get("fingerprint", ""), rows


def write_table(path: Path, reports: list[Path], made_of: str) -> None:
    """Write all kernels of some reports, by name, and the fingerprint of their sources."""
    rows = [
        {"source": report.stem} | row for report in reports for row in kernels_of(report.read_text(encoding="utf-8"))
    ]
    names = "\n".join(row["kernel"] for row in rows)
    if shutil.which("c++filt"):
        names = subprocess.run(["c++filt"], input=names, capture_output=True, text=True, check=True).stdout
    for row, name in zip(rows, names.splitlines(), strict=True):
        row["kernel"] = kernel_name(name)
    rows.sort(key=lambda row: (row["source"], row["architecture"], row["kernel"]))
    for one, other in itertools.pairwise(rows):
        if all(one[column] == other[column] for column in ("source", "architecture", "kernel")):
            raise ValueError(
                f"{one['source']} has two kernels of the name {one['kernel']} for sm_{one['architecture']}"
            )
    rows[0]["fingerprint"] = made_of
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def compare_table(path: Path) -> int:
    """Print whether a table is of the current sources; 0 if so, else 1."""
    made_of, now = read_table(path)[0], fingerprint()
    if made_of == now:
        print(f"cuda-check: {path} is of these sources ({now})")
        return 0
    print(
        f"cuda-check: {path} is of {made_of}, CUDA sources or flags are {now}; "
        f"run `python tools/cuda_check.py --table {path}`",
        file=sys.stderr,
    )
    return 1


def main() -> int:
    parser = argparse.ArgumentParser(description="Compile every CUDA source; no GPU needed.")
    parser.add_argument("--table", type=Path, help="output file for registers and spills of the kernels (CSV)")
    parser.add_argument("--compare", type=Path, metavar="TABLE", help="fail if a table is of other sources or flags")
    parser.add_argument("--quick", action="store_true", help="one architecture per source, in turn, to PTX")
    options = parser.parse_args()
    if options.compare is not None:
        return compare_table(options.compare)
    if options.quick and options.table is not None:
        parser.error("--table needs all architectures: leave out --quick")
    nvcc = find_tool("nvcc")
    if nvcc is None:
        print("cuda-check: skipped, nvcc not found (set CUDA_HOME to the folder of a CUDA toolkit)")
        return 0
    sources = sorted(CSRC.glob("**/*.cu"))
    everything = [*sources, *(CSRC / name for name in GLUE)]
    targets = choose_targets(everything, quick=options.quick)
    folders = include_folders()
    REPORTS.mkdir(parents=True, exist_ok=True)
    fast = fast_flags(nvcc) if options.quick else []
    made_of = fingerprint()  # before compiling: a source edited meanwhile makes the table stale
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        passed = list(
            pool.map(
                lambda source: compile_source(
                    command_for(nvcc, source, folders, targets[source], quick=options.quick)
                    + (fast if source.suffix == ".cu" else []),
                    source,
                ),
                everything,
            )
        )
    usual, newer = (" and ".join(f"sm_{target}" for target in names) for names in (TARGETS, NEWER_TARGETS))
    all_of_them = f"{usual}, {', '.join(NEWER_SOURCES)} for {newer} too"
    print(
        f"cuda-check: {sum(passed)} of {len(everything)} sources of a CUDA build compile for "
        f"{'PTX of one architecture each' if options.quick else all_of_them}, with {nvcc}"
    )
    if options.table and all(passed):
        write_table(options.table, [report_of(source) for source in sources], made_of)
    return 0 if all(passed) else 1


if __name__ == "__main__":
    sys.exit(main())
