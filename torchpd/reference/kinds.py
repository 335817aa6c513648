"""Kinds of elements: the law of a group from its material, and derivatives by the material's rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .laws import Corotated, Damped, Law, Length
from .rotations import nearest_rotation
from .stretches import Limit, Volume

__all__ = ["KINDS", "Given", "Kind", "damping_target"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Rows = dict[str, Array]


class Given(NamedTuple):
    """What a law is made from, for N elements of one kind."""

    material: Rows  # [N] or [N, width]
    constants: Array  # [N, c]
    measure: Array  # [N] V
    group: Index  # [N] number of the group that shares its trace
    start: Array  # [N, 3, d] F at the start of the step
    time_step: float  # h [s]


@dataclass(frozen=True)
class Kind:
    """A kind of element."""

    corners: int  # n
    width: int  # d of F
    law: Callable[[Given], Law]
    rows: Callable[[Given, Rows], Rows]  # from derivatives by the parameters of the law, [N] each


def _solid(names: tuple[str, str]) -> Kind:
    """Lame's constants 2 mu = E / (1 + nu) and lambda = E nu / ((1 + nu) (1 - 2 nu))."""

    def law(given: Given) -> Law:
        youngs, nu = (given.material[name] for name in names)
        bulk = youngs * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
        bulk = np.where(given.group < 0, 0.0, bulk)  # a kind of its own has their volume energy
        return Corotated(youngs / (1.0 + nu), bulk, given.measure, given.group)

    def rows(given: Given, rates: Rows) -> Rows:
        youngs, nu = (given.material[name] for name in names)
        share = (1.0 + nu) * (1.0 - 2.0 * nu)
        by_youngs = rates["shear"] / (1.0 + nu) + rates["bulk"] * nu / share
        by_nu = rates["bulk"] * youngs * (1.0 + 2.0 * nu**2) / share**2 - rates["shear"] * youngs / (1.0 + nu) ** 2
        return {names[0]: by_youngs, names[1]: by_nu}

    return Kind(4, 3, law, rows)


def _membrane(given: Given) -> Law:
    """Plane stress with Y = youngs thickness: 2 mu_s = Y / (1 + nu) and lambda_s = Y nu / (1 - nu^2)."""
    stretch = given.material["membrane_youngs"] * given.material["thickness"]
    nu = given.material["membrane_poisson"]
    return Corotated(stretch / (1.0 + nu), stretch * nu / (1.0 - nu**2), given.measure, given.group)


def _membrane_rows(given: Given, rates: Rows) -> Rows:
    youngs, thickness, nu = (given.material[name] for name in ("membrane_youngs", "thickness", "membrane_poisson"))
    by_stretch = rates["shear"] / (1.0 + nu) + rates["bulk"] * nu / (1.0 - nu**2)
    by_nu = rates["bulk"] * (1.0 + nu**2) / (1.0 - nu**2) ** 2 - rates["shear"] / (1.0 + nu) ** 2
    return {
        "membrane_youngs": thickness * by_stretch,
        "membrane_poisson": youngs * thickness * by_nu,
        "thickness": youngs * by_stretch,
    }


def _line(corners: int, stiffness: str, length: str | float, *, can_slacken: bool = False) -> Kind:
    """The law of a length; `length` names a row, or is the same for all."""

    def law(given: Given) -> Law:
        count = len(given.measure)
        rest = given.material[length] if isinstance(length, str) else np.full(count, length)
        tension_only = given.constants[:, 0] != 0.0 if can_slacken else np.zeros(count, dtype=np.bool_)
        return Length(given.material[stiffness], rest, given.measure, tension_only)

    def rows(given: Given, rates: Rows) -> Rows:
        by_length = {length: rates["length"]} if isinstance(length, str) else {}
        return {stiffness: rates["stiffness"]} | by_length

    return Kind(corners, 1, law, rows)


def _limit(corners: int, width: int, name: str) -> Kind:
    """A row of lo, hi and stiffness."""

    def law(given: Given) -> Law:
        low, high, stiffness = given.material[name].T
        return Limit(stiffness, given.measure, low, high)

    def rows(given: Given, rates: Rows) -> Rows:
        return {name: np.stack([rates[part] for part in ("low", "high", "stiffness")], axis=1)}

    return Kind(corners, width, law, rows)


def damping_target(start: Array) -> Array:
    """The stretch U_t [N, 3, 3] = R^T F at the start of a step, symmetric."""
    stretch = np.swapaxes(nearest_rotation(start), 1, 2) @ start
    return np.asarray(0.5 * (stretch + np.swapaxes(stretch, 1, 2)))


def _damper(given: Given) -> Law:
    return Damped(given.material["viscosity"] / given.time_step, damping_target(given.start), given.measure)


KINDS: dict[str, Kind] = {
    "tet": _solid(("stiffness", "poisson")),
    "triangle": Kind(3, 2, _membrane, _membrane_rows),
    "hinge": _line(4, "bending", "rest_curvature"),
    "spring": _line(2, "spring_stiffness", "rest_length"),
    "tie": _line(5, "tie_stiffness", 0.0),
    "fibre": _line(4, "fibre_stiffness", "fibre_length", can_slacken=True),
    "thread": _line(3, "thread_stiffness", 1.0),
    "solid_limit": _limit(4, 3, "solid_limit"),
    "cloth_limit": _limit(3, 2, "cloth_limit"),
    "volume": Kind(
        4,
        3,
        lambda given: Volume(given.material["volume_stiffness"], given.measure),
        lambda given, rates: {"volume_stiffness": rates["stiffness"]},
    ),
    # viscosity [Pa s] is 2 mu beta; the start of the step gives its target
    "damper": Kind(4, 3, _damper, lambda given, rates: {"viscosity": rates["stiffness"] / given.time_step}),
    # gradients are those after the flow (`plastic.flowed_gradients`)
    "plastic": _solid(("plastic_youngs", "plastic_poisson")),
}
