"""The body-centred cubic lattice of tetrahedra: its tets that a surface touches, and those that it encloses.

Every tet joins the centres of two neighbouring cubes to one edge of the square between them. All tets are congruent,
with dihedral angles of 60 and 90 degrees (a cube cut into six has 45), and have no preferred diagonal.

Lengths here are in cubes: cube (i, j, k) fills [i, i + 1] x [j, j + 1] x [k, k + 1]. Corner positions are integers in
half cubes: even for cube corners, odd for cube centres. A tet is (axis, i, j, k, edge). It lies across the square
between cube (i, j, k) and the next cube along `axis`, over the edge number `edge` of that square.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

__all__ = ["Lattice", "candidates", "split_long"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Touching distance in cubes: far above rounding (1e-13 for 1000 cubes), far below any visible length.
_TOUCH = 1e-9
# Distance in cubes to look for other tets around a point: above the touching distance, far below a tet.
_NUDGE = 1e-6
# triangle-tet pairs tested at a time, to bound memory
_CHUNK = 200_000


def _axes(axis: int, edge: int) -> tuple[int, int]:
    """For an edge of the square across `axis`: the axis on whose side it lies, and the axis along which it runs."""
    across, along = (axis + 1) % 3, (axis + 2) % 3
    return (across, along) if edge < 2 else (along, across)


def _edge(axis: int, side_axis: int, side: int) -> int:
    """Number of the edge on `side` (0 low, 1 high) of `side_axis` in the square across `axis`."""
    return (0 if side_axis == (axis + 1) % 3 else 2) + side


def _corner_table() -> NDArray[np.int64]:
    """Corners [axis, edge, corner, 3] in half cubes from cube (i, j, k), of positive volume."""
    table = np.zeros((3, 4, 4, 3), dtype=np.int64)
    for axis in range(3):
        for edge in range(4):
            side_axis, along = _axes(axis, edge)
            table[axis, edge, :2] = 1
            table[axis, edge, 1, axis] += 2
            table[axis, edge, 2:, axis] = 2
            table[axis, edge, 2:, side_axis] = 2 * (edge % 2)
            table[axis, edge, 3, along] = 2
            spans = table[axis, edge, 1:] - table[axis, edge, 0]
            if np.linalg.det(spans.astype(np.float64)) < 0:
                table[axis, edge, 2:] = table[axis, edge, 3:1:-1].copy()
    return table


_CORNERS = _corner_table()
# from every corner of every kind of tet to its centroid: one direction into each tet around a vertex
_AROUND = 0.5 * (_CORNERS.mean(axis=2, keepdims=True) - _CORNERS).reshape(-1, 3)


def _apart(ours: Array, theirs: Array, axes: Array, slack: float) -> Mask:
    """Whether projections [P, axes, points] of two bodies are separated by `slack` along any axis [..., axes, 3]."""
    margin = slack * np.linalg.norm(axes, axis=-1)
    after = ours.min(axis=-1) > theirs.max(axis=-1) + margin
    before = theirs.min(axis=-1) > ours.max(axis=-1) + margin
    return np.asarray((after | before).any(axis=-1))


def _overlaps(triangles: Array, tet: Array, slack: float = _TOUCH) -> Mask:
    """Whether closed triangles [P, 3, 3] and one closed tet [4, 3] meet: separating axis theorem, all 23 axes.

    A negative slack demands that triangles enter the tet by that much, instead of touching it.

    Two convex polyhedra are separated exactly if a face normal of one of them separates them, or the cross product of
    an edge of each. A vanishing axis (a triangle without area) never separates: at worst a tet too many. The axes of
    the tet are tried first, because they are fixed and settle most pairs.
    """
    spans = tet[[1, 2, 3, 2, 3, 3]] - tet[[0, 0, 0, 1, 1, 2]]
    faces = np.cross(spans[[0, 1, 2, 3]], spans[[1, 2, 0, 4]])
    meet = ~_apart(np.swapaxes(triangles @ faces.T, 1, 2), faces @ tet.T, faces, slack)
    left = triangles[meet]
    edges = left[:, [1, 2, 0]] - left
    crossed = np.cross(edges[:, :, None], spans[None, None]).reshape(len(left), 18, 3)
    axes = np.concatenate([np.cross(edges[:, :1], edges[:, 1:2]), crossed], axis=1)
    meet[meet] = ~_apart(axes @ np.swapaxes(left, 1, 2), axes @ tet.T, axes, slack)
    return meet


def split_long(triangles: Array) -> tuple[Array, Index]:
    """Split triangles until no edge exceeds one cube; returns them and the source triangle of each.

    Halves longest edges. Both triangles of an edge cut it alike, so that a closed surface stays closed, to the bit.
    """
    done, parents = [triangles[:0]], [np.arange(0)]
    source = np.arange(len(triangles))
    while len(triangles):
        lengths = np.linalg.norm(triangles[:, [1, 2, 0]] - triangles, axis=2)
        long = lengths.max(axis=1) > 1.0
        done.append(triangles[~long])
        parents.append(source[~long])
        triangles, lengths, source = triangles[long], lengths[long], np.tile(source[long], 2)
        # Rotate each triangle so that its longest edge comes first, then halve that edge.
        turn = (np.argmax(lengths, axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(triangles, turn[:, :, None], axis=1), 1, 0)
        middle = 0.5 * (a + b)
        triangles = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    return np.concatenate(done), np.concatenate(parents)


def candidates(low: Array, high: Array, shape: tuple[int, ...]) -> tuple[Index, Index]:
    """Pairs (box number, cube index [P, 3]) for the integer points of boxes [low, high]."""
    first = np.maximum(np.ceil(low), 0).astype(np.int64)
    last = np.minimum(np.floor(high), np.array(shape) - 1).astype(np.int64)
    counts = np.maximum(last - first + 1, 0)
    totals = counts.prod(axis=1)
    box = np.repeat(np.arange(len(totals)), totals)
    within = np.arange(len(box)) - np.repeat(np.cumsum(totals) - totals, totals)
    steps = counts[box]
    k = within % steps[:, 2]
    j = within // steps[:, 2] % steps[:, 1]
    i = within // (steps[:, 2] * steps[:, 1])
    return box, first[box] + np.stack([i, j, k], axis=1)


def _neighbours(ids: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Tets on both sides of every inner face, from the tet numbers [axis, i, j, k, edge].

    A tet meets two others over the same square, and one in each of its two cubes. Around a cube edge, the squares of
    two axes meet. The outermost layer of cubes is excluded.
    """
    first, second = [], []
    for low in (0, 1):
        for high in (2, 3):
            first.append(ids[..., low].reshape(-1))
            second.append(ids[..., high].reshape(-1))

    def square(axis: int, side: int, edge: int) -> NDArray[np.int32]:
        """Tets over the square on one side (0 low, 1 high) of every inner cube."""
        low = [0 if side == 0 and other == axis else 1 for other in range(3)]
        i, j, k = (slice(first, first + count - 2) for first, count in zip(low, ids.shape[1:4], strict=True))
        return ids[axis, i, j, k, edge].reshape(-1)

    for a, b in ((0, 1), (1, 2), (2, 0)):
        for side_a in (0, 1):
            for side_b in (0, 1):
                first.append(square(a, side_a, _edge(a, b, side_b)))
                second.append(square(b, side_b, _edge(b, a, side_a)))
    return np.concatenate(first), np.concatenate(second)


@dataclass(frozen=True)
class Lattice:
    """A box of cubes in space, with two empty layers of cubes around the enclosed surface."""

    origin: Array  # lower corner of cube (0, 0, 0) [m]
    spacing: float  # edge of a cube [m]
    shape: tuple[int, int, int]  # cubes along each axis

    @classmethod
    def around(cls, low: Array, high: Array, cells: int) -> Lattice:
        """Lattice centred on a box, with `cells` along its longest side and two more on every side."""
        extent = high - low
        spacing = float(extent.max()) / cells
        # a side of a whole number of cubes up to rounding gets no further cube
        counts = np.maximum(np.ceil(extent / spacing - 1e-6), 1).astype(int) + 4
        if 24 * int(np.prod(counts)) >= 2**31:
            raise ValueError(
                f"tetrahedralize: cells={cells} asks for a lattice of {' x '.join(map(str, counts))} cubes, "
                f"the most is {2**31 // 24} in all; use fewer cells"
            )
        shape = (int(counts[0]), int(counts[1]), int(counts[2]))
        return cls(origin=0.5 * (low + high) - 0.5 * spacing * counts, spacing=spacing, shape=shape)

    def _tet_shape(self) -> tuple[int, ...]:
        return (3, *self.shape, 4)

    def coordinates(self, points: Array) -> Array:
        """Convert positions [m] to cubes."""
        return (points - self.origin) / self.spacing

    def all_tets(self) -> Index:
        """Numbers of all tets of the lattice."""
        exists = np.ones(self._tet_shape(), dtype=bool)
        exists[0, -1] = exists[1, :, -1] = exists[2, :, :, -1] = False
        return np.flatnonzero(exists)

    def mesh(self, tets: Index) -> tuple[Array, Index]:
        """Vertices [V, 3] in m, in lexicographic order, and corner numbers [E, 4] of the tets with these numbers."""
        axis, i, j, k, edge = np.unravel_index(tets, self._tet_shape())
        corners = 2 * np.stack([i, j, k], axis=1)[:, None] + _CORNERS[axis, edge]
        size = tuple(2 * n + 1 for n in self.shape)
        keys = np.ravel_multi_index(tuple(np.moveaxis(corners, 2, 0)), size)
        unique, numbers = np.unique(keys.reshape(-1), return_inverse=True)
        halves = np.stack(np.unravel_index(unique, size), axis=1)
        return self.origin + 0.5 * self.spacing * halves, numbers.reshape(-1, 4).astype(np.int64)

    def touched(self, triangles: Array, report: Callable[[Iterable[int]], Iterable[int]] = iter) -> Mask:
        """Mask of tets [axis, i, j, k, edge] that meet any of the triangles [T, 3, 3] (in m)."""
        pieces, _ = split_long(self.coordinates(triangles))
        touched = np.zeros(self._tet_shape(), dtype=bool)
        # The tets around corners and centroids of the pieces certainly touch; the others are tested.
        samples = np.concatenate([*np.moveaxis(pieces, 1, 0), pieces.mean(axis=1)])
        touched.reshape(-1)[self._locate(samples)[0]] = True
        return touched | self._meeting(pieces, ~touched, _TOUCH, report)

    def entered(self, triangles: Array, asked: Mask) -> Mask:
        """Mask of tets in `asked` that the triangles [T, 3, 3] (in m) enter; touching does not count."""
        if not asked.any():
            return np.zeros_like(asked)
        return self._meeting(split_long(self.coordinates(triangles))[0], asked, -_TOUCH, iter)

    def _meeting(
        self, pieces: Array, asked: Mask, slack: float, report: Callable[[Iterable[int]], Iterable[int]]
    ) -> Mask:
        """Mask of tets in `asked` that meet any of the small triangles (in cubes)."""
        low, high = pieces.min(axis=1) - _TOUCH, pieces.max(axis=1) + _TOUCH
        found = np.zeros_like(asked)
        for kind in report(range(12)):
            axis, edge = divmod(kind, 4)
            tet = 0.5 * _CORNERS[axis, edge]
            box, cubes = candidates(low - tet.max(axis=0), high - tet.min(axis=0), self.shape)
            unknown = asked[axis, cubes[:, 0], cubes[:, 1], cubes[:, 2], edge]
            box, cubes = box[unknown], cubes[unknown]
            for start in range(0, len(box), _CHUNK):
                chosen = slice(start, start + _CHUNK)
                at = cubes[chosen]
                hit = at[_overlaps(pieces[box[chosen]] - at[:, None], tet, slack)]
                found[axis, hit[:, 0], hit[:, 1], hit[:, 2], edge] = True
        return found

    def enclosed(self, walls: Mask) -> Mask:
        """Mask of tets that no path from outside reaches through faces between tets other than `walls`."""
        count = walls.size
        first, second = _neighbours(np.arange(count, dtype=np.int32).reshape(walls.shape))
        free = ~walls.reshape(-1)
        both = free[first] & free[second]
        first, second = first[both], second[both]
        graph = coo_array((np.ones(len(first), dtype=np.int8), (first, second)), shape=(count, count))
        region = connected_components(graph, directed=False)[1].reshape(walls.shape)
        inside = np.zeros(int(region.max()) + 1, dtype=bool)
        inside[region[:, 1:-2, 1:-2, 1:-2]] = True
        for axis in range(1, 4):  # tets of the outermost cubes, which the graph excludes, are outside
            for layer in (0, -2, -1):
                inside[np.take(region, layer, axis=axis)] = False
        return np.asarray(inside[region] & ~walls)

    def locate(self, points: Array) -> tuple[Index, Array]:
        """Number of the tet around each point (in m), and its barycentric coordinates [n, 4], none negative."""
        return self._locate(self.coordinates(points))

    def locate_among(self, points: Array, kept: Mask) -> tuple[Index, Array]:
        """As `locate`, but a point on a face, edge or vertex gets one of its tets in `kept`, if there is one.

        Rounding may then make weights negative.
        """
        place = self.coordinates(points)
        numbers, weights = self._locate(place)
        lost = np.flatnonzero(~kept.reshape(-1)[numbers])
        for step in _AROUND:
            if not len(lost):
                break
            other, _ = self._locate(place[lost] + _NUDGE * step)
            good = kept.reshape(-1)[other]
            numbers[lost[good]] = other[good]
            weights[lost[good]] = self._weights(other[good], place[lost[good]])
            lost = lost[~good]
        return numbers, weights

    def _weights(self, tets: Index, place: Array) -> Array:
        """Barycentric coordinates of points (in cubes), each in a tet of its own."""
        axis, i, j, k, edge = np.unravel_index(tets, self._tet_shape())
        corners = np.stack([i, j, k], axis=1)[:, None] + 0.5 * _CORNERS[axis, edge]
        system = np.concatenate([np.ones((len(tets), 1, 4)), np.swapaxes(corners - place[:, None], 1, 2)], axis=1)
        return np.asarray(np.linalg.solve(system, np.tile([[1.0], [0.0], [0.0], [0.0]], (len(tets), 1, 1)))[..., 0])

    def _locate(self, place: Array) -> tuple[Index, Array]:
        """Tets and barycentric coordinates of points in cubes.

        Let q be the position from the centre of the point's cube, and |q_a| >= |q_b| >= |q_c|. The tet lies across the
        square on the side of q_a, over the edge on the side of q_b. None of its weights is negative:

            1 - |q_a| - |q_b|   at that centre
            |q_a| - |q_b|       at the next centre
            |q_b| -+ q_c        at the ends of the edge along c
        """
        cube = np.floor(place).astype(np.int64)
        q = place - cube - 0.5
        order = np.argsort(-np.abs(q), axis=1, kind="stable")
        axis, side_axis, along = order.T
        rows = np.arange(len(place))
        qa, qb, qc = q[rows, axis], q[rows, side_axis], q[rows, along]
        weights = np.stack([1 - np.abs(qa) - np.abs(qb), np.abs(qa) - np.abs(qb), np.abs(qb) - qc, np.abs(qb) + qc], 1)
        cube[rows, axis] -= qa < 0
        edge = np.where(side_axis == (axis + 1) % 3, 0, 2) + (qb > 0)
        # Order the weights as the corners of the tet: low centre first, ends of the edge as in the table.
        swapped = np.where((qa < 0)[:, None], weights[:, [1, 0, 2, 3]], weights)
        ends = _CORNERS[axis, edge][rows, 2:, along]
        weights = np.where((ends[:, 0] > ends[:, 1])[:, None], swapped[:, [0, 1, 3, 2]], swapped)
        return np.ravel_multi_index((axis, *cube.T, edge), self._tet_shape()), weights
