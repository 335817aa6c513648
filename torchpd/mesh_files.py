"""Volume meshes in files, through meshio: what they hold, and in words why they cannot be read or written."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Collection
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .checks import check_target_file

__all__ = [
    "MESHIO_SUFFIXES",
    "SURFACE_SUFFIXES",
    "cells_of",
    "existing",
    "read_content",
    "regions_of",
    "without_tets",
    "write_tets",
]

Index = NDArray[np.int64]
PathLike = str | os.PathLike[str]

MESHIO_SUFFIXES = {".mesh", ".msh", ".vtk", ".vtu"}
_ENDINGS = "the file's name must end in .mesh, .msh, .vtk or .vtu, or as another format of meshio"
_REGIONS = ("gmsh:physical", "medit:ref")  # what meshio calls the regions of a .msh and of a .mesh
_VOLUMES = ("tetra", "hexahedron", "wedge", "pyramid")
# Formats without tetrahedra; not all that meshio reads.
SURFACE_SUFFIXES = {".glb", ".gltf", ".obj", ".off", ".ply", ".stl", ".wkt"}
# Formats that bring regions back; others write them nowhere, or wrong.
_WITH_REGIONS = {".dat", ".hmf", ".med", ".mesh", ".meshb", ".msh", ".tec", ".vtk", ".vtu", ".xdmf", ".xmf"}


def existing(path: PathLike) -> Path:
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"no such mesh file: {file}")
    return file


def read_content(owner: str, file: Path) -> Any:
    """What a file holds, as meshio has it."""
    import meshio

    if file.suffix.lower() not in meshio.extension_to_filetypes:
        raise ValueError(f"{owner} cannot read {file.name}: {_ENDINGS}")
    said, warned = io.StringIO(), io.StringIO()
    try:
        # meshio prints what is wrong with a file, sums it up on stderr, and exits the process
        with redirect_stdout(said), redirect_stderr(warned):
            content = meshio.read(file)
    except ModuleNotFoundError as error:
        raise _missing(f"{owner} cannot read {file.name}", error) from error
    except (meshio.ReadError, ValueError, SystemExit) as error:
        words = " ".join((said.getvalue().strip() or warned.getvalue()).split()).removeprefix("Error: ")
        raise ValueError(f"{owner} cannot read {file.name} through meshio: {words or error}") from error
    sys.stdout.write(said.getvalue())
    sys.stderr.write(warned.getvalue())
    return content


def cells_of(content: Any) -> dict[str, NDArray[Any]]:
    """The corner numbers of each type of cell."""
    types = {block.type for block in content.cells if len(block.data)}
    return {kind: np.concatenate([b.data for b in content.cells if b.type == kind and len(b.data)]) for kind in types}


def regions_of(content: Any) -> NDArray[Any] | None:
    """The number of each tet's region, if the file has any."""
    for name in _REGIONS:
        if name in content.cell_data:
            pairs = zip(content.cells, content.cell_data[name], strict=True)
            return np.concatenate([values for block, values in pairs if block.type == "tetra"]).astype(np.int64)
    return None


def _missing(failure: str, error: ModuleNotFoundError) -> ModuleNotFoundError:
    fix = f"pip install {error.name}; .mesh, .msh, .vtk and .vtu need nothing"
    return ModuleNotFoundError(f"{failure}: meshio needs the package {error.name} for it; {fix}", name=error.name)


def without_tets(file: Path, came: Collection[str]) -> ValueError:
    fix = "turn a surface into tetrahedra with torchpd.tetrahedralize(path, cells=...)"
    if any(kind.startswith(_VOLUMES) for kind in came):
        fix = "split its cells into tetrahedra of four vertices where it was made (of first order, in Gmsh)"
    return ValueError(
        f"TetMesh.from_file: {file.name} must hold tetrahedra (cells of type tetra), "
        f"got {', '.join(sorted(came)) or 'nothing'}; {fix}"
    )


def write_tets(path: PathLike, points: NDArray[np.float64], tets: Index, regions: Index | None) -> tuple[Path, bool]:
    """Write tets in the format of the file's suffix: the file, and whether it holds the regions."""
    import meshio

    file = check_target_file(path, "TetMesh.to_file")
    suffix = file.suffix.lower()
    plain = file.suffixes[-2:] == [".ugrid"]  # of which meshio cannot read what it writes: it wants .b8.ugrid, say
    if suffix not in meshio.extension_to_filetypes or suffix in SURFACE_SUFFIXES or plain:
        raise ValueError(f"TetMesh.to_file cannot write tetrahedra to {file}: {_ENDINGS}")
    data, kind = {}, None
    kept = suffix in _WITH_REGIONS
    if regions is not None and kept:
        data[_REGIONS[suffix == ".mesh"]] = [regions]
        if suffix == ".msh":  # version 2.2 has room for both numbers of a tet, and wants both
            data["gmsh:geometrical"], kind = [regions], "gmsh22"
    try:
        meshio.Mesh(points, [("tetra", tets)], cell_data=data).write(file, file_format=kind)
    except ModuleNotFoundError as error:
        raise _missing(f"TetMesh.to_file cannot write {file}", error) from error
    # ReadError, of formats that are only read; AssertionError, of numbers that do not fit the columns of a .nas
    except (meshio.ReadError, meshio.WriteError, KeyError, AssertionError) as error:
        words = str(error) or "its numbers do not fit the format"
        raise ValueError(f"TetMesh.to_file cannot write {file} through meshio: {words}; {_ENDINGS}") from error
    return file, kept
