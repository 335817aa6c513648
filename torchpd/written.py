"""What others have written into a simulator where no step would see it."""

from __future__ import annotations

from copy import deepcopy
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from .scene import Scene

__all__ = ["Written"]

_ANOTHER_SHAPE = "and for another shape make a Simulator of another mesh"


class Written:
    """Looks at rest shape and hard pins where they were written to since it looked last: a step takes 0.5 us to know.

    On the CPU alone: to look means to wait for a GPU. Not at what torch traces or maps, either.
    """

    def __init__(self) -> None:
        self._rest: Tensor | None = None
        self._rest_version = self._pins_version = -1
        self._pins: Tensor | None = None
        self._hard: Tensor | None = None  # where pins held exactly [P] or [B, P]

    def __deepcopy__(self, memo: dict[int, Any]) -> Written:
        """A copy has arrays of its own, but the same pins are hard."""
        copied = Written()
        copied._hard = deepcopy(self._hard, memo)
        return copied

    def __reduce__(self) -> tuple[type[Written], tuple[()]]:
        return Written, ()

    def remember_pins(self, stiffness: Tensor) -> None:
        """These are checked."""
        if _can_be_read(stiffness):
            self._pins, self._pins_version = stiffness, stiffness._version
            self._hard = stiffness.detach().isinf()

    def check_pins(self, stiffness: Tensor) -> None:
        """Refuse NaN where there was inf, of which averages and weight decay make it.

        Any other NaN belongs to its environment, whose residual tells.
        """
        if torch.compiler.is_compiling() or (stiffness is self._pins and stiffness._version == self._pins_version):
            return
        if type(stiffness) is not nn.Parameter or not _can_be_read(stiffness):
            return
        hard = self._hard
        if hard is not None and hard.shape == stiffness.shape and bool((stiffness.isnan() & hard).any()):
            raise ValueError(
                "pin_stiffness of pins that hold exactly was inf and has become NaN, as weight decay and the averages "
                "of torch.optim.swa_utils make of it: give optimisers only what is learned, AveragedModel an avg_fn "
                'that keeps inf (docs/limits.md, "Material that is learned"), and set_material(pin_stiffness=...) '
                "what was there"
            )
        self.remember_pins(stiffness)

    def check_rest(self, positions: Tensor, scene: Scene) -> None:
        """Refuse a rest shape that is learned or changed: steps have the one that was compiled."""
        if positions.requires_grad and torch.is_grad_enabled():
            raise ValueError(
                "rest_positions requires a gradient, but the rest shape is compiled into the plan and gets none: "
                f"requires_grad_(False), {_ANOTHER_SHAPE}"
            )
        if torch.compiler.is_compiling() or (positions is self._rest and positions._version == self._rest_version):
            return
        if not _can_be_read(positions):
            return
        own = np.concatenate([solid.mesh.vertices for solid in scene.solids])
        if not torch.equal(positions, torch.tensor(own, dtype=positions.dtype, device="cpu")):
            raise ValueError(
                "rest_positions are not those of the scene, but steps have the rest shape that was compiled from it: "
                f"write back what was there, {_ANOTHER_SHAPE}"
            )
        self._rest, self._rest_version = positions, positions._version


def _can_be_read(array: Tensor) -> bool:
    plain = type(array) in (Tensor, nn.Parameter) and array.device.type == "cpu" and not array.is_inference()
    return plain and not torch._C._functorch.is_functorch_wrapped_tensor(array)
