"""Closest points of segments, triangles and tetrahedra."""

from __future__ import annotations

import numpy as np
import pytest

from torchpd.geometry.closest_points import closest_points


def sampled(vertices: np.ndarray, elements: np.ndarray, steps: int) -> tuple[np.ndarray, float]:
    """Points of all elements on a barycentric grid, and how far any point of an element is from the next of them."""
    count = elements.shape[1]
    grid = np.stack(np.meshgrid(*[np.arange(steps + 1)] * (count - 1), indexing="ij"), axis=-1).reshape(-1, count - 1)
    grid = grid[grid.sum(axis=1) <= steps] / steps
    weights = np.concatenate([1.0 - grid.sum(axis=1, keepdims=True), grid], axis=1)
    corners = vertices[elements]
    longest = np.linalg.norm(corners[:, :, None] - corners[:, None], axis=3).max()
    return np.einsum("wa,eak->ewk", weights, corners).reshape(-1, 3), longest / steps


@pytest.mark.parametrize("count", [2, 3, 4])
def test_closest_of_random_elements(count: int) -> None:
    """No sample of any element is closer, and some is no farther than the spacing of samples."""
    rng = np.random.default_rng(count)
    vertices = rng.normal(size=(12, 3))
    elements = np.array([rng.choice(12, count, replace=False) for _ in range(6)])
    points = np.concatenate([rng.normal(scale=2.0, size=(40, 3)), vertices[elements].mean(axis=1)])
    found = closest_points(points, vertices, elements)
    np.testing.assert_allclose(found.weights.sum(axis=1), 1.0, rtol=1e-14)
    assert found.weights.min() >= 0.0
    held = np.einsum("pa,pak->pk", found.weights, vertices[elements[found.elements]])
    distance = np.linalg.norm(points - held, axis=1)
    np.testing.assert_allclose(found.distances, distance, atol=1e-14)
    samples, spacing = sampled(vertices, elements, 40 if count < 4 else 16)
    least = np.linalg.norm(points[:, None] - samples, axis=2).min(axis=1)
    assert (distance <= least + 1e-14).all()
    assert (distance >= least - spacing).all()


def test_large_and_small_elements_together() -> None:
    """A large triangle is found though the centres of small ones are nearer; equal distances take the first."""
    vertices = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0], [0.0, 0, 1], [0.1, 0, 1], [0, 0.1, 1]])
    found = closest_points(np.array([[4.0, 4.0, 0.5], [0.0, 0.0, 0.9]]), vertices, np.array([[3, 4, 5], [0, 1, 2]]))
    assert found.elements.tolist() == [1, 0]
    np.testing.assert_allclose(found.distances, [0.5, 0.1], rtol=1e-14)
    twice = closest_points(np.array([[1.0, 0.0, 0.0]]), vertices, np.array([[0, 1, 2], [1, 0, 2]]))
    assert twice.elements.tolist() == [0]
