"""Springs between pairs of vertices, and ties of vertices to points of a body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.checks import as_array, check_shape
from ..common.synonyms import check_arguments
from .part import ArrayLike, Body, KeyPart, Place, check_body, per_item, set_fields
from .stencils import StencilGroup

__all__ = ["Springs", "spring_group"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(eq=False, repr=False)
class Springs(KeyPart):
    """Springs between pairs of vertices, of one body or of two: k / 2 (|x1 - x0| - L)^2.

    Two bodies that springs join move together rigidly in a step; iterations do the rest.

    Args:
        body: the body of the first vertices.
        pairs: vertex numbers [N, 2]: the first of `body`, the second of `other`.
        stiffness: k [N/m], a scalar or one value per spring, positive.
        rest_length: L [m], a scalar or one value per spring, not negative. None: the distance at rest.
        other: the body of the second vertices. None: the same.

    Example:
        >>> hanger = Springs(left, [[0, 7], [3, 9]], 200.0, other=right)
    """

    body: Body
    pairs: Index
    stiffness: Array
    rest_length: Array
    other: Body

    @check_arguments("Springs")
    def __init__(
        self,
        body: Body,
        pairs: Any,
        stiffness: ArrayLike,
        rest_length: ArrayLike | None = None,
        *,
        other: Body | None = None,
    ) -> None:
        check_body("Springs.body", body)
        end = body if other is None else other
        check_body("Springs.other", end)
        chosen = _pairs(pairs, body, end)
        count = len(chosen)
        first, second = body.mesh.vertices[chosen[:, 0]], end.mesh.vertices[chosen[:, 1]]
        length = np.linalg.norm(second - first, axis=1) if rest_length is None else rest_length
        set_fields(
            self,
            body=body,
            pairs=chosen,
            stiffness=per_item("Springs.stiffness", stiffness, count, of="spring", unit="N/m"),
            rest_length=per_item("Springs.rest_length", length, count, of="spring", unit="m", zero=True),
            other=end,
        )

    def bodies_used(self) -> tuple[Body, ...]:
        return self.body, self.other

    def stencils(self, place: Place) -> tuple[StencilGroup, ...]:
        corners = self.pairs + np.array([place(self.body), place(self.other)])
        return (spring_group(corners, self.stiffness, self.rest_length),)


def spring_group(corners: Index, stiffness: Array, rest_length: Array) -> StencilGroup:
    """Springs between pairs of vertices of the scene [N, 2]."""
    ends = np.tile([[[-1.0], [1.0]]], (len(corners), 1, 1))
    measure = np.ones(len(corners))
    return StencilGroup.of("spring", corners, ends, measure, spring_stiffness=stiffness, rest_length=rest_length)


def _pairs(value: Any, body: Body, other: Body) -> Index:
    pairs = as_array("Springs.pairs", value)
    if pairs.size == 0:
        raise ValueError("Springs.pairs must name at least one pair, got none")
    check_shape("Springs.pairs", pairs, (None, 2), "a vertex of body and one of other")
    if pairs.dtype.kind not in "iu":
        raise TypeError(f"Springs.pairs must hold integers (vertex numbers), got {pairs.dtype}")
    pairs = pairs.astype(np.int64)
    for column, (name, end) in enumerate((("body", body), ("other", other))):
        count = len(end.mesh.vertices)
        bad = np.flatnonzero((pairs[:, column] < 0) | (pairs[:, column] >= count))
        if bad.size:
            raise IndexError(
                f"Springs.pairs must lie in 0..{count - 1} (vertices of {name}), got {int(pairs[bad[0], column])} at "
                f"[{int(bad[0])}, {column}]"
            )
    if body is other and (pairs[:, 0] == pairs[:, 1]).any():
        bad = np.flatnonzero(pairs[:, 0] == pairs[:, 1])
        raise ValueError(f"Springs.pairs must join different vertices, got {pairs[bad[0]].tolist()} at {int(bad[0])}")
    return pairs
