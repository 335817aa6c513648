"""A compiled scene with everything that a step needs, for modules below the simulator."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from ..ops.diagonal import named_material
from ..scene.pins import PinnedComponents
from ..scene.scene import Scene
from ..scene.solvers import Solver
from .cpu_plan import Plan
from .material import environments_of_material

__all__ = ["CompiledScene", "Planned", "persistent_tensors"]


@contextmanager
def persistent_tensors() -> Iterator[None]:
    """Context for tensors that are kept: those made in inference mode could never be changed or differentiated.

    New tensors without a device go to the CPU, whatever torch's default device.
    """
    with torch.inference_mode(False), torch.no_grad(), torch.device("cpu"):
        yield


class Planned:
    """What has a plan, and says of it how many vertices it has, in which precision and where."""

    plan: Plan

    @property
    def vertices(self) -> int:
        """Number of vertices of all bodies."""
        return self.plan.vertices

    @property
    def dtype(self) -> torch.dtype:
        """Precision of states."""
        return self.plan.dtype

    @property
    def device(self) -> torch.device:
        """Device of plan and states."""
        return self.plan.device


@dataclass(frozen=True, eq=False, kw_only=True)
class CompiledScene(Planned):
    """Plan, material and settings of a scene at one time; `Simulator` documents the settings.

    A value: other settings make another one, by `dataclasses.replace` or `reconfigure`.
    """

    scene: Scene
    pinned: PinnedComponents  # pinned points of the scene's components
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

    @cached_property
    def named(self) -> dict[str, Tensor]:
        """The material by name."""
        return named_material(self.material)

    @cached_property
    def has_stencils(self) -> bool:
        """Whether the scene has elements besides tetrahedra: cloth, springs, fibres, and the like."""
        return any(row.name == "stencil_sizes" for row in self.plan.table)

    @property
    def environments(self) -> int:
        """Environments of a step: the announced batch, or those of the material."""
        return self.batch or environments_of_material(self.named)
