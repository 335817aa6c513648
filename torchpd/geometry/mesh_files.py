"""Tets written to files, through meshio, and in words why a format cannot hold them."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..common.checks import check_target_file

__all__ = ["write_tets"]

Index = NDArray[np.int64]
PathLike = str | os.PathLike[str]

_ENDINGS = "the file's name must end in .mesh, .msh, .vtk or .vtu, or as another format of meshio"
_REGIONS = ("gmsh:physical", "medit:ref")  # what meshio calls the regions of a .msh and of a .mesh
# Formats without tetrahedra; not all that meshio reads.
_SURFACES = {".glb", ".gltf", ".obj", ".off", ".ply", ".stl", ".wkt"}
# Formats that bring regions back; others write them nowhere, or wrong.
_WITH_REGIONS = {".dat", ".hmf", ".med", ".mesh", ".meshb", ".msh", ".tec", ".vtk", ".vtu", ".xdmf", ".xmf"}


def _missing(failure: str, error: ModuleNotFoundError) -> ModuleNotFoundError:
    fix = f"pip install {error.name}; .mesh, .msh, .vtk and .vtu need nothing"
    return ModuleNotFoundError(f"{failure}: meshio needs the package {error.name} for it; {fix}", name=error.name)


def write_tets(path: PathLike, points: NDArray[np.float64], tets: Index, regions: Index | None) -> tuple[Path, bool]:
    """Write tets in the format of the file's suffix: the file, and whether it holds the regions."""
    import meshio

    file = check_target_file(path, "TetMesh.to_file")
    suffix = file.suffix.lower()
    plain = file.suffixes[-2:] == [".ugrid"]  # of which meshio cannot read what it writes: it wants .b8.ugrid, say
    if suffix not in meshio.extension_to_filetypes or suffix in _SURFACES or plain:
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
