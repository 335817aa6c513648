"""Solids: patch test, uniaxial stretch, cantilever, torsion, vibration, muscle."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch

import torchpd as tpd

from . import quadratic
from .case import Case
from .equilibrium import Array, equilibrium
from .meshes import irregular_box

__all__ = ["cases"]

LENGTH, SIDE, YOUNGS = 1.0, 0.2, 1e6
RATIOS = (0.0, 0.3, 0.45)
PATCH = np.array([[0.15, 0.1, -0.05], [0.02, -0.1, 0.08], [-0.06, 0.04, 0.12]])  # displacement gradient
TORSION_CONSTANT = 0.1405770  # J / a^4 of a square


def _bar(cells: int) -> tpd.TetMesh:
    return tpd.shapes.box((LENGTH, SIDE, SIDE), (5 * cells, cells, cells))


def _ends(mesh: tpd.TetMesh) -> tuple[Array, Array]:
    """Vertices at both ends of a bar of 1 m, and those of a lattice beyond them."""
    x = mesh.vertices[:, 0]
    return x < 1e-9, x > LENGTH - 1e-9


def patch(poisson: float, averaging: int) -> float:
    """Largest distance of inner vertices from the affine map that the surface is held at, over the size [1]."""
    size = (1.0, 0.8, 0.6)
    mesh = irregular_box(size, (4, 3, 3))
    border = ((mesh.vertices < 1e-9) | (mesh.vertices > np.array(size) - 1e-9)).any(axis=1)
    mapped = mesh.vertices @ (np.eye(3) + PATCH).T
    noise = np.random.default_rng(3).uniform(-0.02, 0.02, mapped.shape)
    body = tpd.Solid(mesh, YOUNGS, poisson=poisson, averaging=averaging)
    found = equilibrium(body, tpd.Pin(body, border), start=mapped + noise * ~border[:, None])
    return float(np.abs(found.positions - mapped).max())


def uniaxial(poisson: float, averaging: int, stretch: float, what: str) -> float:
    """Lateral stretch of the middle, or force of an end over that of the closed form's section [Pa].

    The ends are held at the lateral stretch of the closed form, and the sides are free.
    """
    mesh = irregular_box((1.0, 0.3, 0.2), (6, 3, 2))
    first, last = _ends(mesh)
    lateral = 1.0 - poisson * (stretch - 1.0)
    start = mesh.vertices * np.where((first | last)[:, None], [stretch, lateral, lateral], [stretch, 1.0, 1.0])
    body = tpd.Solid(mesh, YOUNGS, poisson=poisson, averaging=averaging)
    found = equilibrium(body, tpd.Pin(body, first | last), start=start)
    if what == "force":
        return float(found.gradient[last, 0].sum()) / (0.3 * 0.2)
    sides = (mesh.vertices[:, 1] > 0.3 - 1e-9) & ~first & ~last
    return float(found.positions[sides, 1].mean()) / 0.3


def timoshenko(poisson: float, load: float) -> float:
    """Sag q L^4 / 8 E I + q L^2 / 2 k G A with k = 10 (1 + nu) / (12 + 11 nu) (Cowper 1966), q = load times A."""
    area, inertia, shear = SIDE**2, SIDE**4 / 12.0, YOUNGS / (2.0 * (1.0 + poisson))
    q, factor = load * area, 10.0 * (1.0 + poisson) / (12.0 + 11.0 * poisson)
    return q * LENGTH**4 / (8.0 * YOUNGS * inertia) + q * LENGTH**2 / (2.0 * factor * shear * area)


def cantilever(mesh: tpd.TetMesh, poisson: float, averaging: int) -> float:
    """Sag over `timoshenko` [1], under a weight so small that displacements are linear in it."""
    body = tpd.Solid(mesh, YOUNGS, 1000.0, poisson=poisson, averaging=averaging)
    first, last = _ends(mesh)
    found = equilibrium(body, tpd.Pin(body, first), tpd.Gravity((0.0, -0.01, 0.0)))
    sag = -float((found.positions - mesh.vertices)[last, 1].mean())
    return sag / timoshenko(poisson, 10.0)


def torsion(mesh: tpd.TetMesh, poisson: float, averaging: int) -> float:
    """Torque over G J times the twist per length of the middle [1]. Both ends are held, one turned by 1e-3."""
    first, last = _ends(mesh)
    x, angle = mesh.vertices[:, 0], 1e-3
    arms = mesh.vertices[:, 1:] - SIDE / 2.0
    turns = angle * x / LENGTH
    start = mesh.vertices.copy()
    start[:, 1] += arms[:, 0] * (np.cos(turns) - 1.0) - arms[:, 1] * np.sin(turns)
    start[:, 2] += arms[:, 0] * np.sin(turns) + arms[:, 1] * (np.cos(turns) - 1.0)
    body = tpd.Solid(mesh, YOUNGS, poisson=poisson, averaging=averaging)
    found = equilibrium(body, tpd.Pin(body, first | last), start=start)
    moved = found.positions - mesh.vertices
    ends = found.positions[last, 1:] - SIDE / 2.0
    torque = float((ends[:, 0] * found.gradient[last, 2] - ends[:, 1] * found.gradient[last, 1]).sum())

    def turn(section: float) -> float:
        own = np.abs(x - section) < 1e-9
        cross = arms[own, 0] * moved[own, 2] - arms[own, 1] * moved[own, 1]
        return float(cross.sum() / (arms[own] ** 2).sum())

    rate = (turn(0.8 * LENGTH) - turn(0.2 * LENGTH)) / (0.6 * LENGTH)
    return torque / (YOUNGS / (2.0 * (1.0 + poisson)) * TORSION_CONSTANT * SIDE**4 * rate)


def period(cells: int) -> float:
    """Period of the first axial mode over 4 L sqrt(rho / E) [1], extrapolated in h^2 from two time steps.

    Implicit Euler lengthens a period by (omega h)^2 / 3 to second order.
    """
    mesh = tpd.shapes.box((1.0, 0.1, 0.1), (cells, 1, 1))
    body = tpd.Solid(mesh, 1e5, 1000.0)
    first, last = _ends(mesh)
    scene, exact = tpd.Scene(body, tpd.Pin(body, first), tpd.Gravity((0.0, 0.0, 0.0))), 0.4

    def measured(steps: int) -> float:
        sim = tpd.Simulator(scene, exact / steps, 200, "multilevel", torch.float64, tolerance=1e-11)
        state = sim.rest_state()
        state.positions[0, :, 0] += 1e-4 * torch.sin(0.5 * torch.pi * state.positions[0, :, 0])
        tip = sim.rollout(state, int(0.8 * steps)).positions[:, 0, last, 0].mean(dim=1).numpy() - 1.0
        turned = np.flatnonzero(np.sign(tip[1:]) != np.sign(tip[:-1]))
        crossings = turned + tip[turned] / (tip[turned] - tip[turned + 1])
        return 2.0 * float(crossings[1] - crossings[0]) / steps

    coarse, fine = measured(200), measured(400)
    return fine + (fine - coarse) / 3.0


def muscle() -> float:
    """Stretch of a bar without a Poisson's ratio, with active fibres along it everywhere."""
    mesh = irregular_box((1.0, 0.2, 0.2), (8, 2, 2))
    body = tpd.Solid(mesh, 1e5)
    first, last = _ends(mesh)
    fibres = tpd.Fibres(body, (1.0, 0.0, 0.0), 1e5, 0.3, activation=1.0)
    found = equilibrium(body, fibres, tpd.Pin(body, first), tpd.Gravity((0.0, 0.0, 0.0)))
    return float(found.positions[last, 0].mean())


def _quadratic(cells: int, poisson: float) -> float:
    return quadratic.sag(_bar(cells), YOUNGS, poisson, 10.0) / timoshenko(poisson, 10.0)


def cases() -> list[Case]:
    """Those with closed forms that hold to rounding, then those that converge under refinement."""
    return [*_exact_cases(), *_cantilevers(), *_torsions()]


def _exact_cases() -> list[Case]:
    found = [
        Case("Exact cases", f"patch test, solid, nu = {nu:g}, averaging {groups}", "distance of inner vertices [m]",
             "affine map", 0.0, partial(patch, nu, groups), 1e-10, quick=groups != 2)
        for nu, groups in ((-0.3, 4), (0.0, 1), (0.3, 1), (0.3, 4), (0.45, 1), (0.45, 2), (0.45, 4))
    ]  # fmt: skip
    for nu, groups, stretch in ((0.3, 1, 1.3), (0.45, 4, 1.2), (0.45, 4, 0.8), (-0.3, 1, 1.2)):
        row = f"bar, nu = {nu:g}, averaging {groups}, stretch s = {stretch:g}"
        found += [
            Case("Exact cases", row, "lateral stretch", "1 - nu (s - 1)", 1.0 - nu * (stretch - 1.0),
                 partial(uniaxial, nu, groups, stretch, "lateral"), 1e-9, quick=True),
            Case("Exact cases", row, "end force / A [Pa]", "E (s - 1)", YOUNGS * (stretch - 1.0),
                 partial(uniaxial, nu, groups, stretch, "force"), 1e-9, quick=True),
        ]  # fmt: skip
    return [
        *found,
        Case("Exact cases", "bar with active fibres, w = E, L = 0.7", "stretch", "(E + w L) / (E + w)", 0.85,
             muscle, 1e-9, quick=True),
        *(
            Case("Exact cases", f"axial vibration of a bar, {cells} x 1 x 1 cells", "period / (4 L sqrt(rho / E))",
                 "1", 1.0, partial(period, cells), 2.0 * (0.5 * np.pi / cells) ** 2 / 24.0)  # twice lumped masses'
            for cells in (10, 20)
        ),
    ]  # fmt: skip


def _cantilevers() -> list[Case]:
    table, source = "Cantilever", "Timoshenko, k of Cowper"
    # with nu the clamp, which keeps its section from contracting, is not Timoshenko's
    found = [
        Case(table, f"{5 * cells} x {cells} x {cells}, quadratic", f"nu = {nu:g}", source, 1.0,
             partial(_quadratic, cells, nu), None if nu else 2e-3)
        for cells in (2, 4)
        for nu in RATIOS
    ]  # fmt: skip
    lattice = partial(tpd.tetrahedralize, _block(), cells=20)
    meshes = [
        ("10 x 2 x 2", partial(_bar, 2), True),
        ("20 x 4 x 4", partial(_bar, 4), False),
        ("25 x 5 x 5", partial(_bar, 5), False),
        ("40 x 8 x 8", partial(_bar, 8), False),
        ("20 x 4 x 4, irregular", partial(irregular_box, (LENGTH, SIDE, SIDE), (20, 4, 4)), False),
        ("lattice of `tetrahedralize`, 4 cells across", lattice, False),
    ]
    for name, make, quick in meshes:
        for groups in (1, 2, 4) if not name.startswith("40") else (1, 4):
            found += [
                Case(table, f"{name}, averaging {groups}", f"nu = {nu:g}", source, 1.0,
                     partial(_of_mesh, cantilever, make, nu, groups), None, quick=quick and groups == 4)
                for nu in RATIOS
                if nu or groups == 1
            ]  # fmt: skip
    return found


def _torsions() -> list[Case]:
    return [
        Case("Torsion", f"{5 * cells} x {cells} x {cells}, averaging {groups}", f"nu = {nu:g}", "Saint-Venant", 1.0,
             partial(_of_mesh, torsion, partial(_bar, cells), nu, groups), None, quick=cells == 2 and groups == 4)
        for cells in (1, 2, 4, 6)
        for groups in (1, 2, 4)
        for nu in RATIOS
        if nu or groups == 1
    ]  # fmt: skip


def _of_mesh(run: Callable[..., float], make: Callable[[], tpd.TetMesh], *options: Any) -> float:
    return run(make(), *options)


def _block() -> tpd.TriMesh:
    """Surface of the bar."""
    bar = _bar(1)
    return tpd.TriMesh(bar.vertices, bar.boundary(), drop_unreferenced=True)
