"""The problems for every simulator: a moving body or sheet, held somewhere, and the error of a result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

import torchpd as pd
from torchpd.scene.solvers import Solver
from torchpd.study.scenes import DENSITY

from ..mechanics.meshes import sheet

Array = NDArray[np.float64]
GRAVITY = -9.8  # m/s^2 along y
TIME_STEP = 1 / 30  # s
THICKNESS, AREA_DENSITY = 1e-3, 0.2  # of cloth: m, kg/m^2
SHEET_CELLS = 30  # along an edge of one metre


class MissingPackageError(RuntimeError):
    """A simulator is not installed; the message names the packages it needs."""


@dataclass(frozen=True)
class Problem:
    """A body whose rest shape is its start, with density 1000 kg/m^3 and Poisson ratio 0."""

    name: str
    mesh: pd.TetMesh | pd.TriMesh
    youngs: float  # in `unit`
    velocities: Array  # [V, 3] m/s
    held: NDArray[np.int64]  # vertices that do not move
    time_step: float = TIME_STEP
    gravity: tuple[float, float, float] = (0.0, GRAVITY, 0.0)
    unit: ClassVar[str] = "Pa"
    # the solver of the converged step, and its iterations
    exact: ClassVar[tuple[Solver, int]] = (pd.Multilevel(), 400)

    @property
    def start(self) -> Array:
        """Positions [V, 3] m where the step starts."""
        return self.mesh.vertices

    @property
    def first(self) -> Array:
        """u_0 = h v [m], the reference of errors."""
        return self.time_step * self.velocities

    def body(self) -> pd.Solid | pd.Cloth:
        assert isinstance(self.mesh, pd.TetMesh)
        return pd.Solid(self.mesh, youngs=self.youngs, density=DENSITY)

    def scene(self) -> pd.Scene:
        body = self.body()
        return pd.Scene(body, pd.Pin(body, self.held), pd.Gravity(self.gravity))

    def error(self, displacement: Array, converged: Array) -> float:
        """|u - u*| / |u_0 - u*|; inf after an overflow."""
        found = np.linalg.norm(displacement - converged) / np.linalg.norm(self.first - converged)
        return float(found) if np.isfinite(found) else np.inf


@dataclass(frozen=True)
class Sheet(Problem):
    """Cloth that is flat at rest, of 0.2 kg/m^2; `youngs` is Young's modulus times thickness [N/m]."""

    bending: float = 0.0  # flexural rigidity [N m]
    initial: Array | None = None  # [V, 3] m, where the step starts; None: at rest
    unit: ClassVar[str] = "N/m"
    # Multilevel ends in another minimum of one of the folded sheets
    exact: ClassVar[tuple[Solver, int]] = (pd.Chebyshev(), 40_000)

    @property
    def start(self) -> Array:
        return self.mesh.vertices if self.initial is None else self.initial

    def body(self) -> pd.Cloth:
        assert isinstance(self.mesh, pd.TriMesh)
        return pd.Cloth(
            self.mesh, self.youngs / THICKNESS, THICKNESS, AREA_DENSITY, poisson=0.0, bending=self.bending
        )  # fmt: skip


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


def hanging(youngs: float) -> Sheet:
    """A square metre that hangs along x from the edge x = 0, in tension, thrown with v_y = 3 x^2."""
    mesh = sheet((1.0, 1.0), (SHEET_CELLS, SHEET_CELLS))
    x = mesh.vertices[:, 0]
    velocities = np.zeros_like(mesh.vertices)
    velocities[:, 1] = 3.0 * x**2
    return Sheet(
        "hanging cloth", mesh, youngs, _rounded(velocities), np.flatnonzero(x == 0.0), 1 / 60,
        gravity=(-GRAVITY, 0.0, 0.0), bending=1e-8 * youngs,
    )  # fmt: skip


def folded(youngs: float) -> Sheet:
    """A square metre held at two corners, at the 25th step of its fall from the horizontal."""
    mesh = sheet((1.0, 1.0), (SHEET_CELLS, SHEET_CELLS))
    x, _, z = mesh.vertices.T
    held = np.flatnonzero((x == 0.0) & ((z == 0.0) | (z == 1.0)))
    still = np.zeros_like(mesh.vertices)
    flat = Sheet("folded cloth", mesh, youngs, still, held, 1 / 60, bending=1e-6)
    sim = pd.Simulator(flat.scene(), flat.time_step, 4000, pd.Chebyshev(), torch.float64, progress=False)
    with torch.no_grad():
        end = sim.rollout(sim.rest_state(), 24, every=24).state()
    return replace(flat, initial=_rounded(end.positions[0].numpy()), velocities=_rounded(end.velocities[0].numpy()))


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
