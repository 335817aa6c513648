"""Mass, centre of mass and inertia of rigid surfaces."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.checks import as_array, check_finite, check_scalar
from ..geometry.tri_mesh import TriMesh
from .part import ArrayLike

__all__ = ["RigidMass", "rigid_mass"]

Array = NDArray[np.float64]

_FLAT = 1e-9  # of the largest moment: rounding of a flat body, whose moments meet the triangle inequality as equals
# integral of x x^T over a tetrahedron with corners 0, x_a: det(x) / 120 sum_ab (1 + delta_ab) x_a x_b^T
_OF_TETRAHEDRON = np.ones((3, 3)) + np.eye(3)


class RigidMass(NamedTuple):
    """Mass of a rigid body."""

    mass: float  # kg
    center: Array  # [3] m, of mass, in the axes of the mesh
    inertia: Array  # [3, 3] kg m^2 about that centre


def rigid_mass(mesh: TriMesh, mass: float, inertia: ArrayLike | None) -> RigidMass:
    """Mass of a body with this surface.

    The centre is that of a uniform body inside a closed surface, and of a uniform shell otherwise.

    Args:
        mesh: the surface.
        mass: positive [kg].
        inertia: about the centre of mass, in the axes of the mesh [kg m^2]: [3, 3], or three moments about the axes.
            None: that of a uniform body, which needs a closed surface.
    """
    mass = check_scalar("Collider.mass", mass)
    if not mass > 0.0:
        raise ValueError(f"Collider.mass must be positive [kg], got {mass}; None for a collider that moves by hand")
    corners = mesh.vertices[mesh.triangles]
    closed = _is_closed(mesh)
    center, moment = _solid(corners) if closed else (_shell_center(corners), None)
    if inertia is None:
        if moment is None:
            raise ValueError(
                "Collider.inertia must be given for an open surface, or one whose triangles are wound both ways, got "
                f"None and {_loose_edges(mesh)} edges that do not join two triangles in opposite directions around a "
                "volume; pass three moments [kg m^2], or close the surface and wind its triangles alike"
            )
        moment = mass * moment
        return RigidMass(mass, center, np.trace(moment) * np.eye(3) - moment)
    return RigidMass(mass, center, _inertia(inertia))


def _inertia(value: ArrayLike) -> Array:
    name = "Collider.inertia"
    array = as_array(name, value, np.float64)
    check_finite(name, array)
    if array.shape not in ((3,), (3, 3)):
        raise ValueError(f"{name} must be [3] or [3, 3] [kg m^2], got {list(array.shape)}")
    whole = np.diag(array) if array.ndim == 1 else array
    largest = float(np.abs(whole).max())
    if not np.allclose(whole, whole.T, rtol=0.0, atol=_FLAT * largest):
        raise ValueError(f"{name} must be symmetric, got {whole.tolist()}")
    whole = 0.5 * (whole + whole.T)
    moments = np.linalg.eigvalsh(whole)
    if not moments[0] > 0.0 or moments[2] > (1.0 + _FLAT) * (moments[0] + moments[1]):
        raise ValueError(
            f"{name} must have positive principal moments, none larger than the sum of the others, got "
            f"{moments.tolist()} kg m^2: no mass is spread so"
        )
    return whole


def _is_closed(mesh: TriMesh) -> bool:
    """Whether each edge joins two triangles that pass it in opposite directions, around a volume."""
    return mesh.volume() != 0.0 and _loose_edges(mesh) == 0


def _loose_edges(mesh: TriMesh) -> int:
    """Edges that do not join two triangles which pass them in opposite directions."""
    ways = np.stack([mesh.triangles.ravel(), np.roll(mesh.triangles, -1, axis=1).ravel()], axis=1)
    _, edge, count = np.unique(np.sort(ways, axis=1), axis=0, return_inverse=True, return_counts=True)
    forward = np.bincount(edge.ravel(), weights=ways[:, 0] < ways[:, 1])
    return int(np.count_nonzero((count != 2) | (forward != 1)))


def _solid(corners: Array) -> tuple[Array, Array]:
    """Centre [3], and integral of r r^T from it over the volume [3, 3] m^2 of a uniform body of mass 1."""
    about = corners.reshape(-1, 3).mean(axis=0)
    x = corners - about
    six_volumes = np.linalg.det(x)
    center = np.einsum("n,nij->j", six_volumes, x) / (4.0 * six_volumes.sum())
    moment = np.einsum("n,nai,ab,nbj->ij", six_volumes, x, _OF_TETRAHEDRON, x) / (20.0 * six_volumes.sum())
    return about + center, moment - np.outer(center, center)


def _shell_center(corners: Array) -> Array:
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    return np.asarray((areas[:, None] * corners.mean(axis=1)).sum(axis=0) / areas.sum())
