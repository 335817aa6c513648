"""Rods and ropes: a line of vertices that resists stretch and bending."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.checks import as_array, check_finite, check_shape
from ..common.synonyms import check_arguments
from .part import ArrayLike, Body, Place, per_item, report_size, set_fields
from .springs import spring_group
from .stencils import StencilGroup

__all__ = ["Polyline", "Rod"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Curvatures below this over the length of a segment are rounding.
_STRAIGHT = 1e-12


class Polyline(NamedTuple):
    """The rest shape of a rod."""

    vertices: Array  # [N, 3] m
    segments: Index  # [N - 1, 2]


@dataclass(eq=False, repr=False)
class Rod(Body):
    """A thin round rod along a polyline. It stretches and bends, but has no twist.

    Segments are springs of E A / L0 [N/m]. Bending at an inner vertex is E I / 2 |kappa|^2 (l0 + l1) / 2 with the
    curvature vector kappa = 2 ((x2 - x1) / l1 - (x1 - x0) / l0) / (l0 + l1). For even segments that is
    E I / 2 |x0 - 2 x1 + x2|^2 / L0^3. A clamped end needs two pinned vertices. A vertex has the mass of half of each of
    its segments.

    Args:
        polyline: vertices [N, 3] m, in order, at least two.
        youngs: Young's modulus E [Pa], a scalar or one value per segment, positive.
        radius: of the round cross section [m], a scalar or one value per segment, positive.
        density: [kg/m^3], a scalar or one value per segment, positive.
        bending: flexural rigidity E I [N m^2], a scalar or one value per inner vertex. None: E pi r^4 / 4. The scalar 0
            makes a rope.
        rest_curvature: curvature at rest [1/m], a scalar or one value per inner vertex. "polyline": that of the
            polyline. A curved vertex may bend in any plane. A scene without any curvature has no such array to train.

    Example:
        >>> cable = Rod(np.linspace((0, 1, 0), (1, 1, 0), 21), youngs=1e7, radius=2e-3)
    """

    polyline: Array
    youngs: Array
    radius: Array
    density: Array
    bending: Array | None  # [N - 2], None: follows youngs and radius
    rest_curvature: Array  # [N - 2]

    @check_arguments("Rod")
    def __init__(
        self,
        polyline: Any,
        youngs: ArrayLike,
        radius: ArrayLike,
        density: ArrayLike = 1000.0,
        *,
        bending: ArrayLike | None = None,
        rest_curvature: ArrayLike | Literal["polyline"] = "polyline",
    ) -> None:
        points = _polyline(polyline)
        count = len(points) - 1
        set_fields(self, polyline=points)
        report_size("Rod", "polyline", points, self.elements)

        def per_segment(name: str, value: ArrayLike, unit: str) -> Array:
            return per_item(f"Rod.{name}", value, count, of="segment", unit=unit)

        set_fields(
            self,
            youngs=per_segment("youngs", youngs, "Pa"),
            radius=per_segment("radius", radius, "m"),
            density=per_segment("density", density, "kg/m^3"),
            bending=None if bending is None else self._per_inner("bending", bending, "N m^2"),
            rest_curvature=self._curvature(rest_curvature),
        )

    @cached_property
    def mesh(self) -> Polyline:
        """The polyline with its segments, as bodies call their rest shape."""
        first = np.arange(len(self.polyline) - 1, dtype=np.int64)
        return Polyline(self.polyline, np.stack([first, first + 1], axis=1))

    @property
    def elements(self) -> Index:
        return self.mesh.segments

    @property
    def lengths(self) -> Array:
        """Rest lengths of the segments [N - 1] m."""
        return np.asarray(np.linalg.norm(np.diff(self.polyline, axis=0), axis=1))

    @property
    def cross_sections(self) -> Array:
        """Areas of the cross sections [N - 1] m^2."""
        return np.asarray(np.pi * self.radius**2)

    def masses(self) -> Array:
        half = 0.5 * self.density * self.cross_sections * self.lengths
        return np.asarray(np.append(half, 0.0) + np.append(0.0, half))

    def flexural_rigidity(self) -> Array:
        """E I of each inner vertex [N - 2] N m^2: `bending`, or E pi r^4 / 4 as the mean of two segments by length."""
        if self.bending is not None:
            return self.bending
        length = self.lengths
        weighted = self.youngs * np.pi / 4.0 * self.radius**4 * length
        return np.asarray((weighted[:-1] + weighted[1:]) / (length[:-1] + length[1:]))

    def stencils(self, place: Place) -> tuple[StencilGroup, ...]:
        start, length = place(self), self.lengths
        stretch = spring_group(self.elements + start, self.youngs * self.cross_sections / length, length)
        if len(length) == 1 or (self.bending is not None and not self.bending.any()):
            return (stretch,)
        inner = np.arange(1, len(length), dtype=np.int64) + start
        bend = StencilGroup.of(
            "hinge",
            np.stack([inner - 1, inner, inner + 1, inner], axis=1),  # the last corner has weight zero
            np.pad(self._curvature_weights(), ((0, 0), (0, 1)))[:, :, None],
            0.5 * (length[:-1] + length[1:]),
            bending=self.flexural_rigidity(),
            rest_curvature=self.rest_curvature,
        )
        return stretch, bend

    def _curvature_weights(self) -> Array:
        """Weights of the curvature vector at each inner vertex [N - 2, 3] 1/m^2."""
        before, after = self.lengths[:-1], self.lengths[1:]
        ends = [2.0 / ((before + after) * length) for length in (before, after)]
        return np.stack([ends[0], -ends[0] - ends[1], ends[1]], axis=1)

    def _per_inner(self, name: str, value: ArrayLike, unit: str) -> Array:
        return per_item(f"Rod.{name}", value, len(self.polyline) - 2, of="inner vertex", unit=unit, zero=True)

    def _curvature(self, value: Any) -> Array:
        if not isinstance(value, str):
            return self._per_inner("rest_curvature", value, "1/m")
        if value != "polyline":
            raise ValueError(f'Rod.rest_curvature must be numbers [1/m] or "polyline", got {value!r}')
        if len(self.polyline) < 3:
            return np.zeros(0)
        windows = np.stack([self.polyline[:-2], self.polyline[1:-1], self.polyline[2:]], axis=1)
        curvature = np.linalg.norm(np.einsum("va,vak->vk", self._curvature_weights(), windows), axis=1)
        curvature[curvature * self.lengths[1:] < _STRAIGHT * (1.0 + np.abs(windows).max(axis=(1, 2)))] = 0.0
        return np.asarray(curvature)


def _polyline(value: Any) -> Array:
    points = as_array("Rod.polyline", value, np.float64)
    check_shape("Rod.polyline", points, (None, 3), "vertices in order [m]")
    check_finite("Rod.polyline", points)
    if len(points) < 2:
        raise ValueError(f"Rod.polyline must have at least two vertices, got {len(points)}")
    same = np.flatnonzero((points[1:] == points[:-1]).all(axis=1))
    if same.size:
        first = int(same[0])
        raise ValueError(
            f"Rod.polyline: neighbours must lie apart, got {points[first].tolist()} at {first} and {first + 1}"
        )
    return points
