"""Pieces of bodies as a coarse space: compact groups of vertices, their rigid motions, and matrices reduced to these.

A vertex moves by the twists of the pieces around it, with weights that add up to one, so that pieces bend into each
other. Z holds these motions to first order, orthonormal in the piece, without those that its vertices cannot show.
A matrix of elements is reduced by one pass over the elements of every kind. With B = (g (x) 1) Z of its corners, an
element of second derivative K adds B^T K B.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, coo_array, csr_array, diags_array, kron
from scipy.sparse.csgraph import dijkstra

from .geometry import twists
from .groups import ElementGroup
from .laws import Coupling

if TYPE_CHECKING:
    from .objective import Objective

__all__ = ["PieceSpace", "Pieces", "cut", "thinned"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MOST = 64  # pieces of a component
VERTEX = 4  # pieces that move a vertex, at most
LEAST = 0.1  # share of a piece in the motion of a vertex
SWEEPS = 6  # of Lloyd's method
BLEND = 2  # sweeps that blend the weights of pieces
DAMPING = 2.0 / 3.0  # of these Jacobi sweeps
WEAKEST = 0.01  # relative strength of a coupling: an edge is at most 100 times its distance long
CUT_OFF = 3.0  # a vertex is so many times as far from its centre as half of the vertices would be by strong edges
RANK = 1e-6  # relative singular value below which the vertices of a piece do not show a twist


@dataclass(frozen=True)
class Pieces:
    """The vertices without hard pins in groups, none of which reaches over two components."""

    of: Index  # [V] number of the piece, -1 at hard pins
    weights: csr_array  # [V, P] share of a piece in the motion of a vertex; rows add up to one, zero at hard pins

    @property
    def count(self) -> int:
        return int(self.weights.shape[1])


def cut(problem: Objective, size: float | None = None, most: int = MOST, blend: int = BLEND) -> Pieces:
    """Cut every component into pieces of about `size` vertices, and at most `most` pieces.

    Parts that weak couplings cut off from every centre, such as stiff grains in soft surroundings, are pieces of their
    own as long as there are fewer than `most`.

    Lloyd's method, with distances along the couplings of A; weak couplings are long, so that pieces follow the
    stiffness. Where pins part a component every part has a piece at least. `blend` Jacobi sweeps on the elastic part of
    A smooth the weights of the pieces.

    Args:
        problem: the step.
        size: vertices of a piece. None: n^(2/3) / 2 of a component of n, so that factorising the matrix of its
            2 n^(1/3) pieces takes time in proportion to n.
        most: pieces of a component.
        blend: Jacobi sweeps.
    """
    of, count = np.full(len(problem.positions), -1), 0
    component = problem.values.component
    for number in range(int(component.max()) + 1):
        own = np.flatnonzero(problem.free & (component == number))
        if len(own):
            count_of = 2.0 * np.cbrt(len(own)) if size is None else len(own) / size
            wanted = int(np.clip(round(count_of), 1, most))
            label = _lloyd(*_lengths(problem, own), wanted, most)
            of[own] = count + label
            count += int(label.max()) + 1
    return Pieces(of, _blended(problem, of, count, blend))


def _blended(problem: Objective, of: Index, count: int, sweeps: int) -> csr_array:
    """Weights [V, P] of pieces: one in each, then smoothed and scaled to add up to one."""
    free = np.flatnonzero(problem.free)
    weights = csr_array((np.ones(len(free)), (free, of[free])), shape=(len(of), count))
    elastic = csr_array(problem.matrix - diags_array(problem.weight))
    diagonal = elastic.diagonal()
    inverse = np.where(problem.free & (diagonal > 0.0), DAMPING / np.where(diagonal > 0.0, diagonal, 1.0), 0.0)
    for _ in range(sweeps):
        weights = csr_array(weights - diags_array(inverse) @ (elastic @ weights)).maximum(0.0)
        sums = np.asarray(weights.sum(axis=1)).reshape(-1)
        weights = csr_array(diags_array(1.0 / np.where(sums > 0.0, sums, 1.0)) @ weights)
    return weights


def thinned(pieces: Pieces) -> Pieces:
    """The same with shares of at least `LEAST` of each vertex, and the largest `VERTEX` of these.

    Half as many pieces strain an element then, and L-BFGS takes as many iterations.
    """
    weights = pieces.weights
    rows, columns, entries = list[int](), list[int](), list[float]()
    for vertex in range(weights.shape[0]):
        own = slice(weights.indptr[vertex], weights.indptr[vertex + 1])
        numbers, shares = weights.indices[own], weights.data[own]
        largest = enumerate(np.lexsort((numbers, -shares))[:VERTEX])
        kept = [place for rank, place in largest if rank == 0 or shares[place] >= LEAST]
        rows += [vertex] * len(kept)
        columns += [int(numbers[place]) for place in kept]
        entries += list(shares[kept] / shares[kept].sum())
    return Pieces(pieces.of, csr_array((entries, (rows, columns)), shape=weights.shape))


def _lengths(problem: Objective, own: Index) -> tuple[csr_array, csr_array]:
    """Graphs of the couplings: distance / clip(strength / upper quartile, 0.01, 1), and distance alone [m]."""
    matrix = coo_array(problem.matrix[own][:, own])
    apart = (matrix.row != matrix.col) & (matrix.data != 0.0)
    row, column = matrix.row[apart], matrix.col[apart]
    diagonal, rest = problem.matrix.diagonal()[own], problem.values.rest_positions[own]
    strength = np.abs(matrix.data[apart]) / np.sqrt(diagonal[row] * diagonal[column])
    strength = strength / (np.quantile(strength, 0.75) if len(strength) else 1.0)
    distance = np.linalg.norm(rest[row] - rest[column], axis=1)
    # an edge of length zero would be none
    distance = np.maximum(distance, 1e-9 * distance.max(initial=0.0))
    lengths = distance / np.clip(strength, WEAKEST, 1.0), distance
    graph, plain = (csr_array((length, (row, column)), shape=matrix.shape) for length in lengths)
    return graph, plain


def _lloyd(graph: csr_array, plain: csr_array, wanted: int, most: int) -> Index:
    """Group of every vertex: it joins the nearest centre, then centres move to the deepest vertex of their group."""
    # neighbours in space have near numbers, so spacing the numbers spaces the centres
    centres = graph.shape[0] * (2 * np.arange(wanted) + 1) // (2 * wanted)
    for sweep in range(SWEEPS):
        label, centres = _join_nearest(graph, centres)
        if sweep + 2 == SWEEPS:
            label, centres = _join_cut_off(graph, plain, centres, most)
        if sweep + 1 < SWEEPS:
            centres = _deepest(graph, label, centres)
    return label


def _join_cut_off(graph: csr_array, plain: csr_array, centres: Index, most: int) -> tuple[Index, Index]:
    """The same with centres for parts that are cut off, the farthest first, while there are fewer than `most`."""
    distance, before, _ = dijkstra(graph, indices=centres, min_only=True, return_predecessors=True)
    path = np.zeros(len(distance))
    for vertex in np.argsort(distance, kind="stable"):
        if before[vertex] >= 0:
            path[vertex] = path[before[vertex]] + plain[before[vertex], vertex]
    moved = np.sort(path[path > 0.0])
    farthest = CUT_OFF * moved[len(moved) // 2] if len(moved) else np.inf
    cut_off = np.flatnonzero(distance > farthest)
    for vertex in cut_off[np.argsort(-distance[cut_off], kind="stable")]:
        if len(centres) < most and distance[vertex] > farthest:
            centres = np.append(centres, vertex)
            distance = np.minimum(distance, dijkstra(graph, indices=vertex))
    return _join_nearest(graph, centres)


def _join_nearest(graph: csr_array, centres: Index) -> tuple[Index, Index]:
    """Group of every vertex, and the centres; where none can be reached the first vertex becomes one."""
    while True:
        source = dijkstra(graph, indices=centres, min_only=True, return_predecessors=True)[2]
        if (source >= 0).all():
            place = np.zeros(graph.shape[0], np.int64)
            place[centres] = np.arange(len(centres))
            return place[source], centres
        centres = np.append(centres, np.flatnonzero(source < 0)[0])


def _deepest(graph: csr_array, label: Index, centres: Index) -> Index:
    """The vertex farthest from the border of every group; without a border the centre stays."""
    edges = coo_array(graph)
    inside = label[edges.row] == label[edges.col]
    border = np.unique(edges.row[~inside])
    if not len(border):
        return centres
    within = csr_array((edges.data[inside], (edges.row[inside], edges.col[inside])), shape=graph.shape)
    depth = dijkstra(within, indices=border, min_only=True)
    reached = np.flatnonzero(np.isfinite(depth))
    # the last of a group in this order; the first vertex among equally deep ones
    order = reached[np.lexsort((-reached, depth[reached]))]
    moved = centres.copy()
    moved[label[order]] = order
    return moved


@dataclass(frozen=True)
class PieceSpace:
    """The coarse space of pieces at an iterate, and the matrices of the step reduced to it: N unknowns."""

    problem: Objective
    pieces: Pieces
    displacement: Array  # [V, 3] m, where it was made

    @cached_property
    def _modes(self) -> tuple[csr_array, Index]:
        y, weights = self.problem.positions + self.displacement, csr_array(self.pieces.weights.T)
        rows, columns, entries, of = [], [], [], list[int]()
        for piece in range(self.pieces.count):
            part = slice(weights.indptr[piece], weights.indptr[piece + 1])
            own, share = weights.indices[part], weights.data[part, None]
            arms = y[own] - (share * y[own]).sum(axis=0) / share.sum()
            length = float(np.linalg.norm(arms, axis=1).max())
            motions = share[:, None] * twists(arms / length if length > 0.0 else arms)
            basis, values, _ = np.linalg.svd(motions.reshape(-1, 6), full_matrices=False)
            shown = basis[:, values > RANK * values[0]]
            place = np.meshgrid((3 * own[:, None] + np.arange(3)).reshape(-1), len(of) + np.arange(shown.shape[1]))
            rows.append(place[0].T.reshape(-1))
            columns.append(place[1].T.reshape(-1))
            entries.append(shown.reshape(-1))
            of += [piece] * shown.shape[1]
        where = np.concatenate(rows), np.concatenate(columns)
        return csr_array((np.concatenate(entries), where), shape=(y.size, len(of))), np.array(of)

    @property
    def prolongation(self) -> csr_array:
        """Z [3V, N]: it maps motions to displacements."""
        return self._modes[0]

    @property
    def piece(self) -> Index:
        """[N] the piece of every unknown."""
        return self._modes[1]

    def restrict(self, forces: Array) -> Array:
        """Z^T f [N] of forces [V, 3] N."""
        return np.asarray(self.prolongation.T @ forces.reshape(-1))

    def prolong(self, motion: Array) -> Array:
        """Z q [V, 3] m of motions [N]."""
        return np.asarray(self.prolongation @ motion).reshape(-1, 3)

    @cached_property
    def hessian(self) -> Array:
        """Hc = Z^T H Z [N, N] at `displacement`, the Hessian of every element clamped at zero."""
        reduced = self._inertia()
        for group in self.problem.groups:
            F = group.deformation(self.displacement)
            reduced += self._reduced(group, group.law.blocks(F, positive=True), group.law.coupling(F))
        return reduced

    @cached_property
    def hessian_alone(self) -> Array:
        """The same where every element stands alone, without traces that groups share, as L-BFGS takes it."""
        reduced = self._inertia()
        for group in self.problem.groups:
            reduced += self._reduced(group, group.law.blocks_alone(group.deformation(self.displacement)))
        return reduced

    @cached_property
    def matrix(self) -> Array:
        """Ac = Z^T A Z [N, N] of the constant matrix."""
        reduced = self._inertia()
        for group in self.problem.groups:
            size = 3 * group.stencils.gradients.shape[2]
            reduced += self._reduced(group, (group.law.matrix_weight * group.law.measure)[:, None, None] * np.eye(size))
        return reduced

    def _inertia(self) -> Array:
        """Z^T diag(a) Z [N, N]."""
        z = self.prolongation
        return np.asarray((z.T @ (diags_array(np.repeat(self.problem.weight, 3)) @ z)).toarray())

    def _reduced(self, group: ElementGroup, blocks: Array, coupling: Coupling | None = None) -> Array:
        """[N, N] of one kind, from the second derivative [elements, 3 d, 3 d] of each by F^T."""
        count, size, _ = blocks.shape
        changes = csr_array(kron(group.operator, np.eye(3)) @ self.prolongation)
        second = bsr_array((blocks, np.arange(count), np.arange(count + 1)), shape=(size * count, size * count))
        reduced = changes.T @ (second @ changes)
        if coupling is not None and coupling.factor.any():
            entries, columns = np.swapaxes(coupling.rows, 1, 2).reshape(-1), np.arange(size * count)
            shape = len(coupling.factor), size * count
            along = csr_array((entries, (np.repeat(coupling.group, size), columns)), shape=shape) @ changes
            reduced = reduced + along.T @ (diags_array(coupling.factor) @ along)
        return np.asarray(reduced.toarray())
