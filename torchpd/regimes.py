"""Which kernel of a GPU steps a scene, and the plan for it.

    block   one thread block an environment, all iterations in one launch: the mesh fits a block's shared memory
    grid    a block for each of some patches, all iterations in one launch: the patches fit all multiprocessors
    stream  launches for every iteration: any mesh

Up to 16 patches of a "grid" exchange through each other's shared memory where the GPU has clusters of blocks (compute
capability 9.0): a few environments of a small mesh are then done in a third of the time of "block", which is for many.

The batch does not enter: an environment gives the same bits alone and in any batch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch

from . import _C
from .device_plan import compile_device_plan
from .gpu import Properties
from .plan import KERNELS, Plan
from .scene import SceneValues
from .tables import DEVICE_PLAN_TABLE

__all__ = ["check_kernel", "choose_plan", "shared_bytes"]

_GRID_TETS = 150  # a patch at least: smaller ones cost more in exchange than they save
# of meshes that are cut in so few patches that their blocks may form a cluster (csrc/cuda/cluster.h)
_CLUSTER_TETS, _CLUSTER_EACH = 8000, 200
# with a multilevel solver: a patch a multiprocessor of at least so many, or all in one block
_LEVEL_TETS, _LEVEL_ALONE = 384, 1152
# a patch at most, six rounds of its threads, and how many share a multiprocessor of an H100 (csrc/cuda/stream.h)
_STREAM_TETS = {torch.float32: 2280, torch.float64: 960}
_STREAM_TOGETHER = {torch.float32: 2, torch.float64: 1}
_MOST_FIELDS = 2  # of a pass: the products with a second derivative


def check_kernel(kernel: str) -> str:
    """The name of a kernel, or "auto"."""
    if kernel not in ("auto", *KERNELS):
        raise ValueError(f'Simulator: kernel must be "auto", "block", "grid" or "stream", got {kernel!r}')
    return kernel


def shared_bytes(plan: Plan, planes: int, balls: int) -> int:
    """Shared memory of a block of the kernel that a plan is for."""
    real = torch.finfo(plan.dtype).bits // 8
    slots, entries = plan.size("most_slots"), plan.size("most_entries")
    if plan.for_levels:
        return _C.pass_shared_bytes(real, slots, entries, _MOST_FIELDS) + _C.outer_static_bytes
    if plan.kernel == "stream":
        return _C.pass_shared_bytes(real, slots, entries, _MOST_FIELDS) + _C.pass_static_bytes
    return _C.fused_shared_bytes(real, plan.kernel == "grid", slots, entries, planes, balls)


class _Scene(NamedTuple):
    values: SceneValues
    dtype: torch.dtype
    progress: bool

    @property
    def tets(self) -> int:
        return len(self.values.tets)

    def plan(self, kernel: str, patches: int) -> Plan:
        number = KERNELS.index(kernel)
        arrays = compile_device_plan(self.values, patches, number, self.dtype, progress=self.progress)
        return Plan(arrays, DEVICE_PLAN_TABLE)

    def shared_bytes(self, plan: Plan) -> int:
        return shared_bytes(plan, len(self.values.planes), len(self.values.spheres))

    def cluster_bytes(self, plan: Plan) -> int:
        """Of a block, where the blocks of a "grid" form a cluster."""
        real = torch.finfo(self.dtype).bits // 8
        slots, seats = plan.size("most_slots"), plan.size("most_shared")
        return _C.cluster_shared_bytes(real, self.shared_bytes(plan), slots, seats, plan.patches)

    def forms_cluster(self, plan: Plan, gpu: Properties) -> bool:
        """Whether its patches are as small as those of a cluster have to be (csrc/cuda/fused.cuh)."""
        real = torch.finfo(self.dtype).bits // 8
        small = _C.fits_cluster(real, plan.size("most_slots"), plan.size("most_pairs"))
        return small and self.cluster_bytes(plan) <= gpu.shared

    def patches(self, kernel: str, gpu: Properties) -> int:
        if kernel == "block":
            return 1
        if kernel == "cluster":
            return min(gpu.cluster, gpu.multiprocessors, max(2, self.tets // _CLUSTER_EACH), self.tets)
        if kernel == "grid":
            return min(gpu.multiprocessors, max(2, self.tets // _GRID_TETS), self.tets)
        if kernel == "levels":
            if self.tets <= _LEVEL_ALONE:
                return 1
            # 2.5 entries and at least a third of a slot a tetrahedron, see pass_shared_bytes
            each = (4 * 2.5 + 6 / 3) * torch.finfo(self.dtype).bits / 8
            least = -(-self.tets * each // (gpu.shared - _C.outer_static_bytes))
            rounds = -(-int(least) // gpu.multiprocessors)
            return min(-(-self.tets // _LEVEL_TETS), rounds * gpu.multiprocessors)
        patches = -(-self.tets // _STREAM_TETS[self.dtype])
        # what does not run at once runs in whole waves, of which the last is full too
        wave = _STREAM_TOGETHER[self.dtype] * gpu.multiprocessors
        return patches if patches <= wave else -(-patches // wave) * wave

    def least_shared_bytes(self, kernel: str, patches: int) -> int:
        """Of the kernels block and grid, without building the plan: two tetrahedra have at least five entries."""
        slots = len(self.values.rest_positions) if patches == 1 else 4
        entries = 5 * -(-self.tets // patches) // 2
        real = torch.finfo(self.dtype).bits // 8
        planes, balls = len(self.values.planes), len(self.values.spheres)
        return _C.fused_shared_bytes(real, kernel == "grid", slots, entries, planes, balls)


def _fused_plan(scene: _Scene, kernel: str, gpu: Properties) -> tuple[Plan | None, str]:
    """The plan, and the shared memory of a block; None where that is more than there is."""
    if kernel == "grid" and gpu.cluster > 1 and scene.tets <= _CLUSTER_TETS:
        plan = scene.plan("grid", scene.patches("cluster", gpu))
        if scene.forms_cluster(plan, gpu):
            return plan, f"{scene.cluster_bytes(plan):,} B"
    patches = scene.patches(kernel, gpu)
    least = scene.least_shared_bytes(kernel, patches)
    if least > gpu.shared:
        return None, f"at least {least:,} B"
    try:
        plan = scene.plan(kernel, patches)
    except ValueError as error:  # more entries or slots in a patch than 16 bits count
        return None, f"more than can be counted ({error})"
    needed = scene.shared_bytes(plan)
    return (plan if needed <= gpu.shared else None), f"{needed:,} B"


def _stream_plan(scene: _Scene, gpu: Properties) -> Plan:
    """More patches where many tetrahedra share a vertex, whose forces one patch sums."""
    return _plan_that_fits(scene, gpu, "stream", lambda patches: 2 * patches)


def _level_plan(scene: _Scene, gpu: Properties) -> Plan:
    """For a multilevel solver: as many patches for every multiprocessor, where one each is not enough."""

    def more(patches: int) -> int:
        rounds = -(-patches // gpu.multiprocessors)
        return (rounds + 1 + rounds // 4) * gpu.multiprocessors

    return _plan_that_fits(scene, gpu, "levels", more)


def _plan_that_fits(scene: _Scene, gpu: Properties, name: str, more: Callable[[int], int]) -> Plan:
    """For "stream" or "levels"; `more`: the patches to try after so many, whose slots or forces are too many."""
    patches = min(scene.patches(name, gpu), scene.tets)
    while True:
        try:
            plan = replace(scene.plan("stream", patches), for_levels=name == "levels")
        except ValueError:  # more in a patch than can be counted
            if patches == scene.tets:
                raise
        else:
            if scene.shared_bytes(plan) <= gpu.shared or patches == scene.tets:
                return plan
        patches = min(more(patches), scene.tets)


def choose_plan(
    values: SceneValues,
    dtype: torch.dtype,
    gpu: Properties,
    kernel: str = "auto",
    *,
    levels: bool = False,
    progress: bool = True,
) -> Plan:
    """The plan of a scene for a GPU, on the CPU; move it with `Plan.to`.

    Args:
        values: the flat arrays of `Scene.values`.
        dtype: torch.float32 or torch.float64.
        gpu: what the device has.
        kernel: "auto" takes the first of "block", "grid" and "stream" that fits.
        levels: for a multilevel solver, which runs as "stream" does but for its iterations.
        progress: show a bar when the mesh is large.
    """
    check_kernel(kernel)
    scene = _Scene(values, dtype, progress)
    if levels:
        if kernel not in ("auto", "stream"):
            raise ValueError(
                f'Simulator: Multilevel runs with kernel="stream" on a GPU, got kernel={kernel!r}; leave it at "auto"'
            )
        return replace(_level_plan(scene, gpu), why="what Multilevel runs with")
    needs = []
    for name in ("block", "grid"):
        if kernel not in ("auto", name):
            continue
        plan, needed = _fused_plan(scene, name, gpu)
        needs.append(f"{name} needs {needed}")
        if plan is not None:
            return replace(plan, why=_reason(kernel, needs, gpu))
        if kernel == name:
            others = '"stream", which always fits' if name == "grid" else '"grid" or "stream"'
            raise ValueError(
                f"Simulator: kernel={kernel!r} does not fit this GPU: it needs {needed} of shared memory a thread "
                f'block, and {gpu.shared:,} B are there; take {others}, or "auto", which takes the first that fits'
            )
    return replace(_stream_plan(scene, gpu), why=_reason(kernel, needs, gpu))


def _reason(kernel: str, needs: list[str], gpu: Properties) -> str:
    if kernel != "auto":
        return "asked for"
    return f"shared memory a thread block: {', '.join(needs)}, {gpu.shared:,} B are there"
