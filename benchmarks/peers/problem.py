"""The problem for every simulator: a moving body held at one end, and the error of a result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import torchpd as pd
from torchpd.study.scenes import DENSITY

Array = NDArray[np.float64]
GRAVITY = -9.8  # m/s^2 along y
TIME_STEP = 1 / 30  # s


class MissingPackageError(RuntimeError):
    """A simulator is not installed; the message names the packages it needs."""


@dataclass(frozen=True)
class Problem:
    """A body whose rest shape is its start, with density 1000 kg/m^3 and Poisson ratio 0."""

    name: str
    mesh: pd.TetMesh
    youngs: float  # Pa
    velocities: Array  # [V, 3] m/s
    held: NDArray[np.int64]  # vertices that do not move
    time_step: float = TIME_STEP

    @property
    def first(self) -> Array:
        """u_0 = h v [m], the reference of errors."""
        return self.time_step * self.velocities

    def scene(self) -> pd.Scene:
        body = pd.Solid(self.mesh, youngs=self.youngs, density=DENSITY)
        return pd.Scene(body, pd.Pin(body, self.held), pd.Gravity((0.0, GRAVITY, 0.0)))

    def error(self, displacement: Array, converged: Array) -> float:
        """|u - u*| / |u_0 - u*|; inf after an overflow."""
        found = np.linalg.norm(displacement - converged) / np.linalg.norm(self.first - converged)
        return float(found) if np.isfinite(found) else np.inf


def beam(cells: int, youngs: float) -> Problem:
    """A beam of 1 x 0.2 x 0.2 m, held at x = 0, thrown downwards with v_y = -10 x^2 (rounded to float32)."""
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (5 * cells, cells, cells))
    velocities = np.zeros_like(mesh.vertices)
    velocities[:, 1] = -10.0 * mesh.vertices[:, 0] ** 2
    held = np.flatnonzero(mesh.vertices[:, 0] == 0.0)
    return Problem(f"beam of {len(mesh.vertices)} vertices", mesh, youngs, _rounded(velocities), held)


def from_file(path: str, youngs: float) -> Problem:
    """A tetrahedral mesh scaled to one metre, held at the low end of its longest side, thrown sideways."""
    mesh = pd.TetMesh.from_file(path)
    low, high = mesh.bounds
    mesh = mesh.translated(-low).scaled(1.0 / float((high - low).max()))
    size = np.ptp(mesh.vertices, axis=0)
    up = int(np.argmax(size))
    height = mesh.vertices[:, up] / size[up]
    velocities = np.zeros_like(mesh.vertices)
    velocities[:, (up + 1) % 3] = 10.0 * height**2
    held = np.flatnonzero(height < 0.05)
    velocities[held] = 0.0
    return Problem(f"{Path(path).name}, {len(height)} vertices", mesh, youngs, _rounded(velocities), held)


def _rounded(array: Array) -> Array:
    return array.astype(np.float32).astype(np.float64)


@dataclass(frozen=True)
class Method:
    """A simulator with its problem.

    `run(n)` returns the displacement [V, 3] m after n iterations (or n substeps), `milliseconds(n)` their time.
    """

    name: str
    run: Callable[[int], Array]
    milliseconds: Callable[[int], float]
    note: str = ""
