"""`ContactPlan`: surfaces, trees over their primitives, thickness, and pairs that rest near each other."""

from __future__ import annotations

import time
from itertools import combinations
from typing import Any

import numpy as np
import pytest
import torch
from sheets import sheet

import torchpd as pd
from torchpd.geometry.closest_points import segment_distances, triangle_distances
from torchpd.plan.contact_plan import ContactPlan, contact_plan
from torchpd.plan.contact_tree import Boxes, ContactTree, contact_tree, meeting


def plan_of(*parts: Any) -> ContactPlan:
    return contact_plan(pd.Scene(*parts).values())


def cube(cells: int = 2, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> pd.Solid:
    return pd.Solid(pd.shapes.box((0.1, 0.1, 0.1), (cells, cells, cells)).translated(offset), 1e5)


def square(height: float) -> tuple[Any, Any]:
    """Two triangles of a unit square at y = height."""
    return np.array([[0.0, height, 0], [1, height, 0], [1, height, 1], [0, height, 1]]), [[0, 2, 1], [0, 3, 2]]


def layers(*heights: float) -> pd.Cloth:
    """One sheet of separate unit squares, the next one turned by a quarter so that diagonals cross."""
    vertices, triangles = [], []
    for number, height in enumerate(heights):
        points, faces = square(height)
        vertices.append(np.roll(points, number, axis=0))
        triangles.append(np.array(faces) + 4 * number)
    return pd.Cloth(pd.TriMesh(np.concatenate(vertices), np.concatenate(triangles)), 1e5, 1e-3, 0.2)


def test_the_surface_of_a_cube_on_a_table() -> None:
    """26 of 27 vertices of a 2 x 2 x 2 cube lie on its surface: 48 triangles and 72 edges (Euler: 2)."""
    solid = cube()
    table = pd.Collider(pd.TriMesh(*square(0.0)), friction=0.5, pose=(0.25, -0.5, 0, 1, 0, 0, 0))
    left = np.flatnonzero(solid.mesh.vertices[:, 0] == 0.0)
    plan = plan_of(table, solid, pd.Pin(solid, left), pd.Pin(solid, [26], 1e3), pd.Contact(thickness=1e-3))
    assert [len(of) for of in (plan.vertices, plan.triangles, plan.edges)] == [26 + 4, 48 + 2, 72 + 5]
    assert 13 not in plan.vertices  # the middle
    assert plan.edges[-5:].tolist() == [[27, 28], [27, 29], [27, 30], [28, 29], [29, 30]]
    assert plan.edges[:3].tolist() == [[0, 1], [0, 3], [0, 4]]
    assert (plan.edges[:, 0] < plan.edges[:, 1]).all()
    assert plan.body.tolist() == [0] * 27 + [1] * 4
    assert plan.collider.tolist() == [-1] * 27 + [0] * 4
    assert np.flatnonzero(plan.kinematic).tolist() == [*range(9), 27, 28, 29, 30]  # springs leave a vertex free
    np.testing.assert_array_equal(plan.rest[27:], table.mesh.vertices + [0.25, -0.5, 0])
    np.testing.assert_array_equal(plan.points, table.mesh.vertices)
    assert plan.poses.tolist() == [[0.25, -0.5, 0, 1, 0, 0, 0]]
    # 48 half diagonals and full edges of .05: a third is a diagonal
    mean = (2 + np.sqrt(2)) / 3 * 0.05
    np.testing.assert_allclose(plan.cell, [*[mean] * 27, *[(4 + np.sqrt(2)) / 5] * 4])
    assert plan.friction.tolist() == [[0, 0.5], [0.5, 0.5]]
    assert plan.self_contact.tolist() == [True, False]
    assert (plan.thickness, plan.capacity, len(plan.near.keys)) == (1e-3, 16 * 50, 0)
    assert {str(of.dtype) for of in (plan.vertices, plan.triangles, plan.edges, plan.body, plan.collider)} == {"int32"}


def test_thickness_and_capacity_by_the_mesh() -> None:
    """A twentieth of the mean edge of the finest body; a coarse collider does not count."""
    table = pd.Collider(pd.TriMesh(*square(-1.0)))
    mean = (2 + np.sqrt(2)) / 3
    assert plan_of(cube(4), cube(2, (1, 0, 0)), table, pd.Contact()).thickness == pytest.approx(mean * 0.025 / 20)
    fine = pd.Collider(pd.shapes.box((0.01, 0.01, 0.01), (1, 1, 1)).translated((0, 5, 0)))
    assert plan_of(cube(4), fine, pd.Contact()).thickness == pytest.approx(mean * 0.01 / 20)
    assert plan_of(cube(4), table, pd.Contact(capacity=7)).capacity == 7


def test_bodies_that_take_no_part_have_no_triangles() -> None:
    first, second = cube(1), cube(1, (1, 0, 0))
    plan = plan_of(first, second, pd.Contact(second))
    assert plan.vertices.tolist() == list(range(8, 16))
    assert plan.triangles.min() == 8
    assert plan.self_contact.tolist() == [False, True]
    assert plan.cell[:8].tolist() == [0] * 8
    with pytest.raises(ValueError, match="contact_plan: values must be of a scene with Contact, got one without; add"):
        plan_of(first)


@pytest.mark.parametrize("collides", [True, False])
def test_flat_triangles_are_refused(collides: bool) -> None:
    """Altitude .01 over an edge of 1 m. Half of it is the most."""
    flat = pd.TriMesh([[0.0, 0, 0], [1, 0, 0], [0.5, 0, 0.01]], [[0, 2, 1]])
    body = pd.Collider(flat) if collides else pd.Cloth(flat, 1e5, 1e-3, 0.2)
    parts = (cube(2, (5, 0, 0)), body)
    assert plan_of(*parts, pd.Contact(thickness=0.005)).thickness == 0.005
    where = rf"a triangle, vertices \[0, 2, 1\] of body 1 \({type(body).__name__}\)"
    words = rf"Contact\.thickness must be at most 0\.005 m, half of the least altitude of {where}"
    with pytest.raises(ValueError, match=rf"{words}, got 0\.006; lower it, or mend that triangle"):
        plan_of(*parts, pd.Contact(thickness=0.006))


def test_a_default_thickness_may_be_too_much() -> None:
    """A mean edge of .667 m beside an altitude of .01 m."""
    flat = pd.Cloth(pd.TriMesh([[0.0, 0, 0], [1, 0, 0], [0.5, 0, 0.01]], [[0, 2, 1]]), 1e5, 1e-3, 0.2)
    with pytest.raises(ValueError, match=r"at most 0\.005 m, .* of body 0 .*, got 0\.0333 by the mean edge; lower it"):
        plan_of(flat, pd.Contact())


def test_triangles_without_area_are_refused() -> None:
    line = pd.Collider(pd.TriMesh([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 2, 1]]))
    with pytest.raises(
        ValueError, match=r"must have an area, got a triangle, vertices \[0, 2, 1\] of body 1 .* without; l"
    ):
        plan_of(cube(2, (5, 0, 0)), line, pd.Contact())


@pytest.mark.parametrize(("offset", "edge"), [((0.0, 0.0, 0.0), 1.0), ((100.0, 0.0, 0.0), 1.0)])
def test_a_floor_below_rounding_is_refused(offset: tuple[float, float, float], edge: float) -> None:
    """10 eps times 64 of the largest coordinate, or 256 of the longest edge."""
    body = pd.Solid(pd.shapes.box((edge, edge, edge), (1, 1, 1)).translated(offset), 1e5)
    for dtype, eps in ((torch.float32, 2.0**-23), (torch.float64, 2.0**-52)):
        least = 10.0 * eps * max(64.0 * (offset[0] + edge), 256.0 * np.sqrt(2.0) * edge)
        plan_of(body, pd.Contact(thickness=1.01 * least)).check_resolution(dtype)
        coarse = plan_of(body, pd.Contact(thickness=0.99 * least))
        with pytest.raises(ValueError, match=r"Contact\.thickness must be at least .* in torch\.float.*, got .*origin"):
            coarse.check_resolution(dtype)


def test_parts_that_rest_nearer_than_float32_resolves_are_refused() -> None:
    plan = plan_of(layers(0.0, 1e-5), pd.Contact(thickness=0.1))
    plan.check_resolution(torch.float64)
    words = (
        r"parts of a body must rest at least .* apart .*float32, got 1e-05 m between vertices \[[0-7], .* of body 0; "
    )
    with pytest.raises(ValueError, match=rf"{words}merge"):
        plan.check_resolution(torch.float32)


def test_near_pairs_of_two_layers() -> None:
    """Unit squares .1 apart, turned: every vertex lies over corners, and edges over edges.

    Vertices: 4 of each layer over 2 triangles of the other, of which two touch a corner of one triangle only, the other
    two that of both. Edges: the 5 of one with each of 5 of the other, at .1 but for opposite sides.
    """
    plan = plan_of(layers(0.0, 0.1), pd.Contact(thickness=0.06))
    count, faces, lines = len(plan.rest), len(plan.triangles), len(plan.edges)
    points = plan.near.keys < count * faces
    vertex, triangle = np.divmod(plan.near.keys[points], faces)
    first, second = np.divmod(plan.near.keys[~points] - count * faces, lines)
    assert (points.sum(), (~points).sum()) == (12, 5 * 5 - 4)
    assert ((vertex < 4) == (triangle >= 2)).all()
    assert (first < 5).all()
    assert (second >= 5).all()
    assert (np.diff(plan.near.keys) > 0).all()
    np.testing.assert_allclose(plan.near.thickness, 0.05)
    assert not len(plan_of(layers(0.0, 0.1), pd.Contact(thickness=0.049)).near.keys)
    assert not len(plan_of(layers(0.0, 0.1), pd.Contact(thickness=0.06, self_contact=False)).near.keys)


def all_near(plan: ContactPlan) -> dict[int, float]:
    """Half distances of the near pairs of bodies that touch themselves, by all pairs."""
    found = {}
    count, faces, lines = len(plan.rest), plan.triangles, plan.edges
    candidates = [(int(v) * len(faces) + t, (v, *face)) for v in plan.vertices for t, face in enumerate(faces)]
    split = len(candidates)
    edges = combinations(range(len(lines)), 2)
    candidates += [(count * len(faces) + a * len(lines) + b, (*lines[a], *lines[b])) for a, b in edges]
    corners = np.array([four for _, four in candidates])
    x = plan.rest[corners]
    distance = np.concatenate(
        [triangle_distances(x[:split, 0], x[:split, 1:]), segment_distances(x[split:, :2], x[split:, 2:])]
    )
    body = plan.body[corners]
    own = (body == body[:, :1]).all(axis=1) & plan.self_contact[body[:, 0]]
    for (key, four), d, same in zip(candidates, distance, own, strict=True):
        if same and len(set(four)) == 4 and d < 2.0 * plan.thickness:
            found[key] = 0.5 * d
    return found


def test_near_pairs_are_all_there_are() -> None:
    """Of a rumpled sheet; those of two bodies do not count, nor of a body that does not touch itself."""
    rng = np.random.default_rng(0)
    points, triangles = sheet(cells=(6, 6))
    rumpled = np.stack([points[:, 0], 0.0 * points[:, 0], np.abs(points[:, 2] - 0.48)], axis=1)
    rumpled += rng.normal(size=rumpled.shape) * [0.01, 0.06, 0.0]
    folded = pd.Cloth(pd.TriMesh(rumpled, triangles), 1e5, 1e-3, 0.2)
    near, still = cube(2, (0.2, 0.01, 0.2)), cube(2, (0.4, 0.01, 0.2))
    plan = plan_of(near, folded, still, pd.Contact(thickness=0.015, self_contact=[near, folded]))
    expected = all_near(plan)
    bodies = plan.body[[key // len(plan.triangles) for key in expected if key < len(plan.rest) * len(plan.triangles)]]
    assert np.unique(bodies).tolist() == [1]  # the cube's parts lie farther apart
    assert len(expected) > 100
    np.testing.assert_array_equal(plan.near.keys, sorted(expected))
    np.testing.assert_allclose(plan.near.thickness, [expected[key] for key in plan.near.keys], rtol=1e-9)


def test_rest_distance_zero_is_refused_with_the_vertices() -> None:
    """Layers that touch, after a body with 8 vertices: the numbers are those of the mesh."""
    parts = cube(1, (5, 0, 0)), layers(0.0, 0.0)
    words = (
        r"must be apart at rest, got distance 0 between vertices \[[0-7], [0-7], [0-7], [0-7]\] of body 1 \(33 pairs"
    )
    with pytest.raises(ValueError, match=rf"{words} in all\); merge the vertices, .*self_contact"):
        plan_of(*parts, pd.Contact(thickness=1e-3))
    assert not len(plan_of(*parts, pd.Contact(thickness=1e-3, self_contact=[parts[0]])).near.keys)


def test_ties_join_sides_like_common_vertices() -> None:
    """Vertex 0 of a square tied to a corner of another: 2 + 2 vertices and triangles, 3 x 3 edges, at any distance."""
    low, high = (pd.Cloth(pd.TriMesh(*square(height)), 1e5, 1e-3, 0.2) for height in (0.0, 0.1))
    tie = pd.Tie(low, [0], high, [[0.0, 0.1, 0.0]], stiffness=1e3)
    plan = plan_of(low, high, tie, pd.Contact(thickness=1e-3))
    assert not plan.near.thickness.any()
    assert np.stack(np.divmod(plan.near.keys[:4], 4), axis=1).tolist() == [[0, 2], [0, 3], [4, 0], [4, 1]]
    first, second = np.divmod(plan.near.keys[4:] - 8 * 4, 10)
    assert len(first) == 3 * 3
    assert {tuple(plan.edges[of].tolist()) for of in first} == {(0, 1), (0, 2), (0, 3)}
    assert {tuple(plan.edges[of].tolist()) for of in second} == {(4, 5), (4, 6), (4, 7)}
    rod = pd.Rod(np.linspace((0.0, 2, 0), (1, 2, 0), 4), 1e6, 1e-2)  # takes no part, and has no triangles
    tied = pd.Tie(rod, [0], high, [[0.0, 0.1, 0.0]], stiffness=1e3)
    assert not len(plan_of(low, high, rod, tied, pd.Contact(low, high, thickness=1e-3)).near.keys)


def test_a_seam_may_touch_at_rest() -> None:
    """Two triangles of a sheet meet along x = 1 without common vertices; a tie joins 3 to 1 and 5 to 2."""
    vertices = [[0.0, 0, 0], [1, 0, 0], [1, 0, 1], [1, 0, 0], [2, 0, 0], [1, 0, 1]]
    open_seam = pd.Cloth(pd.TriMesh(vertices, [[0, 2, 1], [3, 5, 4]]), 1e5, 1e-3, 0.2)
    with pytest.raises(ValueError, match="must be apart at rest, got distance 0"):
        plan_of(open_seam, pd.Contact(thickness=1e-3))
    tie = pd.Tie(open_seam, [3, 5], open_seam, open_seam.mesh.vertices[[1, 2]], stiffness=1e3)
    assert not plan_of(open_seam, tie, pd.Contact(thickness=1e-3)).near.thickness.any()


def covers(tree: ContactTree, count: int) -> None:
    assert np.sort(tree.order).tolist() == list(range(count))
    sizes = (count, *tree.levels)
    assert tree.levels == tuple(-(-size // 32) for size in sizes[:-1])
    assert tree.levels[-1] == 1


@pytest.mark.parametrize("count", [1, 31, 32, 33, 1024, 1025, 40_000])
def test_trees_cover_every_primitive_once(count: int) -> None:
    """Bodies one after another, each in one piece, whatever their numbers and places."""
    rng = np.random.default_rng(count)
    body = rng.permutation(np.arange(count) % 3)
    tree = contact_tree(rng.normal(size=(count, 3)), body)
    covers(tree, count)
    assert (np.diff(body[tree.order]) >= 0).all()


def test_trees_of_a_plan() -> None:
    plan = plan_of(cube(6), cube(3, (1, 0, 0)), pd.Contact())
    first = plan.body == 0
    for tree, corners in (
        (plan.vertex_tree, plan.vertices), (plan.triangle_tree, plan.triangles[:, 0]),
        (plan.edge_tree, plan.edges[:, 0]),
    ):  # fmt: skip
        covers(tree, len(corners))
        assert first[corners[tree.order]].tolist() == sorted(first[corners].tolist(), reverse=True)
    assert plan.triangle_tree.levels == (17, 1)  # 432 + 108 triangles


def test_order_is_that_of_morton() -> None:
    """Corners of a cube: x is the lowest bit; equal codes keep their order. Places and sizes of bodies do not count."""
    corners = np.stack(np.meshgrid([0.0, 1.0], [0.0, 1.0], [0.0, 1.0], indexing="ij"), axis=-1).reshape(-1, 3)
    along = [0, 4, 2, 6, 1, 5, 3, 7]
    both = np.concatenate([corners, 1e-3 * corners + 1e3])
    body = np.repeat([0, 1], 8)
    assert contact_tree(both, body).order.tolist() == [*along, *(8 + number for number in along)]
    assert contact_tree(np.zeros((3, 3)), np.zeros(3, dtype=np.int64)).order.tolist() == [0, 1, 2]


def test_clusters_are_compact() -> None:
    """Mean diagonal of clusters of a fine grid, over that of squares of 32 cells: Morton's curve has few long jumps."""
    x, y = (axis.reshape(-1) for axis in np.meshgrid(np.arange(64.0), np.arange(64.0)))
    points = np.stack([x, y, 0.0 * x], axis=1)
    boxes = Boxes.of(contact_tree(points, np.zeros(4096, dtype=np.int64)), points, points)
    sides = boxes.high[1] - boxes.low[1]
    assert sorted(set(map(tuple, sides.tolist()))) == [(7.0, 3.0, 0.0)]


@pytest.mark.parametrize("sizes", [(1, 1), (40, 3000), (3000, 40), (2000, 2000)])
def test_boxes_that_meet(sizes: tuple[int, int]) -> None:
    """Those that all pairs give, each once; nothing meets a box that is left out."""
    rng = np.random.default_rng(3)
    made = []
    for size in sizes:
        low = rng.uniform(size=(size, 3))
        high = low + rng.exponential(0.02, size=(size, 3))
        out = rng.uniform(size=size) < 0.1
        low[out], high[out] = np.inf, -np.inf
        made.append(
            (low, high, Boxes.of(contact_tree(np.where(out[:, None], 0.5, low), np.arange(size) % 2), low, high))
        )

    def expected(one: int, other: int) -> np.ndarray[Any, Any]:
        (low, high, _), (other_low, other_high, _) = made[one], made[other]
        return np.argwhere(((low[:, None] <= other_high) & (other_low <= high[:, None])).all(axis=2))

    found = np.stack(meeting(made[0][2], made[1][2]), axis=1)
    np.testing.assert_array_equal(found[np.lexsort(found.T[::-1])], expected(0, 1))
    own = np.sort(np.stack(meeting(made[0][2], made[0][2]), axis=1), axis=1)
    pairs = expected(0, 0)
    np.testing.assert_array_equal(own[np.lexsort(own.T[::-1])], pairs[pairs[:, 0] < pairs[:, 1]])


def test_distances_of_pairs() -> None:
    """Vertex over a face, beyond an edge, beyond a corner; edges that cross, end, and are parallel."""
    face = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    points = np.array([[0.2, 0.3, 0.5], [2, 2, 0], [-3, 0, 4]])
    np.testing.assert_allclose(triangle_distances(points, np.tile(face, (3, 1, 1))), [0.5, 3 / np.sqrt(2), 5])
    first = np.tile([[0.0, 0, 0], [1, 0, 0]], (5, 1, 1))
    second = np.array([
        [[0.5, -1, 0.1], [0.5, 1, 0.1]], [[4, 4, 0], [4, 5, 0]], [[0.25, 0, 0.2], [0.75, 0, 0.2]],
        [[0.25, 0, 0.2], [0.75, 0, 0.2 + 5e-10]], [[0.5, 0, 0], [0.5, 0, 3]],
    ])  # fmt: skip
    expected = [0.1, 5, 0.2, 0.2, 0]
    np.testing.assert_allclose(segment_distances(first, second), expected, rtol=1e-8)
    np.testing.assert_allclose(segment_distances(second, first), expected, rtol=1e-8)


def test_fifty_thousand_triangles_are_no_matter_of_minutes() -> None:
    """Two layers of 158 x 79 cells, 4 mm apart: well below a second, where all pairs would take minutes."""
    points, triangles = sheet(size=(1.0, 0.5), cells=(158, 79))
    both = np.concatenate([points, points + [0.001, 0.004, 0.002]])
    mesh = pd.TriMesh(both, np.concatenate([triangles, triangles + len(points)]))
    values = pd.Scene(pd.Cloth(mesh, 1e5, 1e-3, 0.2), pd.Contact(thickness=2.1e-3)).values()
    start = time.process_time()
    plan = contact_plan(values)
    assert time.process_time() - start < 5.0
    assert len(plan.triangles) == 49_928
    assert len(plan.near.keys) > 100_000
    assert float(plan.near.thickness.max()) < plan.thickness
