"""What a simulator will run, in words: `print(sim)`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from . import _C
from .solvers import Chebyshev

if TYPE_CHECKING:
    from .simulator import Simulator

__all__ = ["describe"]

# What each effect adds to a step; folded ones are part of the weights and targets that every vertex has anyway.
_FOLDED = "folded into the inertia of a vertex: nothing per iteration"


def _solver_line(sim: Simulator) -> str:
    numbers = sim.solver.numbers()
    name = f"Chebyshev {sim.solver.schedule}" if isinstance(sim.solver, Chebyshev) else "Jacobi"
    stop = f"at most {sim.iterations}" if sim.tolerance else f"{sim.iterations}"
    rho = f", rho {numbers['rho']:g}" if numbers["rho"] else ""
    diagonal = "weighted" if numbers["weighted"] else "plain"
    tolerance = f", tolerance {sim.tolerance:g}" if sim.tolerance else ""
    return f"{name}: {stop} iterations, relaxation {numbers['relaxation']:g}, {diagonal} diagonal{rho}{tolerance}"


def _effect_lines(sim: Simulator) -> list[str]:
    scene = sim.scene
    tets = sum(len(solid.mesh.tets) for solid in scene.solids)
    lines = [f"solids: {len(scene.solids)} ({tets} tetrahedra), one local step an iteration"]
    hard = sum(len(pin.vertices) for pin in scene.pins if pin.stiffness is None)
    soft = sum(len(pin.vertices) for pin in scene.pins) - hard
    if hard:
        lines.append(f"hard pins: {hard} vertices that do not move: nothing per iteration")
    if soft:
        lines.append(f"soft pins: {soft} springs, {_FOLDED}")
    if bool((sim.gravity != 0).any()):
        lines.append(f"gravity: {_FOLDED}")
    if bool((sim.damping != 0).any()):
        lines.append(f"damping: {_FOLDED}")
    if scene.grounds:
        lines.append(f"grounds: {len(scene.grounds)}, one projection a vertex and iteration each")
    if scene.spheres:
        lines.append(f"spheres: {len(scene.spheres)}, one projection a vertex and iteration each")
    return lines


def _pass_line(sim: Simulator) -> str:
    plan = sim.plan
    shared = len(plan.shared_start) - 1
    second = f" and one over {shared} vertices that patches share" if shared else ""
    return (
        f"an iteration is one pass over {plan.patches} patches{second}; "
        "from 8 environments on, SIMD lanes run over environments"
    )


def describe(sim: Simulator) -> str:
    """Lines for `print(sim)`: sizes, solver, effects, passes, memory."""
    plan = sim.plan
    material = sum(array.numel() * array.element_size() for array in sim.material())
    real = torch.finfo(sim.dtype).bits // 8
    # five vectors of four numbers, two weights, and the slots of the patches
    per_environment = real * (22 * plan.vertices + 8 * len(plan.slot_vertex))
    simd = _C.build_info()["simd"]
    lines = [
        f"{plan.vertices} vertices, time step {sim.time_step:.6g} s, {sim.dtype} on {sim.device} ({simd})",
        _solver_line(sim),
        *_effect_lines(sim),
        _pass_line(sim),
        f"memory: plan {plan.bytes:,} B, material {material:,} B, {per_environment:,} B an environment during a step",
    ]
    return "\n  ".join(lines)
