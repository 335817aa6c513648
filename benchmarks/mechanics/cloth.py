"""Cloth and lines: patch test, uniaxial stretch, cantilever strips, elastica, bending length, rods, ties."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from scipy.integrate import solve_bvp
from scipy.optimize import brentq

import torchpd as tpd

from .case import Case
from .equilibrium import Array, Equilibrium, equilibrium
from .meshes import disc, sheet, strip

__all__ = ["cases"]

MESHES = ("alternating", "same", "grid, moved", "equilateral", "equilateral, moved")
RIGIDITY = 1e-3  # kb of strips [N m]; their membranes are stiff enough to keep stretch below 1e-5
TOUCH = np.radians(41.5)  # slope of the plane that ASTM D1388 lets a strip touch
MAP = np.array([[1.15, 0.1], [0.05, -0.02], [-0.04, 1.1]])  # deformation gradient in the columns x, z


def patch(poisson: float, *, woven: bool) -> float:
    """Largest distance of inner vertices from the affine map that the border is held at [m], size 1 m."""
    mesh = disc(0.5, 0.3, 0.1)
    border = np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 2]) > 0.5 - 1e-9
    mapped = mesh.vertices[:, [0, 2]] @ MAP.T
    noise = np.random.default_rng(4).uniform(-0.005, 0.005, mapped.shape) * ~border[:, None]
    threads: dict[str, Any] = {"warp": 300.0, "weft": 100.0, "grain": (1.0, 0.0, 0.5)} if woven else {}
    body = tpd.Cloth(mesh, 1e6, 1e-3, 0.2, poisson=poisson, bending=1e-3, **threads)
    found = equilibrium(body, tpd.Pin(body, border), tpd.Gravity((0.0, 0.0, 0.0)), start=mapped + noise)
    return float(np.abs(found.positions - mapped).max())


def uniaxial(poisson: float, stretch: float, what: str, warp: float = 0.0) -> float:
    """Area over that at rest, or force per width [N/m], of a sheet with free sides and Y = 1 kN/m.

    The ends are held at the lateral stretch of the closed form.
    """
    mesh = sheet((1.0, 0.5), (8, 4))
    first, last = mesh.vertices[:, 0] < 1e-9, mesh.vertices[:, 0] > 1.0 - 1e-9
    lateral = 1.0 - poisson * (stretch - 1.0)
    start = mesh.vertices * np.where((first | last)[:, None], [stretch, 1.0, lateral], [stretch, 1.0, 1.0])
    threads: dict[str, Any] = {"warp": warp, "grain": (1.0, 0.0, 0.0)} if warp else {}
    body = tpd.Cloth(mesh, 1e6, 1e-3, 0.2, poisson=poisson, bending=1e-4, **threads)
    found = equilibrium(body, tpd.Pin(body, first | last), start=start)
    if what == "force":
        return float(found.gradient[last, 0].sum()) / 0.5
    corners = found.positions[mesh.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(np.linalg.norm(normals, axis=1).sum()) / 2.0 / 0.5


def _hang(mesh: tpd.TriMesh, load: float, start: Array | None = None) -> Equilibrium:
    """A strip of 1 m held at x <= 0 under load = q L^3 / kb."""
    density = 0.2
    body = tpd.Cloth(mesh, 1e5 * RIGIDITY / 1e-3, 1e-3, density, poisson=0.0, bending=RIGIDITY)
    fall = tpd.Gravity((0.0, -load * RIGIDITY / density, 0.0))
    return equilibrium(body, tpd.Pin(body, mesh.vertices[:, 0] < 1e-9), fall, start=start)


def _tip(found: Equilibrium, rest: Array) -> Array:
    """Mean position of the free end [3]."""
    end: Array = found.positions[rest[:, 0] > 1.0 - 1e-9].mean(axis=0)
    return end


def small_sag(kind: str, cells: int, correction: float) -> float:
    """Sag of a strip over q L^4 / 8 kb, in the limit of small loads; L = 1 + correction cells."""
    mesh, load = strip(kind, 1.0, 0.2, cells), 1e-3
    sag = -_tip(_hang(mesh, load), mesh.vertices)[1]
    return float(sag / (load / 8.0 * (1.0 + correction / cells) ** 4))


def elastica(load: float, length: float = 1.0) -> tuple[float, float]:
    """End (x, y) of an inextensible cantilever under its weight, with load = q / kb [1/m^3].

    theta'' = -load (L - s) cos theta, theta(0) = 0, theta'(L) = 0 (Bickley 1934).
    """

    def rates(s: Array, state: Array) -> Array:
        angle, bend = state[:2]
        return np.stack([bend, -load * (length - s) * np.cos(angle), np.cos(angle), -np.sin(angle)])

    def ends(first: Array, last: Array) -> Array:
        return np.array([first[0], last[1], first[2], first[3]])

    s = np.linspace(0.0, length, 101)
    guess = np.stack([0.5 * s, 0.0 * s, s, -0.2 * s])
    solved = solve_bvp(rates, ends, s, guess, tol=1e-8, max_nodes=100_000)
    return float(solved.y[2, -1]), float(solved.y[3, -1])


def large_sag(kind: str, cells: int, load: float) -> float:
    """Sag of a strip over that of the elastica, both with L from halfway between the held rows."""
    mesh, start = strip(kind, 1.0, 0.2, cells), None
    for part in np.linspace(0.25, 1.0, 4):
        found = _hang(mesh, part * load, start)
        start = found.positions
    return float(_tip(found, mesh.vertices)[1]) / elastica(load, 1.0 + 0.5 / cells)[1]


def rod_sag(cells: int) -> float:
    """Sag of a rod of that many free segments over q L^4 / 8 E I."""
    line = np.linspace((-1.0 / cells, 0.0, 0.0), (1.0, 0.0, 0.0), cells + 2)
    body = tpd.Rod(line, 1e6, 1e-2)
    weight, rigidity = 1e-6, 1e6 * np.pi / 4.0 * 1e-8
    found = equilibrium(body, tpd.Pin(body, [0, 1]), tpd.Gravity((0.0, -weight, 0.0)))
    return float(-found.positions[-1, 1] / (1000.0 * np.pi * 1e-4 * weight / (8.0 * rigidity)))


def _rigidity_at_touch(chord: Any, low: float, high: float, length: float) -> float:
    """w (L / 2)^3 / kb at the load w / kb where the chord has the slope of the test."""
    load = brentq(lambda load: chord(load) - TOUCH, low, high, xtol=1e-9, rtol=1e-9)
    return float(load * (length / 2.0) ** 3)


def exact_rigidity() -> float:
    """What the test gives for the elastica; its formula G = w (L / 2)^3 takes it for 1."""

    def chord(load: float) -> float:
        x, y = elastica(load)
        return float(np.arctan2(-y, x))

    return _rigidity_at_touch(chord, 5.0, 12.0, 1.0)


def bending_length(kind: str, cells: int) -> float:
    """Flexural rigidity from the cantilever test over kb."""
    mesh, clamp = strip(kind, 1.0, 0.2, cells), -0.5 / cells
    start = _hang(mesh, 3.0).positions

    def chord(load: float) -> float:
        end = _tip(_hang(mesh, load, start), mesh.vertices)
        return float(np.arctan2(-end[1], end[0] - clamp))

    return _rigidity_at_touch(chord, 3.0, 12.0, 1.0 - clamp)


def tie_force() -> float:
    """Force of ties that hold a block under another, over its weight."""
    upper, lower = (tpd.shapes.box((0.2, 0.2, 0.2), (2, 2, 2)).translated((0.0, y, 0.0)) for y in (0.0, -0.2))
    holder, block = tpd.Solid(upper, 1e6), tpd.Solid(lower, 1e6)
    top, stiffness = np.flatnonzero(lower.vertices[:, 1] > -1e-9), 2e3
    parts = (tpd.Tie(block, top, holder, stiffness=stiffness), tpd.Pin(holder, upper.vertices[:, 1] > 0.2 - 1e-9))
    found = equilibrium(holder, block, *parts, tpd.Gravity((0.0, -9.81, 0.0)))
    # bottom of the holder and top of the block coincide at rest, vertex by vertex
    bottom = np.flatnonzero(upper.vertices[:, 1] < 1e-9)
    order = [bottom[np.abs(upper.vertices[bottom] - lower.vertices[own]).sum(axis=1).argmin()] for own in top]
    gaps = found.positions[order, 1] - found.positions[len(upper.vertices) + top, 1]
    return float(stiffness * gaps.sum()) / (8.0 * 9.81)


def cases() -> list[Case]:
    return [*_exact_cases(), *_strips(), *_rods()]


def _exact_cases() -> list[Case]:
    table, held = "Exact cases", "distance of inner vertices [m]"
    found = [
        Case(table, f"patch test, cloth, nu = {nu:g}{', warp and weft' * woven}", held, "affine map", 0.0,
             partial(patch, nu, woven=woven), 1e-10, quick=True)
        for nu, woven in ((0.0, False), (0.3, False), (0.3, True))
    ]  # fmt: skip
    for nu, stretch in ((0.3, 1.2), (0.45, 1.5)):
        row, area = f"sheet, nu = {nu:g}, stretch l = {stretch:g}", stretch * (1.0 - nu * (stretch - 1.0))
        found += [
            Case(table, row, "A / A0", "l (1 - nu (l - 1))", area, partial(uniaxial, nu, stretch, "area"), 1e-9,
                 quick=True),
            Case(table, row, "force / width [N/m]", "Y (l - 1)", 1e3 * (stretch - 1.0),
                 partial(uniaxial, nu, stretch, "force"), 1e-9, quick=True),
        ]  # fmt: skip
    return [
        *found,
        Case(table, "sheet with warp, nu = 0, stretch l = 1.2", "force / width [N/m]", "(Y + warp) (l - 1)", 300.0,
             partial(uniaxial, 0.0, 1.2, "force", 500.0), 1e-9, quick=True),
        Case(table, "block that hangs on nine ties", "force of ties / weight", "1", 1.0, tie_force, 1e-9, quick=True),
    ]  # fmt: skip


def _strips() -> list[Case]:
    found = []
    for kind in MESHES:
        for cells in (10, 20, 40):
            row, quick = f"{kind}, {cells} cells", cells == 10
            found += [
                Case("Cantilever strip", row, "L from the last held row", "q L^4 / 8 kb", 1.0,
                     partial(small_sag, kind, cells, 0.0), None, quick=quick),
                Case("Cantilever strip", row, "L from half a cell before it", "q L^4 / 8 kb", 1.0,
                     partial(small_sag, kind, cells, 0.5), 0.25, quick=quick),
            ]  # fmt: skip
            if cells == 20:
                found += [
                    Case("Cantilever strip", row, f"elastica, q L^3 / kb = {load:g}", "elastica", 1.0,
                         partial(large_sag, kind, cells, load), 0.25)
                    for load in (2.0, 10.0)
                ]  # fmt: skip
        row = f"{kind}, 20 cells"
        found.append(
            Case("Bending length", row, "G / kb", "elastica at 41.5 degrees", exact_rigidity(),
                 partial(bending_length, kind, 20), 0.25)
        )  # fmt: skip
    return found


def _rods() -> list[Case]:
    return [
        Case("Exact cases", f"cantilever rod of {cells} segments", "sag / (q L^4 / 8 E I)", "(1 + 1 / N)^2",
             (1.0 + 1.0 / cells) ** 2, partial(rod_sag, cells), 1e-8, quick=cells == 10)
        for cells in (10, 40)
    ]  # fmt: skip
