"""Provenance of measured numbers: command, machine, versions and commit."""

from __future__ import annotations

import datetime
import os
import platform
import shlex
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .. import _C
from ..version import __version__

__all__ = ["describe_run"]


def describe_run(command: str, device: torch.device, threads: int) -> dict[str, Any]:
    """Record of a run, with all that a comparison needs.

    Args:
        command: reproduces the run; folders of this machine are left out of its files.
        device: device of the run.
        threads: CPU threads.
    """
    build = _C.build_info()
    return {
        "command": shlex.join(Path(word).name if Path(word).is_absolute() else word for word in shlex.split(command)),
        "created": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        "commit": _git_commit(),
        "machine": {
            "cpu": _cpu_name(),
            "logical_cores": os.cpu_count(),
            "threads": threads,
            "simd": build["simd"],
            "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
            "platform": platform.platform(),
        },
        "versions": {
            "torchpd": __version__,
            "torch": torch.__version__,
            "python": platform.python_version(),
            "numpy": np.__version__,
            "compiler": build["compiler"],
        },
    }


def _cpu_name() -> str:
    """Name of the processor, read from the system; py-cpuinfo reads the same one in 1.7 s."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _git_commit() -> str:
    """Commit of the working tree, with a plus if it has changes; "unknown" outside of a repository."""

    def ask(*words: str) -> str:
        folder = Path(__file__).parent
        return subprocess.run(["git", *words], cwd=folder, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return ask("rev-parse", "HEAD") + ("+" if ask("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
