"""Count the instructions of kernel loops, compiled for sm_90. No GPU is needed.

python tools/instructions.py fused_float "fused_step<float, false, false, .*Blocks.0, true"

compiles fused_float.cu as a build does. For each kernel whose name matches the pattern it prints the loops: their
start, their number of instructions, and those of the shortest pass. Functions called in a loop, code after its end, and
the code of diverged warps are left out.

The example is kernel "block" in float32 for held bodies without contacts. Its loop over pairs of tetrahedra without the
energy has 487 instructions. A pass runs 403 if the closed form suffices for every rotation, 202 per tetrahedron:
INSTRUCTIONS of benchmarks/gpu_timing.py.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from cuda_check import CSRC, find_tool, kernel_name, nvcc_flags

TARGET = "90"
_FUNCTION = re.compile(r"^\s*Function : (\S+)$", re.MULTILINE)
_LINE = re.compile(r"^\s+/\*([0-9a-f]+)\*/\s+(.+?)\s*;", re.MULTILINE)
# one or two conditions; BRA.DIV, the branch of diverged warps, has none
_BRANCH = re.compile(r"(?P<first>@\S+ )?BRA(\.U)? (?P<second>!?U?P\d, )?0x(?P<target>[0-9a-f]+)")
_END = re.compile(r"(EXIT|RET|BRX|JMX)\b")


class Loop(NamedTuple):
    """Instruction counts of a loop."""

    begin: int  # address of the first instruction
    all: int
    least: int  # shortest pass


def functions_of(listing: str) -> Iterator[tuple[str, dict[int, str]]]:
    """Functions of a cuobjdump listing: mangled names, and instructions by address."""
    _, *parts = _FUNCTION.split(listing)
    for name, text in zip(parts[::2], parts[1::2], strict=True):
        yield name, {int(address, 16): words for address, words in _LINE.findall(text)}


def successors_of(code: dict[int, str]) -> dict[int, list[int]]:
    """The possible next addresses of each instruction."""
    successors: dict[int, list[int]] = {}
    addresses = list(code)
    for address, following in zip(addresses, addresses[1:] + [-1], strict=True):
        branch = _BRANCH.match(code[address])
        to = [int(branch["target"], 16)] if branch else []
        if not (_END.match(code[address]) or (branch and not branch["first"] and not branch["second"])):
            to.append(following)
        successors[address] = [way for way in to if way in code]
    return successors


def shortest_distances(successors: dict[int, list[int]], first: int, low: int, high: int) -> dict[int, int]:
    """Least number of steps from `first` to every address reachable within a range."""
    steps, new = {first: 0}, [first]
    while new:
        here, new = new, []
        for address in here:
            for way in successors[address]:
                if low <= way <= high and way not in steps:
                    steps[way] = steps[address] + 1
                    new.append(way)
    return steps


def loops_of(code: dict[int, str]) -> list[Loop]:
    """The loops (backward branches), by their start."""
    successors = successors_of(code)
    back: dict[int, list[int]] = {address: [] for address in successors}
    for address, to in successors.items():
        for way in to:
            back[way].append(address)
    loops: dict[int, Loop] = {}
    for end, to in successors.items():
        for begin in to:
            if begin > end:
                continue
            steps = shortest_distances(successors, begin, begin, end)
            if end not in steps:  # a branch back from code placed after its function
                continue
            size = len(steps.keys() & shortest_distances(back, end, begin, end).keys())
            known = loops.get(begin, Loop(begin, 0, steps[end] + 1))
            loops[begin] = Loop(begin, max(size, known.all), min(steps[end] + 1, known.least))
    return sorted(loops.values())


def listing_of(source: Path, nvcc: str, cuobjdump: str) -> str:
    """The instructions of a CUDA source."""
    with tempfile.TemporaryDirectory() as folder:
        cubin = Path(folder) / "kernels.cubin"
        target = f"-gencode=arch=compute_{TARGET},code=sm_{TARGET}"
        flags = [*nvcc_flags(), "-DTORCHPD_CUDA", "-I", CSRC]
        subprocess.run([nvcc, "-cubin", target, *flags, source, "-o", cubin], check=True)
        return subprocess.run([cuobjdump, "-sass", cubin], stdout=subprocess.PIPE, text=True, check=True).stdout


def demangled(name: str) -> str:
    """The demangled name, if c++filt is available."""
    if not shutil.which("c++filt"):
        return name
    return kernel_name(subprocess.run(["c++filt", name], capture_output=True, text=True, check=True).stdout.strip())


def main() -> int:
    parser = argparse.ArgumentParser(description="Count the instructions of the loops of kernels, for sm_90.")
    parser.add_argument("source", help="name of a CUDA source in csrc without .cu, such as fused_float")
    parser.add_argument("pattern", nargs="?", default="", help="regular expression for kernel names")
    parser.add_argument("--cuobjdump", default=find_tool("cuobjdump"), help="the program; needs nvdisasm beside it")
    parser.add_argument("--least", type=int, default=100, help="fewest instructions of a printed loop")
    options = parser.parse_args()
    source, nvcc = next(CSRC.rglob(f"{options.source}.cu"), None), find_tool("nvcc")
    if source is None:
        parser.error(f"there is no {options.source}.cu in csrc/")
    if nvcc is None or options.cuobjdump is None:
        missing = "nvcc" if nvcc is None else "cuobjdump"
        parser.error(f"{missing} not found: set CUDA_HOME to the folder of a CUDA toolkit, or pass --cuobjdump")
    for name, code in functions_of(listing_of(source, nvcc, options.cuobjdump)):
        kernel = demangled(name)
        if not re.search(options.pattern, kernel):
            continue
        print(f"{kernel}: {len(code)} instructions")
        for loop in loops_of(code):
            if loop.all >= options.least:
                print(f"  loop at {loop.begin:#07x}: {loop.all:5}, shortest pass {loop.least:5}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
