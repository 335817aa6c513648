"""What tools/cuda_check.py reads out of the compiler's reports."""

from __future__ import annotations

import runpy
from pathlib import Path

REPORT = """nvcc -c x.cu
ptxas info    : 0 bytes gmem
ptxas info    : Compiling entry function '_Z1av' for 'sm_80'
ptxas info    : Function properties for _Z1av
    72 bytes stack frame, 96 bytes spill stores, 172 bytes spill loads
ptxas info    : Used 128 registers, used 1 barriers, 72 bytes cumulative stack size, 992 bytes cmem[0]
ptxas info    : Function properties for _Z6calledv
    8 bytes stack frame, 9 bytes spill stores, 10 bytes spill loads
ptxas info    : Compiling entry function '_Z1bv' for 'sm_90'
ptxas info    : Function properties for _Z1bv
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 34 registers, used 1 barriers, 768 bytes smem, 800 bytes cmem[0]
"""


def test_kernels_without_the_functions_they_call() -> None:
    tool = runpy.run_path(str(Path(__file__).parent.parent / "tools" / "cuda_check.py"))
    first = {"kernel": "_Z1av", "architecture": "80", "registers": "128", "stack": "72", "spill_stores": "96"}
    second = {"kernel": "_Z1bv", "architecture": "90", "registers": "34", "stack": "0", "spill_stores": "0"}
    assert tool["kernels_of"](REPORT) == [
        first | {"spill_loads": "172", "shared": "0"},
        second | {"spill_loads": "0", "shared": "768"},
    ]
