"""Choice of the GPU kernel of a scene, and the plan for it.

    block    one thread block per environment, or several small environments per block. All iterations run in one
             launch; the mesh fits the shared memory of a block.
    cluster  up to 16 blocks that access each other's shared memory (compute capability 9.0), one patch each. All
             iterations run in one launch; for small meshes.
    grid     one block per patch. All iterations run in one launch; the patches fit the multiprocessors.
    stream   launches for every iteration; for any mesh.

With a known number of environments (`Simulator(batch=...)`), `kernel_costs` chooses among the kernels that fit. The
estimate favours a cluster for few environments of a small mesh and "stream" for many of a large one. Between them it
favours a grid, with fewer and larger patches the more environments run at a time. "benchmark" times every kernel that
fits.

A cluster assigns every vertex to one patch. A patch holds every tetrahedron that touches one of its own vertices, so
tetrahedra at patch borders are computed more than once. Patches exchange no forces. Once an iteration the new position
of a vertex is written to the shared memory of the patches that hold a copy. The patches of the other kernels share no
tetrahedra and exchange the forces on shared vertices.

A group of tetrahedra that averages its volume strain lies in one patch. The patches of a cluster would cut it, so
solids with Poisson's ratio run as "block", "grid" or "stream".

Scenes with stencils (cloth, rods, springs, ties, fibres, limits, damping) run as "block" where the mesh fits the shared
memory of a block, else as "stream". Scenes with `Contact` run as "stream".

The batch of a state has no influence: an environment gives the same bits alone and in any batch.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from .. import _C
from ..common.gpu import Properties
from ..common.tables import DEVICE_SIZES
from ..scene.scene import SceneValues
from .cpu_plan import KERNELS, Plan, quoted_choices
from .gpu_plan import compile_device_plan, device_table
from .kernel_costs import iteration_microseconds, kernel_microseconds

__all__ = ["OTHER_BODIES", "check_kernel", "choose_plan", "shared_bytes"]

_MIN_GRID_TETS = 150  # least per patch: smaller patches cost more in exchange than they save
# "auto" tries clusters for meshes of up to 8000 tetrahedra, with one patch per 75 while there are blocks
_CLUSTER_TETS, _CLUSTER_EACH = 8000, 75
# largest share of the vertices that a block of a cluster has threads for, while there are more blocks
_CLUSTER_OWN = 0.7
# multilevel solver: environments are many if each has at most this number of multiprocessors
_MANY_SHARE = 4
# Multilevel solver: least tetrahedra per patch; largest mesh in one block, in general and for few environments; and
# tetrahedra per patch for many environments. These run faster with fewer patches.
_MIN_LEVEL_TETS, _MAX_BLOCK_TETS, _MAX_BLOCK_TETS_FEW, _MANY_TETS = 384, 1152, 384, 1900
_LEVELS = ("few", "any", "many")  # by the number of environments
# Most tetrahedra per patch, five rounds of its threads when all are paired; and patches per multiprocessor of an H100
# (csrc/cuda/stream/kernels.h).
_STREAM_TETS = {torch.float32: 1920, torch.float64: 960}
_STREAM_CONCURRENT = {torch.float32: 2, torch.float64: 1}
# A pipeline takes patches larger by this factor: a multiprocessor computes one and holds two, if its shared memory
# suffices and each has a patch. Its threads keep the slots in registers (csrc/cuda/stream/pipeline.h).
_PIPELINE_GROWTH, _PIPELINE_BYTES = 1.2, 200_000
_TET_ENTRIES = 2.5  # entries of a tetrahedron in shared memory: five of a pair
_ROW_SHARE = 0.25  # of the corners of quadratic stencils that count as entries when a stream is cut into patches
_STENCIL_KERNELS = ("block", "stream")
# what has stencils, for errors
OTHER_BODIES = "cloth, rods, springs, ties, fibres, strain limits, the volume law or stiffness-proportional damping"
_MAX_PASS_FIELDS = 2  # most fields of one pass: the products with a second derivative


def check_kernel(kernel: str) -> str:
    """Return a kernel name after checking it: "auto", "benchmark" or one of KERNELS."""
    names = ("auto", "benchmark", *KERNELS)
    if kernel not in names:
        raise ValueError(f"Simulator: kernel must be {quoted_choices(names)}, got {kernel!r}")
    return kernel


def shared_bytes(plan: Plan, planes: int, spheres: int) -> int:
    """Shared memory [bytes] per block of the kernel that a plan is for."""
    real = torch.finfo(plan.dtype).bits // 8
    slots, entries = plan.size("most_slots"), plan.step_entries
    if plan.for_multilevel:
        return _C.outer_shared_bytes(real, slots, entries)
    if plan.kernel == "stream":
        return _pass_bytes(plan)
    if plan.kernel == "cluster":
        return _C.cluster_shared_bytes(real, slots, entries, plan.size("most_interior"), planes, spheres)
    return _C.fused_shared_bytes(real, plan.kernel == "grid", slots, entries, planes, spheres)


def max_shared_bytes(plan: Plan, planes: int, spheres: int) -> int:
    """Most shared memory [bytes] of a step and of its backward pass, which visits all patches."""
    return max(shared_bytes(plan, planes, spheres), _pass_bytes(plan))


def _pass_bytes(plan: Plan) -> int:
    real = torch.finfo(plan.dtype).bits // 8
    bytes_of_pass = _C.pass_shared_bytes(real, plan.size("most_slots"), plan.size("most_entries"), _MAX_PASS_FIELDS)
    return bytes_of_pass + _C.pass_static_bytes


class _PlanBuilder(NamedTuple):
    values: SceneValues
    dtype: torch.dtype
    progress: bool

    @property
    def tets(self) -> int:
        return len(self.values.tets)

    @property
    def solids(self) -> int:
        """Tetrahedra, or the groups of them that average their volume strain, which no patch cuts."""
        group = self.values.tet_group
        if group is None:
            return self.tets
        return len(np.unique(group[group >= 0])) + int((group < 0).sum())

    @property
    def elements(self) -> int:
        """What patches may be cut into: solids and stencils."""
        return self.solids + sum(len(group) for group in self.values.stencils)

    @property
    def stencil_corners(self) -> int:
        """Corners of all stencils, each with an entry in shared memory but for those of quadratic ones in a step."""
        return sum(group.corners.size for group in self.values.stencils)

    @property
    def row_corners(self) -> int:
        """Those of quadratic stencils."""
        return sum(group.corners.size for group in self.values.stencils if group.is_quadratic)

    @property
    def vertices(self) -> int:
        return len(self.values.rest_positions)

    @property
    def real(self) -> int:
        """Bytes of a real number."""
        return torch.finfo(self.dtype).bits // 8

    def plan(self, kernel: str, patches: int) -> Plan:
        number = KERNELS.index(kernel)
        arrays = compile_device_plan(self.values, patches, number, self.dtype, progress=self.progress)
        return Plan(arrays, device_table(self.values), loose=self.values.loose)

    def shared_bytes(self, plan: Plan) -> int:
        return max_shared_bytes(plan, len(self.values.planes), len(self.values.spheres))

    def patches(self, kernel: str, gpu: Properties) -> int:
        """Number of patches for a kernel, or for a multilevel solver with "few", "many" or "any" environments."""
        if kernel == "block":
            return 1
        if kernel == "cluster":
            wanted = max(
                2, self.tets // _CLUSTER_EACH, math.ceil(self.vertices / (_CLUSTER_OWN * self.max_owned_vertices()))
            )
            return min(gpu.cluster, gpu.multiprocessors, wanted, self.vertices, self.tets)
        if kernel == "grid":
            return self.max_grid_patches(gpu)
        if kernel in _LEVELS:
            if self.tets <= (_MAX_BLOCK_TETS_FEW if kernel == "few" else _MAX_BLOCK_TETS):
                return 1
            # estimate: 2.5 entries and a third of a slot per tetrahedron, see pass_shared_bytes
            each = (4 * 2.5 + 6 / 3) * self.real
            least = -(-self.tets * each // (gpu.shared - _C.outer_static_bytes - _C.pieces_bytes))
            if kernel == "many":
                return max(2, int(least), -(-self.tets // _MANY_TETS))
            rounds = -(-int(least) // gpu.multiprocessors)
            return min(-(-self.tets // _MIN_LEVEL_TETS), rounds * gpu.multiprocessors)
        # as many entries per patch as tetrahedra would have; of quadratic stencils a share, since only fields have them
        entries = self.stencil_corners - (1.0 - _ROW_SHARE) * self.row_corners
        tets = self.tets + math.ceil(entries / _TET_ENTRIES)
        patches = -(-tets // _STREAM_TETS[self.dtype])
        # patches that do not run at once run in whole waves, of which the last is full too
        wave = _STREAM_CONCURRENT[self.dtype] * gpu.multiprocessors
        if self.uses_pipeline(gpu) and patches > gpu.multiprocessors:
            wave = gpu.multiprocessors
            patches = max(wave, math.ceil(tets / (_PIPELINE_GROWTH * _STREAM_TETS[self.dtype])))
        if self.row_corners > 0 and gpu.multiprocessors < patches < wave:
            return wave  # the patches of rows are large, so that idle places would show
        return patches if patches <= wave else -(-patches // wave) * wave

    def uses_pipeline(self, gpu: Properties) -> bool:
        """Whether "stream" runs as a pipeline: float32, Poisson's ratio 0, no contacts, enough shared memory."""
        others = len(self.values.planes) + len(self.values.spheres) + len(self.values.stencils) > 0
        others = others or self.values.poisson is not None
        return self.dtype == torch.float32 and not others and gpu.shared >= _PIPELINE_BYTES

    def max_grid_patches(self, gpu: Properties) -> int:
        """Most patches of a grid that leave each one its least number of tetrahedra."""
        return min(gpu.multiprocessors, max(2, self.tets // _MIN_GRID_TETS), self.solids)

    def ranked_grids(self, batch: int, gpu: Properties) -> list[tuple[float, int]]:
        """Estimated microseconds per iteration for each useful number of patches, in ascending order of time.

        For one, two, three... environments at a time, the largest number of patches is listed.
        """
        most = self.max_grid_patches(gpu)
        counts = {min(most, gpu.multiprocessors // together) for together in range(1, gpu.multiprocessors // 2 + 1)}
        timed = [(self.microseconds("grid", count, batch, gpu), count) for count in counts or {most}]
        return sorted(timed, key=lambda candidate: (candidate[0], -candidate[1]))

    def microseconds(self, kernel: str, patches: int, batch: int, gpu: Properties) -> float:
        return kernel_microseconds(kernel, patches, self.tets, batch, self.dtype, gpu)

    def max_owned_vertices(self) -> int:
        """Most vertices that a block of a cluster has threads for."""
        return next(count - 1 for count in itertools.count(1) if not _C.fits_cluster(self.real, 1, count))

    def is_candidate(self, kernel: str, gpu: Properties) -> bool:
        """Whether "auto" considers a kernel."""
        if kernel == "cluster" and self.values.poisson is not None:
            return False  # patches of a cluster would cut the groups that average their volume strain
        return kernel != "cluster" or (gpu.cluster > 1 and self.tets <= _CLUSTER_TETS)

    def refuse_size(self, kernel: str, patches: int, gpu: Properties) -> str:
        """Reason why a kernel cannot fit, found before the plan is built; empty if it may fit."""
        tets = -(-self.tets // patches)  # least tetrahedra of the largest patch; a cluster adds copies
        if kernel == "cluster":
            return self.refuse_patch(-(-tets // 2), -(-self.vertices // patches))
        slots = self.vertices if patches == 1 else 4
        planes, spheres = len(self.values.planes), len(self.values.spheres)
        # two tetrahedra have at least five entries
        entries = 5 * tets // 2 + (self.stencil_corners - self.row_corners) // patches
        least = _C.fused_shared_bytes(self.real, kernel == "grid", slots, entries, planes, spheres)
        return f"at least {least:,} B" if least > gpu.shared else ""

    def refuse_patch(self, pairs: int, interior: int) -> str:
        """Reason why a patch of a cluster exceeds the threads of a block; empty if it fits."""
        if _C.fits_cluster(self.real, pairs, interior):
            return ""
        return f"patches smaller than {pairs} pairs of tetrahedra and {interior} vertices"


def _fused_plan(
    scene: _PlanBuilder, kernel: str, gpu: Properties, batch: int | None = None, patches: int | None = None
) -> tuple[Plan | None, str]:
    """The plan, None if it does not fit, and the shared memory that it needs, in words."""
    patches = scene.patches(kernel, gpu) if patches is None else patches
    refusal = scene.refuse_size(kernel, patches, gpu)
    if refusal:
        return None, refusal
    try:
        plan = scene.plan(kernel, patches)
    except ValueError as error:  # more entries or slots in a patch than 16 bits count
        return None, f"more than can be counted ({error})"
    if kernel == "cluster":
        refusal = scene.refuse_patch(plan.size("most_pairs"), plan.size("most_interior"))
        if refusal:
            return None, refusal
    if kernel == "block" and batch is not None:
        each = -(-batch // gpu.multiprocessors)
        plan.sizes[DEVICE_SIZES.index("environments")] = min(each, _C.most_environments)
    needed = scene.shared_bytes(plan)
    return (plan if needed <= gpu.shared else None), f"{needed:,} B"


def _grid_plan(scene: _PlanBuilder, gpu: Properties, batch: int | None) -> tuple[Plan | None, str]:
    """As `_fused_plan` for a grid, with the fastest number of patches that fits."""
    if batch is None:
        return _fused_plan(scene, "grid", gpu)
    plan, needed, too_few = None, "", 0
    for _, patches in scene.ranked_grids(batch, gpu):
        if patches <= too_few:
            continue
        plan, needed = _fused_plan(scene, "grid", gpu, patches=patches)
        if plan is not None:
            break
        too_few = patches
    return plan, needed


def _plans_that_fit(scene: _PlanBuilder, gpu: Properties, batch: int) -> Iterator[Plan]:
    """Plans of the kernels that fit, in ascending order of their estimated time."""
    cluster = _fused_plan(scene, "cluster", gpu)[0] if scene.is_candidate("cluster", gpu) else None
    candidates = [
        (scene.microseconds("block", 1, batch, gpu), "block", 1),
        *((time, "grid", patches) for time, patches in scene.ranked_grids(batch, gpu)),
        (scene.microseconds("stream", 0, batch, gpu), "stream", 0),
    ]
    if cluster is not None:
        candidates.append((iteration_microseconds(cluster, scene.tets, batch, gpu), "cluster", cluster.patches))
    done, too_few = set(), 0  # kernels; patches of a grid
    for _, kernel, patches in sorted(candidates, key=lambda candidate: candidate[0]):
        if kernel in done or (kernel == "grid" and patches <= too_few):
            continue
        if kernel == "stream":
            plan: Plan | None = _stream_plan(scene, gpu)
        else:
            plan = cluster if kernel == "cluster" else _fused_plan(scene, kernel, gpu, batch, patches)[0]
        if plan is not None:
            done.add(kernel)
            count = f"{batch} environment" + "s" * (batch != 1)
            yield replace(plan, why=f"the fastest kernel by estimate for {count}")
        elif kernel == "grid":
            too_few = patches


def _stream_plan(scene: _PlanBuilder, gpu: Properties) -> Plan:
    """Plan for "stream"; the number of patches doubles until the slots of each fit."""
    return _plan_that_fits(scene, gpu, "stream", lambda patches: 2 * patches)


def _level_plan(scene: _PlanBuilder, gpu: Properties, name: str) -> Plan:
    """Plan for a multilevel solver; the number of patches stays a multiple of the multiprocessors."""

    def more(patches: int) -> int:
        if name == "many":
            return patches + 1 + patches // 4
        rounds = -(-patches // gpu.multiprocessors)
        return (rounds + 1 + rounds // 4) * gpu.multiprocessors

    plan = _plan_that_fits(scene, gpu, name, more)
    return replace(plan, many=name == "many", why="the kernel of Multilevel")


def _plan_that_fits(scene: _PlanBuilder, gpu: Properties, name: str, more: Callable[[int], int]) -> Plan:
    """Plan for "stream" or a multilevel solver; `more` gives the next number of patches to try."""
    patches = min(scene.patches(name, gpu), scene.elements)
    while True:
        try:
            plan = replace(scene.plan("stream", patches), for_multilevel=name != "stream")
        except ValueError:  # more entries in a patch than 16 bits count
            if patches == scene.elements:
                raise
        else:
            if scene.shared_bytes(plan) <= gpu.shared or patches == scene.elements:
                return plan
        patches = min(more(patches), scene.elements)


def _check_stencils(values: SceneValues, kernel: str, levels: bool) -> None:
    """Refuse what scenes with stencils cannot have on a GPU."""
    if not values.stencils:
        return
    if levels:
        raise ValueError(
            f"Simulator: solver must be Chebyshev() or Jacobi() for a scene with {OTHER_BODIES} on a GPU, got "
            "Multilevel; it runs there for solids alone"
        )
    known = ("auto", "benchmark", *_STENCIL_KERNELS)
    if kernel not in known:
        raise ValueError(
            f"Simulator: kernel must be {quoted_choices(known)} for a scene with {OTHER_BODIES}, got {kernel!r}; "
            'leave it at "auto"'
        )


def _mixed_plans(scene: _PlanBuilder, gpu: Properties, batch: int | None) -> Iterator[Plan]:
    """Plans that fit a scene with stencils, in the order of preference."""
    plan, needed = _fused_plan(scene, "block", gpu, batch)
    why = _requirements([f"block needs {needed}"], gpu)
    if plan is not None:
        yield replace(plan, why=why)
    yield replace(_stream_plan(scene, gpu), why=why)


def choose_plan(
    values: SceneValues,
    dtype: torch.dtype,
    gpu: Properties,
    kernel: str = "auto",
    *,
    levels: bool = False,
    batch: int | None = None,
    progress: bool = True,
    fastest: Callable[[Iterator[Plan]], Plan] = next,
) -> Plan:
    """Compile the plan of a scene for a GPU. The result is on the CPU; `Plan.to` moves it.

    Args:
        values: the flat arrays of `Scene.values`.
        dtype: torch.float32 or torch.float64.
        gpu: properties of the device.
        kernel: a name, "benchmark" (`fastest` chooses) or "auto". "auto" takes the fastest by `kernel_costs` for a
            known batch, else the first of "block", "cluster", "grid", "stream" that fits. It uses a cluster only for
            a small mesh.
        levels: for a multilevel solver, which runs as "stream" except for its iterations.
        batch: number of environments of a step; None: unknown, treated as between few and many.
        progress: show a bar when the mesh is large.
        fastest: for "benchmark": chooses among a plan for every kernel that fits, see `kernel_benchmark`.
    """
    check_kernel(kernel)
    _check_stencils(values, kernel, levels)
    if values.contact is not None:
        if kernel not in ("auto", "benchmark", "stream"):
            raise ValueError(
                f'Simulator: kernel must be "stream" in a scene with Contact on a GPU, got {kernel!r}; leave it at '
                '"auto"'
            )
        kernel = "stream"
    scene = _PlanBuilder(values, dtype, progress)
    size = "any" if batch is None else "many" if _MANY_SHARE * batch >= gpu.multiprocessors else "few"
    if levels:
        if kernel not in ("auto", "benchmark", "stream"):
            raise ValueError(
                f'Simulator: kernel must be "stream" for Multilevel on a GPU, got {kernel!r}; leave it at "auto"'
            )
        return _level_plan(scene, gpu, size)
    if kernel == "cluster" and gpu.cluster == 1:
        raise ValueError(
            'Simulator: kernel="cluster" needs thread block clusters (NVIDIA compute capability 9.0), and this GPU has '
            'none; take "auto", "block", "grid" or "stream"'
        )
    if kernel == "cluster" and values.poisson is not None:
        raise ValueError(
            'Simulator: kernel must not be "cluster" for a Solid with Poisson\'s ratio, whose groups its patches would '
            'cut; take "auto", "block", "grid" or "stream"'
        )
    if values.stencils and kernel in ("auto", "benchmark"):
        plans = _mixed_plans(scene, gpu, batch)
        return next(plans) if kernel == "auto" else fastest(plans)
    if kernel == "benchmark":
        return fastest(_plans_that_fit(scene, gpu, 1 if batch is None else batch))
    if kernel == "auto" and batch is not None:
        return next(_plans_that_fit(scene, gpu, batch))
    requirements = []
    for name in ("block", "cluster", "grid"):
        if kernel != name and not (kernel == "auto" and scene.is_candidate(name, gpu)):
            continue
        plan, needed = _grid_plan(scene, gpu, batch) if name == "grid" else _fused_plan(scene, name, gpu, batch)
        requirements.append(f"{name} needs {needed}")
        if plan is not None:
            return replace(plan, why=_choice_reason(kernel, requirements, gpu))
        if kernel == name:
            # later kernels need less
            known = _STENCIL_KERNELS if values.stencils else KERNELS
            others = [other for other in known[known.index(name) + 1 :] if scene.is_candidate(other, gpu)]
            raise ValueError(
                f"Simulator: kernel={kernel!r} does not fit this GPU: {_requirements(requirements, gpu)}; "
                f"take {quoted_choices(('auto', *others))}"
            )
    return replace(_stream_plan(scene, gpu), why=_choice_reason(kernel, requirements, gpu))


def _choice_reason(kernel: str, requirements: list[str], gpu: Properties) -> str:
    return "asked for" if kernel != "auto" else _requirements(requirements, gpu)


def _requirements(requirements: list[str], gpu: Properties) -> str:
    return f"shared memory per thread block: {', '.join(requirements)}, {gpu.shared:,} B are available"
