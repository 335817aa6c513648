"""Where files of the repository are, and programs that run headers of csrc on the host."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

HELPERS = Path(__file__).resolve().parent
ROOT = HELPERS.parent.parent
CSRC = ROOT / "csrc"


def compiled(source: str, folder: Path) -> Path:
    """A C++ program that reads stdin and writes stdout; skips where there is no compiler."""
    compiler = shlex.split(os.environ.get("CXX", "c++"))
    if shutil.which(compiler[0]) is None:
        pytest.skip("there is no C++ compiler")
    (folder / "program.cpp").write_text(source)
    flags = ["-std=c++20", "-O1", "-ffp-contract=off", "-I", str(CSRC)]
    subprocess.run([*compiler, *flags, str(folder / "program.cpp"), "-o", str(folder / "program")], check=True)
    return folder / "program"
