"""A scene of bodies and effects, and its flat arrays in the user's order."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.synonyms import check_arguments
from ..geometry.mesh_faces import mesh_components
from .averaging import check_signs
from .cloth import Cloth
from .contact import Collider, Contact, ContactValues, contact_values
from .effects import Damping, Gravity, Ground, Pin, Solid, Sphere
from .fibres import Fibres
from .loads import Pressure, Wind
from .part import Body
from .pins import PinnedComponents
from .rod import Rod
from .springs import Springs
from .stencils import StencilGroup, merge_groups
from .tie import Tie

__all__ = ["Part", "Scene", "SceneValues"]

Part = (
    Solid | Cloth | Rod | Springs | Tie | Fibres | Pin | Pressure | Wind | Gravity | Ground | Sphere | Damping
    | Contact | Collider
)  # fmt: skip
Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class SceneValues:
    """Flat float64 arrays of a scene in the user's order, bodies one after another."""

    rest_positions: Array  # [V, 3] m
    tets: Index  # [E, 4], of all solids but plastic ones, as in the arrays of tetrahedra below
    stiffness: Array  # [E] Young's modulus times fill, Pa, with a fill of at least 0.1
    density: Array  # [E] density times fill, kg/m^3
    masses: Array  # [V] kg, lumped: density * volume / 4 to each corner of a tetrahedron, a third to one of a triangle
    pin_vertices: Index  # [P]
    pin_stiffness: Array  # [P] N/m, inf where the pin is hard
    pin_targets: Array  # [P, 3] m
    gravity: Array  # [3] m/s^2
    planes: Array  # [C, 5] unit normal, height, friction
    spheres: Array  # [S, 5] center, radius, friction
    damping: float  # 1/s
    component: Index  # [V] number of the connected component of each vertex; springs and ties join those of bodies
    pinned: PinnedComponents  # pinned points of the components
    loose: NDArray[np.bool_]  # [components] whether hard pins leave a component rigid motions
    stencils: tuple[StencilGroup, ...] = ()  # at most one group per kind, in the order of `stencils.KINDS`
    poisson: Array | None = None  # [E] Poisson's ratio, None where every solid has the scalar 0
    tet_group: Index | None = None  # [E] groups that share a volume strain, -1: none; None without `poisson`
    stiffness_damping: Array | None = None  # [E] s, None where no solid has any
    pressure: Array | None = None  # [pressures] Pa, None without any
    wind: Array | None = None  # [3] m/s, None without
    contact: ContactValues | None = None  # None without `Contact`

    @cached_property
    def solid(self) -> NDArray[np.bool_]:
        """Whether all vertices of each component [components] are corners of tetrahedra."""
        inside = np.zeros(len(self.component), np.bool_)
        inside[self.tets] = True
        for group in self.stencils:
            if group.gradients.shape[2] == 3:  # F maps space
                inside[group.corners] = True
        solid = np.ones(len(self.loose), np.bool_)
        solid[self.component[~inside]] = False
        return solid


def _no_part(part: object) -> TypeError:
    fix = "; pass them one by one, Scene(*parts)" if isinstance(part, (list, tuple)) else ""
    return TypeError(f"Scene: parts are bodies and effects of torchpd, got {type(part).__name__}{fix}")


def _joined(component: Index, stencils: Iterable[StencilGroup]) -> Index:
    """Components that springs and ties join count as one: only their common rigid motions change no elastic energy."""
    ends = [np.stack(np.broadcast_arrays(of[:, :1], of[:, 1:]), axis=-1).reshape(-1, 2) for of in (
        component[group.corners] for group in stencils
    )]  # fmt: skip
    pairs = np.concatenate([np.stack([component, component], axis=1), *ends])
    if not (pairs[:, 0] != pairs[:, 1]).any():
        return component
    whole = mesh_components(pairs)[component]
    _, first, number = np.unique(whole, return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[number], dtype=np.int64)


class Scene:
    """Bodies and effects, in any order; `Simulator` compiles them.

    Bodies share gravity, grounds and spheres, but pass through each other and themselves without `Contact`. A
    `Simulator` gives a `SceneWarning` if they overlap at rest, and once if they overlap after a step with
    `return_info=True`.

    Args:
        parts: bodies (`Solid`, `Cloth`, `Rod`), what acts on them (`Pin`, `Springs`, `Tie`, `Fibres`, `Pressure`), and
            `Gravity`, `Wind`, `Ground`, `Sphere`, `Damping`, `Contact` with its `Collider`s. At least one body; at most
            one `Gravity`, `Wind`, `Damping` and `Contact`. A part acts on bodies of this scene; no vertex is pinned
            twice.
    """

    @check_arguments("Scene")
    def __init__(self, *parts: Part) -> None:
        for part in parts:
            if not isinstance(part, Part):
                raise _no_part(part)
        self.parts: tuple[Part, ...] = parts
        if not self.bodies:
            raise ValueError("Scene needs at least one body, got none; add Solid(mesh, youngs=1e5, density=1000.0)")
        if len({id(part) for part in parts}) != len(parts):
            twice = next(part for number, part in enumerate(parts) if any(part is one for one in parts[:number]))
            raise ValueError(f"Scene: each part must be given once, got the same {type(twice).__name__} twice")
        for kind in (Gravity, Damping, Wind, Contact):
            if len(self._all(kind)) > 1:
                raise ValueError(f"Scene takes at most one {kind.__name__}, got {len(self._all(kind))}")
        if self.wind is not None and all(isinstance(body, Rod) for body in self.bodies):
            raise ValueError("Scene: Wind acts on a Cloth or a Solid, got rods alone, which do not feel it")
        bodies = {id(body) for body in (*self.bodies, *self.colliders)}
        for part in parts:
            if any(id(body) not in bodies for body in part.bodies_used()):
                words = f"the body of a {type(part).__name__} must be a part of this scene"
                raise ValueError(f"Scene: {words}, got another one; pass both")
        self._check_contact()
        numbers, counts = np.unique(self._pinned(), return_counts=True)
        if (counts > 1).any():
            raise ValueError(f"Scene: pins must hold different vertices, got two at {int(numbers[counts.argmax()])}")

    def _check_contact(self) -> None:
        """Refuse colliders that touch nothing, and bodies that cannot take part in the contact of all."""
        named = () if self.contact is None else self.contact.bodies
        if self.contact is not None and not named:
            self.contact.check_members((*self.bodies, *self.colliders))
            return
        outside = sum(all(collider is not one for one in named) for collider in self.colliders)
        if outside:
            came = "none" if self.contact is None else f"{outside} that it does not name"
            fix = "add Contact()" if self.contact is None else "name them too"
            raise ValueError(f"Scene: a Collider acts by a Contact of this scene, got {came}; {fix}")

    def __deepcopy__(self, memo: dict[int, Any]) -> Scene:
        """The scene itself, so that a copied simulator knows the same parts."""
        return self

    def _pinned(self) -> Index:
        """Numbers of the pinned vertices among those of all bodies [P]."""
        pinned = [self.vertex_range(pin.body).start + pin.vertices for pin in self.pins]
        return np.concatenate([np.zeros(0, dtype=np.int64), *pinned])

    def _all(self, kind: type) -> tuple[Any, ...]:
        return tuple(part for part in self.parts if isinstance(part, kind))

    @property
    def bodies(self) -> tuple[Body, ...]:
        """All parts with vertices, in the order in which they were given, which is that of the vertices."""
        return self._all(Body)

    @property
    def solids(self) -> tuple[Solid, ...]:
        return self._all(Solid)

    @property
    def elastic_solids(self) -> tuple[Solid, ...]:
        """The solids whose tetrahedra have rows in arrays like `stiffness`: all but plastic ones."""
        return tuple(solid for solid in self.solids if solid.plastic is None)

    @property
    def rest_positions(self) -> Array:
        """Rest positions of all bodies [V, 3] m."""
        return np.concatenate([body.mesh.vertices for body in self.bodies])

    @property
    def tets(self) -> Index:
        """Corners of the tetrahedra of all solids [E, 4], numbered over the vertices of all bodies."""
        return self._tets_of(self.solids)

    def _tets_of(self, solids: Iterable[Solid]) -> Index:
        own = [solid.mesh.tets + self.vertex_range(solid).start for solid in solids]
        return own[0] if len(own) == 1 else np.concatenate([np.zeros((0, 4), dtype=np.int64), *own])

    @property
    def pins(self) -> tuple[Pin, ...]:
        return self._all(Pin)

    @property
    def fibres(self) -> tuple[Fibres, ...]:
        return self._all(Fibres)

    @property
    def pressures(self) -> tuple[Pressure, ...]:
        return self._all(Pressure)

    @property
    def wind(self) -> Wind | None:
        return next(iter(self._all(Wind)), None)

    @property
    def grounds(self) -> tuple[Ground, ...]:
        return self._all(Ground)

    @property
    def spheres(self) -> tuple[Sphere, ...]:
        return self._all(Sphere)

    @property
    def contact(self) -> Contact | None:
        return next(iter(self._all(Contact)), None)

    @property
    def colliders(self) -> tuple[Collider, ...]:
        return self._all(Collider)

    def vertex_range(self, body: Body) -> slice:
        """Slice of a body's vertices in positions [B, V, 3]."""
        start = 0
        for other in self.bodies:
            if other is body:
                return slice(start, start + len(other.mesh.vertices))
            start += len(other.mesh.vertices)
        raise ValueError("Scene.vertex_range: body must be a part of the scene, got another one")

    def stencil_ranges(self, part: Part) -> dict[str, slice]:
        """Slices of a part's stencils in the groups of `values().stencils`, by kind."""
        counts: dict[str, int] = {}
        for other in self.parts:
            before = dict(counts)
            for group in other.stencils(lambda body: 0):
                counts[group.kind] = counts.get(group.kind, 0) + len(group)
            if other is part:
                kinds = [kind for kind in counts if counts[kind] > before.get(kind, 0)]
                return {kind: slice(before.get(kind, 0), counts[kind]) for kind in kinds}
        raise ValueError("Scene.stencil_ranges: part must be a part of the scene, got another one")

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
        starts = {id(body): self.vertex_range(body).start for body in self.bodies}
        positions = self.rest_positions
        pin_vertices = self._pinned()
        springs = [np.full(len(p.vertices), np.inf) if p.stiffness is None else p.stiffness for p in self.pins]
        stiffness = np.concatenate([np.zeros(0), *springs])
        stencils = merge_groups(self._stencils(starts))
        component = _joined(self._components, stencils)
        pinned = PinnedComponents.of(positions, self._masses, component, pin_vertices)
        gravity, damping = self._all(Gravity), self._all(Damping)
        none = np.zeros(0)
        poisson, tet_group = self._poisson()
        return SceneValues(
            rest_positions=positions,
            tets=self._tets_of(self.elastic_solids),
            stiffness=np.concatenate([none, *(solid.stiffness for solid in self.elastic_solids)]),
            density=np.concatenate([none, *(solid.filled_density for solid in self.elastic_solids)]),
            masses=self._masses,
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
            stencils=stencils,
            poisson=poisson,
            tet_group=tet_group,
            stiffness_damping=self._stiffness_damping(),
            pressure=np.array([part.pascals for part in self.pressures]) if self.pressures else None,
            wind=None if self.wind is None else self.wind.velocity,
            contact=self.contact_values,
        )

    def _stencils(self, starts: dict[int, int]) -> Iterator[StencilGroup]:
        """Stencils of all parts, by vertices and tetrahedra of the scene."""
        tets = 0
        for part in self.parts:
            for group in part.stencils(lambda body: starts[id(body)]):
                yield group if group.tets is None else replace(group, tets=group.tets + tets)
            tets += len(part.mesh.tets) if isinstance(part, Solid) and part.plastic is None else 0

    @cached_property
    def _masses(self) -> Array:
        """Lumped masses of the vertices of all bodies [V] kg."""
        masses = np.concatenate([body.masses() for body in self.bodies])
        masses.setflags(write=False)
        return masses

    @cached_property
    def contact_values(self) -> ContactValues | None:
        """Flat arrays of contact, None without."""
        return None if self.contact is None else contact_values(self.contact, self.bodies, self.colliders)

    @cached_property
    def _components(self) -> Index:
        """Number of the connected component of each vertex within its body [V]."""
        parts, count = [], 0
        for body in self.bodies:
            parts.append(mesh_components(body.elements) + count)
            count = int(parts[-1].max()) + 1
        components = np.concatenate(parts)
        components.setflags(write=False)
        return components

    def _poisson(self) -> tuple[Array | None, Index | None]:
        """Poisson's ratios of all tetrahedra and their groups, or None if every solid has the scalar 0."""
        if all(isinstance(solid.poisson, float) for solid in self.elastic_solids):
            return None, None
        ratios = [np.broadcast_to(solid.poisson, len(solid.mesh.tets)) for solid in self.elastic_solids]
        poisson, group = np.concatenate(ratios), self.averaging_groups
        check_signs("Solid.poisson", poisson, group)
        return poisson, group

    @property
    def averaging_groups(self) -> Index:
        """Numbers of the groups of tetrahedra that share the mean of their volume strain [E]."""
        groups, count = [np.zeros(0, dtype=np.int64)], 0
        for solid in self.elastic_solids:
            if solid.law == "volume":  # a kind of its own has their volume energy
                groups.append(np.full(len(solid.mesh.tets), -1))
                continue
            groups.append(solid.averaging_groups + count)
            count = int(groups[-1].max()) + 1
        return np.concatenate(groups)

    @property
    def damped_tets(self) -> NDArray[np.bool_]:
        """Whether the solid of each tetrahedron has stiffness-proportional damping [E]."""
        solids = self.elastic_solids
        return np.repeat(
            [not isinstance(solid.stiffness_damping, float) for solid in solids],
            [len(solid.mesh.tets) for solid in solids],
        )

    def _stiffness_damping(self) -> Array | None:
        """Coefficients of all tetrahedra [E] s, or None without damping."""
        if all(isinstance(solid.stiffness_damping, float) for solid in self.elastic_solids):
            return None
        return np.concatenate([np.broadcast_to(s.stiffness_damping, len(s.mesh.tets)) for s in self.elastic_solids])

    def __repr__(self) -> str:
        return f"Scene({', '.join(type(part).__name__ for part in self.parts)})"
