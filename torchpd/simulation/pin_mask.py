"""The mask of hard pins as steps need it: users may write into it, and the plan follows."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..common.checks import has_values, plain_tensor
from ..plan.compiled import CompiledScene, persistent_tensors
from ..plan.cpu_plan import Plan
from ..plan.mutation_guard import MutationGuard
from ..plan.placement import is_recording, plan_after_release, plan_without_released_pins
from ..plan.preconditioner import has_preconditioner
from ..scene.pins import hold_exactly

__all__ = ["PinMask", "held_springs", "read_pin_mask", "serves_any_mask"]


class PinMask(NamedTuple):
    """Result of reading the mask of hard pins."""

    some: bool  # whether any pin may be hard
    springs: Tensor | None = None  # stored springs from which `held` was made
    held: Tensor | None = None  # springs for the ops
    version: int | None = None  # of `springs`; None if all pins are hard, when springs do not matter


def held_springs(mask: PinMask, springs: Tensor, hard: Tensor) -> Tensor:
    """`pin_stiffness` for the ops: inf where a pin is hard."""
    some, known, held, version = mask
    if not some:
        return springs
    learned = springs.requires_grad and torch.is_grad_enabled()
    # a CUDA graph must see later masks
    if known is not springs or held is None or learned or (springs.is_cuda and is_recording(springs.device)):
        return hold_exactly(springs, hard)
    if version is not None and springs._version != version:
        return hold_exactly(springs, hard)
    return held


def serves_any_mask(plan: Plan) -> bool:
    """Whether nothing in a plan depends on which pins are hard."""
    return (plan.loose is None or bool(plan.loose.all())) and not has_preconditioner(plan.arrays)


def read_pin_mask(compiled: CompiledScene, hard: Tensor, *, wait: bool = False) -> tuple[MutationGuard, Plan]:
    """Read the mask `hard`, which waits for a GPU; return a guard with a `PinMask`, and the plan that follows it.

    Released components get rigid motions, and a preconditioner stops holding them. With `wait`, later steps on any
    stream may use the springs that are made here.
    """
    plain, springs = plain_tensor(hard), compiled.named["pin_stiffness"]
    if not has_values(plain) or is_recording(plain.device):
        return MutationGuard(found=PinMask(some=True)), compiled.plan
    rows = plain.cpu().reshape(-1, plain.shape[-1])
    mask = PinMask(some=bool(rows.any()))
    with persistent_tensors():
        plan = plan_without_released_pins(compiled, plan_after_release(compiled, rows), rows.all(0))
        # streams wait for a change of material, but not for a tensor that another stream made in a step
        if plain is hard and type(springs) is nn.Parameter and mask.some and (wait or not hard.is_cuda):
            version = None if bool(rows.all()) else springs._version
            mask = PinMask(True, springs, hold_exactly(springs, hard), version)
    return MutationGuard(hard if plain is hard else None, mask), plan
