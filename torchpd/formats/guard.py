"""The one place that opens mesh files: every failure of a reader becomes an error that explains it."""

from __future__ import annotations

import io
import os
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..common.units import Unit, metres
from .content import CELLS, MeshContent
from .registry import FORMATS, Format

__all__ = ["PathLike", "existing_path", "name_file_in_errors", "read"]

PathLike = str | os.PathLike[str]

_ENDINGS = "the file's name must end in .mesh, .msh, .vtk or .vtu, or as another format that torchpd reads"


def existing_path(path: PathLike) -> Path:
    """Path of an existing file; raises `FileNotFoundError` otherwise."""
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"no such mesh file: {file}")
    return file


def read(owner: str, path: PathLike, unit: Unit | None = None) -> MeshContent:
    """Read points and cells of a mesh file.

    Args:
        owner: name of the caller, with which errors begin.
        path: the file; its suffix selects the format.
        unit: of its numbers, see `torchpd.common.units`.

    Raises:
        FileNotFoundError: the file, or one that belongs to it, is missing.
        ModuleNotFoundError: the format needs a package that is not installed.
        ValueError: any other failure; the error gives the name of the file, its format and the cause.
    """
    factor = metres(owner, unit)
    file = existing_path(path)
    kind = FORMATS.get(file.suffix.lower())
    if kind is None:
        known = " ".join(sorted(FORMATS))
        others = "for other formats of trimesh, TriMesh.from_trimesh(trimesh.load(path))"
        raise ValueError(f"{owner} cannot read {file.name}: {_ENDINGS} ({known}); {others}")
    failure = f"{owner} cannot read {file.name} ({kind.name})"
    if not file.stat().st_size:
        raise ValueError(f"{failure}: the file is empty; write it again")
    output = io.StringIO()
    try:
        # libraries print faults of a file, and some exit the process
        with redirect_stdout(output), redirect_stderr(output), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            content = kind.read(file)
            _check(content)
    except ModuleNotFoundError as error:
        needed = f"its format needs the package {error.name}; pip install {error.name}"
        raise ModuleNotFoundError(f"{failure}: {needed}", name=error.name) from error
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{failure}: {error}") from error
    except PermissionError:
        raise
    # SystemExit and the panics of compiled libraries are no `Exception`
    except BaseException as error:
        if isinstance(error, (KeyboardInterrupt, GeneratorExit)):
            raise
        raise ValueError(f"{failure}: {_describe(error, output.getvalue(), kind)}") from error
    if unit is None:
        return content
    if content.in_metres:
        raise ValueError(f"{owner}: unit must be None for {file.name}, which declares its unit, got {unit!r}")
    return replace(content, points=factor * content.points)


@contextmanager
def name_file_in_errors(owner: str, path: PathLike) -> Iterator[None]:
    """Prefix errors of a mesh made from a file with the name of the file."""
    try:
        yield
    except (ValueError, IndexError, TypeError) as error:
        if Path(path).name in str(error):
            raise
        raise ValueError(f"{owner} cannot use {Path(path).name}: {error}") from error


def _check(content: MeshContent) -> None:
    """Check that cells have all corners, that these are points of the file, and that these points are finite."""
    for block in content.cells:
        corners = CELLS.get(block.kind, (0, 0))[0]
        if corners and block.corners.shape[1:] != (corners,):
            raise ValueError(f"a {block.kind} must have {corners} corners, got cells {list(block.corners.shape)}")
        outside = (block.corners < 0) | (block.corners >= len(content.points))
        if outside.any():
            number = int(block.corners[outside][0])
            raise ValueError(
                f"a {block.kind} names point {number} (counted from 0), but the file holds {len(content.points)} points"
            )
    bad = np.flatnonzero(~np.isfinite(content.points).all(axis=1) & content.in_cells())
    if len(bad):
        raise ValueError(f"point {bad[0]} (counted from 0) must be finite, got {content.points[bad[0]].tolist()}")


def _describe(error: BaseException, output: str, kind: Format) -> str:
    """One-line description of a reader's error."""
    # meshio appends the path of the file to its errors
    printed = re.sub(r" ?Error: Couldn't read file .*", "", " ".join(output.split())).removeprefix("Error: ")
    words = " ".join(str(error).split())
    if isinstance(error, ValueError) and words:
        return f"{words} ({printed})" if printed and printed not in words else words
    if isinstance(error, MemoryError):
        words = f"its reader needs more memory than is available ({words})" if words else "its reader ran out of memory"
    elif isinstance(error, RecursionError):
        words = "it is nested too deeply"
    elif not printed:
        words = f"its reader stopped with {type(error).__name__}: {words}" if words else type(error).__name__
    else:
        words = printed
    return f"{words}; is the file complete, and is it {kind.name}?"
