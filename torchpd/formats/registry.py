"""Readers of mesh files by suffix, in lower case."""

from __future__ import annotations

from typing import NamedTuple

from . import surfaces
from .content import Reader
from .volumes import (
    abaqus,
    avs,
    dolfin,
    flac3d,
    gmsh,
    isaac,
    kratos,
    medit,
    nastran,
    netgen,
    permas,
    su2,
    tecplot,
    tetgen,
    through_meshio,
    ugrid,
    vtk,
    vtk_xml,
)

__all__ = ["FORMATS", "Format"]


class Format(NamedTuple):
    """A file format.

    Args:
        name: its name in error messages.
        read: its reader; raises a `ValueError` without the name of the file if it cannot read one.
    """

    name: str
    read: Reader


FORMATS: dict[str, Format] = {
    ".dato": Format("Permas", permas.read),
    ".post": Format("Permas", permas.read),
    ".f3grid": Format("FLAC3D", flac3d.read),
    ".mdpa": Format("Kratos", kratos.read),
    ".su2": Format("SU2", su2.read),
    ".ugrid": Format("UGRID", ugrid.read),
    ".vol": Format("Netgen", netgen.read),
    ".xml": Format("DOLFIN XML", dolfin.read),
    ".bdf": Format("Nastran", nastran.read),
    ".fem": Format("Nastran", nastran.read),
    ".nas": Format("Nastran", nastran.read),
    ".dat": Format("Tecplot", tecplot.read),
    ".tec": Format("Tecplot", tecplot.read),
    ".avs": Format("AVS-UCD", avs.read),
    ".inp": Format("Abaqus", abaqus.read),
    ".ele": Format("TetGen", tetgen.read),
    ".mesh": Format("Medit", medit.read),
    ".meshb": Format("Medit binary", medit.read),
    ".msh": Format("Gmsh", gmsh.read),
    ".node": Format("TetGen", tetgen.read),
    ".pvtp": Format("VTK XML", vtk_xml.read),
    ".pvtu": Format("VTK XML", vtk_xml.read),
    ".tet": Format("Isaac Gym", isaac.read),
    ".vtk": Format("VTK legacy", vtk.read),
    ".vtp": Format("VTK XML", vtk_xml.read),
    ".vtu": Format("VTK XML", vtk_xml.read),
    **{suffix: Format(name, through_meshio.read) for suffix, name in through_meshio.NAMES.items()},
    **{suffix: Format(*row) for suffix, row in surfaces.READERS.items()},
}
