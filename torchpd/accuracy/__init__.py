"""Errors of a step against converged ones, and tuning by them."""

from .error import Errors, ExactStep, exact_steps, frictionless, problem_of, scene_without_friction, settled_steps

__all__ = [
    "Errors",
    "ExactStep",
    "exact_steps",
    "frictionless",
    "problem_of",
    "scene_without_friction",
    "settled_steps",
]
