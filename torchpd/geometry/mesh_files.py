"""Mesh files of tets, written through meshio; errors name the reason why a format cannot hold them."""

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
_REGIONS = ("gmsh:physical", "medit:ref")  # names of the regions in meshio, for .msh and .mesh
# formats without tetrahedra, among those that meshio reads
_SURFACES = {".glb", ".gltf", ".obj", ".off", ".ply", ".stl", ".wkt"}
# formats that restore regions; others drop or damage them
_WITH_REGIONS = {".dat", ".hmf", ".med", ".mesh", ".meshb", ".msh", ".tec", ".vtk", ".vtu", ".xdmf", ".xmf"}


def _missing(failure: str, error: ModuleNotFoundError) -> ModuleNotFoundError:
    fix = f"pip install {error.name}; .mesh, .msh, .vtk and .vtu need nothing"
    return ModuleNotFoundError(f"{failure}: meshio needs the package {error.name} for it; {fix}", name=error.name)


def write_tets(path: PathLike, points: NDArray[np.float64], tets: Index, regions: Index | None) -> tuple[Path, bool]:
    """Write tets in the format of the file's suffix; returns the file, and whether it holds the regions."""
    import meshio

    file = check_target_file(path, "TetMesh.to_file")
    suffix = file.suffix.lower()
    plain = file.suffixes[-2:] == [".ugrid"]  # a name that meshio cannot read back: it expects .b8.ugrid, for example
    if suffix not in meshio.extension_to_filetypes or suffix in _SURFACES or plain:
        raise ValueError(f"TetMesh.to_file cannot write tetrahedra to {file}: {_ENDINGS}")
    data, kind = {}, None
    kept = suffix in _WITH_REGIONS
    if regions is not None and kept:
        data[_REGIONS[suffix == ".mesh"]] = [regions]
        if suffix == ".msh":  # version 2.2 stores both numbers of a tet, and requires both
            data["gmsh:geometrical"], kind = [regions], "gmsh22"
    try:
        meshio.Mesh(points, [("tetra", tets)], cell_data=data).write(file, file_format=kind)
    except ModuleNotFoundError as error:
        raise _missing(f"TetMesh.to_file cannot write {file}", error) from error
    # ReadError: a format that is only read; AssertionError: numbers too wide for the columns of a .nas
    except (meshio.ReadError, meshio.WriteError, KeyError, AssertionError) as error:
        words = str(error) or "its numbers do not fit the format"
        raise ValueError(f"TetMesh.to_file cannot write {file} through meshio: {words}; {_ENDINGS}") from error
    return file, kept
