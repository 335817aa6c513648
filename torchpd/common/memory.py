"""Slices of long arrays."""

from __future__ import annotations

from collections.abc import Iterator

__all__ = ["chunks"]

_CHUNK = 1 << 14  # rows


def chunks(count: int) -> Iterator[slice]:
    """Slices of a long array whose temporaries fit a cache."""
    return (slice(start, start + _CHUNK) for start in range(0, count, _CHUNK))
