"""The constant arrays of contact: surfaces, trees over their primitives, and pairs that are near at rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ..scene.contact import ContactValues, placed
from ..scene.rigid import RigidMass
from ..scene.scene import SceneValues
from .contact_near import NearPairs, Primitives, least_apart, near_pairs, own_vertices
from .contact_tree import ContactTree

__all__ = ["FLOOR", "ContactPlan", "contact_plan"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Numbers = NDArray[np.int32]
Mask = NDArray[np.bool_]

FLOOR = 0.1  # least distance that is promised, over the thickness
_EDGES_PER_THICKNESS = 20.0
_PAIRS_PER_PART = 16  # a triangle or a segment of a rod: two layers that lie on each other have 11
_APART = 0.7  # of the mean edge: a search in a step reaches over half of it


@dataclass(frozen=True, eq=False)
class ContactPlan:
    """Contact of a scene by the user's numbers: V vertices of all bodies, then those of colliders, N in all.

    Bodies are numbered in the order of the scene, colliders after those that deform: Q bodies, C of them colliders.
    """

    rest: Array  # [N, 3] m, colliders at their first poses
    triangles: Numbers  # [T, 3] of the bodies that take part
    edges: Numbers  # [E, 2] of triangles and rods, each once, in increasing order
    vertices: Numbers  # [S] ends of the edges, increasing
    body: Numbers  # [N] number of the body of each vertex
    kinematic: Mask  # [N] whether the scene moves the vertex by hand: hard pins and colliders without a mass
    collider: Numbers  # [N] number of its collider, -1 for vertices that deform
    points: Array  # [N - V, 3] m, vertices of colliders about the origins of their poses
    poses: Array  # [C, 7] of the colliders at the start
    rigid: tuple[RigidMass | None, ...]  # [C] of colliders with a mass
    cell: Array  # [N] m, mean length of the edges of the vertex's body; 0 where it takes no part
    friction: Array  # [Q, Q] Coulomb's coefficient between bodies
    self_contact: Mask  # [Q] whether parts of a body meet
    thickness: float  # r, m
    capacity: int  # most pairs of an environment
    grows: bool  # whether a step that needs more pairs makes them more
    vertex_tree: ContactTree  # over the rows of `vertices`
    triangle_tree: ContactTree
    edge_tree: ContactTree
    near: NearPairs
    shape: Array  # [V, 3] m, places at rest about the middle of each body's surface
    apart: Array  # [Q] m, least distance at rest between parts of a solid that share no vertex; 0 where not asked
    longest: float  # m, edge

    def check_resolution(self, dtype: torch.dtype) -> None:
        """Refuse a thickness whose floor is below rounding: 64 ulp of places, 256 of the longest edge.

        Directions between close edges turn by rounding of the edges' length.

        Raises:
            ValueError: for the thickness, or for parts of a body that rest too near each other.
        """
        extent = float(np.abs(self.rest[self.vertices]).max())
        least = float(torch.finfo(dtype).eps) * max(64.0 * extent, 256.0 * self.longest) / FLOOR
        where = f"places of up to {extent:.3g} m and edges of up to {self.longest:.3g} m in {dtype}"
        fix = "move the scene to the origin, refine its triangles or use float64"
        if self.thickness < least:
            raise ValueError(
                f"Contact.thickness must be at least {least:.3g} m for {where}, got {self.thickness:.3g}; raise it, "
                f"{fix}"
            )
        thickness = np.where(self.near.thickness > 0.0, self.near.thickness, np.inf)  # those of ties are no pairs
        nearest = int(thickness.argmin()) if len(thickness) else 0
        if len(thickness) and thickness[nearest] < least:
            raise ValueError(
                f"Contact: parts of a body must rest at least {2.0 * least:.3g} m apart for {where}, got "
                f"{2.0 * thickness[nearest]:.3g} m between {self._names(int(self.near.keys[nearest]))}; merge what "
                f"belongs together, give the parts as bodies of their own, {fix}"
            )

    def _names(self, key: int) -> str:
        """Vertices of a pair of one body, by its own numbers."""
        points = len(self.rest) * len(self.triangles)
        one, other = divmod(key, len(self.triangles)) if key < points else divmod(key - points, len(self.edges))
        first = [one] if key < points else self.edges[one].tolist()
        second = (self.triangles if key < points else self.edges)[other].tolist()
        return own_vertices(self.body, [*first, *second])


def contact_plan(values: SceneValues) -> ContactPlan:
    """Compile the contact of a scene, in the order of its parts.

    Args:
        values: the flat arrays of `Scene.values`, of a scene with `Contact`.

    Raises:
        ValueError: a triangle that is too flat for the thickness, or parts of a body that touch at rest.
    """
    given = values.contact
    if given is None:
        raise ValueError("contact_plan: values must be of a scene with Contact, got one without; add Contact()")
    own, bodies = len(values.rest_positions), len(given.kinds)
    world = placed(given.poses[given.collider[own:]], given.points)
    surface = Primitives.of(np.concatenate([values.rest_positions, world]), given.body, given.triangles, given.segments)
    lengths, of = surface.edge_lengths, given.body[surface.edges[:, 0]]
    counts = np.bincount(of, minlength=bodies)
    mean = np.bincount(of, weights=lengths, minlength=bodies) / np.maximum(counts, 1)
    thickness = float(mean[counts > 0].min()) / _EDGES_PER_THICKNESS if given.thickness is None else given.thickness
    _check_triangles(given, surface, thickness)
    parts = len(given.triangles) + len(given.segments)
    capacity = _PAIRS_PER_PART * parts if given.capacity is None else given.capacity
    by_hand = np.array([True, *(mass is None for mass in given.rigid)])
    kinematic = (given.collider >= 0) & by_hand[given.collider + 1]
    kinematic[values.pin_vertices[np.isinf(values.pin_stiffness)]] = True
    tied = _tied(values)
    solid = np.array([kind == "Solid" for kind in given.kinds]) & given.self_contact
    return ContactPlan(
        rest=surface.rest,
        triangles=surface.triangles.astype(np.int32),
        edges=surface.edges.astype(np.int32),
        vertices=surface.vertices.astype(np.int32),
        body=given.body.astype(np.int32),
        kinematic=kinematic,
        collider=given.collider.astype(np.int32),
        points=given.points,
        poses=given.poses,
        rigid=given.rigid,
        cell=mean[given.body],
        friction=given.friction,
        self_contact=given.self_contact,
        thickness=thickness,
        capacity=capacity,
        grows=given.grows,
        vertex_tree=surface.vertex_tree,
        triangle_tree=surface.triangle_tree,
        edge_tree=surface.edge_tree,
        near=near_pairs(surface, given.self_contact, thickness, tied),
        shape=surface.rest[:own] - _middles(surface, bodies)[given.body[:own]],
        apart=least_apart(surface, solid, _APART * mean, tied),
        longest=float(lengths.max()),
    )


def _middles(surface: Primitives, bodies: int) -> Array:
    """Mean places [bodies, 3] m of the vertices of surfaces."""
    of, places = surface.body[surface.vertices], surface.rest[surface.vertices]
    counts = np.maximum(np.bincount(of, minlength=bodies), 1)
    return np.stack([np.bincount(of, weights=axis, minlength=bodies) / counts for axis in places.T], axis=1)


def _check_triangles(given: ContactValues, surface: Primitives, thickness: float) -> None:
    """Refuse a thickness above half of the least altitude: twice the area over the longest side."""
    x = surface.rest[surface.triangles]
    area = np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]), axis=1)
    longest = np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2).max(axis=1)
    altitude = np.divide(area, longest, out=np.zeros_like(area), where=longest > 0.0)
    if thickness <= 0.5 * altitude.min(initial=np.inf):
        return
    flattest = int(altitude.argmin())
    corners = surface.triangles[flattest].tolist()
    where = f"a triangle, {own_vertices(given.body, corners)} ({given.kinds[given.body[corners[0]]]})"
    if altitude[flattest] == 0.0:
        raise ValueError(f"Contact: triangles must have an area, got {where} without; leave it out")
    default = " by the mean edge" if given.thickness is None else ""
    raise ValueError(
        f"Contact.thickness must be at most {0.5 * altitude[flattest]:.3g} m, half of the least altitude of {where}, "
        f"got {thickness:.3g}{default}; lower it, or mend that triangle"
    )


def _tied(values: SceneValues) -> Index:
    """Vertices [n, 2] that ties join: a held one, and a corner of what holds it."""
    pairs = [np.zeros((0, 2), dtype=np.int64)]
    for group in values.stencils:
        if group.kind == "tie":
            stencil, corner = np.nonzero(group.gradients[:, 1:, 0])
            pairs.append(np.stack([group.corners[stencil, 0], group.corners[stencil, 1 + corner]], axis=1))
    return np.concatenate(pairs)
