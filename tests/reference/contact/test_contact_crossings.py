"""Exact signs of edges through triangles, and linking numbers."""

from __future__ import annotations

import time
from fractions import Fraction

import numpy as np
import pytest
import torch

from torchpd.geometry.crossings import orientations
from torchpd.reference.contact.crossings import crossings, linking_number
from torchpd.reference.contact.surfaces import Surfaces


def two_triangles(*corners: tuple[float, float, float], self_contact: bool = True, one: bool = False) -> int:
    """Number of crossings of two triangles [6, 3], as two bodies or as one."""
    body = torch.tensor([0] * 6 if one else [0, 0, 0, 1, 1, 1])
    surfaces = Surfaces(
        rest=torch.rand((6, 3), dtype=torch.float64, generator=torch.Generator().manual_seed(0)),
        triangles=torch.tensor([[0, 1, 2], [3, 4, 5]]),
        body=body,
        kinematic=torch.zeros(6, dtype=torch.bool),
        self_contact=torch.tensor([self_contact] * 2),
        thickness=1e-3,
        friction=torch.zeros((2, 2), dtype=torch.float64),
    )
    return len(crossings(surfaces, torch.tensor(corners, dtype=torch.float64)))


FLAT = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


def test_an_edge_through_a_triangle() -> None:
    through = (*FLAT, (0.2, 0.2, -1.0), (0.2, 0.2, 1.0), (5.0, 5.0, 1.0))
    assert two_triangles(*through) == 2  # an edge of each, or two of one
    assert two_triangles(*through, one=True) == 2
    assert two_triangles(*through, one=True, self_contact=False) == 0


@pytest.mark.parametrize(
    "other",
    [
        ((0.2, 0.2, 0.0), (0.3, 0.2, 0.0), (0.2, 0.3, 0.0)),  # coplanar, inside
        ((0.2, 0.2, 0.0), (2.0, 2.0, 0.0), (2.0, 0.2, 0.0)),  # coplanar, over the rim
        ((0.2, 0.2, 0.0), (0.2, 0.2, 1.0), (0.3, 0.2, 1.0)),  # stands on it
        ((0.0, 0.0, -1.0), (0.0, 0.0, 1.0), (-1.0, -1.0, 0.5)),  # an edge through a corner
        ((0.5, 0.5, -1.0), (0.5, 0.5, 1.0), (3.0, 3.0, 0.5)),  # an edge through an edge
        ((0.2, 0.2, 5e-324), (0.3, 0.2, 5e-324), (0.2, 0.3, 5e-324)),  # above it by the least number
    ],
)
def test_touching_is_not_crossing(other: tuple[tuple[float, float, float], ...]) -> None:
    assert two_triangles(*FLAT, *other) == 0


def test_crossing_by_an_ulp() -> None:
    """The tip is 2^-60 below the plane of a triangle far from the axes, the rest above it."""
    flat = np.array([[0.1, 0.2, 0.3], [1.3, 0.1, 0.7], [0.2, 1.1, 0.9]])
    normal = np.cross(flat[1] - flat[0], flat[2] - flat[0])
    middle = flat.mean(axis=0)
    for depth in (0, 1, 2, 4):
        tip = middle - depth * np.spacing(0.6) * np.sign(normal)
        exact = _exact_sign(*flat, tip)
        assert orientations(np.array([*flat, tip]), np.array([[0, 1, 2, 3]])).tolist() == [exact]
        count = two_triangles(*map(tuple, flat), tuple(tip), tuple(middle + normal), tuple(middle + 1.1 * normal))
        assert (count > 0) == (exact == _exact_sign(*flat, middle - normal))


def _exact_sign(*points: np.ndarray) -> int:
    """Sign of det (a - d, b - d, c - d) in rational numbers."""
    a, b, c, d = ([Fraction(float(v)) for v in point] for point in points)
    a, b, c = ([p - q for p, q in zip(of, d, strict=True)] for of in (a, b, c))
    value = sum(a[i] * (b[(i + 1) % 3] * c[(i + 2) % 3] - b[(i + 2) % 3] * c[(i + 1) % 3]) for i in range(3))
    return (value > 0) - (value < 0)


def test_signs_are_those_of_rational_numbers() -> None:
    """Random, nearly coplanar and exactly coplanar places."""
    random = np.random.default_rng(0)
    points = random.integers(-4, 5, (400, 4, 3)) / 3.0
    points[:100] += 1e-17 * random.standard_normal((100, 4, 3))
    points[100:200] *= 1e-3 * random.random((100, 1, 1))
    corners = np.arange(1600).reshape(400, 4)
    expected = [_exact_sign(*four) for four in points]
    assert orientations(points.reshape(-1, 3), corners).tolist() == expected
    assert 0 in expected


def test_a_thousand_triangles_take_a_fifth_of_a_second() -> None:
    """A folded sheet of 1152 triangles: many coplanar ones."""
    from sheets import sheet

    vertices, triangles = sheet(cells=(24, 24))
    folded = vertices.copy()
    folded[:, 1] = 0.1 * (vertices[:, 0] > 0.5)
    folded[:, 0] = np.minimum(vertices[:, 0], 1.0 - vertices[:, 0])
    surfaces = Surfaces(
        rest=torch.tensor(vertices), triangles=torch.tensor(triangles), body=torch.zeros(625, dtype=torch.int64),
        kinematic=torch.zeros(625, dtype=torch.bool), self_contact=torch.tensor([True]), thickness=1e-3,
        friction=torch.zeros((1, 1), dtype=torch.float64),
    )  # fmt: skip
    assert len(crossings(surfaces, torch.tensor(folded))) == 0
    start = time.process_time()
    assert len(crossings(surfaces, torch.tensor(folded))) == 0
    assert time.process_time() - start < 0.2
    folded[:, 1] = np.where(vertices[:, 0] > 0.5, vertices[:, 2] - 0.47, 0.0)
    assert len(crossings(surfaces, torch.tensor(folded))) > 0


@pytest.mark.parametrize("turns", [0, 1, 2, -1])
def test_linking_number(turns: int) -> None:
    """A line that winds round a circle, and closes."""
    t = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    circle = np.stack([np.cos(t), np.sin(t), 0 * t], axis=1)
    around = 1.0 + 0.3 * np.cos(turns * t)
    line = np.stack(
        [around * np.cos(t), around * np.sin(t), 0.3 * np.sin(turns * t) + (0.5 if not turns else 0)], axis=1
    )
    assert abs(linking_number(circle, line)) == abs(turns)
    assert linking_number(circle, line) == linking_number(line, circle)
    mirrored = line * [1.0, 1.0, -1.0]
    assert linking_number(circle, mirrored) == -linking_number(circle, line)
