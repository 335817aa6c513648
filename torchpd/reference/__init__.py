"""The same step in NumPy float64, for tests: slow and plain."""

from .problem import (
    Array,
    StepProblem,
    elastic_energy,
    elements,
    gradient_operator,
    kinetic_energy,
    nearest_rotation,
    nearest_rotation_fast,
    potential_energy,
    step_problem,
)

__all__ = [
    "Array",
    "StepProblem",
    "elastic_energy",
    "elements",
    "gradient_operator",
    "kinetic_energy",
    "nearest_rotation",
    "nearest_rotation_fast",
    "potential_energy",
    "step_problem",
]
