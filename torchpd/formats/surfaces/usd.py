"""USD (.usd, .usda, .usdc, .usdz), through usd-core: all meshes and tet meshes of a stage, in metres and y up.

Numbers are multiplied by the stage's metersPerUnit, and a z-up stage is rotated to y up. Animated prims are read at
their earliest time.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..content import Array, Cells, Index, MeshContent
from .faces import check_corners, check_instances, face_blocks, join_uvs, left_out, one_uv_each, turn_faces
from .usd_stage import axes_of, check_lengths, open_stage, warnings_of

__all__ = ["read_usd"]

# purposes that are read; the others are guides, and proxies of prims that are read too
_PURPOSES = ("default", "render")


def read_usd(path: Path) -> MeshContent:
    """Read the visible meshes and tet meshes of a file, each at the place of its transforms."""
    try:
        from pxr import Usd, UsdGeom, UsdUtils
    except ImportError:
        raise ModuleNotFoundError("USD files need usd-core", name="usd-core") from None
    check_lengths(path)
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    stage = open_stage(path, delegate)
    reading = _Reading(UsdGeom.XformCache(Usd.TimeCode.EarliestTime()), *axes_of(stage))
    alive = Usd.PrimIsActive & Usd.PrimIsDefined & Usd.PrimIsLoaded & ~Usd.PrimIsAbstract
    prims = iter(Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies(alive)))
    for prim in prims:
        if prim.IsA(UsdGeom.PointInstancer):
            reading.others["PointInstancer"] += 1
            prims.PruneChildren()
        elif prim.IsA(UsdGeom.Gprim):
            reading.take(prim)
    content = reading.content(in_metres=UsdGeom.StageHasAuthoredMetersPerUnit(stage))
    content.notes.extend(warnings_of(delegate))
    return content


class _Reading:
    """Points and cells of the prims so far."""

    def __init__(self, places: Any, axes: Array, notes: list[str]) -> None:
        self.places = places  # the XformCache
        self.time = places.GetTime()
        self.axes = axes
        self.notes = notes
        self.points: list[Array] = []
        self.uvs: list[Array | None] = []
        self.cells: list[Cells] = []
        self.count = self.prims = 0
        self.others: Counter[str] = Counter()  # omitted prims
        self.smooth: Counter[str] = Counter()  # subdivision schemes
        self.moving = 0

    def take(self, prim: Any) -> None:
        """Add a mesh or a tet mesh; other prims are counted."""
        from pxr import UsdGeom

        self.prims += 1
        check_instances(self.prims)
        shown = UsdGeom.Imageable(prim)
        if shown.ComputeVisibility(self.time) == UsdGeom.Tokens.invisible:
            self.others[f"invisible {prim.GetTypeName()}"] += 1
        elif (purpose := shown.ComputePurpose()) not in _PURPOSES:
            self.others[f"{prim.GetTypeName()} of purpose {purpose}"] += 1
        elif prim.IsA(UsdGeom.Mesh):
            self._take_mesh(UsdGeom.Mesh(prim))
        elif prim.IsA(UsdGeom.TetMesh):
            self._take_tets(UsdGeom.TetMesh(prim))
        else:
            self.others[str(prim.GetTypeName())] += 1

    def _values(self, attribute: Any, width: int, kind: type) -> NDArray[Any]:
        """Rows of an attribute [n, width] at the time of reading."""
        value = attribute.Get(self.time)
        return np.array([] if value is None else value, dtype=kind).reshape(-1, width)

    def _place(self, shape: Any) -> tuple[Array, bool]:
        """Points of a prim in metres, y up, and whether its cells must be reversed."""
        from pxr import UsdGeom

        prim = shape.GetPrim()
        above, moving = prim, shape.GetPointsAttr().ValueMightBeTimeVarying()
        while above and not moving:
            moving = bool(UsdGeom.Xformable(above)) and UsdGeom.Xformable(above).TransformMightBeTimeVarying()
            above = above.GetParent()
        self.moving += moving
        if UsdGeom.PrimvarsAPI(prim).HasPrimvar("skel:jointIndices"):
            self.notes.append(f"{prim.GetPath()} is bound to a skeleton and was read in its bind pose")
        matrix = np.array(self.places.GetLocalToWorldTransform(prim))  # acts on rows
        if not np.isfinite(matrix).all() or not np.array_equal(matrix[:, 3], [0.0, 0.0, 0.0, 1.0]):
            raise ValueError(f"the transform of {prim.GetPath()} must be affine and finite")
        points = self._values(shape.GetPointsAttr(), 3, np.float64)
        turned = shape.GetOrientationAttr().Get(self.time) == UsdGeom.Tokens.leftHanded
        return (points @ matrix[:3, :3] + matrix[3, :3]) @ self.axes.T, turned != (np.linalg.det(matrix[:3, :3]) < 0)

    def _take_mesh(self, mesh: Any) -> None:
        name = str(mesh.GetPath())
        points, turned = self._place(mesh)
        sizes = self._values(mesh.GetFaceVertexCountsAttr(), 1, np.int64).reshape(-1)
        corners = self._values(mesh.GetFaceVertexIndicesAttr(), 1, np.int64).reshape(-1)
        if (sizes < 0).any() or int(sizes.sum()) != len(corners):
            raise ValueError(
                f"{name} has {len(corners)} faceVertexIndices; its faceVertexCounts add up to {sizes.sum()}"
            )
        check_corners(corners, len(points), f"points of {name}")
        if not len(corners):
            self.others["Mesh without faces"] += 1
            return
        scheme = mesh.GetSubdivisionSchemeAttr().Get(self.time)
        if scheme != "none":
            self.smooth[str(scheme)] += 1
        values = _coordinates(mesh.GetPrim(), self.time, corners, len(points))
        uvs = None
        if values is not None:
            points, corners, uvs = one_uv_each(points, corners, *values)
        if turned:
            corners = turn_faces(corners, sizes)
        kept = np.ones(len(sizes), dtype=bool)
        holes = self._values(mesh.GetHoleIndicesAttr(), 1, np.int64).reshape(-1)
        if len(holes):
            check_corners(holes, len(sizes), f"faces of {name} in holeIndices")
            kept[holes] = False
            self.others["faces that are declared holes"] += int((~kept).sum())
        corners = corners[np.repeat(kept, sizes)] + self.count
        self.cells += face_blocks(corners, sizes[kept], self.notes)
        self._add(points, uvs)

    def _take_tets(self, mesh: Any) -> None:
        name = str(mesh.GetPath())
        points, turned = self._place(mesh)
        tets = self._values(mesh.GetTetVertexIndicesAttr(), 4, np.int64)
        faces = self._values(mesh.GetSurfaceFaceVertexIndicesAttr(), 3, np.int64)
        for corners in (tets, faces):
            check_corners(corners.reshape(-1), len(points), f"points of {name}")
        if turned:
            tets, faces = tets[:, [0, 1, 3, 2]], faces[:, ::-1]
        if not len(tets):
            self.others["TetMesh without tets"] += 1
        regions = self._regions(mesh, len(tets))
        self.cells += [Cells("tetra", tets + self.count, regions=regions)] if len(tets) else []
        self.cells += [Cells("triangle", faces + self.count)] if len(faces) else []
        self._add(points, None)

    def _regions(self, mesh: Any, count: int) -> Index | None:
        """Subsets of the tets, numbered from 1 in the order of the file; 0 for tets in none."""
        from pxr import UsdGeom

        subsets = UsdGeom.Subset.GetGeomSubsets(mesh, UsdGeom.Tokens.tetrahedron)
        regions = np.zeros(count, dtype=np.int64)
        for number, subset in enumerate(subsets, start=1):
            members = self._values(subset.GetIndicesAttr(), 1, np.int64).reshape(-1)
            check_corners(members, count, f"tets in {subset.GetPath()}")
            regions[members] = number
            self.notes.append(f"region {number} is the subset {subset.GetPrim().GetName()} ({len(members)} tets)")
        return regions if subsets else None

    def _add(self, points: Array, uvs: Array | None) -> None:
        self.points.append(points)
        self.uvs.append(uvs)
        self.count += len(points)

    def content(self, *, in_metres: bool) -> MeshContent:
        notes = self.notes + left_out(self.others)
        for scheme, count in self.smooth.items():
            notes.append(f"{count} of its meshes are to be subdivided ({scheme}); the control meshes were read")
        if self.moving:
            notes.append(f"{self.moving} of its meshes move, and were read at their earliest time")
        uvs = join_uvs(self.uvs, notes)
        return MeshContent(np.concatenate([np.empty((0, 3)), *self.points]), self.cells, uvs, notes, in_metres)


def _coordinates(prim: Any, time: Any, corners: Index, count: int) -> tuple[Index, Array] | None:
    """Number of the texture coordinate of each corner, and the coordinates [n, 2]; None without any."""
    from pxr import UsdGeom

    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar("st")
    value = primvar.ComputeFlattened(time) if primvar else None
    if value is None:
        return None
    uvs = np.array(value, dtype=np.float64)
    place = primvar.GetInterpolation()
    if place in (UsdGeom.Tokens.vertex, UsdGeom.Tokens.varying) and uvs.shape == (count, 2):
        return corners, uvs
    if place == UsdGeom.Tokens.faceVarying and uvs.shape == (len(corners), 2):
        uvs, numbers = np.unique(uvs, axis=0, return_inverse=True)
        return numbers.reshape(-1).astype(np.int64), uvs
    return None
