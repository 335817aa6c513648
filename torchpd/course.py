"""Where the error of a step is measured from: h v, with pins where they are to be, and out of contacts."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .diagonal import named_material, pinned_vertices
from .plan import Plan
from .state import State
from .tables import PLANES, SPHERES

__all__ = ["unsolved_step"]


@torch.no_grad()
def unsolved_step(plan: Plan, arrays: Sequence[Tensor], time_step: float, state: State) -> Tensor:
    """Displacements [B, V, 3] [m] of a step in which nothing is solved: x_0 - x of `TuningResult`, without friction.

    As `torchpd.reference.StepProblem.course`. The iterations of a step start from where rigid motions lead from there.

    Args:
        plan: of the scene.
        arrays: the material of the step, with its targets, see `Simulator.material_at`.
        time_step: h [s].
        state: where the step starts.
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
        places = _out_of(places, normals, (places * normals).sum(-1) - row[..., PLANES["height"], None])
    for row in material["spheres"].unbind(-2):
        # by the normal at where the vertices were headed
        centers = row[..., None, SPHERES["center"]]
        arms = headed - centers
        lengths = arms.norm(dim=-1, keepdim=True)
        normals = torch.where(lengths > 0.0, arms / lengths, torch.eye(3, dtype=x.dtype, device=x.device)[1])
        gaps = ((places - centers) * normals).sum(-1) - row[..., SPHERES["radius"], None]
        places = _out_of(places, normals, gaps)
    return torch.where(free, moved + (places - headed), moved)


def _out_of(places: Tensor, normals: Tensor, gaps: Tensor) -> Tensor:
    return places + (-gaps).clamp(min=0.0)[..., None] * normals
