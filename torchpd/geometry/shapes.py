"""Shapes that need no file: a box, one tet, and an octopus."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from ..common.checks import as_array, check_scalar, check_vector
from .isosurface import contour
from .tet_mesh import TetMesh
from .tri_mesh import TriMesh

__all__ = ["box", "octopus", "single_tet"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def _kuhn_cube() -> Index:
    """The six tets of a cube [6, 4, 3]: one for each path from (0, 0, 0) to (1, 1, 1) along three edges."""
    tets = np.zeros((6, 4, 3), dtype=np.int64)
    for row, order in enumerate(permutations(range(3))):
        for step, axis in enumerate(order):
            tets[row, step + 1 :, axis] = 1
        if np.linalg.det((tets[row, 1:] - tets[row, 0]).astype(np.float64)) < 0:
            tets[row, 2:] = tets[row, 3:1:-1].copy()
    return tets


def box(size: Sequence[float] | Array = (1.0, 0.2, 0.2), cells: Sequence[int] | Index = (25, 5, 5)) -> TetMesh:
    """A box [0, x] x [0, y] x [0, z] in a regular grid, six tets per cell (Kuhn) with parallel diagonals.

    Vertex (i, j, k) has the number (i (ny + 1) + j) (nz + 1) + k.

    Args:
        size: edges x, y, z [m], positive.
        cells: cells along x, y, z, at least 1.
    """
    lengths = check_vector("box.size", size)
    if not np.all(lengths > 0):
        raise ValueError(f"box.size must be positive [m], got {lengths.tolist()}")
    counts = as_array("box.cells", cells)
    if counts.shape != (3,) or counts.dtype.kind not in "iu" or not np.all(counts >= 1):
        raise ValueError(f"box.cells must be three whole numbers, at least 1, got {cells}")
    counts = counts.astype(np.int64)
    grid = np.stack(np.meshgrid(*(np.arange(n + 1) for n in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    low = grid[np.all(grid < counts, axis=1)]
    corners = low[:, None, None] + _kuhn_cube()
    tets = (corners[..., 0] * (counts[1] + 1) + corners[..., 1]) * (counts[2] + 1) + corners[..., 2]
    return TetMesh(grid * (lengths / counts), tets.reshape(-1, 4))


def single_tet(edge: float = 1.0) -> TetMesh:
    """One regular tet, centred at the origin.

    Args:
        edge: its length [m], positive.
    """
    length = check_scalar("single_tet.edge", edge)
    if length <= 0:
        raise ValueError(f"single_tet.edge must be positive [m], got {length}")
    corners = np.array([[1, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]], dtype=np.float64)
    return TetMesh(corners * (length / np.sqrt(8.0)), [[0, 1, 2, 3]])


def _arm(angle: float) -> tuple[Array, Array]:
    """Points along an arm and its radius there: out and down from the body, along the ground, up at the tip."""
    t = np.linspace(0.0, 1.0, 12)
    reach = 0.06 + 0.42 * t
    height = 0.058 + 0.17 * (1.0 - t) ** 3 + 0.10 * np.maximum((t - 0.5) / 0.5, 0.0) ** 2
    turn = angle + 0.35 * t**2
    points = np.stack([reach * np.cos(turn), height, reach * np.sin(turn)], axis=1)
    return points, 0.066 - 0.016 * t


def _tube(points: Array, spine: Array, radii: Array) -> Array:
    """Distance [n] from the tube around a chain of segments, negative inside; the radius is linear along each."""
    distance = np.full(len(points), np.inf)
    for a, b, start, end in zip(spine[:-1], spine[1:], radii[:-1], radii[1:], strict=True):
        t = np.clip((points - a) @ (b - a) / np.dot(b - a, b - a), 0.0, 1.0)
        gap = points - a - t[:, None] * (b - a)
        np.minimum(distance, np.sqrt(np.einsum("ij,ij->i", gap, gap)) - start - t * (end - start), out=distance)
    return distance


def _ball(points: Array, center: Sequence[float], radius: float) -> Array:
    return np.asarray(np.linalg.norm(points - np.array(center), axis=1) - radius)


def _blend(distances: Sequence[Array], width: float) -> Array:
    """Smooth union, -width log sum exp(-d / width): the least distance, rounded over about `width` at joints."""
    stacked = np.stack(distances)
    least = stacked.min(axis=0)
    return np.asarray(least - width * np.log(np.exp((least - stacked) / width).sum(axis=0)))


def octopus(arms: int = 8, cells: int = 24) -> TriMesh:
    """A small octopus, about 1 m wide and 0.5 m tall, that stands on its arms on y = 0 and looks along z.

    Closed and smooth. Its arms are at least 0.1 m thick, two lattice cells at `tetrahedralize(cells=20)`.

    Args:
        arms: 3 to 8.
        cells: resolution; 24 gives about 8500 triangles, and their number grows with its square.
    """
    for name, value, least, most in (("arms", arms, 3, 8), ("cells", cells, 16, 200)):
        number = check_scalar(f"octopus.{name}", value)
        if number != int(number) or not least <= number <= most:
            raise ValueError(f"octopus.{name} must be a whole number from {least} to {most}, got {value}")
    # Two arms stand to the left and the right of the view, so that the face looks out between them.
    spines = [_arm(2.0 * np.pi * (number + 0.5) / arms + 0.5 * np.pi) for number in range(int(arms))]

    def field(points: Array) -> Array:
        tubes = [_tube(points, *spine) for spine in spines]
        head = [_ball(points, (0.0, 0.33, 0.0), 0.165), _ball(points, (0.0, 0.24, 0.0), 0.13)]
        body = _blend([*tubes, *head], 0.018)
        eyes = [_ball(points, (side * 0.072, 0.36, 0.15), 0.046) for side in (-1.0, 1.0)]
        return _blend([body, *eyes], 0.006)

    surface = contour(field, np.array([-0.58, -0.04, -0.58]), np.array([0.58, 0.56, 0.58]), int(cells))
    return surface.translated([0.0, -surface.bounds[0, 1], 0.0])
