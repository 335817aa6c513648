"""Counts the instructions of the loops of kernels, compiled for sm_90. No GPU is needed.

python tools/instructions.py fused_float "fused_step<float, false, false, .*Blocks.0, true"

compiles fused_float.cu as a build does and prints, of each kernel whose name the pattern is found in, the
loops: where they begin, how many instructions they have, and how many the shortest pass runs. Left out are functions
that a loop calls, what stands behind its end, and what a warp does whose lanes have parted. This one is the kernel
"block" in float32 of held bodies without contacts: its loop over pairs of tetrahedra that adds up no energy has 487,
and runs 403 where no rotation wants more than its closed form, 202 a tetrahedron: INSTRUCTIONS of
benchmarks/gpu_timing.py.
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
# one or two conditions; BRA.DIV, which warps take whose lanes have parted, is none
_BRANCH = re.compile(r"(?P<first>@\S+ )?BRA(\.U)? (?P<second>!?U?P\d, )?0x(?P<target>[0-9a-f]+)")
_END = re.compile(r"(EXIT|RET|BRX|JMX)\b")


class Loop(NamedTuple):
    """Counts of instructions."""

    begin: int  # address of the first
    all: int
    least: int  # of a pass


def functions_of(listing: str) -> Iterator[tuple[str, dict[int, str]]]:
    """Of a listing by cuobjdump: names as the compiler has them, and instructions by address."""
    _, *parts = _FUNCTION.split(listing)
    for name, text in zip(parts[::2], parts[1::2], strict=True):
        yield name, {int(address, 16): words for address, words in _LINE.findall(text)}


def ways_of(code: dict[int, str]) -> dict[int, list[int]]:
    """The addresses where each instruction may go on."""
    ways: dict[int, list[int]] = {}
    addresses = list(code)
    for address, following in zip(addresses, addresses[1:] + [-1], strict=True):
        branch = _BRANCH.match(code[address])
        to = [int(branch["target"], 16)] if branch else []
        if not (_END.match(code[address]) or (branch and not branch["first"] and not branch["second"])):
            to.append(following)
        ways[address] = [way for way in to if way in code]
    return ways


def steps_from(ways: dict[int, list[int]], first: int, low: int, high: int) -> dict[int, int]:
    """How many steps at least lead to every address of a range that is reached within it."""
    steps, new = {first: 0}, [first]
    while new:
        here, new = new, []
        for address in here:
            for way in ways[address]:
                if low <= way <= high and way not in steps:
                    steps[way] = steps[address] + 1
                    new.append(way)
    return steps


def loops_of(code: dict[int, str]) -> list[Loop]:
    """What goes back to where it came from, by its beginning."""
    ways = ways_of(code)
    back: dict[int, list[int]] = {address: [] for address in ways}
    for address, to in ways.items():
        for way in to:
            back[way].append(address)
    loops: dict[int, Loop] = {}
    for end, to in ways.items():
        for begin in to:
            if begin > end:
                continue
            steps = steps_from(ways, begin, begin, end)
            if end not in steps:  # back from code that stands behind what it belongs to
                continue
            size = len(steps.keys() & steps_from(back, end, begin, end).keys())
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
    """A name as the source has it, where there is c++filt."""
    if not shutil.which("c++filt"):
        return name
    return kernel_name(subprocess.run(["c++filt", name], capture_output=True, text=True, check=True).stdout.strip())


def main() -> int:
    parser = argparse.ArgumentParser(description="Count the instructions of the loops of kernels, for sm_90.")
    parser.add_argument("source", help="a source of csrc without its .cu, such as fused_float")
    parser.add_argument("pattern", nargs="?", default="", help="a regular expression for names of kernels")
    parser.add_argument("--cuobjdump", default=find_tool("cuobjdump"), help="the program; needs nvdisasm beside it")
    parser.add_argument("--least", type=int, default=100, help="instructions of a loop to be printed")
    options = parser.parse_args()
    source, nvcc = next(CSRC.rglob(f"{options.source}.cu"), None), find_tool("nvcc")
    if source is None:
        parser.error(f"there is no {options.source}.cu in csrc/")
    if nvcc is None or options.cuobjdump is None:
        missing = "nvcc" if nvcc is None else "cuobjdump"
        parser.error(f"there is no {missing}: set CUDA_HOME to the folder of a CUDA toolkit, or name it (--cuobjdump)")
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
