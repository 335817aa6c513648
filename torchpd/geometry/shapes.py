"""Shapes that need no file: a box, one tet, a sheet, surfaces of revolution, and an octopus."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise, permutations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.checks import as_array, check_scalar, check_vector, check_whole
from .isosurface import contour
from .tet_mesh import TetMesh
from .tri_mesh import TriMesh

__all__ = ["box", "capsule", "cylinder", "octopus", "sheet", "single_tet", "sphere"]

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
    length = _positive("single_tet.edge", edge)
    corners = np.array([[1, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]], dtype=np.float64)
    return TetMesh(corners * (length / np.sqrt(8.0)), [[0, 1, 2, 3]])


def sheet(size: Sequence[float] | Array = (1.0, 1.0), cells: Sequence[int] | Index = (20, 20)) -> TriMesh:
    """A level sheet around the origin, two triangles a cell with diagonals that alternate, facing up.

    Vertex (i, k) has the number i (nz + 1) + k.

    Args:
        size: edges along x and z [m], positive.
        cells: cells along x and z, at least 1.

    Example:
        >>> cloth = Cloth(torchpd.shapes.sheet((0.5, 0.5), (25, 25)), youngs=1e5, thickness=1e-3, area_density=0.2)
    """
    if len(size) != 2 or len(cells) != 2:
        raise ValueError(f"sheet: size and cells must be two numbers each, got {size} and {cells}")
    lengths = [_positive("sheet.size", length) for length in size]
    nx, nz = (_whole("sheet.cells", count) for count in cells)
    i, k = np.meshgrid(np.arange(nx + 1), np.arange(nz + 1), indexing="ij")
    places = [lengths[0] * (i / nx - 0.5), 0.0 * i, lengths[1] * (k / nz - 0.5)]
    number = i * (nz + 1) + k
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    even = ((i + k) % 2 == 0)[:-1, :-1]
    triangles = [(a, b, np.where(even, c, d)), (np.where(even, a, b), c, d)]
    return TriMesh(
        np.stack(places, axis=-1).reshape(-1, 3), np.stack([np.stack(of, -1) for of in triangles], 2).reshape(-1, 3)
    )


def sphere(radius: float = 1.0, cells: int = 6) -> TriMesh:
    """A closed sphere around the origin, with vertices on the exact one.

    Args:
        radius: [m], positive.
        cells: edges from a pole to the equator, at least 1; there are 8 cells^2 triangles.

    Example:
        >>> ball = Collider(torchpd.shapes.sphere(0.05), friction=0.5)
    """
    return _revolved(_dome(_positive("sphere.radius", radius), _whole("sphere.cells", cells)), 0.0)


def capsule(radius: float = 1.0, length: float = 1.0, cells: int = 6) -> TriMesh:
    """A closed cylinder along y around the origin, with half a sphere on each end.

    Args:
        radius: [m], positive.
        length: of the straight part [m], positive; the whole is 2 radius longer.
        cells: edges from a pole to the straight part, at least 1; those along it are as long.

    Example:
        >>> finger = Collider(torchpd.shapes.capsule(0.01, 0.05), friction=0.8)
    """
    dome = _dome(_positive("capsule.radius", radius), _whole("capsule.cells", cells))
    return _revolved(dome, _positive("capsule.length", length))


def cylinder(radius: float = 1.0, length: float = 1.0, cells: int = 4) -> TriMesh:
    """A closed cylinder along y around the origin, with flat ends.

    Args:
        radius: [m], positive.
        length: [m], positive.
        cells: edges from the axis to the rim, at least 1, with 6 cells edges around; those along it are as long.

    Example:
        >>> roller = Collider(torchpd.shapes.cylinder(0.02, 0.2), friction=0.6)
    """
    size, count = _positive("cylinder.radius", radius), _whole("cylinder.cells", cells)
    disc = [_Ring(size * k / count, 0.0, max(1, 6 * k)) for k in range(count + 1)]
    return _revolved(disc, _positive("cylinder.length", length))


class _Ring(NamedTuple):
    """Points around the y axis."""

    radius: float  # m
    height: float  # m
    points: int


def _dome(radius: float, cells: int) -> list[_Ring]:
    """Upper half of a sphere from the pole to the equator; rings of 4, 8, .. points, as on an octahedron."""
    angles = [0.5 * np.pi * k / cells for k in range(cells + 1)]
    return [_Ring(radius * np.sin(a), radius * np.cos(a), max(1, 4 * k)) for k, a in enumerate(angles)]


def _revolved(dome: Sequence[_Ring], length: float) -> TriMesh:
    """A closed surface of a dome, given from its pole, a straight part of a length [m] and the same dome below."""
    rim = dome[-1]
    rows = max(1, round(length * rim.points / (2.0 * np.pi * rim.radius))) if length else 0
    straight = [_Ring(rim.radius, length * (0.5 - row / rows), rim.points) for row in range(1, rows)]
    above, below = ([ring._replace(height=0.5 * length + ring.height) for ring in dome] for _ in range(2))
    below = [ring._replace(height=-ring.height) for ring in below[::-1]][0 if length else 1 :]
    rings = [*above, *straight, *below]
    angles = [2.0 * np.pi * np.arange(ring.points) / ring.points for ring in rings]
    places = [
        np.stack([ring.radius * np.cos(a), np.full(len(a), ring.height), ring.radius * np.sin(a)], axis=1)
        for ring, a in zip(rings, angles, strict=True)
    ]
    starts = np.cumsum([0, *(ring.points for ring in rings)])
    bands = zip(pairwise(ring.points for ring in rings), pairwise(starts), strict=False)
    triangles = [
        [(numbers[side] + corner % counts[side]) for side, corner in triangle]
        for counts, numbers in bands
        for triangle in _band(*counts)
    ]
    return TriMesh(np.concatenate(places), triangles)


def _band(upper: int, lower: int) -> Iterator[tuple[tuple[int, int], ...]]:
    """Triangles between rings of two counts: corners as side (0 upper, 1 lower) and number. One point is a pole."""
    most = [0 if count == 1 else count for count in (upper, lower)]
    i = j = 0
    while i < most[0] or j < most[1]:
        # the side that is behind advances; of equal ones that with fewer points
        ahead = (i + 1) * lower - (j + 1) * upper
        if j == most[1] or (i < most[0] and (ahead < 0 or (ahead == 0 and upper <= lower))):
            yield (0, i), (0, i + 1), (1, j)
            i += 1
        else:
            yield (0, i), (1, j + 1), (1, j)
            j += 1


def _positive(name: str, value: float) -> float:
    number = check_scalar(name, value)
    if number <= 0.0:
        raise ValueError(f"{name} must be positive [m], got {number}")
    return number


def _whole(name: str, value: int) -> int:
    return check_whole(name, value, minimum=1)


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
