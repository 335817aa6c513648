"""GPU benchmark scenes: bars from 64 to 4 M vertices, regular and irregular, single and in batches, with goals."""

from __future__ import annotations

import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context

import numpy as np
from numpy.typing import NDArray
from scenes import DENSITY, YOUNGS
from scipy.spatial import Delaunay

import torchpd as pd

SIZE = (1.0, 0.2, 0.2)  # m
ITERATIONS = 64
_SLAB, _MARGIN = 32, 6.0  # cells per slab of a bar, triangulated by one process, and cells that it sees beside them
_SLIVER = 0.01  # volume in cells


@dataclass(frozen=True)
class Aim:
    """Required and desired performance of an H100 in float32: minima of rates, maxima of times."""

    quantity: str  # a number of a row: a rate, or microseconds
    must: float
    stretch: float | None = None

    @property
    def is_time(self) -> bool:
        return self.quantity.endswith("microseconds")

    def share(self, value: float) -> float:
        """Fraction reached of `must`; 1 or more is good."""
        return self.must / value if self.is_time else value / self.must


def regular_bar(cells: tuple[int, int, int]) -> pd.TetMesh:
    """A bar with Kuhn's six tetrahedra per cell."""
    return pd.shapes.box(SIZE, cells)


def five_tet_bar(cells: tuple[int, int, int]) -> pd.TetMesh:
    """A bar with five tetrahedra per cell: one on alternate corners and the four others; neighbours are mirrored."""
    grid = regular_bar(cells)
    i, j, k = np.meshgrid(*(np.arange(count) for count in cells), indexing="ij")
    odd = ((i + j + k) % 2).reshape(-1, 1)
    number = np.arange(len(grid.vertices)).reshape(cells[0] + 1, cells[1] + 1, cells[2] + 1)
    corner = np.stack(
        [number[i + a, j + b, k + c].ravel() for a in range(2) for b in range(2) for c in range(2)], axis=-1
    )  # 4 a + 2 b + c
    corner = np.where(odd, corner[:, [4, 5, 6, 7, 0, 1, 2, 3]], corner)
    tets = corner[:, [[0, 3, 5, 6], [1, 0, 5, 3], [2, 0, 3, 6], [4, 0, 6, 5], [7, 3, 5, 6]]].reshape(-1, 4)
    points = grid.vertices[tets]
    volume = np.linalg.det(points[:, 1:] - points[:, :1])
    return pd.TetMesh(grid.vertices, np.where((volume < 0.0)[:, None], tets[:, [0, 2, 1, 3]], tets))


def _delaunay_slab(points: NDArray[np.float64], low: float, high: float) -> NDArray[np.int64]:
    """Delaunay tetrahedra of all points whose circumspheres have centres at low <= x < high.

    A sphere within the visible layers contains no other point, so these tetrahedra are those of the whole mesh. Spheres
    as large as the margin belong to slivers on a wall, which are removed at the end.
    """
    near = np.flatnonzero((points[:, 0] > low - _MARGIN) & (points[:, 0] < high + _MARGIN))
    tets = near[Delaunay(points[near]).simplices.astype(np.int64)]
    # in an order common to neighbouring slabs: otherwise they might round a centre to different sides
    corners = points[np.sort(tets, axis=1)]
    edges = corners[:, 1:] - corners[:, :1]
    flat = np.abs(np.linalg.det(edges)) / 6.0 <= _SLIVER
    edges[flat] = np.eye(3)
    arms = np.linalg.solve(edges, 0.5 * (edges**2).sum(axis=2, keepdims=True))[..., 0]
    centre = corners[:, 0, 0] + arms[:, 0]
    own = ~flat & (centre >= low) & (centre < high)
    if np.linalg.norm(arms[own], axis=1).max(initial=0.0) > _MARGIN:
        raise RuntimeError("_MARGIN must exceed every circumsphere, got one beyond it; raise _MARGIN")
    return tets[own]


def _in_slabs(points: NDArray[np.float64], cells: int) -> NDArray[np.int64]:
    """Delaunay tetrahedra of points with 0 <= x <= cells, by several processes; needs a `__main__` guard in scripts."""
    # a square on a wall has several triangulations with one sphere, whose centre is a multiple of 1/2
    edges = [-np.inf, *(np.arange(_SLAB, cells, _SLAB) + 0.25), np.inf]
    with ProcessPoolExecutor(min(len(edges) - 1, len(os.sched_getaffinity(0))), get_context("spawn")) as pool:
        return np.concatenate(list(pool.map(partial(_delaunay_slab, points), edges[:-1], edges[1:])))


def irregular_bar(cells: tuple[int, int, int], *, seed: int = 0) -> pd.TetMesh:
    """Delaunay tetrahedra of the cell corners, each moved by up to 0.3 of a cell, without slivers.

    Vertices have 4 to about 40 tetrahedra. Their order in memory is random, as in meshes from other software.
    """
    rng = np.random.default_rng(seed)
    axes = [np.arange(count + 1.0) for count in cells]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    shift = rng.uniform(-0.3, 0.3, points.shape)
    shift[(points == 0.0) | (points == cells)] = 0.0  # the walls stay flat
    points = rng.permutation(points + shift)
    tets = _in_slabs(points, cells[0]) if cells[0] > _SLAB else Delaunay(points).simplices.astype(np.int64)
    volume = np.linalg.det(points[tets[:, 1:]] - points[tets[:, :1]]) / 6.0
    # in units of a cell, in which Kuhn's tetrahedra have a volume of 1/6
    tets = np.where((volume < 0.0)[:, None], tets[:, [0, 2, 1, 3]], tets)[np.abs(volume) > _SLIVER]
    used, compact = np.unique(tets, return_inverse=True)
    return pd.TetMesh(points[used] / cells * SIZE, compact.reshape(-1, 4))


MESHES = {"regular": regular_bar, "irregular": irregular_bar, "five": five_tet_bar}


def _suffix(mesh: str) -> str:
    return "" if mesh == "regular" else f"-{mesh}"


@dataclass(frozen=True)
class GpuScene:
    """Copies of a bar, held at one end where it swings and bends by its weight, or free."""

    name: str
    cells: tuple[int, int, int]
    batch: int = 1
    kernel: str = "auto"
    mesh: str = "regular"
    iterations: int = ITERATIONS
    aims: tuple[Aim, ...] = ()
    heavy: bool = False  # takes minutes to prepare: only on request
    effects: bool = False  # all effects of a solid: rests on a sphere over ground, both with friction, and is damped
    loose: bool = False  # held by nothing
    ground: bool = False  # lies on a frictionless plane

    def build(self) -> pd.Scene:
        """The scene of one environment."""
        mesh = MESHES[self.mesh](self.cells)
        bar = pd.Solid(mesh, youngs=YOUNGS, density=DENSITY)
        parts = [bar, pd.Gravity((0.0, -9.81, 0.0))]
        if not self.loose:
            parts.append(pd.Pin(bar, mesh.vertices[:, 0] < 1e-9))
        if self.ground:
            parts.append(pd.Ground())
        if self.effects:
            ball = pd.Sphere((0.7 * SIZE[0], -0.1, 0.5 * SIZE[2]), 0.1, friction=0.3)
            parts += [ball, pd.Ground(height=-0.2, friction=0.3), pd.Damping(1.0)]
        return pd.Scene(*parts)

    def start(self, sim: pd.Simulator) -> pd.State:
        """At rest, with velocities v_y = -3 x^2, so that rotations are not trivial."""
        positions, velocities = sim.rest_state(self.batch)
        velocities[..., 1] = -3.0 * positions[..., 0] ** 2
        return pd.State(positions, velocities)


# vertices: cells
SMALL = {64: (3, 3, 3), 256: (15, 3, 3), 400: (15, 4, 4), 1000: (9, 9, 9)}
BATCHES = (1, 132, 1024, 8192)
BATCH_AIM = Aim("tet_iterations_per_second", 65e9, 90e9)
STEP_AIM = Aim("environment_steps_per_second", 1.5e6, 2.1e6)  # 256 vertices, 675 tetrahedra, 64 iterations
SMALL_AIM = Aim("step_microseconds", 80.0, 45.0)  # 1200 tetrahedra, 64 iterations


def _pair(name: str, cells: tuple[int, int, int], kernel: str, aim: Aim, *, heavy: bool = False) -> list[GpuScene]:
    """The regular and the irregular mesh."""
    return [
        GpuScene(name + _suffix(mesh), cells, kernel=kernel, mesh=mesh, aims=(aim,), heavy=heavy)
        for mesh in ("regular", "irregular")
    ]


def _as_many_tets(name: str, cells: tuple[int, int, int], kernel: str, aim: Aim, *, heavy: bool = False) -> GpuScene:
    """An irregular mesh with as many tetrahedra as the regular one, which has 12 % more for as many vertices."""
    return GpuScene(f"{name}-irregular-as-many-tets", cells, kernel=kernel, mesh="irregular", aims=(aim,), heavy=heavy)


def _iteration(must: float, stretch: float | None = None) -> Aim:
    # goals from prototypes that timed only iterations; the rest of a step has a column of its own
    return Aim("marginal_iteration_microseconds", must, stretch)


def _loose(name: str, cells: tuple[int, int, int], batch: int = 1, kernel: str = "auto") -> list[GpuScene]:
    """The same bar, free and on the ground."""
    return [
        GpuScene(f"{name}-{suffix}", cells, batch, kernel, loose=True, ground=suffix == "ground")
        for suffix in ("free", "ground")
    ]


GPU_SCENES = (
    *(
        GpuScene(
            f"{vertices}x{batch}{_suffix(mesh)}", cells, batch, mesh=mesh, aims=(BATCH_AIM,) if batch >= 1024 else ()
        )
        for mesh in ("regular", "irregular")
        for vertices, cells in SMALL.items()
        for batch in BATCHES
    ),
    GpuScene("256x8192-five", SMALL[256], 8192, mesh="five", aims=(BATCH_AIM, STEP_AIM)),
    *_pair("one-1200-tets", (8, 5, 5), "cluster", SMALL_AIM),
    GpuScene("one-1200-tets-five", (15, 4, 4), kernel="cluster", mesh="five", aims=(SMALL_AIM,)),
    *_pair("one-10k", (39, 15, 15), "grid", _iteration(3.0, 2.3)),
    *_pair("one-100k", (99, 31, 31), "auto", _iteration(14.0, 11.0)),
    _as_many_tets("one-100k", (94, 30, 30), "auto", _iteration(14.0, 11.0)),
    *_pair("one-1M", (255, 63, 63), "stream", _iteration(130.0, 105.0)),
    _as_many_tets("one-1M", (243, 61, 61), "stream", _iteration(130.0, 105.0)),
    GpuScene("one-1M-effects", (255, 63, 63), kernel="stream", effects=True, aims=(_iteration(360.0),)),
    *_loose("64x8192", SMALL[64], 8192),
    *_loose("256x8192", SMALL[256], 8192),
    *_loose("1000x1024", SMALL[1000], 1024),
    *_loose("one-10k", (39, 15, 15), kernel="grid"),
    *_loose("one-1M", (255, 63, 63), kernel="stream"),
    *_pair("one-4M", (1023, 63, 63), "stream", _iteration(480.0, 400.0), heavy=True),
    _as_many_tets("one-4M", (977, 61, 61), "stream", _iteration(480.0, 400.0), heavy=True),
)

QUICK_GPU_SCENES = tuple(
    GpuScene(f"tiny-{kernel}{_suffix(mesh)}", (6, 2, 2), batch, kernel, mesh, 4, (BATCH_AIM,))
    for mesh in MESHES
    for kernel, batch in (("block", 9), ("cluster", 3), ("grid", 2), ("stream", 1))
)
