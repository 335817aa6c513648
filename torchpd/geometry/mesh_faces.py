"""Faces between tets: match them, and warn of folded, overlapping and unconnected tets."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from .mesh_checks import corner_words, determinants, has_repeated_corner, warn

__all__ = [
    "ROUNDING",
    "TET_FACES",
    "count_components",
    "match_faces",
    "merge_near",
    "mesh_components",
    "number_rows",
    "report_faces",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Face k lies opposite corner k; seen from outside its corners run counter-clockwise when the tet has positive volume.
TET_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])

# Vertices nearer than this fraction of the bounding box diagonal coincide. It is a few roundings of float32, which many
# files hold, in a box about as far from the origin as it is wide.
ROUNDING = 4.0 * float(np.finfo(np.float32).eps)
# No grid has this direction: different points project to different places.
_DIRECTION = np.array([0.8128, 0.4953, 0.3065])
# elements processed at a time, to bound memory
_CHUNK = 50_000


class Faces(NamedTuple):
    """Faces that do not belong to two tets on opposite sides; 4 e + k is face k of tet e."""

    lone: Index  # faces of one tet [n]
    crowded: int  # number of faces of three or more tets
    folded: int  # number of faces of two tets on the same side


def match_faces(tets: Index) -> tuple[Index, Mask]:
    """Order of all 4 E faces (4 e + k is face k of tet e) that puts equal ones side by side, and where each begins."""
    return _match(tets[:, TET_FACES].reshape(-1, 3))


def _match(triangles: Index) -> tuple[Index, Mask]:
    """Order that puts equal triangles side by side, whatever corner is first, and where each begins."""
    faces = np.sort(triangles, axis=1)
    order = np.lexsort((faces[:, 2], faces[:, 0] * (int(faces.max(initial=0)) + 1) + faces[:, 1]))
    faces = faces[order]
    begins = np.ones(len(faces), dtype=bool)
    begins[1:] = (faces[1:] != faces[:-1]).any(axis=1)
    return order, begins


def _is_odd(tets: Index) -> Mask:
    """Whether the corners of a face, as in `TET_FACES`, are an odd permutation of ascending ones [E, 4].

    Two tets on either side of a face list it once evenly and once oddly.
    """
    a, b, c, d = np.ascontiguousarray(tets.T)
    ab, ac, ad, bc, bd, cd = a > b, a > c, a > d, b > c, b > d, c > d
    return np.stack([bc ^ cd ^ bd, ~(ad ^ cd ^ ac), ab ^ bd ^ ad, ~(ac ^ bc ^ ab)], axis=1)


def sort_faces(tets: Index) -> Faces:
    """Match faces of tets of positive volume by one sort of 64-bit numbers.

    A number holds the upper bits of a sum of random words of the corners, the orientation, and the face. Faces with
    equal bits that are no pair with opposite orientation are compared by their corners. A pair of two different faces
    would be accepted; n^2 / 2^43 such pairs are expected among n boundary faces of a million tets.
    """
    words = corner_words(tets)
    bits = np.uint64(int(tets.size - 1).bit_length())
    one = np.uint64(1)
    upper = ~((one << (bits + one)) - one)
    keys = np.arange(tets.size, dtype=np.uint64)
    by_tet = keys.reshape(-1, 4)
    for start in range(0, len(tets), _CHUNK):
        block = slice(start, start + _CHUNK)
        w = words[block]
        sums = (w[:, 0] + w[:, 1]) + (w[:, 2] + w[:, 3])
        by_tet[block] |= ((sums[:, None] - w) & upper) | (_is_odd(tets[block]).astype(np.uint64) << bits)
    keys.sort()
    # The two orientations of a face differ in the lowest remaining bit.
    step = keys[1:] ^ keys[:-1]
    step >>= bits
    begins = np.append(True, step > one)
    ends = np.append(begins[1:], True)
    opposed = np.append((step == one) & begins[:-1] & ends[1:], False)
    lone = begins & ends
    suspects = _numbers(keys[~(lone | opposed | np.append(False, opposed[:-1]))], bits)
    alone = _numbers(keys[lone], bits)
    if not len(suspects):
        return Faces(np.sort(alone), 0, 0)
    order, begins = _match(_corners(tets, suspects))
    first = np.flatnonzero(begins)
    uses = np.diff(np.append(first, len(order)))
    tet, k = np.divmod(suspects[order], 4)
    odd = _is_odd(tets[tet])[np.arange(len(tet)), k]
    two = first[uses == 2]
    return Faces(
        lone=np.sort(np.append(alone, suspects[order[first[uses == 1]]])),
        crowded=int((uses > 2).sum()),
        folded=int((odd[two] == odd[two + 1]).sum()),
    )


def _numbers(keys: NDArray[np.uint64], bits: np.uint64) -> Index:
    return np.asarray((keys & ((np.uint64(1) << bits) - np.uint64(1))).astype(np.int64))


def _corners(tets: Index, faces: Index) -> Index:
    tet, k = np.divmod(faces, 4)
    return np.asarray(tets[tet[:, None], TET_FACES[k]])


def number_rows(rows: Array) -> Index:
    """Numbers for rows [n, 3]; equal rows have equal numbers."""
    order = np.lexsort(rows.T)
    new = np.append(True, (rows[order[1:]] != rows[order[:-1]]).any(axis=1))[: len(rows)]
    numbers = np.empty(len(rows), dtype=np.int64)
    numbers[order] = np.cumsum(new) - 1
    return numbers


def merge_near(points: Array, tolerance: float) -> Index:
    """For each point [n], the lowest number in its group; groups are connected by distances up to `tolerance`."""
    first = np.arange(len(points))
    x, y, z = ((points - points[0]) * _DIRECTION).T
    along = x + y + z  # not by a product of matrices: equal points must have equal bits
    order = np.argsort(along)
    # Near points are near in every projection: compare only neighbours along one direction.
    close = np.diff(along[order]) <= tolerance * (1.0 + 1e-3)
    suspects = order[np.append(close, False) | np.append(False, close)]
    if not len(suspects):
        return first
    number = number_rows(points[suspects])
    _, one = np.unique(number, return_index=True)
    pairs = cKDTree(points[suspects[one]]).query_pairs(tolerance, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs), dtype=np.int8), (pairs[:, 0], pairs[:, 1])), shape=2 * (len(one),))
    label = connected_components(graph, directed=False)[1][number]
    lowest = np.full(int(label.max()) + 1, len(points))
    np.minimum.at(lowest, label, suspects)
    first[suspects] = lowest[label]
    return first


def report_faces(points: Array, tets: Index) -> None:
    """Warn of tets that overlap, that touch unconnected, or whose faces do not match. All volumes are positive."""
    faces = sort_faces(tets)
    if faces.crowded:
        warn(
            f"TetMesh: {faces.crowded} of the faces belong to three tets or more, so some tets overlap; remove "
            "those that are no part of the body"
        )
    if faces.folded:
        _report_folded(points, tets, faces)
    if not len(faces.lone):
        return
    # relative to the box, so that no size overflows
    low, high = (np.array([reduce(column) for column in points.T]) for reduce in (np.min, np.max))
    size = float(np.linalg.norm(high - low))
    at_boundary = np.zeros(len(points), dtype=bool)
    at_boundary[_corners(tets, faces.lone)] = True
    vertices = np.flatnonzero(at_boundary)
    first = np.arange(len(points))
    first[vertices] = vertices[merge_near((points[vertices] - low) / size, ROUNDING)]
    # a tet smaller than the tolerance touches only itself
    lone = faces.lone[~has_repeated_corner(first[tets[faces.lone // 4]])]
    order, begins = _match(first[_corners(tets, lone)])
    alone = begins & np.append(begins[1:], True)
    if not alone.all():
        _report_unmerged(f"{int((~alone).sum())} of {len(faces.lone)}", tets, first, ROUNDING * size)
    boundary = _Boundary.of((points - low) / size, tets, lone[np.sort(order[alone])], first)
    unmatched = boundary.count_unmatched() if len(boundary.tets) else 0
    if unmatched:
        warn(
            f"TetMesh: {unmatched} of {len(faces.lone)} outer faces lie on faces with other corners, so the tets there "
            "are not connected. Vertices lie on faces or edges of other tets, or neighbours split a quadrilateral "
            "along different diagonals. Split the cells so that faces match"
        )


def _report_folded(points: Array, tets: Index, faces: Faces) -> None:
    inner = (tets.size - len(faces.lone)) // 2
    volume = float(determinants(points, tets).sum()) / 6.0
    hull = _enclosed(points, tets)
    fills = "" if hull is None else f", but enclose {hull:.4g} m^3"
    warn(
        f"TetMesh: {faces.folded} of {inner} inner faces have both of their tets on one side: the mesh is folded, and "
        f"tets overlap. Their volumes add up to {volume:.4g} m^3{fills}. No winding repairs that: move the vertices, "
        "or take the undeformed mesh"
    )


def _enclosed(points: Array, tets: Index) -> float | None:
    """Volume of a folded mesh [m^3], with inverted tets counted negative; None if no orientation is consistent.

    Two nodes represent the orientations of a tet; a face joins those that agree across it. Each component of the mesh
    gives two components of this graph, mirror images of each other. It gives one if no orientation is consistent.
    """
    order, begins = match_faces(tets)
    inner = np.flatnonzero(~begins)
    one, other = order[inner - 1], order[inner]
    odd = _is_odd(tets).reshape(-1)
    turned = odd[one] == odd[other]
    count = len(tets)
    a, b = one // 4, other // 4
    rows, columns = np.concatenate([a, a + count]), np.concatenate([b + count * turned, b + count * ~turned])
    graph = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(2 * count, 2 * count))
    label = connected_components(graph, directed=False)[1]
    here, mirrored = label[:count], label[count:]
    if (here == mirrored).any():
        return None
    signed = np.where(here < mirrored, 1.0, -1.0) * determinants(points, tets) / 6.0
    return float(np.abs(np.bincount(np.minimum(here, mirrored), weights=signed)).sum())


def mesh_components(elements: Index) -> Index:
    """Component number of each vertex [V]; vertices connected by elements [E, corners] have equal numbers."""
    count = int(elements.max()) + 1
    rows, columns = np.repeat(elements[:, 0], elements.shape[1] - 1), elements[:, 1:].reshape(-1)
    graph = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def count_components(tets: Index) -> int:
    """Number of components that share no vertices."""
    return len(np.unique(mesh_components(tets)[tets[:, 0]]))


def _report_unmerged(count: str, tets: Index, first: Index, tolerance: float) -> None:
    warn(
        f"TetMesh: {count} outer faces coincide without common vertices, so the tets there are not connected: the mesh "
        f"is in {count_components(tets)} pieces. mesh.merged() merges vertices within {tolerance:.2g} m, which leaves "
        f"{count_components(first[tets])}"
    )


class _Boundary(NamedTuple):
    """Boundary faces of one tet each, in a box of diagonal 1."""

    tets: Index  # [n] of each
    vertices: Index  # [n, 3]; coincident vertices have equal numbers
    corners: Array  # [n, 3, 3]
    normals: Array  # unit outward normal [n, 3]

    @classmethod
    def of(cls, places: Array, tets: Index, faces: Index, first: Index) -> _Boundary:
        """Boundary without faces so narrow, or tets so flat, that they touch their neighbours within rounding.

        The centroid of a triangle is a third of its height away from its edges.
        """
        vertices = _corners(tets, faces)
        corners = places[vertices]
        sides = corners[:, [1, 2, 0]] - corners
        normals = np.cross(sides[:, 0], sides[:, 1])
        areas = np.linalg.norm(normals, axis=1)
        narrowest = areas / np.linalg.norm(sides, axis=2).max(axis=1)
        lowest = determinants(places, tets[faces // 4]) / areas
        wide = np.minimum(narrowest, lowest) > 6.0 * ROUNDING
        return cls(faces[wide] // 4, first[vertices[wide]], corners[wide], normals[wide] / areas[wide, None])

    def count_unmatched(self) -> int:
        return int((self.lie_on_others() | self.reach_into_others()).sum())

    def lie_on_others(self) -> Mask:
        """Mask of faces whose centroid lies on an opposite face within rounding; both are marked."""
        sides = self.corners[:, [1, 2, 0]] - self.corners
        inwards = np.cross(self.normals[:, None], sides / np.linalg.norm(sides, axis=2, keepdims=True))
        centres = self.corners.mean(axis=1)
        found = np.zeros(len(centres), dtype=bool)
        for pairs in _near(centres, np.linalg.norm(self.corners - centres[:, None], axis=2).max(axis=1)):
            one, two = pairs[np.einsum("ij,ij->i", self.normals[pairs[:, 0]], self.normals[pairs[:, 1]]) < 0.0].T
            face, other = np.append(one, two), np.append(two, one)
            away = centres[other] - self.corners[face, 0]
            on = np.abs(np.einsum("ij,ij->i", away, self.normals[face])) <= ROUNDING
            face, other = face[on], other[on]
            for k in range(3):
                away = centres[other] - self.corners[face, k]
                on = np.einsum("ij,ij->i", away, inwards[face, k]) >= -ROUNDING
                face, other = face[on], other[on]
            found[face] = True
            found[other] = True
        return found

    def reach_into_others(self) -> Mask:
        """Mask of faces that bound a missing tet, four each, into which the tets behind them reach.

        This happens where neighbours split a bent quadrilateral along different diagonals. Any two of the four faces
        share an edge.
        """
        ends = np.sort(self.vertices[:, [1, 2, 2, 0, 0, 1]].reshape(-1, 2), axis=1)
        order = np.lexsort(ends.T)
        ends = ends[order]
        face, k = np.divmod(order, 3)
        words = corner_words(self.vertices)
        whole = words[:, 0] + words[:, 1] + words[:, 2]
        found: list[tuple[Index, NDArray[np.uint64]]] = []
        shift = 1
        while len(same := np.flatnonzero((ends[shift:] == ends[:-shift]).all(axis=1))):
            for one, two in ((same, same + shift), (same + shift, same)):
                a, b = face[one], face[two]
                apex = self.corners[b, k[two]] - self.corners[a, 0]
                inside = (np.einsum("ij,ij->i", apex, self.normals[a]) < 0) & (self.tets[a] != self.tets[b])
                found.append((a[inside], (whole[a] + words[b, k[two]])[inside]))
            shift += 1
        faces, sums = (np.concatenate(parts) for parts in zip(*found, strict=True))
        _, number, uses = np.unique(sums, return_inverse=True, return_counts=True)
        reaching = np.zeros(len(self.tets), dtype=bool)
        reaching[faces[uses[number] == 12]] = True
        return reaching


def _near(centres: Array, radii: Array) -> Iterator[Index]:
    """Pairs [n, 2] of spheres of which one holds the other's centre, once each; by powers of two of the radii."""
    octaves = np.frexp(radii)[1]
    for octave in np.unique(octaves):
        large, small = np.flatnonzero(octaves == octave), np.flatnonzero(octaves < octave)
        tree, reach = cKDTree(centres[large]), float(radii[large].max()) * (1.0 + 1e-3)
        pairs = large[tree.query_pairs(reach, output_type="ndarray")]
        yield from (pairs[start : start + _CHUNK] for start in range(0, len(pairs), _CHUNK))
        for start in range(0, len(small), _CHUNK):
            chunk = small[start : start + _CHUNK]
            found = tree.sparse_distance_matrix(cKDTree(centres[chunk]), reach, output_type="ndarray")
            yield np.stack([large[found["i"]], chunk[found["j"]]], axis=1)
