"""Study scenes: a scene at any stiffness and resolution, its motion, and material points to follow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..api.simulator import Simulator
from ..formats.bodies import holds_body
from ..geometry import shapes
from ..geometry.tet_mesh import TetMesh
from ..geometry.tetrahedralize import tetrahedralize
from ..geometry.tri_mesh import TriMesh
from ..scene.cloth import Cloth
from ..scene.effects import Gravity, Ground, Pin, Solid
from ..scene.scene import Scene
from ..simulation.state import State

__all__ = ["SCENES", "STUDY_SCENES", "StudyScene", "study_scene"]

Array = NDArray[np.float64]

DENSITY = 1000.0  # kg/m^3
_GAP = 0.002  # m between the ground and a body before it lands
_LANDING = (0.3, -2.0, 0.0)  # m/s
_HELD = 0.1  # held part, over the height of a body
_SWING = 2.0  # m/s at its top
_THICKNESS, _AREA_DENSITY = 1e-3, 0.2  # of the sheet: m, kg/m^2


@dataclass(frozen=True)
class StudyScene:
    """A family of scenes: the same body at several stiffnesses and resolutions.

    `start(sim)` is the initial state of the motion; a single step is studied after `steps_before` steps of it.
    `probes(mesh, x)` [n, 3] m are the same material points at every resolution, from positions [V, 3].
    """

    name: str
    mesh: Callable[[int], Any]  # TetMesh, or TriMesh of cloth
    scene: Callable[..., Scene]  # (mesh, Young's modulus [Pa], poisson=)
    start: Callable[[Simulator], State]
    probes: Callable[[Any, Array], Array]
    resolution: int
    resolutions: tuple[int, ...]  # of the mesh study; the finest is its reference, a single one means no mesh study
    youngs: float  # Pa
    time_step: float  # s
    steps_before: int = 0


# ---- a beam: held at x = 0 and thrown downwards, as in the tests


def _beam_mesh(resolution: int) -> TetMesh:
    return shapes.box((1.0, 0.2, 0.2), (5 * resolution, resolution, resolution))


def _beam_scene(mesh: TetMesh, youngs: float, poisson: float = 0.0) -> Scene:
    body = Solid(mesh, youngs=youngs, poisson=poisson, density=DENSITY)
    return Scene(body, Pin(body, mesh.vertices[:, 0] == 0.0), Gravity((0.0, -9.8, 0.0)))


def _beam_start(sim: Simulator) -> State:
    state: State = sim.rest_state()
    state.velocities[..., 1] = -10.0 * state.positions[..., 0] ** 2
    return state


def _beam_probes(mesh: TetMesh, positions: Array) -> Array:
    """Points of the four edges at x = 0.2, 0.4, ... 1 m, which are vertices at every resolution."""
    rest = mesh.vertices
    fifths, edges = 5.0 * rest[:, 0], 5.0 * rest[:, 1:]
    chosen = (np.abs(fifths - fifths.round()) < 1e-9) & (fifths > 0.5) & (np.abs(edges - edges.round()) < 1e-9).all(1)
    found = np.flatnonzero(chosen)
    order = np.lexsort(rest[found].T.round(9))
    return positions[found[order]]


# ---- a sheet: hangs along x from the edge x = 0 and is thrown sideways; it stays in tension, and does not buckle


def _sheet_mesh(resolution: int) -> TriMesh:
    steps = np.linspace(0.0, 1.0, resolution + 1)
    x, z = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(resolution), np.arange(resolution), indexing="ij"))
    a = i * (resolution + 1) + j
    b, c, d = a + resolution + 1, a + resolution + 2, a + 1
    cut = ((i + j) % 2 == 1)[:, None]  # diagonals in turn
    halves = (
        np.where(cut, np.stack([a, d, b], 1), np.stack([a, c, b], 1)),
        np.where(cut, np.stack([b, d, c], 1), np.stack([a, d, c], 1)),
    )
    return TriMesh(np.stack([x, np.zeros_like(x), z], 1), np.concatenate(halves))


def _sheet_scene(mesh: TriMesh, youngs: float, poisson: float = 0.0) -> Scene:
    body = Cloth(mesh, youngs, _THICKNESS, _AREA_DENSITY, poisson=poisson, bending=1e-5)
    return Scene(body, Pin(body, mesh.vertices[:, 0] == 0.0), Gravity((9.8, 0.0, 0.0)))


def _sheet_start(sim: Simulator) -> State:
    state: State = sim.rest_state()
    state.velocities[..., 1] = 3.0 * state.positions[..., 0] ** 2
    return state


def _sheet_probes(mesh: TriMesh, positions: Array) -> Array:
    """Points of a grid of 0.2 m, which are vertices at every resolution."""
    fifths = 5.0 * mesh.vertices[:, (0, 2)]
    found = np.flatnonzero((np.abs(fifths - fifths.round()) < 1e-9).all(1) & (fifths[:, 0] > 0.5))
    return positions[found[np.lexsort(mesh.vertices[found].T.round(9))]]


# ---- a body that lands, or is held


def _landing_scene(mesh: TetMesh, youngs: float, poisson: float = 0.0) -> Scene:
    return Scene(Solid(mesh, youngs=youngs, poisson=poisson, density=DENSITY), Gravity((0.0, -9.8, 0.0)), Ground())


def _landing_start(sim: Simulator) -> State:
    state: State = sim.rest_state()
    state.velocities[:] = torch.tensor(_LANDING, dtype=sim.dtype, device=sim.device)
    return state


def _held_scene(mesh: TetMesh, youngs: float, poisson: float = 0.0) -> Scene:
    body = Solid(mesh, youngs=youngs, poisson=poisson, density=DENSITY)
    return Scene(body, Pin(body, _above_held(mesh.vertices[:, 1]) <= 0.0), Gravity((0.0, -9.8, 0.0)))


def _held_start(sim: Simulator) -> State:
    state: State = sim.rest_state()
    state.velocities[..., 0] = _SWING * _above_held(state.positions[..., 1]).clip(0.0) ** 2
    return state


def _above_held(heights: Any) -> Any:
    """0 at the top of the held part, 1 at the top of the body; for an array or a tensor."""
    low = heights.min()
    return ((heights - low) / (heights.max() - low) - _HELD) / (1.0 - _HELD)


# motions of a body, and Young's moduli at which it stands when held
SCENES: dict[str, dict[str, Any]] = {
    "lands": {"scene": _landing_scene, "start": _landing_start, "youngs": 3e4, "steps_before": 4},
    "held": {"scene": _held_scene, "start": _held_start, "youngs": 1e6},
}


def _above_ground(mesh: TetMesh) -> TetMesh:
    low, high = mesh.bounds
    return mesh.translated((0.0, _GAP - float(low[1]), 0.0)) if high[1] > low[1] else mesh


def _surface_points(mesh: TetMesh, positions: Array) -> Array:
    return positions if mesh.embedding is None else mesh.embedding.apply(positions)


def _body(name: str, shape: TetMesh | TriMesh, scene: str | None) -> StudyScene:
    """A study scene of a body one metre long, just above the ground."""
    if scene not in (None, *SCENES):
        raise ValueError(f"study: --scene must be one of {', '.join(SCENES)}, got {scene!r}")
    low, high = shape.bounds
    placed = shape.translated(-(low + high) / 2.0).scaled(1.0 / float((high - low).max()))
    lattice = isinstance(placed, TriMesh)

    def mesh(resolution: int) -> TetMesh:
        if isinstance(placed, TetMesh):
            return _above_ground(placed)
        return _above_ground(tetrahedralize(placed, cells=resolution, progress=False))

    return StudyScene(
        name, mesh, probes=_surface_points, resolution=14, resolutions=(8, 11, 16, 22) if lattice else (14,),
        time_step=1 / 60, **SCENES[scene or "lands"],
    )  # fmt: skip


def _beam(scene: str | None = None) -> StudyScene:
    if scene is not None:
        raise ValueError(f"study: --scene is for bodies (octopus or a mesh), not for the beam, got {scene!r}")
    return StudyScene(
        "beam",
        _beam_mesh,
        _beam_scene,
        _beam_start,
        _beam_probes,
        resolution=5,
        resolutions=(1, 2, 3, 4, 5, 8),
        youngs=1e6,
        time_step=1 / 30,
    )


def _sheet(scene: str | None = None) -> StudyScene:
    if scene is not None:
        raise ValueError(f"study: --scene is for bodies (octopus or a mesh), not for cloth, got {scene!r}")
    return StudyScene(
        "cloth",
        _sheet_mesh,
        _sheet_scene,
        _sheet_start,
        _sheet_probes,
        resolution=30,
        resolutions=(5, 10, 15, 20, 30, 40),
        youngs=1e7,
        time_step=1 / 60,
    )


STUDY_SCENES: dict[str, Callable[..., StudyScene]] = {  # by name, called with --scene
    "beam": _beam,
    "cloth": _sheet,
    "octopus": lambda scene=None: _body("octopus", shapes.octopus(), scene),
}


def study_scene(name: str, scene: str | None = None, poisson: float = 0.0) -> StudyScene:
    """A study scene by name, or from a mesh file (surface or tetrahedral); bodies move as one of `SCENES`."""
    studied = _study_scene(name, scene)
    return replace(studied, scene=partial(studied.scene, poisson=poisson)) if poisson else studied


def _study_scene(name: str, scene: str | None) -> StudyScene:
    if name in STUDY_SCENES:
        return STUDY_SCENES[name](scene)
    path = Path(name)
    if not path.is_file():
        raise FileNotFoundError(f"study: SUBJECT must be a mesh file or one of {', '.join(STUDY_SCENES)}, got {name}")
    shape = TetMesh.from_file(path) if holds_body("study", path) else TriMesh.from_file(path)
    return _body(path.name, shape, scene)
