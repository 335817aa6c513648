"""Sheets of triangles: membrane, bending, and different stiffness along warp and weft."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..common.checks import as_array, check_finite, check_shape
from ..common.synonyms import check_arguments
from ..geometry.mesh_checks import warn
from ..geometry.rest_triangles import Hinges, RestTriangles, find_hinges, rest_triangles
from ..geometry.tri_mesh import TriMesh
from .limits import limit_rows
from .part import ArrayLike, Body, Place, per_item, report_size, set_fields, unit_vectors
from .stencils import StencilGroup

__all__ = ["Cloth"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Areas by UVs over areas in space outside of this range are probably in other units.
_LEAST_AREA, _MOST_AREA = 0.1, 10.0
# A direction this close to the normal of a triangle has no direction in its plane.
_STEEPEST = 1e-3


@dataclass(eq=False, repr=False)
class Cloth(Body):
    """A thin elastic sheet of triangles.

    Membrane, per rest area: mu |F - R|^2 + lambda t^2 / 2 with t = tr(R^T F) - 2, R the nearest 3 x 2 matrix with
    orthonormal columns, and Lame's constants of plane stress for youngs * thickness [N/m].

    Bending, per pair of triangles: kb / 2 |sum c_a x_a|^2 / A, with the weights c of the isometric bending model
    (Bergou et al. 2006) and their total area A. The factor 1 / A makes a cylinder cost kb / 2 times its curvature
    squared per area, where 3 / A is three times too stiff. Grids of right triangles are 14 to 22 % too soft.

    Vertices meet `Ground` and `Sphere` without thickness. It meets itself and other bodies in scenes with `Contact`.

    Args:
        surface: the sheet [m], with edges of one or two triangles. Its vertices are where the sheet starts.
        youngs: Young's modulus [Pa], a scalar or one value per triangle, positive.
        thickness: [m], a scalar or one value per triangle, positive.
        area_density: mass per area [kg/m^2], a scalar or one value per triangle: 0.15 is a shirt, 0.4 denim.
        poisson: Poisson's ratio, a scalar or one value per triangle, above -1 and at most 0.5.
        bending: flexural rigidity kb [N m], a scalar or one value per hinge (rows of `hinges`). None: youngs
            thickness^3 / 12. The scalar 0 leaves bending out. Fabrics bend more easily than that: 1e-6 to 1e-4.
        rest_uv: rest shape in a plane [F, 3, 2] m, by coordinates of each corner of each triangle, as sewing patterns
            have it. None: the rest shape is the surface.
        rest_curvature: curvature at rest [1/m], a scalar or one value per hinge. 0: flat; a scene of flat hinges alone
            has no such array to train. "surface": that of the surface, for shells. Such a hinge may bend either way.
        warp: further stiffness along the warp [N/m], a scalar or one value per triangle; or None.
        weft: the same across the warp, along the weft.
        strain_limit: least and largest stretch (lo, hi), or one pair per triangle [F, 2], lo <= 1 <= hi; None: none.
            Beyond them A k / 2 dist^2(F, {stretches in [lo, hi]}) adds to the energy. Fabrics hardly resist compression
            in their plane: lo = 0 leaves it out.
        limit_stiffness: k [N/m], a scalar or one value per triangle. None: 30 times youngs thickness.
        grain: direction of the warp: [2] in `rest_uv`, by default (0, 1), or else [3] in space, projected to triangles.

    Raises:
        ValueError: an edge of more than two triangles, a triangle without area, or a value outside its range.

    Example:
        >>> shirt = Cloth(surface, youngs=5e5, thickness=4e-4, area_density=0.15, bending=1e-5)
    """

    surface: TriMesh
    youngs: Array
    thickness: Array
    area_density: Array
    poisson: Array
    bending: Array | None  # [H], None: follows youngs and thickness
    rest_uv: Array | None
    rest_curvature: Array  # [H]
    warp: Array | None
    weft: Array | None
    grain: Array | None
    strain_limit: Array | None  # [F, 2]
    limit_stiffness: Array | None  # [F]

    @check_arguments("Cloth")
    def __init__(
        self,
        surface: TriMesh,
        youngs: ArrayLike,
        thickness: ArrayLike,
        area_density: ArrayLike,
        *,
        poisson: ArrayLike = 0.3,
        bending: ArrayLike | None = None,
        rest_uv: Any = None,
        rest_curvature: ArrayLike | Literal["surface"] = 0.0,
        warp: ArrayLike | None = None,
        weft: ArrayLike | None = None,
        grain: Any = None,
        strain_limit: Any = None,
        limit_stiffness: ArrayLike | None = None,
    ) -> None:
        if not isinstance(surface, TriMesh):
            raise TypeError(
                f"Cloth: surface must be a TriMesh, got {type(surface).__name__}; "
                "make one by torchpd.TriMesh(vertices, triangles) or TriMesh.from_file(path)"
            )
        report_size("Cloth", "surface", surface.vertices, surface.triangles)
        count = len(surface.triangles)

        def per_triangle(name: str, value: ArrayLike, unit: str) -> Array:
            return per_item(f"Cloth.{name}", value, count, of="triangle", unit=unit)

        uv = None if rest_uv is None else _rest_uv(rest_uv, surface)
        set_fields(
            self,
            surface=surface,
            youngs=per_triangle("youngs", youngs, "Pa"),
            thickness=per_triangle("thickness", thickness, "m"),
            area_density=per_triangle("area_density", area_density, "kg/m^2"),
            poisson=_poisson(poisson, count),
            rest_uv=uv,
            warp=None if warp is None else per_triangle("warp", warp, "N/m"),
            weft=None if weft is None else per_triangle("weft", weft, "N/m"),
        )
        within = self.youngs * self.thickness
        limits = limit_rows("Cloth", strain_limit, limit_stiffness, within, of="triangle", unit="N/m")
        hinges = self._hinges  # refuses triangles without area and edges of more than two
        set_fields(
            self,
            bending=None if bending is None else _per_hinge("bending", bending, hinges, "N m"),
            rest_curvature=_curvature(rest_curvature, surface, hinges),
            grain=_grain(grain, uv, woven=warp is not None or weft is not None),
            strain_limit=None if limits is None else limits[:, :2],
            limit_stiffness=None if limits is None else limits[:, 2],
        )
        self._directions()  # refuses a direction along a normal

    @cached_property
    def _rest(self) -> RestTriangles:
        triangles = self.surface.triangles
        if self.rest_uv is not None:
            return rest_triangles("Cloth.rest_uv", self.rest_uv, triangles)
        return rest_triangles("Cloth.surface", self.surface.vertices[triangles], triangles)

    @cached_property
    def _hinges(self) -> Hinges:
        return find_hinges("Cloth.surface", self.surface.triangles, self._rest)

    @property
    def mesh(self) -> TriMesh:
        """The surface, as bodies call their rest shape."""
        return self.surface

    @property
    def elements(self) -> Index:
        return self.surface.triangles

    @property
    def hinges(self) -> Index:
        """Interior edges [H, 4]: the ends of the edge, and the opposite vertices of its two triangles."""
        return self._hinges.corners

    @property
    def hinge_triangles(self) -> Index:
        """The two triangles of each hinge [H, 2]."""
        return self._hinges.triangles

    @property
    def areas(self) -> Array:
        """Areas of the triangles at rest [F] m^2."""
        return self._rest.areas

    def masses(self) -> Array:
        share = self.area_density * self.areas / 3.0
        return np.bincount(self.elements.reshape(-1), weights=np.repeat(share, 3)).astype(np.float64, copy=False)

    def flexural_rigidity(self) -> Array:
        """kb of each hinge [H] N m: `bending`, or youngs thickness^3 / 12 as the mean of two triangles by area."""
        if self.bending is not None:
            return self.bending
        of_triangle = self.youngs * self.thickness**3 / 12.0 * self.areas
        return np.asarray(of_triangle[self._hinges.triangles].sum(axis=1) / self._hinges.areas)

    def stencils(self, place: Place) -> tuple[StencilGroup, ...]:
        start = place(self)
        membrane = StencilGroup.of(
            "triangle",
            self.elements + start,
            self._rest.gradients,
            self.areas,
            membrane_youngs=self.youngs,
            membrane_poisson=self.poisson,
            thickness=self.thickness,
        )
        return (membrane, *self._bending(start), *self._threads(start), *self._limits(start))

    def _limits(self, start: int) -> tuple[StencilGroup, ...]:
        if self.strain_limit is None or self.limit_stiffness is None:
            return ()
        rows = np.concatenate([self.strain_limit, self.limit_stiffness[:, None]], axis=1)
        corners = self.elements + start
        return (StencilGroup.of("cloth_limit", corners, self._rest.gradients, self.areas, cloth_limit=rows),)

    def _bending(self, start: int) -> tuple[StencilGroup, ...]:
        hinges = self._hinges
        if not len(hinges.corners) or (self.bending is not None and not self.bending.any()):
            return ()
        group = StencilGroup.of(
            "hinge",
            hinges.corners + start,
            (hinges.weights / hinges.areas[:, None])[:, :, None],
            hinges.areas,
            bending=self.flexural_rigidity(),
            rest_curvature=self.rest_curvature,
        )
        return (group,)

    def _threads(self, start: int) -> tuple[StencilGroup, ...]:
        """Threads along the warp of all triangles, then those along the weft."""
        groups = []
        warp = self._directions()
        for stiffness, direction in ((self.warp, warp), (self.weft, warp[:, ::-1] * [1.0, -1.0])):
            if stiffness is not None:
                along = np.einsum("fad,fd->fa", self._rest.gradients, direction)[:, :, None]
                groups.append(
                    StencilGroup.of("thread", self.elements + start, along, self.areas, thread_stiffness=stiffness)
                )
        return tuple(groups)

    def _directions(self) -> Array:
        """Unit vector of the warp in the rest plane of each triangle [F, 2]."""
        if self.grain is None:
            return np.zeros((len(self.elements), 2))
        if self._rest.frames is None:
            return np.tile(self.grain, (len(self.elements), 1))
        flat = np.einsum("k,fkd->fd", self.grain, self._rest.frames)
        length = np.linalg.norm(flat, axis=1)
        bad = np.flatnonzero(length < _STEEPEST)
        if bad.size:
            raise ValueError(
                f"Cloth.grain must lie along the triangles, got the normal of that at {int(bad[0])} ({bad.size} in "
                "all); take another direction, or give rest_uv"
            )
        return np.asarray(flat / length[:, None])


def _poisson(value: ArrayLike, count: int) -> Array:
    name = "Cloth.poisson"
    array = as_array(name, value, np.float64)
    array = np.full(count, float(array)) if array.ndim == 0 else array
    check_shape(name, array, (count,), "one value per triangle or a scalar")
    check_finite(name, array)
    bad = np.flatnonzero(~((array > -1.0) & (array <= 0.5)))
    if bad.size:
        raise ValueError(
            f"{name} must lie above -1 and at most at 0.5, got {array[bad[0]]} at {int(bad[0])} ({bad.size} in all)"
        )
    return array


def _rest_uv(value: Any, surface: TriMesh) -> Array:
    name = "Cloth.rest_uv"
    uv = as_array(name, value, np.float64)
    check_shape(name, uv, (len(surface.triangles), 3, 2), "coordinates [m] of each corner of each triangle")
    check_finite(name, uv)
    first, second = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    flat = float(np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]).sum())
    corners = surface.vertices[surface.triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = float(np.linalg.norm(across, axis=1).sum())
    if size > 0.0 and flat > 0.0 and not _LEAST_AREA <= flat / size <= _MOST_AREA:
        warn(
            f"Cloth: rest_uv spans {flat / 2.0:.3g} m^2, and the surface {size / 2.0:.3g} m^2. Coordinates are in "
            f"metres: multiply rest_uv by {np.sqrt(size / flat):.3g} if the sheet starts unstretched"
        )
    return uv


def _per_hinge(name: str, value: ArrayLike, hinges: Hinges, unit: str) -> Array:
    return per_item(f"Cloth.{name}", value, len(hinges.corners), of="hinge", unit=unit, zero=True)


def _curvature(value: Any, surface: TriMesh, hinges: Hinges) -> Array:
    if not isinstance(value, str):
        return _per_hinge("rest_curvature", value, hinges, "1/m")
    if value != "surface":
        raise ValueError(f'Cloth.rest_curvature must be numbers [1/m] or "surface", got {value!r}')
    bent = np.einsum("ha,hak->hk", hinges.weights, surface.vertices[hinges.corners])
    return np.asarray(np.linalg.norm(bent, axis=1) / hinges.areas)


def _grain(value: Any, uv: Array | None, *, woven: bool) -> Array | None:
    if value is None:
        if woven and uv is None:
            raise ValueError(
                "Cloth.grain must be given with warp or weft, got None; it is the direction of the warp [3] in space, "
                "or (0, 1) by default with rest_uv"
            )
        return np.array([0.0, 1.0]) if woven else None
    if not woven:
        raise ValueError("Cloth.grain is the direction of warp and weft, got it without either; give warp or weft")
    grain = as_array("Cloth.grain", value, np.float64)
    size, where = (3, "a direction in space") if uv is None else (2, "a direction in rest_uv")
    check_shape("Cloth.grain", grain, (size,), where)
    return unit_vectors("Cloth.grain", grain[None]).reshape(size)
