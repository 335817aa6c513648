"""The patches of a GPU's plan: where they are cut, vertices that they share, parts of pieces. In NumPy, on no GPU."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from cases import box
from device_plans import (  # noqa: F401  (fixtures)
    BLOCK,
    GRID,
    LANES,
    SENDERS,
    SIZES,
    SLOT_STEP,
    STREAM,
    Arrays,
    Lanes,
    arrays_of,
    cut_by_centres,
    fixture_case,
    fixture_lanes,
    fixture_plan,
    fixture_values,
    values_of,
)
from numpy.typing import NDArray

import torchpd as pd
from torchpd.scene import SceneValues

SMALL_PAIRS = 512  # csrc/plan/gpu/patch.cpp


def test_patches_hold_their_interior_and_then_shared_vertices(lanes: Lanes, plan: Arrays, values: SceneValues) -> None:
    np.testing.assert_array_equal(np.sort(plan.vertex_order), np.arange(len(values.rest_positions)))
    touched = np.unique(np.stack([lanes.vertex.reshape(-1), np.repeat(lanes.patch, 5)]), axis=1)
    patches = np.bincount(touched[0])
    first_shared = plan.patch_vertex[-1]
    np.testing.assert_array_equal(patches[plan.vertex_order[:first_shared]], 1)
    assert (patches[plan.vertex_order[first_shared:]] > 1).all()
    for p, (a, b) in enumerate(zip(plan.patch_slot[:-1], plan.patch_slot[1:], strict=True)):
        mine, interior = plan.slot_vertex[a:b], np.arange(plan.patch_vertex[p], plan.patch_vertex[p + 1])
        np.testing.assert_array_equal(mine[: len(interior)], interior)
        assert (mine[len(interior) :] >= first_shared).all()
        np.testing.assert_array_equal(np.sort(plan.vertex_order[mine]), touched[0][touched[1] == p])
    assert len(plan.shared_start) == len(plan.vertex_order) - first_shared + 1
    for v, (a, b) in enumerate(zip(plan.shared_start[:-1], plan.shared_start[1:], strict=True)):
        np.testing.assert_array_equal(plan.shared_slot[a:b], np.flatnonzero(plan.slot_vertex == first_shared + v))


def test_the_first_patch_owns_a_vertex(plan: Arrays) -> None:
    first = np.unique(plan.slot_vertex, return_index=True)[1]
    np.testing.assert_array_equal(np.flatnonzero(plan.slot_row >= 0), np.sort(first))


def test_vertices_of_the_same_patches_are_neighbours(plan: Arrays) -> None:
    """A patch reads what another sends in runs then. They follow the last patch of each, by which all forces are there.

    Slots of a small patch follow; those of a large one save padding.
    """
    first_shared = plan.patch_vertex[-1]
    patch = np.repeat(np.arange(len(plan.patch_slot) - 1), np.diff(plan.patch_slot))
    owners = [patch[plan.slot_vertex == v].tolist() for v in range(first_shared, len(plan.vertex_order))]
    assert owners == sorted(owners, key=lambda patches: patches[::-1])
    for p, (a, b) in enumerate(zip(plan.patch_slot[:-1], plan.patch_slot[1:], strict=True)):
        mine, forces = plan.slot_vertex[a:b], plan.slot_row[a:b] >> 16 & 0x7FFF
        shared = mine >= first_shared
        assert (np.diff(forces[~shared]) <= 0).all()
        assert (np.diff(mine[shared] if plan.patch_pairs[p] <= SMALL_PAIRS else -forces[shared]) >= 0).all()


def test_outer_pairs_come_first(plan: Arrays) -> None:
    """Forces on shared vertices are complete after them. Small patches, of a round or two, have no order."""
    for p, pairs in enumerate(plan.patch_pairs):
        outer = plan.patch_outer[p]
        if pairs <= SMALL_PAIRS:
            assert outer == pairs
            continue
        interior = plan.patch_vertex[p + 1] - plan.patch_vertex[p]
        corners = plan.pair_corner[plan.patch_block[p] : plan.patch_block[p + 1]].reshape(-1, 5, LANES)
        slots = (corners & 0xFFFF).transpose(0, 2, 1).reshape(-1, 5)[:pairs] // SLOT_STEP
        touches = (slots >= interior).any(axis=1)
        assert not touches[outer:].any()
        assert outer == min(-(-touches.sum() // LANES) * LANES, pairs)


@pytest.mark.parametrize(("patches", "small"), [(20, True), (5, False)])
def test_shared_slots_of_small_and_of_large_patches(patches: int, small: bool) -> None:
    values = pd.Scene(pd.Solid(pd.shapes.box((1.0, 1.0, 1.0), (10, 10, 10)), youngs=1e5)).values()
    plan = Arrays.of(values, patches)
    assert (plan.patch_pairs <= SMALL_PAIRS).all() == small
    assert (plan.patch_outer < plan.patch_pairs).any() != small
    test_outer_pairs_come_first(plan)
    test_vertices_of_the_same_patches_are_neighbours(plan)


def test_forces_on_a_shared_vertex_lie_side_by_side(case: tuple[str, int]) -> None:
    """Where those of a stream go, slot by slot: the order of shared_slot."""
    plan = arrays_of(case, STREAM)
    np.testing.assert_array_equal(plan.shared_slot[plan.shared_place], shared_slots(plan))


def sender_rows(plan: Arrays, number: int) -> list[int]:
    """The rows of slot_sender that one shared slot reads."""
    rows = [number]
    while (more := int(plan.slot_sender[rows[-1], SENDERS])) != 0:
        assert more > rows[-1]
        rows.append(more)
    return rows


def shared_slots(plan: Arrays) -> NDArray[np.int64]:
    """Slots of vertices that patches share, patch by patch."""
    return np.flatnonzero(plan.slot_vertex >= plan.patch_vertex[-1])


def test_senders_are_the_slots_of_a_vertex_in_patch_order(plan: Arrays) -> None:
    slots, seen = shared_slots(plan), []
    assert plan.slot_sender.shape[1:] == (SENDERS + 1,)
    for number, slot in enumerate(slots):
        rows = sender_rows(plan, number)
        seen += rows
        assert min(rows[1:], default=len(slots)) >= len(slots)  # those that go on stand after the others
        expected = np.flatnonzero(plan.slot_vertex == plan.slot_vertex[slot])
        padding = np.full(SENDERS * len(rows) - len(expected), -1)
        assert len(padding) < SENDERS
        np.testing.assert_array_equal(plan.slot_sender[rows, :SENDERS].reshape(-1), [*expected, *padding])
    assert sorted(seen) == list(range(len(plan.slot_sender)))


@pytest.mark.parametrize("patches", [2, 7, 8, 14, 15, 20])
def test_a_vertex_of_many_patches_has_several_rows_of_senders(patches: int) -> None:
    values = values_of("cones")
    plan = Arrays.of(values, patches)
    hub = np.flatnonzero(plan.vertex_order[plan.slot_vertex[shared_slots(plan)]] == 0)
    assert len(hub) == patches
    for number in hub:
        assert len(sender_rows(plan, int(number))) == -(-patches // SENDERS)


@pytest.mark.parametrize(
    ("cells", "patches", "cuts"),
    [
        ((9, 9, 9), 2, [(9, 9)]),
        ((20, 5, 5), 7, [(5, 5)] * 6),
        ((33, 4, 4), 12, [(4, 4)] * 11),
        ((21, 6, 5), 5, [(6, 5)] * 4),
        ((11, 11, 2), 4, [(11, 2), (6, 2), (6, 2)]),
    ],
)
def test_a_cut_shares_one_layer_of_vertices(
    cells: tuple[int, int, int], patches: int, cuts: list[tuple[int, int]]
) -> None:
    """On a line across the cut both sides touch one vertex, or two where the cut goes from one layer to the next.

    It does so along a row of cells across the shorter side: one vertex more than cells, and two more at a cell that is
    cut itself.
    """
    vertices, tets = box((float(cells[0]), float(cells[1]), float(cells[2])), cells)
    most = sum((a + 1) * (b + 1) + min(a, b) + 3 for a, b in cuts)
    for order in (np.arange(len(tets)), np.random.default_rng(0).permutation(len(tets))):  # numbers must not matter
        plan = Arrays.of(pd.Scene(pd.Solid(pd.TetMesh(vertices, tets[order]), 1e5)).values(), patches)
        assert len(plan.patch_pairs) == patches
        assert plan.sizes[SIZES.index("shared")] <= most
    # control: ordered by their centres, tetrahedra of a layer that is cut share vertices on either side of it
    touched = np.zeros((len(vertices), patches), dtype=bool)
    for number, part in enumerate(cut_by_centres(vertices[tets].mean(axis=1), np.arange(len(tets)), patches)):
        touched[tets[part], number] = True
    assert (touched.sum(axis=1) > 1).sum() > most


def test_parts_hold_each_free_vertex_once(plan: Arrays, values: SceneValues) -> None:
    held = np.isin(values.component, values.component[values.pin_vertices])
    names = ("slot_piece", "patch_part", "part_start", "part_slot", "part_row", "level_sum", "sum_rows", "piece_rows")
    if held.all():
        assert [len(getattr(plan, name)) for name in names] == [0] * len(names)
        return
    user = plan.vertex_order[plan.slot_vertex]
    np.testing.assert_array_equal(plan.slot_piece < 0, held[user])
    np.testing.assert_array_equal(np.sort(user[plan.part_slot]), np.flatnonzero(~held))
    # a shared vertex belongs to the first patch that has it
    np.testing.assert_array_equal(
        plan.part_slot, np.unique(plan.slot_vertex, return_index=True)[1][plan.slot_vertex[plan.part_slot]]
    )
    assert len(plan.patch_part) == len(plan.patch_pairs) + 1
    assert len(plan.part_start) == len(plan.part_row) + 1
    assert (np.diff(plan.part_start) > 0).all()
    part_patch = np.repeat(np.arange(len(plan.patch_pairs)), np.diff(plan.patch_part))
    part_piece = plan.slot_piece[plan.part_slot[plan.part_start[:-1]]]
    np.testing.assert_array_equal(np.argsort(plan.part_row), np.lexsort((part_patch, part_piece)))
    for part, (a, b) in enumerate(itertools.pairwise(plan.part_start)):
        slots = plan.part_slot[a:b]
        assert (np.diff(slots) > 0).all()
        assert (slots >= plan.patch_slot[part_patch[part]]).all()
        assert (slots < plan.patch_slot[part_patch[part] + 1]).all()
        assert (plan.slot_piece[slots] == part_piece[part]).all()
    moving = plan.slot_piece >= 0
    pairs = np.unique(np.stack([plan.slot_piece[moving], values.component[user[moving]]]), axis=1)
    np.testing.assert_array_equal(pairs[0], np.arange(len(plan.piece_rows)))  # one component each
    assert len(np.unique(pairs[1])) == len(pairs[1])


@pytest.mark.parametrize("kernel", [BLOCK, GRID, STREAM])
def test_parts_are_full(case: tuple[str, int], kernel: int) -> None:
    """They have 128 vertices, but for the last of a piece in a patch."""
    plan = arrays_of(case, kernel)
    sizes = np.diff(plan.part_start)
    for first, last in itertools.pairwise(plan.patch_part):
        pieces = plan.slot_piece[plan.part_slot[plan.part_start[first:last]]]
        for piece in np.unique(pieces):
            mine = sizes[first:last][pieces == piece]
            assert (mine[:-1] == 128).all()
            assert 0 < mine[-1] <= 128


@pytest.mark.parametrize("cells", [(2, 2, 2), (15, 3, 3), (40, 14, 14)])
def test_sums_of_at_most_32_rows_add_up_every_part_of_a_piece(cells: tuple[int, int, int]) -> None:
    small, large = box((1.0, 1.0, 1.0), (1, 1, 1)), box((1.0, 1.0, 1.0), cells)
    bodies = [pd.Solid(pd.TetMesh(v + [2.0 * i, 0.0, 0.0], t), 1e5) for i, (v, t) in enumerate((small, large, small))]
    plan = Arrays.of(pd.Scene(*bodies).values(), 7)
    parts = len(plan.part_row)
    rows = np.zeros((parts + len(plan.sum_rows), parts), np.int64)  # how often a row has each part
    rows[plan.part_row, np.arange(parts)] = 1
    ready = parts
    for first, last in itertools.pairwise(plan.level_sum):
        assert last > first
        for number in range(first, last):
            a, b = plan.sum_rows[number]
            assert 0 < b - a <= 32
            assert b <= ready
            rows[parts + number] = rows[a:b].sum(axis=0)
        ready = parts + last
    assert ready == len(rows)
    part_piece = plan.slot_piece[plan.part_slot[plan.part_start[:-1]]]
    for piece, (a, b) in enumerate(plan.piece_rows):
        assert 0 < b - a <= 32
        np.testing.assert_array_equal(rows[a:b].sum(axis=0), part_piece == piece)
