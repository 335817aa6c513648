"""How wrong a step is: the converged step in float64, and the distance of any other answer from it.

Errors are relative, so that 1 is the first iterate and 0 the converged step:

    position   |u - u*| / |u_0 - u*|                over all vertices, u = x_{t+1} - x_t
    energy     (E(u) - E(u*)) / (E(u_0) - E(u*))    of the objective of the step
    residual   |grad E(u)| / |grad E(h v)|          what contacts balance left out, as in `Info.residual`

The converged step has no friction: where vertices stick, every position inside the cone of friction is a solution.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .effects import Ground, Sphere
from .material import MATERIAL_ROWS
from .reference import StepProblem, step_problem
from .reference_solvers import newton, newton_step
from .scene import Part, Scene
from .solvers import Chebyshev
from .state import Info, State
from .targets import Targets

if TYPE_CHECKING:
    from .simulator import Simulator

__all__ = ["Errors", "ExactStep", "exact_steps", "frictionless", "problem_of", "scene_without_friction", "select_state"]

Array = NDArray[np.float64]

_CHUNK = 500  # iterations between two looks at the residual
_SOLVED = 1e-12  # residual at which nothing is left to gain
_NEWTON_VERTICES = 3000  # above, the factorisation of the Hessian takes minutes
# of the positions: what rounding them already moves a body that only falls, and what a stiff one scatters by
ROUNDINGS = 10.0


class Errors(NamedTuple):
    """Of one answer to one step; see the module for the definitions."""

    position: float
    energy: float
    residual: float
    metres: float  # largest distance of a vertex from its converged position


@dataclasses.dataclass(frozen=True)
class ExactStep:
    """A step in float64 with its converged answer."""

    problem: StepProblem
    first: Array  # [V, 3] m: u_0
    solution: Array  # [V, 3] m: u*
    uncertainty: float  # bound on the error of u* itself, relative as the errors are

    @property
    def scale(self) -> float:
        """|u_0 - u*| [m]."""
        return float(np.linalg.norm(self.first - self.solution))

    def rounding(self, dtype: torch.dtype, roundings: float = ROUNDINGS) -> float:
        """`roundings` times eps |x_t| [m]; by default what no number of iterations in `dtype` is sure to get below."""
        return roundings * torch.finfo(dtype).eps * float(np.linalg.norm(self.problem.positions))

    def moves(self, dtype: torch.dtype) -> bool:
        """Whether solving this step changes more than rounding does."""
        return self.scale > self.rounding(dtype)

    def error_beyond_rounding(self, displacement: Array, dtype: torch.dtype, roundings: float = ROUNDINGS) -> float:
        """The least e >= 0 with |u - u*| <= e |u_0 - u*| + `rounding`."""
        excess = self.judge(displacement).position - self.rounding(dtype, roundings) / self.scale
        return max(excess, 0.0)

    def judge(self, displacement: Array) -> Errors:
        """The errors of u [V, 3] m; inf where it left the range of numbers."""
        if not np.isfinite(displacement).all():
            return Errors(np.inf, np.inf, np.inf, np.inf)
        problem = self.problem
        off = displacement - self.solution
        with np.errstate(all="ignore"):
            energies = [problem.energy(u) for u in (displacement, self.first, self.solution)]
            residual, course = (np.linalg.norm(problem.residual(u)) for u in (displacement, problem.course()))
            lift = energies[1] - energies[2]
            found = Errors(
                float(np.linalg.norm(off)) / self.scale,
                (energies[0] - energies[2]) / lift if lift > 0.0 else 0.0,
                float(residual / course) if course > 0.0 else 0.0,
                float(np.linalg.norm(off, axis=1).max()),
            )
        return Errors(*(value if np.isfinite(value) else np.inf for value in found))


def scene_without_friction(scene: Scene) -> Scene:
    """The same parts, planes and spheres smooth."""
    parts: list[Part] = []
    for part in scene.parts:
        if isinstance(part, Ground):
            parts.append(Ground(part.height, part.normal))
        elif isinstance(part, Sphere):
            parts.append(Sphere(part.center, part.radius))
        else:
            parts.append(part)
    return Scene(*parts)


def frictionless(sim: Simulator, dtype: torch.dtype | None = None) -> Simulator:
    """A copy of the simulator with its present material, smooth contacts, and no stop before the last iteration."""
    twin = copy.deepcopy(sim)
    if dtype is not None:
        twin = twin.to(dtype)
    twin.tolerance = 0.0
    smooth = {name: getattr(twin, name).detach().clone() for name in ("planes", "spheres")}
    for array in smooth.values():
        array[..., 4] = 0.0
    twin.set_material(**smooth)
    return twin


def select_state(state: State, items: list[int]) -> State:
    """Some environments of a state."""
    return State(state[0][items], state[1][items])


def problem_of(
    sim: Simulator, state: State, item: int = 0, *, forces: Tensor | None = None, targets: Targets | None = None
) -> StepProblem:
    """The step of one environment in the reference, with the simulator's present material and without friction."""
    arrays = sim.material_at(targets, state[0].shape[0])
    material = {}
    for name, array in zip(MATERIAL_ROWS, arrays, strict=True):
        shared = array.dim() == MATERIAL_ROWS[name].dims
        material[name] = _double(array if shared else array[item if len(array) > 1 else 0])
    planes, spheres = material["planes"], material["spheres"]
    planes[:, 4] = 0.0
    spheres[:, 4] = 0.0
    values = dataclasses.replace(
        sim.scene.values(),
        stiffness=material["stiffness"],
        masses=material["masses"],
        gravity=material["gravity"],
        pin_stiffness=material["pin_stiffness"],
        pin_targets=material["pin_targets"],
        planes=planes,
        spheres=spheres[:, :5],
        damping=float(material["damping"]),
    )
    return step_problem(
        values,
        _double(state[0][item]),
        _double(state[1][item]),
        sim.time_step,
        forces=None if forces is None else _double(forces[item]),
        sphere_centers=spheres[:, :3],
        sphere_starts=spheres[:, :3] - sim.time_step * spheres[:, 5:8],
    )


def _doubled(targets: Mapping[Part, Tensor] | None) -> Mapping[Part, Tensor] | None:
    if targets is None:
        return None
    return {part: place.double() for part, place in targets.items()}


def _double(tensor: Tensor) -> Array:
    return tensor.detach().double().cpu().numpy().copy()


@torch.no_grad()
def exact_steps(
    sim: Simulator,
    state: State,
    *,
    forces: Tensor | None = None,
    targets: Targets | None = None,
    start: str = "velocity",
    iterations: int = 20000,
) -> list[ExactStep]:
    """The converged step of every environment, from the state and material that `sim` holds, rounded as they are.

    Guarded Chebyshev in float64 until the residual stops falling, then Newton's method where there is no contact and
    the mesh is small enough. `ExactStep.uncertainty` bounds what is left: |grad E| / min m/h^2 >= |u - u*| where the
    elements are stable, or twice its next step where Newton's method ended, which stiff bodies have far shorter.

    Args:
        sim: scene, time step and material; its solver and precision do not matter.
        state: where the steps start, [B, V, 3].
        forces: [B, V, 3] N.
        targets: of pins and spheres, as in `Simulator.forward`.
        start: of the first iterate u_0, "velocity" or "inertial".
        iterations: of Chebyshev, at most.
    """
    twin = frictionless(sim, torch.float64)
    twin.solver, twin.iterations = Chebyshev(), _CHUNK
    wide = State(state[0].double(), state[1].double())
    force = None if forces is None else forces.double()
    places = targets.double() if isinstance(targets, Tensor) else _doubled(targets)
    best: Tensor | None = None
    lowest = torch.full((len(wide.positions),), torch.inf, device="cpu")
    guess: str | Tensor = start
    for _ in range(0, iterations, _CHUNK):
        after, info = _step(twin, wide, force, places, guess)
        residual = info.residual.cpu()
        if best is None:
            best = after.velocities.clone()
        better = residual < 0.5 * lowest
        best[better] = after.velocities[better]
        lowest = torch.where(better, residual, lowest)
        if not bool((better & (lowest > _SOLVED)).any()):
            break
        guess = after.positions
    assert best is not None
    found = []
    for item in range(len(wide.positions)):
        problem = problem_of(sim, state, item, forces=forces, targets=targets)
        found.append(_polished(problem, problem.first_iterate(start), _double(best[item]) * sim.time_step))
    return found


def _step(
    sim: Simulator, state: State, forces: Tensor | None, targets: Targets | None, start: str | Tensor
) -> tuple[State, Info]:
    after, info = sim(state, forces, targets, start, return_info=True)
    return after, info


def _polished(problem: StepProblem, first: Array, near: Array) -> ExactStep:
    """The solution next to an almost converged displacement, and how certain it is."""
    contacts = len(problem.values.planes) + len(problem.values.spheres)
    solution, nearest = near, np.inf
    if not contacts and len(near) <= _NEWTON_VERTICES:
        try:
            solution = newton(problem, near)
            step = newton_step(problem, solution)
            nearest = np.inf if step is None else 2.0 * float(np.linalg.norm(step))
        except RuntimeError:  # stalls at a kink of the rotations: the iterate stays
            solution = near
    left = float(np.linalg.norm(problem.residual(solution)))
    scale = float(np.linalg.norm(first - solution))
    weakest = float(problem.weight[problem.free].min(initial=np.inf))
    return ExactStep(problem, first, solution, min(left / weakest, nearest) / scale if scale > 0.0 else 0.0)
