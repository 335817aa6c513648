"""What a study looks at: a scene at any stiffness and resolution, a motion of it, and points to follow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from . import shapes
from .effects import Gravity, Ground, Pin, Solid
from .mesh import TetMesh, TriMesh
from .scene import Scene
from .simulator import Simulator
from .state import State
from .tetrahedralize import tetrahedralize

__all__ = ["SUBJECTS", "Subject", "subject_of"]

Array = NDArray[np.float64]

DENSITY = 1000.0  # kg/m^3
_TETRAHEDRAL = (".mesh", ".msh", ".vtk", ".vtu")
_GAP = 0.002  # m between the ground and a body that is about to land
_LANDING = (0.3, -2.0, 0.0)  # m/s


@dataclass(frozen=True)
class Subject:
    """A family of scenes: the same body at other stiffnesses and resolutions.

    `start(sim)` is the beginning of the motion; a single step is studied after `steps_before` steps of it.
    `probes(scene, x)` [n, 3] m are the same material points at every resolution, from positions [V, 3].
    """

    name: str
    mesh: Callable[[int], TetMesh]
    scene: Callable[[TetMesh, float], Scene]  # of a Young's modulus [Pa]
    start: Callable[[Simulator], State]
    probes: Callable[[TetMesh, Array], Array]
    resolution: int
    resolutions: tuple[int, ...]  # of the study of the mesh, the finest is its reference; one: nothing to compare
    youngs: float  # Pa
    time_step: float  # s
    steps_before: int = 0


# ---- a beam: held at x = 0 and thrown downwards, as in the tests


def _beam_mesh(resolution: int) -> TetMesh:
    return shapes.box((1.0, 0.2, 0.2), (5 * resolution, resolution, resolution))


def _beam_scene(mesh: TetMesh, youngs: float) -> Scene:
    body = Solid(mesh, youngs=youngs, density=DENSITY)
    return Scene(body, Pin(body, mesh.vertices[:, 0] == 0.0), Gravity((0.0, -9.8, 0.0)))


def _beam_start(sim: Simulator) -> State:
    state = sim.rest_state()
    state.velocities[..., 1] = -10.0 * state.positions[..., 0] ** 2
    return state


def _beam_probes(mesh: TetMesh, positions: Array) -> Array:
    """The four edges at x = 0.2, 0.4, ... 1 m, which are vertices at every resolution."""
    rest = mesh.vertices
    fifths, edges = 5.0 * rest[:, 0], 5.0 * rest[:, 1:]
    chosen = (np.abs(fifths - fifths.round()) < 1e-9) & (fifths > 0.5) & (np.abs(edges - edges.round()) < 1e-9).all(1)
    found = np.flatnonzero(chosen)
    order = np.lexsort(rest[found].T.round(9))
    return positions[found[order]]


# ---- a body that lands


def _landing_scene(mesh: TetMesh, youngs: float) -> Scene:
    return Scene(Solid(mesh, youngs=youngs, density=DENSITY), Gravity((0.0, -9.8, 0.0)), Ground())


def _landing_start(sim: Simulator) -> State:
    state = sim.rest_state()
    state.velocities[:] = torch.tensor(_LANDING, dtype=sim.dtype, device=sim.device)
    return state


def _above_ground(mesh: TetMesh) -> TetMesh:
    low, high = mesh.bounds
    return mesh.translated((0.0, _GAP - float(low[1]), 0.0)) if high[1] > low[1] else mesh


def _surface_points(mesh: TetMesh, positions: Array) -> Array:
    return positions if mesh.embedding is None else mesh.embedding.apply(positions)


def _landing(name: str, shape: TetMesh | TriMesh, time_step: float) -> Subject:
    """A metre long, just above the ground."""
    low, high = shape.bounds
    placed = shape.translated(-(low + high) / 2.0).scaled(1.0 / float((high - low).max()))
    lattice = isinstance(placed, TriMesh)

    def mesh(resolution: int) -> TetMesh:
        if isinstance(placed, TetMesh):
            return _above_ground(placed)
        return _above_ground(tetrahedralize(placed, cells=resolution, progress=False))

    return Subject(
        name, mesh, _landing_scene, _landing_start, _surface_points, resolution=14,
        resolutions=(8, 11, 16, 22) if lattice else (14,), youngs=3e4, time_step=time_step, steps_before=4,
    )  # fmt: skip


SUBJECTS: dict[str, Callable[[], Subject]] = {
    "beam": lambda: Subject(
        "beam",
        _beam_mesh,
        _beam_scene,
        _beam_start,
        _beam_probes,
        resolution=5,
        resolutions=(1, 2, 3, 4, 5, 8),
        youngs=1e6,
        time_step=1 / 30,
    ),
    "octopus": lambda: _landing("octopus", shapes.octopus(), 1 / 60),
}


def subject_of(name: str) -> Subject:
    """A subject by its name, or one that lands from the file of a mesh (surface or tetrahedral)."""
    if name in SUBJECTS:
        return SUBJECTS[name]()
    path = Path(name)
    if not path.is_file():
        raise FileNotFoundError(f"study: {name} is neither a file of a mesh nor one of {', '.join(SUBJECTS)}")
    shape = TetMesh.from_file(path) if path.suffix.lower() in _TETRAHEDRAL else TriMesh.from_file(path)
    return _landing(path.name, shape, 1 / 60)
