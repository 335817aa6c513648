"""Takes the grain out of a path-traced picture, led by what the camera sees: normals and positions."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

__all__ = ["denoise"]

Image = NDArray[np.float32]

_SPLINE = (0.25, 0.5, 0.25)  # linear B-spline, the kernel of the wavelet
_NORMAL_WIDTH = 0.25  # difference of unit normals at which a neighbour counts e^-1/2
_PLANE_WIDTH = 0.01  # distance from the pixel's tangent plane, as a fraction of `size`
_COLOR_WIDTH = 0.5  # difference of radiance; halved in each pass, as the grain gets finer


def denoise(radiance: Image, normals: Image, positions: Image, *, size: float, passes: int = 5) -> Image:
    """Edge-avoiding a-trous wavelet filter (Dammertz et al. 2010): `passes` sparse 3 x 3 averages, 2^pass apart.

    A neighbour counts by how well its normal agrees and how near it lies to the pixel's tangent plane, and from the
    second pass on by its colour too, which keeps the edges of shadows. What still stands out from all of its
    neighbours at the end is cut.

    Args:
        radiance: [H, W, 3] linear.
        normals: [H, W, 3] unit.
        positions: [H, W, 3] in m.
        size: of the scene [m], which the tangent plane's tolerance follows.
    """
    color, normal, position = (
        torch.from_numpy(np.ascontiguousarray(np.moveaxis(image, -1, 0), dtype=np.float32))
        for image in (radiance, normals, positions)
    )
    for number in range(passes):
        color_width = None if number == 0 else _COLOR_WIDTH * 0.5 ** (number - 1)
        color = _filter(color, normal, position, stride=2**number, plane=_PLANE_WIDTH * size, color_width=color_width)
    return np.moveaxis(_clamp_to_neighbours(color).numpy(), 0, -1)


def _clamp_to_neighbours(color: torch.Tensor) -> torch.Tensor:
    """Cut every pixel to the range of its eight neighbours.

    Pixels across a silhouette resemble no neighbour, so the averages leave their grain: lone dots in a smooth rim.
    """
    height, width = color.shape[1:]
    wide = torch.nn.functional.pad(color[None], (1, 1, 1, 1), mode="replicate")[0]
    around = [(row, column) for row in range(3) for column in range(3) if (row, column) != (1, 1)]
    low = high = wide[:, :height, :width]
    for row, column in around:
        neighbour = wide[:, row : row + height, column : column + width]
        low, high = torch.minimum(low, neighbour), torch.maximum(high, neighbour)
    return color.clamp(low, high)


def _filter(
    color: torch.Tensor,
    normal: torch.Tensor,
    position: torch.Tensor,
    *,
    stride: int,
    plane: float,
    color_width: float | None,
) -> torch.Tensor:
    """One weighted 3 x 3 average of pixels `stride` apart, all images [3, H, W]."""
    height, width = color.shape[1:]
    wide = torch.nn.functional.pad(torch.cat([color, normal, position])[None], (stride,) * 4, mode="replicate")[0]
    total, weights = torch.zeros_like(color), torch.zeros(height, width)
    for row, row_weight in enumerate(_SPLINE):
        for column, column_weight in enumerate(_SPLINE):
            shifted = wide[:, row * stride : row * stride + height, column * stride : column * stride + width]
            other_color, other_normal, other_position = shifted[:3], shifted[3:6], shifted[6:]
            distance = ((other_position - position) * normal).sum(0)
            exponent = (distance / plane).square() + (other_normal - normal).square().sum(0) / _NORMAL_WIDTH**2
            if color_width is not None:
                exponent += (other_color - color).square().sum(0) / color_width**2
            weight = row_weight * column_weight * torch.exp(-0.5 * exponent)
            total += weight * other_color
            weights += weight
    return total / weights
