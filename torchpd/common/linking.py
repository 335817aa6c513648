"""The C++ runtime that the extension links. Used by setup.py, so nothing of torchpd is imported here.

torch loads the shared libstdc++. With a second, static copy in the extension no exception passes between both: every
error message would end the process.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Sequence
from pathlib import Path

__all__ = ["libraries_in", "library_names", "runtime_fault", "shared_runtime"]


def shared_runtime(compiler: Sequence[str]) -> list[str]:
    """Linker argument for the shared libstdc++ of the compiler, if it has one.

    It precedes the library that the compiler adds itself, which `-static-libstdc++` makes static.
    """
    for name in ("libstdc++.so", "libstdc++.so.6"):
        try:
            said = subprocess.run([*compiler, f"-print-file-name={name}"], capture_output=True, text=True, check=False)
        except OSError:
            return []
        found = Path(said.stdout.strip())
        if found.is_absolute() and found.exists():
            return [str(found)]
    return []


def library_names(dynamic_section: str) -> list[str]:
    """Shared libraries that a file needs, from the output of `readelf -d`."""
    return re.findall(r"\(NEEDED\).*\[(.+)\]", dynamic_section)


def libraries_in(extension: Path) -> list[str] | None:
    """Shared libraries that a compiled extension needs; None if readelf cannot tell."""
    try:
        said = subprocess.run(["readelf", "-d", str(extension)], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return library_names(said.stdout)


def runtime_fault(libraries: Sequence[str], compiler: str) -> str:
    """Fault of a Linux extension that needs these libraries, with the fix; empty if there is none."""
    if any(library.startswith("libstdc++.so") for library in libraries):
        return ""
    return (
        f"`{compiler}` must link libstdc++ as a shared library, got {', '.join(libraries) or 'no library'}: with a "
        "static copy beside that of torch every error message would crash. Remove -static-libstdc++ from CXX, CXXFLAGS "
        "and LDFLAGS, or install the compiler's shared libstdc++ (Debian and Ubuntu: `apt install g++`), or name "
        "another compiler in CXX."
    )
