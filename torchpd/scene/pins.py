"""Hard pins, and the rigid motions that they leave to connected components of the mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor

__all__ = ["PIN_HARD", "PinnedComponents", "hold_exactly", "split_springs"]

PIN_HARD = "pin_hard"  # name of the buffer of a simulator

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

# pins_apart^2 of csrc/solver/coarse/sums.h
_APART = 1e-8


def split_springs(springs: Tensor) -> tuple[Tensor, Tensor]:
    """Stiffness to store [.., P] N/m, and whether each pin is hard: inf is hard and stored as 0."""
    hard = springs.isinf()
    return springs.masked_fill(hard, 0.0), hard


def hold_exactly(springs: Tensor, hard: Tensor) -> Tensor:
    """Springs [.., P] N/m for the ops: inf where a pin is hard."""
    return springs.masked_fill(hard, torch.inf)


@dataclass(frozen=True)
class PinnedComponents:
    """Pinned points of the connected components of a scene, at rest."""

    points: Array  # [P, 3] m
    component: Index  # [P] number of the component that each holds
    squares: Array  # [components] m^2, second moment by mass: mean square distance of vertices from their mean

    @staticmethod
    def of(positions: Array, masses: Array, component: Index, pin_vertices: Index) -> PinnedComponents:
        """Build it from arrays of `SceneValues`."""

        def means(values: Array) -> Array:
            total = np.bincount(component, weights=masses)
            sums = [np.bincount(component, weights=masses * column) for column in values.T]
            return np.stack(sums, axis=1) / total[:, None]

        arms = positions - means(positions)[component]
        squares = means((arms**2).sum(axis=1, keepdims=True))[:, 0]
        return PinnedComponents(positions[pin_vertices], component[pin_vertices], squares)

    def loose(self, hard: Mask) -> Mask:
        """Whether each component can move rigidly in any environment [components]; `hard` is [P] or [B, P].

        Soft pins leave a component all rigid motions. Hard ones leave it rotations if they lie at a point or along a
        line. Then at most one eigenvalue of their covariance is significant against the size of the component.
        """
        loose = np.ones(len(self.squares), dtype=np.bool_)
        if not len(self.points):
            return loose
        held, of = np.unique(self.component, return_inverse=True)
        rows = hard.reshape(-1, len(self.points))
        # distinct masks; np.unique would compare pin by pin
        distinct = {row.tobytes(): number for number, row in enumerate(np.packbits(rows, axis=1))}
        rows = rows[list(distinct.values())]
        centroid = (
            np.stack([np.bincount(of, weights=axis) for axis in self.points.T], axis=1) / np.bincount(of)[:, None]
        )
        arms = self.points - centroid[of]
        # 1, arm and arm arm^T of each pin, summed below over the hard pins of a component
        moments = np.concatenate(
            [np.ones((len(arms), 1)), arms, (arms[:, :, None] * arms[:, None, :]).reshape(-1, 9)], axis=1
        )
        columns = 13 * of[:, None] + np.arange(13)
        place = np.broadcast_to(np.arange(len(arms))[:, None], columns.shape)
        summing = csr_array((moments.ravel(), (columns.ravel(), place.ravel())), shape=(13 * len(held), len(arms)))
        sums = (summing @ rows.T.astype(np.float64)).T.reshape(len(rows), len(held), 13)
        means = sums[..., 1:] / np.maximum(sums[..., :1], 1.0)
        mean, square = means[..., :3], means[..., 3:].reshape(*means.shape[:2], 3, 3)
        spread = np.linalg.eigvalsh(square - mean[..., :, None] * mean[..., None, :])
        loose[held] = (spread[..., 1] <= _APART * self.squares[held]).any(axis=0)
        return loose
