"""Convergence estimates before a run, and the choice of a solver from them."""

__all__: list[str] = []
