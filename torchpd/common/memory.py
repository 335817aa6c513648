"""Memory of the process, the container limit included, which psutil ignores; and slices of long arrays."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

__all__ = ["chunks", "host_memory"]

_CHUNK = 1 << 14  # rows


def chunks(count: int) -> Iterator[slice]:
    """Slices of a long array whose temporaries fit a cache."""
    return (slice(start, start + _CHUNK) for start in range(0, count, _CHUNK))


def host_memory(root: Path = Path("/")) -> int:
    """Memory in bytes: that of the machine, or the least limit of the enclosing control groups (versions 1 and 2).

    Args:
        root: root of the file system with the limits; tests give another one.
    """
    there = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return min([there, *_limits(root)])


def _limits(root: Path) -> Iterator[int]:
    """Limits of a group and of its parents; in a container its own limit may be mounted at the root."""
    for controllers, path in _groups(root):
        if controllers == "":  # version 2: one hierarchy
            top, name = root / "sys/fs/cgroup", "memory.max"
        elif "memory" in controllers.split(","):
            top, name = root / "sys/fs/cgroup/memory", "memory.limit_in_bytes"
        else:
            continue
        parts = [part for part in PurePosixPath(path).parts if part not in ("/", "..")]
        for depth in range(len(parts) + 1):
            limit = _read(top.joinpath(*parts[:depth], name)).strip()
            if limit.isdecimal():  # else "max"
                yield int(limit)


def _groups(root: Path) -> Iterator[tuple[str, str]]:
    """Controllers and path of each hierarchy, from lines like 4:memory:/path."""
    for line in _read(root / "proc/self/cgroup").splitlines():
        number, _, rest = line.partition(":")
        controllers, colon, path = rest.partition(":")
        if number and colon:
            yield controllers, path


def _read(path: Path) -> str:
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError):
        return ""
