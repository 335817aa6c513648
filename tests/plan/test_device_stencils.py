"""Stencils in the plans of the GPU kernels block and stream: corners, entries, padding, vectors and sizes."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from cases import Case
from device_plans import BLOCK, CLUSTER, GRID, LANES, NONE, SIZES, STREAM, Arrays, Lanes, rows_of, slices_of
from mixed_scenes import CASES, mixed_case, sheet_case
from numpy.typing import NDArray

from torchpd.common.gpu import Properties
from torchpd.common.tables import DEVICE_PLAN_TABLE, DEVICE_STENCIL_TABLE, KINDS, MULTILEVEL_TABLE
from torchpd.plan.gpu_plan import compile_device_plan, device_table
from torchpd.plan.kernel_choice import choose_plan, shared_bytes
from torchpd.plan.preconditioner import has_preconditioner
from torchpd.scene.stencils import StencilGroup

PLANS = [(BLOCK, 1), (STREAM, 1), (STREAM, 7)]
COUNTS = 4  # of StencilSize, before those of the kinds
H100 = Properties(multiprocessors=132, shared=232_448, cluster=16)


def arrays_of(case: Case, patches: int, kernel: int, dtype: torch.dtype = torch.float64) -> Arrays:
    values = case.scene.values()
    tensors = compile_device_plan(values, patches, kernel, dtype)
    return Arrays(**{row.name: t.numpy() for row, t in zip(device_table(values), tensors, strict=True)})


class Stencils:
    """Stencils of one kind lane by lane, padding included."""

    def __init__(self, plan: Arrays, kind: str, group: StencilGroup) -> None:
        blocks = np.flatnonzero(plan.stencil_block[:, 0] == list(KINDS).index(kind))
        corners, stored = group.corners.shape[1], self.numbers(group) + group.constants.shape[1]
        self.patch = np.repeat(np.searchsorted(plan.patch_stencil, blocks, side="right") - 1, LANES)
        self.order = plan.stencil_order[blocks].reshape(-1)
        self.row = plan.stencil_row[blocks].reshape(-1)
        self.measure = plan.stencil_measure[blocks].reshape(-1)
        self.bound = plan.stencil_bound[blocks].reshape(-1)

        def lanes(array: NDArray[np.generic], first: NDArray[np.int32], rows: int) -> NDArray[np.generic]:
            return array[first[:, None] + np.arange(rows)].transpose(0, 2, 1).reshape(-1, rows)

        packed = lanes(plan.stencil_corner.view(np.uint32), plan.stencil_block[blocks, 1], corners)
        self.slot, self.entry = (packed & 65535).astype(np.int64) // 8, (packed >> 16).astype(np.int64)
        self.stored = lanes(plan.stencil_stored, plan.stencil_block[blocks, 2], stored)
        self.vertex = plan.vertex_order[plan.slot_vertex[plan.patch_slot[self.patch][:, None] + self.slot]]
        self.live = self.measure != 0.0

    @staticmethod
    def numbers(group: StencilGroup) -> int:
        n, d = group.gradients.shape[1:]
        return d * (n - d) + d * (d - 1) // 2

    def gradients(self, group: StencilGroup) -> NDArray[np.float64]:
        """The vectors g_a of the stored numbers: column j of F needs the first n - d + j edges."""
        n, d = group.gradients.shape[1:]
        found, at = np.zeros((len(self.stored), n, d)), 0
        for j in range(d):
            for a in range(n - d + j):
                found[:, a + 1, j] = self.stored[:, at]
                at += 1
        found[:, 0] = -found[:, 1:].sum(axis=1)
        return found


@pytest.fixture(scope="module", params=itertools.product(CASES, PLANS), ids=lambda p: f"{p[0]}, {p[1]}")
def built(request: pytest.FixtureRequest) -> tuple[Case, Arrays]:
    name, (kernel, patches) = request.param
    case = CASES[name]()
    return case, arrays_of(case, patches, kernel)


def test_every_stencil_is_there_once_with_its_corners(built: tuple[Case, Arrays]) -> None:
    case, plan = built
    for group in case.scene.values().stencils:
        lanes = Stencils(plan, group.kind, group)
        assert sorted(lanes.order[lanes.live]) == list(range(len(group)))
        assert (lanes.vertex[lanes.live] == group.corners[lanes.order[lanes.live]]).all()
        np.testing.assert_array_equal(lanes.measure[lanes.live], group.measure[lanes.order[lanes.live]])
        assert plan.stencil_sizes[COUNTS + list(KINDS).index(group.kind)] == len(group)
        # padding repeats a stencil of its block, without measure or entries
        assert (lanes.entry[~lanes.live] == NONE).all()
        assert (lanes.vertex == group.corners[lanes.order]).all()
        rows = np.arange(len(group)) if group.tets is None else group.tets
        np.testing.assert_array_equal(lanes.row, rows[lanes.order])


def test_stored_numbers_are_the_vectors_but_for_a_turn(built: tuple[Case, Arrays]) -> None:
    case, plan = built
    for group in case.scene.values().stencils:
        lanes = Stencils(plan, group.kind, group)
        found, given = lanes.gradients(group), group.gradients[lanes.order]
        products = np.einsum("nad,nbd->nab", given, given)
        size = np.abs(products).max(axis=(1, 2), keepdims=True)
        np.testing.assert_array_less(
            np.abs(np.einsum("nad,nbd->nab", found, found) - products) / size, 64 * np.finfo(np.float64).eps
        )
        np.testing.assert_array_equal(lanes.stored[:, lanes.numbers(group) :], group.constants[lanes.order])


def test_every_entry_has_one_writer_and_every_corner_one_entry(built: tuple[Case, Arrays]) -> None:
    """Sums of entries are those of all corners of pairs and stencils at a vertex."""
    case, plan = built
    writers: list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]] = []
    if len(plan.pair_tet):
        pairs = Lanes.of(plan)
        used = pairs.live[:, None] & (pairs.entry != NONE)
        writers.append((np.broadcast_to(pairs.patch[:, None], used.shape)[used], pairs.slot[used], pairs.entry[used]))
    for group in case.scene.values().stencils:
        lanes = Stencils(plan, group.kind, group)
        assert (lanes.entry[lanes.live] != NONE).all()
        patch = np.broadcast_to(lanes.patch[:, None], lanes.slot.shape)
        writers.append((patch[lanes.live].ravel(), lanes.slot[lanes.live].ravel(), lanes.entry[lanes.live].ravel()))
    patch, slot, entry = (np.concatenate(parts) for parts in zip(*writers, strict=True))
    assert len(np.unique(np.stack([patch, entry]), axis=1).T) == len(patch)
    _, first, forces = rows_of(plan)
    row = plan.patch_slot[patch] + slot
    assert ((entry - first[row]) % 8 == 0).all()
    assert ((entry - first[row]) // 8 < forces[row]).all()
    np.testing.assert_array_equal(np.bincount(row, minlength=len(forces)), forces)
    ends = [start[-1] + 8 * rows[-1] for start, rows in slices_of(plan)]
    assert plan.sizes[SIZES.index("most_entries")] == max(ends)


def test_blocks_of_a_patch_stand_kind_by_kind(built: tuple[Case, Arrays]) -> None:
    _, plan = built
    assert plan.patch_stencil[0] == 0
    assert plan.patch_stencil[-1] == len(plan.stencil_block) == plan.stencil_sizes[0]
    ends = plan.patch_element if len(plan.patch_element) else plan.patch_stencil[1:]
    for begin, middle, end in zip(plan.patch_stencil[:-1], ends, plan.patch_stencil[1:], strict=True):
        # those that a step takes as rows are the last
        for part in (slice(begin, middle), slice(middle, end)):
            assert (np.diff(plan.stencil_block[part, 0]) >= 0).all()
    kinds = list(KINDS.values())
    numbers = {"solid_limit": 3, "cloth_limit": 3, "volume": 1, "damper": 7}  # others have two
    for column, count in ((1, lambda kind: kind.corners), (3, lambda kind: numbers.get(kind.name, 2))):
        rows = np.array([count(kinds[kind]) for kind in plan.stencil_block[:, 0]])
        np.testing.assert_array_equal(plan.stencil_block[:, column], np.cumsum(rows) - rows)


@pytest.mark.parametrize(("kernel", "patches"), PLANS)
def test_tetrahedra_are_there_beside_stencils(kernel: int, patches: int) -> None:
    case = mixed_case()
    lanes = Lanes.of(arrays_of(case, patches, kernel))
    tets = case.scene.values().tets
    assert sorted(lanes.tet[lanes.real]) == list(range(len(tets)))
    assert (np.sort(lanes.tet_vertices[lanes.real]) == np.sort(tets[lanes.tet[lanes.real]])).all()


def test_widths_and_types_follow_the_table() -> None:
    values = mixed_case().scene.values()
    tensors = compile_device_plan(values, 3, STREAM, torch.float32)
    for row, array in zip(device_table(values), tensors, strict=True):
        assert array.dtype == {"int32": torch.int32, "real": torch.float32, "int16": torch.int16}[row.type]
    assert [len(tensors), len(DEVICE_STENCIL_TABLE)] == [len(DEVICE_PLAN_TABLE) + 20, 20]
    assert not has_preconditioner(tensors)
    assert has_preconditioner(tensors[: len(DEVICE_PLAN_TABLE)] + tuple(MULTILEVEL_TABLE))


@pytest.mark.parametrize("kernel", [CLUSTER, GRID])
def test_other_kernels_are_refused(kernel: int) -> None:
    with pytest.raises(ValueError, match=rf"kernel must be 0 .*3 .*stencils, got {kernel}"):
        compile_device_plan(sheet_case().scene.values(), 1, kernel, torch.float32)


def test_the_kernel_is_chosen_by_shared_memory() -> None:
    small, large = (sheet_case(cells).scene.values() for cells in ((10, 9), (60, 50)))
    plan = choose_plan(small, torch.float32, H100)
    assert plan.kernel == "block"
    assert plan.patches == 1
    assert shared_bytes(plan, 0, 0) <= H100.shared
    for batch in (None, 1, 5000):
        assert choose_plan(small, torch.float32, H100, batch=batch).kernel == "block"
        assert choose_plan(large, torch.float32, H100, batch=batch).kernel == "stream"
    assert choose_plan(small, torch.float32, H100, "stream").kernel == "stream"
    with pytest.raises(ValueError, match=r"kernel='block' does not fit .* take \"auto\" or \"stream\""):
        choose_plan(large, torch.float32, H100, "block")


@pytest.mark.parametrize("kernel", ["cluster", "grid"])
def test_kernels_without_stencils_are_refused_by_name(kernel: str) -> None:
    with pytest.raises(ValueError, match=rf'kernel must be .*"block" or "stream" .*cloth.* got \'{kernel}\'; leave it'):
        choose_plan(sheet_case().scene.values(), torch.float32, H100, kernel)


def test_multilevel_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"solver must be Chebyshev\(\) or Jacobi\(\) .*cloth.* got Multilevel"):
        choose_plan(sheet_case().scene.values(), torch.float32, H100, levels=True)


@pytest.mark.parametrize(("dtype", "entries"), [(torch.float32, 4800), (torch.float64, 2400)])
def test_patches_of_a_stream_hold_as_many_entries_as_of_solids(dtype: torch.dtype, entries: int) -> None:
    plan = choose_plan(sheet_case((120, 100)).scene.values(), dtype, H100, "stream")
    assert plan.patches > 1
    # padding of slices and the cut make some larger
    assert 0.2 * entries < plan.size("most_entries") < 1.4 * entries
