"""Loads on surfaces: the pressure of a gas, and wind. `SurfaceLoads` turns them into the forces of a step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.checks import check_scalar, check_vector
from ..common.synonyms import check_arguments
from ..geometry.mesh_checks import check_elements
from ..geometry.mesh_faces import mesh_components
from .cloth import Cloth
from .effects import Solid
from .part import ArrayLike, Body, KeyPart, check_body, set_fields

__all__ = ["Pressure", "Wind", "enclosed_volume", "wind_surface"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(eq=False, repr=False)
class Pressure(KeyPart):
    """The pressure of a gas in a closed surface: p A n on every triangle, a third to each corner.

    A step takes the force at its start. It is stable while the pressure is far below the stiffness of the body.

    Args:
        body: a closed `Cloth`, such as a balloon, or a `Solid` with a cavity.
        pascals: overpressure p0 at the rest volume V0 [Pa]; negative for suction. `loads` of a step replace it.
        gas: whether the amount of gas is constant: p = (p0 + ambient) V0 / V - ambient. Else p is constant.
        ambient: pressure around the body [Pa], >= 0; 101325 is the atmosphere, and makes gas almost incompressible.
        triangles: the surface of the gas [F, 3], vertices of the body counter-clockwise seen from outside the gas.
            None: all of a cloth, or the cavities of a solid.

    Raises:
        ValueError: the surface is open, or encloses no positive volume.

    Example:
        >>> balloon = Pressure(cloth, 500.0, gas=True)
    """

    body: Body
    pascals: float
    gas: bool
    ambient: float
    triangles: Index

    @check_arguments("Pressure")
    def __init__(
        self, body: Body, pascals: float, *, gas: bool = False, ambient: float = 0.0, triangles: Any = None
    ) -> None:
        check_body("Pressure.body", body)
        if not isinstance(gas, bool | np.bool_):
            raise TypeError(f"Pressure.gas must be True or False, got {gas!r}")
        if triangles is not None:
            chosen = check_elements("Pressure.triangles", triangles, 3, len(body.mesh.vertices))
        elif isinstance(body, Cloth):
            chosen = body.surface.triangles
        elif isinstance(body, Solid):
            chosen = _cavities(body)
        else:
            raise TypeError(f"Pressure.body must be a Cloth or a Solid, got {type(body).__name__}, without a surface")
        _check_closed(body.mesh.vertices, chosen)
        set_fields(
            self,
            body=body,
            pascals=check_scalar("Pressure.pascals", pascals),
            gas=bool(gas),
            ambient=check_scalar("Pressure.ambient", ambient, minimum=0.0),
            triangles=chosen,
        )


@dataclass(eq=False, repr=False)
class Wind(KeyPart):
    """A uniform wind on every cloth and solid: drag rho c / 2 A (u . n)^2 along the normal n of every triangle.

    u is the wind relative to the triangle. Both sides of a cloth feel it, and a solid where the wind blows onto it. A
    step takes the force at its start, divided by 1 + h |force| / (m |u . n|), so that it never turns u . n around.

    Args:
        velocity: of the wind [3] m/s. `loads` of a step replace it.
        drag: coefficient c, >= 0; 1.2 is a flat plate across the wind.
        density: rho of the medium [kg/m^3], positive: 1.2 is air, 1000 water.

    Example:
        >>> breeze = Wind((4.0, 0.0, 1.0))
    """

    velocity: Array
    drag: float
    density: float

    @check_arguments("Wind")
    def __init__(self, velocity: ArrayLike, drag: float = 1.2, density: float = 1.2) -> None:
        medium = check_scalar("Wind.density", density)
        if medium <= 0.0:
            raise ValueError(f"Wind.density must be positive [kg/m^3], got {medium}")
        set_fields(
            self,
            velocity=check_vector("Wind.velocity", velocity),
            drag=check_scalar("Wind.drag", drag, minimum=0.0),
            density=medium,
        )


def wind_surface(body: Body) -> tuple[Index, bool] | None:
    """Triangles of a body that wind reaches [F, 3], and whether both sides feel it; None for a rod."""
    if isinstance(body, Cloth):
        return body.surface.triangles, True
    return (body.mesh.boundary(), False) if isinstance(body, Solid) else None


def enclosed_volume(vertices: Array, triangles: Index) -> float:
    """Volume inside a closed surface [m^3], about one of its vertices."""
    corners = vertices[triangles] - vertices[triangles[0, 0]]
    return float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0)


def _cavities(solid: Solid) -> Index:
    """Inner parts of the boundary of a solid, turned so that their normals point out of the gas."""
    vertices, boundary = solid.mesh.vertices, solid.mesh.boundary()
    part = mesh_components(boundary)[boundary[:, 0]]
    parts = [boundary[part == number] for number in np.unique(part)]
    inner = [own[:, ::-1] for own in parts if enclosed_volume(vertices, own) < 0.0]
    if not inner:
        raise ValueError(
            "Pressure.triangles must be given for a solid without a cavity, got None; they are the surface of the gas "
            "[F, 3], counter-clockwise seen from outside the gas"
        )
    return np.concatenate(inner)


def _check_closed(vertices: Array, triangles: Index) -> None:
    """Every edge must run once in either direction, and the surface must enclose a volume."""
    starts, ends = triangles[:, [0, 1, 2]].reshape(-1), triangles[:, [1, 2, 0]].reshape(-1)
    count = len(vertices)
    forth, uses = np.unique(starts * count + ends, return_counts=True)
    open_ = np.setdiff1d(forth, ends * count + starts)
    bad = np.concatenate([forth[uses > 1], open_])
    if bad.size:
        edge = [int(number) for number in divmod(int(bad[0]), count)]
        raise ValueError(
            "Pressure: the surface must be closed, every edge between two triangles of one orientation, got the edge "
            f"{edge} ({bad.size} in all); close the holes"
        )
    volume = enclosed_volume(vertices, triangles)
    if volume <= 0.0:
        raise ValueError(
            f"Pressure: the surface must enclose a positive volume, got {volume:.3g} m^3; turn its triangles, "
            "triangles[:, ::-1], so that they are counter-clockwise seen from outside the gas"
        )
