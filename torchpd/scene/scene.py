"""A scene of bodies and effects, and its flat arrays in the user's order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.synonyms import check_arguments
from ..geometry.mesh_faces import mesh_components
from .effects import Damping, Gravity, Ground, Pin, Solid, Sphere
from .pins import PinnedComponents

__all__ = ["Part", "Scene", "SceneValues"]

Part = Solid | Pin | Gravity | Ground | Sphere | Damping
Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class SceneValues:
    """Flat float64 arrays of a scene in the user's order, bodies one after another."""

    rest_positions: Array  # [V, 3] m
    tets: Index  # [E, 4]
    stiffness: Array  # [E] Young's modulus times fill, Pa, with a fill of at least 0.1
    density: Array  # [E] density times fill, kg/m^3
    masses: Array  # [V] kg, lumped: density * volume / 4 to each corner
    pin_vertices: Index  # [P]
    pin_stiffness: Array  # [P] N/m, inf where the pin is hard
    pin_targets: Array  # [P, 3] m
    gravity: Array  # [3] m/s^2
    planes: Array  # [C, 5] unit normal, height, friction
    spheres: Array  # [S, 5] center, radius, friction
    damping: float  # 1/s
    component: Index  # [V] number of the connected component of each vertex
    pinned: PinnedComponents  # pinned points of the components
    loose: NDArray[np.bool_]  # [components] whether hard pins leave a component rigid motions


# Contacts and pins act on vertices of partly empty tetrahedra. If these were far softer, they would be squashed flat,
# and a step would have several solutions.
_LEAST_RESISTANCE = 0.1


def _filled(solid: Solid, values: Array, least: float = 0.0) -> Array:
    """Values per tetrahedron, multiplied by the fill, or by `least` if that is more."""
    return values if solid.mesh.fill is None else values * np.maximum(solid.mesh.fill, least)


def _lumped_masses(positions: Array, tets: Index, density: Array) -> Array:
    corners = positions[tets]
    edges = corners[:, 1:] - corners[:, :1]
    share = density * np.linalg.det(edges) / 24.0
    masses = np.bincount(tets.reshape(-1), weights=np.repeat(share, 4), minlength=len(positions))
    return masses.astype(np.float64, copy=False)


def _no_part(part: object) -> TypeError:
    fix = "; pass them one by one, Scene(*parts)" if isinstance(part, (list, tuple)) else ""
    return TypeError(f"Scene: parts are bodies and effects of torchpd, got {type(part).__name__}{fix}")


class Scene:
    """Bodies and effects, in any order; `Simulator` compiles them.

    Bodies share gravity, grounds and spheres, but pass through each other and themselves. A `Simulator` gives a
    `SceneWarning` if they overlap at rest, and once if they overlap after a step with `return_info=True`.

    Args:
        parts: `Solid`, `Pin`, `Gravity`, `Ground`, `Sphere`, `Damping`. At least one `Solid`; at most one `Gravity` and
            one `Damping`. A `Pin` holds a `Solid` of this scene; no vertex is pinned twice.
    """

    @check_arguments("Scene")
    def __init__(self, *parts: Part) -> None:
        for part in parts:
            if not isinstance(part, Part):
                raise _no_part(part)
        self.parts: tuple[Part, ...] = parts
        if not self.solids:
            raise ValueError("Scene needs at least one body, got none; add Solid(mesh, youngs=1e5, density=1000.0)")
        if len({id(part) for part in parts}) != len(parts):
            twice = next(part for number, part in enumerate(parts) if any(part is one for one in parts[:number]))
            raise ValueError(f"Scene: each part must be given once, got the same {type(twice).__name__} twice")
        for kind in (Gravity, Damping):
            if len(self._all(kind)) > 1:
                raise ValueError(f"Scene takes at most one {kind.__name__}, got {len(self._all(kind))}")
        solids = {id(solid) for solid in self.solids}
        for pin in self.pins:
            if id(pin.solid) not in solids:
                raise ValueError("Scene: the solid of a Pin must be a part of this scene, got another one; pass both")
        numbers, counts = np.unique(self._pinned(), return_counts=True)
        if (counts > 1).any():
            raise ValueError(f"Scene: pins must hold different vertices, got two at {int(numbers[counts.argmax()])}")

    def __deepcopy__(self, memo: dict[int, Any]) -> Scene:
        """The scene itself, so that a copied simulator knows the same parts."""
        return self

    def _pinned(self) -> Index:
        """Numbers of the pinned vertices among those of all bodies [P]."""
        pinned = [self.vertex_range(pin.solid).start + pin.vertices for pin in self.pins]
        return np.concatenate([np.zeros(0, dtype=np.int64), *pinned])

    def _all(self, kind: type) -> tuple[Any, ...]:
        return tuple(part for part in self.parts if isinstance(part, kind))

    @property
    def solids(self) -> tuple[Solid, ...]:
        return self._all(Solid)

    @property
    def pins(self) -> tuple[Pin, ...]:
        return self._all(Pin)

    @property
    def grounds(self) -> tuple[Ground, ...]:
        return self._all(Ground)

    @property
    def spheres(self) -> tuple[Sphere, ...]:
        return self._all(Sphere)

    def vertex_range(self, solid: Solid) -> slice:
        """Slice of a body's vertices in positions [B, V, 3]."""
        start = 0
        for other in self.solids:
            if other is solid:
                return slice(start, start + len(other.mesh.vertices))
            start += len(other.mesh.vertices)
        raise ValueError("Scene.vertex_range: solid must be a part of the scene, got another one")

    def pin_range(self, pin: Pin) -> slice:
        """Slice of a pin's targets in pin_targets [P, 3]."""
        start = 0
        for other in self.pins:
            if other is pin:
                return slice(start, start + len(other.vertices))
            start += len(other.vertices)
        raise ValueError("Scene.pin_range: pin must be a part of the scene, got another one")

    def values(self) -> SceneValues:
        """The flat arrays of the scene, in the user's order."""
        positions = np.concatenate([solid.mesh.vertices for solid in self.solids])
        starts = [self.vertex_range(solid).start for solid in self.solids]
        tets = np.concatenate([s.mesh.tets + start for s, start in zip(self.solids, starts, strict=True)])
        density = np.concatenate([_filled(solid, solid.density) for solid in self.solids])
        pin_vertices = self._pinned()
        springs = [np.full(len(p.vertices), np.inf) if p.stiffness is None else p.stiffness for p in self.pins]
        stiffness = np.concatenate([np.zeros(0), *springs])
        masses, component = _lumped_masses(positions, tets, density), mesh_components(tets)
        pinned = PinnedComponents.of(positions, masses, component, pin_vertices)
        gravity, damping = self._all(Gravity), self._all(Damping)
        return SceneValues(
            rest_positions=positions,
            tets=tets,
            stiffness=np.concatenate([_filled(solid, solid.youngs, _LEAST_RESISTANCE) for solid in self.solids]),
            density=density,
            masses=masses,
            pin_vertices=pin_vertices,
            pin_stiffness=stiffness,
            pin_targets=positions[pin_vertices],
            gravity=gravity[0].vector if gravity else np.zeros(3),
            planes=np.array([[*g.normal, g.height, g.friction] for g in self.grounds]).reshape(-1, 5),
            spheres=np.array([[*s.center, s.radius, s.friction] for s in self.spheres]).reshape(-1, 5),
            damping=damping[0].rate if damping else 0.0,
            component=component,
            pinned=pinned,
            loose=pinned.loose(np.isinf(stiffness)),
        )

    def __repr__(self) -> str:
        return f"Scene({', '.join(type(part).__name__ for part in self.parts)})"
