"""Which kernel a GPU gets follows from the mesh, the precision and what the device has: no GPU is needed to know."""

from __future__ import annotations

import copy
import pickle
import re
import runpy

import numpy as np
import pytest
import torch
from device_plans import box_values
from programs import ROOT

import torchpd as pd
from torchpd import _C
from torchpd.common.gpu import H100, Properties, check_free_memory, unavailable_reason
from torchpd.common.tables import DEVICE_PLAN_TABLE, DEVICE_SIZES
from torchpd.plan import KERNELS, Plan, compile_plan, kernel_costs
from torchpd.plan import kernel_choice as regimes
from torchpd.plan import placement as placing
from torchpd.plan.kernel_choice import choose_plan, max_shared_bytes, shared_bytes
from torchpd.plan.preconditioner import precondition_plan
from torchpd.scene import SceneValues

A100 = Properties(108, 166_912)
SMALL = Properties(20, 101_376)
REAL = {torch.float32: 4, torch.float64: 8}


def test_auto_takes_the_first_that_fits() -> None:
    """Just enough memory for a kernel chooses it, one byte less the next one."""
    values = box_values((6, 6, 6))
    for dtype in REAL:
        needs = {name: max_shared_bytes(choose_plan(values, dtype, H100, name), 0, 0) for name in KERNELS[:-1]}
        assert needs["grid"] < needs["cluster"] < needs["block"]
        for shared, kernel in (
            (needs["block"], "block"),
            (needs["block"] - 1, "cluster"),
            (needs["cluster"], "cluster"),
            (needs["cluster"] - 1, "grid"),
            (needs["grid"], "grid"),
            (needs["grid"] - 1, "stream"),
        ):
            plan = choose_plan(values, dtype, Properties(132, shared, 16))
            assert plan.kernel == kernel
            assert f"{shared:,} B are available" in plan.why
            assert all(f"{name} needs" in plan.why for name in KERNELS[: KERNELS.index(kernel)])


def test_auto_looks_at_clusters_of_small_meshes_where_there_are_any(monkeypatch: pytest.MonkeyPatch) -> None:
    values = box_values((6, 6, 6))
    shared = shared_bytes(choose_plan(values, torch.float32, H100, "block"), 0, 0) - 1
    for most, blocks, kernel in ((1296, 16, "cluster"), (1295, 16, "grid"), (1296, 1, "grid")):
        monkeypatch.setattr(regimes, "_CLUSTER_TETS", most)
        plan = choose_plan(values, torch.float32, Properties(132, shared, blocks))
        assert plan.kernel == kernel
        assert ("cluster needs" in plan.why) == (kernel == "cluster")
    # who asks for one gets it for any mesh that fits
    monkeypatch.setattr(regimes, "_CLUSTER_TETS", 0)
    assert choose_plan(values, torch.float32, H100, "cluster").kernel == "cluster"


def test_patches_too_large_for_a_cluster_go_to_a_grid() -> None:
    """Every vertex of a patch wants threads, and in float32 every tetrahedron one of its own."""
    large = box_values((14, 7, 7))  # 4116 tetrahedra, 960 vertices
    needs = r"cluster needs patches smaller than \d+ pairs of tetrahedra and \d+ vertices"
    for gpu, dtype in ((H100, torch.float64), (Properties(170, 101_376, 8), torch.float32)):
        plan = choose_plan(box_values((6, 4, 4)), dtype, gpu, "cluster")
        assert _C.fits_cluster(REAL[dtype], plan.size("most_pairs"), plan.size("most_interior"))
        with pytest.raises(
            ValueError, match=rf"'cluster' does not fit this GPU: .*{needs}, .*; take \"auto\", \"grid\" or \"stream"
        ):
            choose_plan(large, dtype, gpu, "cluster")
        plan = choose_plan(large, dtype, gpu)
        assert (plan.kernel, plan.patches) == ("grid", 4116 // regimes._MIN_GRID_TETS)
        assert re.search(needs, plan.why)


def test_a_mesh_that_no_cluster_could_have_is_not_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the patches, one has a sixteenth of the tetrahedra at least."""
    values = box_values((12, 12, 12))

    def fail(*_: object, **__: object) -> None:
        raise AssertionError("a plan was built")

    monkeypatch.setattr(regimes, "compile_device_plan", fail)
    for dtype in REAL:
        with pytest.raises(ValueError, match=r"cluster .*than 324 pairs .* and 138 vertices"):
            choose_plan(values, dtype, H100, "cluster")


def test_a_gpu_without_clusters_is_told() -> None:
    values = box_values((3, 3, 3))
    refusal = r'kernel="cluster" needs .*\(NVIDIA compute capability 9\.0\).*; take "auto", "block", "grid" or "stream"'
    with pytest.raises(ValueError, match=refusal):
        choose_plan(values, torch.float32, A100, "cluster")


def test_who_is_refused_hears_of_kernels_that_may_fit() -> None:
    small, large = box_values((3, 3, 3)), box_values((12, 12, 12))
    tight = H100._replace(shared=100)
    for values, gpu, others in (
        (small, tight, '"cluster", "grid" or "stream"'),
        (small, tight._replace(cluster=1), '"grid" or "stream"'),
        (large, tight, '"grid" or "stream"'),
    ):
        with pytest.raises(
            ValueError, match=f"'block' does not fit this GPU: .* are available; take \"auto\", {others}"
        ):
            choose_plan(values, torch.float32, gpu, "block")


def test_shared_memory_of_a_cluster() -> None:
    """One byte less than a patch needs is too little."""
    values = box_values((6, 6, 6), pd.Ground(), pd.Sphere((0, -3, 0), 1.0))
    for dtype, real in REAL.items():
        plan = choose_plan(values, dtype, H100, "cluster")
        needed = shared_bytes(plan, 1, 1)
        sizes = (plan.size(name) for name in ("most_slots", "most_entries", "most_interior"))
        assert needed == _C.cluster_shared_bytes(real, *sizes, 1, 1)
        assert choose_plan(values, dtype, Properties(132, needed, 16), "cluster").patches == plan.patches
        with pytest.raises(ValueError, match=rf"cluster needs {needed:,} B, {needed - 1:,} B are available; take"):
            choose_plan(values, dtype, Properties(132, needed - 1, 16), "cluster")


def test_number_of_patches() -> None:
    """As many for a grid as leave each its least number of tetrahedra, as few for a stream as leave none too many."""
    small, large = box_values((6, 6, 6)), box_values((13, 11, 10))
    for dtype in REAL:
        assert choose_plan(small, dtype, H100, "block").patches == 1
        grid, tets = choose_plan(small, dtype, H100, "grid").patches, len(small.tets)
        assert grid > 2
        assert tets / grid >= regimes._MIN_GRID_TETS > tets / (grid + 1)
        assert choose_plan(small, dtype, Properties(5, 232_448), "grid").patches == 5
        middle = box_values((9, 3, 3))
        cluster, tets = choose_plan(middle, torch.float32, H100, "cluster").patches, len(middle.tets)
        assert 2 < cluster < 16
        assert tets / cluster >= regimes._CLUSTER_EACH > tets / (cluster + 1)
        assert choose_plan(small, dtype, H100, "cluster").patches == 16
        assert choose_plan(small, dtype, H100._replace(multiprocessors=9), "cluster").patches == 9
        stream, tets = choose_plan(large, dtype, H100, "stream").patches, len(large.tets)
        assert stream > 1
        assert tets / stream <= regimes._STREAM_TETS[dtype] < tets / (stream - 1)
        # on a GPU that runs fewer at once, the last wave of patches is as full as the others
        few = Properties(1 if dtype is torch.float32 else 2, 166_912)  # two patches at once
        assert stream % 2 == 1
        assert choose_plan(large, dtype, few, "stream").patches == stream + 1
    one = pd.Scene(pd.Solid(pd.shapes.single_tet(), 1e5)).values()
    assert [choose_plan(one, torch.float32, H100, name).patches for name in KERNELS] == [1, 1, 1, 1]
    # tetrahedra that share no vertices have many of them
    corners = one.rest_positions + 2.0 * np.arange(70)[:, None, None] * [1, 0, 0]
    apart = pd.Scene(pd.Solid(pd.TetMesh(corners.reshape(-1, 3), np.arange(280).reshape(-1, 4)), 1e5)).values()
    for dtype, real in REAL.items():
        plan = choose_plan(apart, dtype, H100, "cluster")
        assert plan.patches > 2
        assert _C.fits_cluster(real, plan.size("most_pairs"), plan.size("most_interior"))


def test_patches_of_a_pipeline_are_larger() -> None:
    """Of float32, without contacts, where a block has room for two of them and every multiprocessor has one."""
    free, touching = box_values((13, 12, 11)), box_values((13, 12, 11), pd.Ground(-1.0))
    few = H100._replace(multiprocessors=1)
    small = few._replace(shared=166_912)  # compute capability 8.0

    def patches(values: SceneValues, gpu: Properties) -> int:
        return choose_plan(values, torch.float32, gpu, "stream").patches

    tets = len(free.tets)
    fewer, more = -(-tets // 2304), -(-tets // regimes._STREAM_TETS[torch.float32])
    assert fewer < more
    assert patches(free, few) == fewer
    assert {patches(free, H100), patches(free, small), patches(touching, few)} == {more}
    # as many as there are multiprocessors rather than fewer larger ones
    assert patches(free, few._replace(multiprocessors=more - 1)) == more - 1
    # their slots are what bringers hold at once (csrc/cuda/stream/pipeline.h), and two fit
    plan = choose_plan(box_values((40, 12, 12)), torch.float32, few, "stream")
    assert plan.size("most_slots") <= 640
    half = 24 * plan.size("most_slots") + 12 * plan.size("most_entries")
    assert 2 * half <= regimes._PIPELINE_BYTES


def test_a_kernel_that_does_not_fit_is_refused_with_numbers() -> None:
    values = box_values((12, 12, 12))
    with pytest.raises(
        ValueError,
        match=r"'block' does not fit this GPU: .*block needs at least [\d,]+ B, 101,376 B are available; .*grid",
    ):
        choose_plan(values, torch.float32, SMALL, "block")
    with pytest.raises(
        ValueError,
        match=r"'grid' does not fit this GPU: .*grid needs (at least )?[\d,]+ B, 5,000 B are available; .*stream",
    ):
        choose_plan(values, torch.float32, Properties(132, 5000), "grid")
    with pytest.raises(ValueError, match=r"kernel .*got 'team'"):
        choose_plan(values, torch.float32, H100, "team")


def test_shared_memory_by_hand(dtype: torch.dtype) -> None:
    """Many patches keep four numbers a slot (position) in place of eight (and u), and both 1 KB for control."""
    values, real = box_values((4, 4, 4)), torch.finfo(dtype).bits // 8
    for kernel, numbers in (("block", 8), ("grid", 4)):
        plan = choose_plan(values, dtype, H100, kernel)
        slots, entries = plan.size("most_slots"), plan.size("most_entries")
        assert shared_bytes(plan, 2, 3) == 1024 + real * (numbers * slots + 4 * entries + 5 * 2 + 8 * 3)


@pytest.mark.parametrize(
    ("kernel", "batch", "cells"),
    [("grid", None, (13, 8, 8)), ("grid", 66, (13, 8, 8)), ("cluster", None, (6, 6, 6)), ("block", 1000, (4, 4, 4))],
)
def test_the_way_back_fits_where_the_step_does(
    kernel: str, batch: int | None, cells: tuple[int, int, int], dtype: torch.dtype
) -> None:
    """Its passes keep a position and a direction of every slot, beside static memory, where a grid has a position."""
    values, real = box_values(cells), torch.finfo(dtype).bits // 8
    plan = choose_plan(values, dtype, H100, kernel, batch=batch)
    step, most = shared_bytes(plan, 0, 0), max_shared_bytes(plan, 0, 0)
    passes = -(-6 * real * plan.size("most_slots") // 16) * 16 + 4 * real * plan.size("most_entries")
    assert most == max(step, passes + _C.pass_static_bytes)
    assert (most > step) == (kernel == "grid")
    # what has room for the step alone gets another plan
    tight = H100._replace(shared=most - 1)
    assert max_shared_bytes(choose_plan(values, dtype, tight, batch=batch), 0, 0) <= tight.shared


def test_what_is_refused_unbuilt_does_not_fit_when_built() -> None:
    """The bound from the numbers of vertices and tetrahedra never exceeds what the plan then needs."""
    for cells in ((1, 1, 1), (5, 4, 3), (9, 9, 2)):
        values = box_values(cells, pd.Ground(), pd.Sphere((0, -3, 0), 1.0))
        for dtype, real in REAL.items():
            plan = choose_plan(values, dtype, Properties(2, 10**9), "block")
            least = _C.fused_shared_bytes(real, False, len(values.rest_positions), 5 * len(values.tets) // 2, 1, 1)
            assert least <= shared_bytes(plan, 1, 1)


def test_a_patch_with_a_busy_vertex_is_split_until_it_fits() -> None:
    """Hundreds of tetrahedra around one vertex want eight entries each: more patches share the sum."""
    ring = np.linspace(0.0, 2.0 * np.pi, 901)[:-1]
    around = np.stack([np.cos(ring), np.sin(ring), 0.0 * ring], axis=1)
    vertices = np.concatenate([[[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], around])
    numbers = np.arange(900)
    tets = np.stack([0 * numbers, 2 + numbers, 2 + (numbers + 1) % 900, 0 * numbers + 1], axis=1)
    values = pd.Scene(pd.Solid(pd.TetMesh(vertices, tets), 1e5)).values()
    plan = choose_plan(values, torch.float32, SMALL, "stream")
    assert plan.patches > 1
    assert shared_bytes(plan, 0, 0) <= SMALL.shared


def test_a_patch_with_more_slots_than_can_be_counted_is_split(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(regimes._STREAM_TETS, torch.float32, 2304)
    count = 2200
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    vertices = (corners + 2.0 * np.arange(count)[:, None, None] * [1, 0, 0]).reshape(-1, 3)
    mesh = pd.TetMesh(vertices, np.arange(4 * count).reshape(-1, 4))
    values = pd.Scene(pd.Solid(mesh, youngs=1e5)).values()
    assert choose_plan(values, torch.float32, Properties(132, 10**9), "stream").patches == 2
    assert choose_plan(values, torch.float32, Properties(1, 10**9), levels=True).patches > 1


@pytest.mark.parametrize("gpu", [Properties(1, 232_448), Properties(20, 101_376)])
def test_patches_of_a_multilevel_solver_fit(gpu: Properties, dtype: torch.dtype) -> None:
    """As many for every multiprocessor as fit, also where 16 bits would not count the entries of fewer."""
    values = box_values((54, 11, 11))  # 39 204 tetrahedra
    plan = choose_plan(values, dtype, gpu, levels=True, progress=False)
    assert plan.for_multilevel
    assert plan.kernel == "stream"
    assert plan.patches % gpu.multiprocessors == 0
    assert shared_bytes(plan, 0, 0) <= gpu.shared
    # not many more than it takes
    assert shared_bytes(plan, 0, 0) >= 0.3 * gpu.shared
    assert choose_plan(box_values((3, 3, 3)), dtype, gpu, levels=True).patches == 1
    with pytest.raises(ValueError, match=r"kernel .*got 'block'"):
        choose_plan(values, dtype, gpu, "block", levels=True)


@pytest.mark.parametrize("gpu", [Properties(8, 232_448), Properties(20, 101_376), H100])
def test_many_environments_of_a_multilevel_solver_get_larger_patches(gpu: Properties, dtype: torch.dtype) -> None:
    values = box_values((9, 9, 9))  # 3 645 or more tetrahedra
    least = -(-gpu.multiprocessors // 4)
    few, many = (choose_plan(values, dtype, gpu, levels=True, batch=batch) for batch in (least - 1, least))
    assert (few.many, many.many) == (False, True)
    assert many.for_multilevel
    assert shared_bytes(many, 0, 0) <= gpu.shared
    if gpu == H100 and dtype == torch.float32:
        assert (few.patches, many.patches) == (12, 3)


def test_blocks_of_a_multilevel_solver_share_a_small_mesh_where_environments_are_few(dtype: torch.dtype) -> None:
    """Which is done sooner; in large batches, and where nobody knows, one block does it."""
    values = box_values((5, 5, 5))  # 625 or more tetrahedra
    assert [choose_plan(values, dtype, H100, levels=True, batch=b).patches for b in (None, 1, 32, 33)] == [1, 2, 2, 1]
    assert choose_plan(box_values((3, 3, 3)), dtype, H100, levels=True, batch=1).patches == 1


def test_many_environments_of_several_patches_get_levels() -> None:
    """A direct solve reads more, but has fewer phases: it serves all others of up to 1024 vertices."""

    def is_direct(cells: int, batch: int | None) -> bool:
        values = box_values((cells, cells, cells))
        plan = choose_plan(values, torch.float32, H100, levels=True, batch=batch)
        inertia = torch.ones(plan.vertices, dtype=torch.float64)
        made = precondition_plan(plan, values, torch.full((len(values.tets),), 1e5, dtype=torch.float64), inertia)
        return bool(made.level_sizes[6])

    assert [is_direct(7, batch) for batch in (None, 1, 1024)] == [True, True, False]
    assert is_direct(4, 1024)


@pytest.mark.parametrize(("source", "dtype"), [("float", torch.float32), ("double", torch.float64)])
def test_registers_of_clusters_are_those_of_the_table(source: str, dtype: torch.dtype) -> None:
    """Of sm_90, the first that has clusters; a multiprocessor hands them out in eights."""
    tool = runpy.run_path(str(ROOT / "tools" / "cuda_check.py"))
    _, rows = tool["read_table"](ROOT / "benchmarks" / "results" / "cuda-registers.csv")
    used = [
        int(row["registers"])
        for row in rows
        if row["source"] == f"cuda-fused-fused_{source}.cu"
        and row["architecture"] == "90"
        and "Blocks)1," in row["kernel"]
    ]
    assert -(-max(used) // 8) * 8 == kernel_costs._CLUSTER_REGISTERS[dtype]


@pytest.mark.parametrize("architecture", ["90", "100"])
def test_shared_vertices_have_room_beside_the_pipeline(architecture: str) -> None:
    """Of the registers of a multiprocessor: else their kernel would come after it, and nothing but time would tell."""
    tool = runpy.run_path(str(ROOT / "tools" / "cuda_check.py"))
    _, rows = tool["read_table"](ROOT / "benchmarks" / "results" / "cuda-registers.csv")
    used = {
        row["kernel"]: -(-int(row["registers"]) // 8) * 8
        for row in rows
        if row["source"] == "cuda-stream-stream_float.cu" and row["architecture"] == architecture
    }
    pipelines = [registers for kernel, registers in used.items() if "stream_pipeline" in kernel]
    beside = [registers for kernel, registers in used.items() if "stream_shared" in kernel and "float, false" in kernel]
    assert len(pipelines) == 2
    assert len(beside) == 4  # one for each Visit
    assert 640 * max(pipelines) + 128 * max(beside) <= 65536


def test_contacts_take_shared_memory() -> None:
    values = box_values((3, 3, 3))
    plan = choose_plan(values, torch.float32, H100, "block")
    assert shared_bytes(plan, 2, 3) - shared_bytes(plan, 0, 0) == 4 * (2 * 5 + 3 * 8)


@pytest.mark.parametrize("kernel", KERNELS)
def test_one_class_for_both_plans(kernel: str, dtype: torch.dtype) -> None:
    values = box_values((4, 3, 3))
    plan, cpu = choose_plan(values, dtype, H100, kernel), compile_plan(values, dtype=dtype)
    assert (plan.kernel, cpu.kernel) == (kernel, None)
    assert plan.vertices == cpu.vertices == len(values.rest_positions)
    assert plan.dtype == dtype
    assert plan.to(dtype=dtype).dtype == dtype
    other = torch.float64 if dtype == torch.float32 else torch.float32
    with pytest.raises(ValueError, match=rf"Plan.to: dtype .*{dtype} .*got {other}"):
        plan.to(dtype=other)
    assert plan.bytes == sum(array.numel() * array.element_size() for array in plan.arrays)
    assert len(DEVICE_SIZES) == len(plan.sizes)
    assert (plan.size("tets"), plan.size("patches")) == (len(values.tets), plan.patches)
    for row, array in zip(DEVICE_PLAN_TABLE, plan.arrays, strict=True):
        assert getattr(plan, row.name) is array
    with pytest.raises(AttributeError, match="Plan has no array 'tet_rest'; it has sizes, vertex_order"):
        plan.tet_rest  # noqa: B018
    there = plan.to("meta")
    assert (there.device.type, there.sizes.device.type, there.kernel) == ("meta", "cpu", kernel)
    for twin in (copy.deepcopy(plan), pickle.loads(pickle.dumps(plan))):
        assert isinstance(twin, Plan)
        assert (twin.kernel, twin.why, twin.patches) == (plan.kernel, plan.why, plan.patches)
        assert all(torch.equal(one, other) for one, other in zip(twin.arrays, plan.arrays, strict=True))


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ((False, None, 0), ("CPU build", "install a torch for CUDA", "python -m torchpd doctor")),
        ((False, "13.0", 1), ("no CUDA kernels", "CUDA 13.0 toolkit", "build torchpd again", "doctor")),
        ((True, "13.0", 0), ("no CUDA device", "nvidia-smi", "CUDA_VISIBLE_DEVICES", "doctor")),
        ((True, "13.0", 1, (7, 5)), ("capability 7.5", "need 8.0", "CPU")),
    ],
)
def test_why_a_gpu_cannot_be_used(
    facts: tuple[bool, str | None, int] | tuple[bool, str | None, int, tuple[int, int]], words: tuple[str, ...]
) -> None:
    for word in words:
        assert word in unavailable_reason(*facts), word


def test_a_gpu_that_can_be_used() -> None:
    assert (
        unavailable_reason(True, "13.0", 1)
        == unavailable_reason(True, "13.0", 2, (8, 0))
        == unavailable_reason(True, "13.0", 1, (12, 0))
        == ""
    )


def test_too_little_memory_is_a_sentence() -> None:
    check_free_memory(1000, 1000)
    with pytest.raises(RuntimeError, match=r"step need 1,001 B .*the GPU and 1,000 B are free"):
        check_free_memory(1001, 1000)


def test_plans_are_moved_between_alike_devices_only(monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = {0: H100, 1: H100, 2: SMALL}
    monkeypatch.setattr(placing, "properties_of", lambda device: kinds[device.index])
    first, second, other = (torch.device("cuda", number) for number in kinds)
    cpu, meta = torch.device("cpu"), torch.device("meta")
    same = placing._same_plan
    assert same(first, second)
    assert same(other, other)
    assert same(first, meta)
    assert same(cpu, cpu)
    for source, target in ((first, other), (cpu, first), (first, cpu), (meta, cpu), (meta, first)):
        assert not same(source, target)
