"""Groups of tetrahedra that share the mean of their volume strain, against locking near a Poisson's ratio of 1/2.

Each group is grown from a tetrahedron over shared faces: next comes the unused neighbour that shares most faces with
the group (F-bar by patches: de Souza Neto, Pires and Owen 2005).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..geometry.mesh_faces import match_faces
from ..geometry.tet_mesh import TetMesh

__all__ = ["average_over", "check_signs", "is_lattice"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# A group holds tetrahedra of one material: bulk moduli within this factor of that of the first one.
_ALIKE = 2.0
# squared edges of a tet of the body-centred cubic lattice, over that of the longest one
_LATTICE = np.array([0.75, 0.75, 0.75, 0.75, 1.0, 1.0])


def average_over(mesh: TetMesh, bulk_modulus: Array, size: int | None) -> Index:
    """Numbers of the groups [E] of up to `size` tets, from 0; None: 2 for the lattice of `tetrahedralize`, else 4."""
    if size is None:
        size = 2 if is_lattice(mesh) else 4
    if size == 1:
        return np.arange(len(mesh.tets), dtype=np.int64)
    neighbours = _neighbours(mesh.tets, bulk_modulus)
    pairs = _grown(neighbours, len(mesh.tets), 2)
    if size == 2:
        return pairs
    # groups of four are two pairs, which a GPU computes in neighbouring lanes
    beside: list[list[int]] = [[] for _ in range(int(pairs.max()) + 1)]
    for own, others in zip(pairs, neighbours, strict=True):
        beside[own].extend(int(pairs[other]) for other in others if pairs[other] != own)
    return _grown(beside, len(beside), 2)[pairs]


def check_signs(name: str, poisson: Array, group: Index) -> None:
    """Refuse groups with Poisson's ratios of both signs, whose mean has no majoriser; `poisson` is [E] or [B, E]."""
    if not (poisson < 0.0).any():
        return
    count = int(group.max()) + 1
    for row in poisson.reshape(-1, len(group)):
        signs = (np.bincount(group[mask], minlength=count) for mask in (row < 0.0, row > 0.0))
        both = np.flatnonzero(next(signs) * next(signs))
        if both.size:
            tets = np.flatnonzero(group == both[0])
            raise ValueError(
                f"{name} must have one sign in each group of averaged tetrahedra, got {row[tets].tolist()} in "
                f"tetrahedra {tets.tolist()} ({both.size} groups in all); give Solid(averaging=) groups of one sign, "
                "or 1"
            )


def is_lattice(mesh: TetMesh) -> bool:
    """Whether all tets are those of a body-centred cubic lattice, which `tetrahedralize` makes."""
    corners = mesh.vertices[mesh.tets]
    edges = corners[:, [1, 2, 3, 2, 3, 3]] - corners[:, [0, 0, 0, 1, 1, 2]]
    squares = np.sort(np.einsum("eak,eak->ea", edges, edges), axis=1)
    return bool(np.allclose(squares / squares[:, -1:], _LATTICE, rtol=0.0, atol=1e-6))


def _neighbours(tets: Index, bulk_modulus: Array) -> list[list[int]]:
    """Neighbours of each tet over shared faces, of a similar bulk modulus."""
    order, begins = match_faces(tets)
    inner = np.flatnonzero(~begins)
    one, other = order[inner - 1] // 4, order[inner] // 4
    ratio = bulk_modulus[one] / bulk_modulus[other]
    alike = (ratio <= _ALIKE) & (ratio >= 1.0 / _ALIKE)
    ends = np.concatenate([one[alike], other[alike]])
    starts = np.concatenate([other[alike], one[alike]])
    by_tet = np.lexsort((ends, starts))
    bounds = np.cumsum(np.bincount(starts, minlength=len(tets)))[:-1]
    return [part.tolist() for part in np.split(ends[by_tet], bounds)]


def _grown(neighbours: list[list[int]], count: int, size: int) -> Index:
    """Grow groups, each from the first unused tet.

    Of neighbours that share equally many faces, that with the fewest unused neighbours comes first, then the last one.
    The first one would pair all tets of a lattice in one direction, which averages less.
    """
    group = [-1] * count
    number = 0
    for seed in range(count):
        if group[seed] >= 0:
            continue
        members = [seed]
        group[seed] = number
        while len(members) < size:
            shared: dict[int, int] = {}
            for member in members:
                for other in neighbours[member]:
                    if group[other] < 0:
                        shared[other] = shared.get(other, 0) + 1
            if not shared:
                break
            free = {tet: sum(group[other] < 0 for other in neighbours[tet]) for tet in shared}
            chosen = min(shared, key=lambda tet: (-shared[tet], free[tet], -tet))
            members.append(chosen)
            group[chosen] = number
        number += 1
    return np.array(group, dtype=np.int64)
