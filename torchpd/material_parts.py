"""Columns of the material that have names in scenes: friction, height of grounds, radius of spheres."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from .material import MATERIAL_ROWS, real_tensor

if TYPE_CHECKING:
    from .model import Model

__all__ = ["COLUMNS", "whole_arrays"]

# of each name the arrays that have it, and where
COLUMNS = {
    "friction": {"planes": 4, "spheres": 4},
    "height": {"planes": 3},
    "radius": {"spheres": 3},
}
_THINGS = {"planes": "grounds", "spheres": "spheres"}


def whole_arrays(sim: Model, owner: str, arrays: Mapping[str, Tensor | float]) -> dict[str, Tensor | float]:
    """The arrays with the named columns written into those of the simulator; values are the caller's to check."""
    whole = {name: value for name, value in arrays.items() if name not in COLUMNS}
    for name in [name for name in arrays if name in COLUMNS]:
        if given := [array for array in COLUMNS[name] if array in arrays]:
            column = COLUMNS[name][given[0]]
            raise TypeError(f"{owner}: give {name} or {given[0]}, whose column {column} it is, got both")
        rows = {array: getattr(sim, array).shape[-2] for array in COLUMNS[name]}
        value = _values(sim, owner, name, arrays[name], rows)
        for array, part in zip(rows, value.split(list(rows.values()), dim=-1), strict=True):
            if rows[array]:
                own = whole.get(array, getattr(sim, array).detach())
                assert isinstance(own, Tensor)
                whole[array] = _with_column(owner, name, array, own, part)
    return whole


def _values(sim: Model, owner: str, name: str, value: Tensor | float, rows: Mapping[str, int]) -> Tensor:
    """[rows] or [B, rows], in the precision of the simulator."""
    things, count = " and ".join(_THINGS[array] for array in rows), sum(rows.values())
    if count == 0:
        raise ValueError(f"{owner}: {name} is of {things}, and the scene has none")
    tensor = real_tensor(owner, name, value)
    if tensor.dim() > 2 or tensor.numel() == 0 or (tensor.dim() > 0 and tensor.shape[-1] not in (1, count)):
        raise ValueError(
            f"{owner}: {name} must be [{count}], or with a batch in front, got {list(tensor.shape)}; {things} of the "
            f"scene: {count}"
        )
    own = sim.planes
    return tensor.to(dtype=own.dtype, device=own.device).expand(*tensor.shape[:-1], count)


def _with_column(owner: str, name: str, array: str, own: Tensor, value: Tensor) -> Tensor:
    """The array [rows, width], or with a batch, with other numbers in one column."""
    batches = [len(t) for t, dims in ((own, MATERIAL_ROWS[array].dims), (value, 1)) if t.dim() > dims]
    if len(batches) == 2 and batches[0] != batches[1] and 1 not in batches:
        raise ValueError(
            f"{owner}: {name} is of {batches[1]} environments, but {array} are of {batches[0]}; give {array} instead"
        )
    if batches:
        own, value = own.expand(max(batches), *own.shape[-2:]), value.expand(max(batches), value.shape[-1])
    column = COLUMNS[name][array]
    return torch.cat([own[..., :column], value[..., None], own[..., column + 1 :]], dim=-1)
