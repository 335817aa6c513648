"""Choice of the CUDA toolkit of a build, or the reason for a build without CUDA. Used by `setup.py` and the doctor.

Imports nothing from the package, because `setup.py` runs it before the package can be imported.
"""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path
from typing import NamedTuple

__all__ = [
    "CUDA_ARCHITECTURES",
    "MIN_RELEASE",
    "NVCC_FLAGS",
    "NVCC_PACKING",
    "Toolkit",
    "choose_toolkit",
    "find_toolkit",
]

# Without TORCH_CUDA_ARCH_LIST torch asks a visible GPU, which fails on a build machine without one. Newer devices
# compile the PTX of the last architecture when they load it.
CUDA_ARCHITECTURES = "8.0;9.0+PTX"
# --fmad=false: the code names the fused operations itself, as for the CPU.
NVCC_FLAGS = ("-std=c++20", "-O3", "--expt-relaxed-constexpr", "--fmad=false")
# Compile two architectures at a time, and compress the code to a quarter; neither changes the result.
NVCC_PACKING = ("--threads=2", "-Xfatbin=-compress-all")
MIN_RELEASE = "12.3"  # first release with PTX 8.3, needed for the 128-bit words of csrc/cuda


class Toolkit(NamedTuple):
    """A CUDA toolkit, or the reason for a build without CUDA."""

    home: str | None  # folder that holds bin/nvcc; None without CUDA
    release: str  # release of nvcc, such as "13.0"; empty without one
    reason: str  # reason for a build without CUDA; empty with CUDA


def _nvcc_release(home: str) -> str:
    """Release of nvcc, such as "13.0"; empty if it does not run."""
    nvcc = Path(home) / "bin" / "nvcc"
    try:
        answer = subprocess.run([nvcc, "--version"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    found = re.search(r"release (\d+\.\d+)", answer.stdout)
    return found.group(1) if found else ""


def _numbers(release: str) -> tuple[int, ...]:
    return tuple(map(int, release.split(".")))


def choose_toolkit(home: str | None, release: str, torch_cuda: str | None) -> Toolkit:
    """Choose from the given facts; a visible GPU is not one of them.

    Args:
        home: folder of the toolkit; None without one.
        release: release of its nvcc; empty if it does not run.
        torch_cuda: `torch.version.cuda`, None for a CPU build of torch.
    """
    if torch_cuda is None:
        return Toolkit(None, release, "this torch is a CPU build (torch.version.cuda is None)")
    if home is None:
        return Toolkit(None, "", f"no CUDA toolkit found: install CUDA {torch_cuda} or set CUDA_HOME")
    if not release:
        return Toolkit(None, "", f"no working nvcc in {home}/bin")
    if release.split(".")[0] != torch_cuda.split(".")[0]:
        return Toolkit(None, release, f"nvcc is CUDA {release} but torch is built for CUDA {torch_cuda}")
    if _numbers(release) < _numbers(MIN_RELEASE):
        reason = f"nvcc is CUDA {release} and the kernels need {MIN_RELEASE} or newer: install a newer toolkit"
        return Toolkit(None, release, f"{reason} of the same major version, and set CUDA_HOME to it")
    return Toolkit(home, release, "")


def find_toolkit() -> Toolkit:
    """Find the toolkit that a build would use now. TORCHPD_CUDA=0 in the environment disables CUDA."""
    import torch

    if os.environ.get("TORCHPD_CUDA") == "0":
        return Toolkit(None, "", "switched off by TORCHPD_CUDA=0")
    try:
        from torch.utils.cpp_extension import CUDA_HOME
    except ImportError as error:
        return Toolkit(None, "", f"torch cannot build extensions here: {error}")
    return choose_toolkit(CUDA_HOME, _nvcc_release(CUDA_HOME) if CUDA_HOME else "", torch.version.cuda)
