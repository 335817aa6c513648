"""Errors of the coarse correction: bodies that fly, land, slide, tip, roll, hang and are gripped.

`python benchmarks/coarse_scenes.py 8 16 64 --youngs 1e5 1e7 --out FILE` measures what so many iterations a step leave
of the converged course, in float64 and float32.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from machine import describe_run, write_result
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import torchpd as pd
from torchpd.reference import StepProblem, step_problem
from torchpd.reference.coarse_step import coarse_chebyshev

Array = NDArray[np.float64]
Record = dict[str, Any]
Solve = Callable[[StepProblem], Array]

H = 1.0 / 60.0
CUBE = (0.1, 0.1, 0.1)
SOLVED = 1e-9  # residual of a converged step
PIECE = 12  # vertices of a piece
FALL = 0.5 * 9.8 * H  # m/s: what gravity gives in half a step, the least speed that errors are compared with


@dataclass(frozen=True)
class Course:
    """A scene, the state that it starts from, and the displacements of its spheres in a step."""

    scene: pd.Scene
    positions: Array  # [V, 3]
    velocities: Array  # [V, 3]
    steps: int
    sphere_motions: Array = field(default_factory=lambda: np.zeros((0, 3)))  # [S, 3] m

    def problem(self, step: int, positions: Array, velocities: Array) -> StepProblem:
        values = self.scene.values()
        starts = values.spheres[:, :3] + step * self.motions
        return step_problem(
            values, positions, velocities, H, sphere_centers=starts + self.motions, sphere_starts=starts
        )

    @property
    def motions(self) -> Array:
        return self.sphere_motions if len(self.sphere_motions) else np.zeros((len(self.scene.spheres), 3))

    def run(self, solve: Solve) -> list[tuple[Array, Array]]:
        """Positions and velocities after every step."""
        x, v, out = self.positions, self.velocities, []
        for step in range(self.steps):
            u = solve(self.problem(step, x, v))
            x, v = x + u, u / H
            out.append((x, v))
        return out

    def library(self, iterations: int, dtype: torch.dtype = torch.float64) -> list[tuple[Array, Array]]:
        """The same course by the library's own steps."""
        sim = pd.Simulator(self.scene, H, iterations, pd.Chebyshev(), dtype, progress=False)

        def solve(problem: StepProblem) -> Array:
            state = pd.State(*(torch.from_numpy(a)[None].to(dtype) for a in (problem.positions, problem.velocities)))
            with torch.no_grad():
                return H * sim(state, targets=self._targets(problem, dtype)).velocities[0].double().numpy()

        return self.run(solve)

    def _targets(self, problem: StepProblem, dtype: torch.dtype) -> dict[pd.Sphere, torch.Tensor]:
        rows = np.concatenate([problem.sphere_centers, problem.sphere_motions / H], axis=1)
        return dict(zip(self.scene.spheres, torch.from_numpy(rows).to(dtype), strict=True))

    def converged(self) -> list[tuple[Array, Array]]:
        """The same course with every step solved to a residual of 1e-9."""
        rough = any(plane.friction > 0.3 for plane in self.scene.grounds) or self.scene.spheres
        solver = pd.Chebyshev(rho=0.99) if rough else pd.Multilevel()
        sim = pd.Simulator(self.scene, H, 20000, solver, torch.float64, tolerance=1e-13, progress=False)

        def solve(problem: StepProblem) -> Array:
            state = pd.State(*(torch.from_numpy(a)[None].clone() for a in (problem.positions, problem.velocities)))
            with torch.no_grad():
                u = H * sim(state, targets=self._targets(problem, torch.float64)).velocities[0].numpy()
            for _ in range(40):
                if problem.relative_residual(u) <= SOLVED:
                    return u
                u = coarse_chebyshev(problem, u, iterations=500, every=8)
            raise RuntimeError(f"residual must fall to {SOLVED:g}, got {problem.relative_residual(u):.1e}")

        return self.run(solve)


def error(course: Course, run: list[tuple[Array, Array]], exact: list[tuple[Array, Array]]) -> float:
    """Greatest error of the middle's velocity, and of the spin times half the size, over the greatest speed."""
    masses, size = course.scene.values().masses, float(np.ptp(course.positions, axis=0).max())
    motions = [[middle_and_spin(masses, x, v) for x, v in states] for states in (run, exact)]
    fastest = max(max(np.linalg.norm(v), 0.5 * size * np.linalg.norm(w)) for v, w in motions[1])
    worst, fastest = 0.0, max(fastest, FALL)
    for (v, w), (v0, w0) in zip(*motions, strict=True):
        worst = max(worst, float(np.linalg.norm(v - v0)), 0.5 * size * float(np.linalg.norm(w - w0)))
    return worst / float(fastest)


def middle_and_spin(masses: Array, x: Array, v: Array) -> tuple[Array, Array]:
    """Velocity [3] m/s of the centre of mass, and angular velocity [3] rad/s of the same angular momentum."""
    share = masses[:, None] / masses.sum()
    arms, middle = x - (share * x).sum(axis=0), (share * v).sum(axis=0)
    inertia = (share * arms**2).sum() * np.eye(3) - (share * arms).T @ arms
    return middle, np.linalg.solve(inertia, np.cross(arms, share * v).sum(axis=0))


def box(size: tuple[float, float, float], cells: tuple[int, int, int], *degrees: float) -> pd.TetMesh:
    """A box about the origin, turned about z, then about x, then y."""
    mesh = pd.shapes.box(size, cells)
    turned = Rotation.from_euler("zxy", np.append(degrees, np.zeros(3 - len(degrees))), degrees=True)
    return pd.TetMesh(turned.apply(mesh.vertices - mesh.vertices.mean(axis=0)), mesh.tets)


def rod(radius: float = 0.1, length: float = 0.2, cells: tuple[int, int, int] = (6, 6, 4)) -> pd.TetMesh:
    """A cylinder along z: a square mapped to a disc, with blended corners."""
    mesh = pd.shapes.box((2.0, 2.0, length), cells)
    vertices = mesh.vertices - mesh.vertices.mean(axis=0)
    x, y = vertices[:, 0].copy(), vertices[:, 1].copy()
    vertices[:, 0], vertices[:, 1] = radius * x * np.sqrt(1 - 0.425 * y**2), radius * y * np.sqrt(1 - 0.425 * x**2)
    return pd.TetMesh(vertices, mesh.tets)


def course(
    mesh: pd.TetMesh,
    youngs: float,
    *parts: pd.Gravity | pd.Ground | pd.Sphere,
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    spin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    about: Array | None = None,
    height: float | None = 0.0,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    steps: int = 8,
    held: Callable[[Array], Array] | None = None,
    motions: Array | None = None,
) -> Course:
    """A body, its lowest vertex at a height; `held` chooses the pinned vertices."""
    vertices = mesh.vertices - np.array([0.0, 0.0 if height is None else mesh.vertices[:, 1].min() - height, 0.0])
    vertices = vertices + np.array(shift)
    body = pd.Solid(pd.TetMesh(vertices, mesh.tets), youngs, density=1000.0)
    pins = [] if held is None else [pd.Pin(body, np.flatnonzero(held(vertices)))]
    gravity = [] if any(isinstance(part, pd.Gravity) for part in parts) else [pd.Gravity((0.0, -9.8, 0.0))]
    scene = pd.Scene(body, *gravity, *parts, *pins)
    arms = vertices - (vertices.mean(axis=0) if about is None else about)
    velocities = np.array(velocity) + np.cross(np.array(spin), arms)
    return Course(scene, vertices, velocities, steps, np.zeros((0, 3)) if motions is None else motions)


def ground(friction: float, normal: tuple[float, float, float] = (0.0, 1.0, 0.0)) -> pd.Ground:
    return pd.Ground(0.0, friction=friction, normal=normal)


def gripper(youngs: float, cells: int = 4) -> Course:
    """A cube squeezed by 0.5 mm between two spheres that rise."""
    spheres = [pd.Sphere((x, 0.0, 0.0), 0.05, 1.0) for x in (-0.0995, 0.0995)]
    rise = np.tile([0.0, 0.1 * H, 0.0], (2, 1))
    return course(box(CUBE, (cells,) * 3), youngs, *spheres, height=None, motions=rise)


def scenes(youngs: float, cells: int = 4) -> dict[str, Course]:
    """All scenes by name; a cube has so many cells an edge."""
    cube, bar = (cells,) * 3, (2 * cells, cells // 2, cells // 2)
    mesh, tilted, long = box(CUBE, cube), box(CUBE, cube, 20.0, 15.0), box((0.4, 0.1, 0.1), bar)
    up = (bar[1], bar[0], bar[1])
    falling, column = box((0.1, 0.5, 0.1), (up[0], 5 * up[1] // 4, up[2]), 15.0, 10.0), box((0.1, 0.4, 0.1), up)
    corner, wheel = long.vertices[long.vertices.sum(axis=1).argmax()] * [-1.0, 1.0, 1.0], rod()

    def edge(x: Array) -> Array:
        return np.asarray((x[:, 0] < -0.2 + 1e-9) & (x[:, 1] > x[:, 1].max() - 1e-9))

    def point(x: Array) -> Array:
        return edge(x) & (x[:, 2] > 0.05 - 1e-9)

    def ball(radius: float, friction: float) -> pd.Sphere:
        return pd.Sphere((0.0, -radius, 0.0), radius, friction)

    start = np.array([[0.1 * H, 0.0, 0.0]])
    out = {
        "flies": course(mesh, youngs, velocity=(1.0, 2.0, 0.0), spin=(3.0, 6.0, 8.0), height=None),
        "hinge": course(long, youngs, held=edge, height=None),
        "corner pin": course(long, youngs, held=point, height=None, spin=(0.0, 5.0, 0.0), about=corner),
        "rests": course(mesh, youngs, ground(0.5), steps=6),
        "cube on a starting ball": course(mesh, youngs, ball(10.0, 1.0), steps=4, motions=start),
        "corner of planes": course(mesh, youngs, ground(0.3), ground(0.3, (1.0, 0.0, 0.0)), shift=(0.06, 0.0, 0.0),
                                   velocity=(-1.0, 0.0, 0.5), steps=6),
        "column over its edge": course(column, youngs, ground(1.0), pd.Gravity((6.0, -9.8, 0.0))),
        "column leans": course(column, youngs, ground(1.0), pd.Gravity((2.0, -9.8, 0.0))),
        "rod rolls": course(wheel, youngs, ground(0.5), spin=(0.0, 0.0, -5.0), velocity=(0.5, 0.0, 0.0)),
        "gripped": gripper(youngs, cells),
    }  # fmt: skip
    for mu in (0.0, 0.3):
        out[f"lands and slides {mu}"] = course(
            mesh, youngs, ground(mu), velocity=(1.0, -1.0, 0.0), height=0.005, steps=6
        )
        out[f"slides {mu}"] = course(mesh, youngs, ground(mu), velocity=(1.0, 0.0, 0.5), steps=6)
    for mu in (0.0, 0.5):
        out[f"lands on a corner {mu}"] = course(tilted, youngs, ground(mu), velocity=(0.5, -1.0, 0.0), height=0.005)
        out[f"off a small ball {mu}"] = course(mesh, youngs, ball(0.2, mu), shift=(0.03, 0.0, 0.0))
    for mu in (0.0, 0.8):
        out[f"bar falls {mu}"] = course(falling, youngs, ground(mu))
    return out


def summary(rows: list[Record]) -> dict[str, str]:
    """Geometric mean and worst of the scenes in float64, by stiffness and iterations."""
    out = {}
    for youngs, count in sorted({(row["youngs"], row["iterations"]) for row in rows}):
        of = [r["float64"] for r in rows if (r["youngs"], r["iterations"]) == (youngs, count)]
        out[f"{youngs:g} Pa, {count} iterations"] = f"{np.exp(np.mean(np.log(of))):.2g}, worst {max(of):.2g}"
    return out


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("iterations", type=int, nargs="*", default=[8, 16, 64], help="of a step (8 16 64)")
    parser.add_argument("--youngs", type=float, nargs="+", default=[1e5, 1e6, 1e7], help="Pa (1e5 1e6 1e7)")
    parser.add_argument("--scenes", nargs="+", help="names of scenes (all)")
    parser.add_argument("--out", type=Path, help="output file (JSON)")
    options = parser.parse_args(words)
    torch.set_num_threads(1)
    rows: list[Record] = []
    for youngs in options.youngs:
        for name, chosen in scenes(youngs).items():
            if options.scenes and name not in options.scenes:
                continue
            exact = chosen.converged()
            for count in options.iterations:
                errors = {
                    str(dtype).removeprefix("torch."): error(chosen, chosen.library(count, dtype), exact)
                    for dtype in (torch.float64, torch.float32)
                }
                rows.append({"scene": name, "youngs": youngs, "iterations": count, **errors})
            cells = "".join(f"{row['float64']:10.1e}" for row in rows[-len(options.iterations) :])
            print(f"{name:26s}{youngs:8.0e}{cells}", flush=True)
    found = summary(rows)
    print("\n".join(f"{of}: {text}" for of, text in found.items()))
    if options.out:
        run = describe_run(torch.device("cpu"), 1)
        write_result(options.out, {"schema": 1, **run, "summary": found, "rows": rows})


if __name__ == "__main__":
    main()
