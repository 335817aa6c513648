"""Warnings about loads that the time step is too long for."""

from __future__ import annotations

import torch

from ..common.warn import SceneWarning, warn_user
from ..ops.diagonal import elastic_material
from ..plan.compiled import CompiledScene
from ..scene.loads import Pressure, enclosed_volume
from .surface_loads import Blown, SurfaceLoads

__all__ = ["warn_of_loads"]


def warn_of_loads(compiled: CompiledScene, loads: SurfaceLoads) -> None:
    """Warn of a gas that is unstable at this time step, and of a wind that a step bounds.

    Args:
        compiled: a new scene on the CPU; the numbers of pressure and wind are those of its parts.
        loads: those of the scene.
    """
    for part in compiled.scene.pressures:
        if part.gas:
            _check_gas(compiled, part)
    if loads.wind is not None:
        _check_wind(compiled, loads.wind)


def _check_gas(compiled: CompiledScene, part: Pressure) -> None:
    """Compare stiffness in uniform growth d = x - centre of the body.

    An explicit stiffness k_g beside an implicit k and masses M is unstable if d.k_g.d > d.(k + 4 M / h^2).d. The gas
    law has d.k_g.d = (3 p0 + 9 ambient) V0.
    """
    step, rows = compiled.time_step, compiled.scene.vertex_range(part.body)
    masses = compiled.named["masses"].detach()[:, None]
    rest = torch.tensor(compiled.scene.rest_positions, dtype=masses.dtype)
    way = torch.zeros_like(rest)
    way[rows] = rest[rows] - (masses * rest)[rows].sum(0) / masses[rows].sum()
    material = [array.detach() for array in elastic_material(compiled.material)]
    stiff = torch.ops.torchpd.hessian_product(rest[None], way[None], material, list(compiled.plan.arrays))[0]
    own, inertia = float((way * stiff).sum()), float((masses * way.square()).sum())
    gas = (3.0 * part.pascals + 9.0 * part.ambient) * enclosed_volume(part.body.mesh.vertices, part.triangles)
    if gas > own + 4.0 * inertia / step**2:
        warn_user(
            f"Simulator: the gas of a Pressure with ambient={part.ambient:g} is too stiff for a time step of "
            f"{step:.3g} s. Its force is that at the start of a step, so it will oscillate and grow: take at most "
            f"{(4.0 * inertia / (gas - own)) ** 0.5:.3g} s, or a smaller ambient",
            SceneWarning,
        )


def _check_wind(compiled: CompiledScene, blown: Blown) -> None:
    """Find triangles so light that a step bounds the wind of the scene when it blows across."""
    part, step, corners = compiled.scene.wind, compiled.time_step, blown.surface.triangles
    assert part is not None
    masses = (compiled.named["masses"].detach()[corners] * blown.shares).sum(1)
    x, y, z = torch.tensor(compiled.scene.rest_positions, dtype=masses.dtype)[corners].unbind(1)
    areas = 0.5 * torch.linalg.cross(y - x, z - x).norm(dim=1)
    speed, lightest = float((part.velocity**2).sum() ** 0.5), float((masses / areas).min())
    if step * blown.drag * speed > lightest:
        warn_user(
            f"Simulator: a wind of {speed:.3g} m/s across triangles of {lightest:.3g} kg/m^2 is weakened, because its "
            f"force would turn the relative motion around within a time step of {step:.3g} s: take at most "
            f"{lightest / (blown.drag * speed):.3g} s",
            SceneWarning,
        )
