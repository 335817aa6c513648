"""Guards against in-place changes of a user's tensors, which a step checks in 0.3 us.

`pin_hard` and `rest_positions` belong to users, who may write into them in place without any notice.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..common.checks import has_values, plain_tensor
from ..scene.scene import Scene

__all__ = ["MutationGuard", "check_rest"]

_ANOTHER_SHAPE = "and for another shape make a Simulator of another mesh"


class MutationGuard:
    """A tensor, its version when it was last read, and the result of reading it. A copy of a guard guards nothing."""

    def __init__(self, tensor: Tensor | None = None, found: Any = None) -> None:
        self.found = found
        # inference tensors count no versions
        self._tensor = None if tensor is None or tensor.is_inference() else tensor
        self._version = -1 if self._tensor is None else self._tensor._version

    def __deepcopy__(self, memo: dict[int, Any]) -> MutationGuard:
        return MutationGuard()

    def __reduce__(self) -> tuple[type[MutationGuard], tuple[()]]:
        return MutationGuard, ()

    def is_current(self, tensor: Tensor) -> bool:
        """Whether this is the guarded tensor, unchanged since, except through `.data`."""
        return tensor is self._tensor and tensor._version == self._version


def check_rest(guard: MutationGuard, positions: Tensor, scene: Scene) -> MutationGuard:
    """Refuse a rest shape that requires a gradient or, on the CPU, has changed: steps use the compiled one."""
    if positions.requires_grad and torch.is_grad_enabled():
        raise ValueError(
            "rest_positions must not require a gradient: the rest shape is compiled into the plan and gets none; use "
            f"requires_grad_(False), {_ANOTHER_SHAPE}"
        )
    if torch.compiler.is_compiling() or guard.is_current(positions):
        return guard
    # reading a GPU's would wait for it
    readable = positions.device.type == "cpu" and has_values(positions) and plain_tensor(positions) is positions
    if not readable or positions.is_inference():
        return guard
    if not torch.equal(positions, torch.tensor(scene.rest_positions, dtype=positions.dtype, device="cpu")):
        raise ValueError(
            "rest_positions must be those of the scene, whose rest shape is compiled, but they were changed: "
            f"restore them, {_ANOTHER_SHAPE}"
        )
    return MutationGuard(positions)
