"""The compiled scene: the same mesh in another order, in patches that cover it once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from cases import beam, beam_mesh, box, sliver_mesh, slivers
from device_plans import face_frames
from numpy.typing import NDArray

import torchpd as pd
from torchpd import _C
from torchpd.common.tables import PLAN_TABLE
from torchpd.plan import Plan, compile_plan
from torchpd.plan.material import material_of, material_rows
from torchpd.reference import elements
from torchpd.scene import SceneValues

LANES = 16


def values_of(name: str) -> SceneValues:
    if name == "beam":
        return beam(1e5).scene.values()
    if name == "slivers":
        return slivers().scene.values()
    if name == "one tet":
        mesh = pd.TetMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]])
        return pd.Scene(pd.Solid(mesh, 1e5)).values()
    if name == "shuffled":
        mesh = beam_mesh(jitter=0.2)
        rng = np.random.default_rng(0)
        order, tets = rng.permutation(len(mesh.vertices)), rng.permutation(mesh.tets)
        place = np.argsort(order)
        return pd.Scene(pd.Solid(pd.TetMesh(mesh.vertices[order], place[tets]), 1e5)).values()
    vertices, tets = box((0.4, 0.2, 0.2), (4, 2, 2))
    pieces = [pd.Solid(pd.TetMesh(vertices + [0.0, y, 0.0], tets), 1e5) for y in (0.0, 1.0, 2.0)]
    return pd.Scene(*pieces, pd.Pin(pieces[0], [0]), pd.Pin(pieces[2], [7], 1e3)).values()


SCENES = ("beam", "slivers", "one tet", "shuffled", "three pieces")


@pytest.fixture(scope="module", params=SCENES)
def values(request: pytest.FixtureRequest) -> SceneValues:
    return values_of(request.param)


@pytest.fixture(scope="module", params=[None, 16, 64, 8192], ids=["chosen", "patch 16", "patch 64", "patch 8192"])
def plan(request: pytest.FixtureRequest, values: SceneValues) -> Plan:
    return compile_plan(values, dtype=torch.float64, patch_size=request.param)


def real_lanes(plan: Plan) -> NDArray[np.bool_]:
    """Lanes that hold an element; the others are padding of volume zero."""
    return (plan.tet_volume.numpy() > 0.0).reshape(-1)


def by_lane(plan: Plan, name: str, width: int) -> NDArray[np.float64]:
    """[lanes, width] of an array that is stored entry by entry."""
    array = getattr(plan, name).numpy()
    lanes: NDArray[np.float64] = array.reshape(len(array), width, LANES).transpose(0, 2, 1).reshape(-1, width)
    return lanes


def corner_vertices(plan: Plan) -> NDArray[np.int64]:
    """User's number of the corners of every lane [lanes, 4]: through the slots of its patch."""
    corners = by_lane(plan, "tet_corner", 4).astype(np.int64)
    blocks = np.diff(plan.patch_block.numpy())
    first = np.repeat(plan.patch_slot.numpy()[:-1], blocks * LANES)
    order: NDArray[np.int64] = plan.vertex_order.numpy().astype(np.int64)
    return order[plan.slot_vertex.numpy()[corners + first[:, None]]]


def test_orders_are_permutations(plan: Plan, values: SceneValues) -> None:
    order = plan.vertex_order.numpy()
    np.testing.assert_array_equal(np.sort(order), np.arange(len(values.rest_positions)))
    lanes = plan.tet_order.numpy().reshape(-1)
    np.testing.assert_array_equal(np.sort(lanes[real_lanes(plan)]), np.arange(len(values.tets)))
    np.testing.assert_array_equal(order[plan.pin_vertex.numpy()], values.pin_vertices)


def test_lanes_hold_their_elements(plan: Plan, values: SceneValues) -> None:
    """Also padding repeats a whole element of its patch, so that it strains like one, but weighs nothing."""
    shape = elements(values.rest_positions, values.tets)
    who = plan.tet_order.numpy().reshape(-1)
    assert who.min() >= 0
    assert who.max() < len(values.tets)
    # corners may be renumbered as long as the rest matrix is that of the same order
    corners = corner_vertices(plan)
    np.testing.assert_array_equal(np.sort(corners, axis=1), np.sort(values.tets[who], axis=1))
    edges = np.swapaxes(values.rest_positions[corners[:, 1:]] - values.rest_positions[corners[:, :1]], 1, 2)
    numbers, inverse = by_lane(plan, "tet_rest", 6), np.zeros((len(edges), 3, 3))
    rows, columns = [0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]
    inverse[:, rows, columns] = numbers
    # in the frame of the face of corners 0, 1 and 2
    product = face_frames(edges) @ edges @ inverse
    # inverse of a matrix of condition up to 1e3 on slivers
    np.testing.assert_allclose(product, np.tile(np.eye(3), (len(product), 1, 1)), atol=1e-12)
    real = real_lanes(plan)
    np.testing.assert_allclose(plan.tet_volume.numpy().reshape(-1)[real], shape.volumes[who[real]], rtol=1e-12)
    # l_e is between 4/3 and 4; flat elements lose digits of their unit normals to the condition
    np.testing.assert_allclose(plan.tet_bound.numpy().reshape(-1)[real], shape.eigenvalue_bound[who[real]], rtol=1e-10)
    assert bool(plan.tet_bound.isfinite().all())


def test_bounds_of_regular_tetrahedra() -> None:
    """Where the largest eigenvalue is a multiple one, as of shapes with a threefold axis, it is no less certain."""
    turns = 2.0 * np.pi * np.arange(3)[:, None] / 3.0
    base = np.concatenate([np.cos(turns), np.sin(turns), 0.0 * turns], axis=1)
    corners = [np.concatenate([base, [[0.0, 0.0, height]]]) for height in (0.1, 1.0, np.sqrt(2.0), 1.5, 20.0)]
    turn = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    turn[0] *= np.linalg.det(turn)
    for vertices in [*corners, *(shape @ turn.T for shape in corners)]:
        values = pd.Scene(pd.Solid(pd.TetMesh(vertices, [[0, 1, 2, 3]]), 1e5)).values()
        expected = elements(values.rest_positions, values.tets).eigenvalue_bound[0]
        bounds = compile_plan(values, dtype=torch.float64).tet_bound.numpy().reshape(-1)
        np.testing.assert_allclose(bounds[0], expected, rtol=1e-13)


def test_patches_cover_slots_blocks_and_vertices(plan: Plan, values: SceneValues) -> None:
    blocks, slots, interior = (getattr(plan, name).numpy() for name in ("patch_block", "patch_slot", "patch_vertex"))
    for ends, last in ((blocks, len(plan.tet_order)), (slots, len(plan.slot_vertex))):
        assert ends[0] == 0
        assert ends[-1] == last
        assert (np.diff(ends) > 0).all()
    assert interior[0] == 0
    assert (np.diff(interior) >= 0).all()
    corners = by_lane(plan, "tet_corner", 4).reshape(-1, LANES * 4)
    for patch in range(plan.patches):
        mine = plan.slot_vertex.numpy()[slots[patch] : slots[patch + 1]]
        inside = np.arange(interior[patch], interior[patch + 1])
        # interior vertices first, in their own order; then shared ones, each once
        np.testing.assert_array_equal(mine[: len(inside)], inside)
        assert (mine[len(inside) :] >= interior[-1]).all()
        assert len(np.unique(mine)) == len(mine)
        used = np.unique(corners[blocks[patch] : blocks[patch + 1]])
        np.testing.assert_array_equal(used, np.arange(len(mine)))


def test_shared_vertices_list_all_their_slots_in_patch_order(plan: Plan) -> None:
    first_shared = int(plan.patch_vertex[-1])
    start, slot = plan.shared_start.numpy(), plan.shared_slot.numpy()
    assert start[0] == 0
    assert len(start) - 1 + first_shared == plan.vertices
    vertex = plan.slot_vertex.numpy()
    for number in range(len(start) - 1):
        mine = slot[start[number] : start[number + 1]]
        np.testing.assert_array_equal(mine, np.flatnonzero(vertex == first_shared + number))
        assert len(mine) >= 2


def test_loose_pieces_are_numbered(plan: Plan, values: SceneValues) -> None:
    order = plan.vertex_order.numpy()
    group = np.empty(len(order), dtype=np.int64)
    group[order] = plan.vertex_component.numpy()
    hard = values.pin_vertices[np.isinf(values.pin_stiffness)]
    held = np.zeros(len(order), dtype=bool)
    for number in np.unique(values.component[hard]):
        points = values.rest_positions[hard[values.component[hard] == number]]
        held |= (values.component == number) & (np.linalg.matrix_rank(points - points[0]) > 1)
    np.testing.assert_array_equal(group < 0, held)
    numbers = np.unique(group[group >= 0])
    np.testing.assert_array_equal(numbers, np.arange(int(plan.sizes[3])))
    assert int(plan.sizes[-1]) == len(numbers)  # of tetrahedra alone
    for number in numbers:
        assert len(np.unique(values.component[group == number])) == 1


def test_order_of_the_user_does_not_matter() -> None:
    """A shuffled mesh is the same body: the same step to rounding, vertex by vertex."""
    mesh = sliver_mesh((5, 3, 3))
    rng = np.random.default_rng(0)
    order, tet_order = rng.permutation(len(mesh.vertices)), rng.permutation(len(mesh.tets))
    tets = np.argsort(order)[mesh.tets[tet_order]][:, [1, 2, 0, 3]]  # an even turn of the corners too
    youngs = 10.0 ** rng.uniform(4.0, 6.0, len(mesh.tets))
    plain = pd.Simulator(pd.Scene(pd.Solid(mesh, youngs)), 1 / 60, 20, dtype=torch.float64)
    turned = pd.Simulator(
        pd.Scene(pd.Solid(pd.TetMesh(mesh.vertices[order], tets), youngs[tet_order])), 1 / 60, 20, dtype=torch.float64
    )
    push = torch.from_numpy(rng.standard_normal((1, len(order), 3)))
    state = pd.State(plain.rest_state().positions + 0.01 * push, push)
    mixed = pd.State(state.positions[:, order], state.velocities[:, order])
    one, other = plain(state), turned(mixed)
    # sums in another order: some fifty operations, extrapolated twenty times (k^2)
    limit = 50 * 400 * torch.finfo(torch.float64).eps
    assert float((one.positions[:, order] - other.positions).abs().max()) <= limit


def test_patch_size_does_not_matter() -> None:
    values = values_of("slivers")
    material, x = material_rows(material_of(values, torch.float64)), torch.from_numpy(values.rest_positions)[None]
    x = x + 0.01 * torch.randn(x.shape, dtype=x.dtype, generator=torch.Generator().manual_seed(0))
    plans = [compile_plan(values, dtype=torch.float64, patch_size=size) for size in (16, 48, 512, 8192)]
    assert len({plan.patches for plan in plans}) == 4
    gradients = [torch.ops.torchpd.gradient(x, material, list(plan.arrays)) for plan in plans]
    for other in gradients[1:]:
        # sums of about a hundred corner forces in another order
        assert float((gradients[0] - other).abs().max()) <= 100 * torch.finfo(x.dtype).eps * float(
            gradients[0].abs().max()
        )


def test_arrays_are_those_of_the_table(plan: Plan) -> None:
    assert len(plan.arrays) == len(PLAN_TABLE)
    kinds = {"real": torch.float64, "int32": torch.int32, "int16": torch.int16}
    for row, array in zip(PLAN_TABLE, plan.arrays, strict=True):
        assert getattr(plan, row.name) is array
        assert array.dtype == kinds[row.type], row.name
        assert array.is_contiguous(), row.name
        assert array.shape[1:] == ((row.width,) if row.width > 1 else ()), row.name
    assert plan.bytes == sum(array.numel() * array.element_size() for array in plan.arrays)
    with pytest.raises(AttributeError, match="Plan has no array 'tets'; it has sizes, vertex_order"):
        plan.tets  # noqa: B018


def test_plan_to_keeps_integers(plan: Plan) -> None:
    single = plan.to(dtype=torch.float32)
    assert single.dtype == torch.float32
    for row, one, other in zip(PLAN_TABLE, plan.arrays, single.arrays, strict=True):
        if row.type == "real":
            np.testing.assert_array_equal(one.float(), other)
        else:
            assert torch.equal(one, other)
            assert one.dtype == other.dtype


def test_sizes_count_what_the_arrays_hold(plan: Plan, values: SceneValues) -> None:
    slots, components = plan.patch_slot.diff(), int(plan.vertex_component.max()) + 1
    assert plan.sizes.tolist() == [
        len(values.rest_positions), len(values.tets), len(values.pin_vertices),
        components, len(plan.tet_rest), plan.patches, len(plan.slot_vertex),
        plan.vertices - int(plan.patch_vertex[-1]), int(slots.max()), 1, components,
    ]  # fmt: skip


def test_sizes_stay_on_the_cpu(plan: Plan) -> None:
    moved = plan.to("meta")
    assert [array.device.type for array in moved.arrays] == ["cpu"] + ["meta"] * (len(PLAN_TABLE) - 1)
    assert moved.device.type == "meta"


def test_compiling_twice_gives_the_same_plan(values: SceneValues) -> None:
    one, other = (compile_plan(values, dtype=torch.float64) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(one.arrays, other.arrays, strict=True))


def test_the_number_of_threads_changes_nothing(values: SceneValues) -> None:
    plans, before = [], torch.get_num_threads()
    for threads in (1, 3):
        try:
            torch.set_num_threads(threads)
            plans.append(compile_plan(values, dtype=torch.float64, patch_size=16))
        finally:
            torch.set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(*(plan.arrays for plan in plans), strict=True))


def test_large_meshes_show_progress(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    values = values_of("beam")
    monkeypatch.setattr("torchpd.plan.cpu_plan._WORTH_A_BAR", 1000)
    compile_plan(values, progress=False)
    assert capsys.readouterr().err == ""
    compile_plan(values)
    assert "compiling the scene" in capsys.readouterr().err


def test_indices_are_checked_before_memory_is_touched() -> None:
    vertices, tets = box((0.1, 0.1, 0.1), (1, 1, 1))
    for bad in (8, -1, 2**40):
        wrong = tets.copy()
        wrong[3, 2] = bad
        with pytest.raises(IndexError, match=r"tets .*positions"):
            _C.build_plan(vertices, wrong, [], None, 128, lambda done: None)
    with pytest.raises(ValueError, match=r"positions .*float64 \[vertices, 3\]"):
        _C.build_plan(vertices[:, :2].copy(), tets, [], None, 128, lambda done: None)
    with pytest.raises(ValueError, match=r"tets .*int64 \[count > 0, 4\]"):
        _C.build_plan(vertices, tets[:0], [], None, 128, lambda done: None)


def test_a_mesh_that_32_bits_do_not_count_is_refused_unread(tmp_path: Path) -> None:
    """Files without contents stand for arrays of gigabytes."""
    vertices, tets = box((0.1, 0.1, 0.1), (1, 1, 1))
    most = 1 << 28
    many_tets = np.memmap(tmp_path / "tets", np.int64, "w+", shape=(most + 1, 4))
    many_vertices = np.memmap(tmp_path / "vertices", np.float64, "w+", shape=(most + 1, 3))
    for x, t in ((vertices, many_tets), (many_vertices, tets)):
        with pytest.raises(
            ValueError,
            match=rf"up to 2\^28 = {most} vertices and tetrahedra.* got {len(x)} and {len(t)}; take a coarser",
        ):
            _C.build_plan(x, t, [], None, 128, lambda done: None)
