"""How many iterations a solver will need, foretold from the weights of the step alone: nothing is solved.

The smallest ratio mu of inertia to diagonal bounds the spectrum of D^-1 A from below, and with it the rate of the
Jacobi and Chebyshev iterations. What `Multilevel` needs does not depend on the mesh, but on mu n^(2/3), n vertices of a
body: about rho L^2 / (E h^2), how far a wave travels in a step against the size L of the body. It grows with the
logarithm of that, with constants fitted to random scenes and to beams of 936 to 95499 vertices. On 132 random scenes
without contacts nine of ten needed 0.2 to 1.4 times the forecast, meshes with slivers and steps that are a rigid motion
the least, on 65 with contacts Chebyshev 0.2 to 1.25 times (`benchmarks/forecast.py`).

With smooth planes the forecast of `Multilevel` is that of the step in which a stiff body lands on a face: two square
roots of what Chebyshev needs, and a seventh of it at least with slivers or stiffness that varies much within a body
(`benchmarks/landings.py`); most steps need far less. With friction or balls, and with schedules that do not know the
rigid turns of a body, it is a bound: what Chebyshev needs. `Simulator.tune` measures instead.

Source of the rates: Young, Iterative Solution of Large Linear Systems, 1971, chapters 5 and 11.
"""

from __future__ import annotations

import math
from typing import NamedTuple
from weakref import WeakKeyDictionary

import torch

from ..common.tables import PLANES, SPHERES
from ..geometry.mesh_quality import smallest_dihedral
from ..geometry.tet_mesh import TetMesh
from ..ops.diagonal import step_diagonal
from ..plan.compiled import CompiledScene
from ..scene.solvers import Chebyshev, Multilevel, Solver

__all__ = [
    "Forecast",
    "Spectrum",
    "UnsolvedWarning",
    "forecast",
    "has_contacts",
    "has_friction",
    "held_up_by",
    "is_bound",
    "is_uneven",
    "spectrum_of",
]

_LARGEST_RHO = 0.99999  # of the guarded schedule, see csrc/solver/chebyshev.h
# iterations of Multilevel for a tenth of the error: least + slope * log10(1 / (mu n^(2/3)))
_LEVELS_LEAST, _LEVELS_SLOPE = 2.0, {"corotated": 2.0, "lbfgs": 3.0, "momentum": 3.0}
# of Multilevel where something lands, in those of Chebyshev for an error of 1e-3, and in their square roots
_LANDING_SHARE, LANDING_ROOTS = 1.0 / 7.0, 2.0
# of a body that is not uneven: the smallest dihedral angle, and how much stiffer one tetrahedron is than another, which
# is up to ten times where `tetrahedralize` leaves some partly empty
_EVEN_ANGLE, _EVEN_STIFFNESS = math.radians(5.0), 30.0
_MOST = 10_000
# iterations of Multilevel that "auto" takes at most: what a bound asks beyond that hardly a step needs
MOST_OF_LEVELS = 1_000
FAR_TOO_FEW = 0.1  # error that is left
_smallest_angles: WeakKeyDictionary[TetMesh, float] = WeakKeyDictionary()


class UnsolvedWarning(UserWarning):
    """Iterations that nobody named, the default or those of "auto", are far too few for this time step and material."""


class Spectrum(NamedTuple):
    """Bounds on the smallest eigenvalue of D^-1 A, D the weighted diagonal, of the worst environment."""

    least: float  # mu: smallest ratio a / D of a vertex that is free, in (0, 1]
    slow: float  # the same for modes that reach across the mesh, which one flat element does not slow down


class Forecast(NamedTuple):
    """Of one solver on one scene: the error falls by exp(-rate) an iteration."""

    rate: float

    def iterations(self, error: float) -> int:
        """About how many reach an error |x - x*| / |x_0 - x*| in (0, 1)."""
        return max(1, math.ceil(math.log(1.0 / error) / self.rate - 1e-9))

    def words(self, error: float) -> str:
        """`iterations` in words; of very large numbers the rate is not good enough to tell."""
        number = self.iterations(error)
        return f"about {number}" if number <= _MOST else f"more than {_MOST:,}"

    def error(self, iterations: int) -> float:
        """About what so many leave; 1 is the first iterate."""
        return math.exp(-self.rate * iterations)


@torch.no_grad()
def spectrum_of(compiled: CompiledScene) -> Spectrum | None:
    """From the present material and time step; None on "meta", where there are no values, and without a free vertex."""
    if compiled.device.type == "meta" or (compiled.plan.kernel is None) != (compiled.device.type == "cpu"):
        return None
    inertia, diagonal = step_diagonal(compiled.plan.arrays, compiled.material, compiled.time_step)
    inertia, diagonal = (array.detach().double().reshape(-1, compiled.vertices) for array in (inertia, diagonal))
    free = inertia.isfinite()
    if not bool(free.any()):
        return None
    ratio = torch.where(free, inertia / diagonal, 1.0)
    sums = (torch.where(free, array, 0.0).sum(1) for array in (inertia, diagonal))
    mean = torch.nan_to_num(next(sums) / next(sums), nan=1.0)
    least = float(ratio.min())
    # the guarded schedule takes no more momentum than this ratio asks for, so only below it does a flat element matter
    floor = (1.0 - _LARGEST_RHO) / Chebyshev().settings()["relaxation"]
    slow = float(torch.maximum(ratio.amin(1), mean.clamp(max=floor)).min())
    valid = math.isfinite(least) and 0.0 < least <= slow <= 1.0
    return Spectrum(least, slow) if valid else None


def _limit(rho: float) -> float:
    """b of omega = 1 + b, where the weights of the Chebyshev method end."""
    rho = min(max(rho, 0.0), 1.0 - 1e-15)
    return ((1.0 - math.sqrt(1.0 - rho * rho)) / rho) ** 2 if rho > 0.0 else 0.0


def _decay(eigenvalue: float, limit: float) -> float:
    """Larger root |r| of r^2 - (1 + b) g r + b = 0: what an iteration leaves of the mode g of the Jacobi iteration."""
    sum_of_roots = (1.0 + limit) * abs(eigenvalue)
    discriminant = sum_of_roots**2 - 4.0 * limit
    return math.sqrt(limit) if discriminant <= 0.0 else (sum_of_roots + math.sqrt(discriminant)) / 2.0


def forecast(
    compiled: CompiledScene, solver: Solver | None = None, spectrum: Spectrum | None = None
) -> Forecast | None:
    """What to expect of a solver on this scene; None where nothing can be said.

    That is so for the plain diagonal, with which iterations may diverge, and where `spectrum_of` has nothing.

    Args:
        compiled: with time step and material.
        solver: that of the scene when None.
        spectrum: when known already.
    """
    solver = compiled.solver if solver is None else solver
    spectrum = spectrum_of(compiled) if spectrum is None else spectrum
    numbers = solver.settings()
    if spectrum is None or not numbers["weighted"]:
        return None
    if isinstance(solver, Multilevel) and not has_contacts(compiled):
        body = max(len(solid.mesh.vertices) for solid in compiled.scene.solids)
        reach = min(spectrum.slow * body ** (2.0 / 3.0), 1.0)
        decade = _LEVELS_LEAST + _LEVELS_SLOPE[solver.outer] * math.log10(1.0 / reach)
        return Forecast(math.log(10.0) / decade)
    theta, rho = numbers["relaxation"], numbers["rho"]
    slowest = 1.0 - theta * spectrum.slow
    limit = 0.0
    if isinstance(solver, (Chebyshev, Multilevel)):
        limit = _limit(rho if rho > 0.0 else slowest)
    # the error has little of the modes at the upper end of the spectrum, [mu, 1], but half of it of the middle
    middle = 1.0 - theta * (1.0 + spectrum.slow) / 2.0
    left = max(_decay(slowest, limit), _decay(middle, limit), 1e-3)
    rate = -math.log(min(left, 1.0 - 1e-15))
    lands = isinstance(solver, Multilevel) and solver.outer == "corotated" and not held_up_by(compiled)
    if lands:
        plain = math.log(1e3) / rate
        usual = LANDING_ROOTS * math.sqrt(plain)
        rate = math.log(1e3) / (max(_LANDING_SHARE * plain, usual) if is_uneven(compiled) else usual)
    return Forecast(rate)


def is_bound(compiled: CompiledScene) -> bool:
    """Whether the forecast for the solver of the scene is what its hardest steps need, and most of them less."""
    return isinstance(compiled.solver, Multilevel) and has_contacts(compiled)


def has_contacts(compiled: CompiledScene) -> bool:
    """Whether the scene has anything to touch."""
    return compiled.named["planes"].shape[-2] + compiled.named["spheres"].shape[-2] > 0


def is_uneven(compiled: CompiledScene) -> bool:
    """Whether a body has tetrahedra with an angle below five degrees, or one that is 30 times as stiff as another."""
    if any(_smallest_angle(solid.mesh) < _EVEN_ANGLE for solid in compiled.scene.solids):
        return True
    bodies = (
        compiled.named["stiffness"].detach().split([len(solid.mesh.tets) for solid in compiled.scene.solids], dim=-1)
    )
    return any(bool((body.amax(-1) > _EVEN_STIFFNESS * body.amin(-1)).any()) for body in bodies)


def _smallest_angle(mesh: TetMesh) -> float:
    if mesh not in _smallest_angles:
        _smallest_angles[mesh] = smallest_dihedral(mesh.vertices, mesh.tets)
    return _smallest_angles[mesh]


def has_friction(compiled: CompiledScene) -> bool:
    """Whether any contact may hold a vertex by friction."""
    columns = {"planes": PLANES["friction"], "spheres": SPHERES["friction"]}
    return any(bool((compiled.named[name][..., column] > 0.0).any()) for name, column in columns.items())


def held_up_by(compiled: CompiledScene) -> str:
    """What may keep `Multilevel` from working: "friction", "a ball" (thin sheets buckle over it), or ""."""
    if has_friction(compiled):
        return "friction"
    return "a ball" if compiled.named["spheres"].shape[-2] else ""
