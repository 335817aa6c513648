"""Courses of bodies that touch each other: errors after few iterations, with pairs of vertices and faces given.

`python benchmarks/coarse_pairs.py 16 1e5 1e7` prints, for each scene, the error of iterations alone, with corrections
before and after them, with further ones after every fourth, and with these by pieces of bodies. It is the greatest over
bodies and steps of the error of the middle's velocity, or of the spin times half the size, over the greatest speed, at
least that of gravity in half a step. The pairs of a step are the vertices within `REACH` of a face of another body at
its start.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace

import numpy as np
from coarse_scenes import FALL, PIECE, H, box, middle_and_spin
from numpy.typing import NDArray

import torchpd as pd
from torchpd.reference import step_problem
from torchpd.reference.envelopes import PairContacts
from torchpd.reference.pair_step import pair_chebyshev
from torchpd.reference.pieces import Pieces, cut
from torchpd.scene import SceneValues

Array = NDArray[np.float64]

REACH = 0.025  # m


@dataclass(frozen=True)
class Bodies:
    """Boxes with their velocities, and the friction between them."""

    meshes: tuple[pd.TetMesh, ...]
    youngs: float
    velocities: Array  # [V, 3]
    friction: float
    parts: tuple[pd.Gravity | pd.Ground, ...]
    steps: int

    def values(self) -> SceneValues:
        return pd.Scene(*(pd.Solid(mesh, self.youngs, density=1000.0) for mesh in self.meshes), *self.parts).values()

    def cut(self, size: int) -> Pieces:
        """Pieces of about `size` vertices."""
        values = self.values()
        return cut(step_problem(values, values.rest_positions, self.velocities, H), size)

    def run(self, iterations: int, **options: int | bool | Pieces) -> list[tuple[Array, Array]]:
        """Positions and velocities after every step; multipliers are carried by vertex and body."""
        values = self.values()
        x, v, out, known = values.rest_positions, self.velocities, [], {}
        for _ in range(self.steps):
            pairs = self.pairs(x)
            keys = [(int(row[0]), int(values.component[row[1]])) for row in pairs.vertices]
            pairs = replace(pairs, forces=np.array([known.get(key, np.zeros(3)) for key in keys]).reshape(-1, 3))
            u, after = pair_chebyshev(step_problem(values, x, v, H), pairs, iterations=iterations, **options)
            known = dict(zip(keys, after.forces, strict=True))
            x, v = x + u, u / H
            out.append((x, v))
        return out

    def error(self, run: list[tuple[Array, Array]], exact: list[tuple[Array, Array]]) -> float:
        worst, fastest, start = 0.0, FALL, 0
        for mesh in self.meshes:
            own = slice(start, start + len(mesh.vertices))
            start, half = own.stop, 0.5 * float(np.ptp(mesh.vertices, axis=0).max())
            masses = pd.Scene(pd.Solid(mesh, self.youngs, density=1000.0)).values().masses
            for (x, v), (y, w) in zip(run, exact, strict=True):
                (a, b), (c, d) = (middle_and_spin(masses, p[own], q[own]) for p, q in ((x, v), (y, w)))
                worst = max(worst, float(np.linalg.norm(a - c)), half * float(np.linalg.norm(b - d)))
                fastest = max(fastest, float(np.linalg.norm(c)), half * float(np.linalg.norm(d)))
        return worst / fastest

    def pairs(self, x: Array) -> PairContacts:
        """Vertices near a face of another body: the nearest one of each body."""
        body = np.repeat(np.arange(len(self.meshes)), [len(mesh.vertices) for mesh in self.meshes])
        starts = np.cumsum([0, *(len(mesh.vertices) for mesh in self.meshes)])
        faces = [mesh.boundary() + start for mesh, start in zip(self.meshes, starts, strict=False)]
        vertices, weights, normals, offsets = [], [], [], []
        for i in np.unique(np.concatenate(faces)):
            for other, triangles in enumerate(faces):
                if other == body[i]:
                    continue
                found = nearest_face(x[i], x[triangles])
                if found is not None:
                    number, shares, normal, gap = found
                    vertices.append([i, *triangles[number]])
                    weights.append([1.0, *-shares])
                    normals.append(normal)
                    offsets.append(gap)
        count = len(offsets)
        return PairContacts(
            np.array(vertices, np.int64).reshape(count, 4), np.array(weights).reshape(count, 4),
            np.array(normals).reshape(count, 3), np.array(offsets), np.full(count, self.friction), np.zeros((count, 3)),
            np.zeros((count, 3)),
        )  # fmt: skip


def nearest_face(point: Array, corners: Array) -> tuple[int, Array, Array, float] | None:
    """Number, barycentric coordinates, outward normal and distance of the nearest face over which a point lies."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = np.cross(first, second)
    squares = (areas**2).sum(axis=1)
    arms = point - corners[:, 0]
    shares = np.stack(
        [(np.cross(arms, second) * areas).sum(axis=1), (np.cross(first, arms) * areas).sum(axis=1)], axis=1
    )
    shares = shares / squares[:, None]
    shares = np.concatenate([1.0 - shares.sum(axis=1, keepdims=True), shares], axis=1)
    gaps = (arms * areas).sum(axis=1) / np.sqrt(squares)
    far = np.where((shares >= -1e-3).all(axis=1), np.abs(gaps), np.inf)
    number = int(far.argmin())
    if far[number] > REACH:
        return None
    return number, shares[number], areas[number] / np.sqrt(squares[number]), float(gaps[number])


def scenes(youngs: float, cells: int = 2) -> dict[str, Bodies]:
    """All scenes by name; a cube has so many cells an edge."""
    cube = box((0.1,) * 3, (cells,) * 3)

    def at(x: float, y: float, z: float = 0.0) -> pd.TetMesh:
        return pd.TetMesh(cube.vertices + np.array([x, y, z]), cube.tets)

    def bodies(*meshes: pd.TetMesh, velocity: tuple[Array, ...] = (), steps: int = 6, floor: bool = True) -> Bodies:
        moving = velocity or tuple(np.zeros(3) for _ in meshes)
        velocities = np.concatenate([np.tile(v, (len(m.vertices), 1)) for v, m in zip(moving, meshes, strict=True)])
        ground = (pd.Ground(0.0, friction=0.5),) if floor else ()
        return Bodies(meshes, youngs, velocities, 0.5, (pd.Gravity((0.0, -9.8, 0.0)), *ground), steps)

    toward = np.array([0.5, 0.2, 0.0])
    return {
        "two cubes rest": bodies(at(0.0, 0.05), at(0.01, 0.15, 0.005)),
        "tower of four": bodies(*(at(0.003 * k, 0.05 + 0.1 * k, 0.002 * k) for k in range(4))),
        "dropped on a cube": bodies(
            at(0.0, 0.05), at(0.02, 0.155, 0.01), velocity=(np.zeros(3), np.array([0.0, -1.0, 0.0]))
        ),
        "overhang tips off": bodies(at(0.0, 0.05), at(0.07, 0.15), steps=8),
        "collide in flight": bodies(
            at(0.0, 1.0), at(0.105, 1.02, 0.01), velocity=(toward, -toward), steps=4, floor=False
        ),
    }


def main(iterations: int, stiffness: list[float]) -> None:
    print(f"{'scene':20s}{'youngs':>8s}{'alone':>10s}{'both ends':>12s}{'every 4th':>12s}{'pieces':>12s}")
    for youngs in stiffness:
        for name, chosen in scenes(youngs).items():
            exact = chosen.run(1000)
            options = ({"corrections": False}, {}, {"every": 4}, {"every": 4, "pieces": chosen.cut(PIECE)})
            errors = "".join(f"{chosen.error(chosen.run(iterations, **o), exact):12.1e}" for o in options)
            print(f"{name:20s}{youngs:8.0e}{errors}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), [float(word) for word in sys.argv[2:]])
