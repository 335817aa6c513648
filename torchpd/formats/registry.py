"""Which reader reads a file, by its suffix in lower case."""

from __future__ import annotations

from typing import NamedTuple

from . import surfaces, through_meshio
from .content import Reader

__all__ = ["FORMATS", "Format"]


class Format(NamedTuple):
    """A file format.

    Args:
        name: what error messages call it.
        read: its reader, which raises a `ValueError` without the name of the file where it cannot read one.
    """

    name: str
    read: Reader


FORMATS: dict[str, Format] = {
    **{suffix: Format(name, through_meshio.read) for suffix, name in through_meshio.NAMES.items()},
    **{suffix: Format(name, surfaces.read) for suffix, name in surfaces.NAMES.items()},
}
