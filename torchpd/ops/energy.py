"""Elastic energy of all elements of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor

from ..common.tables import EFFECT_ROWS, MATERIAL_TABLE

__all__ = ["elastic_energy"]

_ops = torch.ops.torchpd
_CORE = len(MATERIAL_TABLE) - len(EFFECT_ROWS)  # arrays that every scene has


def elastic_energy(positions: Tensor, material: Sequence[Tensor], plan: Sequence[Tensor]) -> Tensor:
    """Elastic energy of each environment [B] J, from the arrays of the ops."""
    arrays, constants = list(material), list(plan)
    if len(arrays) > _CORE:
        return cast(Tensor, _ops.effect_energy(positions, arrays, constants))  # of tetrahedra, too
    return cast(Tensor, _ops.element_energy(positions, arrays, constants)).sum(-1)
