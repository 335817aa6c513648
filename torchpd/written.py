"""What others have written into a simulator since it looked last: a step takes 0.3 us to know.

`pin_hard` and `rest_positions` are tensors of users, who write into them in place; nothing else tells of that.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from .checks import has_values, plain_tensor
from .scene import Scene

__all__ = ["MutationGuard", "check_rest"]

_ANOTHER_SHAPE = "and for another shape make a Simulator of another mesh"


class MutationGuard:
    """A tensor, its version when somebody looked at it, and what was found. A copy of this has seen nothing."""

    def __init__(self, tensor: Tensor | None = None, found: Any = None) -> None:
        self.found = found
        self._tensor = None if tensor is None or tensor.is_inference() else tensor  # those count no versions
        self._version = -1 if self._tensor is None else self._tensor._version

    def __deepcopy__(self, memo: dict[int, Any]) -> MutationGuard:
        return MutationGuard()

    def __reduce__(self) -> tuple[type[MutationGuard], tuple[()]]:
        return MutationGuard, ()

    def holds(self, tensor: Tensor) -> bool:
        """Whether this is the tensor, and nobody has written into it since, but through `.data`."""
        return tensor is self._tensor and tensor._version == self._version


def check_rest(seen: MutationGuard, positions: Tensor, scene: Scene) -> MutationGuard:
    """Refuse a rest shape that is learned or, on the CPU, changed: steps have the one that was compiled."""
    if positions.requires_grad and torch.is_grad_enabled():
        raise ValueError(
            "rest_positions requires a gradient, but the rest shape is compiled into the plan and gets none: "
            f"requires_grad_(False), {_ANOTHER_SHAPE}"
        )
    if torch.compiler.is_compiling() or seen.holds(positions):
        return seen
    # to look at a GPU's means to wait for it
    readable = positions.device.type == "cpu" and has_values(positions) and plain_tensor(positions) is positions
    if not readable or positions.is_inference():
        return seen
    own = np.concatenate([solid.mesh.vertices for solid in scene.solids])
    if not torch.equal(positions, torch.tensor(own, dtype=positions.dtype, device="cpu")):
        raise ValueError(
            "rest_positions are not those of the scene, but steps have the rest shape that was compiled from it: "
            f"write back what was there, {_ANOTHER_SHAPE}"
        )
    return MutationGuard(positions)
