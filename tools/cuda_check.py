"""Compiles every CUDA source for the architectures that matter. Needs nvcc, but no GPU and no CUDA build of torch.

What ptxas says about registers, spills and shared memory is kept in build/cuda-check/, one report per source, and with
--table FILE as one table (CSV) of all kernels; benchmarks/results/cuda-registers.csv is the one of this repository.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import sysconfig
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
REPORTS = ROOT / "build" / "cuda-check"
TARGETS = ("80", "90")


def find_nvcc() -> str | None:
    """nvcc of CUDA_HOME, of the PATH, or of the usual place."""
    home = os.environ.get("CUDA_HOME")
    candidates = [f"{home}/bin/nvcc"] if home else ["nvcc", "/usr/local/cuda/bin/nvcc"]
    return next((found for found in map(shutil.which, candidates) if found), None)


def include_folders() -> list[str]:
    """Our headers, and those of torch and python for the sources that hold tensors."""
    from torch.utils.cpp_extension import include_paths

    system = [*include_paths(), sysconfig.get_path("include")]
    return ["-I", str(ROOT / "csrc"), *(word for path in system for word in ("-isystem", path))]


def command_for(nvcc: str, source: Path, folders: list[str]) -> list[str]:
    flags = runpy.run_path(str(ROOT / "torchpd" / "toolkit.py"))["NVCC_FLAGS"]
    targets = [f"-gencode=arch=compute_{target},code=sm_{target}" for target in TARGETS]
    return [nvcc, "-c", str(source), "-o", os.devnull, *flags, *targets, "-Xptxas=-v", "-DTORCHPD_CUDA", *folders]


def report_of(source: Path) -> Path:
    return REPORTS / (source.relative_to(ROOT / "csrc").as_posix().replace("/", "-") + ".txt")


def compile_source(command: list[str], source: Path) -> bool:
    """Compile one source, keep the report, and say what went wrong."""
    name = source.relative_to(ROOT / "csrc").as_posix()
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
COLUMNS = ("source", "architecture", "kernel", "registers", "stack", "spill_stores", "spill_loads", "shared")


def kernels_of(report: str) -> list[dict[str, str]]:
    """What ptxas says of every kernel: bytes, but for registers."""
    rows: list[dict[str, str]] = []
    for line in report.splitlines():
        if entry := _ENTRY.search(line):
            rows.append(entry.groupdict() | {"shared": "0"})
        elif not rows or "registers" in rows[-1]:
            continue  # functions that kernels call, after the kernel's own lines
        elif frame := _FRAME.search(line):
            rows[-1] |= frame.groupdict()
        elif used := _USED.search(line):
            rows[-1] |= {name: value for name, value in used.groupdict().items() if value}
    return rows


def kernel_name(signature: str) -> str:
    """A function as c++filt prints it, without what it returns and takes; template arguments stay."""
    depth = 0
    for place in reversed(range(len(signature) * signature.endswith(")"))):
        depth += {")": 1, "(": -1}.get(signature[place], 0)
        if depth == 0:
            signature = signature[:place]
            break
    return signature.removeprefix("void ")


def write_table(path: Path, reports: list[Path]) -> None:
    """All kernels of some reports, by name."""
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
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def main() -> int:
    parser = argparse.ArgumentParser(description="Compile every CUDA source; no GPU needed.")
    parser.add_argument("--table", type=Path, help="file for a table of the kernels' registers and spills (CSV)")
    options = parser.parse_args()
    nvcc = find_nvcc()
    if nvcc is None:
        print("cuda-check: skipped, there is no nvcc (set CUDA_HOME to the folder of a CUDA toolkit)")
        return 0
    sources = sorted((ROOT / "csrc").glob("**/*.cu"))
    folders = include_folders() if sources else []
    REPORTS.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        passed = list(pool.map(lambda source: compile_source(command_for(nvcc, source, folders), source), sources))
    targets = ", ".join(f"sm_{target}" for target in TARGETS)
    print(f"cuda-check: {sum(passed)} of {len(sources)} CUDA sources compile for {targets} with {nvcc}")
    if options.table and all(passed):
        write_table(options.table, [report_of(source) for source in sources])
    return 0 if all(passed) else 1


if __name__ == "__main__":
    sys.exit(main())
