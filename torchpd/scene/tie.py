"""Ties of vertices to points on the surface, or in the interior, of a body."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.checks import as_array, check_finite, check_shape
from ..common.synonyms import check_arguments
from ..common.warn import SceneWarning, warn_user
from ..geometry.closest_points import closest_points
from .part import ArrayLike, Body, KeyPart, Place, check_body, per_item, selected, set_fields
from .stencils import StencilGroup

__all__ = ["Tie"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_FAR = 0.1  # edges between a point and the body that is to hold it


@dataclass(eq=False, repr=False)
class Tie(KeyPart):
    """Ties vertices of one body to points of another: k / 2 |x_v - sum b_a x_a|^2.

    A point is the closest one of the other body to `points`, in a tetrahedron, triangle or segment with barycentric
    coordinates b. The tie pulls the vertex to the point itself, as a spring of length zero. Two bodies that a tie joins
    move together rigidly in a step; iterations do the rest.

    Args:
        body: the body of the vertices.
        vertices: vertex numbers of that body [N], each once, or a boolean mask over its vertices.
        other: the body that holds the points; the same body for a seam of its own.
        points: [N, 3] m, on the rest shape of `other`. None: where the vertices are at rest.
        stiffness: k [N/m], a scalar or one value per vertex, positive.

    Raises:
        ValueError: a vertex would be tied to itself.

    A `SceneWarning` comes if a point lies farther from `other` than a tenth of an edge there.

    Example:
        >>> skin = Tie(cloth, rim, body, stiffness=1e4)
    """

    body: Body
    vertices: Index
    other: Body
    points: Array | None
    stiffness: Array

    @check_arguments("Tie")
    def __init__(self, body: Body, vertices: Any, other: Body, points: Any = None, *, stiffness: ArrayLike) -> None:
        check_body("Tie.body", body)
        check_body("Tie.other", other)
        chosen = selected("Tie.vertices", vertices, len(body.mesh.vertices), of="body")
        targets = None
        if points is not None:
            targets = as_array("Tie.points", points, np.float64)
            check_shape("Tie.points", targets, (len(chosen), 3), "a point for each vertex [m]")
            check_finite("Tie.points", targets)
        set_fields(
            self,
            body=body,
            vertices=chosen,
            other=other,
            points=targets,
            stiffness=per_item("Tie.stiffness", stiffness, len(chosen), of="vertex", unit="N/m"),
        )
        self._report_far()
        own = np.flatnonzero(((self.corners == chosen[:, None]) & (self.weights > 0.0)).any(axis=1) & (body is other))
        if own.size:
            raise ValueError(
                f"Tie: a vertex must not be tied to itself, got vertex {int(chosen[own[0]])} held by its own element "
                f"({own.size} in all); give points on another part of the body"
            )

    @property
    def corners(self) -> Index:
        """Vertices of `other` that hold each vertex [N, 4]; those of weight 0 may repeat."""
        return self._held[0]

    @property
    def weights(self) -> Array:
        """Barycentric coordinates b of each point [N, 4]."""
        return self._held[1]

    @cached_property
    def _held(self) -> tuple[Index, Array, Array]:
        """Corners, weights, and distances [N] from the wanted points over the longest edge of the element."""
        wanted = self.body.mesh.vertices[self.vertices] if self.points is None else self.points
        rest, elements = self.other.mesh.vertices, self.other.elements
        found = closest_points(wanted, rest, elements)
        corners = elements[found.elements]
        ends = rest[corners]
        edges = np.linalg.norm(ends[:, :, None] - ends[:, None], axis=3).max(axis=(1, 2))
        unused = 4 - corners.shape[1]
        corners = np.concatenate([corners, np.repeat(corners[:, :1], unused, axis=1)], axis=1)
        return corners, np.pad(found.weights, ((0, 0), (0, unused))), found.distances / edges

    def _report_far(self) -> None:
        apart = self._held[2]
        far = np.flatnonzero(apart > _FAR)
        if far.size:
            worst = int(apart.argmax())
            what = "vertices" if self.points is None else "points"
            warn_user(
                f"Tie: {far.size} of {len(apart)} {what} lie off the other body at rest, vertex "
                f"{int(self.vertices[worst])} by {apart[worst]:.3g} edges. They are tied to the closest points, "
                "which pull from the first step on; to sew what is apart, give points on the other body",
                SceneWarning,
            )

    def bodies_used(self) -> tuple[Body, ...]:
        return self.body, self.other

    def stencils(self, place: Place) -> tuple[StencilGroup, ...]:
        corners = np.concatenate([self.vertices[:, None] + place(self.body), self.corners + place(self.other)], axis=1)
        weights = np.concatenate([np.ones((len(corners), 1)), -self.weights], axis=1)[:, :, None]
        return (StencilGroup.of("tie", corners, weights, np.ones(len(corners)), tie_stiffness=self.stiffness),)
