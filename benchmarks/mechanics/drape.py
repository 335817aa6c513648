"""The drape test of Cusick: a disc of cloth of 30 cm hangs over a support of 18 cm.

Vertices within 9 cm are held, which is the support with its upper disc. The drape coefficient is the share of the
ring beyond it that the shadow of the hanging cloth covers (Cusick 1968, J. Textile Inst. 59, 253). The cloth passes
through itself, and has no friction between its yarns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch

import torchpd as tpd

from .case import Case
from .equilibrium import Array, equilibrium
from .meshes import disc

__all__ = ["FABRICS", "Fabric", "cases", "drape_coefficient", "shadow"]

RADIUS, SUPPORT = 0.15, 0.09


@dataclass(frozen=True)
class Fabric:
    """Measured properties; stiffness and rigidity along warp and weft."""

    name: str
    density: float  # kg/m^2
    stretch: tuple[float, float]  # N/m
    shear: float  # N/m
    bending: tuple[float, float]  # N m
    measured: float  # drape coefficient
    source: str
    published: str = ""  # range of the drape coefficient of such fabrics, where that of this one was not measured


PETRAK = "Petrak et al. 2025, Sustainability 17, 1388"
WANG = "Wang, O'Brien and Ramamoorthi 2011, ACM Trans. Graph. 30, 71 (11 oz black denim)"
FABRICS = (
    Fabric("polyester, plain, 84 g/m^2", 0.08366, (471.9, 373.5), 46.0, (0.85e-6, 0.33e-6), 0.228, PETRAK),
    Fabric("polyester, twill, 135 g/m^2", 0.13517, (477.2, 458.6), 41.0, (1.95e-6, 0.61e-6), 0.223, PETRAK),
    Fabric("wool blend, twill, 179 g/m^2", 0.17870, (449.7, 439.8), 50.0, (2.14e-6, 2.00e-6), 0.349, PETRAK),
    Fabric("viscose blend, twill, 286 g/m^2", 0.28613, (403.4, 401.8), 61.0, (2.97e-6, 2.40e-6), 0.286, PETRAK),
    Fabric("polyester, plain, 242 g/m^2", 0.24200, (407.2, 415.0), 57.0, (3.22e-6, 3.88e-6), 0.443, PETRAK),
    Fabric("cotton blend, twill, 253 g/m^2", 0.25336, (473.9, 404.7), 126.0, (7.43e-6, 3.70e-6), 0.549, PETRAK),
    Fabric("denim, 324 g/m^2", 0.32400, (1055.0, 225.0), 70.0, (62e-6, 110e-6), 0.8, WANG, "0.70 to 0.90"),
)


def _cloth(fabric: Fabric, mesh: tpd.TriMesh) -> tpd.Cloth:
    """Warp along x. An isotropic membrane of no Poisson's ratio has the shear stiffness, threads carry the rest.

    A hinge bends along the normal of its edge; its rigidity is that of the warp times the squared cosine of the
    normal's angle to the warp, and that of the weft times the squared sine.
    """
    isotropic = 2.0 * fabric.shear
    plain = tpd.Cloth(mesh, 1.0, 1.0, fabric.density)
    along = mesh.vertices[plain.hinges[:, 1]] - mesh.vertices[plain.hinges[:, 0]]
    square = along[:, 2] ** 2 / (along**2).sum(axis=1)
    return tpd.Cloth(
        mesh,
        isotropic / 1e-3,
        1e-3,
        fabric.density,
        poisson=0.0,
        bending=square * fabric.bending[0] + (1.0 - square) * fabric.bending[1],
        warp=fabric.stretch[0] - isotropic,
        weft=fabric.stretch[1] - isotropic,
        grain=(1.0, 0.0, 0.0),
    )


def hang(fabric: Fabric, edge: float, *, waves: int = 0, seconds: float = 3.0) -> tuple[tpd.TriMesh, Array]:
    """The mesh, and where it hangs at rest [V, 3]: steps of 1/60 s, then the equilibrium near them.

    With `waves`, the free cloth starts with velocities of 0.3 m/s up and down, that many times around.
    """
    mesh = disc(RADIUS, SUPPORT, edge)
    body = _cloth(fabric, mesh)
    held = np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 2]) < SUPPORT + 1e-9
    parts = (body, tpd.Pin(body, held), tpd.Gravity((0.0, -9.81, 0.0)))
    sim = tpd.Simulator(tpd.Scene(*parts), 1.0 / 60.0, 200, "chebyshev", torch.float64)
    state = sim.rest_state()
    if waves:
        around = np.arctan2(mesh.vertices[:, 2], mesh.vertices[:, 0])
        state.velocities[0, :, 1] = torch.from_numpy(0.3 * np.cos(waves * around) * ~held)
    for _ in range(round(60.0 * seconds)):
        state = sim(state)
    found = equilibrium(*parts, start=state.positions[0].numpy(), tolerance=1e-9)
    return mesh, found.positions


def shadow(points: Array, triangles: Array, cell: float) -> float:
    """Area [m^2] that triangles cover in a plane, by centres of square cells; folds count once."""
    low = points.min(axis=0) - cell
    covered = np.zeros(np.ceil((np.ptp(points, axis=0) + 2.0 * cell) / cell).astype(int) + 1, dtype=bool)
    for corners in (points[triangles] - low) / cell:
        first, last = np.floor(corners.min(axis=0)).astype(int), np.ceil(corners.max(axis=0)).astype(int) + 1
        x, y = np.meshgrid(*(np.arange(a, b) + 0.5 for a, b in zip(first, last, strict=True)), indexing="ij")
        sides = [
            (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])
            for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
        ]
        inside = np.all([side >= 0.0 for side in sides], axis=0) | np.all([side <= 0.0 for side in sides], axis=0)
        covered[first[0] : last[0], first[1] : last[1]] |= inside
    return float(covered.sum()) * cell**2


def drape_coefficient(fabric: Fabric, edge: float, *, waves: int = 0, seconds: float = 3.0) -> float:
    """Share of the ring beyond the support that the shadow covers."""
    mesh, positions = hang(fabric, edge, waves=waves, seconds=seconds)
    flat, hanging = (shadow(at[:, [0, 2]], mesh.triangles, 5e-4) for at in (mesh.vertices, positions))
    held = np.pi * SUPPORT**2
    return (hanging - held) / (flat - held)


def cases() -> list[Case]:
    wool, cotton = FABRICS[2], FABRICS[5]
    stiffer = replace(cotton, bending=(2.0 * cotton.bending[0], 2.0 * cotton.bending[1]))
    given = [(fabric.name, fabric, 0) for fabric in FABRICS]
    given += [(f"{wool.name}; starts with six waves", wool, 6), (f"{cotton.name}; twice its bending", stiffer, 0)]
    return [
        Case("Drape", name, f"edges of {1e3 * edge:g} mm", fabric.source, fabric.measured,
             partial(drape_coefficient, fabric, edge, waves=waves), 0.125 if fabric.published else None,
             published=fabric.published)
        for name, fabric, waves in given
        for edge in ((0.01, 0.005, 0.0036) if fabric in (FABRICS[0], cotton) else (0.01, 0.005))
    ]  # fmt: skip
