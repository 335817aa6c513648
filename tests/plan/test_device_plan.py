"""The plan of a GPU: pairs of tetrahedra, their rest shapes, entries of their forces. Checked in NumPy, on no GPU."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from cases import box
from device_plans import (  # noqa: F401  (fixtures)
    BLOCK,
    CLUSTER,
    GRID,
    KERNELS,
    LANES,
    NONE,
    SIZES,
    SLICE,
    STREAM,
    Arrays,
    Lanes,
    Rest,
    arrays_of,
    entries_of,
    face_frames,
    fixture_case,
    fixture_lanes,
    fixture_plan,
    fixture_values,
    patches_of,
    rows_of,
    slices_of,
    values_of,
)
from numpy.typing import NDArray
from runs import ULP

import torchpd as pd
from torchpd import _C
from torchpd.common.tables import DEVICE_PLAN_TABLE
from torchpd.plan.gpu_plan import compile_device_plan
from torchpd.reference import elements
from torchpd.scene import SceneValues


def test_every_tetrahedron_is_in_one_lane(lanes: Lanes, values: SceneValues) -> None:
    both = lanes.tet[lanes.live]
    assert (both[:, 0] >= 0).all()
    np.testing.assert_array_equal(lanes.counted, lanes.tet >= 0)
    np.testing.assert_array_equal(np.sort(both[both >= 0]), np.arange(len(values.tets)))
    np.testing.assert_array_equal(
        np.sort(lanes.tet_vertices[lanes.real], axis=1), np.sort(values.tets[lanes.tet[lanes.real]], axis=1)
    )


def test_kernels_differ_in_rest_shapes_and_in_how_patches_exchange_alone(case: tuple[str, int]) -> None:
    """So that what is shown of the plan for one of them holds for all but a cluster: see test_cluster_plan.py."""
    plans = {kernel: arrays_of(case, kernel) for kernel in KERNELS if kernel != CLUSTER}
    own = {"sizes", "pair_rest", "pair_factor", "slot_rest", "slot_fixed", "patch_unit", "slot_sender", "shared_place"}
    entries = {"pair_corner": 65535, "slot_row": 32767 << 16}  # what is not an entry, which a pipeline has elsewhere
    for kernel, plan in plans.items():
        assert len(plan.slot_copy) == 0
        for row in DEVICE_PLAN_TABLE:
            array, expected = getattr(plan, row.name), getattr(plans[GRID], row.name)
            if kernel == STREAM and row.name in entries:
                array, expected = array & entries[row.name], expected & entries[row.name]
            if row.name not in own:
                np.testing.assert_array_equal(array, expected, row.name)
    assert len(plans[BLOCK].slot_sender) == len(plans[STREAM].slot_sender) == 0
    assert len(plans[BLOCK].shared_place) == len(plans[GRID].shared_place) == 0


@pytest.mark.parametrize("kernel", KERNELS)
def test_rest_shapes_are_there_once(kernel: int, case: tuple[str, int]) -> None:
    """Positions for the stream, whole numbers in float32; matrices for others and single patches. All else rounded."""
    double, single = arrays_of(case, kernel), arrays_of(case, kernel, torch.float32)
    blocks, slots, patches = len(double.pair_tet), len(double.slot_vertex), len(double.patch_pairs)
    computed = kernel == STREAM
    stored = not computed or patches == 1
    for plan, fixed in ((double, False), (single, True)):
        assert plan.pair_rest.shape == (stored * blocks, 384)
        assert plan.pair_factor.shape == (computed * blocks, 64)
        assert plan.slot_rest.shape == ((computed and not fixed) * slots, 4)
        assert plan.slot_fixed.shape == ((computed and fixed) * slots, 4)
        assert plan.patch_unit.shape == (computed * patches,)
    assert (double.patch_unit == 1.0).all()
    for row in DEVICE_PLAN_TABLE:
        if row.name not in ("pair_factor", "slot_rest", "slot_fixed", "patch_unit"):
            array = getattr(single, row.name)
            np.testing.assert_array_equal(array, getattr(double, row.name).astype(array.dtype), row.name)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("kernel", KERNELS)
def test_rest_shapes_fit_the_order_of_corners(
    kernel: int, dtype: torch.dtype, case: tuple[str, int], values: SceneValues
) -> None:
    """F of a deformed body is that of its tetrahedra, also where the corners wind the other way.

    To first order, with H = |a| |b| |c| / |det| of the edges and k = |Dm| |Dm^-1|, in Frobenius norms: where positions
    are off by e, so are edges by 2 e and Ds times the cofactors by 12 e H / (shortest edge) of |F|. Rounding u of edges
    makes 2 u k, of cross products 12 u H, of the determinant 8 u H k, of NumPy's inverse and products with Ds 40 u k;
    and what the plan holds in `dtype` is rounded once more. A frame, from a cross product too, is 12 u H off.
    """
    noise = np.random.default_rng(0).standard_normal(values.rest_positions.shape)
    lanes = Lanes.of(arrays_of(case, kernel, dtype))

    def edges(positions: NDArray[np.float64]) -> NDArray[np.float64]:
        p = positions[lanes.tet_vertices[lanes.real]]
        return np.swapaxes(p[:, 1:] - p[:, :1], -1, -2)

    def norm(matrices: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(np.linalg.norm(matrices, axis=(-2, -1)))

    rest, u = Rest.of(arrays_of(case, kernel, dtype), lanes), ULP[torch.float64]
    Ds, Dm = edges(values.rest_positions + 0.01 * noise), edges(values.rest_positions)
    inverse, volume, lengths = np.linalg.inv(Dm), np.abs(np.linalg.det(Dm)) / 6.0, np.linalg.norm(Dm, axis=1)
    hadamard, condition = lengths.prod(axis=-1) / (6.0 * volume), norm(Dm) * norm(inverse)
    held = ULP[dtype] + u * ((20 if kernel == STREAM else 32) * hadamard + 42)
    moved = 12 * np.broadcast_to(rest.rounding[:, None], lanes.real.shape)[lanes.real] * hadamard / lengths.min(axis=-1)
    # where they are stored it is in a frame of the face that pairs share: F Q^T with the turn Q into it
    F = Ds @ inverse if kernel == STREAM else Ds @ inverse @ np.swapaxes(face_frames(Dm), -1, -2)
    difference = norm(Ds @ rest.inverse[lanes.real] - F)
    assert (difference <= (moved + held * condition) * norm(Ds @ inverse)).all()
    limit = (2 * ULP[dtype] + u * (8 * hadamard + 42 * condition)) * volume
    assert (np.abs(rest.volume[lanes.real] - volume) <= limit).all()


@pytest.mark.parametrize("kernel", [CLUSTER, GRID])
def test_bounds_are_those_of_the_reference(kernel: int, case: tuple[str, int], values: SceneValues) -> None:
    lanes = Lanes.of(arrays_of(case, kernel))
    expected = elements(values.rest_positions, values.tets).eigenvalue_bound[lanes.tet[lanes.real]]
    np.testing.assert_allclose(lanes.bound[lanes.real], expected, rtol=1e-9)


def test_rest_positions_are_relative_to_the_first_slot(case: tuple[str, int], values: SceneValues) -> None:
    """Rounded once: to float64, or to the patch's unit, of which whole numbers leave 29 bits to its extent."""
    plan, single = arrays_of(case, STREAM), arrays_of(case, STREAM, torch.float32)
    patch, _, _ = rows_of(plan)
    x = values.rest_positions[plan.vertex_order[plan.slot_vertex]]
    expected = np.zeros((len(x), 4))
    expected[:, :3] = x - x[plan.patch_slot[patch]]
    np.testing.assert_array_equal(plan.slot_rest, expected)
    unit = single.patch_unit.astype(np.float64)
    assert (np.frexp(unit)[0] == 0.5).all()
    assert (np.abs(single.slot_fixed * unit[patch][:, None] - expected) <= 0.5 * unit[patch][:, None]).all()
    extent = np.maximum.reduceat(np.abs(single.slot_fixed).max(axis=1), single.patch_slot[:-1])
    assert (extent >= 2**28).all()


def test_differences_of_rest_positions_fit_32_bits() -> None:
    """The corners of one tetrahedron reach almost a power of two on either side of the first slot, and round to it."""
    reach = 1.0 - 2.0**-45
    vertices = np.array([[0.0, 0.0, 0.0], [reach, 0.0, 0.0], [-reach, 0.5, 0.0], [0.0, 0.0, 0.5]])
    values = pd.Scene(pd.Solid(pd.TetMesh(vertices, [[0, 1, 2, 3]]), 1e5)).values()
    plan = Arrays.of(values, 1, STREAM, torch.float32)
    np.testing.assert_array_equal(plan.vertex_order[plan.slot_vertex[0]], 0)
    x = plan.slot_fixed.astype(np.int64)
    assert np.abs(x[:, None] - x).max() < 2**31


def test_rest_positions_do_not_feel_how_far_away_the_body_is() -> None:
    """Numbers that float64 holds exactly: the same bits where float32 could not tell one vertex from the next."""
    vertices, tets = box((5.0, 4.0, 3.0), (20, 16, 12))
    far = vertices + [2.0**24, -(2.0**25), 0.0]
    assert len(np.unique(far.astype(np.float32), axis=0)) < len(far) / 10
    near, there = (
        compile_device_plan(pd.Scene(pd.Solid(pd.TetMesh(x, tets), 1e5)).values(), 9, STREAM, torch.float32)
        for x in (vertices, far)
    )
    for row, one, other in zip(DEVICE_PLAN_TABLE, near, there, strict=True):
        assert torch.equal(one, other), row.name


def test_what_is_missing_strains_but_weighs_nothing(case: tuple[str, int], plan: Arrays, lanes: Lanes) -> None:
    stored, computed = Rest.of(plan, lanes), Rest.of(arrays_of(case, STREAM), lanes)
    single = lanes.live & (lanes.tet[:, 1] < 0)
    np.testing.assert_array_equal(lanes.slot[single, 4], lanes.slot[single, 3])
    np.testing.assert_array_equal(stored.inverse[single, 1], stored.inverse[single, 0])
    np.testing.assert_array_equal(lanes.bound[single, 1], lanes.bound[single, 0])
    np.testing.assert_array_equal(lanes.entry == NONE, ~lanes.live[:, None] | (single[:, None] & (np.arange(5) == 4)))
    np.testing.assert_array_equal(stored.volume == 0.0, ~lanes.live[:, None] | (lanes.tet < 0))
    for rest in (stored, computed):
        assert np.isfinite(rest.inverse).all()  # zero times it is zero
    last = plan.patch_block[lanes.patch] * LANES + plan.patch_pairs[lanes.patch] - 1
    padding = ~lanes.live
    assert (lanes.tet[padding] == -1).all()
    np.testing.assert_array_equal(lanes.slot[padding], lanes.slot[last[padding]])
    np.testing.assert_array_equal(stored.inverse[padding], stored.inverse[last[padding]])
    np.testing.assert_array_equal(plan.patch_pairs, np.bincount(lanes.patch[lanes.live]))
    np.testing.assert_array_equal(np.diff(plan.patch_block), -(-plan.patch_pairs // LANES))


def test_most_tetrahedra_find_a_partner(lanes: Lanes, plan: Arrays, values: SceneValues) -> None:
    if len(values.tets) < 40 * len(plan.patch_pairs):
        pytest.skip("patches of a few tetrahedra")
    # a small patch of odd size leaves one alone, one in 40; and twice that for the greedy choice
    assert int((lanes.live & (lanes.tet[:, 1] < 0)).sum()) <= 3 / 40 * len(values.tets)


def test_forces_have_entries_of_their_own(lanes: Lanes, plan: Arrays) -> None:
    """A slot owns every eighth entry from its first on, one for each pair that touches it, in the order of pairs."""
    patch, first, forces = rows_of(plan)
    which, corner = np.nonzero(lanes.entry != NONE)
    slot = plan.patch_slot[lanes.patch[which]] + lanes.slot[which, corner]
    entry = lanes.entry[which, corner]
    np.testing.assert_array_equal(np.bincount(slot, minlength=len(forces)), forces)
    assert (forces > 0).all()
    order = np.argsort(slot, kind="stable")  # by slot, then by pair
    rank = np.arange(len(slot)) - np.repeat(np.cumsum(forces) - forces, forces)
    np.testing.assert_array_equal(entry[order], first[slot[order]] + SLICE * rank)
    assert len(np.unique(np.stack([patch[slot], entry]), axis=1).T) == len(entry)
    assert (entry < entries_of(plan)[patch[slot]]).all()
    for start, rows in slices_of(plan):  # no padding in between
        np.testing.assert_array_equal(start, SLICE * (np.cumsum(rows) - rows))
    np.testing.assert_array_equal(first % SLICE, (np.arange(len(first)) - plan.patch_slot[patch]) % SLICE)


def test_banks_are_spread(lanes: Lanes, plan: Arrays) -> None:
    """Eight lanes in a row seldom meet in a bank: under 1.6 passes a phase, 2.5 in a random order, 1 at best."""
    if plan.patch_pairs.min() < 100:
        pytest.skip("too few pairs to choose from")
    banks = (lanes.slot % 8).reshape(-1, 8, 5)[lanes.live.reshape(-1, 8).all(axis=1)]
    passes = (banks[:, :, :, None] == np.arange(8)).sum(axis=1).max(axis=-1)
    assert passes.mean() < 1.6


def test_gather_is_the_sum_over_corners(lanes: Lanes, plan: Arrays, values: SceneValues) -> None:
    push = np.random.default_rng(0).integers(-1000, 1000, lanes.entry.shape).astype(np.float64)  # sums are exact
    has = lanes.entry != NONE
    expected = np.bincount(lanes.vertex[has], weights=push[has], minlength=len(values.rest_positions))

    buffer = np.full((len(plan.patch_pairs), entries_of(plan).max()), np.nan)
    buffer[np.broadcast_to(lanes.patch[:, None], has.shape)[has], lanes.entry[has]] = push[has]
    patch, first, forces = rows_of(plan)
    sums = np.array([buffer[p, a : a + SLICE * n : SLICE].sum() for p, a, n in zip(patch, first, forces, strict=True)])
    got = np.full(len(plan.vertex_order), np.nan)
    first_shared = plan.patch_vertex[-1]
    inside = plan.slot_vertex < first_shared
    got[plan.slot_vertex[inside]] = sums[inside]
    for v, (a, b) in enumerate(zip(plan.shared_start[:-1], plan.shared_start[1:], strict=True)):
        got[first_shared + v] = sums[plan.shared_slot[a:b]].sum()
    np.testing.assert_array_equal(got, expected[plan.vertex_order])


def test_pins_know_their_vertices(plan: Arrays, values: SceneValues) -> None:
    np.testing.assert_array_equal(plan.vertex_order[plan.pin_vertex], values.pin_vertices)
    if len(values.pin_vertices) == 0:
        assert len(plan.vertex_pin) == 0
        return
    expected = np.full(len(plan.vertex_order), -1)
    expected[plan.pin_vertex] = np.arange(len(values.pin_vertices))
    np.testing.assert_array_equal(plan.vertex_pin, expected)


@pytest.mark.parametrize("kernel", KERNELS)
def test_sizes_count_the_arrays(kernel: int, case: tuple[str, int], values: SceneValues) -> None:
    plan = arrays_of(case, kernel)
    free = np.setdiff1d(values.component, values.component[values.pin_vertices])
    expected = {
        "kernel": kernel,
        "vertices": len(values.rest_positions),
        "tets": len(values.tets),
        "pins": len(values.pin_vertices),
        "pieces": len(free),
        "blocks": len(plan.pair_tet),
        "patches": len(plan.patch_pairs),
        "slots": len(plan.slot_vertex),
        "shared": len(plan.shared_start) - 1,
        "parts": len(plan.part_row),
        "sums": len(plan.sum_rows),
        "sum_levels": max(len(plan.level_sum) - 1, 0),
        "senders": len(plan.slot_sender),
        "most_slots": np.diff(plan.patch_slot).max(),
        "most_pairs": plan.patch_pairs.max(),
        "most_entries": entries_of(plan).max(),
        "most_interior": np.diff(plan.patch_vertex).max(),
        "members": 0,
        "environments": 0,
        "solid_pieces": len(free),
    }
    assert dict(zip(SIZES, plan.sizes.tolist(), strict=True)) == expected


@pytest.mark.parametrize("kernel", KERNELS)
def test_arrays_are_those_of_the_table(kernel: int, case: tuple[str, int], values: SceneValues) -> None:
    kinds = {"real": torch.float32, "int32": torch.int32}
    tensors = compile_device_plan(values, patches_of(case, kernel), kernel, torch.float32)
    for row, array in zip(DEVICE_PLAN_TABLE, tensors, strict=True):
        assert array.dtype == kinds[row.type], row.name
        assert array.is_contiguous(), row.name
        assert array.device.type == "cpu", row.name
        assert array.shape[1:] == ((row.width,) if row.width > 1 else ()), row.name


@pytest.mark.parametrize("kernel", KERNELS)
def test_threads_do_not_matter(kernel: int) -> None:
    values = values_of("delaunay")
    before = torch.get_num_threads()
    plans = []
    try:
        for threads in (1, 2, 2):
            torch.set_num_threads(threads)
            plans.append(compile_device_plan(values, 9, kernel, torch.float64))
    finally:
        torch.set_num_threads(before)
    for other in plans[1:]:
        assert all(torch.equal(a, b) for a, b in zip(plans[0], other, strict=True))


def test_too_few_patches_are_refused() -> None:
    refusal = (
        r"patches = 1 is too few: one of them would have at least \d+ entries, and 16 bits count up to 65534; take"
    )
    # known from the number of tetrahedra; and only once the entries are counted
    for cells in ((20, 20, 20), (4, 4, 273)):
        vertices, tets = box((1.0, 1.0, 1.0), cells)
        piece = np.zeros(len(vertices), dtype=np.int32)
        with pytest.raises(ValueError, match=refusal):
            _C.build_device_plan(vertices, tets, [], 1, STREAM, False, piece, lambda done: None)
        plan = _C.build_device_plan(vertices, tets, [], 2, STREAM, False, piece, lambda done: None)
        assert plan["sizes"][SIZES.index("patches")] == 2


def test_too_many_slots_are_refused() -> None:
    """Single tetrahedra have few entries, and more slots than pair_corner counts."""
    count = 2049
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    vertices = (corners + 2.0 * np.arange(count)[:, None, None] * [1, 0, 0]).reshape(-1, 3)
    tets, piece = np.arange(4 * count).reshape(-1, 4), np.zeros(4 * count, dtype=np.int32)
    refusal = "patches = 1 is too few: one of them would have at least 8196 slots, and 16 bits count up to 8192; take"
    with pytest.raises(ValueError, match=refusal):
        _C.build_device_plan(vertices, tets, [], 1, STREAM, False, piece, lambda done: None)
    most = _C.build_device_plan(vertices[:-4], tets[:-1], [], 1, STREAM, False, piece[:-4], lambda done: None)
    assert most["sizes"][SIZES.index("most_slots")] == 8192
    assert (most["pair_corner"].view(np.uint32) & 65535).max() == 8 * 8191


def test_bad_arguments_are_refused() -> None:
    values = values_of("one tet")
    x, tets, piece = values.rest_positions, values.tets, np.zeros(4, dtype=np.int32)
    for patches in (0, -1, 2):
        with pytest.raises(ValueError, match=rf"patches .*got {patches}"):
            compile_device_plan(values, patches, 0, torch.float32)
    for kernel in (-1, 4):
        refusal = f"kernel must be 0, 1, 2 or 3, got {kernel}"
        with pytest.raises(ValueError, match=refusal):
            compile_device_plan(values, 1, kernel, torch.float32)
        with pytest.raises(ValueError, match=refusal):
            _C.build_device_plan(x, tets, [], 1, kernel, False, piece, lambda done: None)
    with pytest.raises(ValueError, match=r"dtype .*got torch\.float16"):
        compile_device_plan(values, 1, 0, torch.float16)
    for bad in (4, -1, 2**40):
        with pytest.raises(IndexError, match=r"tets .*positions"):
            _C.build_device_plan(x, np.array([[0, 1, 2, bad]]), [], 1, BLOCK, False, piece, lambda done: None)
    with pytest.raises(ValueError, match=r"piece .*int32 \[vertices\]"):
        _C.build_device_plan(x, tets, [], 1, BLOCK, False, piece[:3], lambda done: None)
    for number in (-2, 4):
        with pytest.raises(ValueError, match=r"piece .*from 0, or -1"):
            _C.build_device_plan(x, tets, [], 1, BLOCK, False, np.full(4, number, dtype=np.int32), lambda done: None)
