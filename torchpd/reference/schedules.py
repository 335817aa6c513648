"""Weights omega_k of the accelerated iterations, and the restart of their momentum."""

from __future__ import annotations

import numpy as np

__all__ = ["Classic", "Guarded", "Plain"]


class Plain:
    """Jacobi iteration: omega = 1."""

    def omega(self, iteration: int) -> float:
        return 1.0

    def check(self, energy: float) -> bool:
        return False


class Classic:
    """The recurrence of Wang 2015: 1 before the delay S, 2 / (2 - rho^2) at S, 4 / (4 - rho^2 omega) after it."""

    def __init__(self, rho: float, delay: int) -> None:
        self.rho, self.delay, self.last = rho, delay, 1.0

    def omega(self, iteration: int) -> float:
        if iteration >= self.delay:
            at_start = iteration == self.delay
            self.last = 2.0 / (2.0 - self.rho**2) if at_start else 4.0 / (4.0 - self.rho**2 * self.last)
        return self.last

    def check(self, energy: float) -> bool:
        return False


class Guarded:
    """Momentum age / (age + 3), up to the limit of Chebyshev's recurrence; restarts when the energy has risen."""

    def __init__(self, rho: float, tolerance: float) -> None:
        self.limit = ((1.0 - np.sqrt(1.0 - rho**2)) / rho) ** 2 if rho > 0.0 else 0.0
        self.tolerance, self.age, self.last = tolerance, 0, np.inf

    def omega(self, iteration: int) -> float:
        momentum = min(self.limit, self.age / (self.age + 3.0))
        self.age += 1
        return 1.0 + momentum

    def check(self, energy: float) -> bool:
        risen = energy > self.last * (1.0 + self.tolerance)
        self.age, self.last = 0 if risen else self.age, energy
        return bool(risen)
