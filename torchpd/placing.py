"""Moving a simulator: every device needs a plan of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from . import _C
from .diagonal import pinned_vertices
from .gpu import free_memory, properties_of, refuse_full_memory, seen_devices, step_bytes, why_not
from .material import environments_of_material, in_order, material_of
from .multilevel import Reference, has_levels, precondition_plan, reference_of, reference_of_levels, without_levels
from .plan import Plan, compile_plan, with_loose_pieces
from .regimes import choose_plan
from .solvers import Multilevel
from .written import plain_tensor

if TYPE_CHECKING:
    from .model import Model

__all__ = [
    "check_wanted_device",
    "find_device",
    "is_recording",
    "loosened_plan",
    "move_plan",
    "plan_anew",
    "plan_for_solver",
    "plan_on",
    "plan_that_holds",
    "serves",
]

Pieces = NDArray[np.bool_]


def _reason(device: torch.device | None = None) -> str:
    capability = None if device is None else torch.cuda.get_device_capability(device)
    return why_not(bool(_C.build_info()["cuda"]), torch.version.cuda, torch.cuda.device_count(), capability)


def find_device(name: str) -> torch.device:
    """What --device names, if it is there."""
    kind = name.split(":")[0]
    if kind not in ("cpu", "cuda"):
        raise ValueError(f"--device must be cpu or cuda, got {name}")
    if kind == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: torch sees no CUDA device here; python -m torchpd doctor says more")
    device = torch.device(name)
    if kind == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise ValueError(f"--device {name} is not there: {seen_devices()}")
    return device


def check_wanted_device(fn: Callable[[Tensor], Tensor], probe: Tensor) -> Tensor:
    """What `fn`, which moves or converts, makes of an empty tensor; explains why a GPU cannot be had."""
    try:
        wanted = fn(probe)
    except (AssertionError, RuntimeError) as error:
        reason = _reason()
        if not reason and "invalid device ordinal" in str(error):
            raise RuntimeError(f"Simulator: there is no such GPU: {seen_devices()}") from error
        if not reason or not any(word in str(error) for word in ("CUDA", "NVIDIA")):
            raise
        raise RuntimeError(f"Simulator: no CUDA here: {reason}") from error
    if wanted.device.type not in ("cpu", "cuda", "meta"):
        raise RuntimeError(f"Simulator: there are no kernels for {wanted.device.type}; it runs on the CPU and on CUDA")
    if wanted.device.type == "cuda":
        reason = _reason(wanted.device)
        if reason:
            raise RuntimeError(f"Simulator: {wanted.device} cannot be used: {reason}")
    return wanted


def _same_plan(source: torch.device, target: torch.device) -> bool:
    """Whether the plan of one device serves the other: nothing runs on "meta"."""
    if source.type != "cuda" or target.type != "cuda":
        return target.type in ("meta", source.type)
    return source == target or properties_of(source) == properties_of(target)


def _compile(sim: Model, dtype: torch.dtype, device: torch.device, loose: Pieces | None = None) -> Plan:
    """The scene's plan for a device and the solver, on the CPU, without what the solver prepares."""
    values = sim.scene.values()
    # "meta" does not know which pins are hard
    if loose is None and sim.device.type != "meta":
        loose = values.pinned.loose(sim.pin_hard.cpu().numpy())
    values = values if loose is None else replace(values, loose=loose)
    if device.type != "cuda":
        return compile_plan(values, dtype=dtype, progress=sim.progress)
    levels = isinstance(sim.solver, Multilevel)
    gpu = properties_of(device)
    return choose_plan(values, dtype, gpu, sim.kernel, levels=levels, batch=sim.batch, progress=sim.progress)


def _wants_levels(sim: Model) -> bool:
    """Whether steps or gradients use a multilevel preconditioner."""
    return isinstance(sim.solver, Multilevel) or sim.adjoint == "multilevel"


def _has_patches_for(sim: Model, plan: Plan) -> bool:
    """Whether the patches serve the solver: a GPU wants others for a multilevel solver, whatever gradients use."""
    return plan.kernel is None or plan.for_levels == isinstance(sim.solver, Multilevel)


def serves(sim: Model, plan: Plan) -> bool:
    """Whether a plan has what the solver and gradients of a simulator use."""
    return _has_patches_for(sim, plan) and has_levels(plan.arrays) == _wants_levels(sim)


def _with_levels(sim: Model, plan: Plan, reference: Reference) -> Plan:
    """The plan with a multilevel preconditioner; of a GPU's kernels only one reads it."""
    if plan.kernel not in (None, "stream"):
        raise ValueError(
            f'Simulator: adjoint="multilevel" needs kernel="stream" on a GPU, got kernel={sim.kernel!r}, which is '
            f'"{plan.kernel}" for this scene; set kernel="stream", or leave adjoint at "solver"'
        )
    return precondition_plan(plan, sim.scene.values(), *reference, progress=sim.progress)


def plan_for_solver(sim: Model, material: Sequence[Tensor], plan: Plan | None = None) -> Plan:
    """The plan of a simulator, or the one given, with what its solver and gradients use of a material."""
    plan = without_levels(sim.plan if plan is None else plan)
    if not _has_patches_for(sim, plan):
        plan = _compile(sim, sim.dtype, sim.device)
    if _wants_levels(sim):
        plan = _with_levels(sim, plan, reference_of(sim.plan, material, sim.time_step))
    return move_plan(sim, plan, sim.device)


def loosened_plan(sim: Model, hard: Tensor) -> Plan:
    """The plan of a simulator where pieces that a mask [P] or [B, P] lets go move rigidly too; its own if they do."""
    before = sim.plan.loose
    if before is None or bool(before.all()):
        return sim.plan
    loose = before | sim.pinned.loose(hard.cpu().numpy())
    if bool((loose == before).all()):
        return sim.plan
    if sim.plan.kernel is None:
        return with_loose_pieces(sim.plan, replace(sim.scene.values(), loose=loose))
    return move_plan(sim, plan_anew(sim, sim.dtype, sim.device, loose), sim.device)


def plan_that_holds(sim: Model, plan: Plan, hard: Tensor) -> Plan:
    """The plan whose preconditioner, if it has one, holds no pin but those that are hard in every environment [P].

    It is made of what the one before was made of, but for the pins that are let go: held by it they would not move.
    """
    if not has_levels(plan.arrays):
        return plan
    stiffness, inertia = reference_of_levels(plan.arrays)
    freed = pinned_vertices(plan.arrays)[~hard.to(plan.device)]
    freed = freed[inertia[freed].isinf()]
    if not len(freed):
        return plan
    masses, damping = (plain_tensor(array.detach()) for array in (sim.masses, sim.damping))
    drag = 1.0 + damping.max() * sim.time_step
    inertia[freed] = masses.reshape(-1, plan.vertices).amax(0)[freed] / sim.time_step**2 * drag
    plan = precondition_plan(plan, sim.scene.values(), stiffness, inertia, progress=sim.progress)
    return move_plan(sim, plan, sim.device)


def move_plan(sim: Model, plan: Plan, device: torch.device, material: int = 0) -> Plan:
    """A plan on its device, where a GPU has room for it, for `material` bytes beside it and for a step."""
    if plan.device == device:
        return plan
    if device.type == "cuda":
        needed = plan.bytes + material + step_bytes(sim, plan, sim.batch or environments_of_material(sim), device)
        refuse_full_memory(needed, free_memory(device))
    return plan.to(device)


def is_recording(device: torch.device) -> bool:
    """Whether torch.compile or a CUDA graph is looking on, which can wait for no value."""
    return torch.compiler.is_compiling() or (device.type == "cuda" and torch.cuda.is_current_stream_capturing())


def plan_anew(sim: Model, dtype: torch.dtype, device: torch.device, loose: Pieces | None = None) -> Plan:
    """The plan of a simulator for a precision and a device, on the CPU; `loose`: its pieces that can move rigidly."""
    plan = _compile(sim, dtype, device, loose)
    if not _wants_levels(sim):
        return plan
    # what M was made of goes along, as into a file; coming from "meta" the values are lost
    if sim.device.type == "meta":
        arrays = in_order(material_of(sim.scene.values(), sim.dtype))
        source = compile_plan(sim.scene.values(), dtype=sim.dtype, progress=False)
        reference = reference_of(source, arrays, sim.time_step)
    else:
        reference = reference_of_levels(sim.plan.arrays)
    return _with_levels(sim, plan, reference)


def plan_on(sim: Model, dtype: torch.dtype, device: torch.device) -> Plan:
    """The plan of a simulator for a precision and a device: its own moved there where that will do."""
    same = dtype == sim.dtype and _same_plan(sim.device, device)
    plan = sim.plan if same else plan_anew(sim, dtype, device)
    numbers = sum(array.numel() for array in (*sim.material(), sim.rest_positions))
    return move_plan(sim, plan, device, numbers * (torch.finfo(dtype).bits // 8))
