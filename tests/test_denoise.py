"""The filter of pictures: grain goes, edges of surfaces stay."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchpd.denoise import denoise

SHAPE = (48, 64, 3)


def _floor() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Normals and positions of a flat floor seen from above."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)
    normals = np.zeros(SHAPE, dtype=np.float32)
    normals[..., 1] = 1.0
    return normals, np.stack([columns, np.zeros_like(rows), rows], axis=2)


def test_grain_goes() -> None:
    normals, positions = _floor()
    grain = np.random.default_rng(0).normal(0.5, 0.1, SHAPE).astype(np.float32)
    smooth = denoise(grain, normals, positions, size=1.0)
    assert smooth.shape == SHAPE
    # the first average leaves (3/8)^2 of the variance; four more, at most slowed by the weights of colour, do the rest
    assert smooth.std() < 0.375 * 0.1 / 2.0
    assert abs(float(smooth.mean()) - float(grain.mean())) < 0.1 / 10.0


def test_edge_between_surfaces_stays() -> None:
    normals, positions = _floor()
    color = np.full(SHAPE, 0.2, dtype=np.float32)
    normals[:, 32:] = [1.0, 0.0, 0.0]
    color[:, 32:] = 0.8
    # normals at a right angle weigh exp(-|n - m|^2 / (2 * 0.25^2)) = exp(-16) = 1.1e-7 against each other
    assert np.abs(denoise(color, normals, positions, size=1.0) - color).max() < 5 * 0.6 * 2e-7


def test_lone_bright_pixel_is_cut() -> None:
    normals, positions = _floor()
    color = np.full(SHAPE, 0.2, dtype=np.float32)
    color[20, 20] = 50.0
    normals[20, 20] = [0.0, 0.0, 1.0]  # resembles no neighbour, so no average touches it
    assert np.abs(denoise(color, normals, positions, size=1.0) - 0.2).max() < 1e-4
