"""Contact of bodies with each other, with themselves, and with rigid surfaces."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..common.checks import as_array, check_finite, check_scalar, check_shape, check_whole
from ..common.synonyms import check_arguments
from ..geometry.tet_mesh import TetMesh
from ..geometry.tri_mesh import TriMesh
from .effects import Ground, Sphere
from .part import ArrayLike, Body, KeyPart, set_fields, unit_vectors
from .rigid import RigidMass, rigid_mass
from .rod import Polyline

__all__ = ["Collider", "Contact", "ContactValues", "can_touch", "contact_values", "placed"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

_STILL = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


@dataclass(eq=False, repr=False)
class Collider(KeyPart):
    """A rigid surface of triangles, for `Contact`: moved by hand, or with `mass` by forces.

    Both sides of a triangle keep bodies away, so the surface may be open. Steps take `targets={collider: pose}`, a pose
    [7] or [B, 7] at their end; without one the collider stays. Colliders without a mass do not touch each other.

    With a mass the collider moves by gravity, contact and an applied wrench: steps take `targets={collider: wrench}`
    [6] or [B, 6], force [N] and torque [N m] about its origin, in world axes; without one it is zero. Its velocity is
    `state.history.motion`. `Ground` and `Sphere` do not act on it: docs/contact.md#colliders-with-a-mass.

    Args:
        mesh: a `TriMesh`, or a `TetMesh` whose boundary is taken, with coordinates [m] about the origin of the pose.
        friction: Coulomb's coefficient, >= 0; None: that of the other side, see `Contact`.
        pose: at the start, (x, y, z, qw, qx, qy, qz): the origin in the world [m], and a quaternion, normalised here.
            None: where the mesh is.
        mass: positive [kg]; None: it moves by hand.
        inertia: with a mass, about its centre of mass in the axes of the mesh [kg m^2]: [3, 3], or three moments about
            the axes. None: that of a uniform body inside a closed surface. The centre is that of the enclosed volume,
            or of the area of an open surface.

    Example:
        >>> finger = Collider(torchpd.shapes.box((0.02, 0.1, 0.02), (1, 5, 1)), friction=0.8)
    """

    mesh: TriMesh
    friction: float | None
    pose: Array  # [7]
    mass: float | None
    inertia: Array | None  # [3, 3]

    @check_arguments("Collider")
    def __init__(
        self,
        mesh: TriMesh | TetMesh,
        *,
        friction: float | None = None,
        pose: ArrayLike | None = None,
        mass: float | None = None,
        inertia: ArrayLike | None = None,
    ) -> None:
        if not isinstance(mesh, TriMesh | TetMesh):
            raise TypeError(
                f"Collider: mesh must be a TriMesh or a TetMesh, got {type(mesh).__name__}; "
                "make one by torchpd.TriMesh(vertices, triangles) or TriMesh.from_file(path)"
            )
        if isinstance(mesh, TetMesh):
            kept, numbers = np.unique(mesh.boundary(), return_inverse=True)
            mesh = TriMesh(mesh.vertices[kept], numbers.reshape(-1, 3))
        if mass is None and inertia is not None:
            raise ValueError("Collider.inertia must come with a mass, got mass=None; give mass= in kg, or leave it out")
        rigid = None if mass is None else rigid_mass(mesh, mass, inertia)
        set_fields(
            self,
            mesh=mesh,
            friction=None if friction is None else check_scalar("Collider.friction", friction, minimum=0.0),
            pose=_pose(_STILL if pose is None else pose),
            mass=None if rigid is None else rigid.mass,
            inertia=None if rigid is None else rigid.inertia,
        )

    @property
    def rigid(self) -> RigidMass | None:
        """Mass, centre of mass and inertia; None without a mass."""
        return None if self.mass is None else rigid_mass(self.mesh, self.mass, self.inertia)


def _pose(value: ArrayLike) -> Array:
    pose = as_array("Collider.pose", value, np.float64)
    check_shape("Collider.pose", pose, (7,), "x, y, z in m, and a quaternion qw, qx, qy, qz")
    check_finite("Collider.pose", pose)
    if not pose[3:].any():
        raise ValueError(
            "Collider.pose must have a quaternion (qw, qx, qy, qz) that is not zero, got [0, 0, 0, 0]; "
            "(1, 0, 0, 0) turns nothing"
        )
    pose[3:] = unit_vectors("Collider.pose", pose[None, 3:])[0]
    return pose


Member: TypeAlias = Body | Collider


@dataclass(eq=False, repr=False)
class Contact(KeyPart):
    """Keeps surfaces and rods apart: those of bodies, of colliders, and of each body with itself.

    Surfaces rest `thickness` apart and do not cross, however few iterations a step has: docs/contact.md. The surface of
    a solid is the boundary of its mesh, whatever is embedded in it. A rod is its centre line: for rods of a radius on
    each other, the thickness is twice the radius. Bodies that take no part pass through all others. A vertex that a
    `Tie` holds does not meet the triangles and edges that end at the corners of what holds it, nor do its own meet
    those corners.

    Friction between two bodies is the geometric mean of their coefficients. `Contact(friction=)` is the coefficient of
    bodies, and of colliders that have none. If only one of the two has a coefficient, that is it, and without any there
    is no friction.

    Args:
        bodies: each a `Solid`, a `Cloth`, a `Rod` or a `Collider`; all of the scene if none is named.
        self_contact: whether bodies touch themselves, or a list of those that do.
        friction: Coulomb's coefficient, >= 0; or by pairs of bodies, {(cloth, table): 0.3}, where other pairs are as
            without it; or None.
        thickness: distance at which surfaces rest [m], positive, at most half of the least altitude of a triangle.
            Parts of a body that rest nearer than twice that have half of their distance at rest. None: a twentieth of
            the mean edge, the least of all bodies and colliders.
        capacity: most pairs of a vertex and a triangle, or of two edges, that an environment may have near each other
            in a step. None: 16 per triangle, and per segment of a rod. "grow": those, and where an environment needs
            more, the simulator makes them more and takes the step again: eager calls alone, docs/contact.md#capacity.

    Example:
        >>> box = torchpd.shapes.box((0.1, 0.1, 0.1), (2, 2, 2))
        >>> cubes = [Solid(box.translated((0, y, 0)), youngs=1e5, density=1e3) for y in (0, 0.12)]
        >>> scene = Scene(*cubes, Ground(), Gravity(), Contact(friction=0.4))
        >>> sim = Simulator(scene)
        >>> state, info = sim(sim.rest_state(), return_info=True)
        >>> info.contact_gap  # [1] least distance over the thickness
    """

    bodies: tuple[Member, ...]
    self_contact: bool | tuple[Body, ...]
    friction: float | Mapping[tuple[Member, Member], float] | None
    thickness: float | None
    capacity: int | Literal["grow"] | None

    @check_arguments("Contact")
    def __init__(
        self,
        *bodies: Member,
        self_contact: bool | Sequence[Body] = True,
        friction: float | Mapping[tuple[Member, Member], float] | None = None,
        thickness: float | None = None,
        capacity: int | Literal["grow"] | None = None,
    ) -> None:
        for body in bodies:
            _check_member("Contact", body)
        if len({id(body) for body in bodies}) != len(bodies):
            twice = next(body for number, body in enumerate(bodies) if any(body is one for one in bodies[:number]))
            raise ValueError(f"Contact: each body must be given once, got the same {type(twice).__name__} twice")
        if thickness is not None:
            thickness = check_scalar("Contact.thickness", thickness)
            if thickness <= 0.0:
                raise ValueError(f"Contact.thickness must be positive [m], got {thickness}; None chooses by the mesh")
        set_fields(
            self,
            bodies=bodies,
            self_contact=_self_contact(self_contact),
            friction=_friction(friction),
            thickness=thickness,
            capacity=_capacity(capacity),
        )
        if bodies:
            self.check_members(bodies)

    def bodies_used(self) -> tuple[Any, ...]:
        selves = () if isinstance(self.self_contact, bool) else self.self_contact
        pairs = self.friction if isinstance(self.friction, Mapping) else {}
        return (*self.bodies, *selves, *(part for pair in pairs for part in pair))

    def takes(self, part: Member) -> bool:
        """Whether a body or collider of the scene takes part."""
        return not self.bodies or any(part is one for one in self.bodies)

    def touches_itself(self, body: Member) -> bool:
        """Whether parts of a body meet each other."""
        if isinstance(self.self_contact, bool):
            return self.self_contact and isinstance(body, Body)
        return any(body is one for one in self.self_contact)

    def check_members(self, members: Sequence[Member]) -> None:
        """Refuse members that cannot take part, none that deforms, and settings of other bodies or of no pair."""
        for body in members:
            _check_member("Contact", body)
        if not any(isinstance(body, Body) for body in members):
            raise ValueError(
                f"Contact: bodies must have one that deforms, a Solid, a Cloth or a Rod, got {len(members)} colliders "
                "alone; name it too"
            )
        known = {id(body) for body in members}
        for part in self.bodies_used():
            if id(part) not in known:
                raise ValueError(
                    f"Contact: bodies must have those of self_contact and friction, got a {type(part).__name__} there "
                    "that is not among them; name it too"
                )
        for one, other in self.friction if isinstance(self.friction, Mapping) else ():
            if not (self.touches_itself(one) if one is other else can_touch(one, other)):
                names = f"{type(one).__name__}, {type(other).__name__}"
                raise ValueError(
                    f"Contact.friction must name pairs that can touch, got ({names}), which cannot: colliders without "
                    "a mass do not touch each other, nor a body itself without self_contact; leave the pair out"
                )


def can_touch(one: Member, other: Member) -> bool:
    """Whether one of two members moves by forces."""
    return any(isinstance(part, Body) or part.mass is not None for part in (one, other))


def _check_member(name: str, body: object) -> None:
    if isinstance(body, Collider | Body):
        return
    kind = type(body).__name__
    if isinstance(body, Ground | Sphere):
        fix = f"every vertex meets a {kind}, whose coefficient is {kind}(friction=): leave it out"
    elif isinstance(body, int | float):
        fix = f"a coefficient of friction goes by name, Contact(friction={body})"
    else:
        fix = "pass them one by one"
    raise TypeError(f"{name} takes Solid, Cloth, Rod and Collider, got {kind}; {fix}")


def _capacity(value: Any) -> int | Literal["grow"] | None:
    if value is None or (isinstance(value, str) and value == "grow"):
        return value  # type: ignore[return-value]
    if isinstance(value, str):
        raise ValueError(f'Contact.capacity must be a whole number of pairs, "grow" or None, got {value!r}')
    return check_whole("Contact.capacity", value, minimum=1)


def _self_contact(value: Any) -> bool | tuple[Body, ...]:
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if not isinstance(value, list | tuple):
        raise TypeError(
            f"Contact.self_contact must be a bool or a list of bodies, got {type(value).__name__}; for one body pass "
            "[body]"
        )
    for body in value:
        if isinstance(body, Collider):
            raise TypeError("Contact.self_contact must list bodies that deform, got a Collider; leave it out")
        _check_member("Contact.self_contact", body)
    return tuple(value)


def _friction(value: Any) -> float | dict[tuple[Member, Member], float] | None:
    if value is None:
        return None
    if not isinstance(value, Mapping):
        return check_scalar("Contact.friction", value, minimum=0.0)
    table: dict[tuple[Member, Member], float] = {}
    for pair, number in value.items():
        if not isinstance(pair, tuple) or len(pair) != 2:
            raise TypeError(
                f"Contact.friction must have pairs of bodies as keys, got {type(pair).__name__}; "
                "{(cloth, table): 0.3} is one"
            )
        for part in pair:
            _check_member("Contact.friction", part)
        names = ", ".join(type(part).__name__ for part in pair)
        if pair in table or pair[::-1] in table:
            raise ValueError(f"Contact.friction must have each pair once, got ({names}) in both orders; leave out one")
        table[pair] = check_scalar(f"Contact.friction of ({names})", number, minimum=0.0)
    return table


@dataclass(frozen=True, eq=False)
class ContactValues:
    """Flat arrays of contact by the user's numbers: vertices of all bodies, then those of colliders, N in all.

    Bodies are numbered in the order of the scene, the Q - C that deform first, then the C colliders.
    """

    triangles: Index  # [T, 3] surfaces of the bodies that take part
    segments: Index  # [n, 2] of the rods that take part
    body: Index  # [N] number of the body of each vertex
    collider: Index  # [N] number of its collider, -1 for vertices that deform
    points: Array  # [N - V, 3] m, vertices of colliders about the origins of their poses
    poses: Array  # [C, 7] of the colliders at the start
    rigid: tuple[RigidMass | None, ...]  # [C] None: moves by hand
    friction: Array  # [Q, Q] Coulomb's coefficient between bodies
    self_contact: Mask  # [Q] whether parts of a body meet
    thickness: float | None  # m; None: by the mesh
    capacity: int | None  # pairs of an environment; None: by the mesh
    grows: bool  # whether a step that needs more pairs makes them more
    kinds: tuple[str, ...]  # [Q] kinds of the bodies, for errors


def contact_values(contact: Contact, bodies: Sequence[Body], colliders: Sequence[Collider]) -> ContactValues:
    """Arrays of contact between bodies of a scene and its colliders, all of them in the scene's order."""
    parts: tuple[Member, ...] = (*bodies, *colliders)
    taking = [contact.takes(part) for part in parts]
    selves = [takes and contact.touches_itself(part) for takes, part in zip(taking, parts, strict=True)]
    counts = np.array([len(part.mesh.vertices) for part in parts])
    starts = np.cumsum(counts) - counts
    body = np.repeat(np.arange(len(parts)), counts)
    return ContactValues(
        triangles=np.concatenate([_triangles(parts[number]) + starts[number] for number in np.flatnonzero(taking)]),
        segments=np.concatenate([_segments(parts[number]) + starts[number] for number in np.flatnonzero(taking)]),
        body=body,
        collider=np.where(body < len(bodies), -1, body - len(bodies)),
        points=np.concatenate([np.zeros((0, 3)), *(part.mesh.vertices for part in colliders)]),
        poses=np.array([part.pose for part in colliders]).reshape(-1, 7),
        rigid=tuple(part.rigid for part in colliders),
        friction=_table(contact, parts),
        self_contact=np.array(selves),
        thickness=contact.thickness,
        capacity=contact.capacity if isinstance(contact.capacity, int) else None,
        grows=contact.capacity == "grow",
        kinds=tuple(type(part).__name__ for part in parts),
    )


def _triangles(part: Member) -> Index:
    own = part.contact_triangles() if isinstance(part, Body) else None
    if own is not None:
        return own
    mesh = part.mesh
    if isinstance(mesh, Polyline):
        return np.zeros((0, 3), dtype=np.int64)
    triangles: Index = mesh.boundary() if isinstance(mesh, TetMesh) else mesh.triangles
    return triangles


def _segments(part: Member) -> Index:
    return part.mesh.segments if isinstance(part.mesh, Polyline) else np.zeros((0, 2), dtype=np.int64)


def _table(contact: Contact, parts: Iterable[Member]) -> Array:
    """Friction between bodies [Q, Q]: the geometric mean of what they say, overwritten by that of pairs."""
    parts = list(parts)
    usual = contact.friction if isinstance(contact.friction, float) else None
    said = [part.friction if isinstance(part, Collider) else None for part in parts]
    own = np.array([usual if value is None else value for value in said], dtype=np.float64)  # NaN without any
    one, other = np.meshgrid(own, own, indexing="ij")
    one, other = np.where(np.isnan(one), other, one), np.where(np.isnan(other), one, other)
    table = np.nan_to_num(np.sqrt(one) * np.sqrt(other))
    table = np.where(one == other, np.nan_to_num(one), table)  # to the bit
    if isinstance(contact.friction, Mapping):
        numbers = {id(part): number for number, part in enumerate(parts)}
        for (first, second), value in contact.friction.items():
            i, j = numbers[id(first)], numbers[id(second)]
            table[i, j] = table[j, i] = value
    return np.asarray(table)


def placed(poses: Array, points: Array) -> Array:
    """World positions [n, 3] m of points [n, 3] about the origins of poses [n, 7]."""
    axis = poses[:, 4:]
    across = 2.0 * np.cross(axis, points)
    return np.asarray(poses[:, :3] + points + poses[:, 3:4] * across + np.cross(axis, across))
