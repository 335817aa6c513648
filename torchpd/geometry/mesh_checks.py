"""Checks of mesh arrays on creation, and the repairs on offer."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..common.checks import as_array, check_finite, check_shape
from ..common.warn import warn_user

__all__ = [
    "MeshWarning",
    "Numbers",
    "affine",
    "check_elements",
    "check_fill",
    "check_points",
    "check_regions",
    "clean_tets",
    "compact",
    "corner_words",
    "determinants",
    "find_duplicates",
    "has_repeated_corner",
    "is_flat",
    "raise_for_first",
    "scaling",
    "set_frozen",
    "translation",
    "warn",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Numbers = Sequence[Any] | NDArray[Any] | torch.Tensor

_ROUNDOFF = float(np.finfo(np.float64).eps) / 2


class MeshWarning(UserWarning):
    """A mesh was repaired on creation, or is unlikely to be intended; the message gives fault, count and fix."""


def warn(message: str) -> None:
    warn_user(message, MeshWarning)


def set_frozen(part: object, **values: Any) -> None:
    """Set fields of a frozen object; arrays become read-only."""
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            value = np.ascontiguousarray(value)
            value.setflags(write=False)
        object.__setattr__(part, name, value)


def check_points(name: str, value: Numbers) -> Array:
    """Check vertices; returns them as float64 [V, 3]."""
    array = as_array(name, value)
    if array.size == 0:
        raise ValueError(f"{name} must hold at least one vertex, got none")
    check_shape(name, array, (None, 3), "positions [m]")
    if array.dtype.kind == "b":
        raise TypeError(f"{name} must hold real numbers, got {array.dtype}")
    check_finite(name, array)
    return np.asarray(array, dtype=np.float64)


def check_elements(name: str, value: Numbers, corners: int, count: int) -> Index:
    """Check that corner numbers name vertices; returns them as int64 [E, corners]."""
    array = as_array(name, value)
    if array.size == 0:
        raise ValueError(f"{name} must hold at least one element, got none")
    check_shape(name, array, (None, corners), f"{corners} vertex numbers each")
    if array.dtype.kind not in "iu":
        raise TypeError(f"{name} must hold integers (vertex numbers), got {array.dtype}")
    outside = (array < 0) | (array >= count)
    if outside.any():
        row = int(np.flatnonzero(outside.any(axis=1))[0])
        raise IndexError(
            f"{name} must lie in 0..{count - 1} (there are {count} vertices), "
            f"got {array[row].tolist()} at {row} ({int(outside.sum())} numbers in all)"
        )
    return np.asarray(array, dtype=np.int64)


def has_repeated_corner(elements: Index) -> NDArray[np.bool_]:
    corners = elements.T
    equal = np.zeros(len(elements), dtype=bool)
    for a, b in combinations(range(len(corners)), 2):
        equal |= corners[a] == corners[b]
    return equal


def corner_words(elements: Index) -> NDArray[np.uint64]:
    """Random word of the vertex at every corner [E, corners], so that equal corner sets have equal sums."""
    words = np.random.default_rng(0).integers(0, 2**63, int(elements.max()) + 1, dtype=np.uint64)
    return np.asarray(words[elements])


def find_duplicates(tets: Index) -> tuple[NDArray[np.bool_], int]:
    """Mask of tets with the corners of an earlier one, in any order, and the original of the first such tet.

    Equal tets have equal sums of random words, one per vertex. Corners are compared only where two sums are equal.
    """
    words = corner_words(tets)
    sums = sum(words[:, k] for k in range(1, words.shape[1])) + words[:, 0]
    repeated = np.zeros(len(tets), dtype=bool)
    ordered = np.sort(sums)
    equal = ordered[1:][ordered[1:] == ordered[:-1]]
    if not len(equal):
        return repeated, -1
    suspects = np.flatnonzero(np.isin(sums, equal))
    _, first, number = np.unique(np.sort(tets[suspects], axis=1), axis=0, return_index=True, return_inverse=True)
    origin = suspects[first[number.reshape(-1)]]
    repeated[suspects] = origin != suspects
    found = np.flatnonzero(repeated)
    return repeated, int(origin[suspects == found[0]][0]) if len(found) else -1


def determinants(points: Array, tets: Index) -> Array:
    """Six times the signed volume of each tet."""
    origin = points[tets[:, 0]]
    a, b, c = (points[tets[:, k]] - origin for k in (1, 2, 3))
    return np.asarray(np.einsum("ij,ij->i", a, np.cross(b, c)))


def is_flat(points: Array, tets: Index, values: Array) -> NDArray[np.bool_]:
    """Mask of tets whose volume is within the float64 rounding of a flat tet.

    Let the bounding box reach to M from the origin. A coordinate is off by up to u M, a vertex by sqrt(3) u M. Each
    vertex changes the determinant by twice the opposite area. The four areas add up to at most sqrt(3) l^2 (l the
    longest edge), so the bound is 6 u M l^2. The evaluation adds less than 10 u l^3 (8 roundings of at most 1.16 l^3,
    the permanent).
    """
    reach = float(np.abs(points).max())

    def noise(longest: Any) -> Any:
        return _ROUNDOFF * (6.0 * reach + 10.0 * longest) * longest**2

    # No edge exceeds the diagonal: measure edges only of tets that are flat by this bound. Not `<=`: a determinant that
    # overflows to NaN is no volume either.
    flat = ~(np.abs(values) > noise(float(np.linalg.norm(np.ptp(points, axis=0)))))
    suspects = np.flatnonzero(flat)
    corners = points[tets[suspects]]
    edges = corners[:, [1, 2, 3, 2, 3, 3]] - corners[:, [0, 0, 0, 1, 1, 2]]
    longest = np.linalg.norm(edges, axis=2).max(axis=1, initial=0.0)
    flat[suspects] = ~(np.abs(values[suspects]) > noise(longest))
    return np.asarray(flat)


def raise_for_first(name: str, bad: NDArray[np.bool_], elements: Index, fault: str, fix: str) -> None:
    """Raise an error for the first bad element, if any."""
    rows = np.flatnonzero(bad)
    if rows.size:
        raise ValueError(
            f"{name}: {fault}, got {elements[rows[0]].tolist()} at {int(rows[0])} ({rows.size} in all); {fix}"
        )


def compact(owner: str, elements: Index, count: int, *, drop: bool) -> tuple[Index, Index]:
    """Referenced vertices, and the elements renumbered to them. Unreferenced vertices are refused unless dropped.

    A vertex without an element has no mass: nothing would determine its motion.
    """
    used = np.zeros(count, dtype=bool)
    used[elements] = True
    kept = np.flatnonzero(used)
    if len(kept) == count:
        return kept, elements
    lost = count - len(kept)
    if not drop:
        raise ValueError(
            f"{owner}.vertices: every vertex must belong to an element, got {lost} of {count} that do not "
            f"(the first is {int(np.argmin(used))}); pass drop_unreferenced=True to drop and renumber them"
        )
    warn(f"{owner}: {lost} of {count} vertices belong to no element and were left out; the others are renumbered")
    return kept, (np.cumsum(used) - 1)[elements]


def check_fill(value: Numbers, count: int) -> Array:
    fill = as_array("TetMesh.fill", value, np.float64)
    check_shape("TetMesh.fill", fill, (count,), "the share of each tet that is material")
    bad = np.flatnonzero(~((fill > 0.0) & (fill <= 1.0)))
    if bad.size:
        raise ValueError(f"TetMesh.fill must lie in (0, 1], got {fill[bad[0]]} at {int(bad[0])} ({bad.size} in all)")
    return fill


def check_regions(value: Numbers, count: int) -> Index:
    regions = as_array("TetMesh.regions", value)
    check_shape("TetMesh.regions", regions, (count,), "the region of each tet")
    if regions.dtype.kind not in "iu":
        raise TypeError(f"TetMesh.regions must hold integers, got {regions.dtype}")
    return np.asarray(regions, dtype=np.int64)


def clean_tets(
    vertices: Numbers,
    tets: Numbers,
    fill: Numbers | None,
    regions: Numbers | None,
    *,
    drop_unreferenced: bool = False,
    drop_degenerate: bool = False,
) -> dict[str, Any]:
    """Check and repair the fields of a `TetMesh`; all tets of the result have positive volume."""
    points = check_points("TetMesh.vertices", vertices)
    elements = check_elements("TetMesh.tets", tets, 4, len(points))
    shares = None if fill is None else check_fill(fill, len(elements))
    groups = None if regions is None else check_regions(regions, len(elements))
    fix = "pass drop_degenerate=True to leave them out"
    if not drop_degenerate:
        raise_for_first("TetMesh.tets", has_repeated_corner(elements), elements, "corners must differ", fix)
    with np.errstate(over="ignore", invalid="ignore"):
        signed = determinants(points, elements)
        flat = is_flat(points, elements, signed)
    twice, first = find_duplicates(elements)
    if drop_degenerate and (flat.any() or twice.any()):
        for bad, fault in ((flat, "have no volume"), (twice & ~flat, "come twice")):
            if bad.any():
                warn(f"TetMesh: {int(bad.sum())} of {len(bad)} tets {fault} and were left out")
        kept = ~(flat | twice)
        shares = None if shares is None else shares[kept]
        groups = None if groups is None else groups[kept]
        elements, signed, flat, twice = elements[kept], signed[kept], flat[kept], twice[kept]
        if not len(elements):
            raise ValueError("TetMesh.tets: no tet has a volume; are all vertices in one plane?")
    raise_for_first("TetMesh.tets", flat, elements, "volumes must exceed the rounding of the vertices", fix)
    if twice.any():
        again = f"tets must be distinct (that at {first} comes again, with a volume of its own)"
        raise_for_first("TetMesh.tets", twice, elements, again, fix)
    inverted = signed < 0
    flipped = int(inverted.sum())
    if flipped:
        elements[inverted] = elements[inverted][:, [0, 1, 3, 2]]
        warn(f"TetMesh: {flipped} of {len(elements)} tets had inverted winding and were turned")
    used, elements = compact("TetMesh", elements, len(points), drop=drop_unreferenced)
    return {
        "vertices": points[used],
        "tets": elements,
        "fill": shares,
        "regions": groups,
        "flipped": flipped,
    }


def affine(name: str, matrix: Numbers) -> tuple[Array, Array]:
    """Linear part and offset of a 3x3 or an affine 4x4 matrix."""
    array = as_array(name, matrix, np.float64)
    if array.shape not in ((3, 3), (4, 4)):
        raise ValueError(f"{name} must be [3, 3] or [4, 4] (acting on columns), got {list(array.shape)}")
    check_finite(name, array)
    if array.shape == (3, 3):
        return array, np.zeros(3)
    if not np.array_equal(array[3], [0.0, 0.0, 0.0, 1.0]):
        raise ValueError(f"{name} must be affine: its last row must be [0, 0, 0, 1], got {array[3].tolist()}")
    return array[:3, :3], array[:3, 3]


def translation(name: str, offset: Numbers) -> Array:
    matrix = np.eye(4)
    vector = as_array(name, offset, np.float64)
    check_shape(name, vector, (3,), "a vector [m]")
    matrix[:3, 3] = vector
    return matrix


def scaling(name: str, factor: float | Numbers) -> Array:
    factors = as_array(name, factor, np.float64)
    if factors.shape not in ((), (1,), (3,)) or not np.all(np.isfinite(factors)) or not np.all(factors > 0):
        raise ValueError(f"{name} must be one positive number or three (x, y, z), got {factor}")
    return np.diag(np.broadcast_to(factors, 3))
