"""Projective dynamics as it was first published, on a GPU: the global step solved exactly by a dense inverse.

What a study on a GPU compares with, as `baselines` are on the CPU. The local step is the compiled one of the library,
and all iterations are one CUDA graph, so that the host does not slow the method down.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..reference.problem import StepProblem
from ..reference.solvers import classic_omegas
from ..simulation.stepper import Stepper
from .methods import factorised, refuse_contacts, two_stage_rho

__all__ = ["DENSE", "MOST_VERTICES", "DenseDirect"]

Array = NDArray[np.float64]

MOST_VERTICES = 8192  # whose inverse takes 0.5 GB in float64
_DELAY = 10


class DenseDirect:
    """u <- u_prev + omega (u - A^-1 grad E(u) - u_prev), from A^-1 as a matrix; omega = 1 is the plain iteration.

    Source: Bouaziz et al. 2014, with Wang's (2015) acceleration of it.

    Args:
        sim: of the scene, whose device and precision are those of the iterations.
        problem: the step, of one environment.

    Raises:
        ValueError: the scene has contacts, or more than `MOST_VERTICES` vertices.
    """

    def __init__(self, sim: Stepper, problem: StepProblem) -> None:
        refuse_contacts(problem)
        vertices, free = len(problem.free), np.flatnonzero(problem.free)
        if vertices > MOST_VERTICES:
            raise ValueError(f"a dense inverse is for up to {MOST_VERTICES} vertices; this scene has {vertices}")

        def here(array: Array) -> Tensor:
            return torch.as_tensor(array, dtype=sim.dtype, device=sim.device)

        matrix = torch.as_tensor(problem.matrix[free][:, free].toarray(), device=sim.device)
        inverse = torch.cholesky_inverse(torch.linalg.cholesky(matrix)).to(sim.dtype)
        # zero where vertices are held, so that an iteration is a few calls without a detour through the free ones
        self._inverse = inverse.new_zeros((vertices, vertices))
        self._inverse[torch.from_numpy(free[:, None]), torch.from_numpy(free)] = inverse
        self._weight, self._target = here(problem.weight[:, None]), here(problem.target)
        self._positions = here(problem.positions)
        self._material, self._plan = [array.detach() for array in sim.material()], list(sim.plan.arrays)

    @property
    def bytes(self) -> int:
        """Memory of the inverse."""
        return self._inverse.numel() * self._inverse.element_size()

    def iterate(self, first: Tensor, omegas: Sequence[float]) -> Tensor:
        """u [V, 3] m after as many iterations as there are omegas, from `first`."""
        before = current = first
        for omega in omegas:
            elastic = torch.ops.torchpd.gradient((self._positions + current)[None], self._material, self._plan)[0]
            slope = torch.addcmul(elastic, self._weight, current - self._target)
            stepped = torch.addmm(current, self._inverse, slope, alpha=-1.0)
            current, before = stepped if omega == 1.0 else torch.lerp(before, stepped, omega), current
        return current.clone()

    def recorded(self, first: Tensor, omegas: Sequence[float]) -> Callable[[], Tensor]:
        """`iterate` to be called again and again, from what `first` then holds.

        On a GPU it is one CUDA graph, whose result the next call overwrites.
        """
        return _Recording(self, first, omegas) if first.device.type == "cuda" else partial(self.iterate, first, omegas)


class _Recording:
    """A CUDA graph of all iterations."""

    def __init__(self, method: DenseDirect, first: Tensor, omegas: Sequence[float]) -> None:
        # the graph knows addresses only: what lies there has to live as long as it does
        self._alive = (method, first)
        with torch.cuda.device(first.device):
            # what libraries allocate or load at a first call cannot be recorded; nor can what only omega = 1 leaves out
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                method.iterate(first, [1.0, omegas[-1]])
            torch.cuda.current_stream().wait_stream(stream)
            self._graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(self._graph):
                self._end = method.iterate(first, omegas)

    def __call__(self) -> Tensor:
        self._graph.replay()
        return self._end


def _plain(problem: StepProblem, first: Array, iterations: int) -> list[float]:
    return [1.0] * iterations


def _accelerated(problem: StepProblem, first: Array, iterations: int) -> list[float]:
    return classic_omegas(two_stage_rho(problem, first, factorised(problem)), _DELAY, iterations)


# the omegas of a step, from its first iterate
DENSE: dict[str, Callable[[StepProblem, Array, int], list[float]]] = {
    "direct global step, dense": _plain,
    "direct global step + Chebyshev, dense": _accelerated,
}
