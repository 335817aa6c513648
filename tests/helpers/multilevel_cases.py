"""Steps that are hard for a Jacobi iteration, and M from its tables in plain NumPy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from cases import Array, Case, Index, box, oriented
from runs import arguments_of, displacement, simulator, state_of
from scipy.sparse import bsr_array, csr_array
from scipy.sparse.linalg import LinearOperator, eigsh, splu
from scipy.spatial import Delaunay

import torchpd as pd
from torchpd import _C
from torchpd.plan import Plan
from torchpd.plan.preconditioner import precondition_plan, stored_reference
from torchpd.reference.pieces import Pieces

SOLVERS = [pd.Multilevel(), pd.Multilevel("momentum")]
IDS = ["lbfgs", "momentum"]


def swing(cells: int, youngs: float, **material: Any) -> Case:
    """The box of 5r x r x r cells that swings about its held end."""
    vertices, tets = box((1.0, 0.2, 0.2), (5 * cells, cells, cells))
    body = pd.Solid(pd.TetMesh(vertices, tets), youngs=youngs, density=1000.0, **material)
    velocities = np.zeros_like(vertices)
    velocities[:, 1] = -10.0 * vertices[:, 0] ** 2
    scene = pd.Scene(body, pd.Pin(body, vertices[:, 0] == 0.0), pd.Gravity((0.0, -9.8, 0.0)))
    return Case(scene, vertices, velocities, 1.0 / 30.0, start="inertial")


def slabs() -> Case:
    """The swinging beam of 25 x 5 x 5 cells, 1e4 and 1e8 Pa in turn along it, every two cells."""
    case = swing(5, 1e4)
    vertices, tets = box((1.0, 0.2, 0.2), (25, 5, 5))
    cell = np.floor(25.0 * vertices[tets].mean(axis=1)[:, 0]).astype(np.int64)
    body = pd.Solid(pd.TetMesh(vertices, tets), np.where(cell // 2 % 2 == 1, 1e8, 1e4), density=1000.0)
    scene = pd.Scene(body, pd.Pin(body, vertices[:, 0] == 0.0), pd.Gravity((0.0, -9.8, 0.0)))
    return replace(case, scene=scene)


def twist(cells: int, youngs: float) -> Case:
    """The same box, at rest, its free face turned by 90 degrees about the long axis."""
    vertices, tets = box((1.0, 0.2, 0.2), (5 * cells, cells, cells))
    body = pd.Solid(pd.TetMesh(vertices, tets), youngs=youngs, density=1000.0)
    ends = [pd.Pin(body, vertices[:, 0] == x) for x in (0.0, 1.0)]
    scene = pd.Scene(body, *ends)
    targets = vertices[scene.values().pin_vertices]
    turned = targets[:, 0] == 1.0
    y, z = targets[turned, 1] - 0.1, targets[turned, 2] - 0.1
    targets[turned, 1], targets[turned, 2] = 0.1 - z, 0.1 + y
    return Case(scene, vertices, 0.0 * vertices, 1.0 / 30.0, extras={"pin_targets": targets})


def irregular(*, seed: int = 0) -> Case:
    """A tetrahedralised octopus, held where it is low, with stiffness random over two decades from tet to tet.

    Its tets count as full: what they enclose would make it three decades.
    """
    lattice = pd.tetrahedralize(pd.shapes.octopus(), cells=14)
    mesh = pd.TetMesh(lattice.vertices, lattice.tets)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    stiffness = 10.0 ** np.random.default_rng(seed).uniform(6.0, 8.0, len(mesh.tets))
    body = pd.Solid(mesh, youngs=stiffness, density=1000.0)
    velocities = np.zeros_like(mesh.vertices)
    velocities[:, 0] = 10.0 * ((mesh.vertices[:, 1] - low[1]) / (high - low).max()) ** 2
    held = pd.Pin(body, mesh.vertices[:, 1] < low[1] + 0.1 * (high - low)[1])
    return Case(pd.Scene(body, held, pd.Gravity((0.0, -9.8, 0.0))), np.array(mesh.vertices), velocities, 1.0 / 30.0)


def landing(youngs: float, *, friction: float = 0.0, size: float = 0.02, cells: int = 4) -> Case:
    """A tilted cube that a step takes into the ground: sound crosses one of 2 cm and 1e6 Pa 26 times in it."""
    vertices, tets = box((size, size, size), (cells, cells, cells))
    c, s = np.cos(0.35), np.sin(0.35)
    vertices = vertices @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    ground = pd.Ground(float(vertices[:, 1].min()) - 0.001 * size, friction=friction)
    scene = pd.Scene(pd.Solid(pd.TetMesh(vertices, tets), youngs), pd.Gravity(), ground)
    velocities = np.tile([0.3, -0.3, 0.1], (len(vertices), 1))
    return Case(scene, vertices, velocities, 1.0 / 60.0)


def many_bodies(count: int = 300) -> Case:
    """Single tetrahedra that nothing joins, every other one held at a corner."""
    corners = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    vertices = np.concatenate([corners + [0.2 * i, 0.0, 0.0] for i in range(count)])
    tets: Index = oriented(vertices, np.arange(4 * count).reshape(-1, 4))
    body = pd.Solid(pd.TetMesh(vertices, tets), youngs=1e6)
    velocities = np.random.default_rng(0).standard_normal(vertices.shape)
    return Case(pd.Scene(body, pd.Pin(body, np.arange(0, 4 * count, 8))), vertices, velocities, 1.0 / 60.0)


def converged(case: Case, **options: Any) -> Array:
    """Displacement of the step by many iterations of the solver under test; the reference finds no force left."""
    sim = simulator(case, torch.float64, solver=pd.Multilevel(), iterations=600, **options)
    u = displacement(sim, sim(state_of(case, sim), **arguments_of(case, sim)))
    problem = case.problem()
    start = problem.residual(problem.first_iterate(case.start))
    assert np.linalg.norm(problem.residual(u)) <= 1e-9 * np.linalg.norm(start)
    return u


def build_levels(sim: pd.Simulator, *, folded: bool) -> dict[str, Any]:
    """The arrays of its preconditioner, which has levels, in float64; `folded`: as a GPU plan has them."""
    stiffness, inertia = (array.cpu().double().numpy() for array in stored_reference(sim.plan.arrays))
    values, order = sim.scene.values(), sim.plan.vertex_order.cpu().numpy()
    return _C.build_multilevel(
        values.rest_positions, values.tets, [], order, stiffness, inertia,
        0, folded, torch.get_num_threads(), lambda _: None,
    )  # fmt: skip


def pieces_of(plan: Plan) -> Pieces:
    """The pieces in a plan, in the user's order of vertices."""
    order, of = plan.vertex_order.numpy(), plan.piece_of.numpy().reshape(-1, 4)
    weight = plan.piece_weight.numpy().astype(np.float64).reshape(-1, 4)
    entries = (weight.ravel(), (np.repeat(order, 4), of.ravel()))
    shares = csr_array(entries, shape=(len(order), int(plan.level_sizes[7])))
    shares.eliminate_zeros()
    main = np.empty(len(order), np.int64)
    main[order] = np.where(weight[:, 0] > 0.0, of[:, 0], -1)
    return Pieces(main, shares)


class Tables:
    """M as the tables say it, in float64: a V-cycle with Chebyshev smoothing of degree 2 on [1/4, 1]."""

    def __init__(self, plan: Plan) -> None:
        t = {row.name: array.numpy() for row, array in zip(plan.table, plan.arrays, strict=True)}
        count, (_, _, nodes, _, _, below, direct, *_) = len(t["vertex_order"]), t["level_sizes"].tolist()
        self.order = t["vertex_order"]
        self.levels = []
        if not direct:
            self.levels.append(
                (
                    csr_array((t["fine_value"], t["fine_column"], t["fine_start"]), shape=(count, count)),
                    t["fine_inverse"].reshape(-1, 1),
                    self._blocks(t, "fine_prolongation", 1, (count, 4 * nodes)),
                )
            )
        if below:
            shape = (4 * nodes, 4 * nodes)
            value = t["middle_value"].reshape(-1, 4, 4)
            self.levels.append(
                (
                    csr_array(bsr_array((value, t["middle_column"], t["middle_start"]), shape=shape)),
                    t["middle_inverse"].reshape(-1, 1),
                    self._blocks(t, "middle_prolongation", 4, (4 * nodes, 4 * below)),
                )
            )
        size = count if direct else 4 * (below or nodes)
        self.factor = np.zeros((size, size))
        self.factor[np.tril_indices(size)] = t["coarse_factor"]

    @staticmethod
    def _blocks(t: dict[str, Any], name: str, height: int, shape: tuple[int, int]) -> csr_array:
        weight = t[f"{name}_weight"].reshape(-1, height, 4)
        return csr_array(bsr_array((weight, t[f"{name}_node"], t[f"{name}_start"]), shape=shape))

    @staticmethod
    def smooth(matrix: csr_array, inverse: Array, right: Array) -> Array:
        # Chebyshev iteration, Saad 2003, algorithm 12.1, two steps
        middle, half = 0.625, 0.375
        step = inverse * right / middle
        result = step
        rho = half / middle
        following = 1.0 / (2.0 * middle / half - rho)
        step = following * rho * step + 2.0 * following / half * inverse * (right - matrix @ result)
        return np.asarray(result + step)

    def _cycle(self, level: int, right: Array) -> Array:
        if level == len(self.levels):
            return np.asarray(self.factor.T @ (self.factor @ right))
        matrix, inverse, prolongation = self.levels[level]
        z = self.smooth(matrix, inverse, right)
        z = z + prolongation @ self._cycle(level + 1, prolongation.T @ (right - matrix @ z))
        return np.asarray(z + self.smooth(matrix, inverse, right - matrix @ z))

    def __call__(self, field: Array) -> Array:
        """M of a field [V, 3] in the user's order."""
        result = np.empty_like(field)
        result[self.order] = self._cycle(0, field[self.order])
        return result


def solved_directly(sim: pd.Simulator, most: int = 1024) -> pd.Simulator:
    """The simulator with M = A^-1 where it has up to so many vertices, as on a GPU."""
    sim.plan = precondition_plan(sim.plan, sim.scene.values(), *stored_reference(sim.plan.arrays), most_direct=most)
    return sim


def precondition(sim: pd.Simulator, field: Array) -> Array:
    """M of a field [V, 3] by the op."""
    given = torch.tensor(field, dtype=sim.dtype)[None]
    out: Array = torch.ops.torchpd.precondition(given, list(sim.plan.arrays))[0].double().numpy()
    return out


def spectrum_of(sim: pd.Simulator, case: Case) -> tuple[float, float]:
    """Smallest and largest eigenvalue of M A over the free vertices, A from the reference."""
    problem = case.problem()
    free = np.flatnonzero(problem.free)
    matrix = problem.matrix[free][:, free].tocsc()
    solve = splu(matrix).solve

    def image(x: Array) -> Array:
        field = np.zeros((len(problem.free), 3))
        field[free, 0] = matrix @ x.reshape(-1)
        return np.asarray(matrix @ precondition(sim, field)[free, 0])

    shape = matrix.shape
    operator, inverse = LinearOperator(shape, matvec=image), LinearOperator(shape, matvec=solve)
    low, high = (
        float(eigsh(operator, k=1, M=matrix, Minv=inverse, which=end, return_eigenvectors=False, tol=1e-3)[0])
        for end in ("SA", "LA")
    )
    return low, high


def plate(youngs: float) -> tuple[pd.Simulator, pd.State]:
    """Delaunay tetrahedra of random points, slivers among them, a third of which lie on the smooth ground below."""
    points = np.random.default_rng(0).uniform(size=(700, 3)) * (1.0, 0.06, 0.5)
    points[:250, 1] = 0.0
    tets = Delaunay(points).simplices.astype(np.int64)
    volumes = np.linalg.det(points[tets[:, 1:]] - points[tets[:, :1]]) / 6.0
    tets = np.where((volumes < 0.0)[:, None], tets[:, [0, 2, 1, 3]], tets)[np.abs(volumes) > 1e-9]
    scene = pd.Scene(pd.Solid(pd.TetMesh(points, tets), youngs, 1000.0), pd.Gravity(), pd.Ground(-0.02))
    sim = pd.Simulator(scene, 1 / 60, 600, dtype=torch.float64, progress=False)
    state = sim.rest_state()
    state.velocities[..., 1] = -2.0
    for _ in range(3):
        state = sim(state)
    return sim, state
