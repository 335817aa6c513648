"""Compiles every CUDA source for the architectures that matter. Needs nvcc, but no GPU and no CUDA build of torch.

What ptxas says about registers, spills and shared memory is kept in build/cuda-check/, one report per source.
"""

from __future__ import annotations

import os
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


def compile_source(command: list[str], source: Path) -> bool:
    """Compile one source, keep the report, and say what went wrong."""
    name = source.relative_to(ROOT / "csrc").as_posix()
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    report = REPORTS / (name.replace("/", "-") + ".txt")
    report.write_text(f"{shlex.join(command)}\n{result.stdout}{result.stderr}", encoding="utf-8")
    passed = result.returncode == 0
    print(f"{'ok  ' if passed else 'FAIL'} {name}  ({report.relative_to(ROOT)})", flush=True)
    if not passed:
        print(result.stderr, file=sys.stderr, flush=True)
    return passed


def main() -> int:
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
    return 0 if all(passed) else 1


if __name__ == "__main__":
    sys.exit(main())
