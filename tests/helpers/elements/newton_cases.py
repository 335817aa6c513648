"""Steps for tests of Newton's method: chains and rods, a cloth strip, cloth that folds, a free body."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch
from cases import Array, Case, box
from iterate_cases import stirred
from runs import simulator, state_of
from sheets import cloth, surface

import torchpd as pd

STEP = 1.0 / 60.0


def chain(count: int = 12) -> Case:
    """A rod of springs and hinges that hangs in line from its first vertex."""
    vertices = np.zeros((count, 3))
    vertices[:, 1] = -0.1 * np.arange(count)
    rod = pd.Rod(vertices, youngs=1e7, radius=1e-3, density=1000.0)
    scene = pd.Scene(rod, pd.Pin(rod, [0]), pd.Gravity())
    return Case(scene, vertices, 0.0 * vertices, STEP)


def chain_displacement(case: Case) -> Array:
    """The step of the chain [V, 3]: what acts along a line is linear, so that A u = a s."""
    problem = case.problem()
    free = np.flatnonzero(problem.free)
    u = np.zeros_like(problem.positions)
    matrix = problem.matrix.toarray()[np.ix_(free, free)]
    u[free] = np.linalg.solve(matrix, (problem.weight[:, None] * problem.target)[free])
    return u


def thrown_rod() -> Case:
    """A rod of 41 vertices that is held at one end and bends: M is far from A^-1 on its pieces."""
    vertices = np.linspace((0.0, 1.0, 0.0), (1.0, 1.0, 0.0), 41)
    rod = pd.Rod(vertices, youngs=1e7, radius=5e-3)
    velocities = np.zeros_like(vertices)
    velocities[:, 1] = -2.0 * vertices[:, 0] ** 2
    return Case(pd.Scene(rod, pd.Pin(rod, [0, 1]), pd.Gravity()), vertices, velocities, STEP)


def strip() -> Case:
    """A strip of cloth, held at an end and thrown along itself: in tension the step has one minimum."""
    mesh = surface(size=(0.6, 0.1), cells=(12, 2))
    body = cloth(mesh, youngs=1e6, bending=1e-4)
    x = mesh.vertices[:, 0]
    scene = pd.Scene(body, pd.Pin(body, x == 0.0), pd.Gravity())
    velocities = np.stack([2.0 * x, np.sin(10.0 * x), 0.0 * x], axis=1)
    return Case(scene, mesh.vertices, velocities, STEP)


@cache
def falling_cloth(cells: int = 20, stretch: float = 1e4) -> Case:
    """A square metre of Y = `stretch` N/m that hangs from two corners, after 24 steps of its fall: it folds."""
    mesh = surface(cells=(cells, cells))
    body = cloth(mesh, youngs=stretch / 1e-3, bending=1e-6)
    v = mesh.vertices
    scene = pd.Scene(body, pd.Pin(body, (v[:, 0] == 0.0) & ((v[:, 2] == 0.0) | (v[:, 2] == 1.0))), pd.Gravity())
    case = Case(scene, v, 0.0 * v, STEP)
    sim = simulator(case, torch.float64, solver=pd.Multilevel(), iterations=200)
    state = state_of(case, sim)
    for _ in range(24):
        state = sim(state)
    return Case(scene, state.positions[0].numpy(), state.velocities[0].numpy(), STEP)


def free_body(**options: Any) -> Case:
    """A block in flight, stirred and turning; `options` of the solid."""
    vertices, tets = box((0.3, 0.2, 0.2), (3, 2, 2))
    body = pd.Solid(pd.TetMesh(vertices, tets), 1e6, **options)
    spin = np.cross([3.0, 5.0, -2.0], vertices)
    return stirred(Case(pd.Scene(body, pd.Gravity()), vertices, spin, STEP), size=0.002)
