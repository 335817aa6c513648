"""Warnings about loads that the time step is too long for."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from ..common.warn import SceneWarning, warn_user
from ..ops.diagonal import elastic_material
from ..scene.loads import Pressure, enclosed_volume

if TYPE_CHECKING:
    from .model import Model
    from .surface_loads import Blown

__all__ = ["warn_of_loads"]


def warn_of_loads(sim: Model) -> None:
    """Warn of a gas that is unstable at this time step, and of a wind that a step bounds.

    Args:
        sim: a new simulator on the CPU, with the numbers of its scene.
    """
    for part in sim.scene.pressures:
        if part.gas:
            _check_gas(sim, part)
    if sim.loads is not None and sim.loads.wind is not None:
        _check_wind(sim, sim.loads.wind)


def _check_gas(sim: Model, part: Pressure) -> None:
    """Compare stiffness in uniform growth d = x - centre of the body.

    An explicit stiffness k_g beside an implicit k and masses M is unstable if d.k_g.d > d.(k + 4 M / h^2).d. The gas
    law has d.k_g.d = (3 p0 + 9 ambient) V0.
    """
    rows, rest = sim.scene.vertex_range(part.body), sim.rest_positions.detach()
    masses = sim.masses.detach()[rows, None]
    way = torch.zeros_like(rest)
    way[rows] = rest[rows] - (masses * rest[rows]).sum(0) / masses.sum()
    material = [array.detach() for array in elastic_material(sim.material())]
    stiff = torch.ops.torchpd.hessian_product(rest[None], way[None], material, list(sim.plan.arrays))[0]
    own = float((way * stiff).sum())
    inertia = float((masses * way[rows].square()).sum())
    gas = (3.0 * part.pascals + 9.0 * part.ambient) * enclosed_volume(part.body.mesh.vertices, part.triangles)
    if gas > own + 4.0 * inertia / sim.time_step**2:
        longest = f"at most {(4.0 * inertia / (gas - own)) ** 0.5:.3g} s"
        warn_user(
            f"Simulator: the gas of a Pressure with ambient={part.ambient:g} is too stiff for a time step of "
            f"{sim.time_step:.3g} s. Its force is that at the start of a step, so it will oscillate and grow: take "
            f"{longest}, or a smaller ambient",
            SceneWarning,
        )


def _check_wind(sim: Model, blown: Blown) -> None:
    """Find triangles so light that a step bounds the wind of the scene when it blows across."""
    rest, corners = sim.rest_positions.detach(), blown.surface.triangles
    masses = (sim.masses.detach()[corners] * blown.shares).sum(1)
    x, y, z = rest[corners].unbind(1)
    areas = 0.5 * torch.linalg.cross(y - x, z - x).norm(dim=1)
    speed, lightest = float(sim.wind.detach().norm()), float((masses / areas).min())
    if sim.time_step * blown.drag * speed > lightest:
        warn_user(
            f"Simulator: a wind of {speed:.3g} m/s across triangles of {lightest:.3g} kg/m^2 is weakened, because its "
            f"force would turn the relative motion around within a time step of {sim.time_step:.3g} s: take at most "
            f"{lightest / (blown.drag * speed):.3g} s",
            SceneWarning,
        )
