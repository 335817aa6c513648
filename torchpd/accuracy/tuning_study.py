"""The study of `Simulator.tune`: a few states of the motion, each with its converged step, and trials from them."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import torch
from torch import Tensor

from ..common.tables import PLANES
from ..estimate.convergence import has_friction
from ..estimate.solver_choice import runs
from ..ops.diagonal import named_material, step_diagonal
from ..plan.material import dims_of, named_arrays
from ..scene.pins import PIN_HARD
from ..scene.solvers import Chebyshev, Multilevel, Solver
from ..scene.targets import Targets
from ..simulation.parametrization import plain_copy
from ..simulation.state import HistoryState, State, chosen, joined
from .error import ExactStep, exact_steps, settled_steps
from .tuning_result import Trial

if TYPE_CHECKING:
    from ..simulation.stepper import Stepper

__all__ = ["SAFETY", "AnyState", "Study", "allowed_uncertainty", "is_minimum", "make_study", "with_targets"]

AnyState: TypeAlias = State | HistoryState

# Safety factor of the error bound over studied errors, because other states may be harder. Studied errors may contain
# this share of the rounding.
SAFETY = 2.0
_STUDIED_ROUNDINGS = 2.0
_STEPS = (0, 1, 4, 12, 30)  # of the motion, whose states are studied
_TURNED = (0, 4)  # of these, also studied with the axes of their velocities exchanged
_HARDEST = 2  # further states: those that are hardest to solve
_TURN_ANGLES = (37.0, -110.0)  # [degrees] further directions of motions on rough ground
_SPEEDS = (0.6, 1.3)  # further speeds of motions in which bodies meet, over the given one
_ENVIRONMENTS = 3  # of a batch, besides the worst conditioned one
# iterations that produce the studied states: of Multilevel; of Chebyshev if that does not run, or may stagnate
_MOVING, _MOVING_PLAINLY = 64, 512
# uncertainty at which steps with friction count as settled: this share of the requested error, or of _COARSE
_SETTLED, _COARSE = 1e-2, 1e-2
_KNOWN = 0.1  # largest uncertainty of converged steps if a time is requested


@dataclass(frozen=True, eq=False)
class Study:
    """Inputs of every trial."""

    sim: Stepper  # its batch the studied states
    state: AnyState
    forces: Tensor | None
    exact: list[ExactStep]

    @property
    def roundings(self) -> list[float]:
        """Rounding of every state, relative to the displacement of its step."""
        return [step.rounding(self.sim.dtype) / step.scale for step in self.exact]

    def visible(self, trial: Trial) -> list[float]:
        """Errors of the states, 0 if rounding hides them."""
        pairs = zip(trial.errors, self.roundings, strict=True)
        return [0.0 if error <= rounding / SAFETY else error for error, rounding in pairs]

    def worst(self, trial: Trial) -> float:
        """The largest error that rounding does not hide."""
        return max(self.visible(trial))

    @torch.no_grad()
    def trial(self, solver: Solver, iterations: int) -> Trial:
        """Run a solver for some iterations from every state."""
        self.sim.solver, self.sim.iterations = solver, iterations
        after, info = self.sim(self.state, self.forces, return_info=True)
        displacements = after.velocities.double().cpu().numpy() * self.sim.time_step
        pairs = zip(self.exact, displacements, strict=True)
        # the uncertainty of the converged steps counts as error
        errors = [
            step.error_beyond_rounding(u, self.sim.dtype, _STUDIED_ROUNDINGS) + step.uncertainty for step, u in pairs
        ]
        return Trial(solver, iterations, max(errors), tuple(info.residual.tolist()), tuple(errors))


def is_minimum(sim: Stepper) -> bool:
    """Whether a step minimises an energy, without friction and contact between bodies."""
    return not has_friction(sim.compiled) and sim.scene.contact is None


def with_targets(sim: Stepper, targets: Targets | None, batch: int) -> Stepper:
    """The simulator with pins, spheres, fibres and loads as `targets` say."""
    if targets is None:
        return sim
    places = named_material(sim.material_at(targets, batch))
    placed = plain_copy(sim)
    moved = [name for name in ("pin_targets", "spheres", "fibre_length") if name in sim.material_names]
    changed = {name: places[name] for name in moved} | sim.load_values(targets, batch)
    placed.set_material(**{name: value.detach() for name, value in changed.items()})
    return placed


@torch.no_grad()
def make_study(sim: Stepper, start: AnyState, forces: Tensor | None, error: float | None) -> Study:
    """Study states of the motion from `start`, with their converged steps; free fall is left out."""
    items = _environments(sim, len(start[0]))
    some = _of_environments(sim, items, len(start[0]))
    some.tolerance = 0.0
    given = None if forces is None else forces.detach()[items]
    begun = chosen(start, items)
    states = [state for other in (begun, *_other_starts(some, begun)) for state in _motion(some, other, given)]
    everyone = _of_environments(some, list(range(len(items))) * len(states), len(items))
    state = joined(states)
    repeated = None if given is None else given.repeat(len(states), 1, 1)
    if not is_minimum(sim):
        exact = settled_steps(everyone, state, forces=repeated, enough=_SETTLED * (error or _COARSE))
    else:
        exact = exact_steps(everyone, state, forces=repeated)
    moving = [
        number
        for number, step in enumerate(exact)
        if step.moves(sim.dtype) and not _comes_to_rest(step, allowed_uncertainty(error))
    ]
    if not moving:
        raise ValueError(
            "tune: this scene has no motion that needs solving: from the given state the bodies rest or fall freely; "
            "pass a state of the motion that matters, for example sim.tune(state, error=1e-2)"
        )
    picked = _of_environments(everyone, moving, len(exact))
    pushed = None if repeated is None else repeated[moving]
    return Study(picked, chosen(state, moving), pushed, [exact[number] for number in moving])


def allowed_uncertainty(error: float | None) -> float:
    """Largest relative uncertainty of a converged step."""
    return _KNOWN if error is None else error / SAFETY


def _comes_to_rest(step: ExactStep, allowed: float) -> bool:
    """Whether a body comes to rest: its displacement is so small that float64 rounding makes it uncertain."""
    return step.uncertainty > allowed and step.uncertainty * step.scale <= step.rounding(torch.float64)


def _environments(sim: Stepper, batch: int) -> list[int]:
    """Some environments of a batch, evenly spread, and the one with the worst conditioned system."""
    items = set(np.linspace(0, batch - 1, _ENVIRONMENTS).round().astype(int).tolist())
    inertia, diagonal = step_diagonal(sim.plan.arrays, sim.material(), sim.time_step)
    ratio = torch.where(inertia.isinf(), torch.ones_like(inertia), inertia / diagonal)
    if ratio.dim() == 2 and len(ratio) == batch:
        items.add(int(ratio.min(dim=1).values.argmin()))
    return sorted(items)


def _other_starts(sim: Stepper, start: AnyState) -> list[AnyState]:
    """Starts of further motions, where what is hard to solve depends on the path: on rough ground, and of contact."""
    met = () if sim.scene.contact is None else _SPEEDS
    faster = [start._replace(velocities=speed * start[1]) for speed in met if bool(start[1].any())]
    return [*_turned_starts(sim, start), *faster]


def _turned_starts(sim: Stepper, start: AnyState) -> list[AnyState]:
    """The start with velocities turned about the normal of rough ground, because sticking depends on the path."""
    planes = sim.planes.detach()
    if not bool((planes[..., PLANES["friction"]] > 0.0).any()):
        return []
    planes = planes.reshape(-1, *planes.shape[-2:])  # [1 or B, C, 5]
    # the rough plane of each environment that bears most of the weight
    bears = -(planes[..., PLANES["normal"]] * sim.gravity.detach().reshape(-1, 1, 3)).sum(dim=-1)
    most = bears.masked_fill(planes[..., PLANES["friction"]] <= 0.0, -math.inf).argmax(dim=1)
    chosen = planes.expand(len(most), -1, -1)[torch.arange(len(most), device=most.device), most]
    normal = chosen[:, None, PLANES["normal"]]
    across = torch.linalg.cross(normal.expand_as(start[1]), start[1])
    along = (start[1] * normal).sum(dim=-1, keepdim=True) * normal
    return [
        start._replace(velocities=along + math.cos(angle) * (start[1] - along) + math.sin(angle) * across)
        for angle in map(math.radians, _TURN_ANGLES)
        if bool(across.any())
    ]


def _motion(sim: Stepper, start: AnyState, forces: Tensor | None) -> list[AnyState]:
    """The states before the steps `_STEPS`, solved accurately enough, and a few others.

    Turned states have the same shape and speeds in other directions: an equally likely motion that excites other modes.
    The hardest states are those where a fifth of the iterations leaves the largest error. A motion may pass a few
    states in which the energy is not convex, and all solvers leave these slowly.
    """
    mover = copy.copy(sim)
    smooth = not (has_friction(mover.compiled) or mover.compiled.has_stencils)
    if smooth and runs(Multilevel(), mover.compiled):
        mover.solver, mover.iterations = Multilevel(), _MOVING
    else:
        mover.solver, mover.iterations = Chebyshev(), _MOVING_PLAINLY
    prober = copy.copy(mover)
    prober.iterations = mover.iterations // 5
    states, state, hardest = [], start, list[tuple[float, AnyState]]()
    for step in range(max(_STEPS) + 1):
        if step in _STEPS:
            states.append(state)
        if step in _TURNED:
            states.append(state._replace(velocities=state[1].roll(1, -1)))
        after = mover(state, forces)
        if not bool(after[0].isfinite().all()):
            break
        if step not in _STEPS:
            left = _relative_error(prober(state, forces), state, after, sim.time_step)
            hardest = sorted([*hardest, (left, state)], key=lambda pair: -pair[0])[:_HARDEST]
        state = after
    return [*states, *(state for _, state in hardest)]


def _relative_error(rough: AnyState, before: AnyState, after: AnyState, time_step: float) -> float:
    """Error of a roughly solved step, relative to the change from x + h v, largest of the environments."""
    size = [(v - after[1]).flatten(1).norm(dim=1) for v in (rough[1], before[1])]
    rounding = 10.0 * torch.finfo(after[0].dtype).eps / time_step * after[0].flatten(1).norm(dim=1)
    left = (size[0] - rounding).clamp(min=0.0) / size[1].clamp(min=torch.finfo(after[0].dtype).tiny)
    return float(left.max())


def _of_environments(sim: Stepper, items: list[int], batch: int) -> Stepper:
    """The simulator for some environments of a batch, with the rows of their material."""
    own = {
        name: array.detach()[items]
        for name, array in named_arrays(sim).items()
        if array.dim() > dims_of(name) and len(array) == batch
    }
    if "pin_stiffness" in own:
        own.setdefault(PIN_HARD, sim.pin_hard)
    picked = plain_copy(sim)
    picked.named_iterations = True  # the study itself measures whether they suffice
    picked.set_material(**own)
    return picked
