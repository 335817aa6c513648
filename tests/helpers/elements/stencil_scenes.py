"""Scenes of mixed kinds whose converged step is known: from closed forms or an independent float64 prototype.

Places are means of vertices [m], to 1e-6; energies are those of the converged step [J], to 1e-6 of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from cases import beam, beam_tip, box
from numpy.typing import NDArray

from torchpd.reference import StepProblem, elements, step_problem
from torchpd.scene import SceneValues
from torchpd.scene.pins import PinnedComponents
from torchpd.scene.stencils import StencilGroup

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Point = tuple[float, float, float]
GRAVITY = np.array([0.0, -9.8, 0.0])


@dataclass(frozen=True)
class StencilScene:
    """A step of a mixed scene and what is known of its converged state."""

    values: SceneValues
    velocities: Array  # [V, 3]
    time_step: float
    energy: float  # E* [J]
    places: tuple[tuple[Index, Point], ...]  # mean position of some vertices
    start: str = "inertial"
    positions: Array | None = None  # [V, 3], those at rest if none are given
    pin_targets: Array | None = None

    def problem(self) -> StepProblem:
        at = self.values.rest_positions if self.positions is None else self.positions
        return step_problem(self.values, at, self.velocities, self.time_step, pin_targets=self.pin_targets)


def bare_values(
    positions: Array,
    masses: Array,
    stencils: Sequence[StencilGroup],
    held: Index,
    *,
    gravity: Array = GRAVITY,
    component: Index | None = None,
) -> SceneValues:
    """A scene without tetrahedra, all vertices in one component by default, some of them held."""
    parts = np.zeros(len(positions), dtype=np.int64) if component is None else component
    pinned = PinnedComponents.of(positions, masses, parts, held)
    return SceneValues(
        rest_positions=positions,
        tets=np.zeros((0, 4), dtype=np.int64),
        stiffness=np.zeros(0),
        density=np.zeros(0),
        masses=masses,
        pin_vertices=held,
        pin_stiffness=np.full(len(held), np.inf),
        pin_targets=positions[held],
        gravity=gravity,
        planes=np.zeros((0, 5)),
        spheres=np.zeros((0, 5)),
        damping=0.0,
        component=parts,
        pinned=pinned,
        loose=pinned.loose(np.ones(len(held), dtype=np.bool_)),
        stencils=tuple(stencils),
    )


def group(
    kind: str,
    corners: Index,
    gradients: Array,
    measure: Array,
    *,
    constants: Array | None = None,
    **material: float | Array,
) -> StencilGroup:
    """A group, without constants by default; rows given as numbers are the same for all."""
    count = len(corners)
    rows = {name: np.array(np.broadcast_to(value, (count, *np.shape(value)[1:]))) for name, value in material.items()}
    measures = np.array(np.broadcast_to(measure, count))
    return StencilGroup(
        kind=kind,
        corners=corners,
        gradients=gradients,
        measure=measures,
        constants=np.zeros((count, 0)) if constants is None else constants,
        material=rows,
    )


# Springs


def springs(pairs: Index, stiffness: float, length: float) -> StencilGroup:
    """Springs k / 2 (|x1 - x0| - L)^2."""
    gradients = np.tile(np.array([[-1.0], [1.0]]), (len(pairs), 1, 1))
    return group("spring", pairs, gradients, np.ones(1), spring_stiffness=stiffness, rest_length=length)


def pulled_spring() -> StencilScene:
    """A mass at rest on a spring drawn to 1.1 of its length: (m/h^2 1.1 L + k L) / (m/h^2 + k)."""
    mass, k, length, h = 0.01, 500.0, 0.05, 1.0 / 60.0
    positions = np.array([[0.0, 0.0, 0.0], [length, 0.0, 0.0]])
    values = bare_values(positions, np.full(2, mass), [springs(np.array([[0, 1]]), k, length)], np.array([0]),
                         gravity=np.zeros(3))  # fmt: skip
    inertia, drawn = mass / h**2, 1.1 * length
    end = (inertia * drawn + k * length) / (inertia + k)
    energy = 0.5 * inertia * (drawn - end) ** 2 + 0.5 * k * (end - length) ** 2
    places = ((np.array([1]), (end, 0.0, 0.0)),)
    return StencilScene(values, np.zeros((2, 3)), h, energy, places, positions=positions * [1.1, 1.0, 1.0])


def chain() -> StencilScene:
    """Twenty springs along x, the first vertex held."""
    positions = np.zeros((21, 3))
    positions[:, 0] = 0.05 * np.arange(21)
    pairs = np.stack([np.arange(20), np.arange(1, 21)], axis=1)
    velocities = np.stack([np.full(21, 0.5), 3.0 * positions[:, 0], np.zeros(21)], axis=1)
    velocities[0] = 0.0
    values = bare_values(positions, np.full(21, 0.01), [springs(pairs, 500.0, 0.05)], np.array([0]))
    places = ((np.array([20]), (1.0080610411, 0.0472641632, 0.0)),)
    return StencilScene(values, velocities, 1.0 / 60.0, 4.2699841885e-3, places)


# Cloth


def sheet(size: tuple[float, float], cells: tuple[int, int], *, alternating: bool = True) -> tuple[Array, Index]:
    """Vertices (i, j) at id i (nz + 1) + j in x-z, two triangles a cell; diagonals from (i, j) where i + j is even."""
    axes = [np.linspace(0.0, length, count + 1) for length, count in zip(size, cells, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    positions = np.stack([grid[:, 0], np.zeros(len(grid)), grid[:, 1]], axis=1)
    i, j = (index.reshape(-1) for index in np.meshgrid(*(np.arange(count) for count in cells), indexing="ij"))
    a = i * (cells[1] + 1) + j
    b, c, d = a + cells[1] + 1, a + cells[1] + 2, a + 1
    up = ((i + j) % 2 == 0)[:, None] if alternating else np.ones((len(i), 1), dtype=np.bool_)
    first = np.where(up, np.stack([a, b, c], axis=1), np.stack([a, b, d], axis=1))
    second = np.where(up, np.stack([a, c, d], axis=1), np.stack([b, c, d], axis=1))
    return positions, np.concatenate([first, second])


def membrane(positions: Array, triangles: Index, stretch: float, poisson: float) -> StencilGroup:
    """Triangles with Y = `stretch` N/m, as Young's modulus times a thickness of 1 m."""
    a = positions[triangles[:, 1]] - positions[triangles[:, 0]]
    b = positions[triangles[:, 2]] - positions[triangles[:, 0]]
    length = np.linalg.norm(a, axis=1)
    along = (a * b).sum(axis=1) / length
    across = np.sqrt((b**2).sum(axis=1) - along**2)
    edges = np.zeros((len(triangles), 2, 2))
    edges[:, 0, 0], edges[:, 0, 1], edges[:, 1, 1] = length, along, across
    inverse = np.linalg.inv(edges)
    gradients = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
    material = {"membrane_youngs": stretch, "membrane_poisson": poisson, "thickness": 1.0}
    return group("triangle", triangles, gradients, 0.5 * length * across, **material)


def hinges(positions: Array, triangles: Index, bending: float) -> StencilGroup:
    """Flat hinges of all interior edges (x0, x1), opposite corners x2, x3: F = sum c_a x_a / A (Bergou et al. 2006)."""
    opposite: dict[tuple[int, int], list[int]] = {}
    for triangle in triangles.tolist():
        for k in range(3):
            edge = sorted((triangle[(k + 1) % 3], triangle[(k + 2) % 3]))
            opposite.setdefault((edge[0], edge[1]), []).append(triangle[k])
    corners = np.array([[*edge, *others] for edge, others in opposite.items() if len(others) == 2])
    x = [positions[corners[:, k]] for k in range(4)]

    def cotangent(at: int, one: int, other: int) -> Array:
        u, v = x[one] - x[at], x[other] - x[at]
        return np.asarray((u * v).sum(axis=1) / np.linalg.norm(np.cross(u, v), axis=1))

    c01, c02, c03, c04 = cotangent(0, 1, 2), cotangent(0, 1, 3), cotangent(1, 0, 2), cotangent(1, 0, 3)
    c = np.stack([c03 + c04, c01 + c02, -c01 - c03, -c02 - c04], axis=1)
    area = sum(0.5 * np.linalg.norm(np.cross(x[1] - x[0], x[k] - x[0]), axis=1) for k in (2, 3))
    gradients = (c / area[:, None])[:, :, None]
    return group("hinge", corners, gradients, area, bending=bending, rest_curvature=0.0)


def cloth_masses(positions: Array, triangles: Index, density: float) -> Array:
    """A third of each triangle's mass [kg] at each corner; density in kg/m^2."""
    corners = positions[triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return np.bincount(triangles.reshape(-1), weights=np.repeat(density * area / 3.0, 3))


def cloth(
    stretch: float, bending: float, energy: float, places: dict[str, Point], *, poisson: float = 0.0, cells: int = 30
) -> StencilScene:
    """A square metre in x-z held at x = 0, pulled along x by gravity, with v_y = 3 x^2; places: "edge", "middle"."""
    positions, triangles = sheet((1.0, 1.0), (cells, cells))
    held = np.flatnonzero(positions[:, 0] < 1e-9)
    velocities = np.zeros_like(positions)
    velocities[:, 1] = 3.0 * positions[:, 0] ** 2
    groups = [membrane(positions, triangles, stretch, poisson), hinges(positions, triangles, bending)]
    masses = cloth_masses(positions, triangles, 0.2)
    values = bare_values(positions, masses, groups, held, gravity=np.array([9.8, 0.0, 0.0]))
    of = {
        "edge": np.flatnonzero(positions[:, 0] > 1.0 - 1e-9),
        "middle": np.array([np.abs(positions - [0.5, 0.0, 0.5]).sum(axis=1).argmin()]),
    }
    known = tuple((of[name], place) for name, place in places.items())
    return StencilScene(values, velocities, 1.0 / 60.0, energy, known, start="velocity")


SOFT_CLOTH = (1e3, 1e-5, 2.8420816339e-3, {
    "edge": (0.9993034292, 0.0496638513, 0.5), "middle": (0.5004800001, 0.0125159489, 0.5),
})  # fmt: skip
FIRM_CLOTH = (1e4, 1e-4, 3.4802744431e-3, {
    "edge": (0.9984904528, 0.0495717668, 0.5), "middle": (0.4998827068, 0.0125242734, 0.5),
})  # fmt: skip


# Solids


@dataclass(frozen=True)
class SolidCase:
    """The swinging beam with a Poisson's ratio: mean of its x = 1 face and energy."""

    youngs: float
    poisson: float
    cells: bool  # whether the six tetrahedra of a cell share their trace
    tip: Point
    energy: float

    def scene(self) -> StencilScene:
        case = beam(self.youngs)
        values = case.scene.values()
        count = len(values.tets)
        share = np.arange(count) // 6 if self.cells else None
        mixed = replace(values, poisson=np.full(count, self.poisson), tet_group=share)
        return StencilScene(mixed, case.velocities, case.time_step, self.energy, ((beam_tip(), self.tip),))


SOLID_CASES = (
    SolidCase(1e5, 0.3, False, (0.9774019721, -0.2054170812, 0.1003131148), 13.1941209022),
    SolidCase(1e5, 0.45, False, (0.9773636587, -0.2051780154, 0.1004013304), 13.6292909797),
    SolidCase(1e6, 0.3, False, (0.9627906799, -0.1820217096, 0.1008414258), 37.4949486691),
    SolidCase(1e6, 0.45, False, (0.9634005398, -0.1787967183, 0.1023433305), 42.4101395319),
    SolidCase(1e6, 0.3, True, (0.9626007660, -0.1827579540, 0.1004801691), 36.4811002465),
    SolidCase(1e6, 0.45, True, (0.9624795040, -0.1827521738, 0.1004037982), 36.9611426155),
)


def of_tets(kind: str, values: SceneValues, chosen: Index, **material: float | Array) -> StencilGroup:
    """Elements of width 3 on some of the tetrahedra."""
    shape = elements(values.rest_positions, values.tets[chosen])
    return group(kind, values.tets[chosen], shape.shape_gradients, shape.volumes, **material)


def limited_beam(stiffness: float, tip: Point, energy: float) -> StencilScene:
    """The swinging beam at E = 1e5, also thrown along itself, its stretches limited to [.95, 1.05]."""
    case = beam(1e5)
    values = case.scene.values()
    velocities = case.velocities + case.positions * [3.0, 0.0, 0.0]
    rows = np.array([[0.95, 1.05, stiffness]])
    limit = of_tets("solid_limit", values, np.arange(len(values.tets)), solid_limit=rows)
    mixed = replace(values, stencils=(limit,))
    return StencilScene(mixed, velocities, case.time_step, energy, ((beam_tip(), tip),), start="velocity")


LIMITED_BEAMS = (
    (1e6, (1.01866847, -0.17343950, 0.10036641), 64.384202),
    (1e7, (0.99970532, -0.15216458, 0.10114496), 92.143749),
)


def muscle_beam(*, upper: bool, tip: Point, energy: float) -> StencilScene:
    """The beam at rest with fibres along x that contract to 0.7, in its upper half or everywhere."""
    case = beam(1e5)
    values = case.scene.values()
    height = values.rest_positions[values.tets].mean(axis=1)[:, 1]
    chosen = np.flatnonzero((height > 0.1) | (not upper))
    shape = elements(values.rest_positions, values.tets[chosen])
    rows = {"fibre_stiffness": 1e5, "fibre_length": 0.7}
    slack = np.zeros((len(chosen), 1))
    along = shape.shape_gradients[:, :, :1]
    fibres = group("fibre", values.tets[chosen], along, shape.volumes, constants=slack, **rows)
    mixed = replace(values, stencils=(fibres,))
    still = np.zeros_like(case.velocities)
    return StencilScene(mixed, still, case.time_step, energy, ((beam_tip(), tip),), start="velocity")


MUSCLE_BEAMS = (
    (True, (0.96384975, 0.10959840, 0.09949347), 70.866612),
    (False, (0.93133144, 0.08863226, 0.09975887), 139.274593),
)


def _bar(density: float) -> tuple[Array, Index, Array, Index]:
    """A bar 1 x .2 x .2 of 10x2x2 cells: positions, tets, masses, and the vertices of both ends, left ones first."""
    positions, tets = box((1.0, 0.2, 0.2), (10, 2, 2))
    share = np.repeat(density * elements(positions, tets).volumes / 4.0, 4)
    ends = [np.flatnonzero(np.abs(positions[:, 0] - x) < 1e-9) for x in (0.0, 1.0)]
    return positions, tets, np.bincount(tets.reshape(-1), weights=share), np.concatenate(ends)


def capped_box() -> StencilScene:
    """A box of nu = .45 drawn to 1.6 of its length, its end scaled by 1.3: a tenth of the tetrahedra are capped."""
    positions, tets, masses, held = _bar(1000.0)
    values = replace(
        bare_values(positions, masses, (), held),
        tets=tets,
        stiffness=np.full(len(tets), 1e5),
        density=np.full(len(tets), 1000.0),
        poisson=np.full(len(tets), 0.45),
    )
    targets = positions[held]
    right = targets[:, 0] > 0.5
    targets[right] = (targets[right] - [1.0, 0.1, 0.1]) * [1.0, 1.3, 1.3] + [1.6, 0.1, 0.1]
    find = lambda point: np.array([np.abs(positions - point).sum(axis=1).argmin()])  # noqa: E731
    places = (
        (find([0.5, 0.1, 0.1]), (0.6348349910, 0.0910681638, 0.0996792692)),
        (find([0.5, 0.0, 0.0]), (0.6345501489, 0.0121974829, 0.0210733600)),
    )
    still = np.zeros_like(positions)
    return StencilScene(values, still, 1.0 / 30.0, 2225.854545, places, start="velocity", pin_targets=targets)


def small_beam(youngs: float, poisson: float) -> StencilScene:
    """The swinging beam with 10x2x2 cells."""
    positions, tets, masses, ends = _bar(1000.0)
    values = replace(
        bare_values(positions, masses, (), ends[: len(ends) // 2]),
        tets=tets,
        stiffness=np.full(len(tets), youngs),
        density=np.full(len(tets), 1000.0),
        poisson=np.full(len(tets), poisson),
    )
    velocities = np.zeros_like(positions)
    velocities[:, 1] = -10.0 * positions[:, 0] ** 2
    return StencilScene(values, velocities, 1.0 / 30.0, 0.0, ())


def plastic_bar() -> tuple[SceneValues, StencilGroup]:
    """The bar without gravity, held at both ends, E = 1e6 and nu = .3, before any flow; its elements are plastic."""
    positions, tets, masses, held = _bar(1.0)
    values = bare_values(positions, masses, (), held, gravity=np.zeros(3))
    shape = elements(positions, tets)
    plastic = group("plastic", tets, shape.shape_gradients, shape.volumes, plastic_youngs=1e6, plastic_poisson=0.3)
    return values, plastic


# elastic force of the right face [N] by step, and the mean hardening variable at the end
PLASTIC_FORCES = {1: 1548.1698, 2: 3097.1754, 3: 3603.8731, 8: 3000.7086, 9: 860.5419, 16: -3255.7570}
PLASTIC_ALPHA = 0.446692
