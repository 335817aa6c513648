"""The unsolved step, relative to which errors are measured: h v, with hard pins at their targets, out of contacts."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..common.tables import PLANES, SPHERES
from ..ops.diagonal import named_material, pinned_vertices
from ..plan.cpu_plan import Plan
from ..simulation.state import State

__all__ = ["ROUNDINGS", "unsolved_step"]

# machine epsilons of positions: rounding error of a body in free fall, and scatter of a stiff one
ROUNDINGS = 10.0


@torch.no_grad()
def unsolved_step(plan: Plan, arrays: Sequence[Tensor], time_step: float, state: State) -> Tensor:
    """Displacements [B, V, 3] [m] of a step without solving: x_0 - x of `TuningResult`, without friction.

    The same as `torchpd.reference.StepProblem.course`. The iterations of a step start from its rigid motions.

    Args:
        plan: of the scene.
        arrays: material of the step, with its targets, see `Simulator.material_at`.
        time_step: h [s].
        state: start of the step.
    """
    x, moved = state[0], time_step * state[1]
    material = named_material(arrays)
    free = torch.ones_like(x[..., :1], dtype=torch.bool)
    if len(plan.pin_vertex):
        vertices = pinned_vertices(plan.arrays)
        hard = material["pin_stiffness"].isinf().expand(len(x), -1)[..., None]
        held = torch.where(hard, material["pin_targets"] - x[:, vertices], moved[:, vertices])
        moved, free = moved.index_copy(1, vertices, held), free.index_copy(1, vertices, ~hard)
    headed = x + moved
    places = headed
    for row in material["planes"].unbind(-2):
        normals = row[..., None, PLANES["normal"]]
        places = _pushed_out(places, normals, (places * normals).sum(-1) - row[..., PLANES["height"], None])
    for row in material["spheres"].unbind(-2):
        # with the normal at the vertex before any contact
        centers = row[..., None, SPHERES["center"]]
        arms = headed - centers
        lengths = arms.norm(dim=-1, keepdim=True)
        normals = torch.where(lengths > 0.0, arms / lengths, torch.eye(3, dtype=x.dtype, device=x.device)[1])
        gaps = ((places - centers) * normals).sum(-1) - row[..., SPHERES["radius"], None]
        places = _pushed_out(places, normals, gaps)
    return torch.where(free, moved + (places - headed), moved)


def _pushed_out(places: Tensor, normals: Tensor, gaps: Tensor) -> Tensor:
    return places + (-gaps).clamp(min=0.0)[..., None] * normals
