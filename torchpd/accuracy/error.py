"""Errors of a step, relative to its converged solution in float64.

Errors are 1 at the unsolved step u_0, which is h v with hard pins at their targets and out of contacts. They are 0 at
the converged step u*:

    position   |u - u*| / |u_0 - u*|                over all vertices, u = x_{t+1} - x_t
    energy     (E(u) - E(u*)) / (E(u_0) - E(u*))    of the objective of the step
    residual   share of the forces that is not balanced: `StepProblem.relative_residual`, `Info.residual`

`exact_steps` solves without friction, which has no energy to minimise; `settled_steps` has friction.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..baselines.contact_newton import ContactNewton
from ..common.checks import expand_shared
from ..common.tables import PLANES, SPHERES
from ..ops.diagonal import named_material
from ..plan.material import MATERIAL_ROWS
from ..reference.problem import StepProblem, step_problem
from ..scene.contact import Collider, Contact
from ..scene.effects import Ground, Sphere
from ..scene.scene import Part, Scene
from ..scene.solvers import Chebyshev, Multilevel, Solver
from ..scene.stencils import StencilGroup
from ..scene.targets import Targets
from ..simulation.parametrization import plain_copy
from ..simulation.state import History, HistoryState, State, named_state
from ..simulation.surface_loads import SurfaceLoads
from .unsolved_step import ROUNDINGS

if TYPE_CHECKING:
    from ..simulation.stepper import Stepper

__all__ = [
    "Errors",
    "ExactStep",
    "exact_steps",
    "frictionless",
    "problem_of",
    "scene_without_friction",
    "settled_steps",
]

Array = NDArray[np.float64]

# Solvers of exact steps, with iterations between checks of the residual. The first is the best by far without contacts.
# With contacts, each solves scenes on which the others stagnate.
_SOLVERS: tuple[tuple[Solver, int], ...] = ((Multilevel(), 50), (Multilevel("momentum"), 100), (Chebyshev(), 500))
# With other parts, a step has several minima where something buckles: the one that the default solver goes to counts.
_OF_STENCILS: tuple[tuple[Solver, int], ...] = ((Chebyshev(), 2000), (Multilevel(), 50))
_LONG = 40_000  # least limit of iterations there
_SOLVED = 1e-13  # residual at which a solver ends
_NEARLY = 1e-9  # residual that may be the lowest that rounding allows
_PATIENCE = 3  # checks without a halved residual before a solver ends; one if all are below _NEARLY
_SURE = 1e-8  # uncertainty of a converged step that ends the search for a better one
# uncertainty, by precision, that rounding hides: no Newton's method is needed
_FINE = {torch.float32: 1e-8, torch.float64: 1e-14}
# steps with friction: iterations of Multilevel, then of successive runs of Chebyshev
_LEADING, _SETTLING = 64, (256, 512, 1024, 2048, 4096, 8192)


class Errors(NamedTuple):
    """Errors of one solution of one step; see the module for the definitions."""

    position: float
    energy: float
    residual: float
    metres: float  # largest distance of a vertex from its converged position


@dataclasses.dataclass(frozen=True)
class ExactStep:
    """A step in float64 with its converged solution."""

    problem: StepProblem
    first: Array  # [V, 3] m: u_0, the unsolved step
    solution: Array  # [V, 3] m: u*
    uncertainty: float  # bound on the relative error of u* itself

    @property
    def scale(self) -> float:
        """|u_0 - u*| [m]."""
        return float(np.linalg.norm(self.first - self.solution))

    def rounding(self, dtype: torch.dtype, roundings: float = ROUNDINGS) -> float:
        """`roundings` eps |x_t| [m]; by default the error floor of any number of iterations in `dtype`."""
        return roundings * torch.finfo(dtype).eps * float(np.linalg.norm(self.problem.positions))

    def moves(self, dtype: torch.dtype) -> bool:
        """Whether solving this step changes more than rounding does, compared with rigid motions."""
        change = min(self.scale, float(np.linalg.norm(self.problem.first_iterate() - self.solution)))
        return change > self.rounding(dtype)

    def error_beyond_rounding(self, displacement: Array, dtype: torch.dtype, roundings: float = ROUNDINGS) -> float:
        """The least e >= 0 with |u - u*| <= e |u_0 - u*| + `rounding`."""
        return max(self.position_error(displacement) - self.rounding(dtype, roundings) / self.scale, 0.0)

    def position_error(self, displacement: Array) -> float:
        """|u - u*| / |u_0 - u*| of u [V, 3] m, far cheaper than all `Errors`; inf for NaN."""
        with np.errstate(all="ignore"):
            error = float(np.linalg.norm(displacement - self.solution)) / self.scale
        return error if np.isfinite(error) else np.inf

    def errors_of(self, displacement: Array) -> Errors:
        """The errors of u [V, 3] m; inf if it is not finite."""
        if not np.isfinite(displacement).all():
            return Errors(np.inf, np.inf, np.inf, np.inf)
        problem = self.problem
        error = displacement - self.solution
        with np.errstate(all="ignore"):
            energies = [problem.energy(u) for u in (displacement, self.first, self.solution)]
            gain = energies[1] - energies[2]
            found = Errors(
                self.position_error(displacement),
                (energies[0] - energies[2]) / gain if gain > 0.0 else 0.0,
                problem.relative_residual(displacement),
                float(np.linalg.norm(error, axis=1).max()),
            )
        return Errors(*(value if np.isfinite(value) else np.inf for value in found))


def scene_without_friction(scene: Scene) -> Scene:
    """The same parts, with frictionless planes, spheres, colliders and contact."""
    twins: dict[int, Any] = {
        id(part): Collider(part.mesh, pose=part.pose, mass=part.mass, inertia=part.inertia) for part in scene.colliders
    }
    parts: list[Part] = []
    for part in scene.parts:
        if isinstance(part, Ground):
            parts.append(Ground(part.height, part.normal))
        elif isinstance(part, Sphere):
            parts.append(Sphere(part.center, part.radius))
        elif isinstance(part, Contact):
            bodies = [twins.get(id(body), body) for body in part.bodies]
            options: dict[str, Any] = {"thickness": part.thickness, "capacity": part.capacity}
            parts.append(Contact(*bodies, self_contact=part.self_contact, **options))
        else:
            parts.append(twins.get(id(part), part))
    return Scene(*parts)


def frictionless(sim: Stepper, dtype: torch.dtype | None = None) -> Stepper:
    """A copy of the simulator with its present material, frictionless contacts and no tolerance."""
    with torch.inference_mode(False), torch.no_grad():
        twin = plain_copy(sim)
        if dtype is not None:
            twin = twin.to(dtype)
        twin.tolerance = 0.0
        smooth = {name: getattr(twin, name).detach().clone() for name in ("planes", "spheres")}
        smooth["planes"][..., PLANES["friction"]] = smooth["spheres"][..., SPHERES["friction"]] = 0.0
        twin.set_material(**smooth)
    return twin


def problem_of(
    sim: Stepper,
    state: State | HistoryState,
    item: int = 0,
    *,
    forces: Tensor | None = None,
    targets: Targets | None = None,
) -> StepProblem:
    """One environment's step in the reference, with the simulator's present material and without friction.

    Its forces are `forces` and those of pressure and wind.
    """
    arrays = sim.with_history(sim.material_at(targets, state[0].shape[0]), state)
    forces = expand_shared(forces, state[0].shape)
    pushed = None if forces is None else _double(forces[item])
    material = {}
    for name, array in named_material(arrays).items():
        shared = array.dim() == MATERIAL_ROWS[name].dims
        material[name] = _double(array if shared else array[item if len(array) > 1 else 0])
    if sim.loads is not None:
        loads = _load_forces(sim, state, item, material["masses"], targets)
        pushed = loads if pushed is None else pushed + loads

    def changing(group: StencilGroup) -> set[str]:
        return set(group.trainable) | set(group.material).intersection(History._fields)

    planes, spheres = material["planes"], material["spheres"]
    planes[:, PLANES["friction"]] = 0.0
    spheres[:, SPHERES["friction"]] = 0.0
    motion = SPHERES["motion"]
    values = sim.scene.values()
    values = dataclasses.replace(
        values,
        stiffness=material["stiffness"],
        masses=material["masses"],
        gravity=material["gravity"],
        pin_stiffness=material["pin_stiffness"],
        pin_targets=material["pin_targets"],
        planes=planes,
        spheres=spheres[:, : motion.start],
        damping=float(material["damping"]),
        poisson=None if values.poisson is None else material["poisson"],
        stencils=tuple(
            dataclasses.replace(group, material=group.material | {name: material[name] for name in changing(group)})
            for group in values.stencils
        ),
    )
    return step_problem(
        values,
        _double(state[0][item]),
        _double(state[1][item]),
        sim.time_step,
        forces=pushed,
        sphere_centers=spheres[:, SPHERES["center"]],
        sphere_starts=spheres[:, SPHERES["center"]] - sim.time_step * spheres[:, motion],
    )


def _load_forces(sim: Stepper, state: State | HistoryState, item: int, masses: Array, targets: Targets | None) -> Array:
    """Forces of pressure and wind on one environment [V, 3] N, evaluated in float64."""
    loads = SurfaceLoads.of(sim.scene, torch.float64, torch.device("cpu"))
    assert loads is not None
    values = {}
    for name, array in sim.load_values(targets, len(state[0])).items():
        shared = array.dim() == MATERIAL_ROWS[name].dims
        values[name] = _wide(array if shared else array[item if len(array) > 1 else 0])
    one = _wide(state[0][item, None]), _wide(state[1][item, None])
    return _double(loads.forces(one, torch.from_numpy(masses), sim.time_step, values)[0])


def _widened(targets: Mapping[Part, Tensor] | None) -> Mapping[Part, Tensor] | None:
    return None if targets is None else {part: _wide(place) for part, place in targets.items()}


def _wide(tensor: Tensor) -> Tensor:
    return tensor.detach().to("cpu", torch.float64)


def _wide_state(state: State | HistoryState) -> State | HistoryState:
    return named_state(state).detach().to("cpu", torch.float64)


def _double(tensor: Tensor) -> Array:
    return tensor.detach().double().cpu().numpy().copy()


@torch.no_grad()
def exact_steps(
    sim: Stepper,
    state: State | HistoryState,
    *,
    forces: Tensor | None = None,
    targets: Targets | None = None,
    start: str = "velocity",
    iterations: int = 5000,
) -> list[ExactStep]:
    """The converged frictionless step of every environment, for the state and material as rounded in `sim`.

    `Multilevel` runs in float64 on the CPU until the residual stops falling. Newton's method follows if the result is
    uncertain, with contacts or without. Other solvers then continue from the best result so far.

    With cloth, rods and other parts besides solids, Chebyshev goes first. Where these buckle a step has several minima.
    Errors are against the one that the default solver reaches; `Multilevel` may end in another.

    `ExactStep.uncertainty` bounds the remaining error. Where the elements are stable, |grad E| / min m/h^2 >= |u - u*|.
    Another bound is twice the next step of Newton's method, which is far shorter for stiff bodies. If the uncertainty
    is large, there is no converged step to compare with.

    Args:
        sim: scene, time step and material; its solver and device do not matter. float32 needs less certainty.
        state: start of the steps [B, V, 3].
        forces: [B, V, 3] N.
        targets: as in `Simulator.forward`.
        start: u_0 of the errors: "velocity", h v, or the "inertial" first iterate.
        iterations: most of each solver; of Chebyshev 40,000 with parts besides solids.
    """
    # independent of torch's default device
    with torch.device("cpu"):
        search = _Search(sim, state, forces, targets, start)
        several = sim.compiled.has_stencils
        for solver, chunk in _OF_STENCILS if several else _SOLVERS:
            most = max(iterations, _LONG) if several and isinstance(solver, Chebyshev) else iterations
            search.iterate(solver, chunk, most)
            search.polish(_FINE[sim.dtype])
            if search.sure:
                break
    return [step for step in search.found if step is not None]


@torch.no_grad()
def settled_steps(
    sim: Stepper,
    state: State | HistoryState,
    *,
    forces: Tensor | None = None,
    targets: Targets | None = None,
    enough: float = _SURE,
) -> list[ExactStep]:
    """The step of every environment with its friction, if iterations from "velocity" settle.

    There is no energy for Newton's method to minimise. So `Multilevel` in float64 on the CPU is followed by longer and
    longer runs of Chebyshev. `ExactStep.uncertainty` is the change by the last two runs. It stays large if the
    iterations cycle, for example between sticking and slipping. `ExactStep.errors_of` ignores friction.

    Steps with `Contact` have runs of Chebyshev alone, each from the start. `errors_of` is then of positions alone.

    Args:
        sim: scene, time step and material; its solver and device do not matter.
        state: start of the steps [B, V, 3].
        forces: [B, V, 3] N.
        targets: as in `Simulator.forward`.
        enough: uncertainty at which to stop.
    """
    with torch.device("cpu"):
        twin = plain_copy(sim)
        twin.solver, twin.tolerance = Chebyshev(), 0.0
        twin = twin.to("cpu", torch.float64)
        wide, pushed = _wide_state(state), None if forces is None else _wide(forces)
        placed = _wide(targets) if isinstance(targets, Tensor) else _widened(targets)

        def run(solver: Solver, iterations: int, start: str | Tensor = "velocity") -> State | HistoryState:
            twin.solver, twin.iterations = solver, iterations
            return twin(wide, pushed, placed, start)

        problems = [problem_of(sim, state, item, forces=forces, targets=targets) for item in range(len(wide.positions))]
        first = torch.from_numpy(np.stack([problem.unsolved() for problem in problems]))
        anew = sim.scene.contact is not None  # whose steps take no positions to start from
        after = run(Chebyshev() if anew else Multilevel(), _LEADING)
        moves = [torch.inf * torch.ones(len(first), dtype=torch.float64)]
        for iterations in _SETTLING:
            before, after = after, run(Chebyshev(), iterations, "velocity" if anew else after.positions)
            # from velocities, because a difference of positions loses digits
            moves.append((after.velocities - before.velocities).flatten(1).norm(dim=1) * twin.time_step)
            scale = (first - after.velocities * twin.time_step).flatten(1).norm(dim=1)
            rounding = ROUNDINGS * torch.finfo(torch.float64).eps * wide.positions.flatten(1).norm(dim=1)
            left = torch.maximum(moves[-2], moves[-1])
            if bool((left <= torch.maximum(enough * scale, rounding)).all()):
                break
    shares = left / scale.clamp(min=torch.finfo(torch.float64).tiny)
    found = zip(first.numpy(), (after.velocities * twin.time_step).numpy(), shares.tolist(), strict=True)
    return [
        ExactStep(problem, start, solution, share)
        for problem, (start, solution, share) in zip(problems, found, strict=True)
    ]


class _Search:
    """Search for the converged steps of a batch; keeps the best result of each environment."""

    def __init__(
        self, sim: Stepper, state: State | HistoryState, forces: Tensor | None, targets: Targets | None, start: str
    ) -> None:
        # the CPU runs all solvers; a GPU's kernel may not
        self.twin = frictionless(sim)
        self.twin.solver = Chebyshev()
        self.twin = self.twin.to("cpu", torch.float64)
        self.state = _wide_state(state)
        self.forces = None if forces is None else _wide(forces)
        self.targets = _wide(targets) if isinstance(targets, Tensor) else _widened(targets)
        self.problems = [problem_of(sim, state, item, forces=forces, targets=targets) for item in range(len(state[0]))]
        self.firsts = [
            problem.unsolved() if start == "velocity" else problem.first_iterate(start) for problem in self.problems
        ]
        near = [problem.first_iterate(start) for problem in self.problems]
        self.best: Tensor = torch.from_numpy(np.array(near))  # displacements [B, V, 3] m
        self.lowest = torch.full((len(self.problems),), torch.inf, dtype=torch.float64)
        self.found: list[ExactStep | None] = [None] * len(self.problems)

    @property
    def sure(self) -> bool:
        """Whether the uncertainty of every step is small enough."""
        return all(step is not None and step.uncertainty <= _SURE for step in self.found)

    def iterate(self, solver: Solver, chunk: int, most: int) -> None:
        """Continue from the best result with a solver until no residual falls any more."""
        self.twin.solver, self.twin.iterations = solver, chunk
        guess, idle = self.state.positions + self.best, 0
        for _ in range(0, most, chunk):
            after, info = self.twin(self.state, self.forces, self.targets, guess, return_info=True)
            # from velocities, because a difference of positions loses digits
            reached = after.velocities * self.twin.time_step
            better = info.residual < self.lowest
            halved = bool((info.residual < 0.5 * self.lowest).any())
            self.best = torch.where(better[:, None, None], reached, self.best)
            self.lowest = torch.where(better, info.residual, self.lowest)
            idle = 0 if halved else idle + 1
            least = _PATIENCE if bool((self.lowest > _NEARLY).any()) else 1
            if idle >= least or not bool((self.lowest > _SOLVED).any()):
                break
            guess = after.positions

    def polish(self, fine: float) -> None:
        """Bound the error of uncertain environments, by Newton's method where the residual does not suffice."""
        for item, (problem, first) in enumerate(zip(self.problems, self.firsts, strict=True)):
            known = self.found[item]
            if known is not None and known.uncertainty <= _SURE:
                continue
            step = _certified(problem, first, self.best[item].numpy(), fine)
            if known is None or step.uncertainty < known.uncertainty:
                self.found[item] = step
                self.best[item] = torch.from_numpy(step.solution)


def _certified(problem: StepProblem, first: Array, near: Array, fine: float) -> ExactStep:
    """The solution next to an almost converged displacement, with its uncertainty."""
    step = ExactStep(problem, first, near, _uncertainty(problem, first, near))
    if step.uncertainty <= fine:
        return step
    newton = ContactNewton(problem)
    solution = newton.minimise(near)
    direction, stable = newton.step(solution)
    bound = _relative_norm(2.0 * direction, first - solution) if stable else np.inf
    bound = min(_uncertainty(problem, first, solution), bound)
    return min(step, ExactStep(problem, first, solution, bound), key=lambda found: found.uncertainty)


def _uncertainty(problem: StepProblem, first: Array, displacement: Array) -> float:
    """|grad E| / min m/h^2 over |u_0 - u|."""
    weakest = float(problem.weight[problem.free].min(initial=np.inf))
    return _relative_norm(problem.residual(displacement) / weakest, first - displacement)


def _relative_norm(part: Array, whole: Array) -> float:
    size = float(np.linalg.norm(whole))
    return float(np.linalg.norm(part)) / size if size > 0.0 else 0.0
