"""The plan of a cluster: patches that own vertices, and have all that these need. In NumPy, on no GPU."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from device_plans import CLUSTER, MOST_CLUSTER, NONE, SLICE, Arrays, Lanes, rows_of, values_of
from numpy.typing import NDArray

from torchpd.plan.gpu_plan import compile_device_plan
from torchpd.scene import SceneValues

CASES = (
    ("one tet", 1),
    ("held box", 1),
    ("held box", 2),
    ("held box", 16),
    ("held and free", 7),
    ("pieces", 5),  # most cuts lie within a piece, some between two
    ("slivers", 16),
    ("delaunay", 2),
    ("delaunay", 13),
    ("cones", 16),  # one patch has all tetrahedra, and its vertex copies in all others
)


@dataclass(frozen=True)
class Cut:
    """What the patches must have, from the mesh and from which of them owns each vertex: nothing else of the plan."""

    owner: NDArray[np.int64]  # [vertices] patch, by the user's numbers
    tets: NDArray[np.int64]  # [tets, 4]

    @classmethod
    def of(cls, plan: Arrays, values: SceneValues) -> Cut:
        owner = np.full(len(values.rest_positions), -1, dtype=np.int64)
        for p, (a, b) in enumerate(zip(plan.patch_vertex[:-1], plan.patch_vertex[1:], strict=True)):
            owner[plan.vertex_order[a:b]] = p
        return cls(owner, values.tets)

    def tets_of(self, patch: int) -> NDArray[np.int64]:
        """All that touch a vertex of the patch."""
        return np.flatnonzero((self.owner[self.tets] == patch).any(axis=1))

    def others_of(self, patch: int) -> NDArray[np.int64]:
        """Vertices of those tetrahedra that other patches own."""
        touched = np.unique(self.tets[self.tets_of(patch)])
        return touched[self.owner[touched] != patch]


@pytest.fixture(name="case", scope="module", params=CASES, ids=lambda case: f"{case[0]}, {case[1]}")
def fixture_case(request: pytest.FixtureRequest) -> tuple[str, int]:
    chosen: tuple[str, int] = request.param
    return chosen


@pytest.fixture(name="values", scope="module")
def fixture_values(case: tuple[str, int]) -> SceneValues:
    return values_of(case[0])


@pytest.fixture(name="plan", scope="module")
def fixture_plan(case: tuple[str, int], values: SceneValues) -> Arrays:
    return Arrays.of(values, case[1], CLUSTER)


@pytest.fixture(name="lanes", scope="module")
def fixture_lanes(plan: Arrays) -> Lanes:
    return Lanes.of(plan)


@pytest.fixture(name="cut", scope="module")
def fixture_cut(plan: Arrays, values: SceneValues) -> Cut:
    return Cut.of(plan, values)


def patches(plan: Arrays) -> list[tuple[int, int, int, int]]:
    """Number, first slot, first slot of the others' vertices, and end of every patch."""
    interior, first = np.diff(plan.patch_vertex), plan.patch_slot
    return [(p, int(first[p]), int(first[p] + count), int(first[p + 1])) for p, count in enumerate(interior)]


def test_every_vertex_has_one_owner(case: tuple[str, int], plan: Arrays, values: SceneValues) -> None:
    np.testing.assert_array_equal(np.sort(plan.vertex_order), np.arange(len(values.rest_positions)))
    assert plan.patch_vertex[0] == 0
    assert plan.patch_vertex[-1] == len(values.rest_positions)
    assert len(plan.patch_vertex) == case[1] + 1
    assert (np.diff(plan.patch_vertex) > 0).all()
    assert plan.shared_start.tolist() == [0]
    assert len(plan.shared_slot) == len(plan.shared_place) == len(plan.slot_sender) == 0


def test_a_patch_has_the_tetrahedra_of_its_vertices(lanes: Lanes, cut: Cut, plan: Arrays, values: SceneValues) -> None:
    np.testing.assert_array_equal(
        np.sort(lanes.tet_vertices[lanes.real], axis=1), np.sort(values.tets[lanes.tet[lanes.real]], axis=1)
    )
    for p in range(len(plan.patch_pairs)):
        mine = lanes.real & (lanes.patch == p)[:, None]
        np.testing.assert_array_equal(np.sort(lanes.tet[mine]), cut.tets_of(p))


def test_every_tetrahedron_is_counted_once(lanes: Lanes, cut: Cut, plan: Arrays) -> None:
    np.testing.assert_array_equal(np.sort(lanes.tet[lanes.counted]), np.arange(len(cut.tets)))
    owners = np.sort(cut.owner[cut.tets], axis=1)
    several = 1 + (np.diff(owners, axis=1) > 0).sum(axis=1)
    assert (plan.pair_tet < -1).sum() == (several - 1).sum()


def test_slots_hold_own_vertices_and_then_what_they_need(plan: Arrays, cut: Cut) -> None:
    for p, first, others, end in patches(plan):
        np.testing.assert_array_equal(
            plan.slot_vertex[first:others], np.arange(plan.patch_vertex[p], plan.patch_vertex[p + 1])
        )
        np.testing.assert_array_equal(np.sort(plan.vertex_order[plan.slot_vertex[others:end]]), cut.others_of(p))
        assert (plan.slot_row[first:others] >= 0).all()
        assert (plan.slot_row[others:end] < 0).all()


def copies_of(row: NDArray[np.int32]) -> list[tuple[int, int]]:
    """Patch and slot in it of every copy of a vertex, from a row of slot_copy."""
    assert (row >= -1).all()
    return [(int(name) >> 16, int(name) & 65535) for name in row if name >= 0]


def test_copies_are_the_slots_of_others(plan: Arrays, cut: Cut) -> None:
    assert plan.slot_copy.shape == (len(plan.vertex_order), MOST_CLUSTER)
    found = [set[tuple[int, int]]() for _ in plan.vertex_order]
    for p, first, others, end in patches(plan):
        for slot in range(others, end):
            found[plan.slot_vertex[slot]].add((p, slot - first))
    for v, row in enumerate(plan.slot_copy):
        named = copies_of(row)
        assert len(named) == len(set(named))
        assert set(named) == found[v]
        # those that a neighbour of the vertex belongs to
        user = plan.vertex_order[v]
        near = cut.owner[cut.tets[(cut.tets == user).any(axis=1)]]
        assert {p for p, _ in named} == set(near.reshape(-1).tolist()) - {int(cut.owner[user])}


def test_an_iteration_needs_no_other_patch(plan: Arrays, lanes: Lanes, cut: Cut, values: SceneValues) -> None:
    """Owners send what their vertices are: each patch then knows all of its own forces, and no sum is sent."""
    rng = np.random.default_rng(0)
    user = plan.vertex_order[plan.slot_vertex]
    x = rng.standard_normal(values.rest_positions.shape)
    seen = np.full((len(user), 3), np.nan)
    for p, first, others, _ in patches(plan):
        seen[first:others] = x[user[first:others]]
        for slot in range(first, others):
            for other, place in copies_of(plan.slot_copy[plan.slot_vertex[slot]]):
                assert other != p
                seen[plan.patch_slot[other] + place] = seen[slot]
    np.testing.assert_array_equal(seen, x[user])

    push = rng.integers(-1000, 1000, values.tets.shape).astype(np.float64)  # sums are exact
    expected = np.zeros(len(values.rest_positions))
    np.add.at(expected, values.tets, push)
    force = np.zeros(lanes.entry.shape)
    for which, corners in enumerate(([0, 1, 2, 3], [0, 1, 2, 4])):
        real = lanes.live & (lanes.tet[:, which] >= 0)
        tet = lanes.tet[real, which]
        at = (values.tets[tet][:, None, :] == lanes.vertex[real][:, corners][:, :, None]).argmax(axis=-1)
        force[np.ix_(real, corners)] += np.take_along_axis(push[tet], at, axis=1)
    has = lanes.entry != NONE
    buffer = np.full((len(plan.patch_pairs), NONE), np.nan)
    buffer[np.broadcast_to(lanes.patch[:, None], has.shape)[has], lanes.entry[has]] = force[has]
    _, entry, forces = rows_of(plan)
    for p, first, others, _ in patches(plan):
        for slot in range(first, others):
            mine = buffer[p, entry[slot] : entry[slot] + SLICE * forces[slot] : SLICE]
            assert mine.sum() == expected[user[slot]]


def test_parts_are_the_free_vertices_that_a_patch_owns(plan: Arrays, cut: Cut, values: SceneValues) -> None:
    held = np.isin(values.component, values.component[values.pin_vertices])
    if held.all():
        assert len(plan.part_slot) == len(plan.slot_piece) == 0
        return
    user = plan.vertex_order[plan.slot_vertex]
    np.testing.assert_array_equal(plan.slot_piece < 0, held[user])
    np.testing.assert_array_equal(np.sort(user[plan.part_slot]), np.flatnonzero(~held))
    part_patch = np.repeat(np.arange(len(plan.patch_pairs)), np.diff(plan.patch_part))
    patch, _, _ = rows_of(plan)
    for part, (a, b) in enumerate(zip(plan.part_start[:-1], plan.part_start[1:], strict=True)):
        slots = plan.part_slot[a:b]
        assert len(slots) > 0
        assert (patch[slots] == part_patch[part]).all()
        assert (cut.owner[user[slots]] == part_patch[part]).all()
        assert len(np.unique(values.component[user[slots]])) == len(np.unique(plan.slot_piece[slots])) == 1


def test_pins_know_their_vertices(plan: Arrays, values: SceneValues) -> None:
    np.testing.assert_array_equal(plan.vertex_order[plan.pin_vertex], values.pin_vertices)


def test_more_patches_than_a_cluster_has_are_refused() -> None:
    values = values_of("held box")
    with pytest.raises(ValueError, match=r"patches of kernel 1, .* 1\.\.16, got 17"):
        compile_device_plan(values, 17, CLUSTER, torch.float32)
