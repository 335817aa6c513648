"""Projective dynamics as first published, on a GPU: a dense inverse solves the global step exactly.

Studies on a GPU compare with it, as `baselines` are for the CPU. The local step is the compiled one of the library. One
CUDA graph holds all iterations, so that the host does not slow the method down.
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

MOST_VERTICES = 8192  # their inverse takes 0.5 GB in float64
_DELAY = 10


class DenseDirect:
    """Iterate u <- u_prev + omega (u - A^-1 grad E(u) - u_prev) with a dense A^-1; omega = 1 is the plain iteration.

    Source: Bouaziz et al. 2014, with the acceleration of Wang 2015.

    Args:
        sim: a simulator of the scene; its device and precision are those of the iterations.
        problem: the step of one environment.

    Raises:
        ValueError: the scene has contacts, or more than `MOST_VERTICES` vertices.
    """

    def __init__(self, sim: Stepper, problem: StepProblem) -> None:
        refuse_contacts(problem)
        vertices, free = len(problem.free), np.flatnonzero(problem.free)
        if vertices > MOST_VERTICES:
            raise ValueError(f"vertices must be at most {MOST_VERTICES} for a dense inverse, got {vertices}")

        def here(array: Array) -> Tensor:
            return torch.as_tensor(array, dtype=sim.dtype, device=sim.device)

        matrix = torch.as_tensor(problem.matrix[free][:, free].toarray(), device=sim.device)
        inverse = torch.cholesky_inverse(torch.linalg.cholesky(matrix)).to(sim.dtype)
        # rows of held vertices are zero, so that an iteration needs no gather of the free ones
        self._inverse = inverse.new_zeros((vertices, vertices))
        self._inverse[torch.from_numpy(free[:, None]), torch.from_numpy(free)] = inverse
        self._weight, self._target = here(problem.weight[:, None]), here(problem.target)
        self._positions = here(problem.positions)
        self._material, self._plan = [array.detach() for array in sim.material()], list(sim.plan.arrays)

    @property
    def bytes(self) -> int:
        """Size of the inverse [bytes]."""
        return self._inverse.numel() * self._inverse.element_size()

    def iterate(self, first: Tensor, omegas: Sequence[float]) -> Tensor:
        """u [V, 3] m after one iteration per omega, from `first`."""
        before = current = first
        for omega in omegas:
            elastic = torch.ops.torchpd.gradient((self._positions + current)[None], self._material, self._plan)[0]
            slope = torch.addcmul(elastic, self._weight, current - self._target)
            stepped = torch.addmm(current, self._inverse, slope, alpha=-1.0)
            current, before = stepped if omega == 1.0 else torch.lerp(before, stepped, omega), current
        return current.clone()

    def recorded(self, first: Tensor, omegas: Sequence[float]) -> Callable[[], Tensor]:
        """A callable that repeats `iterate` from the current contents of `first`.

        On a GPU it replays one CUDA graph; the next call overwrites its result.
        """
        return _Recording(self, first, omegas) if first.device.type == "cuda" else partial(self.iterate, first, omegas)


class _Recording:
    """A CUDA graph of all iterations."""

    def __init__(self, method: DenseDirect, first: Tensor, omegas: Sequence[float]) -> None:
        # the graph stores addresses only: these tensors must live as long as the graph
        self._alive = (method, first)
        with torch.cuda.device(first.device):
            # a first call may allocate or load a library, and omega = 1 skips some calls: neither can be captured
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


# the omegas of a step, computed from its first iterate
DENSE: dict[str, Callable[[StepProblem, Array, int], list[float]]] = {
    "direct global step, dense": _plain,
    "direct global step + Chebyshev, dense": _accelerated,
}
