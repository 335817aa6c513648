"""The plan of a GPU: pairs of tetrahedra, entries of their forces, parts of pieces. Checked in NumPy, on no GPU."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from cases import box, oriented, sliver_mesh
from numpy.typing import NDArray
from scipy.spatial import Delaunay

import torchpd as pd
from torchpd import _C
from torchpd.device_plan import compile_device_plan
from torchpd.reference import elements
from torchpd.scene import SceneValues
from torchpd.tables import DEVICE_PLAN_TABLE

LANES, SLICE, NONE = 32, 8, 65535
SIZES = ["kernel", "vertices", "tets", "pins", "pieces", "blocks", "patches", "slots", "shared", "parts"]
SIZES += ["most_slots", "most_pairs", "most_entries", "most_shared", "most_parts"]


def delaunay_mesh() -> pd.TetMesh:
    """Random points, denser at one corner: tetrahedra of all sizes, slivers among them."""
    points = np.random.default_rng(1).uniform(size=(300, 3)) ** 2
    tets = oriented(points, Delaunay(points).simplices.astype(np.int64))
    volumes = np.linalg.det(points[tets][:, 1:] - points[tets][:, :1]) / 6.0
    tets = tets[volumes > 1e-9]
    used, tets = np.unique(tets, return_inverse=True)
    return pd.TetMesh(points[used], tets.reshape(-1, 4))


def values_of(name: str) -> SceneValues:
    if name == "one tet":
        mesh = pd.TetMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]])
        return pd.Scene(pd.Solid(mesh, 1e5)).values()
    vertices, tets = box((0.5, 0.4, 0.3), (5, 4, 3))
    body = pd.Solid(pd.TetMesh(vertices, tets), 1e5)
    if name == "full patch":  # almost as many entries as 16 bits count
        return pd.Scene(pd.Solid(pd.TetMesh(*box((1.0, 1.0, 1.0), (16, 16, 17))), 1e5)).values()
    if name == "held box":
        return pd.Scene(body, pd.Pin(body, [7, 0, 33])).values()
    if name == "held and free":
        other = pd.Solid(pd.TetMesh(vertices + [0.0, 1.0, 0.0], tets), 1e5)
        return pd.Scene(body, other, pd.Pin(body, np.arange(20))).values()
    if name == "pieces":
        far = [pd.Solid(pd.TetMesh(vertices + [0.0, y, 0.0], tets), 1e5) for y in (1.0, 2.0)]
        return pd.Scene(body, *far).values()
    return pd.Scene(pd.Solid({"slivers": sliver_mesh, "delaunay": delaunay_mesh}[name](), 1e5)).values()


CASES = (
    ("one tet", 1),
    ("held box", 1),
    ("held box", 4),
    ("held box", 360),
    ("full patch", 1),
    ("held and free", 1),
    ("held and free", 7),
    ("pieces", 5),
    ("slivers", 1),
    ("slivers", 20),
    ("delaunay", 1),
    ("delaunay", 13),
)


class Arrays(SimpleNamespace):
    """The arrays of a plan by name."""

    @classmethod
    def of(cls, values: SceneValues, patches: int, dtype: torch.dtype = torch.float64) -> Arrays:
        tensors = compile_device_plan(values, patches, 1, dtype)
        return cls(**{row.name: t.numpy() for row, t in zip(DEVICE_PLAN_TABLE, tensors, strict=True)})


@dataclass(frozen=True)
class Lanes:
    """Pairs lane by lane, padding included."""

    live: NDArray[np.bool_]  # [lanes]
    patch: NDArray[np.int64]  # [lanes]
    slot: NDArray[np.int64]  # [lanes, 5] in the patch
    entry: NDArray[np.int64]  # [lanes, 5] in the patch
    vertex: NDArray[np.int64]  # [lanes, 5] user's
    tet: NDArray[np.int32]  # [lanes, 2] user's
    rest: NDArray[np.float64]  # [lanes, 2, 3, 3]
    volume: NDArray[np.float64]  # [lanes, 2]
    bound: NDArray[np.float64]  # [lanes, 2]

    @classmethod
    def of(cls, plan: Arrays) -> Lanes:
        blocks = np.diff(plan.patch_block)
        patch = np.repeat(np.arange(len(blocks)), blocks * LANES)
        number = np.arange(len(patch)) - plan.patch_block[patch] * LANES
        packed = plan.pair_corner.view(np.uint32).reshape(-1, 5, LANES).transpose(0, 2, 1).reshape(-1, 5)
        slot, entry = (packed & 65535).astype(np.int64), (packed >> 16).astype(np.int64)
        rest = plan.pair_rest.reshape(-1, 5, LANES, 4).transpose(0, 2, 1, 3).reshape(-1, 20)
        return cls(
            number < plan.patch_pairs[patch],
            patch,
            slot,
            entry,
            plan.vertex_order[plan.slot_vertex[plan.patch_slot[patch][:, None] + slot]].astype(np.int64),
            plan.pair_tet.reshape(-1, 2, LANES).transpose(0, 2, 1).reshape(-1, 2),
            rest[:, :18].reshape(-1, 2, 3, 3),
            rest[:, 18:],
            plan.pair_bound.reshape(-1, 2, LANES).transpose(0, 2, 1).reshape(-1, 2),
        )

    @property
    def tet_vertices(self) -> NDArray[np.int64]:
        """User's corners of both tetrahedra [lanes, 2, 4]."""
        return self.vertex[:, [[0, 1, 2, 3], [0, 1, 2, 4]]]


@pytest.fixture(scope="module", params=CASES, ids=lambda case: f"{case[0]}, {case[1]}")
def case(request: pytest.FixtureRequest) -> tuple[SceneValues, int]:
    return values_of(request.param[0]), request.param[1]


@pytest.fixture(scope="module")
def values(case: tuple[SceneValues, int]) -> SceneValues:
    return case[0]


@pytest.fixture(scope="module")
def plan(case: tuple[SceneValues, int]) -> Arrays:
    return Arrays.of(*case)


@pytest.fixture(scope="module")
def lanes(plan: Arrays) -> Lanes:
    return Lanes.of(plan)


def rows_of(plan: Arrays) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Patch, first entry and number of entries of every slot."""
    packed = plan.slot_row.view(np.uint32)
    patch = np.repeat(np.arange(len(plan.patch_pairs)), np.diff(plan.patch_slot))
    return patch, (packed & 65535).astype(np.int64), (packed >> 16).astype(np.int64)


def entries_of(plan: Arrays) -> NDArray[np.int64]:
    """Entries of each patch, padding included: slices of eight slots, as many rows as the busiest needs."""
    _, _, forces = rows_of(plan)
    slots = [forces[a:b] for a, b in zip(plan.patch_slot[:-1], plan.patch_slot[1:], strict=True)]
    return np.array([sum(SLICE * s[i : i + SLICE].max() for i in range(0, len(s), SLICE)) for s in slots])


def test_every_tetrahedron_is_in_one_lane(lanes: Lanes, values: SceneValues) -> None:
    both = lanes.tet[lanes.live]
    assert (both[:, 0] >= 0).all()
    np.testing.assert_array_equal(np.sort(both[both >= 0]), np.arange(len(values.tets)))
    real = lanes.live[:, None] & (lanes.tet >= 0)
    np.testing.assert_array_equal(
        np.sort(lanes.tet_vertices[real], axis=1), np.sort(values.tets[lanes.tet[real]], axis=1)
    )


def test_rest_matrices_fit_the_order_of_corners(lanes: Lanes, values: SceneValues) -> None:
    """F of a deformed body is that of the user's tetrahedra, also where the corners wind the other way."""
    noise = np.random.default_rng(0).standard_normal(values.rest_positions.shape)
    x = values.rest_positions + 0.01 * noise

    def gradient(positions: NDArray[np.float64], corners: NDArray[np.int64]) -> NDArray[np.float64]:
        p = positions[corners]
        return np.swapaxes(p[..., 1:, :] - p[..., :1, :], -1, -2)

    rest = np.linalg.inv(gradient(values.rest_positions, values.tets))
    expected = gradient(x, values.tets) @ rest
    got = gradient(x, lanes.tet_vertices) @ lanes.rest
    real = lanes.live[:, None] & (lanes.tet >= 0)
    who = lanes.tet[real]
    # rounding grows with the condition of the rest shape, up to 1e4 in slivers
    scale = np.abs(expected[who]).max() * np.linalg.cond(rest[who])[:, None, None]
    assert (np.abs(got[real] - expected[who]) <= 1e-14 * scale).all()
    shape = elements(values.rest_positions, values.tets)
    np.testing.assert_allclose(lanes.volume[real], shape.volumes[who], rtol=1e-11)
    np.testing.assert_allclose(lanes.bound[real], shape.spread[who], rtol=1e-9)


def test_what_is_missing_strains_but_weighs_nothing(lanes: Lanes, plan: Arrays) -> None:
    single = lanes.live & (lanes.tet[:, 1] < 0)
    np.testing.assert_array_equal(lanes.slot[single, 4], lanes.slot[single, 3])
    np.testing.assert_array_equal(lanes.rest[single, 1], lanes.rest[single, 0])
    np.testing.assert_array_equal(lanes.bound[single, 1], lanes.bound[single, 0])
    np.testing.assert_array_equal(lanes.entry == NONE, ~lanes.live[:, None] | (single[:, None] & (np.arange(5) == 4)))
    np.testing.assert_array_equal(lanes.volume == 0.0, ~lanes.live[:, None] | (lanes.tet < 0))
    last = plan.patch_block[lanes.patch] * LANES + plan.patch_pairs[lanes.patch] - 1
    padding = ~lanes.live
    assert (lanes.tet[padding] == -1).all()
    np.testing.assert_array_equal(lanes.slot[padding], lanes.slot[last[padding]])
    np.testing.assert_array_equal(lanes.rest[padding], lanes.rest[last[padding]])
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


def test_parts_hold_each_free_vertex_once(plan: Arrays, values: SceneValues) -> None:
    held = np.isin(values.component, values.component[values.pin_vertices])
    names = ("slot_piece", "patch_part", "part_start", "part_slot", "piece_start", "piece_part")
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
    assert len(plan.part_start) == len(plan.piece_part) + 1
    assert (np.diff(plan.part_start) > 0).all()
    part_patch = np.repeat(np.arange(len(plan.patch_pairs)), np.diff(plan.patch_part))
    seen = []
    for piece, (a, b) in enumerate(zip(plan.piece_start[:-1], plan.piece_start[1:], strict=True)):
        parts = plan.piece_part[a:b]
        seen += list(parts)
        assert (np.diff(part_patch[parts]) > 0).all()
        for part in parts:
            slots = plan.part_slot[plan.part_start[part] : plan.part_start[part + 1]]
            assert (np.diff(slots) > 0).all()
            assert (slots >= plan.patch_slot[part_patch[part]]).all()
            assert (slots < plan.patch_slot[part_patch[part] + 1]).all()
            assert (plan.slot_piece[slots] == piece).all()
    assert sorted(seen) == list(range(len(plan.piece_part)))
    moving = plan.slot_piece >= 0
    pairs = np.unique(np.stack([plan.slot_piece[moving], values.component[user[moving]]]), axis=1)
    np.testing.assert_array_equal(pairs[0], np.arange(len(plan.piece_start) - 1))  # one component each
    assert len(np.unique(pairs[1])) == len(pairs[1])


def test_pins_know_their_vertices(plan: Arrays, values: SceneValues) -> None:
    np.testing.assert_array_equal(plan.vertex_order[plan.pin_vertex], values.pin_vertices)
    if len(values.pin_vertices) == 0:
        assert len(plan.vertex_pin) == 0
        return
    expected = np.full(len(plan.vertex_order), -1)
    expected[plan.pin_vertex] = np.arange(len(values.pin_vertices))
    np.testing.assert_array_equal(plan.vertex_pin, expected)


def test_sizes_count_the_arrays(plan: Arrays, values: SceneValues) -> None:
    shared = np.diff(plan.patch_slot) - np.diff(plan.patch_vertex)
    free = np.setdiff1d(values.component, values.component[values.pin_vertices])
    expected = {
        "kernel": 1,
        "vertices": len(values.rest_positions),
        "tets": len(values.tets),
        "pins": len(values.pin_vertices),
        "pieces": len(free),
        "blocks": len(plan.pair_tet),
        "patches": len(plan.patch_pairs),
        "slots": len(plan.slot_vertex),
        "shared": len(plan.shared_start) - 1,
        "parts": len(plan.piece_part),
        "most_slots": np.diff(plan.patch_slot).max(),
        "most_pairs": plan.patch_pairs.max(),
        "most_entries": entries_of(plan).max(),
        "most_shared": shared.max(),
        "most_parts": np.diff(plan.patch_part).max() if len(free) else 0,
    }
    assert dict(zip(SIZES, plan.sizes.tolist(), strict=True)) == expected


def test_arrays_are_those_of_the_table(case: tuple[SceneValues, int]) -> None:
    kinds = {"real": torch.float32, "int32": torch.int32}
    tensors = compile_device_plan(*case, 0, torch.float32)
    for row, array in zip(DEVICE_PLAN_TABLE, tensors, strict=True):
        assert array.dtype == kinds[row.type], row.name
        assert array.is_contiguous(), row.name
        assert array.device.type == "cpu", row.name
        assert array.shape[1:] == ((row.width,) if row.width > 1 else ()), row.name


def test_threads_do_not_matter() -> None:
    values = values_of("delaunay")
    before = torch.get_num_threads()
    plans = []
    try:
        for threads in (1, 2, 2):
            torch.set_num_threads(threads)
            plans.append(compile_device_plan(values, 9, 2, torch.float64))
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
            _C.build_device_plan(vertices, tets, 1, piece, lambda done: None)
        assert _C.build_device_plan(vertices, tets, 2, piece, lambda done: None)["sizes"][SIZES.index("patches")] == 2


def test_bad_arguments_are_refused() -> None:
    values = values_of("one tet")
    x, tets, piece = values.rest_positions, values.tets, np.zeros(4, dtype=np.int32)
    for patches in (0, -1, 2):
        with pytest.raises(ValueError, match=rf"patches must lie in 1\.\.1, the number of tetrahedra, got {patches}"):
            compile_device_plan(values, patches, 0, torch.float32)
    with pytest.raises(ValueError, match="kernel must be 0, 1 or 2, got 3"):
        compile_device_plan(values, 1, 3, torch.float32)
    with pytest.raises(ValueError, match=r"dtype must be torch\.float32 or torch\.float64, got torch\.float16"):
        compile_device_plan(values, 1, 0, torch.float16)
    for bad in (4, -1, 2**40):
        with pytest.raises(IndexError, match="tets refer to vertices that positions does not have"):
            _C.build_device_plan(x, np.array([[0, 1, 2, bad]]), 1, piece, lambda done: None)
    with pytest.raises(ValueError, match=r"piece must be int32 \[vertices\], a number for each row of positions"):
        _C.build_device_plan(x, tets, 1, piece[:3], lambda done: None)
    for number in (-2, 4):
        with pytest.raises(ValueError, match="piece must hold numbers of pieces, counted from 0, or -1"):
            _C.build_device_plan(x, tets, 1, np.full(4, number, dtype=np.int32), lambda done: None)
