"""Pieces of bodies as a coarse space: compact groups of vertices, their rigid motions, and matrices reduced to these.

Z holds the twists of every piece to first order, orthonormal in the piece, without those that its vertices cannot show.
A matrix of elements is reduced by one pass over the elements of every kind. With B_a = Z_a (x) g_a of the corners
a, an element of second derivative K adds B_a^T K B_b to the block of the pieces of a and b.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from .geometry import twists
from .groups import ElementGroup
from .laws import Coupling

if TYPE_CHECKING:
    from .problem import StepProblem

__all__ = ["PieceSpace", "Pieces", "cut"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MOST = 64  # pieces of a component
SWEEPS = 6  # of Lloyd's method
WEAKEST = 0.01  # relative strength of a coupling: an edge is at most 100 times its distance long
RANK = 1e-6  # relative singular value below which the vertices of a piece do not show a twist


@dataclass(frozen=True)
class Pieces:
    """The vertices without hard pins in groups, none of which reaches over two components."""

    of: Index  # [V] number of the piece, -1 at hard pins
    count: int


def cut(problem: StepProblem, size: int = 25, most: int = MOST) -> Pieces:
    """Cut every component into pieces of about `size` vertices, and at most `most` pieces.

    Lloyd's method, with distances along the couplings of A; weak couplings are long, so that pieces follow the
    stiffness. Where pins part a component every part has a piece at least.
    """
    of, count = np.full(len(problem.positions), -1), 0
    component = problem.values.component
    for number in range(int(component.max()) + 1):
        own = np.flatnonzero(problem.free & (component == number))
        if len(own):
            wanted = int(np.clip(round(len(own) / size), 1, most))
            label = _lloyd(_lengths(problem, own), wanted)
            of[own] = count + label
            count += int(label.max()) + 1
    return Pieces(of, count)


def _lengths(problem: StepProblem, own: Index) -> csr_array:
    """Graph of the couplings of some vertices: distance / clip(strength / upper quartile, 0.01, 1) [m]."""
    matrix = coo_array(problem.matrix[own][:, own])
    apart = (matrix.row != matrix.col) & (matrix.data != 0.0)
    row, column = matrix.row[apart], matrix.col[apart]
    diagonal, rest = problem.matrix.diagonal()[own], problem.values.rest_positions[own]
    strength = np.abs(matrix.data[apart]) / np.sqrt(diagonal[row] * diagonal[column])
    strength = strength / (np.quantile(strength, 0.75) if len(strength) else 1.0)
    distance = np.linalg.norm(rest[row] - rest[column], axis=1)
    # an edge of length zero would be none
    length = np.maximum(distance, 1e-9 * distance.max(initial=0.0)) / np.clip(strength, WEAKEST, 1.0)
    return csr_array((length, (row, column)), shape=matrix.shape)


def _lloyd(graph: csr_array, wanted: int) -> Index:
    """Group of every vertex: it joins the nearest centre, then centres move to the deepest vertex of their group."""
    # neighbours in space have near numbers, so spacing the numbers spaces the centres
    centres = graph.shape[0] * (2 * np.arange(wanted) + 1) // (2 * wanted)
    for sweep in range(SWEEPS):
        label, centres = _join_nearest(graph, centres)
        if sweep + 1 < SWEEPS:
            centres = _deepest(graph, label, centres)
    return label


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

    problem: StepProblem
    pieces: Pieces
    displacement: Array  # [V, 3] m, where it was made

    @cached_property
    def modes(self) -> Array:
        """[V, 3, 6]: the modes of its piece at every vertex, orthonormal; columns beyond its rank are zero."""
        modes, y = np.zeros((len(self.displacement), 3, 6)), self.problem.positions + self.displacement
        for piece in range(self.pieces.count):
            own = np.flatnonzero(self.pieces.of == piece)
            arms = y[own] - y[own].mean(axis=0)
            length = float(np.linalg.norm(arms, axis=1).max())
            columns = twists(arms / length if length > 0.0 else arms).reshape(-1, 6)
            basis, values, _ = np.linalg.svd(columns, full_matrices=False)
            rank = int((values > RANK * values[0]).sum())
            modes[own, :, :rank] = basis[:, :rank].reshape(-1, 3, rank)
        return modes

    @cached_property
    def kept(self) -> Index:
        """[N] the columns that are not zero, of 6 a piece."""
        shown = np.zeros((self.pieces.count, 6), dtype=np.bool_)
        np.logical_or.at(shown, self.pieces.of[self.problem.free], self.modes[self.problem.free].any(axis=1))
        return np.flatnonzero(shown)

    @cached_property
    def prolongation(self) -> csr_array:
        """Z [3V, N]: it maps motions to displacements."""
        free = np.flatnonzero(self.problem.free)
        modes = self.modes[free].reshape(-1, 6)
        columns = np.repeat(6 * self.pieces.of[free], 3)[:, None] + np.arange(6)
        rows = np.broadcast_to((3 * free[:, None] + np.arange(3)).reshape(-1, 1), columns.shape)
        shape = (self.displacement.size, 6 * self.pieces.count)
        return csr_array(csr_array((modes.reshape(-1), (rows.reshape(-1), columns.reshape(-1))), shape)[:, self.kept])

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
        return self._dense(reduced)

    @cached_property
    def matrix(self) -> Array:
        """Ac = Z^T A Z [N, N] of the constant matrix."""
        reduced = self._inertia()
        for group in self.problem.groups:
            size = 3 * group.stencils.gradients.shape[2]
            reduced += self._reduced(group, (group.law.matrix_weight * group.law.measure)[:, None, None] * np.eye(size))
        return self._dense(reduced)

    def _dense(self, reduced: Array) -> Array:
        """[P, P, 6, 6] as [N, N]."""
        size = 6 * self.pieces.count
        return np.asarray(np.swapaxes(reduced, 1, 2).reshape(size, size)[np.ix_(self.kept, self.kept)])

    def _inertia(self) -> Array:
        """Z^T diag(a) Z [P, P, 6, 6]."""
        reduced = np.zeros((self.pieces.count, self.pieces.count, 6, 6))
        own = np.einsum("v,vim,vin->vmn", self.problem.weight, self.modes, self.modes)
        np.add.at(reduced, (self.pieces.of, self.pieces.of), own)  # zero at hard pins
        return reduced

    def _reduced(self, group: ElementGroup, blocks: Array, coupling: Coupling | None = None) -> Array:
        """[P, P, 6, 6] of one kind, from the second derivative [elements, 3 d, 3 d] of each by F^T."""
        corners, gradients = group.stencils.corners, group.stencils.gradients
        count, each = corners.shape
        # modes are zero at hard pins, whose piece is any
        pieces, number = self.pieces.count, np.maximum(self.pieces.of[corners], 0)
        changes = np.einsum("eak,eaim->eakim", gradients, self.modes[corners]).reshape(count, each, -1, 6)
        products = np.einsum("eajm,ejk,ebkn->eabmn", changes, blocks, changes, optimize=True)
        place = (number[:, :, None] * pieces + number[:, None, :]).reshape(-1)
        gather = csr_array((np.ones(len(place)), (place, np.arange(len(place)))), shape=(pieces**2, len(place)))
        reduced = (gather @ products.reshape(-1, 36)).reshape(pieces, pieces, 6, 6)
        if coupling is not None and coupling.factor.any():
            rows = np.swapaxes(coupling.rows, 1, 2).reshape(count, -1)
            along = np.zeros((len(coupling.factor), pieces, 6))
            np.add.at(along, (coupling.group[:, None], number), np.einsum("ej,eajm->eam", rows, changes))
            reduced = reduced + np.einsum("g,gpm,gqn->pqmn", coupling.factor, along, along, optimize=True)
        return np.asarray(reduced)
