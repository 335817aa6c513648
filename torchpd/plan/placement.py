"""Plan placement: compile, move and rebuild the plan when device, precision, solver or pins change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .. import _C
from ..common.checks import plain_tensor
from ..common.gpu import check_free_memory, free_memory, properties_of, unavailable_reason, visible_devices
from ..common.tables import EFFECT_ROWS, KINDS
from ..ops.diagonal import pinned_vertices
from ..scene.solvers import Multilevel, Newton
from .compiled import CompiledScene
from .cpu_plan import Plan, compile_plan, with_loose_components
from .kernel_benchmark import fastest_plan
from .kernel_choice import OTHER_BODIES, choose_plan
from .material import dims_of, material_of, material_rows
from .preconditioner import (
    ReferenceMaterial,
    has_preconditioner,
    precondition_plan,
    reference_material,
    stored_reference,
    without_preconditioner,
)

__all__ = [
    "check_target_device",
    "find_device",
    "is_recording",
    "is_suitable",
    "move_plan",
    "plan_after_release",
    "plan_for_device",
    "plan_for_solver",
    "plan_without_released_pins",
    "recompile_plan",
    "step_bytes",
]

Pieces = NDArray[np.bool_]


def _reason(device: torch.device | None = None) -> str:
    capability = None if device is None else torch.cuda.get_device_capability(device)
    return unavailable_reason(bool(_C.build_info()["cuda"]), torch.version.cuda, torch.cuda.device_count(), capability)


def find_device(name: str) -> torch.device:
    """Parse and check the `--device` argument."""
    kind = name.split(":")[0]
    if kind not in ("cpu", "cuda"):
        raise ValueError(f"--device must be cpu or cuda, got {name}")
    if kind == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: torch sees no CUDA device here; python -m torchpd doctor says more")
    device = torch.device(name)
    if kind == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise ValueError(f"--device must be an existing GPU, got {name}: {visible_devices()}")
    return device


def check_target_device(fn: Callable[[Tensor], Tensor], probe: Tensor) -> Tensor:
    """Apply `fn`, which moves or converts, to an empty tensor; explains why a GPU is not available."""
    try:
        wanted = fn(probe)
    except (AssertionError, RuntimeError) as error:
        reason = _reason()
        if not reason and "invalid device ordinal" in str(error):
            raise RuntimeError(f"Simulator: device must be an existing GPU: {visible_devices()}") from error
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
    """Whether the plan of one device is valid on the other; nothing runs on "meta"."""
    if source.type != "cuda" or target.type != "cuda":
        return target.type in ("meta", source.type)
    return source == target or properties_of(source) == properties_of(target)


def _compile(compiled: CompiledScene, dtype: torch.dtype, device: torch.device, loose: Pieces | None = None) -> Plan:
    """Compile the plan of a scene for a device, on the CPU, without the preconditioner."""
    values = compiled.scene.values()
    # on "meta" the hard pins are unknown
    if loose is None and compiled.device.type != "meta":
        loose = values.pinned.loose(compiled.named["pin_stiffness"].isinf().cpu().numpy())
    values = values if loose is None else replace(values, loose=loose)
    if device.type != "cuda":
        return compile_plan(values, dtype=dtype, progress=compiled.progress)
    lacking = [group.kind for group in values.stencils if not KINDS[group.kind].on_gpu]
    if lacking:
        raise RuntimeError(
            f"Simulator: device must be the CPU for scenes with plastic solids ({', '.join(lacking)}), which have no "
            f"kernels for {device}; keep it there, or leave plastic out"
        )
    return choose_plan(
        values, dtype, properties_of(device), compiled.kernel,
        levels=isinstance(compiled.solver, Multilevel), batch=compiled.batch, progress=compiled.progress,
        fastest=partial(fastest_plan, scene=compiled, dtype=dtype, device=device),
    )  # fmt: skip


def _uses_preconditioner(compiled: CompiledScene) -> bool:
    """Whether the steps or the adjoint use a multilevel preconditioner."""
    return isinstance(compiled.solver, Multilevel | Newton) or compiled.adjoint == "multilevel"


def _has_patches_for(compiled: CompiledScene, plan: Plan) -> bool:
    """Whether the patches suit the solver: on a GPU a multilevel solver needs its own, the adjoint does not."""
    return plan.kernel is None or plan.for_multilevel == isinstance(compiled.solver, Multilevel)


def is_suitable(compiled: CompiledScene) -> bool:
    """Whether the plan suits the solver and the adjoint."""
    return _has_patches_for(compiled, compiled.plan) and has_preconditioner(
        compiled.plan.arrays
    ) == _uses_preconditioner(compiled)


def _with_preconditioner(compiled: CompiledScene, plan: Plan, reference: ReferenceMaterial) -> Plan:
    """Add a multilevel preconditioner to a plan. On a GPU only the stream kernel reads it, for solids alone."""
    if plan.kernel is not None and compiled.has_stencils:
        raise ValueError(
            f'Simulator: adjoint="multilevel" needs a scene of solids alone on a GPU, got {OTHER_BODIES} too; '
            'leave adjoint at "solver"'
        )
    if plan.kernel not in (None, "stream"):
        raise ValueError(
            f'Simulator: adjoint="multilevel" needs kernel="stream" on a GPU, got kernel={compiled.kernel!r} '
            f'("{plan.kernel}" for this scene); set kernel="stream", or leave adjoint at "solver"'
        )
    return precondition_plan(plan, compiled.scene.values(), *reference, progress=compiled.progress)


def plan_for_solver(compiled: CompiledScene) -> Plan:
    """The plan for the current solver and adjoint; a preconditioner is built from the current material."""
    plan = without_preconditioner(compiled.plan)
    if not _has_patches_for(compiled, plan):
        plan = _compile(compiled, compiled.dtype, compiled.device)
    if _uses_preconditioner(compiled):
        plan = _with_preconditioner(
            compiled, plan, reference_material(compiled.plan, compiled.material, compiled.time_step)
        )
    return move_plan(compiled, plan, compiled.device)


def plan_after_release(compiled: CompiledScene, hard: Tensor) -> Plan:
    """The plan after pins are released by a mask [P] or [B, P]: their components may move rigidly too.

    Returns the present plan if no component changes.
    """
    before = compiled.plan.loose
    if before is None or bool(before.all()):
        return compiled.plan
    loose = before | compiled.pinned.loose(hard.cpu().numpy())
    if bool((loose == before).all()):
        return compiled.plan
    if compiled.plan.kernel is None:
        return with_loose_components(compiled.plan, replace(compiled.scene.values(), loose=loose))
    return move_plan(compiled, recompile_plan(compiled, compiled.dtype, compiled.device, loose), compiled.device)


def plan_without_released_pins(compiled: CompiledScene, plan: Plan, hard: Tensor) -> Plan:
    """The plan with a preconditioner that holds only the pins that are hard in every environment [P].

    Its reference material stays, except at the released pins: held by the preconditioner, they would not move.
    """
    if not has_preconditioner(plan.arrays):
        return plan
    stiffness, inertia = stored_reference(plan.arrays)
    freed = pinned_vertices(plan.arrays)[~hard.to(plan.device)]
    freed = freed[inertia[freed].isinf()]
    if not len(freed):
        return plan
    masses, damping = (plain_tensor(compiled.named[name].detach()) for name in ("masses", "damping"))
    drag = 1.0 + damping.max() * compiled.time_step
    inertia[freed] = masses.reshape(-1, plan.vertices).amax(0)[freed] / compiled.time_step**2 * drag
    plan = precondition_plan(plan, compiled.scene.values(), stiffness, inertia, progress=compiled.progress)
    return move_plan(compiled, plan, compiled.device)


def move_plan(compiled: CompiledScene, plan: Plan, device: torch.device, material: int = 0) -> Plan:
    """Move a plan to a device. A GPU must have memory for it, `material` further bytes, and a step."""
    if plan.device == device:
        return plan
    if device.type == "cuda":
        needed = plan.bytes + material + step_bytes(compiled, plan, compiled.environments, device)
        check_free_memory(needed, free_memory(device))
    return plan.to(device)


def step_bytes(compiled: CompiledScene, plan: Plan, batch: int, device: torch.device) -> int:
    """Memory of a step in bytes, beside plan, material and states, as the op allocates it.

    Args:
        compiled: the scene; its solver and material are used.
        plan: of a GPU, with its preconditioner if any; it may still be on the CPU.
        batch: number of environments.
        device: the GPU.
    """
    real = torch.finfo(plan.dtype).bits // 8
    none = np.empty(0, dtype=np.int32)
    levels = plan.level_sizes.numpy() if has_preconditioner(plan.arrays) else none
    stencils = plan.stencil_sizes.numpy() if compiled.has_stencils else none
    rows = plan.row_sizes.numpy() if compiled.has_stencils else none
    planes, spheres = (compiled.named[name] for name in ("planes", "spheres"))

    def own(name: str) -> bool:
        array = compiled.named[name]
        return array.dim() > dims_of(name) and len(array) == batch

    tets = own("stiffness") or ("poisson" in compiled.named and own("poisson"))
    effects = any(own(row.name) for row in EFFECT_ROWS if row.name in compiled.named)
    schedule: int = compiled.solver.settings()["schedule"]
    with torch.cuda.device(device):
        return _C.step_bytes(
            real, plan.sizes.numpy(), levels, stencils, rows, schedule, batch, planes.shape[-2], spheres.shape[-2],
            tets, effects,
        )  # fmt: skip


def is_recording(device: torch.device) -> bool:
    """Whether torch.compile or a CUDA graph is recording, so that no value may be read."""
    return torch.compiler.is_compiling() or (device.type == "cuda" and torch.cuda.is_current_stream_capturing())


def recompile_plan(
    compiled: CompiledScene, dtype: torch.dtype, device: torch.device, loose: Pieces | None = None
) -> Plan:
    """Compile the plan for a precision and a device, on the CPU; `loose`: components that may move rigidly."""
    plan = _compile(compiled, dtype, device, loose)
    if not _uses_preconditioner(compiled):
        return plan
    # The reference material stays, as in a saved file. On "meta" its values are lost.
    if compiled.device.type == "meta":
        arrays = material_rows(material_of(compiled.scene.values(), compiled.dtype))
        source = compile_plan(compiled.scene.values(), dtype=compiled.dtype, progress=False)
        reference = reference_material(source, arrays, compiled.time_step)
    else:
        reference = stored_reference(compiled.plan.arrays)
    return _with_preconditioner(compiled, plan, reference)


def plan_for_device(compiled: CompiledScene, dtype: torch.dtype, device: torch.device) -> Plan:
    """The plan for a precision and a device: the present one, moved, if it is valid there."""
    same = dtype == compiled.dtype and _same_plan(compiled.device, device)
    plan = compiled.plan if same else recompile_plan(compiled, dtype, device)
    numbers = sum(array.numel() for array in compiled.material) + 3 * compiled.vertices
    return move_plan(compiled, plan, device, numbers * (torch.finfo(dtype).bits // 8))
