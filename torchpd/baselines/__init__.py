"""Published methods to compare with."""

from .methods import BASELINES, Baseline, GaussSeidel, colour_vertices, factorised, run_baseline, two_stage_rho

__all__ = ["BASELINES", "Baseline", "GaussSeidel", "colour_vertices", "factorised", "run_baseline", "two_stage_rho"]
