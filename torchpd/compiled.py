"""A scene with all that a step of it has: what modules below the simulator read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from .diagonal import named_material
from .material import environments_of_material
from .pins import PinnedPieces
from .plan import Plan
from .scene import Scene
from .solvers import Solver

__all__ = ["CompiledScene", "persistent_tensors"]


@contextmanager
def persistent_tensors() -> Iterator[None]:
    """For tensors that are kept: those that are made in inference mode can never be changed or differentiated.

    Those that name no device are for the CPU, whatever torch's default device.
    """
    with torch.inference_mode(False), torch.no_grad(), torch.device("cpu"):
        yield


@dataclass(frozen=True, eq=False, kw_only=True)
class CompiledScene:
    """Plan, material and settings of a scene at one time; `Simulator` documents the settings.

    A value: other settings make another one, with `dataclasses.replace` or `reconfigure`.
    """

    scene: Scene
    pinned: PinnedPieces  # where pins hold the pieces of the scene
    plan: Plan
    material: list[Tensor]  # in the order of the ops, with inf for springs of hard pins
    time_step: float  # h [s]
    iterations: int
    tolerance: float
    solver: Solver
    adjoint: str
    kernel: str
    batch: int | None
    progress: bool

    @property
    def vertices(self) -> int:
        """Vertices of all bodies."""
        return self.plan.vertices

    @property
    def dtype(self) -> torch.dtype:
        """Precision of states."""
        return self.plan.dtype

    @property
    def device(self) -> torch.device:
        """Where states are."""
        return self.plan.device

    @cached_property
    def named(self) -> dict[str, Tensor]:
        """The material by name."""
        return named_material(self.material)

    @property
    def environments(self) -> int:
        """Environments of a step: those that were announced, or those of the material."""
        return self.batch or environments_of_material(self.named)
