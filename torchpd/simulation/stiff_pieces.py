"""Rigid coarse space of stiff pieces: their affine motions, extended into the rest of the mesh; built on the CPU.

Z has four functions per piece, 1 and X - c. Their extension to the rest of the mesh minimises the energy of A without
the elements of the pieces. Only the extension is dense; it is solved in blocks of columns.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from ..common.gpu import free_memory
from ..common.memory import host_memory
from ..scene.scene import SceneValues

__all__ = ["StiffPieces", "find_pieces"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_CONTRAST = 100.0  # least ratio of stiffnesses for pieces by default
_MOST = 256  # most pieces: 1536 unknowns of a dense solve
_BLOCK = 64  # columns per solve
_ROW = 32  # vertices of a piece per row


class StiffPieces(NamedTuple):
    """P stiff pieces in C rows of vertices, and their functions Z on all V vertices."""

    threshold: float  # stiffness [Pa] above which an element belongs to a piece
    vertices: list[Index]  # centroid of each piece
    functions: NDArray[np.floating]  # Z [V, 4 P], in the requested precision
    coarse: Array  # Z^T A Z [P, 4, P, 4] N/m
    rows: Index  # vertices of a piece, 32 per row; the last row of a piece repeats one [C, 32]
    fits: Array  # least-squares operator from positions of these vertices to coefficients of Z [C, 4, 32]
    owners: Array  # 1 where a row belongs to a piece [P, C]


def find_pieces(
    values: SceneValues,
    stiffness: Array,
    inertia: Array,
    stiffer_than: float | None,
    dtype: torch.dtype,
    device: torch.device,
) -> StiffPieces:
    """Find connected stiff elements without hard pins, and their functions.

    Args:
        values: of the scene.
        stiffness: Young's modulus of the elements [E] Pa.
        inertia: of the vertices [V] N/m, inf where pinned.
        stiffer_than: see `RigidPieces`.
        dtype: of the functions.
        device: of the functions; its free memory is checked.
    """
    threshold = _threshold(stiffness, stiffer_than)
    stiff = stiffness > threshold
    label, found, held = _label_pieces(values.tets[stiff], inertia)
    if not 1 <= found <= _MOST:
        raise ValueError(_why_not(stiffness, threshold, found, held))
    _check_free_memory(len(inertia), found, dtype, device)
    pieces = _split(label, found)
    inside = label >= 0
    strained = ~(stiff & inside[values.tets[:, 0]])
    matrix = _matrix(values, np.where(strained, stiffness, 0.0), inertia)
    motions = [_motions(values.rest_positions[piece]) for piece in pieces]
    others = np.flatnonzero(np.isfinite(inertia) & ~inside)
    functions, coarse = _functions(_placed(pieces, motions, len(inertia)), matrix, others, dtype)
    return StiffPieces(threshold, pieces, functions, coarse.reshape(found, 4, found, 4), *_fits(pieces, motions))


def _threshold(stiffness: Array, given: float | None) -> float:
    if given is not None:
        return given
    low, high = float(stiffness.min()), float(stiffness.max())
    return float(np.sqrt(low * high)) if high >= _CONTRAST * low else np.inf


def _label_pieces(tets: Index, inertia: Array) -> tuple[Index, int, int]:
    """Label of the free piece of each vertex [V], -1 elsewhere; counts of free and of pinned pieces."""
    count = len(inertia)
    first, other = np.repeat(tets[:, 0], 3), tets[:, 1:].reshape(-1)
    graph = coo_array((np.ones(len(first)), (first, other)), shape=(count, count))
    sets, label = connected_components(graph, directed=False)
    stiff, held = (np.zeros(sets, dtype=bool) for _ in range(2))
    stiff[label[tets]] = True
    held[label[np.isinf(inertia)]] = True
    free = stiff & ~held
    number = np.where(free, np.cumsum(free) - 1, -1)
    return number[label], int(free.sum()), int((stiff & held).sum())


def _split(label: Index, count: int) -> list[Index]:
    """Vertices of each label from 0 on, in ascending order."""
    ends = np.cumsum(np.bincount(label + 1, minlength=count + 1))
    return np.split(np.argsort(label, kind="stable"), ends)[1 : count + 1]


def _why_not(stiffness: Array, threshold: float, free: int, held: int) -> str:
    span = f"the elements have {stiffness.min():g} to {stiffness.max():g} Pa"
    if np.isinf(threshold):
        return (
            f"RigidPieces: stiffer_than has a default only for a stiffness ratio of {_CONTRAST:g}, and {span}; give "
            "stiffer_than [Pa], or use the simulator alone"
        )
    return (
        f"RigidPieces: there must be 1 to {_MOST} connected pieces without hard pins, got {free + held} stiffer than "
        f"{threshold:g} Pa, {held} of them with hard pins; {span}. Choose another stiffer_than [Pa], or use the "
        "simulator alone"
    )


def _check_free_memory(vertices: int, pieces: int, dtype: torch.dtype, device: torch.device) -> None:
    """Raise an error if the functions do not fit in memory; the factor of the surroundings needs more."""
    needed = 4 * vertices * pieces * dtype.itemsize
    for place in {torch.device("cpu"), device}:
        there = _memory(place)
        if needed > there:
            raise ValueError(
                f"RigidPieces: {pieces} pieces of {vertices:,} vertices need {needed:,} B of memory, and {place.type} "
                f"has {there:,} B; choose stiffer_than [Pa] for fewer pieces, or a coarser mesh"
            )


def _memory(device: torch.device) -> int:
    """Total memory of the host available to this process, or free memory of a GPU, in bytes."""
    return free_memory(device) if device.type == "cuda" else host_memory()


def _matrix(values: SceneValues, stiffness: Array, inertia: Array) -> csr_array:
    """Matrix A of projective dynamics [V, V] N/m, with zero inertia at pinned vertices."""
    corners = values.rest_positions[values.tets]
    edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    inner = np.linalg.inv(edges)
    gradients = np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)
    weight = stiffness * np.linalg.det(edges) / 6.0
    entries = weight[:, None, None] * (gradients @ gradients.transpose(0, 2, 1))
    rows, columns = np.repeat(values.tets, 4, axis=1).reshape(-1), np.tile(values.tets, (1, 4)).reshape(-1)
    elastic = coo_array((entries.reshape(-1), (rows, columns)), shape=(len(inertia), len(inertia)))
    return csr_array(elastic.tocsr() + diags_array(np.where(np.isfinite(inertia), inertia, 0.0)))


def _motions(rest: Array) -> Array:
    """Affine functions 1 and X - c of a piece [n, 4], scaled to order 1."""
    arms = rest - rest.mean(axis=0)
    return np.column_stack([np.ones(len(rest)), arms / np.abs(arms).max()])


def _placed(pieces: list[Index], motions: list[Array], count: int) -> csc_array:
    """Z on the pieces alone [V, 4 P]."""
    rows = np.repeat(np.concatenate(pieces), 4)
    columns = np.concatenate([np.tile(np.arange(4 * n, 4 * n + 4), len(piece)) for n, piece in enumerate(pieces)])
    return csc_array((np.concatenate(motions).reshape(-1), (rows, columns)), shape=(count, 4 * len(pieces)))


def _functions(
    placed: csc_array, matrix: csr_array, others: Index, dtype: torch.dtype
) -> tuple[NDArray[np.floating], Array]:
    """Z [V, 4 P] in the requested precision, and Z^T A Z [4 P, 4 P] N/m.

    On the other vertices A_oo Z_o = -A_op Z_p, so that Z^T A Z = Z_p^T (A_pp Z_p + A_po Z_o).
    """
    columns = placed.shape[1]
    functions = placed.astype(torch.empty(0, dtype=dtype).numpy().dtype).toarray(order="C")
    coarse = (placed.T @ (matrix @ placed)).toarray()
    if len(others):
        rows = matrix[others]
        pull = csc_array(rows @ placed)
        factor = splu(csc_array(rows[:, others]))
        for first in range(0, columns, _BLOCK):
            block = slice(first, first + _BLOCK)
            solved = factor.solve(-pull[:, block].toarray())
            functions[others, block] = solved
            coarse[:, block] += pull.T @ solved
    return functions, 0.5 * (coarse + coarse.T)


def _fits(pieces: list[Index], motions: list[Array]) -> tuple[Index, Array, Array]:
    """Rows, fits and owners of `StiffPieces`: the least-squares fit of Z to positions of each piece."""
    rows, fits = [], []
    for piece, motion in zip(pieces, motions, strict=True):
        room = -len(piece) % _ROW
        rows.append(np.pad(piece, (0, room), mode="edge").reshape(-1, _ROW))
        weights = np.pad(np.linalg.pinv(motion), ((0, 0), (0, room)))
        fits.append(weights.reshape(4, -1, _ROW).transpose(1, 0, 2))
    owner = np.repeat(np.arange(len(pieces)), [len(own) for own in rows])
    owners = (owner == np.arange(len(pieces))[:, None]).astype(np.float64)
    return np.concatenate(rows), np.concatenate(fits), owners
