"""Convergence estimate: the iterations that a solver needs, from the weights of a step, without solving.

The smallest ratio mu of inertia to diagonal bounds the spectrum of D^-1 A from below. It gives the rate of the Jacobi
and Chebyshev iterations (Young, Iterative Solution of Large Linear Systems, 1971, chapters 5 and 11).

`Multilevel` depends on mu n^(2/3), with n the vertices of a body, and not on the mesh resolution. That number is about
rho L^2 / (E h^2): the distance that a wave travels in a step, relative to the body size L. The iterations grow with its
logarithm. The constants are fitted to random scenes and to beams of 936 to 95499 vertices.

Accuracy (`benchmarks/forecast.py`): on 132 random scenes without contacts nine of ten needed 0.2 to 1.4 times the
estimate. Meshes with slivers, and steps that are a rigid motion, needed the least. On 65 scenes with contacts Chebyshev
needed 0.2 to 1.25 times.

With smooth planes the estimate of `Multilevel` is for the impact of a stiff body on a face (`benchmarks/landings.py`).
It is two square roots of the count of Chebyshev. With slivers or strongly varying stiffness it is at least a seventh of
that count. Most steps need far fewer. With friction, spheres, cloth or rods, and with schedules that do not treat
rigid rotations, it is an upper bound: the count of Chebyshev. `Simulator.tune` measures instead.

One formula holds for every kind of element. At rest the smallest eigenvalue is 1.0 to 1.5 times mu for the scenes of
`benchmarks/effect_scenes.py`: solids with a Poisson ratio, cloth, a rod and a mixture. Where nothing buckles, Chebyshev
needs 0.5 to 2.3 times the estimate there. A compressed sheet or rod resists less than not at all in the direction in
which it buckles: its second derivative is negative. Then the smallest eigenvalue falls below mu, 0.27 to 0.94 of it in
some of the measured steps, which needed 1.1 to 9 times the estimate. Weights cannot tell which steps these are.
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
from ..scene.solvers import Chebyshev, Multilevel, Newton, Solver

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
# Multilevel: iterations per tenth of the error = least + slope * log10(1 / (mu n^(2/3)))
_LEVELS_LEAST, _LEVELS_SLOPE = 2.0, {"lbfgs": 2.0, "momentum": 3.0}
# Multilevel at an impact: factors on the Chebyshev count for an error of 1e-3, and on its square root
_LANDING_SHARE, LANDING_ROOTS = 1.0 / 7.0, 2.0
# limits of an even body: smallest dihedral angle, and largest ratio of stiffness between tetrahedra. `tetrahedralize`
# leaves a ratio of up to ten where tets are partly filled
_EVEN_ANGLE, _EVEN_STIFFNESS = math.radians(5.0), 30.0
_MOST = 10_000
# most iterations of Multilevel that "auto" takes: hardly any step needs more, though the bound may ask for it
MOST_OF_LEVELS = 1_000
FAR_TOO_FEW = 0.1  # remaining error
_smallest_angles: WeakKeyDictionary[TetMesh, float] = WeakKeyDictionary()


class UnsolvedWarning(UserWarning):
    """Warning: the default iterations, or those of "auto", are far too few for this time step and material."""


class Spectrum(NamedTuple):
    """Lower bounds on the smallest eigenvalue of D^-1 A, with D the weighted diagonal, for the worst environment."""

    least: float  # mu: smallest ratio a / D of a free vertex, in (0, 1]
    slow: float  # the same for modes across the mesh, which a single flat element does not slow down


class Forecast(NamedTuple):
    """Convergence estimate of one solver on one scene: the error falls by exp(-rate) per iteration."""

    rate: float

    def iterations(self, error: float) -> int:
        """Iterations until the relative error |x - x*| / |x_0 - x*| falls to `error`, in (0, 1)."""
        return max(1, math.ceil(math.log(1.0 / error) / self.rate - 1e-9))

    def words(self, error: float) -> str:
        """`iterations` as text; very large counts are only named as such."""
        number = self.iterations(error)
        return f"about {number}" if number <= _MOST else f"more than {_MOST:,}"

    def error(self, iterations: int) -> float:
        """Estimated relative error after a number of iterations; 1 is the first iterate."""
        return math.exp(-self.rate * iterations)


@torch.no_grad()
def spectrum_of(compiled: CompiledScene) -> Spectrum | None:
    """Spectral bounds for the present material and time step; None on "meta" or without a free vertex."""
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
    # the guarded schedule limits its momentum to this ratio, so a flat element matters only below it
    floor = (1.0 - _LARGEST_RHO) / Chebyshev().settings()["relaxation"]
    slow = float(torch.maximum(ratio.amin(1), mean.clamp(max=floor)).min())
    valid = math.isfinite(least) and 0.0 < least <= slow <= 1.0
    return Spectrum(least, slow) if valid else None


def _limit(rho: float) -> float:
    """Limit b of the weights omega = 1 + b of the Chebyshev method."""
    rho = min(max(rho, 0.0), 1.0 - 1e-15)
    return ((1.0 - math.sqrt(1.0 - rho * rho)) / rho) ** 2 if rho > 0.0 else 0.0


def _decay(eigenvalue: float, limit: float) -> float:
    """Larger root |r| of r^2 - (1 + b) g r + b = 0: decay per iteration of a mode with Jacobi eigenvalue g."""
    sum_of_roots = (1.0 + limit) * abs(eigenvalue)
    discriminant = sum_of_roots**2 - 4.0 * limit
    return math.sqrt(limit) if discriminant <= 0.0 else (sum_of_roots + math.sqrt(discriminant)) / 2.0


def forecast(
    compiled: CompiledScene, solver: Solver | None = None, spectrum: Spectrum | None = None
) -> Forecast | None:
    """Convergence estimate of a solver on this scene; None without one.

    There is none for the plain diagonal, whose iterations may diverge, and without spectral bounds.

    Args:
        compiled: scene, time step and material.
        solver: None takes that of the scene.
        spectrum: if known already.
    """
    solver = compiled.solver if solver is None else solver
    spectrum = spectrum_of(compiled) if spectrum is None else spectrum
    numbers = solver.settings()
    if spectrum is None or not numbers["weighted"] or isinstance(solver, Newton):
        return None
    if isinstance(solver, Multilevel) and not (has_contacts(compiled) or compiled.has_stencils):
        largest = max(len(body.mesh.vertices) for body in compiled.scene.bodies)
        reach = min(spectrum.slow * largest ** (2.0 / 3.0), 1.0)
        decade = _LEVELS_LEAST + _LEVELS_SLOPE[solver.outer] * math.log10(1.0 / reach)
        decade *= _resists_volume(compiled)
        return Forecast(math.log(10.0) / decade)
    theta, rho = numbers["relaxation"], numbers["rho"]
    slowest = 1.0 - theta * spectrum.slow
    limit = 0.0
    if isinstance(solver, (Chebyshev, Multilevel)):
        limit = _limit(rho if rho > 0.0 else slowest)
    # the initial error holds little of the upper modes of [mu, 1], but half of the middle ones
    middle = 1.0 - theta * (1.0 + spectrum.slow) / 2.0
    left = max(_decay(slowest, limit), _decay(middle, limit), 1e-3)
    rate = -math.log(min(left, 1.0 - 1e-15))
    lands = isinstance(solver, Multilevel) and solver.outer == "lbfgs" and not held_up_by(compiled)
    if lands:
        plain = math.log(1e3) / rate
        usual = LANDING_ROOTS * math.sqrt(plain)
        rate = math.log(1e3) / (max(_LANDING_SHARE * plain, usual) if is_uneven(compiled) else usual)
    return Forecast(rate)


def _resists_volume(compiled: CompiledScene) -> float:
    """Factor on the iterations of `Multilevel`, whose scalar matrix knows 2 mu + lambda alone: its cube root of (2 mu +
    lambda) / 2 mu. The swinging beam needs 1.6 times the iterations of a ratio of 0 at 0.3, and 3 times at 0.45; half
    of that is in the diagonal.
    """
    poisson = compiled.named.get("poisson")
    if poisson is None or poisson.shape[-1] == 0:
        return 1.0
    largest = max(float(poisson.detach().max()), 0.0)
    return float(((1.0 - largest) / (1.0 - 2.0 * largest)) ** (1.0 / 3.0))


def is_bound(compiled: CompiledScene) -> bool:
    """Whether the estimate is an upper bound that most steps stay far below."""
    return isinstance(compiled.solver, Multilevel) and (has_contacts(compiled) or compiled.has_stencils)


def has_contacts(compiled: CompiledScene) -> bool:
    """Whether the scene has planes or spheres."""
    return compiled.named["planes"].shape[-2] + compiled.named["spheres"].shape[-2] > 0


def is_uneven(compiled: CompiledScene) -> bool:
    """Whether a body has a dihedral angle below five degrees, or a stiffness ratio of 30 between tetrahedra."""
    if any(_smallest_angle(solid.mesh) < _EVEN_ANGLE for solid in compiled.scene.solids):
        return True
    counts = [len(solid.mesh.tets) for solid in compiled.scene.elastic_solids]
    bodies = compiled.named["stiffness"].detach().split(counts, dim=-1) if counts else ()
    return any(bool((body.amax(-1) > _EVEN_STIFFNESS * body.amin(-1)).any()) for body in bodies)


def _smallest_angle(mesh: TetMesh) -> float:
    if mesh not in _smallest_angles:
        _smallest_angles[mesh] = smallest_dihedral(mesh.vertices, mesh.tets)
    return _smallest_angles[mesh]


def has_friction(compiled: CompiledScene) -> bool:
    """Whether any contact has friction."""
    columns = {"planes": PLANES["friction"], "spheres": SPHERES["friction"]}
    return any(bool((compiled.named[name][..., column] > 0.0).any()) for name, column in columns.items())


def held_up_by(compiled: CompiledScene) -> str:
    """Obstacle to the convergence of `Multilevel`: other elements, friction, a ball (sheets buckle), or ""."""
    if compiled.has_stencils:
        return "other elements than plain tetrahedra"
    if has_friction(compiled):
        return "friction"
    return "a ball" if compiled.named["spheres"].shape[-2] else ""
