"""Flat arrays of rods, springs, ties and fibres, and how a scene joins all kinds."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from sheets import bending_energy, cloth, deformation, group_of, surface

import torchpd as pd
from torchpd.common.warn import SceneWarning
from torchpd.scene.stencils import KINDS

EXACT = 1e-12  # roundings of a few products of numbers near 1


def solid(offset: tuple[float, float, float] = (0.0, 0.0, 0.0), **changed: object) -> pd.Solid:
    mesh = pd.shapes.box((0.2, 0.2, 0.2), (2, 2, 2)).translated(offset)
    return pd.Solid(mesh, **{"youngs": 1e5, **changed})


def straight(points: int = 5, length: float = 1.0) -> pd.Rod:
    return pd.Rod(np.linspace((0.0, 1.0, 0.0), (length, 1.0, 0.0), points), youngs=1e6, radius=0.01)


# ---- rods


def test_a_rod_stretches_and_bends() -> None:
    """Springs of E A / L0; on even segments E I / 2 |x0 - 2 x1 + x2|^2 / L0^3, with I = pi r^4 / 4."""
    rod = straight()
    stretch, bend = pd.Scene(rod).values().stencils[::-1]
    np.testing.assert_allclose(stretch.material["spring_stiffness"], 1e6 * np.pi * 1e-4 / 0.25, rtol=EXACT)
    np.testing.assert_allclose(stretch.material["rest_length"], 0.25, rtol=EXACT)
    assert np.linalg.norm(deformation(stretch, rod.polyline), axis=1).ravel() == pytest.approx([0.25] * 4, rel=EXACT)
    moved = rod.polyline + np.random.default_rng(2).normal(size=(5, 3))
    second = np.diff(moved, n=2, axis=0)
    expected = 1e6 * np.pi * 1e-8 / 4.0 / 2.0 * (second**2).sum() / 0.25**3
    assert bending_energy(bend, moved) == pytest.approx(expected, rel=EXACT)
    assert bend.corners[:, 3].tolist() == [1, 2, 3]
    assert not bend.gradients[:, 3].any()


def test_uneven_segments_are_straight_at_rest() -> None:
    """A circle of radius R costs E I / 2 / R^2 a length, whatever the segments; a straight rod costs nothing."""
    arcs = np.cumsum(np.append(0.0, np.random.default_rng(3).uniform(0.5, 2.0, 400)))
    arcs *= 1.0 / arcs[-1]
    points = np.stack([arcs, np.zeros_like(arcs), np.zeros_like(arcs)], axis=1)
    rod = pd.Rod(points, youngs=1e6, radius=0.01, bending=3.0)
    group = group_of("hinge", rod)
    assert not rod.rest_curvature.any()
    assert bending_energy(group, points) < 1e-20 * 3.0 / 0.0025**2
    circle = np.stack([np.cos(arcs), np.sin(arcs), np.zeros_like(arcs)], axis=1)
    assert bending_energy(group, circle) == pytest.approx(1.5, rel=0.01)  # the end segments count half
    curved = pd.Rod(circle, youngs=1e6, radius=0.01, bending=3.0)
    assert curved.rest_curvature == pytest.approx(np.ones(399), rel=1e-4)
    assert bending_energy(group_of("hinge", curved), circle) < 1e-20
    open_ = pd.Rod(circle, youngs=1e6, radius=0.01, bending=3.0, rest_curvature=0.0)
    assert bending_energy(group_of("hinge", open_), circle) == pytest.approx(1.5, rel=0.01)


def test_an_uneven_bend_counts_the_mean_of_its_segments() -> None:
    """Segments of 1 and 3 m at a right angle: kappa = 2 |t1 - t0| / 4 with unit t, times the length of 2 m."""
    rod = pd.Rod([[0, 0, 0], [1, 0, 0], [4, 0, 0]], 1e6, 0.01, bending=5.0)
    bent = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 3.0, 0.0]])
    assert bending_energy(group_of("hinge", rod), bent) == pytest.approx(5.0 / 2.0 * 0.5 * 2.0, rel=EXACT)
    soft = pd.Rod(rod.polyline, [1e6, 2e6], 0.01)
    assert soft.flexural_rigidity() == pytest.approx([1.75e6 * np.pi * 1e-8 / 4.0], rel=EXACT)  # by length


def test_ropes_and_single_segments_have_no_hinges() -> None:
    rope = pd.Rod(straight().polyline, youngs=1e6, radius=0.01, bending=0.0)
    for rod in (rope, straight(2)):
        assert [group.kind for group in pd.Scene(rod).values().stencils] == ["spring"]


def test_a_rod_has_half_masses_at_its_ends() -> None:
    masses = pd.Scene(straight()).values().masses
    np.testing.assert_allclose(masses, 1000.0 * np.pi * 1e-4 * 0.25 * np.array([0.5, 1, 1, 1, 0.5]), rtol=EXACT)


# ---- springs and ties


def test_springs_join_vertices_of_one_or_two_bodies() -> None:
    near, far = solid(), solid((0.3, 0.0, 0.0))
    within = pd.Springs(near, [[0, 26]], 5.0)
    between = pd.Springs(far, [[0, 1], [2, 3]], [1.0, 2.0], [0.0, 0.7], other=near)
    group = group_of("spring", near, between, far, within)
    assert group.corners.tolist() == [[27, 1], [29, 3], [0, 26]]
    assert group.material["spring_stiffness"].tolist() == [1.0, 2.0, 5.0]
    np.testing.assert_allclose(group.material["rest_length"], [0.0, 0.7, np.sqrt(0.12)], rtol=EXACT)
    x = np.concatenate([near.mesh.vertices, far.mesh.vertices])
    np.testing.assert_array_equal(deformation(group, x)[:, :, 0], x[group.corners[:, 1]] - x[group.corners[:, 0]])


def test_ties_hold_vertices_to_points() -> None:
    """F = x_v - p for any affine motion of the holding body, whose point p moves along; 0 where both coincide."""
    body, sheet, rod = solid(), cloth(), straight()
    inside = np.array([[0.05, 0.11, 0.07], [0.19, 0.02, 0.03]])
    ties = [
        (pd.Tie(sheet, [0, 1], body, inside, stiffness=1e3), inside),
        (pd.Tie(body, [3], sheet, [[0.4, 0.0, 0.9]], stiffness=1e3), np.array([[0.4, 0.0, 0.9]])),
        (pd.Tie(body, [3], rod, [[0.6, 1.0, 0.0]], stiffness=1e3), np.array([[0.6, 1.0, 0.0]])),
        (pd.Tie(rod, [0], rod, [[0.75, 1.0, 0.0]], stiffness=1e3), np.array([[0.75, 1.0, 0.0]])),
    ]
    scene = pd.Scene(body, sheet, rod)
    map_ = np.eye(3) + 0.3 * np.random.default_rng(4).normal(size=(3, 3))
    x = scene.values().rest_positions @ map_.T
    for tie, points in ties:
        group = group_of("tie", *scene.parts, tie)
        assert group.corners.shape == (len(points), 5)
        wanted = x[group.corners[:, 0]] - points @ map_.T
        np.testing.assert_allclose(deformation(group, x)[:, :, 0], wanted, atol=EXACT)
        assert (group.gradients[:, 1:] <= 0.0).all()
        assert (scene.vertex_range(tie.other).start <= group.corners[:, 1:]).all()
    welded = pd.Tie(body, body.mesh.vertices[:, 1] == 0.0, sheet, stiffness=1e3)  # the base lies on the sheet
    group = group_of("tie", body, sheet, welded)
    assert np.abs(deformation(group, scene.values().rest_positions)).max() < EXACT


def test_ties_off_the_body_are_said() -> None:
    """The closest point holds; a tenth of an edge of 0.1 sqrt(3) m is 0.017 m."""
    body, other = solid(), solid((0.25, 0.0, 0.0))
    facing = np.flatnonzero(body.mesh.vertices[:, 0] == body.mesh.vertices[:, 0].max())
    with pytest.warns(SceneWarning, match=r"Tie: 9 of 9 vertices lie off .*vertex 18 by 0\.\d+ edges") as said:
        tie = pd.Tie(body, facing, other, stiffness=1e3)
    assert said[0].filename == __file__
    held = np.einsum("na,nak->nk", tie.weights, other.mesh.vertices[tie.corners])
    np.testing.assert_allclose(held - body.mesh.vertices[facing], np.tile([0.05, 0.0, 0.0], (9, 1)), atol=EXACT)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pd.Tie(body, facing, other, body.mesh.vertices[facing] + [0.06, 0.0, 0.0], stiffness=1e3)


# ---- fibres


def test_fibres_have_unit_length_at_rest_and_contract() -> None:
    """|F f| = 1 at rest and s for a stretch along f; L = 1 - contraction activation; volumes are those of material."""
    mesh = solid().mesh
    part_full = pd.TetMesh(mesh.vertices, mesh.tets, fill=np.linspace(0.1, 1.0, 48))
    body = pd.Solid(part_full, 1e5)
    across = pd.Fibres(body, (3.0, 0.0, 0.0), 1e4, activation=0.5)
    some = pd.Fibres(
        body, [[0.0, 1.0, 1.0]] * 2, [1.0, 2.0], [0.2, 0.4], activation=1.0, tension_only=True, tets=[7, 3]
    )
    group = group_of("fibre", body, across, some)
    lengths = np.linalg.norm(deformation(group, part_full.vertices * [1.3, 1.0, 1.0])[:, :, 0], axis=1)
    np.testing.assert_allclose(lengths, [1.3] * 48 + [1.0] * 2, rtol=EXACT)
    np.testing.assert_allclose(group.material["fibre_length"], [0.85] * 48 + [0.8, 0.6], rtol=EXACT)
    assert group.material["fibre_stiffness"].tolist() == [1e4] * 48 + [1.0, 2.0]
    assert group.constants.ravel().tolist() == [0.0] * 48 + [1.0] * 2
    volumes = part_full.fill * mesh.quality().volumes
    np.testing.assert_allclose(group.measure, [*volumes, *volumes[[7, 3]]], rtol=EXACT)
    assert group.corners[48:].tolist() == part_full.tets[[7, 3]].tolist()


# ---- scenes


def test_groups_come_by_kind_in_the_order_of_the_table() -> None:
    options = {"strain_limit": (0.9, 1.1)}
    body = solid(poisson=0.3, law="volume", stiffness_damping=0.1, **options)
    sheet, rod = cloth(warp=3.0, grain=(1, 0, 0), **options), straight()
    parts = (
        pd.Fibres(body, (1, 0, 0), 1e4), rod, pd.Tie(rod, [4], body, [[0.2, 0.2, 0.0]], stiffness=1.0), sheet,
        solid(plastic=pd.Plastic(0.1)), body, pd.Springs(sheet, [[0, 1]], 2.0),
    )  # fmt: skip
    scene = pd.Scene(*parts)
    values = scene.values()
    assert [group.kind for group in values.stencils] == list(KINDS)
    for group in values.stencils:
        kind, count = KINDS[group.kind], len(group)
        assert group.corners.shape == (count, kind.corners)
        assert group.corners.dtype == np.int64
        assert group.gradients.shape == (count, kind.corners, kind.columns)
        assert (group.measure.shape, group.constants.shape) == ((count,), (count, kind.constants))
        assert tuple(group.material) == kind.own_rows
        assert {row.shape for row in group.material.values()} <= {(count,), (count, 3), (count, 10)}
        assert (group.tets is not None) == kind.of_tets
        largest = np.abs(group.gradients).max(axis=(1, 2))
        assert (np.abs(group.gradients.sum(axis=1)).max(axis=1) <= EXACT * largest).all()
        assert (group.measure > 0.0).all()
        for part in parts:
            rows = scene.stencil_ranges(part).get(group.kind)
            if rows is not None:
                (own,) = (one for one in part.stencils(lambda b: scene.vertex_range(b).start) if one.kind == group.kind)
                np.testing.assert_array_equal(group.corners[rows], own.corners)
    assert scene.stencil_ranges(parts[-1]) == {"spring": slice(4, 5)}
    count = len(body.mesh.tets)
    assert scene.stencil_ranges(body) == {kind: slice(0, count) for kind in ("solid_limit", "volume", "damper")}
    with pytest.raises(ValueError, match="part must be a part of the scene, got another one"):
        scene.stencil_ranges(straight())


def test_vertices_follow_the_order_of_the_bodies() -> None:
    sheet, body, rod = cloth(), solid(), straight()
    scene = pd.Scene(sheet, pd.Gravity(), body, pd.Pin(rod, [1, 2]), rod, pd.Pin(sheet, [3], 5.0))
    assert scene.bodies == (sheet, body, rod)
    assert scene.solids == (body,)
    assert [scene.vertex_range(one) for one in scene.bodies] == [slice(0, 25), slice(25, 52), slice(52, 57)]
    values = scene.values()
    np.testing.assert_array_equal(
        values.rest_positions, np.concatenate([sheet.surface.vertices, body.mesh.vertices, rod.polyline])
    )
    np.testing.assert_array_equal(values.tets, body.mesh.tets + 25)
    assert values.pin_vertices.tolist() == [53, 54, 3]
    np.testing.assert_array_equal(values.pin_targets, values.rest_positions[[53, 54, 3]])
    assert values.component.tolist() == [0] * 25 + [1] * 27 + [2] * 5


def test_springs_and_ties_join_components() -> None:
    """Only their common rigid motions change no elastic energy, so a step may move them only together."""
    two = pd.Rod([[0, 0, 0], [1, 0, 0]], 1e6, 0.01), pd.Rod([[2, 0, 0], [3, 0, 0]], 1e6, 0.01)
    joined = pd.Scene(
        *two, pd.Springs(two[0], [[1, 0]], 1.0, other=two[1]), pd.Tie(two[0], [0], two[1], [[2, 0, 0]], stiffness=1.0)
    )
    assert joined.values().component.tolist() == [0, 0, 0, 0]
    assert pd.Scene(*two).values().component.tolist() == [0, 0, 1, 1]
    vertices = np.concatenate([surface().vertices, surface().vertices + [2.0, 0.0, 0.0]])
    halves = pd.TriMesh(vertices, np.concatenate([surface().triangles, surface().triangles + 25]))
    assert pd.Scene(cloth(halves)).values().component.tolist() == [0] * 25 + [1] * 25


@pytest.mark.parametrize(
    ("body", "vertices", "loose"),
    [
        ("cloth", [], True), ("cloth", [0, 4], True), ("cloth", [0, 4, 20], False),
        ("rod", [0], True), ("rod", [0, 1], True), ("bent", [0, 1], True), ("bent", [0, 1, 4], False),
    ],
)  # fmt: skip
def test_pins_along_a_line_leave_a_turn(body: str, vertices: list[int], loose: bool) -> None:
    """A straight rod has five rigid motions at rest, and turns about its pins once it bends, as a clamped one may."""
    bent = np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 0.1, 0], [0.3, 0.1, 0.1], [0.3, 0.2, 0.1]])
    held = {"cloth": cloth, "rod": straight, "bent": lambda: pd.Rod(bent, 1e6, 0.01)}[body]()
    scene = pd.Scene(held, *([pd.Pin(held, vertices)] if vertices else []))
    assert scene.values().loose.tolist() == [loose]


def test_scenes_of_solids_have_no_stencils_and_no_poisson() -> None:
    values = pd.Scene(solid(), solid((0.5, 0.0, 0.0), averaging=1)).values()
    assert (values.stencils, values.poisson, values.tet_group) == ((), None, None)
    empty = pd.Scene(straight()).values()
    assert (empty.tets.shape, empty.stiffness.shape, empty.density.shape) == ((0, 4), (0,), (0,))
