"""The errors of `tools/sanitize.py --plant`, which a sanitizer must report."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from sanitize_scenes import BAR, KERNEL_CASES, KernelCase, ball_of_patches, compiled_for, samples_everywhere, scene
from torch import Tensor

import torchpd as pd


def change_plan(sim: pd.Simulator, name: str, change: Callable[[Tensor], Tensor]) -> None:
    """Replace an array of the plan."""
    rows = zip(sim.plan.table, sim.plan.arrays, strict=True)
    sim.plan = replace(sim.plan, arrays=tuple(change(array) if row.name == name else array for row, array in rows))


def ends_alone(array: Tensor) -> Tensor:
    """Return the array if no allocation can begin at its end."""
    if array.numel() * array.element_size() % 256 == 0:  # allocations begin at multiples of it
        raise RuntimeError("what lies behind may be another tensor; take a scene of another size")
    return array


def without_last(array: Tensor) -> Tensor:
    """Shorten part_slot, the only array whose size the ops cannot check against other numbers of the plan."""
    return ends_alone(array[:-1].clone())


def into_one_place(corners: Tensor) -> Tensor:
    """Give every corner with an entry the first one: in the upper 16 bits, 65535 without an entry."""
    return torch.where(corners >> 16 == -1, corners, corners & 65535)


def behind_list(patches: pd.FreeFormPatches) -> pd.FreeFormPatches:
    """Make the last patch's list end one entry past the array."""
    names = dict(zip(("triangles", "patch_start", "entry_quadric"), patches.lists, strict=False))
    ends_alone(names["entry_quadric"])
    names["patch_start"][-1] += 1
    return patches


def plant_in_patches(tool: str) -> None:
    """Evaluate heights in which `tool` must find an error."""
    patches = ball_of_patches().to("cuda")
    samples = samples_everywhere(patches)
    if tool == "memcheck":
        patches = behind_list(patches)
    else:
        q = patches.quadrics
        unwritten = replace(q, amplitudes=torch.empty_like(q.amplitudes))
        patches = patches.with_quadrics(unwritten, keep_lists=True)
    patches.heights(samples)


def planted_scene(kernel: str) -> pd.Scene:
    """A scene large enough that a block has several warps, which can race."""
    mesh = KERNEL_CASES[kernel][0].mesh if kernel in ("block", "far", "large") else BAR
    return scene(mesh, contacts=False, pieces=True, pins=False)


def plant_in_step(tool: str, kernel: str) -> None:
    """Run a step in which `tool` must find an error."""
    with compiled_for(kernel, KernelCase(BAR, {}) if kernel == "levels" else KERNEL_CASES[kernel][0]) as name:
        options: dict[str, Any] = {"solver": pd.Multilevel()} if kernel == "levels" else {"kernel": name}
        sim = pd.Simulator(planted_scene(kernel), 1 / 60, 5, progress=False, **options).to("cuda")
    state = sim.rest_state(2)
    if tool == "memcheck":
        change_plan(sim, "part_slot", without_last)
    elif tool == "initcheck":
        state = pd.State(state.positions, torch.empty_like(state.velocities))
    else:
        change_plan(sim, "pair_corner", into_one_place)
    sim.step_(state)


def plant(tool: str, kernel: str) -> None:
    """Make an error that `tool` must find."""
    if kernel == "patches":
        plant_in_patches(tool)
    else:
        plant_in_step(tool, kernel)
    torch.cuda.synchronize()


def why_not_plant(tool: str, kernels: Sequence[str]) -> str:
    """The reason why an error cannot be made; empty if it can."""
    if len(kernels) != 1:
        return "--plant needs one kernel: --kernel grid"
    if tool == "racecheck" and kernels[0] == "patches":
        return "the ops of free-form patches use no shared memory for racecheck to examine"
    if tool != "racecheck" and os.environ.get("PYTORCH_NO_CUDA_MEMORY_CACHING") != "1":
        return "the tool needs PYTORCH_NO_CUDA_MEMORY_CACHING=1 to see single tensors"
    return ""
