"""The parts of a scene: frozen descriptions, without work, that `Scene` gathers.

All quantities are in SI units. Numbers, sequences, arrays and tensors are accepted alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import FrozenInstanceError, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..common.checks import as_array, check_finite, check_positive, check_scalar, check_shape, check_vector
from ..common.reprs import by_fields
from ..common.synonyms import check_arguments
from ..geometry.mesh_checks import warn
from ..geometry.mesh_faces import mesh_components
from ..geometry.tet_mesh import TetMesh

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["Damping", "Gravity", "Ground", "Pin", "Solid", "Sphere"]

Array = NDArray[np.float64]
ArrayLike = float | Sequence[float] | Array | torch.Tensor

# Meshes of shorter or longer bodies [m] are probably in other units.
_SHORTEST, _LONGEST = 1e-3, 50.0


def _set(part: object, **values: Any) -> None:
    """Store checked values in a frozen part."""
    for name, value in values.items():
        object.__setattr__(part, name, value)


class _Part:
    """A value that a deep copy shares, so that copies of a scene know the same parts."""

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self

    def __repr__(self) -> str:
        return by_fields(self)


class _Key(_Part):
    """A part that serves as a key of `targets` and read-outs: frozen, but not by `dataclass(frozen=True)`.

    torch.compile would hash such a dataclass by its fields, which are arrays, despite `eq=False`.
    """

    def __setattr__(self, name: str, value: object) -> None:
        raise FrozenInstanceError(f"cannot assign to field {name!r}")

    def __delattr__(self, name: str) -> None:
        raise FrozenInstanceError(f"cannot delete field {name!r}")


def _per_element(name: str, value: ArrayLike, count: int, *, unit: str) -> Array:
    array = as_array(name, value, np.float64)
    if array.ndim == 0:
        array = np.full(count, float(array))
    check_shape(name, array, (count,), f"one value per tetrahedron or a scalar [{unit}]")
    check_finite(name, array)
    check_positive(name, array, unit=unit)
    array.setflags(write=False)
    return array


def _longest_side(mesh: TetMesh) -> float:
    """Longest side [m] of the box around a mesh or, if that is too long, of the boxes around its components."""
    points = mesh.vertices
    length = float(np.ptp(points, axis=0).max())
    if length <= _LONGEST:
        return length
    component = mesh_components(mesh.tets)
    order = np.argsort(component, kind="stable")
    starts = np.flatnonzero(np.diff(component[order], prepend=-1))
    sides = np.maximum.reduceat(points[order], starts) - np.minimum.reduceat(points[order], starts)
    return float(sides.max())


def _report_size(mesh: TetMesh) -> None:
    """Warn of a body whose longest side is probably not in metres."""
    length = _longest_side(mesh)
    if not _SHORTEST <= length <= _LONGEST:
        fix = "scaled(1000) if these were divided by 1000"
        if length > _LONGEST:
            fix = 'scaled(0.001) if these are millimetres, or read its file with unit="mm"'
        warn(
            f"Solid: the mesh is {length:.4g} m long, where bodies of {_SHORTEST:g} to {_LONGEST:g} m are expected. "
            f"Coordinates are in metres: pass mesh.{fix}"
        )


@dataclass(eq=False, repr=False)
class Solid(_Key):
    """An elastic body of tetrahedra.

    The energy of a tetrahedron is w V / 2 |F - R|^2. F is the deformation gradient, R its nearest rotation, and w
    Young's modulus at Poisson ratio 0 (Vyatkin and Dolgovesov 2023, where st = w / 2).

    Tetrahedra that are partly empty (`mesh.fill`, from `tetrahedralize`) have mass and stiffness in proportion. The
    stiffness is at least a tenth of the full one (Nesme et al. 2009, for embedded surfaces).

    Args:
        mesh: the rest shape [m]. A `MeshWarning` comes if it is longer than 50 m or shorter than 1 mm; load such files
            with `from_file(..., unit="mm")`.
        youngs: Young's modulus [Pa], a scalar or one value per tetrahedron, positive.
        density: [kg/m^3], a scalar or one value per tetrahedron, positive.
    """

    mesh: TetMesh
    youngs: Array
    density: Array

    @check_arguments("Solid")
    def __init__(self, mesh: TetMesh, youngs: ArrayLike, density: ArrayLike = 1000.0) -> None:
        if not isinstance(mesh, TetMesh):
            raise TypeError(
                f"Solid: mesh must be a TetMesh, got {type(mesh).__name__}; "
                "turn a surface into tetrahedra with torchpd.tetrahedralize(surface, cells=...)"
            )
        _report_size(mesh)
        count = len(mesh.tets)
        _set(
            self,
            mesh=mesh,
            youngs=_per_element("Solid.youngs", youngs, count, unit="Pa"),
            density=_per_element("Solid.density", density, count, unit="kg/m^3"),
        )


@dataclass(eq=False, repr=False)
class Pin(_Key):
    """Holds vertices of a solid at their rest positions, or at the `targets` of a step.

    `Simulator.set_material(pin_hard=...)` releases hard pins, and grasps again.

    Args:
        solid: the body.
        vertices: vertex numbers of that body [P], or a boolean mask over its vertices.
        stiffness: None holds them exactly (hard); a positive number or [P] is a spring k / 2 |x - target|^2 [N/m].
    """

    solid: Solid
    vertices: NDArray[np.int64]
    stiffness: Array | None

    @check_arguments("Pin")
    def __init__(
        self, solid: Solid, vertices: Sequence[int] | NDArray[Any] | torch.Tensor, stiffness: ArrayLike | None = None
    ) -> None:
        if not isinstance(solid, Solid):
            raise TypeError(f"Pin: solid must be a Solid of the scene, got {type(solid).__name__}")
        count = len(solid.mesh.vertices)
        chosen = as_array("Pin.vertices", vertices)
        if chosen.dtype == np.bool_:
            check_shape("Pin.vertices", chosen, (count,), "a mask over the vertices of the body")
            chosen = np.flatnonzero(chosen)
        if chosen.size == 0:
            raise ValueError("Pin.vertices must name at least one vertex, got none")
        if chosen.ndim != 1 or not np.issubdtype(chosen.dtype, np.integer):
            raise ValueError(
                f"Pin.vertices must be integers [P] or a boolean mask [{count}], "
                f"got {chosen.dtype} {list(chosen.shape)}"
            )
        if chosen.min() < 0 or chosen.max() >= count:
            bad = int(chosen[(chosen < 0) | (chosen >= count)][0])
            raise IndexError(f"Pin.vertices must lie in 0..{count - 1} (vertices of the body), got {bad}")
        if len(np.unique(chosen)) != len(chosen):
            numbers, counts = np.unique(chosen, return_counts=True)
            raise ValueError(f"Pin.vertices must name each vertex once, got {int(numbers[counts.argmax()])} twice")
        springs = None
        if stiffness is not None:
            springs = as_array("Pin.stiffness", stiffness, np.float64)
            springs = np.full(len(chosen), float(springs)) if springs.ndim == 0 else springs
            check_shape("Pin.stiffness", springs, (len(chosen),), "a scalar or one value per pinned vertex [N/m]")
            check_finite("Pin.stiffness", springs)
            check_positive("Pin.stiffness", springs, unit="N/m")
            springs.setflags(write=False)
        _set(self, solid=solid, vertices=chosen.astype(np.int64), stiffness=springs)


@dataclass(frozen=True, eq=False, repr=False)
class Gravity(_Part):
    """A uniform acceleration of all bodies.

    Args:
        vector: [3] m/s^2.
    """

    vector: Array

    @check_arguments("Gravity")
    def __init__(self, vector: ArrayLike = (0.0, -9.81, 0.0)) -> None:
        _set(self, vector=check_vector("Gravity.vector", vector))


@dataclass(eq=False, repr=False)
class Ground(_Key):
    """A plane that vertices cannot pass: normal . x >= height, with Coulomb friction.

    Planes act one after another. In the wedge of two planes that are not at right angles, a vertex ends slightly inside
    the earlier one. It ends above it if the wedge is flatter than 45 degrees. Its gradient is that of the edge.

    Args:
        height: of the plane along its normal [m].
        normal: [3], towards the free side; normalised here.
        friction: Coulomb's coefficient, >= 0.
    """

    height: float
    normal: Array
    friction: float

    @check_arguments("Ground")
    def __init__(self, height: float = 0.0, normal: ArrayLike = (0.0, 1.0, 0.0), friction: float = 0.0) -> None:
        direction = check_vector("Ground.normal", normal)
        largest = float(np.abs(direction).max())
        if largest == 0.0:
            raise ValueError("Ground.normal must not be zero, got [0, 0, 0]")
        direction = direction / largest  # so that no length overflows
        direction = direction / np.linalg.norm(direction)
        direction.setflags(write=False)
        _set(
            self,
            height=check_scalar("Ground.height", height),
            normal=direction,
            friction=check_scalar("Ground.friction", friction, minimum=0.0),
        )


@dataclass(eq=False, repr=False)
class Sphere(_Key):
    """A sphere that vertices cannot enter, with Coulomb friction; `targets` of a step may move its centre.

    Friction drags a body along only if the step gets the centre's velocity too: `targets={sphere: [..., 6]}`. `rollout`
    derives it from the centres that a function of the step number gives.

    Args:
        center: [3] m.
        radius: [m], positive.
        friction: Coulomb's coefficient, >= 0.
    """

    center: Array
    radius: float
    friction: float

    @check_arguments("Sphere")
    def __init__(self, center: ArrayLike, radius: float, friction: float = 0.0) -> None:
        size = check_scalar("Sphere.radius", radius)
        if size <= 0.0:
            raise ValueError(f"Sphere.radius must be positive [m], got {size}")
        _set(
            self,
            center=check_vector("Sphere.center", center),
            radius=size,
            friction=check_scalar("Sphere.friction", friction, minimum=0.0),
        )


@dataclass(frozen=True, eq=False, repr=False)
class Damping(_Part):
    """Drag proportional to mass: every velocity decays as dv/dt = -rate v.

    It is implicit: the energy rate m / (2 h) |x - x_t|^2 divides a free motion by 1 + rate h in each step.

    Args:
        rate: [1/s], >= 0.
    """

    rate: float

    @check_arguments("Damping")
    def __init__(self, rate: float) -> None:
        _set(self, rate=check_scalar("Damping.rate", rate, minimum=0.0))
