"""What all parts of a scene have in common: frozen values without work, and the checks of their arrays."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import FrozenInstanceError
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from ..common.checks import as_array, check_finite, check_positive, check_shape
from ..common.reprs import by_fields
from ..geometry.mesh_checks import warn
from ..geometry.mesh_faces import mesh_components

if TYPE_CHECKING:
    from typing_extensions import Self

    from .stencils import StencilGroup

__all__ = [
    "ArrayLike",
    "Body",
    "KeyPart",
    "Place",
    "ScenePart",
    "check_body",
    "per_item",
    "report_size",
    "selected",
    "set_fields",
    "unit_vectors",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
ArrayLike = float | Sequence[float] | Array | torch.Tensor
Place = Callable[[Any], int]  # number in the scene of the first vertex of a body

# Bodies shorter or longer than this [m] are probably in other units.
_SHORTEST, _LONGEST = 1e-3, 50.0
_ROUNDING = 4.0 * float(np.finfo(np.float64).eps)


def set_fields(part: object, **values: Any) -> None:
    """Store checked values in a frozen part; arrays become read-only."""
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
        object.__setattr__(part, name, value)


class ScenePart:
    """A value that a deep copy shares, so that copies of a scene know the same parts."""

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self

    def __repr__(self) -> str:
        return by_fields(self)

    def bodies_used(self) -> tuple[Any, ...]:
        """Bodies of the scene that this part acts on."""
        return ()

    def stencils(self, place: Place) -> tuple[StencilGroup, ...]:
        """The stencils of this part, by vertices of the scene. Most parts have none."""
        return ()


class KeyPart(ScenePart):
    """A part that serves as a key of `targets` and read-outs: frozen, but not by `dataclass(frozen=True)`.

    torch.compile would hash such a dataclass by its fields, which are arrays, despite `eq=False`.
    """

    def __setattr__(self, name: str, value: object) -> None:
        raise FrozenInstanceError(f"cannot assign to field {name!r}")

    def __delattr__(self, name: str) -> None:
        raise FrozenInstanceError(f"cannot delete field {name!r}")


class Body(KeyPart, ABC):
    """A part with vertices: a body has a `mesh` with `vertices` [V, 3] m, its rest shape."""

    mesh: Any

    @property
    @abstractmethod
    def elements(self) -> Index:
        """Vertex numbers of the elements that hold the body together [E, corners]."""

    @abstractmethod
    def masses(self) -> Array:
        """Lumped masses of the vertices [V] kg."""

    def contact_triangles(self) -> Index | None:
        """Triangles [F, 3] that `Contact` takes; None: those of the mesh, or of its boundary."""
        return None

    def rise(self) -> float:
        """How far its surface was found to lie from the triangles that contact acts on [m]."""
        return 0.0


def check_body(name: str, value: object) -> None:
    """Refuse what is no body."""
    if not isinstance(value, Body):
        raise TypeError(f"{name} must be a body of the scene (Solid, Cloth or Rod), got {type(value).__name__}")


def per_item(name: str, value: ArrayLike, count: int, *, of: str, unit: str, zero: bool = False) -> Array:
    """One value per item [count], also from a scalar: positive or, with `zero`, not negative."""
    array = as_array(name, value, np.float64)
    if array.ndim == 0:
        array = np.full(count, float(array))
    check_shape(name, array, (count,), f"one value per {of} or a scalar [{unit}]")
    check_finite(name, array)
    if zero:
        bad = np.flatnonzero(array < 0.0)
        if bad.size:
            raise ValueError(f"{name} must be >= 0 [{unit}], got {array[bad[0]]} at {int(bad[0])} ({bad.size} in all)")
    else:
        check_positive(name, array, unit=unit)
    array.setflags(write=False)
    return array


def selected(
    name: str, value: Any, count: int, *, of: str, items: Literal["vertex", "tetrahedron"] = "vertex"
) -> Index:
    """Numbers of chosen items [P], each once, from numbers or a boolean mask [count]."""
    plural = {"vertex": "vertices", "tetrahedron": "tetrahedra"}[items]
    chosen = as_array(name, value)
    if chosen.dtype == np.bool_:
        check_shape(name, chosen, (count,), f"a mask over the {plural} of the {of}")
        chosen = np.flatnonzero(chosen)
    if chosen.size == 0:
        raise ValueError(f"{name} must name at least one {items}, got none")
    if chosen.ndim != 1 or not np.issubdtype(chosen.dtype, np.integer):
        raise ValueError(
            f"{name} must be integers [P] or a boolean mask [{count}], got {chosen.dtype} {list(chosen.shape)}"
        )
    if chosen.min() < 0 or chosen.max() >= count:
        bad = int(chosen[(chosen < 0) | (chosen >= count)][0])
        raise IndexError(f"{name} must lie in 0..{count - 1} ({plural} of the {of}), got {bad}")
    if len(np.unique(chosen)) != len(chosen):
        numbers, counts = np.unique(chosen, return_counts=True)
        raise ValueError(f"{name} must name each {items} once, got {int(numbers[counts.argmax()])} twice")
    return np.asarray(chosen, dtype=np.int64)


def unit_vectors(name: str, array: Array) -> Array:
    """Vectors [N, k] of length 1. Those that are so within rounding stay as they are, to the bit."""
    check_finite(name, array)
    largest = np.abs(array).max(axis=1, initial=0.0)
    bad = np.flatnonzero(largest == 0.0)
    if bad.size:
        raise ValueError(f"{name} must not be zero, got {array[bad[0]].tolist()} at {int(bad[0])} ({bad.size} in all)")
    unit = array / largest[:, None]  # so that no length overflows
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    is_unit = np.abs(np.linalg.norm(array, axis=1) - 1.0) <= _ROUNDING
    return np.where(is_unit[:, None], array, unit)


def _longest_side(points: Array, elements: Index) -> float:
    """Longest side [m] of the box around a body or, if that is too long, of the boxes around its components."""
    length = float(np.ptp(points, axis=0).max())
    if length <= _LONGEST:
        return length
    component = mesh_components(elements)
    order = np.argsort(component, kind="stable")
    starts = np.flatnonzero(np.diff(component[order], prepend=-1))
    sides = np.maximum.reduceat(points[order], starts) - np.minimum.reduceat(points[order], starts)
    return float(sides.max())


def report_size(owner: str, shape: str, points: Array, elements: Index) -> None:
    """Warn of a body whose longest side is probably not in metres; `shape` is the argument with its points."""
    length = _longest_side(points, elements)
    if _SHORTEST <= length <= _LONGEST:
        return
    scaled = "{} * {}" if shape == "polyline" else "{}.scaled({})"
    fix = scaled.format(shape, 1000) + " if these were divided by 1000"
    if length > _LONGEST:
        read = "" if shape == "polyline" else ', or read its file with unit="mm"'
        fix = scaled.format(shape, 0.001) + f" if these are millimetres{read}"
    warn(
        f"{owner}: the {shape} is {length:.4g} m long, where bodies of {_SHORTEST:g} to {_LONGEST:g} m are expected. "
        f"Coordinates are in metres: pass {fix}"
    )
