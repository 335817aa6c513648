"""Irregular meshes and strips of cloth."""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay

import torchpd as tpd

from .equilibrium import Array

__all__ = ["disc", "irregular_box", "sheet", "strip"]


def irregular_box(size: tuple[float, float, float], cells: tuple[int, int, int], amount: float = 0.2) -> tpd.TetMesh:
    """A box of tetrahedra with every vertex moved at random inside its face or edge, up to `amount` of a cell."""
    mesh = tpd.shapes.box(size, cells)
    cell = np.array(size) / np.array(cells)
    noise = np.random.default_rng(0).uniform(-amount, amount, mesh.vertices.shape) * cell
    border = (mesh.vertices < 1e-9) | (mesh.vertices > np.array(size) - 1e-9)
    return tpd.TetMesh(mesh.vertices + np.where(border, 0.0, noise), mesh.tets)


def _delaunay(points: Array) -> tpd.TriMesh:
    """Delaunay triangles of points in the plane of x and z, without flat ones at the border."""
    triangles = Delaunay(points).simplices
    a, b, c = (points[triangles[:, i]] for i in range(3))
    areas = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    kept = np.abs(areas) > 1e-6 * np.abs(areas).max()
    vertices = np.stack([points[:, 0], np.zeros(len(points)), points[:, 1]], axis=1)
    return tpd.TriMesh(vertices, triangles[kept], drop_unreferenced=True)


def strip(kind: str, length: float, width: float, cells: int) -> tpd.TriMesh:
    """A strip along x from -dx to `length`, dx = length / cells, with rows of vertices at -dx and 0.

    `kind`: "alternating" or "same" diagonals of a grid, "equilateral", or Delaunay triangles of their vertices moved
    at random by up to a fifth of a cell: "grid, moved" or "equilateral, moved".
    """
    dx, across = length / cells, max(1, round(width * cells / length))
    if kind in ("alternating", "same"):
        return sheet((length + dx, width), (cells + 1, across), alternating=kind == "alternating", origin=-dx)
    if kind.startswith("equilateral"):
        return _equilateral(length, width, cells, 0.2 if kind.endswith("moved") else 0.0)
    x, z = np.meshgrid(np.linspace(-dx, length, cells + 2), np.linspace(0.0, width, across + 1), indexing="ij")
    noise = np.random.default_rng(1).uniform(-0.2, 0.2, (2, *x.shape)) * np.array([dx, width / across])[:, None, None]
    inner_x, inner_z = (x > 0.5 * dx) & (x < length - 0.5 * dx), (z > 0.0) & (z < width)
    points = np.stack([x + noise[0] * inner_x, z + noise[1] * inner_z], axis=2)
    return _delaunay(points.reshape(-1, 2))


def _equilateral(length: float, width: float, cells: int, amount: float) -> tpd.TriMesh:
    """Columns at distance dx across x, every second one shifted by half an edge; edges of 2 dx / sqrt 3 along z."""
    dx = length / cells
    edge = 2.0 * dx / np.sqrt(3.0)
    across = max(2, round(width / edge))
    rng, points = np.random.default_rng(1), []
    for column in range(cells + 2):
        z = edge * np.arange(across + 1)
        if column % 2:
            z = np.concatenate([[0.0], z[:-1] + 0.5 * edge, [z[-1]]])
        inner = (z > 1e-9) & (z < z[-1] - 1e-9) & (1 < column < cells + 1)
        moved = amount * dx * rng.uniform(-1.0, 1.0, (len(z), 2)) * inner[:, None]
        points.append(np.stack([np.full(len(z), (column - 1) * dx), z], axis=1) + moved)
    return _delaunay(np.concatenate(points))


def sheet(
    size: tuple[float, float], cells: tuple[int, int], *, alternating: bool = True, origin: float = 0.0
) -> tpd.TriMesh:
    """A grid of right triangles in the plane of x and z, x from `origin`."""
    x, z = (np.linspace(0.0, length, count + 1) for length, count in zip(size, cells, strict=True))
    vertices = np.stack([np.repeat(x + origin, len(z)), np.zeros(len(x) * len(z)), np.tile(z, len(x))], axis=1)
    i, j = (index.reshape(-1) for index in np.meshgrid(*(np.arange(count) for count in cells), indexing="ij"))
    a = i * (cells[1] + 1) + j
    b, c, d = a + cells[1] + 1, a + cells[1] + 2, a + 1
    even = np.stack([np.stack([a, c, b], axis=1), np.stack([a, d, c], axis=1)], axis=1)
    odd = np.stack([np.stack([a, d, b], axis=1), np.stack([b, d, c], axis=1)], axis=1)
    turned = ((i + j) % 2 == 1) & alternating
    return tpd.TriMesh(vertices, np.where(turned[:, None, None], odd, even).reshape(-1, 3))


def disc(radius: float, support: float, edge: float) -> tpd.TriMesh:
    """An irregular disc: rings of vertices at both radii, and points between moved at random by a fifth of an edge."""
    rng = np.random.default_rng(2)
    rings = [np.zeros((1, 2))]
    counts = [max(2, round(support / edge)), max(2, round((radius - support) / edge))]
    radii = [*np.linspace(0.0, support, counts[0] + 1)[1:], *np.linspace(support, radius, counts[1] + 1)[1:]]
    for r in radii:
        number = max(6, round(2.0 * np.pi * r / edge))
        angle = 2.0 * np.pi * (np.arange(number) + rng.uniform()) / number
        fixed = np.isclose(r, support) or np.isclose(r, radius)
        moved = 0.2 * edge * rng.uniform(-1.0, 1.0, (2, number)) * (not fixed)
        out, turn = r + moved[0], angle + moved[1] / r
        rings.append(np.stack([out * np.cos(turn), out * np.sin(turn)], axis=1))
    return _delaunay(np.concatenate(rings))
