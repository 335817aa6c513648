"""Plastic flow of a solid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.checks import as_array, check_finite, check_shape
from ..common.synonyms import check_arguments
from .part import ArrayLike, ScenePart, set_fields

__all__ = ["Plastic"]

Array = NDArray[np.float64]
# Fp = 1, row by row, and alpha = 0
_AT_REST = np.array([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0])


@dataclass(frozen=True, eq=False, repr=False)
class Plastic(ScenePart):
    """Flow of a solid beyond a yield strain: it stays deformed. For `Solid(plastic=)`.

    The deformation gradient is F = F_e Fp (Simo 1992). The corotated law acts on the elastic part F_e. Fp, of
    determinant 1, is part of the state. It changes where a step ends. With the singular values s of F_e, e = log s and
    its deviator d, the flow is

        gamma = max(0, |d| - (y + H alpha)) / (1 + H) (1 - exp(-h / tau)),   y = sqrt(2/3) (1 + nu) yield_strain

    Fp is stretched by exp(gamma d / |d|) along the axes of F_e, and alpha grows by gamma. Nothing flows where
    det F_e <= 0. The force of a step is the one before its flow, so take steps with small strains.

    Args:
        yield_strain: strain of a uniaxial test at which flow begins, a scalar or one value per tetrahedron [E],
            positive.
        hardening: H, rise of y per flow alpha, a scalar or [E], >= 0. 0: perfectly plastic.
        creep_time: tau [s], in which excess strain flows, a scalar or [E]. 0: within the step.
        max_flow: largest |log s| of the stretches s of Fp, a scalar or [E], positive. inf: no bound.

    Example:
        >>> steel = Solid(mesh, youngs=1e6, poisson=0.3, plastic=Plastic(0.02, hardening=0.1))
    """

    yield_strain: Array  # [] or [E], like the others
    hardening: Array
    creep_time: Array
    max_flow: Array

    @check_arguments("Plastic")
    def __init__(
        self,
        yield_strain: ArrayLike,
        hardening: ArrayLike = 0.0,
        creep_time: ArrayLike = 0.0,
        max_flow: ArrayLike = np.inf,
    ) -> None:
        set_fields(
            self,
            yield_strain=_numbers("yield_strain", yield_strain),
            hardening=_numbers("hardening", hardening, zero=True),
            creep_time=_numbers("creep_time", creep_time, zero=True),
            max_flow=_numbers("max_flow", max_flow, infinite=True),
        )

    def rows(self, count: int) -> dict[str, Array]:
        """Rows of the material of that many tetrahedra, and their flow at rest."""
        return {
            "yield_strain": _per_tet("yield_strain", self.yield_strain, count),
            "hardening": _per_tet("hardening", self.hardening, count),
            "creep_time": _per_tet("creep_time", self.creep_time, count, unit="s"),
            "max_flow": _per_tet("max_flow", self.max_flow, count),
            "flow": np.tile(_AT_REST, (count, 1)),
        }


def _numbers(name: str, value: Any, *, zero: bool = False, infinite: bool = False) -> Array:
    full = f"Plastic.{name}"
    array = as_array(full, value, np.float64)
    if array.ndim > 1:
        raise ValueError(f"{full} must be a scalar or one value per tetrahedron [E], got {list(array.shape)}")
    check_finite(full, np.where(np.isinf(array), np.sign(array), array) if infinite else array)
    bad = np.flatnonzero((array < 0.0) if zero else (array <= 0.0))
    if bad.size:
        wanted = ">= 0" if zero else "positive"
        raise ValueError(
            f"{full} must be {wanted}, got {array.reshape(-1)[bad[0]]} at {int(bad[0])} ({bad.size} in all)"
        )
    return array


def _per_tet(name: str, array: Array, count: int, unit: str = "1") -> Array:
    if array.ndim:
        check_shape(f"Plastic.{name}", array, (count,), f"one value per tetrahedron or a scalar [{unit}]")
    return np.broadcast_to(array, (count,))
