"""Checks of the arguments of `Simulator.tune`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from ..common.checks import check_like
from ..ops.diagonal import named_material, step_diagonal
from ..plan.material import environments_of_material, named_arrays
from ..scene.contact import Collider
from ..scene.targets import Targets
from ..simulation.state import HistoryState, State
from .error import ExactStep

if TYPE_CHECKING:
    from ..simulation.stepper import Stepper

__all__ = ["check_known", "check_request", "check_start"]

_UNBOUNDED = ("pin_stiffness", "max_flow")  # hard pins have infinite springs; flow has no limit by default


def check_request(error: float | None, milliseconds: float | None) -> None:
    """Check that one target is given, within its range."""
    if (error is None) == (milliseconds is None):
        raise ValueError(
            f"tune: exactly one of error and milliseconds must be given, got error={error} and "
            f"milliseconds={milliseconds}; "
            "for example sim.tune(error=1e-2)"
        )
    if error is not None and not 0.0 < error < 1.0:
        raise ValueError(f"tune: error must lie in (0, 1), where 1 is the unsolved step x + h v; got {error}")
    if milliseconds is not None and not 0.0 < milliseconds < math.inf:
        raise ValueError(f"tune: milliseconds must be positive and finite, got {milliseconds}")


def check_start(sim: Stepper, state: State | HistoryState, forces: Tensor | None, targets: Targets | None) -> None:
    """Check that states, forces and material are finite, the system is not singular, and colliders stay."""
    if isinstance(targets, Mapping) and any(isinstance(part, Collider) for part in targets):
        raise ValueError(
            "tune: targets must not move a Collider, because the study keeps colliders where the state has them, got a "
            "pose; leave it out, and pass a state of the motion that matters"
        )
    sim.check_state(state, forces=forces)
    if forces is not None:
        check_like("forces", forces, state[0], "N")
    if state[0].dim() != 3 or not len(state[0]):
        raise ValueError(f"tune: state must hold environments [B, V, 3], at least one, got {list(state[0].shape)}")
    count = environments_of_material(named_arrays(sim))
    if count not in (1, len(state[0])):
        raise ValueError(f"tune: state must have the {count} environments of the material, got {len(state[0])}")
    for name, part in zip(State._fields, state[:2], strict=True):
        bad = (~part.isfinite()).flatten(1).any(1).nonzero()
        if len(bad):
            raise ValueError(f"tune: state.{name} must be finite, got NaN or infinity in environment {int(bad[0])}")
    values = {"forces": forces} if forces is not None else {}
    for name, array in (values | named_material(sim.material())).items():
        bad = (array.isnan() if name in _UNBOUNDED else ~array.isfinite()).nonzero()
        if len(bad):
            raise ValueError(f"tune: {name} must be finite, got NaN or infinity at {bad[0].tolist()}")
    inertia, diagonal = step_diagonal(sim.plan.arrays, sim.material(), sim.time_step)
    bad = ~((inertia > 0) & (diagonal > 0)).reshape(-1, sim.vertices).all(0)
    if bool(bad.any()):
        vertex = int(bad.nonzero()[0])
        raise ValueError(
            f"tune: the system is singular: vertex {vertex} has inertia {float(inertia[..., vertex].min()):g} N/m and "
            f"diagonal {float(diagonal[..., vertex].min()):g} N/m, which must be positive; check masses and stiffness"
        )


def check_known(steps: Sequence[ExactStep], allowed: float) -> None:
    """Refuse a study without converged steps to compare with."""
    uncertainty = max(step.uncertainty for step in steps)
    if not uncertainty <= allowed:
        raise RuntimeError(
            f"tune: no converged step to compare with: the best float64 solution of one of the {len(steps)} studied "
            f"steps may itself be wrong by {uncertainty:.1e}, which must be at most {allowed:.1e}; solver and "
            "iterations are unchanged. Look for slivers in the mesh (quality()), or request a larger error"
        )
