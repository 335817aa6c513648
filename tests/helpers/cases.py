"""Scenes with known answers, as data, shared by all tests. KNOWN_* were computed once by independent prototypes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Delaunay

from torchpd import TetMesh
from torchpd.reference import StepProblem, elements, step_problem
from torchpd.scene import Part, Scene
from torchpd.scene.effects import Gravity, Ground, Pin, Solid, Sphere

Array = NDArray[np.float64]
Index = NDArray[np.int64]

BEAM_STIFFNESS = (1e4, 1e5, 1e6)
BEAM_CELLS = (25, 5, 5)

# converged step: mean of the x = 1 face [m]; +-1e-6 in float64, +-2e-5 in float32
KNOWN_TIP = {
    1e4: (0.993170, -0.218141, 0.100221),
    1e5: (0.977397, -0.205176, 0.100329),
    1e6: (0.962635, -0.182398, 0.100623),
}
# |x - x*| / |x_0 - x*| at E = 1e6 from the inertial start
KNOWN_JACOBI = {1: 0.967649, 10: 0.819060, 50: 0.630731, 100: 0.566253, 200: 0.497272}  # theta = 1, plain D; +-1e-5
KNOWN_CLASSIC = {50: 0.397752, 100: 0.271904, 200: 0.152104}  # and rho = .995, S = 10; +-1e-4
KNOWN_SPECTRUM = (8.9754e-4, 1.9991)  # extreme eigenvalues of D^-1 A at E = 1e6, +-1 %


@dataclass(frozen=True)
class Case:
    """A scene and the state from which a step starts."""

    scene: Scene
    positions: Array  # [V, 3]
    velocities: Array  # [V, 3]
    time_step: float
    start: str | Array = "velocity"
    extras: dict[str, Array] = field(default_factory=dict)  # forces, pin_targets, sphere_centers, sphere_starts

    def problem(self) -> StepProblem:
        """The step in the reference."""
        return step_problem(self.scene.values(), self.positions, self.velocities, self.time_step, **self.extras)


def box(size: tuple[float, float, float], cells: tuple[int, int, int]) -> tuple[Array, Index]:
    """Kuhn's six tetrahedra a cell; vertex (i, j, k) at id (i (ny + 1) + j) (nz + 1) + k."""
    axes = [np.linspace(0.0, length, count + 1) for length, count in zip(size, cells, strict=True)]
    vertices = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    strides = np.array([(cells[1] + 1) * (cells[2] + 1), cells[2] + 1, 1])
    places = np.stack(np.meshgrid(*(np.arange(count) for count in cells), indexing="ij"), axis=-1).reshape(-1, 3)
    corner = places @ strides
    tets = []
    for path in ((0, 1, 2), (1, 2, 0), (2, 0, 1), (0, 2, 1), (2, 1, 0), (1, 0, 2)):
        walk = np.concatenate([[0], np.cumsum(strides[list(path)])])
        odd = path in ((0, 2, 1), (2, 1, 0), (1, 0, 2))
        tets.append(corner[:, None] + (walk[[0, 2, 1, 3]] if odd else walk))
    return vertices, np.stack(tets, axis=1).reshape(-1, 4)


def oriented(vertices: Array, tets: Index) -> Index:
    """Swap two corners of every tetrahedron of negative volume."""
    inverted = np.linalg.det(vertices[tets][:, 1:] - vertices[tets][:, :1]) < 0.0
    return np.where(inverted[:, None], tets[:, [0, 2, 1, 3]], tets)


def beam_mesh(*, jitter: float = 0.0, seed: int = 0) -> TetMesh:
    """The beam; `jitter` moves every vertex by up to that share of a cell along each axis.

    From 0.25 on some tetrahedra turn over: they are wound anew, and the mesh overlaps itself there.
    """
    vertices, tets = box((1.0, 0.2, 0.2), BEAM_CELLS)
    shift = np.random.default_rng(seed).uniform(-jitter, jitter, vertices.shape) * 0.04
    return TetMesh(vertices + shift, oriented(vertices + shift, tets))


def beam_tip() -> Index:
    """Vertices of the face x = 1."""
    return np.arange(25 * 36, 26 * 36)


def beam(youngs: float) -> Case:
    """The swinging beam: x = 0 face held, v_y = -10 x^2, inertial start."""
    mesh = beam_mesh()
    body = Solid(mesh, youngs=youngs, density=1000.0)
    velocities = np.zeros_like(mesh.vertices)
    velocities[:, 1] = -10.0 * mesh.vertices[:, 0] ** 2
    scene = Scene(body, Pin(body, np.arange(36)), Gravity((0.0, -9.8, 0.0)))
    return Case(scene, np.array(mesh.vertices), velocities, 1.0 / 30.0, start="inertial")


def hard_start(kind: str, *, seed: int = 0) -> Case:
    """The beam at rest at E = 1e6, start "random" in the unit cube, "collapsed" to a point, or "mirrored" in y."""
    still = beam(1e6)
    guesses = {
        "random": np.random.default_rng(seed).uniform(0.0, 1.0, still.positions.shape),
        "collapsed": np.zeros_like(still.positions),
        "mirrored": still.positions * [1.0, -1.0, 1.0],
    }
    return Case(still.scene, still.positions, np.zeros_like(still.positions), still.time_step, start=guesses[kind])


def sliver_mesh(cells: tuple[int, int, int] = (8, 3, 3), *, seed: int = 0) -> TetMesh:
    """Delaunay of a slightly disturbed grid: many almost flat tetrahedra, l_e up to almost 4."""
    points, _ = box((cells[0] * 0.1, cells[1] * 0.1, cells[2] * 0.1), cells)
    points = points + np.random.default_rng(seed).uniform(-0.003, 0.003, points.shape)
    tets = oriented(points, Delaunay(points).simplices.astype(np.int64))
    volumes = np.linalg.det(points[tets][:, 1:] - points[tets][:, :1]) / 6.0
    # a regular share of a cell is 1e-3 / 6 m^3: keep slivers down to some 1e-3 of that
    return TetMesh(points, tets[volumes > 2e-7])


def cone_mesh(points: int, *, radius: float = 0.2) -> TetMesh:
    """A ball of 2 points - 4 tetrahedra, all of which have its centre, vertex 0, as a corner."""
    number = np.arange(points)
    angle, height = np.pi * (1.0 + 5.0**0.5) * number, 1.0 - (2.0 * number + 1.0) / points
    around = np.sqrt(1.0 - height**2)
    sphere = np.stack([around * np.cos(angle), around * np.sin(angle), height], axis=1)
    faces = 1 + ConvexHull(sphere).simplices.astype(np.int64)
    vertices = radius * np.concatenate([np.zeros((1, 3)), sphere])
    return TetMesh(vertices, oriented(vertices, np.column_stack([0 * faces[:, 0], faces])))


def slivers(*, seed: int = 0) -> Case:
    """A sliver mesh with stiffness random (log-uniform) over 1e4..1e6, held at one end and swung."""
    mesh = sliver_mesh(seed=seed)
    stiffness = 10.0 ** np.random.default_rng(seed + 1).uniform(4.0, 6.0, len(mesh.tets))
    body = Solid(mesh, youngs=stiffness, density=1000.0)
    velocities = np.zeros_like(mesh.vertices)
    velocities[:, 1] = -10.0 * mesh.vertices[:, 0] ** 2
    scene = Scene(body, Pin(body, mesh.vertices[:, 0] < 0.05), Gravity((0.0, -9.8, 0.0)))
    return Case(scene, np.array(mesh.vertices), velocities, 1.0 / 30.0)


def contact_block(
    *parts: Part,
    height: float = 0.0,
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gravity: tuple[float, float, float] = (0.0, -9.8, 0.0),
    youngs: float = 1e5,
    cells: int = 3,
) -> Case:
    """A free cube of edge 0.3 m whose lower face is at `height`, with the given contacts."""
    vertices, tets = box((0.3, 0.3, 0.3), (cells, cells, cells))
    vertices = vertices + [0.0, height, 0.0]
    body = Solid(TetMesh(vertices, tets), youngs=youngs, density=1000.0)
    scene = Scene(body, Gravity(gravity), *parts)
    return Case(scene, vertices, np.tile(velocity, (len(vertices), 1)), 1.0 / 60.0)


def rotation(*degrees: float) -> Array:
    """About x, then y, then z."""
    matrix = np.eye(3)
    for axis, angle in enumerate(np.radians(degrees)):
        turn = np.eye(3)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn[i, i] = turn[j, j] = np.cos(angle)
        turn[j, i], turn[i, j] = np.sin(angle), -np.sin(angle)
        matrix = turn @ matrix
    return matrix


def leaning(
    friction: float,
    *parts: Part,
    turn: tuple[float, float, float] = (0.0, 20.0, 20.0),
    size: tuple[float, float, float] = (0.05, 0.5, 0.05),
    cells: tuple[int, int, int] = (1, 10, 1),
    gravity: tuple[float, float, float] = (0.0, -9.8, 0.0),
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    youngs: float = 1e7,
    height: float = 0.0,
) -> Case:
    """A bar on its lowest corner, edge or face, on y = 0, or that far above it."""
    vertices, tets = box(size, cells)
    vertices = (vertices - vertices.mean(axis=0)) @ rotation(*turn).T
    vertices[:, 1] += height - vertices[:, 1].min()
    ground = Ground(0.0, friction=friction)
    scene = Scene(Solid(TetMesh(vertices, tets), youngs), Gravity(gravity), ground, *parts)
    return Case(scene, vertices, np.tile(velocity, (len(vertices), 1)), 1.0 / 60.0)


def slope(angle: float, friction: float) -> Case:
    """A cube at rest on a slope [rad]: gravity is tilted instead of the plane, downhill is +x."""
    pull = (9.8 * float(np.sin(angle)), -9.8 * float(np.cos(angle)), 0.0)
    return contact_block(Ground(height=0.0, friction=friction), gravity=pull)


def on_sphere(friction: float = 0.3) -> Case:
    """A cube falling onto a ball."""
    return contact_block(Sphere((0.15, -0.2, 0.15), 0.21, friction), velocity=(0.0, -1.0, 0.0))


def longest_spread(mesh: TetMesh) -> float:
    """Largest l_e of a mesh."""
    return float(elements(mesh.vertices, mesh.tets).eigenvalue_bound.max())


class Still(StepProblem):
    """Without rigid motions."""

    def align(self, displacement: Array) -> Array:
        return displacement
