"""The parts of a scene: frozen descriptions, without work, that `Scene` gathers.

All quantities are in SI units. Numbers, sequences, arrays and tensors are accepted alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from ..common.checks import as_array, check_finite, check_scalar, check_shape, check_vector
from ..common.memory import chunks
from ..common.synonyms import Renamed, check_arguments
from ..common.warn import SceneWarning, warn_user
from ..geometry.mesh_checks import determinants
from ..geometry.mesh_quality import shape_gradients
from ..geometry.tet_mesh import TetMesh
from .averaging import average_over
from .limits import limit_rows
from .part import (
    Array,
    ArrayLike,
    Body,
    Index,
    KeyPart,
    Place,
    ScenePart,
    check_body,
    per_item,
    report_size,
    selected,
    set_fields,
)
from .plastic import Plastic
from .stencils import StencilGroup

__all__ = ["Damping", "Gravity", "Ground", "Pin", "Solid", "Sphere"]

# Contacts and pins act on vertices of partly empty tetrahedra. If these were far softer, they would be squashed flat,
# and a step would have several solutions.
_LEAST_RESISTANCE = 0.1
# Poisson's ratios [low, high) that a solid may have, and above which a step takes many iterations.
_LARGEST_GROUP = 4  # of tetrahedra, see csrc/plan/mesh/elements.h
_LOWEST, _HIGHEST, _SLOW = -1.0, 0.495, 0.45


@dataclass(eq=False, repr=False)
class Solid(Body):
    """An elastic body of tetrahedra.

    Without a Poisson's ratio, the energy of a tetrahedron is w V / 2 |F - R|^2. F is the deformation gradient, R its
    nearest rotation, and w Young's modulus (Vyatkin and Dolgovesov 2023, where st = w / 2).

    With one, it is V (mu |F - R|^2 + lambda t^2 / 2), t = tr(R^T F) - 3 and Lame's constants mu and lambda: the
    "corotated" linear law. Where lambda t > 2 mu, the pressure stays at 2 mu, so that a step cannot diverge. Linear
    tetrahedra are too stiff near nu = 1/2; groups of them share the mean of t, weighted by V lambda.

    The law "volume" is V (mu |F - R|^2 + 3 lambda / 2 dist^2(F, {det F = 1})), with the volume constraint of Bouaziz
    et al. (2014). It has the same linear elasticity, and keeps its volume at large strains, where the corotated law
    loses it. An iteration costs more, and single tetrahedra are too stiff near nu = 1/2.

    Tetrahedra that are partly empty (`mesh.fill`, from `tetrahedralize`) have mass and stiffness in proportion. The
    stiffness is at least a tenth of the full one (Nesme et al. 2009, for embedded surfaces).

    Args:
        mesh: the rest shape [m]. A `MeshWarning` comes if it is longer than 50 m or shorter than 1 mm; load such files
            with `from_file(..., unit="mm")`.
        youngs: Young's modulus [Pa], a scalar or one value per tetrahedron, positive.
        density: [kg/m^3], a scalar or one value per tetrahedron, positive.
        poisson: Poisson's ratio, a scalar or one value per tetrahedron, above -1 and below 0.495. Above 0.45 a step
            needs many iterations, and a `SceneWarning` says so. The scalar 0 compiles lambda away.
        averaging: tetrahedra that share the mean of t: 1, 2 or 4 at most, or the number of a group for each
            tetrahedron [E]. None: 2 for the lattice of `tetrahedralize`, which hardly locks, and 4 otherwise. Groups
            of 2 and 4 share faces and have similar bulk moduli. On a GPU a group must be one or two pairs with a common
            face each, as these are, or one tetrahedron more. The law "volume" averages nothing.
        law: "corotated" or "volume". "volume" takes a positive Poisson's ratio.
        strain_limit: least and largest stretch (lo, hi), or one pair per tetrahedron [E, 2], lo <= 1 <= hi; None: no
            limit. Beyond them V k / 2 dist^2(F, {stretches in [lo, hi], det F > 0}) adds to the energy.
        limit_stiffness: k [Pa], a scalar or one value per tetrahedron. None: 30 times Young's modulus. It is a
            stiffness, not a clamp: 10 to 100 times Young's modulus hold most of an excess.
        stiffness_damping: beta [s], a scalar or one value per tetrahedron: Rayleigh damping by the stiffness, in the
            frame of the material. The axial stress of a step is 2 mu beta (s - s_t) / h beside the elastic one. A rigid
            rotation feels none. It acts by mu alone, also with a Poisson's ratio.
        plastic: how the solid flows, see `Plastic`; None: it is elastic. It takes law="corotated", averages nothing,
            and has no stiffness_damping. Its state is a `HistoryState`; its modulus `plastic_youngs`.

    Example:
        >>> rubber = Solid(mesh, youngs=1e6, poisson=0.4, density=1100.0)
    """

    mesh: TetMesh
    youngs: Array
    density: Array
    poisson: Array | float  # [E], or 0.0
    averaging: int | Index | None
    law: Literal["corotated", "volume"]
    strain_limit: Array | None  # [E, 2]
    limit_stiffness: Array | None  # [E]
    stiffness_damping: Array | float  # [E], or 0.0
    plastic: Plastic | None

    @check_arguments("Solid")
    def __init__(
        self,
        mesh: TetMesh,
        youngs: ArrayLike,
        density: ArrayLike = 1000.0,
        *,
        poisson: ArrayLike = 0.0,
        averaging: int | Sequence[int] | NDArray[Any] | torch.Tensor | None = None,
        law: Literal["corotated", "volume"] = "corotated",
        strain_limit: Any = None,
        limit_stiffness: ArrayLike | None = None,
        stiffness_damping: ArrayLike = 0.0,
        plastic: Plastic | None = None,
    ) -> None:
        if not isinstance(mesh, TetMesh):
            raise TypeError(
                f"Solid: mesh must be a TetMesh, got {type(mesh).__name__}; "
                "turn a surface into tetrahedra with torchpd.tetrahedralize(surface, cells=...)"
            )
        report_size("Solid", "mesh", mesh.vertices, mesh.tets)
        count = len(mesh.tets)
        modulus = per_item("Solid.youngs", youngs, count, of="tetrahedron", unit="Pa")
        limits = limit_rows("Solid", strain_limit, limit_stiffness, modulus, of="tetrahedron", unit="Pa")
        set_fields(
            self,
            mesh=mesh,
            youngs=modulus,
            density=per_item("Solid.density", density, count, of="tetrahedron", unit="kg/m^3"),
            poisson=_poisson(poisson, count),
            averaging=_averaging(averaging, count),
            law=_law(law, poisson),
            strain_limit=None if limits is None else limits[:, :2],
            limit_stiffness=None if limits is None else limits[:, 2],
            stiffness_damping=_stiffness_damping(stiffness_damping, count),
            plastic=plastic,
        )
        if plastic is not None:
            self._check_plastic(plastic)

    def _check_plastic(self, plastic: Plastic) -> None:
        if not isinstance(plastic, Plastic):
            raise TypeError(f"Solid.plastic must be a Plastic or None, got {type(plastic).__name__}")
        plastic.rows(len(self.mesh.tets))
        alone = self.averaging is None or np.array_equal(self.averaging, 1)
        refused = {
            'law must be "corotated"': (self.law, self.law != "corotated"),
            "averaging must be 1 or None": (self.averaging, not alone),
            "stiffness_damping must be 0": ("another", not isinstance(self.stiffness_damping, float)),
        }
        for contract, (given, broken) in refused.items():
            if broken:
                raise ValueError(
                    f"Solid.{contract} beside plastic, whose elements have a law of their own, got {given!r}"
                )

    @property
    def elements(self) -> Index:
        return self.mesh.tets

    @property
    def stiffness(self) -> Array:
        """Young's modulus times fill [E] Pa, with a fill of at least 0.1."""
        return self._filled(self.youngs, _LEAST_RESISTANCE)

    def stencils(self, place: Place) -> tuple[StencilGroup, ...]:
        is_damped = not isinstance(self.stiffness_damping, float)
        if self.strain_limit is None and self.law != "volume" and not is_damped and self.plastic is None:
            return ()
        corners, tets = self.mesh.tets + place(self), np.arange(len(self.mesh.tets), dtype=np.int64)
        gradients, volumes = shape_gradients(self.mesh.vertices, self.mesh.tets)
        groups = []
        if self.strain_limit is not None and self.limit_stiffness is not None:
            stiffness = self._filled(self.limit_stiffness, _LEAST_RESISTANCE)
            rows = np.concatenate([self.strain_limit, stiffness[:, None]], axis=1)
            groups.append(StencilGroup.of("solid_limit", corners, gradients, volumes, solid_limit=rows))
        if self.law == "volume":
            groups.append(StencilGroup.of("volume", corners, gradients, volumes, tets=tets))
        if is_damped:
            groups.append(StencilGroup.of("damper", corners, gradients, volumes, tets=tets))
        if self.plastic is not None:
            rows_of = {"plastic_youngs": self.stiffness, "plastic_poisson": np.broadcast_to(self.poisson, len(tets))}
            rows_of |= self.plastic.rows(len(tets))
            groups.append(StencilGroup.of("plastic", corners, gradients, volumes, **rows_of))
        return tuple(groups)

    @property
    def filled_density(self) -> Array:
        """Density times fill [E] kg/m^3."""
        return self._filled(self.density, 0.0)

    def masses(self) -> Array:
        masses, density = np.zeros(len(self.mesh.vertices)), self.filled_density
        for some in chunks(len(density)):
            tets = self.mesh.tets[some]
            np.add.at(masses, tets, (density[some] * determinants(self.mesh.vertices, tets) / 24.0)[:, None])
        return masses

    @cached_property
    def averaging_groups(self) -> Index:
        """Numbers of the groups that share the mean of t [E], from 0."""
        if isinstance(self.averaging, np.ndarray):
            return np.unique(self.averaging, return_inverse=True)[1].astype(np.int64).reshape(-1)
        return average_over(self.mesh, self.stiffness / (3.0 * (1.0 - 2.0 * self.poisson)), self.averaging)

    def _filled(self, values: Array, least: float) -> Array:
        return values if self.mesh.fill is None else values * np.maximum(self.mesh.fill, least)


def _poisson(value: ArrayLike, count: int) -> Array | float:
    name = "Solid.poisson"
    array = as_array(name, value, np.float64)
    if array.ndim == 0 and float(array) == 0.0:
        return 0.0
    array = np.full(count, float(array)) if array.ndim == 0 else array
    check_shape(name, array, (count,), "one value per tetrahedron or a scalar")
    check_finite(name, array)
    bad = np.flatnonzero(~((array > _LOWEST) & (array < _HIGHEST)))
    if bad.size:
        raise ValueError(
            f"{name} must lie above {_LOWEST:g} and below {_HIGHEST:g}, got {array[bad[0]]} at {int(bad[0])} "
            f"({bad.size} in all); take 0.45 for what hardly changes its volume"
        )
    if array.max() > _SLOW:
        warn_user(
            f"{name} is {array.max():g}: above {_SLOW:g} a step needs several times as many iterations. Take "
            f"{_SLOW:g}, which changes volumes by a little more, or check the error of your steps",
            SceneWarning,
        )
    return array


def _stiffness_damping(value: ArrayLike, count: int) -> Array | float:
    array = per_item("Solid.stiffness_damping", value, count, of="tetrahedron", unit="s", zero=True)
    return array if array.any() else 0.0


def _law(value: Any, poisson: ArrayLike) -> Literal["corotated", "volume"]:
    if value not in ("corotated", "volume"):
        raise ValueError(f'Solid.law must be "corotated" or "volume", got {value!r}')
    least = np.min(as_array("Solid.poisson", poisson, np.float64))
    if value == "volume" and not least > 0.0:
        raise ValueError(
            f'Solid.poisson must be positive for law="volume", whose volume energy is proportional to lambda, got '
            f'{least:g}; take law="corotated"'
        )
    return "volume" if value == "volume" else "corotated"


def _averaging(value: Any, count: int) -> int | Index | None:
    name = "Solid.averaging"
    if value is None:
        return None
    array = as_array(name, value)
    if array.dtype.kind not in "iu" or (array.ndim == 0 and int(array) not in (1, 2, 4)):
        raise ValueError(f"{name} must be 1, 2, 4 or whole numbers of groups [{count}], got {value!r}")
    if array.ndim == 0:
        return int(array)
    check_shape(name, array, (count,), "the number of a group for each tetrahedron")
    numbers, sizes = np.unique(array, return_counts=True)
    if sizes.max() > _LARGEST_GROUP:
        raise ValueError(
            f"{name} must have up to {_LARGEST_GROUP} tetrahedra in a group, got {sizes.max()} in group "
            f"{numbers[sizes.argmax()]}; divide it"
        )
    return array.astype(np.int64)


@dataclass(eq=False, repr=False)
class Pin(KeyPart):
    """Holds vertices of a body at their rest positions, or at the `targets` of a step.

    `Simulator.set_material(pin_hard=...)` releases hard pins, and grasps again.

    Args:
        body: the body: a `Solid`, `Cloth` or `Rod`.
        vertices: vertex numbers of that body [P], or a boolean mask over its vertices.
        stiffness: None holds them exactly (hard); a positive number or [P] is a spring k / 2 |x - target|^2 [N/m].
    """

    body: Body
    vertices: Index
    stiffness: Array | None

    solid = Renamed("body")

    @check_arguments("Pin", renamed={"solid": "body"})
    def __init__(
        self, body: Body, vertices: Sequence[int] | NDArray[Any] | torch.Tensor, stiffness: ArrayLike | None = None
    ) -> None:
        check_body("Pin.body", body)
        chosen = selected("Pin.vertices", vertices, len(body.mesh.vertices), of="body")
        springs = None
        if stiffness is not None:
            springs = per_item("Pin.stiffness", stiffness, len(chosen), of="pinned vertex", unit="N/m")
        set_fields(self, body=body, vertices=chosen, stiffness=springs)

    def bodies_used(self) -> tuple[Body, ...]:
        return (self.body,)


@dataclass(frozen=True, eq=False, repr=False)
class Gravity(ScenePart):
    """A uniform acceleration of all bodies.

    Args:
        vector: [3] m/s^2.
    """

    vector: Array

    @check_arguments("Gravity")
    def __init__(self, vector: ArrayLike = (0.0, -9.81, 0.0)) -> None:
        set_fields(self, vector=check_vector("Gravity.vector", vector))


@dataclass(eq=False, repr=False)
class Ground(KeyPart):
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
        set_fields(
            self,
            height=check_scalar("Ground.height", height),
            normal=direction,
            friction=check_scalar("Ground.friction", friction, minimum=0.0),
        )


@dataclass(eq=False, repr=False)
class Sphere(KeyPart):
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
        set_fields(
            self,
            center=check_vector("Sphere.center", center),
            radius=size,
            friction=check_scalar("Sphere.friction", friction, minimum=0.0),
        )


@dataclass(frozen=True, eq=False, repr=False)
class Damping(ScenePart):
    """Drag proportional to mass: every velocity decays as dv/dt = -rate v.

    It is implicit: the energy rate m / (2 h) |x - x_t|^2 divides a free motion by 1 + rate h in each step.

    Args:
        rate: [1/s], >= 0.
    """

    rate: float

    @check_arguments("Damping")
    def __init__(self, rate: float) -> None:
        set_fields(self, rate=check_scalar("Damping.rate", rate, minimum=0.0))
