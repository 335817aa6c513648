"""The multilevel preconditioner of a scene: made once, of the material then, as arrays that follow the plan's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from . import _C
from .diagonal import named_material, step_diagonal
from .plan import Plan, compiling
from .scene import SceneValues
from .tables import MULTILEVEL_TABLE, PLAN_TABLE

__all__ = ["has_levels", "inertia_of_levels", "precondition_plan", "reference_of", "without_levels"]


def has_levels(plan: Sequence[Tensor]) -> bool:
    """Whether the arrays of a plan include those of a preconditioner."""
    return len(plan) == len(PLAN_TABLE) + len(MULTILEVEL_TABLE)


def inertia_of_levels(plan: Sequence[Tensor]) -> Tensor:
    """Inertia a that a preconditioner was made of [V] N/m, in the user's order; inf where held."""
    row = next(number for number, row in enumerate(MULTILEVEL_TABLE) if row.name == "reference_inertia")
    _, vertex_order, *_ = plan
    stored = plan[len(PLAN_TABLE) + row]
    return torch.empty_like(stored).index_copy(0, vertex_order.long(), stored)


def without_levels(plan: Plan) -> Plan:
    """The plan alone."""
    return replace(plan, arrays=plan.arrays[: len(PLAN_TABLE)], table=PLAN_TABLE) if has_levels(plan.arrays) else plan


def reference_of(plan: Plan, material: Sequence[Tensor], time_step: float) -> tuple[Tensor, Tensor]:
    """What a matrix for all environments is made of: the largest stiffness [E] Pa and inertia a [V] N/m of any.

    A vertex counts as held (inf) where a hard pin holds it in every environment. Inertia stands in internal order. An
    environment whose values are all s times these loses nothing: M / s serves it exactly.
    """
    stiffness = named_material(material)["stiffness"].detach()
    inertia, _ = step_diagonal(plan.arrays[: len(PLAN_TABLE)], [array.detach() for array in material], time_step)
    stiffness = stiffness.amax(0) if stiffness.dim() == 2 else stiffness
    if inertia.dim() == 2:
        largest = torch.where(inertia.isinf(), 0.0, inertia).amax(0)
        inertia = torch.where(inertia.isinf().all(0), torch.inf, largest)
    return stiffness.to(plan.dtype), inertia[plan.vertex_order.long()].to(plan.dtype)


def precondition_plan(
    plan: Plan, values: SceneValues, stiffness: Tensor, inertia: Tensor, *, progress: bool = False
) -> Plan:
    """The plan with a multilevel approximation of A^-1 for a material, see csrc/plan/multilevel_build.h.

    Args:
        plan: of the CPU.
        values: of the scene that the plan was compiled from.
        stiffness: [E] Pa, in the plan's precision, which decides the bits of the result.
        inertia: a of each internal vertex [V] N/m, inf where held.
        progress: show a bar when the mesh is large.
    """
    order = plan.vertex_order.numpy()
    by_user = np.empty(len(order))
    by_user[order] = inertia.double().numpy()
    with compiling(len(values.tets), progress) as advance:
        arrays: dict[str, NDArray[Any]] = _C.build_multilevel(
            values.rest_positions, values.tets, order, stiffness.double().numpy(), by_user,
            torch.get_num_threads(), advance,
        )  # fmt: skip
    tensors = (torch.from_numpy(arrays[row.name]) for row in MULTILEVEL_TABLE)
    levels = (t.to(plan.dtype) if t.is_floating_point() else t for t in tensors)
    return replace(plan, arrays=(*plan.arrays[: len(PLAN_TABLE)], *levels), table=PLAN_TABLE + MULTILEVEL_TABLE)
