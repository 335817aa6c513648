"""Scenes for every effect of a step, whose iterates are compared with those of the reference."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from cases import Case, box, contact_block, leaning, sliver_mesh

import torchpd as pd

SOLVERS = {
    "jacobi": pd.Jacobi(relaxation=0.9),
    "plain": pd.Jacobi(diagonal="plain"),
    "classic": pd.Chebyshev("classic", rho=0.97, delay=3),
    "classic, weighted": pd.Chebyshev("classic", rho=0.9, delay=0, relaxation=1.5, diagonal="weighted"),
    "guarded": pd.Chebyshev(),
    "guarded, given rho": pd.Chebyshev(rho=0.9, relaxation=1.2),
}


def stirred(case: Case, *, seed: int = 0, size: float = 0.01) -> Case:
    """The case from a deformed, moving state."""
    rng = np.random.default_rng(seed)
    x, v = (
        array + scale * rng.standard_normal(array.shape)
        for array, scale in ((case.positions, size), (case.velocities, 30 * size))
    )
    return Case(case.scene, x, v, case.time_step, start=case.start, extras=case.extras)


def pinned(start: str) -> Case:
    """Slivers of random stiffness with hard and soft pins whose targets move, drag, gravity and forces."""
    rng = np.random.default_rng(1)
    mesh = sliver_mesh((5, 3, 3))
    body = pd.Solid(mesh, youngs=10.0 ** rng.uniform(4.0, 6.0, len(mesh.tets)))
    hard, soft = pd.Pin(body, mesh.vertices[:, 0] < 0.05), pd.Pin(body, [60, 70, 71], stiffness=[1e3, 2e4, 3e5])
    scene = pd.Scene(hard, body, soft, pd.Gravity((1.0, -9.8, 0.5)), pd.Damping(3.0))
    held = scene.values().pin_targets
    extras = {
        "forces": rng.standard_normal(mesh.vertices.shape),
        "pin_targets": held + 0.01 * rng.standard_normal(held.shape),
    }
    return stirred(Case(scene, mesh.vertices, 0.0 * mesh.vertices, 1.0 / 60.0, start, extras))


def guessed() -> Case:
    """A first iterate of the caller's."""
    case = pinned("velocity")
    guess = case.positions + 0.03 * np.random.default_rng(2).standard_normal(case.positions.shape)
    return Case(case.scene, case.positions, case.velocities, case.time_step, guess, case.extras)


def two_bodies() -> Case:
    """A held body and a free one, each in one piece; only the free one is shifted to its momentum."""
    vertices, tets = box((0.3, 0.2, 0.2), (3, 2, 2))
    held, free = (pd.Solid(pd.TetMesh(vertices + [0.0, y, 0.0], tets), 3e5) for y in (0.0, 1.0))
    scene = pd.Scene(held, free, pd.Pin(held, [0, 1, 2]), pd.Gravity((0.0, -9.8, 0.0)))
    x = scene.values().rest_positions
    return stirred(Case(scene, x, 0.0 * x, 1.0 / 60.0))


def on_ground(friction: float) -> Case:
    """Sunk a little into a tilted ground, moving down and along it."""
    ground = pd.Ground(height=0.02, normal=(0.1, 1.0, 0.0), friction=friction)
    return stirred(contact_block(ground, velocity=(1.0, -2.0, 0.0)))


def on_ball(friction: float, motion: float) -> Case:
    case = contact_block(pd.Sphere((0.15, -0.2, 0.15), 0.21, friction), velocity=(0.0, -1.0, 0.0))
    centre = case.scene.values().spheres[:, :3]
    extras = {"sphere_centers": centre + [motion, 0.5 * motion, 0.0], "sphere_starts": centre}
    return stirred(Case(case.scene, case.positions, case.velocities, case.time_step, extras=extras))


def in_a_corner() -> Case:
    """Two planes and two balls, one body free and in the air, so that it is shifted and the other is not."""
    vertices, tets = box((0.3, 0.2, 0.2), (3, 2, 2))
    low, high = (pd.Solid(pd.TetMesh(vertices + [0.0, y, 0.0], tets), 3e5) for y in (0.0, 3.0))
    scene = pd.Scene(
        low, high, pd.Gravity((0.0, -9.8, 0.0)), pd.Ground(0.01, friction=0.4), pd.Ground(0.01, normal=(1.0, 0.0, 0.0)),
        pd.Sphere((0.3, 0.2, 0.1), 0.05), pd.Sphere((0.15, -0.1, 0.0), 0.12, friction=0.2),
    )  # fmt: skip
    x = scene.values().rest_positions
    return stirred(Case(scene, x, np.tile([-1.0, -1.0, 0.0], (len(x), 1)), 1.0 / 60.0))


def restarting(cells: tuple[int, int, int] = (10, 2, 2), youngs: float = 100.0, size: float = 0.03) -> Case:
    """A bar so soft that with RESTARTS the momentum has grown past its use by iteration 16, where the energy rises."""
    vertices, tets = box((1.0, 0.2, 0.2), cells)
    body = pd.Solid(pd.TetMesh(vertices, tets), youngs)
    scene = pd.Scene(body, pd.Pin(body, vertices[:, 0] == 0.0))
    return stirred(Case(scene, vertices, 0.0 * vertices, 1.0 / 60.0), size=size)


def sliding(*planes: pd.Ground, spin: float = 0.0) -> Case:
    """A hard block on one of the planes at least, which its targets lie below: it moves along and turns on the spot."""
    case = contact_block(*planes, velocity=(1.0, 0.0, 0.3), gravity=(2.0, -9.8, 1.0), youngs=1e6)
    x = case.positions
    turning = np.cross([0.0, spin, 0.0], x - x.mean(axis=0))
    return stirred(Case(case.scene, x, case.velocities + turning, case.time_step), size=1e-5)


def hung(*held: int, stiffness: float | None = None, ground: float = -9.0) -> Case:
    """A hard bar that swings, under forces, from these vertices, which move."""
    rng = np.random.default_rng(3)
    vertices, tets = box((0.6, 0.1, 0.1), (6, 1, 1))
    body = pd.Solid(pd.TetMesh(vertices, tets), 2e5)
    pin = pd.Pin(body, list(held)) if stiffness is None else pd.Pin(body, list(held), stiffness=stiffness)
    scene = pd.Scene(body, pin, pd.Gravity(), pd.Ground(ground))
    pins = scene.values().pin_targets
    extras = {"forces": rng.standard_normal(vertices.shape), "pin_targets": pins + [0.0, 0.01, 0.0]}
    return stirred(Case(scene, vertices, 0.0 * vertices, 1.0 / 60.0, extras=extras), size=1e-4)


def tipping(friction: float, *, spin: float = 0.0, **options: Any) -> Case:
    """A stiff bar or block that tips, and spins about its lowest vertex; much gravity, as float32 rounds its 0.5 m."""
    case = leaning(friction, **{"youngs": 1e6, "gravity": (0.0, -98.0, 0.0), **options})
    arms = case.positions - case.positions[case.positions[:, 1].argmin()]
    turning = np.cross([0.0, 0.0, spin], arms)
    return stirred(Case(case.scene, case.positions, case.velocities + turning, case.time_step), size=1e-5)


def several_tip() -> Case:
    """Bars on a corner and on an edge, a block that lands, one that rests and a bar that flies."""
    bodies, gravity, *_ = zip(
        *(
            leaning(0.7, youngs=1e6, gravity=(0.0, -98.0, 0.0), **shape).scene.parts
            for shape in (
                {},
                {"turn": (0.0, 0.0, 25.0)},
                {"turn": (5.0, 10.0, 15.0), "size": (0.2, 0.2, 0.2), "cells": (2, 2, 2), "height": 0.005},
                {"turn": (0.0, 0.0, 0.0), "size": (0.2, 0.2, 0.2), "cells": (2, 2, 2)},
                {"height": 0.5},
            )
        ),
        strict=True,
    )
    placed = [
        pd.Solid(body.mesh.translated((0.0, 0.0, 0.2 * k)), body.youngs, body.density) for k, body in enumerate(bodies)
    ]
    planes = [pd.Ground(-9.0, normal=(1.0, 0.0, 0.0)), pd.Ground(0.0, friction=0.7)]
    scene = pd.Scene(*placed, gravity[0], *planes)
    x = scene.values().rest_positions
    return stirred(Case(scene, x, 0.0 * x, 1.0 / 60.0), size=1e-5)


def landing_on_a_leash() -> Case:
    """A hard block with a pin at one of its upper corners."""
    vertices, tets = box((0.3, 0.2, 0.2), (3, 2, 2))
    body = pd.Solid(pd.TetMesh(vertices + [0.0, 0.002, 0.0], tets), 1e6)
    corner = int((vertices @ [1.0, 1.0, 1.0]).argmax())
    scene = pd.Scene(body, pd.Pin(body, [corner]), pd.Gravity(), pd.Ground(0.0))
    x = scene.values().rest_positions
    return stirred(Case(scene, x, np.tile([0.0, -1.0, 0.0], (len(x), 1)), 1.0 / 60.0), size=1e-5)


def landing_far_and_near() -> Case:
    """A hard block and a soft one that land in a corner at once, and a hard one that has not come to it."""
    vertices, tets = box((0.3, 0.2, 0.2), (3, 2, 2))
    near = [pd.Solid(pd.TetMesh(vertices + [0.001, 0.001, z], tets), youngs) for z, youngs in ((0.0, 1e6), (0.3, 1e3))]
    far = pd.Solid(pd.TetMesh(vertices + [0.02, 0.01, 0.6], tets), 1e6)
    scene = pd.Scene(*near, far, pd.Gravity(), pd.Ground(0.0), pd.Ground(0.0, normal=(1.0, 0.0, 0.0)))
    x = scene.values().rest_positions
    return stirred(Case(scene, x, np.tile([-0.2, -1.0, 0.5], (len(x), 1)), 1.0 / 60.0), size=1e-5)


def among_planes() -> Case:
    """Three hard blocks among eleven planes: one touches the tenth, one a wall that it slides to, one nothing."""
    vertices, tets = box((0.3, 0.2, 0.2), (3, 2, 2))
    places = ((0.0, 0.0, 0.0), (0.0, 3.0, 0.0), (0.0, 0.0, 2.0))
    blocks = [pd.Solid(pd.TetMesh(vertices + place, tets), 1e6) for place in places]
    above = [pd.Ground(-10.0 - k, normal=(0.0, 1.0, 0.0)) for k in range(8)]
    walls = [pd.Ground(1e-4, normal=(0.0, 0.02, -1.0)), pd.Ground(-0.5, normal=(-1.0, 0.0, 0.0))]
    scene = pd.Scene(*blocks, pd.Gravity(), above[0], pd.Ground(0.0), *above[1:], *walls)
    x = scene.values().rest_positions
    v = np.repeat([[1.0, 0.0, 4.0], [1.0, 0.0, 0.0], [14.0, 0.0, -1.0]], len(vertices), axis=0)
    return stirred(Case(scene, x, v, 1.0 / 60.0), size=1e-5)


RESTARTS = pd.Chebyshev(rho=0.9999)
CASES: dict[str, Callable[[], Case]] = {
    "pins, velocity start": lambda: pinned("velocity"),
    "pins, inertial start": lambda: pinned("inertial"),
    "given start": guessed,
    "two bodies": two_bodies,
    "ground": lambda: on_ground(0.0),
    "ground, friction": lambda: on_ground(0.6),
    "ball": lambda: on_ball(0.0, 0.0),
    "ball, friction": lambda: on_ball(0.5, 0.0),
    "moving ball, friction": lambda: on_ball(0.5, 0.01),
    "corner": in_a_corner,
    "turning on the ground": lambda: sliding(pd.Ground(0.0, normal=(0.02, 1.0, 0.0)), spin=3.0),
    "sliding against friction": lambda: sliding(pd.Ground(0.0, friction=0.3)),
    "sliding, turning, friction": lambda: sliding(pd.Ground(0.0, friction=0.3), spin=3.0),
    "sliding along an edge": lambda: sliding(pd.Ground(0.0), pd.Ground(-0.3, normal=(-1.0, 0.1, 0.0)), spin=3.0),
    "sliding along a wall, friction": lambda: sliding(
        pd.Ground(0.0, friction=0.1), pd.Ground(-0.3, normal=(0.0, 0.1, -1.0), friction=0.2)
    ),
    "tipping about a corner": lambda: tipping(0.8),
    "tipping on smooth ground": lambda: tipping(0.0),
    "tipping and sliding": lambda: tipping(0.1, velocity=(1.0, 0.0, 0.5)),
    "tipping over an edge": lambda: tipping(
        1.0, turn=(0.0, 33.0, 0.0), size=(0.1, 0.4, 0.1), cells=(2, 8, 2), gravity=(50.0, -98.0, -32.0)
    ),
    # the far end of the edge is found by way of a third vertex
    "tipping over an edge askew": lambda: tipping(
        1.0, turn=(0.0, 33.0, 0.0), size=(0.2, 0.4, 0.1), cells=(4, 8, 2), gravity=(40.0, -98.0, 40.0)
    ),
    "tipping on to a face": lambda: tipping(
        0.7, turn=(0.0, 10.0, 1.0), size=(0.2, 0.2, 0.2), cells=(2, 2, 2), spin=-2.0
    ),
    "landing on a corner": lambda: tipping(
        0.6, turn=(5.0, 10.0, 15.0), size=(0.2, 0.2, 0.2), cells=(2, 2, 2), velocity=(0.5, -1.0, 0.0), height=0.005
    ),
    # they start from where they are, above the ground
    "landing and sliding": lambda: tipping(
        0.3, turn=(2.0, 0.0, 1.0), size=(0.6, 0.15, 0.15), cells=(8, 2, 2), velocity=(3.0, -1.0, 0.0), height=0.002
    ),
    "landing on three corners": lambda: tipping(
        0.3,
        turn=(2.0, 0.0, 1.0),
        size=(0.6, 0.15, 0.15),
        cells=(8, 2, 2),
        velocity=(1.0, -1.0, 0.3),
        height=0.01,
        spin=-2.0,
    ),
    "landing, held at a corner": landing_on_a_leash,
    "landing far and near": landing_far_and_near,
    "several that tip": several_tip,
    "among many planes": among_planes,
    "hung from a point": lambda: hung(0),
    "hung from an edge": lambda: hung(0, 1),
    "hung from an edge, on the ground": lambda: hung(0, 1, ground=-1e-4),
    "hung from springs": lambda: hung(0, 1, 2, stiffness=300.0),
}
