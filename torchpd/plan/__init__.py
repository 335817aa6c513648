"""A scene compiled for a device: partition, element tables, preconditioner, kernel choice."""

from .cpu_plan import KERNELS, Plan, compile_plan

__all__ = ["KERNELS", "Plan", "compile_plan"]
