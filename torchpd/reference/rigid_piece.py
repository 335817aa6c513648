"""One component of the reference as a rigid body: its weight, its distance to contacts, and its rotations."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..common.tables import PLANES, SPHERES
from ..scene.scene import SceneValues

__all__ = [
    "LYING",
    "NearestRotation",
    "Problem",
    "RigidComponent",
    "axis_of",
    "fraction_of",
    "gaps_of",
    "rotation_about",
    "turn_about",
]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

NORMAL, HEIGHT, FRICTION = (PLANES[name] for name in ("normal", "height", "friction"))
LYING = 0.01  # a vertex lies on a plane when its gap is below this fraction of the displacement the plane stops
HALF_TURN = 1e-6  # upper bound of 4 cos^2(angle / 2) for a rotation treated as a half turn


class Problem(Protocol):
    """The attributes of `StepProblem` that rigid motions read."""

    @property
    def values(self) -> SceneValues: ...
    @property
    def positions(self) -> Array: ...
    @property
    def weight(self) -> Array: ...
    @property
    def target(self) -> Array: ...
    @property
    def free(self) -> Mask: ...
    @property
    def sphere_centers(self) -> Array: ...
    def hold(self, displacement: Array) -> Array: ...
    def project(self, displacement: Array, around: Array | None = None) -> Array: ...


class NearestRotation(Protocol):
    def __call__(self, matrices: Array) -> Array: ...


def gaps_of(positions: Array, planes: Array, centers: Array, spheres: Array) -> Array:
    """Signed distance [n] m of every position to the nearest plane or sphere; inf without any."""
    gaps = np.full(len(positions), np.inf)
    for plane in planes:
        gaps = np.minimum(gaps, positions @ plane[NORMAL] - plane[HEIGHT])
    for center, sphere in zip(centers, spheres, strict=True):
        gaps = np.minimum(gaps, np.linalg.norm(positions - center, axis=1) - sphere[SPHERES["radius"]])
    return gaps


class RigidComponent:
    """One component: n vertices at y = x + u, with targets z = x + s."""

    def __init__(
        self, problem: Problem, displacement: Array, of: Mask, nearest_rotation: NearestRotation, first: bool
    ) -> None:
        self.problem, self.nearest_rotation, self.first = problem, nearest_rotation, first
        self.planes = problem.values.planes
        self.u, self.weight = displacement[of], problem.weight[of, None]
        self.y, self.z = problem.positions[of] + self.u, problem.positions[of] + problem.target[of]
        share = self.weight / self.weight.sum()
        self.centroid, self.target_offset = (share * self.y).sum(axis=0), (share * (self.z - self.y)).sum(axis=0)
        self.gyration_squared = float((share * (self.y - self.centroid) ** 2).sum())  # squared radius of gyration
        self.covariance = self.covariance_about(self.centroid + self.target_offset, self.centroid)
        self.pinned = ~problem.free[of]
        self.rest = problem.values.rest_positions[of]
        self.meets_contact = False  # the motion ends at a contact

    def covariance_about(self, goal: Array, pivot: Array) -> Array:
        """Covariance [3, 3]: the sum of a (z - goal) (y - pivot)^T."""
        return np.asarray((self.weight * (self.z - goal)).T @ (self.y - pivot))

    def gaps(self, positions: Array, planes: Array, *, with_spheres: bool = True) -> Array:
        spheres = self.problem.values.spheres if with_spheres else np.zeros((0, 5))
        return gaps_of(positions, planes, self.problem.sphere_centers[: len(spheres)], spheres)

    def gaps_after(self, moved: Array, planes: Array) -> Array:
        """Gaps [n] m after a motion; after the first iterate, also 0 or less where a sphere could resist the motion.

        A sphere resists with a force inside its friction cone if the vertex lies on it, since its surface curves away
        from tangential motion. A single sphere without normal force resists nothing by friction.
        """
        after, way, spheres = self.gaps(moved, planes), moved - self.y, self.problem.values.spheres
        if self.first:
            return after
        size, several = np.linalg.norm(way, axis=1), len(self.planes) + len(spheres) > 1
        for center, sphere in zip(self.problem.sphere_centers, spheres, strict=True):
            arm = self.y - center
            length = np.linalg.norm(arm, axis=1, keepdims=True)
            normals = np.where(length > 0.0, arm / np.maximum(length, 1e-300), [0.0, 1.0, 0.0])
            across = (normals * way).sum(axis=1)
            along = np.linalg.norm(way - across[:, None] * normals, axis=1)
            rounding = 4 * np.finfo(np.float64).eps * (np.linalg.norm(self.y, axis=1) + sphere[SPHERES["radius"]])
            lies = length[:, 0] - sphere[SPHERES["radius"]] <= LYING * size + rounding
            after = np.where(lies, np.minimum(after, across - several * sphere[SPHERES["friction"]] * along), after)
        return after

    def energy_change(self, way: Array) -> float:
        """Change of the energy [J] under a displacement [n, 3] m."""
        return float((0.5 * self.weight * ((self.y + way - self.z) ** 2 - (self.y - self.z) ** 2)).sum())

    def fraction_to(self, planes: Array, free: Array) -> float:
        """Fraction of the free motion after which the component reaches the planes."""
        least = 1.0
        for plane in planes:
            before, after = (y @ plane[NORMAL] - plane[HEIGHT] for y in (self.y, free))
            comes, touches = (before > 0.0) & (after <= 0.0), after <= 0.0
            shares = np.where(comes, before / np.where(comes, np.maximum(before - after, 1e-300), 1.0), 0.0)
            least = min(least, float(shares[touches].min(initial=1.0)))
        return least

    def slips(self, normal: Array) -> Array:
        return np.asarray(self.u - np.outer(self.u @ normal, normal))

    def translation_along(self, planes: Array) -> Array:
        """Displacement [3] m of the component along all planes that it touches."""
        normals, friction = planes[:, NORMAL], planes[:, FRICTION]
        _, sizes, directions = np.linalg.svd(normals)
        span = directions[: int((sizes > 1e-6).sum())]
        along = self.target_offset - span.T @ (span @ self.target_offset)
        if not friction.any():
            return along if len(span) < 3 else np.zeros(3)
        if len(span) != len(planes) or len(span) > 2:
            return np.zeros(3)
        if len(planes) == 1 and float(self.target_offset @ normals[0]) >= 0.0:
            return np.asarray(along)
        # normal displacements that the planes impose, and the slips on those with friction
        pushes = np.linalg.solve(normals @ normals.T, -normals @ self.target_offset)
        if len(planes) > 1 and not (pushes > 0.0).all():
            return np.zeros(3)
        rough = [plane for plane in planes if plane[FRICTION] > 0.0]
        lies = [
            self.y @ plane[NORMAL] - plane[HEIGHT] < -LYING * float(self.target_offset @ plane[NORMAL])
            for plane in rough
        ]
        slips = np.concatenate([self.slips(plane[NORMAL])[own] for plane, own in zip(rough, lies, strict=True)])
        if not len(slips):
            return np.zeros(3)
        mean = slips.mean(axis=0)
        if len(span) == 2:
            mean = mean - span.T @ (span @ mean)
        # where slips differ, the point at which friction acts is uncertain: the iterations resolve that part
        apart = 2.0 * float(np.linalg.norm(slips.max(axis=0) - slips.min(axis=0)))
        free, rub, slip = mean + along, float(friction @ pushes), float(np.linalg.norm(mean))
        left = float(np.linalg.norm(free)) - rub
        if left <= 0.0:
            return np.asarray(-mean if slip > max(apart, apart * rub / max(slip, 1e-300)) else np.zeros(3))
        way = left * free / np.linalg.norm(free) - mean
        doubt = rub * min(2.0, apart / left)
        return np.asarray(max(0.0, 1.0 - doubt / max(float(np.linalg.norm(way)), 1e-300)) * way)


def axis_of(matrix: Array) -> Array:
    """Twice the axis of the skew part."""
    return np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])


def rotation_about(half: Array) -> Array:
    """Rotation about an axis by 2 atan(|v| / 2), v = `half`: Cayley's formula."""
    v = 0.5 * half
    skew = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.asarray(np.eye(3) + 2.0 / (1.0 + v @ v) * (skew + skew @ skew))


def fraction_of(turn: Array, share: float) -> Array:
    """About `share` of a rotation: its Cayley vector times `share`; identity for a half turn (no axis)."""
    if share == 1.0:
        return turn
    left = 1.0 + float(np.trace(turn))
    return rotation_about(share * 2.0 / left * axis_of(turn)) if left > HALF_TURN else np.eye(3)


def turn_about(normal: Array, covariance: Array) -> Array:
    """The rotation R about a normal that maximises tr(R^T covariance)."""
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first /= np.linalg.norm(first)
    frame = np.stack([first, np.cross(normal, first)])
    flat = frame @ covariance @ frame.T
    angle = np.arctan2(flat[1, 0] - flat[0, 1], flat[0, 0] + flat[1, 1])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.asarray(np.outer(normal, normal) + frame.T @ turn @ frame)
