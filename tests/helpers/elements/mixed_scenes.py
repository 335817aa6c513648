"""Scenes with stencils of every kind, alone and together with solids, from deformed and moving states."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from cases import Case, box
from iterate_cases import stirred
from sheets import cloth, surface

import torchpd as pd


def _case(*parts: object) -> Case:
    scene = pd.Scene(*parts)  # type: ignore[arg-type]
    rest = scene.values().rest_positions
    return stirred(Case(scene, rest, 0.0 * rest, 1.0 / 60.0), size=0.002)


def _block(**options: Any) -> pd.Solid:
    return pd.Solid(pd.TetMesh(*box((0.3, 0.2, 0.2), (3, 2, 2))), 2e5, **options)


def block_case(**options: Any) -> Case:
    """A held block; `options` of the solid."""
    body = _block(**options)
    return _case(body, pd.Pin(body, body.mesh.vertices[:, 0] == 0.0), pd.Gravity())


def sheet_case(cells: tuple[int, int] = (6, 5), **options: Any) -> Case:
    """Cloth held at an edge: triangles, hinges with a curvature at rest, threads."""
    mesh = surface(size=(0.6, 0.5), cells=cells)
    body = cloth(mesh, bending=1e-4, rest_curvature=0.5, warp=200.0, weft=50.0, grain=(1.0, 0.0, 0.3), **options)
    return _case(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity((1.0, -9.8, 0.5)), pd.Damping(1.0))


def free_sheet() -> Case:
    """Cloth that falls on a ground and a ball with friction."""
    body = cloth(surface(size=(0.6, 0.5), cells=(6, 5)), bending=1e-4)
    return _case(
        body, pd.Gravity((2.0, -9.8, 0.0)), pd.Ground(-0.001, friction=0.3), pd.Sphere((0.3, -0.1, 0.2), 0.11, 0.4)
    )


def flat_case() -> Case:
    """Cloth held at an edge whose bending differs from hinge to hinge, without a curvature at rest."""
    mesh = surface(size=(0.6, 0.5), cells=(9, 8))
    count = len(cloth(mesh, bending=1.0).bending)
    body = cloth(mesh, bending=np.linspace(1e-4, 3e-3, count), poisson=0.2)
    return _case(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity((1.0, -9.8, 0.5)))


def tied_case() -> Case:
    """Two sheets with hinges that are curved at rest, tied together: only the ties are quadratic."""
    mesh = surface(size=(0.6, 0.5), cells=(6, 5))
    body = cloth(mesh, bending=1e-4, rest_curvature=0.5)
    other = cloth(mesh.translated((0.03, 0.0, 0.02)), bending=1e-4)
    ties = pd.Tie(other, [0, 7, 20, 30], body, stiffness=np.array([40.0, 80.0, 20.0, 60.0]))
    return _case(body, other, ties, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity())


def rod_case() -> Case:
    """A rod: springs and hinges of three vertices."""
    angle = np.linspace(0.0, 1.5, 14)
    body = pd.Rod(np.stack([np.sin(angle), np.cos(angle), 0.1 * angle], axis=1), 1e7, 0.005)
    return _case(body, pd.Pin(body, [0, 1]), pd.Gravity())


def spring_case(**options: Any) -> Case:
    """Two blocks joined by springs, one of them held, with `options`."""
    body, other = (
        _block(**options),
        pd.Solid(pd.TetMesh(*box((0.2, 0.2, 0.2), (2, 2, 2))).translated((0.35, 0.0, 0.0)), 1e5),
    )
    pairs = [[len(body.mesh.vertices) - 1, 0], [len(body.mesh.vertices) - 2, 3], [5, 7]]
    springs = pd.Springs(body, pairs, [300.0, 500.0, 200.0], [0.02, 0.1, 0.3], other=other)
    return _case(other, body, springs, pd.Pin(body, [0, 1, 2]), pd.Gravity())


def fibre_case(**options: Any) -> Case:
    """A held block with active fibres and others that resist tension alone."""
    body = _block(**options)
    tets = np.arange(len(body.mesh.tets))
    active = pd.Fibres(body, (1.0, 0.2, 0.0), 3e5, activation=0.7, tets=tets[::2])
    passive = pd.Fibres(body, (0.0, 1.0, 0.3), 2e5, tension_only=True, tets=tets[1::3])
    return _case(body, active, passive, pd.Pin(body, body.mesh.vertices[:, 0] == 0.0), pd.Gravity())


def mixed_case(*parts: object, **options: Any) -> Case:
    """Solid, cloth tied to it, a rod, springs and fibres, with contacts."""
    solid = _block(**options)
    mesh = surface(size=(0.4, 0.3), cells=(5, 4)).translated((0.05, 0.2, 0.0))
    sheet = cloth(mesh, bending=1e-4, poisson=0.2, weft=100.0, grain=(1.0, 0.0, 0.0))
    points = np.stack([np.linspace(0.0, 0.5, 9), np.full(9, 0.4), np.full(9, 0.1)], axis=1)
    rod = pd.Rod(points, 1e7, 0.004)
    return _case(
        solid, sheet, rod,
        pd.Fibres(solid, (1.0, 0.0, 0.0), 1e5, activation=0.5),
        pd.Tie(sheet, [0, 5, 11], solid, stiffness=2e3),
        pd.Tie(rod, [4], sheet, [[0.25, 0.2, 0.1]], stiffness=500.0),
        pd.Springs(rod, [[0, 3], [8, 20]], 100.0, other=sheet),
        pd.Pin(rod, [0]), pd.Gravity(), pd.Ground(0.001, friction=0.4), pd.Sphere((0.2, -0.05, 0.1), 0.06, 0.3), *parts,
    )  # fmt: skip


CASES: dict[str, Callable[[], Case]] = {
    "sheet": sheet_case,
    "free sheet": free_sheet,
    "flat sheet": flat_case,
    "ties": tied_case,
    "rod": rod_case,
    "springs": spring_case,
    "fibres": fibre_case,
    "mixed": mixed_case,
    # each tetrahedron has its own trace, averages it with another one, or with up to three
    "fibres, poisson": lambda: fibre_case(poisson=0.36, averaging=1),
    "springs, poisson": lambda: spring_case(poisson=0.3, averaging=2),
    "mixed, poisson": lambda: mixed_case(poisson=0.38, averaging=4),
    "limits": lambda: block_case(strain_limit=(0.97, 1.02), limit_stiffness=1e6),
    "limited sheet": lambda: sheet_case(strain_limit=(0.985, 1.01), limit_stiffness=5e3),
    "volume": lambda: block_case(poisson=0.36, law="volume"),
    "damped": lambda: spring_case(stiffness_damping=0.02),
    "mixed, all": lambda: mixed_case(
        poisson=0.3, averaging=2, strain_limit=(0.95, 1.04), limit_stiffness=4e5, stiffness_damping=0.01
    ),
}
