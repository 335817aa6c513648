"""Scenes of rods with `Contact`, and what no motion without a passage changes: linking numbers and knots."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import torch
from body_scenes import Course, block, cloth, each, gravity, plane, pose, rotation
from numpy.typing import NDArray

import torchpd as pd
from torchpd.reference.contact import linking_number

Array = NDArray[np.float64]

RADIUS = 2e-3
FAR = 50.0  # m


def rod(start: Any, end: Any, segments: int, youngs: float = 1e6, **options: Any) -> pd.Rod:
    """A straight rod of 4 mm."""
    return pd.Rod(np.linspace(start, end, segments + 1), youngs, RADIUS, **options)


def crossed_rods(speed: float, *, contact: bool = True) -> Course:
    """A rod along z falls on one along x, whose ends are clamped."""
    lower = rod((-0.2, 0.0, 0.0), (0.2, 0.0, 0.0), 20)
    upper = rod((0.003, 0.05, -0.2), (0.003, 0.05, 0.2), 20)
    parts = (pd.Contact(thickness=2.0 * RADIUS),) if contact else ()
    scene = pd.Scene(lower, upper, pd.Pin(lower, [0, 1, 19, 20]), gravity(), *parts)
    return Course(scene, each(scene, (0.0, 0.0, 0.0), (0.0, -speed, 0.0)))


def passages(places: Array) -> int:
    """How often the upper of `crossed_rods` has passed through the lower one, by places [42, 3] m.

    The lower one is closed far below, the upper one far above. An end of the upper one that swings round below the
    lower one adds one to their linking number, a passage takes one away.
    """
    lower, upper = places[:21], places[21:]
    down, up = np.array([0.0, -FAR, 0.0]), np.array([0.0, FAR, 0.0])
    linked = linking_number(
        np.concatenate([lower, [lower[-1] + down, lower[0] + down]]),
        np.concatenate([upper, [upper[-1] + up, upper[0] + up]]),
    )
    return int(upper[0, 2] > 0.0) + int(upper[-1, 2] < 0.0) - linked


def rod_in_a_ring(way: float = 0.15, steps: int = 4) -> tuple[Course, Array]:
    """A rod along y goes through a soft ring; its clamped ends take it aside within some steps.

    Returns the course, and the numbers of the ring's centre line.
    """
    cells, box = 16, pd.shapes.box((1.0, 0.02, 0.02), (16, 2, 2))
    angle = 2.0 * np.pi * box.vertices[:, 0]
    size = 0.05 + box.vertices[:, 1] - 0.01
    points = np.stack([size * np.cos(angle), box.vertices[:, 2] - 0.01, size * np.sin(angle)], axis=1)
    kept, number = np.unique(np.round(points, 9), axis=0, return_inverse=True)
    ring = pd.Solid(pd.TetMesh(kept, number.reshape(-1)[box.tets]), youngs=1e5, density=1000.0)
    turns = 2.0 * np.pi * np.arange(cells) / cells
    line = 0.05 * np.stack([np.cos(turns), 0.0 * turns, np.sin(turns)], axis=1)
    centre = np.array([int(np.linalg.norm(kept - place, axis=1).argmin()) for place in line])
    needle = rod((0.0, -0.3, 0.0), (0.0, 0.3, 0.0), 30)
    ends = pd.Pin(needle, [0, 1, 29, 30])
    start = torch.tensor(needle.polyline[[0, 1, 29, 30]])

    def targets(step: int) -> dict[Any, torch.Tensor]:
        return {ends: start + torch.tensor([way * min((step + 1) / steps, 1.0), 0.0, 0.0])}

    scene = pd.Scene(ring, needle, ends, pd.Contact(thickness=1e-3))
    return Course(scene, targets=targets), centre


def rod_on_cloth(speed: float = 20.0) -> Course:
    """A rod falls, end ahead, on a sheet that is pinned at its rim."""
    sheet = cloth(plane(0.4, 0.4, 12))
    rim = (np.abs(sheet.mesh.vertices) > 0.2 - 1e-9).any(axis=1)
    falls = rod((-0.08, 0.02, 0.013), (0.07, 0.09, 0.021), 10)
    scene = pd.Scene(sheet, falls, pd.Pin(sheet, rim), gravity(), pd.Contact(thickness=1e-3))
    return Course(scene, each(scene, (0.0, 0.0, 0.0), (0.0, -speed, 0.0)))


def rod_on_a_slope(degrees: float, friction: float) -> Course:
    """A rod across a rigid mesh, downhill is x."""
    turn = rotation(0.0, 0.0, -degrees)
    start, end = (turn @ np.array([-0.5, 1e-3, z]) for z in (-0.1, 0.113))
    table = pd.Collider(plane(2.0, 0.6, 6, turn))
    scene = pd.Scene(rod(start, end, 8), table, gravity(), pd.Contact(friction=friction, thickness=1e-3))
    return Course(scene)


def rod_on_a_block() -> Course:
    """A rod at rest on a soft block that stands on pins."""
    base = block(0.1, 3, (0.0, -0.05, 0.0))
    feet = pd.Pin(base, base.mesh.vertices[:, 1] < -0.1 + 1e-9)
    lies = rod((-0.08, 1e-3, 0.013), (0.08, 1e-3, 0.021), 10, 1e7)
    return Course(pd.Scene(base, feet, lies, gravity(), pd.Contact(friction=0.3, thickness=1e-3)))


def coil(turns: int = 4, cells: int = 24, steps: int = 12) -> Course:
    """A helix of 4 cm between two plates that come to 12 mm of each other."""
    angle = 2.0 * np.pi * np.arange(turns * cells + 1) / cells
    line = np.stack([0.03 * np.cos(angle), 0.01 * angle / (2.0 * np.pi), 0.03 * np.sin(angle)], axis=1)
    low, high = (pd.Collider(plane(0.2, 0.2, 4), pose=(0.0, y, 0.0, 1, 0, 0, 0)) for y in (-0.003, 0.043))

    def targets(step: int) -> dict[Any, torch.Tensor]:
        return {high: pose(0.0, 0.043 - 0.034 * min((step + 1) / steps, 1.0))}

    scene = pd.Scene(pd.Rod(line, 1e7, 1e-3), low, high, pd.Contact(friction=0.3, thickness=2e-3))
    return Course(scene, targets=targets)


def overhand_knot(*, self_contact: bool = True, segments: int = 120, steps: int = 40) -> Course:
    """A rope in an overhand knot, pulled at its ends; two ends far apart close it to a trefoil."""
    t = np.linspace(-2.1, 2.1, 2000)
    curve = 0.05 * np.stack([t**3 - 3.0 * t, 0.8 * (t**4 - 4.0 * t**2), 0.2 * (t**5 - 10.0 * t)], axis=1)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    places = np.linspace(0.0, length[-1], segments + 1)
    line = np.stack([np.interp(places, length, axis) for axis in curve.T], axis=1)
    rope = pd.Rod(line, 1e6, 3e-3, rest_curvature=0.0)
    held = [0, 1, segments - 1, segments]
    ends, start = pd.Pin(rope, held), torch.tensor(line[held])
    goal = start.clone()
    goal[:, 0] += torch.tensor([-0.5, -0.5, 0.5, 0.5])
    goal[:, 1:] = 0.0

    def targets(step: int) -> dict[Any, torch.Tensor]:
        return {ends: start + min((step + 1) / steps, 1.0) * (goal - start)}

    contact = pd.Contact(self_contact=self_contact, friction=0.2, thickness=6e-3)
    scene = pd.Scene(rope, ends, pd.Damping(2.0), contact)
    return Course(scene, targets=targets)


def knot_determinant(line: Array) -> int:
    """Determinant of a closed polyline [n, 3]: 1 for a circle, 3 for a trefoil.

    By the colouring matrix of its diagram in a plane: at each crossing 2 over - under - under' (Livingston 1993).
    """
    turn = rotation(31.0, 47.0, 11.0)
    points = line @ turn.T
    ahead = np.roll(points, -1, axis=0)
    count, found = len(points), []
    for i, j in combinations(range(count), 2):
        p, q, r = points[i], ahead[i] - points[i], points[j]
        s, d = ahead[j] - r, r - p
        across = q[0] * s[1] - q[1] * s[0]
        if j == i + 1 or (i == 0 and j == count - 1) or across == 0.0:
            continue
        a, b = (d[0] * s[1] - d[1] * s[0]) / across, (d[0] * q[1] - d[1] * q[0]) / across
        if 0.0 <= a < 1.0 and 0.0 <= b < 1.0:
            first, second = (i + a, j + b), (p[2] + a * q[2], r[2] + b * s[2])
            found.append(first if second[0] < second[1] else first[::-1])  # under, over
    if len(found) < 3:
        return 1
    under = np.sort([of for of, _ in found])
    matrix = np.zeros((len(found), len(found)))
    for row, (below, above) in enumerate(found):
        # arcs begin where the line has passed below
        number = int(np.searchsorted(under, below))
        matrix[row, int(np.searchsorted(under, above)) % len(found)] += 2.0
        matrix[row, number] -= 1.0
        matrix[row, (number + 1) % len(found)] -= 1.0
    return round(abs(float(np.linalg.det(matrix[1:, 1:]))))


def closed_far(line: Array, axis: int) -> Array:
    """An open polyline, its ends joined far away: they go out along an axis, and around along the next one."""
    out, aside = FAR * np.eye(3)[axis], FAR * np.eye(3)[(axis + 1) % 3]
    first, last = line[0] - out, line[-1] + out
    return np.concatenate([line, [last, last + aside, first + aside, first]])
