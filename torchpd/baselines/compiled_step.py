"""The step of `reference` in float64 on the CPU with the compiled local step, shared by the baseline methods."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..ops.energy import elastic_energy
from ..plan.cpu_plan import compile_plan
from ..plan.material import material_of, material_rows
from ..reference.problem import StepProblem

__all__ = ["CompiledStep", "CountedStep"]

Array = NDArray[np.float64]

_ops = torch.ops.torchpd


@dataclass(frozen=True)
class CountedStep(StepProblem):
    """A step that counts its evaluations."""

    calls: list[int] = field(default_factory=lambda: [0])

    def evaluate(self, displacement: Array) -> tuple[float, Array]:
        self.calls[0] += 1
        return super().evaluate(displacement)


@dataclass(frozen=True)
class CompiledStep(CountedStep):
    """E and grad E of `StepProblem` to rounding, with the elastic part from the ops, on torch's threads.

    Energy and gradient are separate passes over the elements, each made only on request.
    """

    @cached_property
    def _elements(self) -> tuple[list[Tensor], list[Tensor]]:
        """Material and plan arrays."""
        plan = compile_plan(self.values, dtype=torch.float64, progress=False)
        return material_rows(material_of(self.values, torch.float64)), list(plan.arrays)

    @cached_property
    def _quadratic(self) -> Array:
        """a_i [V, 1] N/m, zero at hard pins, which add nothing to E."""
        return np.where(self.free, self.weight, 0.0)[:, None]

    @cached_property
    def _held(self) -> NDArray[np.int64]:
        return np.flatnonzero(~self.free)

    def evaluate(self, displacement: Array) -> tuple[float, Array]:
        self.calls[0] += 1
        return self._energy(displacement), self._gradient(displacement)

    def energy(self, displacement: Array) -> float:
        self.calls[0] += 1
        return self._energy(displacement)

    def gradient(self, displacement: Array) -> Array:
        self.calls[0] += 1
        return self._gradient(displacement)

    def _positions_tensor(self, displacement: Array) -> Tensor:
        return torch.from_numpy(self.positions + displacement)[None]

    def _energy(self, displacement: Array) -> float:
        pull = displacement - self.target
        elastic = float(elastic_energy(self._positions_tensor(displacement), *self._elements))
        return 0.5 * float(np.vdot(self._quadratic * pull, pull)) + elastic

    def _gradient(self, displacement: Array) -> Array:
        gradient: Array = _ops.gradient(self._positions_tensor(displacement), *self._elements)[0].numpy()
        gradient += self._quadratic * (displacement - self.target)
        gradient[self._held] = 0.0
        return gradient
