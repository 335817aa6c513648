"""Elements and scenes of mixed kinds with known answers, as data, and random single elements.

The numbers come from an independent float64 prototype, converged to 1e-12, or from closed forms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from torchpd.scene.stencils import StencilGroup

Array = NDArray[np.float64]
Index = NDArray[np.int64]
GRAVITY = np.array([0.0, -9.8, 0.0])


# Single elements


@dataclass(frozen=True)
class ElementCase:
    """One element of measure 1 at known positions, its energy density and entries of P = dpsi / dF."""

    name: str
    kind: str
    gradients: Array  # [n, d]
    positions: Array  # [n, 3]
    material: dict[str, float | tuple[float, ...]]
    energy: float
    stress: dict[tuple[int, int], float] = field(default_factory=dict)
    constants: tuple[float, ...] = ()
    start: Array | None = None  # [n, 3] positions at the start of the step
    time_step: float = 1.0

    def group(self) -> StencilGroup:
        """The element as a group of one; its vertices are 0..n-1."""
        corners = np.arange(len(self.gradients))[None]
        rows = {name: np.asarray(value, np.float64)[None] for name, value in self.material.items()}
        return StencilGroup(
            kind=self.kind,
            corners=corners,
            gradients=self.gradients[None],
            measure=np.ones(1),
            constants=np.array([self.constants], np.float64).reshape(1, -1),
            material=rows,
        )


def unit_gradients(width: int) -> Array:
    """g [d + 1, d] of the unit simplex: x_1 .. x_d less x_0 are the columns of F."""
    return np.concatenate([-np.ones((1, width)), np.eye(width)])


def unit_positions(F: Array) -> Array:
    """Positions [d + 1, 3] of the unit simplex with the deformation gradient F [3, d]."""
    return np.concatenate([np.zeros((1, 3)), F.T])


def _full(P: Sequence[Sequence[float]]) -> dict[tuple[int, int], float]:
    return {(i, j): value for i, row in enumerate(P) for j, value in enumerate(row)}


def _at(
    name: str,
    kind: str,
    F: Array,
    material: dict[str, float | tuple[float, ...]],
    energy: float,
    stress: dict[tuple[int, int], float],
) -> ElementCase:
    return ElementCase(name, kind, unit_gradients(F.shape[1]), unit_positions(F), material, energy, stress)


def _fold(degrees: float, energy: float) -> ElementCase:
    """A hinge over the diagonal of the unit square in x-z, its sides turned towards each other."""
    half = np.radians(degrees) / 2.0
    middle, side = np.array([0.5, 0.0, 0.5]), np.sqrt(0.5) * np.array([1.0, 0.0, -1.0])
    arms = [sign * np.sqrt(0.5) * np.cos(half) * side + [0.0, np.sqrt(0.5) * np.sin(half), 0.0] for sign in (1, -1)]
    positions = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 1.0], middle + arms[0], middle + arms[1]])
    gradients = np.array([[2.0], [2.0], [-2.0], [-2.0]])  # c of Bergou et al. 2006 over A = 1
    return ElementCase(
        f"fold {degrees}", "hinge", gradients, positions, {"bending": 1.0, "rest_curvature": 0.0}, energy
    )


_F = np.array([[1.1, 0.2, -0.1], [0.05, 0.9, 0.3], [0.0, -0.2, 1.3]])
_INVERTED = np.array([[1.1, 0.2, -0.1], [0.05, 0.9, 0.3], [0.1, -0.2, -0.5]])
_CAPPED = 1.4 * np.eye(3) + 0.1 * (_F - np.eye(3))
_SHEET = np.array([[1.2, 0.3], [0.0, 0.9], [0.1, -0.4]])
_SOFT: dict[str, float | tuple[float, ...]] = {"stiffness": 1.0, "poisson": 0.4}
_RUBBER: dict[str, float | tuple[float, ...]] = {"stiffness": 1.0, "poisson": 0.45}
_CLOTH: dict[str, float | tuple[float, ...]] = {"membrane_youngs": 2.0, "membrane_poisson": 0.3, "thickness": 0.5}


def _uniaxial(stretch: float, nu: float) -> ElementCase:
    """A free bar: lateral stretch 1 - nu (s - 1), stress E (s - 1)."""
    e = stretch - 1.0
    F = np.diag([1.0 + e, 1.0 - nu * e, 1.0 - nu * e])
    stress = _full(np.diag([e, 0.0, 0.0]).tolist())
    return _at(f"uniaxial {stretch} {nu}", "tet", F, {"stiffness": 1.0, "poisson": nu}, 0.5 * e**2, stress)


def _dilation(e: float, nu: float) -> ElementCase:
    """(1 + e) I: P = (2 mu + 3 lambda) e I = E e / (1 - 2 nu) I, and 2 mu (1 + e) I beyond 3 lambda e = 2 mu."""
    shear, bulk = 1.0 / (1.0 + nu), nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
    capped = 3.0 * bulk * e > shear
    p = shear * (1.0 + e) if capped else e / (1.0 - 2.0 * nu)
    volume = 3.0 * shear * e - shear**2 / (2.0 * bulk) if capped else 4.5 * bulk * e**2
    stress = _full((p * np.eye(3)).tolist())
    material: dict[str, float | tuple[float, ...]] = {"stiffness": 1.0, "poisson": nu}
    return _at(f"dilation {e} {nu}", "tet", (1.0 + e) * np.eye(3), material, 1.5 * shear * e**2 + volume, stress)


def _line(kind: str, length: float, rest: float, material: dict[str, float], *constants: float) -> ElementCase:
    """An element of stiffness 3 with F of this length along (2, -1, 2): E = 3 / 2 (|F| - L)^2."""
    corners = {"spring": 2, "tie": 5, "hinge": 4, "fibre": 4, "thread": 3}[kind]
    direction = np.array([2.0, -1.0, 2.0]) / 3.0
    gradients = np.array([[-1.0], [0.6], [0.4], [0.1], [-0.1]])[:corners]
    gradients[-1] -= gradients.sum()
    # corners beyond the second lie on the first
    positions = np.zeros((corners, 3))
    positions[1] = length * direction / gradients[1, 0]
    slack = length < rest and constants == (1.0,)
    pull = 0.0 if slack else 3.0 * (length - rest)
    stress = {(i, 0): pull * component for i, component in enumerate(direction)}
    name = " ".join([kind, str(length), *map(str, constants)])
    given: dict[str, float | tuple[float, ...]] = {**material}
    return ElementCase(name, kind, gradients, positions, given, pull**2 / 6.0, stress, constants)


def _damped() -> ElementCase:
    """The part of damping: 2 mu = 1 and beta / h = b = 0.5 give 0.5 (1.07 - 1.02); elasticity adds 0.07."""
    gradients, start = unit_gradients(3), unit_positions(np.diag([1.02, 1.0, 1.0]))
    positions = unit_positions(np.diag([1.07, 1.0, 1.0]))
    stress = _full(np.diag([0.025, 0.0, 0.0]).tolist())
    material: dict[str, float | tuple[float, ...]] = {"viscosity": 0.05}
    return ElementCase("damped", "damper", gradients, positions, material, 0.25 * 0.05**2, stress, (), start, 0.1)


# before any flow
_VIRGIN: dict[str, float | tuple[float, ...]] = {
    "plastic_youngs": 1.0, "plastic_poisson": 0.4, "yield_strain": 0.05, "hardening": 0.0, "creep_time": 0.0,
    "max_flow": np.inf, "flow": (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0),
}  # fmt: skip

ELEMENT_CASES = (
    _uniaxial(1.3, 0.3),
    _uniaxial(0.8, 0.45),
    _uniaxial(1.2, -0.5),
    _dilation(0.05, 0.4),
    _dilation(0.4, 0.4),
    _at("sheared", "tet", _F, _SOFT, 0.1533328234616, _full([
        [0.59259215583, 0.12839335275, -0.06258442296],
        [0.04784595421, 0.45431170097, 0.17084591456],
        [-0.01184241555, -0.10013721359, 0.73984320579],
    ])),
    _at("inverted", "tet", _INVERTED, _SOFT, 1.6894638741880, {(2, 2): -1.6592959787, (1, 2): -1.6931728596}),
    _at("capped", "tet", _CAPPED, _SOFT, 0.8810446428571, _full((_CAPPED / 1.4).tolist())),
    _at("plastic", "plastic", _F, _VIRGIN, 0.1533328234616, _full([
        [0.59259215583, 0.12839335275, -0.06258442296],
        [0.04784595421, 0.45431170097, 0.17084591456],
        [-0.01184241555, -0.10013721359, 0.73984320579],
    ])),
    _at("solid limit", "solid_limit", _F, {"solid_limit": (0.95, 1.05, 1.0)}, 0.0534945564887,
        {(0, 0): 0.0750619053935, (2, 2): 0.2787569508876}),
    _at("volume", "volume", _F, {"volume_stiffness": 1.0}, 0.0144971184378, {(0, 0): 0.0942891129186}),
    _at("membrane", "triangle", _SHEET, _CLOTH, 0.0385037013576, _full([
        [0.23507462099, 0.12274321678], [0.07582170255, 0.06494284012], [-0.01621514112, -0.02043885088],
    ])),
    _at("rank one", "triangle", np.array([[1.2, 0.6], [0.4, 0.2], [0.0, 0.0]]), _CLOTH, 0.5071674383681, {}),
    _at("cloth limit", "cloth_limit", _SHEET, {"cloth_limit": (0.95, 1.05, 1.0)}, 0.0257453805182, {}),
    _fold(90.0, 2.0),
    _fold(60.0, 1.0),
    _line("spring", 0.7, 0.5, {"spring_stiffness": 3.0, "rest_length": 0.5}),
    _line("tie", 0.7, 0.0, {"tie_stiffness": 3.0}),
    _line("hinge", 0.7, 2.0, {"bending": 3.0, "rest_curvature": 2.0}),
    _line("fibre", 0.9, 0.8, {"fibre_stiffness": 3.0, "fibre_length": 0.8}, 1.0),
    _line("fibre", 0.7, 0.8, {"fibre_stiffness": 3.0, "fibre_length": 0.8}, 1.0),
    _line("fibre", 0.7, 0.8, {"fibre_stiffness": 3.0, "fibre_length": 0.8}, 0.0),
    _line("thread", 0.7, 1.0, {"thread_stiffness": 3.0}),
    _damped(),
)  # fmt: skip


# Random single elements


STATES = ("near rest", "stretched", "collapsed", "inverted", "flat", "huge", "mixed")


@dataclass(frozen=True)
class RandomElements:
    """Single elements, each with corners of its own."""

    group: StencilGroup
    positions: Array  # [N n, 3]


def random_rotations(rng: np.random.Generator, count: int) -> Array:
    """Uniform rotations [N, 3, 3]."""
    q = rng.standard_normal((count, 4))
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def random_deformations(rng: np.random.Generator, count: int) -> Array:
    """F [N, 3, 3] of the seven classes of `STATES` in turn, each between random rotations."""
    stretches = np.ones((count, 3))
    classes = np.arange(count) % len(STATES)

    def put(name: str, values: Array) -> None:
        of = classes == STATES.index(name)
        stretches[of] = values[of]

    normal, uniform = rng.standard_normal((count, 3)), rng.uniform(size=(count, 3))
    put("near rest", 1.0 + 0.03 * normal)
    put("stretched", 0.2 + 6.0 * uniform)
    put("collapsed", 10.0 ** (-6.0 * uniform))
    put("inverted", (0.1 + 2.0 * uniform) * [1.0, 1.0, -1.0])
    flat = (0.2 + 3.0 * uniform) * [1.0, 1.0, 0.0]
    flat[: count // 2, 2] = 1e-3 * normal[: count // 2, 2]
    put("flat", flat)
    put("huge", 10.0 ** (1.0 + 2.0 * uniform) * np.sign(normal))
    left, right = random_rotations(rng, count), random_rotations(rng, count)
    F = (left * stretches[:, None]) @ right
    mixed = classes == STATES.index("mixed")
    F[mixed] = 2.0 * rng.standard_normal((int(mixed.sum()), 3, 3))
    return F


def random_gradients(rng: np.random.Generator, count: int, corners: int, width: int) -> Array:
    """g [N, n, d] of simplices with edges near 1 and some slivers; for d = 1 random vectors, some entries zero."""
    if width == 1:
        gradients = rng.standard_normal((count, corners, 1))
        gradients[: count // 4, 2:] = 0.0
        return gradients - gradients.sum(axis=1, keepdims=True) * np.eye(corners)[0][:, None]
    edges = rng.standard_normal((count, width, width))
    edges[: count // 3, -1] *= 0.05
    edges += 0.3 * np.eye(width)
    inverse = np.linalg.inv(edges)  # columns of the inverse are the gradients of corners 1 .. d
    inner = np.swapaxes(inverse, 1, 2)
    return np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)


def random_flow(rng: np.random.Generator, count: int) -> dict[str, Array]:
    """Rows of plastic elements: random numbers of the law, and Fp of determinant 1 with stretches from .5 to 2."""
    logs = rng.uniform(-0.5, 0.5, (count, 3))
    stretches = np.exp(logs - logs.mean(axis=1, keepdims=True))
    plastic = random_rotations(rng, count) @ (stretches[:, :, None] * random_rotations(rng, count))
    rows = {"yield_strain": (0.01, 0.1), "hardening": (0.0, 1.0), "creep_time": (0.0, 0.1), "max_flow": (0.1, 1.0)}
    return {name: rng.uniform(*ends, count) for name, ends in rows.items()} | {
        "flow": np.concatenate([plastic.reshape(count, 9), rng.uniform(0.0, 0.1, (count, 1))], axis=1)
    }


def random_material(rng: np.random.Generator, kind: str, count: int, *, decades: float = 4.0) -> dict[str, Array]:
    """Rows of the kind, stiffnesses spread over some decades, Poisson's ratios up to 0.49."""
    stiff, ratio, length = (
        10.0 ** rng.uniform(-decades / 2.0, decades / 2.0, count),
        rng.uniform(0.0, 0.49, count),
        rng.uniform(0, 2, count),
    )
    limits = np.stack([rng.uniform(0.2, 1.0, count), rng.uniform(1.0, 2.0, count), stiff], axis=1)
    return {
        "tet": {"stiffness": stiff, "poisson": ratio},
        "plastic": {"plastic_youngs": stiff, "plastic_poisson": ratio, **random_flow(rng, count)},
        "triangle": {"membrane_youngs": stiff, "membrane_poisson": 2.0 * ratio, "thickness": 0.1 + length},
        "hinge": {"bending": stiff, "rest_curvature": length * (np.arange(count) % 2)},
        "spring": {"spring_stiffness": stiff, "rest_length": length},
        "tie": {"tie_stiffness": stiff},
        "fibre": {"fibre_stiffness": stiff, "fibre_length": length},
        "thread": {"thread_stiffness": stiff},
        "solid_limit": {"solid_limit": limits},
        "cloth_limit": {"cloth_limit": limits},
        "volume": {"volume_stiffness": stiff},
        "damper": {"viscosity": stiff},
    }[kind]


def random_elements(kind: str, sizes: tuple[int, int], count: int, *, seed: int = 0) -> RandomElements:
    """Elements of a kind with n corners and width d, their states of the seven classes in turn."""
    rng = np.random.default_rng(seed)
    corners, width = sizes
    gradients = random_gradients(rng, count, corners, width)
    F = random_deformations(rng, count)[:, :, :width]
    # the positions of least size with that F, moved about: x = F (g^T g)^-1 g^T
    inverse = np.linalg.inv(np.swapaxes(gradients, 1, 2) @ gradients)
    positions = gradients @ inverse @ np.swapaxes(F, 1, 2) + rng.standard_normal((count, 1, 3))
    group = StencilGroup(
        kind=kind,
        corners=np.arange(count * corners).reshape(count, corners),
        gradients=gradients,
        measure=10.0 ** rng.uniform(-1.0, 1.0, count),
        constants=np.asarray(np.arange(count) % 2, np.float64)[:, None][:, : int(kind == "fibre")],
        material=random_material(rng, kind, count),
    )
    return RandomElements(group, positions.reshape(-1, 3))
