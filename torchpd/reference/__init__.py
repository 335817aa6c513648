"""The same step in NumPy float64, for tests: slow and plain."""

from .geometry import Array, elements, gradient_operator
from .problem import StepProblem, elastic_energy, kinetic_energy, potential_energy, step_problem
from .rotations import nearest_rotation, nearest_rotation_fast

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
