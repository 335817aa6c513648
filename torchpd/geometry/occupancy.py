"""Fraction of each lattice tet inside a surface, from the crossings of the lines of a fine grid with the surface.

A surface consists of parts: connected pieces that enclose a volume each. The inside of the surface is the union of
their insides, so cavities count as filled and parts may overlap. A piece that encloses nothing is a sheet.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from .bcc_lattice import Lattice, candidates, split_long
from .mesh_checks import find_duplicates
from .mesh_faces import number_rows
from .tri_mesh import TriMesh

__all__ = ["MIN_FILL", "Parts", "inside_share", "parts_of"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Least fraction of a tet: a much softer neighbour slows every solver, and an empty one is singular.
MIN_FILL = 0.05

# Samples along the edge of a cube, 18 per tet. Even, so that none lies in a symmetry plane of the cube, and lattice
# planes have as many on either side.
_SAMPLES = 6
# a part thinner than this on average, in cubes, encloses nothing: a surface and its reverse
_THIN = 1e-3
# nearest vertices that may be merged with a vertex; the others are reached through these
_COPIES = 7
# rounding of a covered length
_TIE = 1e-3
# samples and small triangles processed at a time, to bound memory
_SLAB = 5_000_000
_CHUNK = 20_000


@dataclass(frozen=True)
class Parts:
    """Triangles of a surface by the volume that they enclose."""

    triangles: Array  # triangles of closed parts and caps [T, 3, 3] m
    part: Index  # part of each [T]
    oriented: Mask  # whether the triangles of a part have consistent winding [P]
    sheets: Array  # triangles of open parts [S, 3, 3] m
    caps: Array  # cones over holes [C, 3, 3] m, an apex each; the last of `triangles`
    own: int  # number of the surface's own triangles, the first of `triangles`
    open_edges: tuple[int, int]  # number of edges still open after closing seams, and of all edges


class _Edges(NamedTuple):
    ends: Index  # vertices of each edge [n, 2]
    triangle: Index  # one part that has it [n]
    open: Mask  # an odd number of triangles have it [n]
    turned: Mask  # its triangles run along it in unequal numbers per direction [n]


def parts_of(surface: TriMesh, tolerance: float, *, fill_holes: bool) -> Parts:
    """Split a surface into parts, and close holes by a cone over each connected piece of open edges.

    Parts that are already closed stay exact. In the others, vertices at open edges closer than `tolerance` are merged:
    files repeat vertices along seams, not always to the bit. Strips of triangles close the seams. Pieces with mostly
    open edges after that are sheets. Triangles that come from both sides count once.
    """
    same = number_rows(surface.vertices)
    triangles = surface.triangles[_without_duplicates(surface.triangles, same)]
    part = _connected(triangles, same)
    edges = _edges(triangles, same)
    closed, oriented = (np.ones(int(part.max()) + 1, dtype=bool) for _ in range(2))
    closed[part[edges.triangle[edges.open]]] = False
    oriented[part[edges.triangle[edges.turned]]] = False
    rest = ~closed[part]
    corners = surface.vertices[triangles]
    none = np.empty((0, 3, 3))
    if not rest.any():
        return Parts(corners, part, oriented, none, none, len(corners), (0, len(edges.open)))
    places, near = _merge_open_edges(surface.vertices, same, _edges(triangles[rest], same), tolerance)
    loose = triangles[rest][_without_duplicates(triangles[rest], near)]
    beside = int(closed[part[edges.triangle]].sum())
    own, edges = _connected(loose, near), _edges(loose, near)
    count = int(own.max()) + 1
    gaps = np.bincount(own[edges.triangle[edges.open]], minlength=count)
    torn = 2 * gaps > np.bincount(own[edges.triangle], minlength=count)
    whole = ~torn if fill_holes else gaps == 0
    strips, strip_of = _strips(surface.vertices, places, _edges(loose, same), own)
    cones, cone_of = _cones(places, near, edges, own)
    strips, strip_of = strips[whole[strip_of]], strip_of[whole[strip_of]]
    cones, cone_of = cones[whole[cone_of]], cone_of[whole[cone_of]]
    corners, inner = surface.vertices[loose], whole[own]
    new = np.concatenate([own[inner], strip_of, cone_of])
    return Parts(
        triangles=np.concatenate([surface.vertices[triangles[~rest]], corners[inner], strips, cones]),
        part=np.concatenate([part[~rest], len(oriented) + new]),
        oriented=np.append(oriented, np.zeros(count, dtype=bool)),
        sheets=corners[~inner],
        caps=cones,
        own=int((~rest).sum() + inner.sum()),
        open_edges=(int(edges.open.sum()), beside + len(edges.open)),
    )


def _without_duplicates(triangles: Index, same: Index) -> Mask:
    """Mask of triangles without duplicates, in parts that this closes or that consist of duplicates.

    Many models list every triangle twice, once from either side: by winding or by parity they would enclose nothing.
    """
    again = find_duplicates(same[triangles])[0]
    if again.any():
        part = _connected(triangles, same)
        edges = _edges(triangles[~again], same)
        good = np.ones(int(part.max()) + 1, dtype=bool)
        good[part[~again][edges.triangle[edges.open]]] = False
        again &= good[part] | (np.bincount(part, again) == np.bincount(part, ~again))[part]
    return ~again


def _merge_open_edges(vertices: Array, same: Index, edges: _Edges, tolerance: float) -> tuple[Array, Index]:
    """Position and number of every vertex; merged vertices have equal ones.

    Ends of open edges are merged if they are closer than `tolerance`, and than half of all edges there. So neighbours
    along a fine rim stay apart.
    """
    shortest = np.full(len(vertices), np.inf)
    lengths = np.linalg.norm(vertices[edges.ends[:, 0]] - vertices[edges.ends[:, 1]], axis=1)
    for end in (0, 1):
        np.minimum.at(shortest, same[edges.ends[:, end]], lengths)
    numbers, first = np.unique(same[edges.ends[edges.open]], return_index=True)
    points = vertices[edges.ends[edges.open].reshape(-1)[first]]
    reach = np.minimum(tolerance, 0.5 * shortest[numbers])
    distance, other = cKDTree(points).query(points, k=range(2, 2 + _COPIES), distance_upper_bound=float(reach.max()))
    near = distance <= np.minimum(reach[:, None], np.append(reach, 0.0)[other])
    one, other = np.nonzero(near)[0], other[near]
    graph = coo_array((np.ones(len(one), dtype=np.int8), (one, other)), shape=2 * (len(points),))
    cluster = connected_components(graph, directed=False)[1]
    sums = np.stack([np.bincount(cluster, weights=points[:, k]) for k in range(3)], axis=1)
    renumbered = np.arange(len(vertices))
    renumbered[numbers] = numbers[np.unique(cluster, return_index=True)[1]][cluster]
    moved = np.full((len(vertices), 3), np.nan)
    moved[numbers] = (sums / np.bincount(cluster)[:, None])[cluster]
    places = moved[same]
    return np.where(np.isnan(places), vertices, places), renumbered[same]


def _strips(vertices: Array, places: Array, edges: _Edges, part: Index) -> tuple[Array, Index]:
    """Triangles [C, 3, 3] between the open edges and the merged positions of their ends, and the part of each."""
    ends, of = edges.ends[edges.open], part[edges.triangle[edges.open]]
    (a, b), (c, d) = vertices[ends.T], places[ends.T]
    strips = np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)])
    wide = np.concatenate([(b != d).any(axis=1), (a != c).any(axis=1)])
    return strips[wide], np.tile(of, 2)[wide]


def _connected(triangles: Index, same: Index) -> Index:
    """Number of the connected piece of each triangle."""
    corners = same[triangles]
    rows, columns = corners[:, [0, 1]].reshape(-1), corners[:, [1, 2]].reshape(-1)
    count = int(same.max()) + 1
    graph = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(count, count))
    label = connected_components(graph, directed=False)[1][corners[:, 0]]
    return np.asarray(np.unique(label, return_inverse=True)[1].reshape(-1), dtype=np.int64)


def _edges(triangles: Index, same: Index) -> _Edges:
    """Edges of a surface, once each, without edges whose ends were merged."""
    ends = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    keys = same[ends]
    real = np.flatnonzero(keys[:, 0] != keys[:, 1])
    along = np.where(keys[real, 0] < keys[real, 1], 1.0, -1.0)
    low, high = np.sort(keys[real], axis=1).T
    _, first, number, uses = np.unique(
        low * (int(same.max()) + 1) + high, return_index=True, return_inverse=True, return_counts=True
    )
    turned = np.bincount(number.reshape(-1), weights=along, minlength=len(first)) != 0
    chosen = real[first]
    return _Edges(ends[chosen], chosen // 3, uses % 2 == 1, turned)


def _cones(vertices: Array, same: Index, edges: _Edges, part: Index) -> tuple[Array, Index]:
    """Triangles [C, 3, 3] that close every hole, and the part of each.

    Open edges always form closed curves, and the cone from the mean of a curve closes it.
    """
    ends, of = edges.ends[edges.open], part[edges.triangle[edges.open]]
    if not len(ends):
        return np.empty((0, 3, 3)), of
    keys = same[ends]
    count = int(same.max()) + 1
    graph = coo_array((np.ones(len(keys), dtype=np.int8), (keys[:, 0], keys[:, 1])), shape=(count, count))
    curve = connected_components(graph, directed=False)[1][keys[:, 0]]
    curve = np.unique(curve, return_inverse=True)[1].reshape(-1)
    points = vertices[ends]
    sums = np.stack([np.bincount(curve, weights=points[:, :, k].mean(axis=1)) for k in range(3)], axis=1)
    apexes = sums / np.bincount(curve)[:, None]
    return np.concatenate([points, apexes[curve][:, None]], axis=1), of


class _Intervals(NamedTuple):
    """Intervals of grid lines inside a part."""

    line: Index  # grid line, by the samples of the two other axes [n, 2]
    start: Array  # in samples
    stop: Array
    part: Index

    def where(self, chosen: Mask) -> _Intervals:
        return _Intervals(self.line[chosen], self.start[chosen], self.stop[chosen], self.part[chosen])


def inside_share(lattice: Lattice, parts: Parts, walls: Mask) -> tuple[NDArray[np.float32], Mask]:
    """Fraction of each surface tet [axis, i, j, k, edge] inside the surface; and the parts that have a volume [P]."""
    pieces, parents = split_long(lattice.coordinates(parts.triangles))
    part = parts.part[parents]
    samples = np.array(lattice.shape) * _SAMPLES
    grid = pieces * _SAMPLES - 0.5  # sample n of an axis lies at n
    found = [_intervals(grid, part, parts.oriented, axis, samples) for axis in range(3)]
    count = len(parts.oriented)
    volume = sum(np.bincount(inner.part, weights=inner.stop - inner.start, minlength=count) for inner in found) / 3.0
    area = np.linalg.norm(np.cross(grid[:, 1] - grid[:, 0], grid[:, 2] - grid[:, 0]), axis=1) / 2.0
    solid = volume > _THIN * _SAMPLES * np.bincount(part, weights=area, minlength=count)
    found = [inner.where(solid[inner.part]) for inner in found]
    share = np.zeros(walls.shape, dtype=np.float32)
    table = _half_tets()
    for slab, covered in _slabs(lattice, found):
        cubes = np.stack(np.nonzero(_cubes_of(walls)[slab]), axis=1)
        blocks = covered.reshape(-1, _SAMPLES, lattice.shape[1], _SAMPLES, lattice.shape[2], _SAMPLES)
        own = blocks.transpose(0, 2, 4, 1, 3, 5)[tuple(cubes.T)].reshape(len(cubes), _SAMPLES**3)
        halves = (own @ table).reshape(-1, 3, 2, 4)
        cubes[:, 0] += slab.start
        for axis in range(3):
            for side in (0, 1):  # a tet has the number of the lower of its two cubes
                i, j, k = (cubes - (1 - side) * (np.arange(3) == axis)).T
                share[axis, i, j, k] += halves[:, axis, side]
    return share, np.asarray(solid)


def _intervals(triangles: Array, part: Index, oriented: Mask, axis: int, samples: Index) -> _Intervals:
    """Intervals inside the surface of the grid lines along an axis.

    An oriented part is inside where its signed crossings add up to a nonzero number, so it may overlap itself. Other
    parts use the parity of the crossings.
    """
    chunks = [slice(start, start + _CHUNK) for start in range(0, len(triangles), _CHUNK)]
    found = [_crossings(triangles[chunk], axis, samples) for chunk in chunks]
    piece = np.concatenate([np.arange(0), *(c.start + f[0] for c, f in zip(chunks, found, strict=True))])
    line = np.concatenate([np.empty((0, 2), dtype=np.int64), *(f[1] for f in found)])
    depth, sign = (np.concatenate([np.empty(0), *(f[k] for f in found)]) for k in (2, 3))
    own = part[piece]
    column = line[:, 0] * samples[(axis + 2) % 3] + line[:, 1]
    order = np.lexsort((depth, column, own))
    own, column, line, depth, sign = own[order], column[order], line[order], depth[order], sign[order]
    last = np.append((own[1:] != own[:-1]) | (column[1:] != column[:-1]), True)[: len(own)]
    first = np.append(True, last[:-1])[: len(own)]
    begin = np.flatnonzero(first)[np.cumsum(first) - 1]
    total = np.cumsum(sign)
    winding = total - (total - sign)[begin]
    by_turns = (np.arange(len(own)) - begin) % 2 == 0
    inner = np.flatnonzero(np.where(oriented[own], winding != 0, by_turns) & ~last)
    return _Intervals(line[inner], depth[inner], depth[inner + 1], own[inner])


def _crossings(triangles: Array, axis: int, samples: Index) -> tuple[Index, Index, Array, Array]:
    """Triangle, grid line, depth and sign of every crossing of small triangles with grid lines along an axis.

    A line crosses a triangle if a ray from it, in the plane normal to the axis, passes an odd number of edges. Whether
    it passes an edge depends on the ends of that edge alone. So each line meets a closed surface an even number of
    times, as often from either side, also through edges and vertices.
    """
    b, c = (axis + 1) % 3, (axis + 2) % 3
    flat = triangles[:, :, [b, c]]
    low, high = (np.pad(bound, ((0, 0), (0, 1))) for bound in (flat.min(axis=1), flat.max(axis=1)))
    which, at = candidates(low, high, (int(samples[b]), int(samples[c]), 1))
    x, y = at[:, 0].astype(np.float64), at[:, 1].astype(np.float64)
    sign = np.zeros(len(which))
    for k in range(3):
        p, q = flat[which, k], flat[which, (k + 1) % 3]
        upwards = p[:, 1] <= q[:, 1]
        low, high = np.where(upwards[:, None], p, q), np.where(upwards[:, None], q, p)
        side = (high[:, 0] - low[:, 0]) * (y - low[:, 1]) - (x - low[:, 0]) * (high[:, 1] - low[:, 1])
        sign += np.where((low[:, 1] <= y) & (y < high[:, 1]) & (side > 0), np.where(upwards, 1.0, -1.0), 0.0)
    hit = sign != 0
    which, at, sign = which[hit], at[hit, :2], sign[hit]
    corners, heights = flat[which], triangles[which, :, axis]
    u, v, w = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], at - corners[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
        second = (w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0]) / area
        third = (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0]) / area
        depth = heights[:, 0] + second * (heights[:, 1] - heights[:, 0]) + third * (heights[:, 2] - heights[:, 0])
    # a triangle seen edge on has several depths; any will do
    depth = np.where(np.isfinite(depth), depth, heights[:, 0])
    return which, at, np.clip(depth, heights.min(axis=1), heights.max(axis=1)), sign


def _slabs(lattice: Lattice, found: list[_Intervals]) -> Iterator[tuple[slice, NDArray[np.float32]]]:
    """Layers of cubes, and the fraction of the small cube around each sample [x, y, z] inside any part.

    Each axis estimates it: the covered length of its grid line. A majority of axes decides between inside (more than
    half) and outside. The least certain of that majority gives the value: the line steepest to a nearby face. A single
    axis may look through a crack. One half counts as both, since a face may lie in a plane of samples.
    """
    samples = np.array(lattice.shape) * _SAMPLES
    thick = max(1, int(_SLAB // (_SAMPLES * samples[1] * samples[2])))
    for start in range(0, lattice.shape[0], thick):
        slab = slice(start, min(start + thick, lattice.shape[0]))
        low = np.array([start * _SAMPLES, 0, 0])
        counts = np.array([(slab.stop - start) * _SAMPLES, samples[1], samples[2]])
        x, y, z = (_covered(inner, axis, low, counts) for axis, inner in enumerate(found))
        less, more = np.minimum(x, y), np.maximum(x, y)
        least, most = np.minimum(less, z), np.maximum(more, z)
        middle = np.maximum(less, np.minimum(more, z))
        yield slab, np.where(least >= 0.5 - _TIE, least, np.where(most <= 0.5 + _TIE, most, middle))


def _covered(inner: _Intervals, axis: int, low: Index, counts: Index) -> NDArray[np.float32]:
    """Covered length around each sample, n - 1/2 to n + 1/2 of its grid line, in a box of samples.

    An interval adds a step up and a step down, each within the length of one sample.
    """
    others = [(axis + 1) % 3, (axis + 2) % 3]
    line = inner.line - low[others]
    chosen = ((line >= 0) & (line < counts[others])).all(axis=1)
    shape = counts + (np.arange(3) == axis) * 2
    steps = np.zeros(int(np.prod(shape)), dtype=np.float32)
    place = np.empty((int(chosen.sum()), 3), dtype=np.int64)
    place[:, others] = line[chosen]
    for ends, sign in ((inner.start, 1.0), (inner.stop, -1.0)):
        edge = np.clip(ends[chosen] - low[axis] + 0.5, 0.0, counts[axis])
        place[:, axis] = np.floor(edge)
        at, part = np.ravel_multi_index(tuple(place.T), tuple(shape)), edge - np.floor(edge)
        np.add.at(steps, at, sign * (1.0 - part))
        np.add.at(steps, at + int(np.prod(shape[axis + 1 :])), sign * part)
    covered = np.cumsum(steps.reshape(shape), axis=axis, dtype=np.float32)
    inside = covered[tuple(slice(count) for count in counts)]
    return np.clip(inside, 0.0, 1.0, out=inside)


def _cubes_of(walls: Mask) -> Mask:
    """The two cubes [i, j, k] on both sides of the square of a surface tet."""
    cubes = walls.any(axis=(0, 4))
    for axis in range(3):
        # surface tets keep two cubes away from the ends: nothing wraps around
        cubes = cubes | np.roll(walls[axis].any(axis=-1), 1, axis=axis)
    return np.asarray(cubes)


def _half_tets() -> NDArray[np.float32]:
    """Contribution of a sample of a cube [s] to the fractions of its 24 half tets [axis, side, edge].

    See `Lattice.locate`. Half tets share the samples that lie in their common faces.
    """
    q = 2 * np.stack(np.meshgrid(*3 * [np.arange(_SAMPLES)], indexing="ij"), axis=-1).reshape(-1, 3) + 1 - _SAMPLES
    table = np.zeros((len(q), 3, 2, 4))
    for axis in range(3):
        for side in (0, 1):
            for edge in range(4):
                across, along = (axis + 1) % 3, (axis + 2) % 3
                if edge >= 2:
                    across, along = along, across
                towards, aside = (2 * side - 1) * q[:, axis], (2 * (edge % 2) - 1) * q[:, across]
                table[:, axis, side, edge] = (towards >= aside) & (aside >= np.abs(q[:, along]))
    table /= table.sum(axis=(1, 2, 3), keepdims=True)
    return (table.reshape(len(q), 24) / (_SAMPLES**3 / 12)).astype(np.float32)
