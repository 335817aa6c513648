"""Which C++ runtime the extension is linked with. Used by setup.py too, so nothing of torchpd is imported here.

torch brings the shared libstdc++ along. With a second, static copy in the extension no exception gets from one to the
other: every error message ends the process.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Sequence
from pathlib import Path

__all__ = ["libraries_in", "library_names", "runtime_fault", "shared_runtime"]


def shared_runtime(compiler: Sequence[str]) -> list[str]:
    """The compiler's shared libstdc++ as an argument of its linker, where it has one.

    Named like this it comes before the one that the compiler adds by itself, which `-static-libstdc++` makes static.
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
    """The shared libraries that a file needs, from what `readelf -d` prints of it."""
    return re.findall(r"\(NEEDED\).*\[(.+)\]", dynamic_section)


def libraries_in(extension: Path) -> list[str] | None:
    """The shared libraries that a compiled extension needs; None where readelf cannot tell."""
    try:
        said = subprocess.run(["readelf", "-d", str(extension)], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return library_names(said.stdout)


def runtime_fault(libraries: Sequence[str], compiler: str) -> str:
    """What is wrong with a Linux extension that needs these libraries; empty when nothing is."""
    if any(library.startswith("libstdc++.so") for library in libraries):
        return ""
    return (
        f"`{compiler}` links libstdc++ statically, as the extension needs {', '.join(libraries) or 'no library'}, and "
        "with a copy of its own beside torch's every error message would crash; take -static-libstdc++ out of CXX, "
        "CXXFLAGS and LDFLAGS, or install the compiler's shared libstdc++ (Debian and Ubuntu: `apt install g++`), or "
        "name another compiler in CXX."
    )
