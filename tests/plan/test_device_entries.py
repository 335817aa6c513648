"""Where the plan of a pipeline puts forces in shared memory, so that lanes of a warp seldom meet in a bank."""

from __future__ import annotations

import numpy as np
import pytest
from cases import box
from device_plans import (
    CASES,
    GRID,
    LANES,
    NONE,
    SLICE,
    STREAM,
    Arrays,
    Lanes,
    arrays_of,
    entries_of,
    rows_of,
    slices_of,
    values_of,
)
from numpy.typing import NDArray

import torchpd as pd

PIPED = [case for case in CASES if case[1] > 1 and case[0] != "full patch"]
QUARTERS = 4  # of the banks: eight entries of 4 bytes each


def passes(entry: NDArray[np.int64], together: int) -> float:
    """In how many turns that many lanes reach as many banks as they are, on average over blocks and corners."""
    banks = entry.reshape(-1, together, entry.shape[1], 1) % together == np.arange(together)
    return float(banks.sum(axis=1).max(axis=-1).mean())


@pytest.mark.parametrize("case", PIPED, ids=str)
def test_every_force_has_an_entry_of_its_slot(case: tuple[str, int]) -> None:
    plan = arrays_of(case, STREAM)
    lanes = Lanes.of(plan)
    patch, first, forces = rows_of(plan)
    which, corner = np.nonzero(lanes.entry != NONE)
    slot = plan.patch_slot[lanes.patch[which]] + lanes.slot[which, corner]
    entry = lanes.entry[which, corner]
    order = np.lexsort((entry, slot))
    rank = np.arange(len(slot)) - np.repeat(np.cumsum(forces) - forces, forces)
    np.testing.assert_array_equal(slot[order], np.repeat(np.arange(len(forces)), forces))
    np.testing.assert_array_equal(entry[order], first[slot[order]] + SLICE * rank)
    assert len(np.unique(np.stack([patch[slot], entry]), axis=1).T) == len(entry)
    assert (entry < entries_of(plan)[patch[slot]]).all()


@pytest.mark.parametrize("case", PIPED, ids=str)
def test_rows_of_a_warp_begin_in_four_quarters_of_the_banks(case: tuple[str, int]) -> None:
    """And those of half a warp in both halves; no more rows are left out than that takes."""
    plan = arrays_of(case, STREAM)
    for entry, rows in slices_of(plan):
        start = entry // SLICE
        left_out = start[1:] - (start + rows)[:-1]
        assert start[0] == 0
        assert ((left_out >= 0) & (left_out < QUARTERS)).all()
        for warp in range(0, len(start), QUARTERS):
            quarter = start[warp : warp + QUARTERS] % QUARTERS
            assert len(np.unique(quarter)) == len(quarter)
            assert all((a - b) % 2 for a, b in zip(quarter[::2], quarter[1::2], strict=False))


def test_lanes_that_write_forces_seldom_meet() -> None:
    """A fifth fewer turns of half a warp, and a third fewer of a warp, than entries in the order of pairs take."""
    scene = pd.Scene(pd.Solid(pd.TetMesh(*box((1.0, 1.0, 1.0), (9, 9, 9))), 1e5))
    turns = {}
    for kernel in (GRID, STREAM):
        lanes = Lanes.of(Arrays.of(scene.values(), 2, kernel))
        block = lanes.entry.reshape(-1, LANES, 5)
        entry = block[(block != NONE).all(axis=(1, 2))].reshape(-1, 5)
        assert len(entry) > 20 * LANES
        turns[kernel] = np.array([passes(entry, LANES // 2), passes(entry, LANES)])
    assert (turns[STREAM] <= np.array([0.8, 0.7]) * turns[GRID]).all(), turns


def test_large_and_single_patches_keep_the_order_of_pairs() -> None:
    """Large ones go through no pipeline, and may need all entries that 16 bits count. Single ones sum like `block`."""
    single = [case for case in CASES if case[1] == 1]
    assert {"full patch", "held box", "slivers"} <= {name for name, _ in single}
    for case in single:
        for name in ("pair_corner", "slot_row"):
            grid, stream = (getattr(arrays_of(case, kernel), name) for kernel in (GRID, STREAM))
            np.testing.assert_array_equal(grid, stream)
    assert len(values_of("full patch").rest_positions) > 1024
